"""Send signals at random times to the command; check that outputs are complete, inputs intact, and messages clean.

    python benchmarks/signals.py -n 100
    python benchmarks/signals.py --case polish:41 --keep FOLDER

Each command runs once undisturbed, to measure its duration. It then runs repeatedly, each time in its own session, and
receives SIGINT or SIGTERM at a time drawn from seed and name. A *failure* is any of: a traceback; an undocumented exit
status (SIGTERM may end a process with its default status); a remaining process; changed inputs; output that is missing
or truncated; a temporary file remaining after SIGINT; a batch that does not complete when the same command runs again.
Requires a system with process groups.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from damaged_files import read_trials
from quasiharmonic import boundary_loops, injective_map
from quasiharmonic.io import MeshData, map_of, read_mesh, write_map
from quasiharmonic.surfaces import cat, disk

# Commands to interrupt: arguments, and the files that they write.
CALLS: dict[str, tuple[str, str]] = {
    "map": ("map mesh.obj --to star:5 --polish symmetric-dirichlet -o out.obj", "out.obj"),
    "refine": ("map coarse.obj --refine -o out.ply", "out.ply"),
    "polish": ("polish flat.obj -o out.obj", "out.obj"),
    "flatten": ("flatten cat.obj -o out.obj", "out.obj"),
    "animate": ("animate mesh.obj frames.npy --polish symmetric-dirichlet -o out", "out"),
    "batch": ("batch set -o out --to disk -j 2 --polish symmetric-dirichlet", "out"),
}
_SIGNALS = signal.SIGINT, signal.SIGTERM
# Seconds for a process to end after a signal, and for its children after it, which may still be loading.
_PATIENCE, _CHILDREN = 60.0, 30.0
_OLD = b"what was here before"


class Trial(NamedTuple):
    """The result of an interrupted command; ``fault`` describes the failure and is empty if there is none."""

    name: str
    sent: str
    after: float
    status: int
    ended: float
    fault: str
    said: str


def prepare(folder: Path) -> None:
    """Write the files that the commands read."""
    V, F = disk(14)
    (loop,) = boundary_loops(F, len(V))
    bent = MeshData(np.column_stack([V, 0.4 * (V**2).sum(axis=1)]), F)
    z = V @ (1, 1j)
    waves = [V * (1 + 0.03 * k * np.cos(5 * np.angle(z))[:, None]) for k in range(12)]
    write_map(folder / "mesh.obj", bent, V)
    write_map(folder / "flat.obj", bent, injective_map(V, F, loop, waves[-1][loop]).uv)
    np.save(folder / "frames.npy", np.stack(waves))
    write_map(folder / "cat.obj", MeshData(*cat(40)), np.zeros((len(cat(40)[0]), 2)))
    # A star with corners where the mesh is a fan of few triangles, so that edges must be split.
    coarse, G = disk(3)
    (rim,) = boundary_loops(G, len(coarse))
    star = coarse.copy()
    star[rim] *= np.where(np.arange(len(rim)) % 2, 1.0, 0.08)[:, None]
    write_map(folder / "coarse.obj", MeshData(np.column_stack([coarse, np.zeros(len(coarse))]), G), star)
    (folder / "set").mkdir()
    for k in range(8):
        shutil.copy(folder / "mesh.obj", folder / "set" / f"part{k}.obj")


def undisturbed(kind: str, given: Path) -> float:
    """Return the seconds that a command takes."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(given, folder, dirs_exist_ok=True)
        began = time.monotonic()
        process = _start(CALLS[kind][0], Path(folder))
        said, _ = process.communicate()
        if process.returncode:
            raise RuntimeError(f"qhm {CALLS[kind][0]} ends in {process.returncode} by itself: {said}")
        return time.monotonic() - began


def attempt(name: str, given: Path, seconds: float, folder: Path) -> Trial:
    """Interrupt a command, named ``kind:seed``, in its own folder."""
    kind, seed = name.split(":")
    call, written = CALLS[kind]
    rng = np.random.default_rng([zlib.crc32(kind.encode()), int(seed)])
    number = _SIGNALS[int(rng.integers(2))]
    after = float(rng.uniform(0, 1.1 * seconds))
    shutil.copytree(given, folder, dirs_exist_ok=True)
    output = folder / written
    if output.suffix:
        output.write_bytes(_OLD)
    process = _start(call, folder)
    with suppress(subprocess.TimeoutExpired):
        process.wait(after)
    told = time.monotonic()
    process.send_signal(number)
    try:
        said, _ = process.communicate(timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        said, _ = process.communicate()
    ended = time.monotonic() - told
    fault = _fault(number, process, ended, said) or _left(given, folder, number, written, process.returncode)
    if not fault and kind == "batch":
        fault = _not_resumed(call, folder)
    return Trial(name, number.name, after, process.returncode, ended, fault, said)


def _start(call: str, folder: Path) -> subprocess.Popen[str]:
    """Start the command as the leader of its own process group."""
    return subprocess.Popen(
        [sys.executable, "-m", "quasiharmonic", *call.split()],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        # Shells ignore these signals in background processes.
        preexec_fn=_heeding,
    )


def _heeding() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _fault(number: signal.Signals, process: subprocess.Popen[str], ended: float, said: str) -> str:
    """Return the fault in how the process ended, or an empty string."""
    if ended >= _PATIENCE:
        return f"not ended after {_PATIENCE:g} s"
    if "Traceback" in said or "Error" in said:
        return "a traceback"
    by_itself = 0, 1, 2, 3
    if process.returncode not in (by_itself if number is signal.SIGINT else (*by_itself, -signal.SIGTERM)):
        return f"exit status {process.returncode}"
    if process.returncode == 2 and "qhm" not in said:
        return "ended without a word"
    deadline = time.monotonic() + _CHILDREN
    while _alive(process.pid):
        if time.monotonic() > deadline:
            os.killpg(process.pid, signal.SIGKILL)
            return "processes left behind"
        time.sleep(0.05)
    return ""


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def _left(given: Path, folder: Path, number: signal.Signals, written: str, status: int) -> str:
    """Return the fault in the folder's contents, or an empty string."""
    for path in (path for path in given.rglob("*") if path.is_file()):
        here = folder / path.relative_to(given)
        if not here.is_file() or here.read_bytes() != path.read_bytes():
            return f"{here.name} has changed"
    parts = list(folder.rglob("*.tmp"))
    # A batch kills its workers, and removes temporary files when it runs again.
    if parts and number is signal.SIGINT and not (folder / "out").is_dir():
        return f"left behind: {parts[0].name}"
    output = folder / written
    if not output.suffix:
        return _unreadable(path for path in output.rglob("*.obj") if path.is_file()) if output.is_dir() else ""
    if not output.is_file():
        return "what was there is gone"
    if output.read_bytes() == _OLD:
        return "" if status in (2, -signal.SIGTERM) else f"exit status {status}, and nothing written"
    return "exit status 2, and written" if status == 2 else _unreadable([output])


def _unreadable(paths: Iterable[Path]) -> str:
    """Return the first map that cannot be read, and the reason."""
    for path in paths:
        try:
            if map_of(read_mesh(path)) is None:
                return f"{path.name} has no map"
        except (ValueError, OSError) as error:
            return f"{path.name}: {error}"
    return ""


def _not_resumed(call: str, folder: Path) -> str:
    """Return the fault when a batch runs again, or an empty string."""
    again = _start(call, folder)
    said, _ = again.communicate()
    if again.returncode:
        return f"given again, it ends in {again.returncode}: {said[-300:]}"
    if parts := list(folder.rglob("*.tmp")):
        return f"given again, it leaves {parts[0].name} behind"
    records = (folder / "out" / "records.csv").read_text(encoding="utf-8").splitlines()
    wanted = 1 + len(list((folder / "set").glob("*.obj")))
    return "" if len(records) == wanted else f"{len(records)} lines of records instead of {wanted}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Interrupt commands and list the failures; return 1 if there is any."""
    options, names = read_trials(arguments, str(__doc__), "signals", 60, CALLS)
    ends: Counter[str] = Counter()
    failures, slowest = 0, 0.0
    with tempfile.TemporaryDirectory() as given:
        prepare(Path(given))
        seconds = {kind: undisturbed(kind, Path(given)) for kind in dict.fromkeys(name.split(":")[0] for name in names)}
        print("undisturbed: " + ", ".join(f"{kind} {took:.1f} s" for kind, took in seconds.items()), flush=True)
        for name in names:
            folder = Path(tempfile.mkdtemp()) if options.keep is None else options.keep / name.replace(":", "-")
            trial = attempt(name, Path(given), seconds[name.split(":")[0]], folder)
            ends[f"{trial.sent} → {trial.status}"] += 1
            failures, slowest = failures + bool(trial.fault), max(slowest, trial.ended)
            print(f"{trial.name}: {trial.sent} after {trial.after:.2f} s, {trial.fault or 'right'}", flush=True)
            if trial.fault or options.case:
                print("    " + trial.said.strip()[-1000:], flush=True)
            if options.keep is None:
                shutil.rmtree(folder)
    print(", ".join(f"{end}: {count}" for end, count in sorted(ends.items())))
    print(f"{failures} failures among {len(names)} signals, the slowest to end took {slowest:.1f} s")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
