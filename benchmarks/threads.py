"""Linear solvers and threads: how often a process crashes, by trial and by solver.

    python benchmarks/threads.py
    python benchmarks/threads.py -n 5 --trials end overlap --solvers rslab
    python benchmarks/threads.py --trials blender --blender .ci/venv-blender/bin/python

A library that keeps memory for every thread may crash when the thread that loaded it has ended, or when a later one has
taken its place. So every trial is run many times, each in a process of its own. A process *fails* if its status is not
zero, or if it does not end. Where a solver cannot be loaded, SuperLU stands in for it. The trial in Blender takes the
solver that the extension takes.
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

# Seconds until a process that has not ended counts as one that never will.
_PATIENCE = 120
_BUILD = Path(__file__).resolve().parents[1] / "blender" / "build.py"
# The first lines of every process: no other solver than this one, and SuperLU.
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
    # Threads one after another, each ended before the next.
    "end": "for _ in range(4): in_threads(1)",
    # Threads at the same time, and others after them.
    "overlap": "for count in (3, 2, 1, 2): in_threads(count)",
    # The first thread is at work while others come and go.
    "outlive": """
first = threading.Thread(target=work, args=(4,))
first.start()
in_threads(1)
in_threads(2)
first.join()
in_threads(1)
work()
""",
    # Pools of threads, in a process that a thread starts.
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
    # The solver's package was imported before, by a thread that has ended.
    "imported": """
if find_spec(sys.argv[2]):
    in_threads(1, lambda: import_module(sys.argv[2]))
for _ in range(4): in_threads(1)
""",
}
_SERVE = "import sys; from quasiharmonic.ui.studio.worker import serve; serve(sys.argv[1])"
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
    """Run all, one line each; 1 if any process failed."""
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
    """The trials that need no Blender: functions of a solver that run one process and return its status."""
    surface = folder / "cat.obj"
    V, F = cat(40)
    write_obj(surface, MeshData(V, F))
    trials: dict[str, Callable[[str], int]] = {trial: partial(in_process, code) for trial, code in TRIALS.items()}
    return trials | {"worker": partial(in_worker, surface)}


def in_process(code: str, solver: str) -> int:
    """Run a trial in a process."""
    first = _SOLVER % solver + _WORK
    return status_of([sys.executable, "-W", "ignore", "-c", first + code, first, solver])


def in_worker(surface: Path, solver: str) -> int:
    """Have the process behind a page flatten and polish a surface."""
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
            # The last thing that is said of a map.
            kind = ""
            while kind != "obstructions" and len(head := process.stdout.read(8)) == 8:
                kind = decode(process.stdout.read(int.from_bytes(head, "little"))).header["kind"]
            if kind != "obstructions":
                return process.wait() or 1
        process.stdin.close()
        return process.wait()


def in_blender(python: str, folder: Path) -> Callable[[], int]:
    """Build the extension; a function that flattens Suzanne twice in Blender, subdivided twice."""
    subprocess.run([python, str(_BUILD), "-o", str(folder)], check=True)
    (archive,) = folder.glob("*.zip")

    def run() -> int:
        with tempfile.TemporaryDirectory() as settings:
            return status_of([python, "-c", _BLENDER, str(archive), settings])

    return run


def status_of(command: list[str]) -> int:
    """What a process ends with; 124 if it does not end."""
    try:
        return subprocess.run(command, stdout=subprocess.DEVNULL, timeout=_PATIENCE).returncode
    except subprocess.TimeoutExpired:
        return 124


def report(trial: str, solver: str, n: int, run: Callable[[], int]) -> bool:
    """Run a trial n times and print what became of it; whether any process failed."""
    found = Counter(run() for _ in range(n))
    failed = n - found.pop(0, 0)
    kinds = ", ".join(f"{count} with status {status}" for status, count in sorted(found.items()))
    print(f"{trial:10} {solver:10} {failed:3} of {n} failed{': ' * bool(kinds)}{kinds}", flush=True)
    return failed > 0


if __name__ == "__main__":
    sys.exit(main())
