from __future__ import annotations

import gc
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

# Use one thread per process: there may be one process per core, and on small problems one thread is faster anyway.
# Libraries read these variables when they are loaded, so set them before NumPy is imported.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# Without bytecode, each process that a test starts would compile the package again, which takes longer than most tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A process that a script starts in the background ignores interrupts, and so would the commands that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# These scripts limit the resources of processes, which Windows cannot.
collect_ignore = ["test_benchmarks.py", "test_damaged_files.py"] if os.name == "nt" else []

EXAMPLES = Path(__file__).parent.parent / "examples"

# Beyond this number, a worker's start and its memory (half a gigabyte) cost more than it saves.
MOST_WORKERS = 8


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """A worker for each core; no worker if files are named, because most of them end before workers have started."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None  # the plugin then reads this variable itself
    if any(".py" in argument for argument in config.args):
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(MOST_WORKERS, cores)


def pytest_addoption(parser):
    parser.addoption("--nightly", action="store_true", help="run the tests that .ci/nightly runs, too")


def pytest_configure(config):
    """Let Hypothesis generate the same examples in every run, and new ones only with `--nightly`."""
    try:
        from hypothesis import Phase, settings
    except ImportError:  # the tests of a wheel and of the Blender extension install little
        return
    # A mutant (.ci/mutants) is killed by any failing example; to shorten the example would take minutes.
    phases = [Phase.explicit, Phase.generate] if "MUTANT_UNDER_TEST" in os.environ else list(Phase)
    settings.register_profile("repeatable", derandomize=True, database=None, deadline=None, phases=phases)
    settings.register_profile("exploring", print_blob=True, deadline=None)
    settings.load_profile("exploring" if config.getoption("nightly") else "repeatable")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker("slow")
    if not config.getoption("nightly"):
        left = [item for item in items if item.get_closest_marker("nightly")]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in left]


def pytest_collection_finish():
    """Leave the modules and the collected tests out of later garbage collections, which they would slow down."""
    gc.freeze()


def pytest_runtest_teardown():
    """Ignore SIGPIPE again, as Python does: Gmsh undoes this, and then a write to a closed socket ends the process."""
    if "gmsh" in sys.modules and hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)


@pytest.fixture
def rng():
    """A random generator with a constant seed."""
    import numpy as np

    return np.random.default_rng(20231)


@pytest.fixture
def put(tmp_path):
    """Write a file and return its path."""

    def write(text, name="mesh.obj"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


@pytest.fixture
def star(tmp_path):
    """The mesh file of a problem with a star as its target, and its fixed vertices next to it."""
    from shared.commands import write_input
    from shared.solvable_problems import star_problem

    return write_input(tmp_path, *star_problem())


@pytest.fixture
def stars(tmp_path):
    """Four problems at several folder depths."""
    from shared.datasets import write_stars

    return write_stars(tmp_path / "set", ["a", "b/c", "b/d/e", "z"])


@pytest.fixture(scope="session")
def flat():
    """A planar mesh of irregular triangles."""
    from quasiharmonic import surfaces

    return surfaces.random_delaunay(400, seed=2)


@pytest.fixture(scope="session")
def dome():
    """A part of a sphere."""
    from shared.distances import make_dome

    return make_dome()


@pytest.fixture
def factored(monkeypatch):
    """Numbers of unknown positions in the factored Newton systems."""
    from quasiharmonic.energies.newton.newton_system import NewtonSystem

    sizes, factor = [], NewtonSystem.factor

    def count(system, shift=0.0):
        sizes.append(system.free.size)
        factor(system, shift)

    monkeypatch.setattr(NewtonSystem, "factor", count)
    return sizes


@pytest.fixture
def example(tmp_path, monkeypatch):
    """Run the ``main`` of one script in a new folder, which draws at half the resolution; return its numbers."""
    import importlib
    import json

    import numpy as np
    from matplotlib import rc_context
    from PIL import Image

    monkeypatch.syspath_prepend(str(EXAMPLES))

    def run(name, **options):
        with rc_context({"savefig.dpi": 50}):
            numbers = importlib.import_module(name).main(tmp_path, **options)
        with Image.open(tmp_path / f"{name}.png") as image:
            picture = np.asarray(image.convert("RGB")) / 255
        assert picture.shape[0] > 150
        assert picture.std() > 0.05
        json.dumps(numbers)
        return numbers

    return run


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A studio server of a small surface, which takes few bytes."""
    from shared.studio_server import serve_small_surface

    with serve_small_surface(tmp_path_factory.mktemp("studio")) as server:
        yield server


@pytest.fixture(scope="session")
def forks():
    """Workers of data sets that start without importing the library again."""
    from quasiharmonic.ui.batch import supervisor
    from shared.commands import FAILING_WORKER
    from shared.forked_workers import Forks

    made = Forks([(supervisor.COMMAND, ""), (FAILING_WORKER, FAILING_WORKER[-1])])
    yield made
    made.close()


@pytest.fixture
def quick_workers(forks, monkeypatch):
    """Solve data sets in processes that start quickly, where it is safe to copy processes."""
    from quasiharmonic.ui.batch import supervisor

    if sys.platform == "linux":
        monkeypatch.setattr(supervisor, "subprocess", SimpleNamespace(Popen=forks.open, PIPE=forks.PIPE))


@pytest.fixture
def failing_worker(monkeypatch):
    """Solve data sets in a process that fails or hangs as the names of the problems say."""
    from quasiharmonic.ui.batch import supervisor
    from shared.commands import FAILING_WORKER

    monkeypatch.setattr(supervisor, "COMMAND", FAILING_WORKER)
    # If several problems together make no progress, soon solve them one by one.
    monkeypatch.setattr(supervisor, "TOGETHER", 1.0)


@pytest.fixture(scope="module")
def visitor():
    """A session of the page, shared by the tests of a module that leave it as it was or accept any state."""
    from shared.pages import Visitor

    return Visitor()


@pytest.fixture
def quick_campaign(monkeypatch):
    """Solve the problems of a campaign in processes that start quickly."""
    import campaign
    from shared.quick_processes import quick_context

    monkeypatch.setattr(campaign, "multiprocessing", SimpleNamespace(get_context=lambda _: quick_context()))
