"""In Pyodide, Python in a browser, the package installs and computes without threads, processes or compiled solvers."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import quasiharmonic
from shared.without_threads import simulate

ROOT = Path(__file__).parent.parent
SOURCE = str(Path(quasiharmonic.__file__).parent.parent)
PYODIDE = {"sys_platform": "emscripten", "platform_machine": "wasm32", "platform_python_implementation": "CPython"}

# Imports every module but those that need an extra or start processes when they are used, and computes a few maps.
_MAPS = """
import pkgutil, sys, threading
from importlib import import_module
import quasiharmonic
for start in (threading.Thread(target=print).start, lambda: __import__("subprocess").run(["true"])):
    try:
        start()
    except (RuntimeError, OSError):
        continue
    raise SystemExit("this test simulates nothing")
before = set(threading.enumerate())
for module in pkgutil.walk_packages(quasiharmonic.__path__, "quasiharmonic."):
    if not {"torch", "jax", "notebook", "studio", "batch", "report", "__main__"} & {*module.name.split(".")}:
        import_module(module.name)
from quasiharmonic import flatten, injective_map, injective_maps, polish, unwrap
from quasiharmonic.linsolve import available
from quasiharmonic.surfaces import cat, disk, starfish
from quasiharmonic.targets import boundary_to
from quasiharmonic.util import kernels
assert available() == ("superlu",) and kernels.extension is None
V, F = cat(5)
fixed, target = boundary_to(V, F, "star:5")
first = injective_map(V, F, fixed, target)
assert first.certificate.bijective
assert polish(V, F, first.uv, fixed=fixed, max_iterations=5).injective
problems = [(V, F, fixed, k * target) for k in (1, 2)]
assert [result.injective for result in injective_maps(problems, jobs=3)] == [True, True]
assert flatten(*disk(4)).certificate.bijective
# With a given scale the charts are placed once.
unwrapped = unwrap(*starfish(rings=5), texels_per_unit=20, jobs=3)
assert len(unwrapped.uvs) and unwrapped.charts.max() > 0
assert set(threading.enumerate()) == before
print("mapped")
"""


def test_base_requirements_leave_out_solvers_without_a_wheel():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [Requirement(line) for line in project["dependencies"]]
    there = {one.name for one in needed if one.marker is None or one.marker.evaluate(PYODIDE)}
    assert there == {"lazy_loader", "numpy", "scipy", "matplotlib", "fonttools"}
    assert {one.name for one in needed} - there == {"qdldl", "rslab"}


@pytest.mark.long
def test_maps_without_threads_and_processes(tmp_path):
    environment = simulate(tmp_path)
    environment["PYTHONPATH"] += os.pathsep + SOURCE
    done = subprocess.run([sys.executable, "-c", _MAPS], env=environment, capture_output=True, text=True, timeout=300)
    assert done.stdout == "mapped\n", done.stderr
