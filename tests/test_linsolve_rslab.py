"""The choice of a linear solver, and rslab."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from quasiharmonic.linsolve import (
    QDLDL_UP_TO,
    NotPositiveDefinite,
    available,
    make_solver,
    mkl,
    packages,
    rslab,
)
from quasiharmonic.util import progress
from shared.matrices import ALL, UNLIMITED, both, diagonal, solve, solver_for, stiffness, upper


def test_unknown_name():
    with pytest.raises(ValueError, match=r"linear_solver must be one of auto, mkl, .*, superlu, not 'umfpack'"):
        make_solver([0, 1], [0], name="umfpack")


@pytest.mark.parametrize(
    ("backend", "command"),
    [
        (mkl.MKL, "pip install mkl"),
        (packages.Cholmod, "pip install scikit-sparse"),
        (packages.Qdldl, "pip install qdldl"),
        (rslab.Rslab, "pip install rslab"),
    ],
)
def test_a_backend_that_is_not_installed(monkeypatch, backend, command):
    monkeypatch.setattr(backend, "is_installed", classmethod(lambda cls: False))
    assert backend.name not in available()
    with pytest.raises(ImportError, match=f"'{backend.name}' is not installed; available: .*superlu.*: {command}"):
        make_solver([0, 1], [0], name=backend.name)
    assert make_solver([0, 1], [0]).name != backend.name


def test_auto_uses_the_first_backend_that_loads(monkeypatch):
    def fail(self, *pattern, **ordered):
        raise ImportError("undefined symbol")

    left = list(available(1))
    assert left[-1] == "superlu"
    for expected in left[:-1]:
        solver = make_solver([0, 1], [0])
        assert solver.name == expected
        monkeypatch.setattr(type(solver), "__init__", fail)
        with pytest.raises(ImportError, match="undefined symbol"):
            make_solver([0, 1], [0], name=expected)
    assert make_solver([0, 1], [0]).name == "superlu"


def test_preference_depends_on_the_number_of_entries(monkeypatch):
    for backend in (mkl.MKL, packages.Cholmod, rslab.Rslab, packages.Qdldl):
        monkeypatch.setattr(backend, "is_installed", classmethod(lambda cls: True))
    assert available() == available(QDLDL_UP_TO + 1) == ALL == ("mkl", "cholmod", "rslab", "qdldl", "superlu")
    assert available(QDLDL_UP_TO) == ("mkl", "cholmod", "qdldl", "rslab", "superlu")
    monkeypatch.setattr(packages.Qdldl, "is_installed", classmethod(lambda cls: False))
    assert available(1) == ("mkl", "cholmod", "rslab", "superlu")


@pytest.mark.slow
def test_import_loads_no_backend():
    code = (
        "import sys, quasiharmonic.linsolve as l; l.available(); "
        "print([m for m in ('scipy', 'qdldl', 'rslab', 'sksparse') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


needs_rslab = pytest.mark.skipif(not rslab.Rslab.is_installed(), reason="rslab is not installed")


class Panic(BaseException):
    """A failed assertion in Rust appears like this."""


Panic.__name__ = "PanicException"


@pytest.fixture
def damaged(monkeypatch):
    """Make rslab's symbolic and numeric objects fail in a given way."""
    if not rslab.Rslab.is_installed():
        pytest.skip("rslab is not installed")
    library = rslab.library()
    analyze = library.analyze

    class Stub:
        def __init__(self, of, **instead):
            self.of, self.instead = of, instead

        def __getattr__(self, name):
            return self.instead.get(name, getattr(self.of, name))

    def damage(**instead):
        def analysed(*pattern, **settings):
            if "analyze" in instead:
                return instead["analyze"]()
            symbolic = analyze(*pattern, **settings)
            return Stub(symbolic, factor=instead.get("factor", lambda data: Stub(symbolic.factor(data), **instead)))

        monkeypatch.setattr(library, "analyze", analysed)

    return damage


def test_the_pattern_is_analysed_by_the_first_factorisation(damaged, monkeypatch):
    calls = []
    library = rslab.library()
    analyze = library.analyze
    monkeypatch.setattr(
        library, "analyze", lambda *pattern, **settings: calls.append(1) or analyze(*pattern, **settings)
    )
    solver = rslab.Rslab([0, 2, 3], [0, 1, 1])
    assert not calls
    for scale in (1.0, 2.0):
        solver.factor(scale * np.array([2.0, -1.0, 2.0]))
        np.testing.assert_allclose(solver.solve([scale, scale]), [1.0, 1.0])
    assert calls == [1]


@needs_rslab
def test_a_factorisation_that_would_exceed_the_time_limit_is_not_begun(monkeypatch):
    """The first factorisation takes about as long as the analysis before it."""
    now, library = [0.0], rslab.library()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    analyze = library.analyze

    def analyse_slowly(*pattern, **settings):
        now[0] += 60.0
        return analyze(*pattern, **settings)

    monkeypatch.setattr(library, "analyze", analyse_slowly)
    solver = rslab.Rslab([0, 2, 3], [0, 1, 1])
    with progress.time_limit(100.0) as limit, pytest.raises(KeyboardInterrupt):
        solver.factor(np.array([2.0, -1.0, 2.0]))
    assert limit.reached
    solver.factor(np.array([2.0, -1.0, 2.0]))
    np.testing.assert_allclose(solver.solve([1.0, 1.0]), [1.0, 1.0])


def raising(error):
    def fail(*_):
        raise error

    return fail


@pytest.mark.parametrize("qdldl_present", [True, False])
@pytest.mark.parametrize("step", ["analyze", "factor", "solve", "solve_many"])
@pytest.mark.parametrize("error", [RuntimeError("index out of bounds"), Panic("called `unwrap`")])
def test_another_backend_replaces_rslab_on_failure(damaged, monkeypatch, step, error, qdldl_present):
    if not qdldl_present:
        monkeypatch.setattr(packages.Qdldl, "is_installed", classmethod(lambda cls: False))
    damaged(**{step: raising(error)})
    A = stiffness(12)
    rng = np.random.default_rng(0)
    with solver_for(A, "rslab") as solver:
        for _ in range(2):
            solver.factor(A.data)
            for columns in [(), (1,), (3,), ()]:
                rhs = rng.standard_normal((144, *columns))
                np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-10)
        indefinite = A.data.copy()
        indefinite[A.indptr[:-1]] *= 0.5
        with pytest.raises(NotPositiveDefinite, match="not positive definite"):
            solver.factor(indefinite)


@pytest.mark.parametrize("damage", [np.zeros_like, np.negative, lambda x: np.full_like(x, np.nan), lambda x: x[::-1]])
def test_another_backend_corrects_a_wrong_solution_of_rslab(damaged, damage):
    damaged(solve=lambda b: damage(b), solve_many=lambda b: damage(b))
    A = stiffness(12)
    with solver_for(A, "rslab") as solver:
        solver.factor(A.data)
        for rhs in (np.ones(144), np.random.default_rng(0).standard_normal((144, 2))):
            np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-10)


def test_each_solve_reports_that_the_replacement_failed_too(damaged, monkeypatch):
    """After the first failure the solver must not be without a factor, or the next solve would blame the caller."""
    damaged(solve=np.zeros_like)
    A = stiffness(4)
    with solver_for(A, "rslab") as solver:
        solver.factor(A.data)
        with monkeypatch.context() as during:
            for other in (packages.Qdldl, packages.SuperLU):
                during.setattr(other, "factor", raising(NotPositiveDefinite("singular")))
            for _ in range(2):
                with pytest.raises(NotPositiveDefinite, match="singular"):
                    solver.solve(np.ones(16))
        np.testing.assert_allclose(both(A) @ solver.solve(np.ones(16)), 1, rtol=0, atol=1e-10)


@pytest.mark.parametrize("error", [MemoryError("no memory"), KeyboardInterrupt(), ValueError("wrong length")])
def test_other_exceptions_of_rslab_are_raised(damaged, error):
    damaged(factor=raising(error))
    A = stiffness(4)
    with solver_for(A, "rslab") as solver, pytest.raises(type(error)):
        solver.factor(A.data)


@needs_rslab
def test_rslab_solves_its_own_test_cases(monkeypatch):
    """No other backend replaces it for matrices that it should handle: any scaling, and indefinite ones."""
    for other in ("Qdldl", "SuperLU"):
        monkeypatch.setattr(rslab, other, None)
    A = stiffness(20, contrast=2.0)
    for decades in (0, 10, 60):
        scale = 2.0 ** np.round(np.random.default_rng(3).uniform(-decades, decades, 400) * np.log2(10))
        scaled = upper(diagonal(scale) @ both(A) @ diagonal(scale))
        rhs = scale * np.random.default_rng(4).standard_normal(400)
        x = solve(scaled, rhs, "rslab") * scale
        np.testing.assert_allclose(both(A) @ x, rhs / scale, rtol=0, atol=1e-9)
        scaled.data[scaled.indptr[:-1]] *= 0.9
        with pytest.raises(NotPositiveDefinite, match="rslab found a pivot"):
            solver_for(scaled, "rslab").factor(scaled.data)


_BITS = """
import sys
import numpy as np
from quasiharmonic.linsolve import make_solver
indptr, indices, data, rhs = (np.load(f"{part}.npy") for part in ("indptr", "indices", "data", "rhs"))
with make_solver(indptr, indices, name="rslab") as solver:
    solver.factor(data)
    np.save(sys.argv[1], solver.solve(rhs))
"""


@pytest.mark.long
@needs_rslab
def test_rslab_gives_the_same_bits_on_any_number_of_threads(tmp_path):
    A = stiffness(174, contrast=1.0)
    assert A.shape[0] >= rslab.SEQUENTIAL_BELOW
    for part in ("indptr", "indices", "data"):
        np.save(tmp_path / f"{part}.npy", getattr(A, part))
    np.save(tmp_path / "rhs.npy", np.random.default_rng(0).standard_normal((A.shape[0], 2)))
    # The number of threads for solves is set once per process, at the first solve.
    for threads in ("1", "2", "3"):
        environment = UNLIMITED | {"RAYON_NUM_THREADS": threads}
        subprocess.run([sys.executable, "-c", _BITS, f"{threads}.npy"], env=environment, cwd=tmp_path, check=True)
    one, two, three = (np.load(tmp_path / f"{threads}.npy") for threads in ("1", "2", "3"))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, three)


# Solves with rslab in threads that end before the next one begins.
_THREADS = """
import sys, threading
import numpy as np
from quasiharmonic.linsolve import make_solver
n = 300
indptr, indices = np.append(np.arange(0, 2 * n - 1, 2), 2 * n - 1), np.append(np.repeat(np.arange(n), 2)[1:], [])
values = np.where(np.arange(2 * n - 1) % 2, -1.0, 2.0)
found = []
def solve(name="rslab"):
    with make_solver(indptr, indices.astype(int), name=name) as solver:
        solver.factor(values)
        solver.solve(np.ones(n))
        found.append(solver.name)
def one_by_one(*tasks):
    for task in tasks:
        thread = threading.Thread(target=task)
        thread.start()
        thread.join()
"""


_ENDING = {
    "threads that end": "one_by_one(*[solve] * 30)\nsolve()",
    "threads that overlap": """
barrier = threading.Barrier(3)
def solve_together():
    barrier.wait()
    solve()
for _ in range(3):
    threads = [threading.Thread(target=solve_together) for _ in range(3)]
    for thread in threads: thread.start()
    for thread in threads: thread.join()
one_by_one(*[solve] * 30)
""",
    "a second copy of the module": """
one_by_one(solve)
for name in [name for name in sys.modules if name.startswith("quasiharmonic.linsolve")]: del sys.modules[name]
from quasiharmonic.linsolve import make_solver
one_by_one(*[solve] * 30)
""",
}


def finished(code):
    """Return what a process prints that runs this code."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout.split()


@pytest.mark.long
@needs_rslab
@pytest.mark.parametrize("trial", _ENDING)
def test_rslab_works_after_its_first_thread_has_ended(trial):
    assert set(finished(_THREADS + _ENDING[trial] + "\nprint(*found)")) == {"rslab"}


@pytest.mark.slow
@needs_rslab
def test_rslab_imported_by_other_code_is_not_used():
    """The thread that imported it may have ended; rslab then crashes."""
    code = """
from importlib import import_module
import quasiharmonic.linsolve
for other in ("mkl", "cholmod"): del quasiharmonic.linsolve.BACKENDS[other]
quasiharmonic.linsolve.QDLDL_UP_TO = 0
one_by_one(lambda: import_module("rslab"))
one_by_one(*[lambda: solve("auto")] * 6)
try:
    solve()
except ImportError as error:
    print(*found, error)
"""
    said = finished(_THREADS + code)
    assert " ".join(said[6:]).startswith("rslab was imported by other code before quasiharmonic used it")
    assert len(set(said[:6])) == 1
    assert said[0] in ("qdldl", "superlu")


_FORK = """
import os, signal
import numpy as np
from quasiharmonic.linsolve import make_solver
n = 300
indptr, indices = np.append(np.arange(0, 2 * n - 1, 2), 2 * n - 1), np.append(np.repeat(np.arange(n), 2)[1:], [])
values = np.where(np.arange(2 * n - 1) % 2, -1.0, 2.0)
solver = make_solver(indptr, indices.astype(int), name="rslab")
solver.factor(values)
expected = solver.solve(np.ones((n, 2)))
child = os.fork()
if child == 0:
    signal.alarm(30)
    assert np.allclose(solver.solve(np.ones((n, 2))), expected)
    solver.factor(values)
    assert np.allclose(solver.solve(np.ones((n, 2))), expected)
    fresh = make_solver(indptr, indices.astype(int), name="rslab")
    fresh.factor(values)
    assert np.allclose(fresh.solve(np.ones((n, 2))), expected)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.slow
@needs_rslab
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_forked_process_does_not_wait_for_threads_of_its_parent():
    subprocess.run([sys.executable, "-W", "ignore", "-c", _FORK], check=True, timeout=600)
