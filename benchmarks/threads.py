"""Linear solvers and threads: number of crashed processes, by trial and by solver.

    python benchmarks/threads.py
    python benchmarks/threads.py -n 5 --trials end overlap --solvers rslab
    python benchmarks/threads.py --trials blender --blender .ci/venv-blender/bin/python

A library with thread-local memory may crash after the thread that loaded it has ended, or when a later thread has
replaced it. Therefore every trial runs many times, each in its own process. A process *fails* if its status is not zero
or if it does not end. If a solver cannot be loaded, SuperLU replaces it. The trial in Blender uses the extension's
solver.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

from quasiharmonic.io import MeshData, write_obj
from quasiharmonic.linsolve import available
from quasiharmonic.surfaces import cat
from quasiharmonic.ui.studio.protocol import decode, encode

# Seconds after which a process counts as never ending.
_PATIENCE = 120
_BUILD = Path(__file__).resolve().parents[1] / "blender" / "build.py"
# The first lines of every process: allow this solver and SuperLU only.
_SOLVER = """
from quasiharmonic.linsolve import BACKENDS
for name in BACKENDS.keys() - {"%s", "superlu"}:
    del BACKENDS[name]
"""
_WORK = """
import os, subprocess, sys, threading
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from quasiharmonic import flatten
from quasiharmonic.surfaces import cat
V, F = cat(40)
def work(times=1):
    for _ in range(times):
        assert flatten(V, F).injective
def in_threads(count, task=work):
    threads = [threading.Thread(target=task) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
def in_pools():
    for _ in range(3):
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(work, [1, 1]))
"""
TRIALS = {
    # Threads in sequence, each ended before the next.
    "end": "for _ in range(4): in_threads(1)",
    # Simultaneous threads, and more threads after them.
    "overlap": "for count in (3, 2, 1, 2): in_threads(count)",
    # The first thread works while others start and end.
    "outlive": """
first = threading.Thread(target=work, args=(4,))
first.start()
in_threads(1)
in_threads(2)
first.join()
in_threads(1)
work()
""",
    # Thread pools in a process that a thread starts.
    "pool": """
code = sys.argv[1] + "in_pools()"
in_threads(1, lambda: subprocess.run([sys.executable, "-c", code], check=True))
in_pools()
""",
    # Threads in a forked process, and again in its parent.
    "fork": """
if hasattr(os, "fork"):
    in_threads(1)
    child = os.fork()
    if child == 0:
        for _ in range(3): in_threads(1)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
in_threads(1)
""",
    # A thread that has ended has already imported the solver's package.
    "imported": """
if find_spec(sys.argv[2]):
    in_threads(1, lambda: import_module(sys.argv[2]))
for _ in range(4): in_threads(1)
""",
}
_SERVE = "import sys; from quasiharmonic.ui.studio.page_worker import serve; serve(sys.argv[1])"
_BLENDER = """
import os, sys
os.environ["BLENDER_USER_RESOURCES"] = sys.argv[2]
import bpy
bpy.ops.extensions.package_install_files(repo="user_default", filepath=sys.argv[1], enable_on_install=True)
bpy.ops.mesh.primitive_monkey_add()
bpy.context.object.modifiers.new("finer", "SUBSURF").levels = 2
bpy.ops.object.modifier_apply(modifier="finer")
for _ in range(2):
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
"""


def main() -> int:
    """Run all trials, one line each; return 1 if any process failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=20, metavar="N", help="processes for each trial (default: 20)")
    parser.add_argument("--trials", nargs="+", choices=[*TRIALS, "worker", "blender"], help="(default: all)")
    parser.add_argument("--solvers", nargs="+", default=available(), help="(default: all that are installed)")
    parser.add_argument("--blender", metavar="PYTHON", help="an interpreter that has the package bpy")
    options = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as name:
        for solver, (trial, run) in itertools.product(options.solvers, in_python(Path(name)).items()):
            if options.trials is None or trial in options.trials:
                failed |= report(trial, solver, options.n, partial(run, solver))
        if options.blender and (options.trials is None or "blender" in options.trials):
            failed |= report("blender", "auto", options.n, in_blender(options.blender, Path(name)))
    return int(failed)


def in_python(folder: Path) -> dict[str, Callable[[str], int]]:
    """Return the trials without Blender: functions of a solver that run one process and return its status."""
    surface = folder / "cat.obj"
    V, F = cat(40)
    write_obj(surface, MeshData(V, F))
    trials: dict[str, Callable[[str], int]] = {trial: partial(in_process, code) for trial, code in TRIALS.items()}
    return trials | {"worker": partial(in_worker, surface)}


def in_process(code: str, solver: str) -> int:
    """Run a trial in a process; return its status."""
    first = _SOLVER % solver + _WORK
    return status_of([sys.executable, "-W", "ignore", "-c", first + code, first, solver])


def in_worker(surface: Path, solver: str) -> int:
    """Flatten and polish a surface in the process behind a page."""
    command = [sys.executable, "-c", _SOLVER % solver + _SERVE, str(surface)]
    asked = [{"do": "flatten"}, {"do": "polish", "energy": "symmetric-dirichlet"}, {"do": "flatten"}]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for request in [None, *asked]:
            if request is not None:
                message = encode(request)
                process.stdin.write(len(message).to_bytes(8, "little") + message)
                process.stdin.flush()
            # The last message about a map.
            kind = ""
            while kind != "obstructions" and len(head := process.stdout.read(8)) == 8:
                kind = decode(process.stdout.read(int.from_bytes(head, "little"))).header["kind"]
            if kind != "obstructions":
                return process.wait() or 1
        process.stdin.close()
        return process.wait()


def in_blender(python: str, folder: Path) -> Callable[[], int]:
    """Build the extension; return a function that flattens Suzanne, subdivided twice, two times in Blender."""
    subprocess.run([python, str(_BUILD), "-o", str(folder)], check=True)
    (archive,) = folder.glob("*.zip")

    def run() -> int:
        with tempfile.TemporaryDirectory() as settings:
            return status_of([python, "-c", _BLENDER, str(archive), settings])

    return run


def status_of(command: list[str]) -> int:
    """Return the exit status of a command, or 124 if it does not end."""
    try:
        return subprocess.run(command, stdout=subprocess.DEVNULL, timeout=_PATIENCE).returncode
    except subprocess.TimeoutExpired:
        return 124


def report(trial: str, solver: str, n: int, run: Callable[[], int]) -> bool:
    """Run a trial n times and print the results; return whether any process failed."""
    found = Counter(run() for _ in range(n))
    failed = n - found.pop(0, 0)
    kinds = ", ".join(f"{count} with status {status}" for status, count in sorted(found.items()))
    print(f"{trial:10} {solver:10} {failed:3} of {n} failed{': ' * bool(kinds)}{kinds}", flush=True)
    return failed > 0


if __name__ == "__main__":
    sys.exit(main())
