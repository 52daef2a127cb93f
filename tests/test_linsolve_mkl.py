"""Pardiso of MKL."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from quasiharmonic.linsolve import (
    NotPositiveDefinite,
    available,
    make_solver,
    mkl,
)
from quasiharmonic.linsolve.dissection import nested_dissection
from shared.matrices import UNLIMITED, both, diagonal, solve, solver_for, stiffness, upper

needs_mkl = pytest.mark.skipif(mkl.find_mkl() is None, reason="MKL is not installed")


@needs_mkl
def test_pardiso_with_all_threads():
    A = stiffness(180, contrast=1.0)
    assert A.shape[0] >= mkl.SEQUENTIAL_BELOW
    rhs = np.random.default_rng(0).standard_normal((A.shape[0], 2))
    with solver_for(A, "mkl") as solver:
        for columns in (rhs, rhs[:, 0]):
            solver.factor(A.data)
            x = solver.solve(columns)
            np.testing.assert_allclose(both(A) @ x, columns, rtol=0, atol=1e-9)
            np.testing.assert_array_equal(x, solver.solve(columns))
        indefinite = A.data.copy()
        indefinite[A.indptr[:-1]] *= 0.9
        with pytest.raises(NotPositiveDefinite, match="PARDISO found a pivot that is not positive"):
            solver.factor(indefinite)
        solver.factor(A.data)
        solver.solve(rhs)


@needs_mkl
def test_pardiso_uses_an_order_that_is_marked_as_good():
    """Eliminating the tip of an arrow matrix first fills the whole factor."""
    n = 1000
    arrow = sp.csr_array(diagonal(np.full(n, 2.0 * n)) + sp.csr_array(np.eye(1, n).T @ np.ones((1, n))))
    megabytes = {}
    for ordered in (False, True):
        with solver_for(arrow, "mkl", ordered=ordered) as solver:
            megabytes[ordered] = solver.handle.iparm[16] / 1024
    assert megabytes[False] < 1
    assert megabytes[True] > n * n / 2 * 8 / 2**20


@needs_mkl
@pytest.mark.parametrize("ordered", [False, True])
def test_pardiso_gives_the_same_result_on_one_thread_and_two(ordered):
    A = stiffness(180, contrast=1.0)
    if ordered:
        points = np.stack(np.divmod(np.arange(A.shape[0]), 180), axis=1) * 1.0
        order = nested_dissection(points, *sp.triu(A, 1).nonzero())
        A = upper(both(A)[order][:, order])
    rng = np.random.default_rng(0)
    loads = [rng.standard_normal((A.shape[0], *columns)) for columns in [(), (1,), (2,), (3,)]]
    library = mkl.load_mkl()
    answers = []
    for threads in (1, 2):
        before = library.MKL_Set_Num_Threads_Local(threads)
        try:
            with solver_for(A, "mkl", ordered=ordered) as solver:
                solver.factor(A.data)
                answers.append([solver.solve(load) for load in loads])
        finally:
            library.MKL_Set_Num_Threads_Local(before)
    for one, two in zip(*answers, strict=True):
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-11 * np.abs(one).max())


_WORKERS = """
import os, sys
import numpy as np
from quasiharmonic.linsolve import make_solver, mkl
from quasiharmonic.surfaces import grid
from quasiharmonic.linsolve.laplacian import Laplacian
mkl.load_mkl()
V, F = grid(200, 200)
rim = np.flatnonzero((V == 0).any(axis=1) | (V == 1).any(axis=1))
def solve():
    laplacian = Laplacian(F, len(V), rim, "mkl", V)
    laplacian.factor(np.full((3, len(F)), -1.0)).extend(V @ [1, 1j])
if sys.argv[1] == "limit":
    from threadpoolctl import threadpool_limits
    with threadpool_limits(1):
        solve()
else:
    solve()
print(len(os.listdir("/proc/self/task")))
"""


@pytest.mark.long
@needs_mkl
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts threads by /proc")
@pytest.mark.parametrize("way", ["limit", "OMP_NUM_THREADS", "MKL_NUM_THREADS"])
def test_thread_limits_are_respected(way):
    if way == "limit":
        pytest.importorskip("threadpoolctl")
    clean = UNLIMITED | {"OPENBLAS_NUM_THREADS": "1"}  # NumPy's own solver

    def threads(**environment):
        run = subprocess.run(
            [sys.executable, "-c", _WORKERS, way], env=clean | environment, capture_output=True, text=True, check=True
        )
        return int(run.stdout)

    assert threads(**({} if way == "limit" else {way: "1"})) == 1
    if way == "MKL_NUM_THREADS":
        assert threads(MKL_NUM_THREADS="2", MKL_DYNAMIC="FALSE") > 1, "the count sees nothing"


_CHANGES = """
import numpy as np
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.linsolve import mkl
from quasiharmonic.surfaces import grid
library = mkl.load_mkl()
V, F = grid(250, 250)
rim = np.flatnonzero((V == 0).any(axis=1) | (V == 1).any(axis=1))
rng = np.random.default_rng(0)
for round in range(4):
    laplacian = Laplacian(F, len(V), rim, "mkl", V)
    for _ in range(8):
        library.MKL_Set_Num_Threads_Local(int(rng.choice([1, 2], p=[0.2, 0.8])))
        laplacian.factor(-np.exp(0.3 * rng.standard_normal((3, len(F)))))
        library.MKL_Set_Num_Threads_Local(int(rng.choice([1, 2])))
        laplacian.solver.solve(rng.standard_normal((laplacian.free.size, rng.integers(1, 4))))
"""


@pytest.mark.long
@needs_mkl
def test_pardiso_survives_changes_of_threads_between_its_phases():
    """Many factorisations, single and several right-hand sides; the residual of every solution is checked."""
    environment = UNLIMITED | {"MKL_NUM_THREADS": "2", "MKL_DYNAMIC": "FALSE"}
    run = subprocess.run([sys.executable, "-c", _CHANGES], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-2000:]


_TEAM = """
import numpy as np
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.surfaces import grid
V, F = grid(200, 200)
rim = np.flatnonzero((V == 0).any(axis=1) | (V == 1).any(axis=1))
laplacian = Laplacian(F, len(V), rim, "mkl", V)
laplacian.factor(np.full((3, len(F)), -1.0)).extend(V @ [1, 1j])
print(laplacian.solver.handle.threads)
"""


@pytest.mark.long
@needs_mkl
@pytest.mark.parametrize(
    ("name", "value", "threads"),
    [
        ("OMP_THREAD_LIMIT", "1", "1"),
        ("OMP_THREAD_LIMIT", "2", "2"),
        ("KMP_DEVICE_THREAD_LIMIT", "1", "1"),
        ("OMP_DYNAMIC", "TRUE", "1"),
        ("OMP_DYNAMIC", "false", "2"),
        ("OMP_MAX_ACTIVE_LEVELS", "0", "1"),
    ],
)
def test_pardiso_does_not_wait_for_threads_that_openmp_refuses(name, value, threads):
    environment = UNLIMITED | {"MKL_NUM_THREADS": "2", "MKL_DYNAMIC": "FALSE", name: value}
    run = subprocess.run(
        [sys.executable, "-c", _TEAM], env=environment, capture_output=True, text=True, check=True, timeout=600
    )
    assert run.stdout.split() == [threads]


@needs_mkl
def test_pardiso_does_not_change_the_number_of_threads():
    library = mkl.load_mkl()
    before = library.MKL_Set_Num_Threads_Local(0)
    try:
        library.MKL_Set_Num_Threads_Local(2)
        solve(stiffness(5), np.ones(25), "mkl")
        assert library.MKL_Set_Num_Threads_Local(0) == 2
    finally:
        library.MKL_Set_Num_Threads_Local(before)


@needs_mkl
@pytest.mark.parametrize(
    ("code", "kind", "message"),
    [
        (-2, MemoryError, "phase 22 with error -2: not enough memory"),
        (-1, RuntimeError, "phase 22 with error -1: input inconsistent"),
        (-77, RuntimeError, "phase 22 with error -77: unknown error"),
        (-4, NotPositiveDefinite, "PARDISO met a pivot"),
        (1, NotPositiveDefinite, "PARDISO met a pivot"),
    ],
)
def test_pardiso_errors(monkeypatch, code, kind, message):
    A = stiffness(4)
    solver = solver_for(A, "mkl")
    with monkeypatch.context() as patch:
        patch.setattr(solver.handle, "call", lambda *_: code)
        with pytest.raises(kind, match=message):
            solver.factor(A.data)
    solver.factor(A.data)
    solver.solve(np.ones(16))


@needs_mkl
def test_pardiso_releases_its_memory():
    A = stiffness(4)
    by_hand, forgotten = solver_for(A, "mkl"), solver_for(A, "mkl")
    handles = by_hand.handle, forgotten.handle
    by_hand.close()
    assert [bool(handle.memory.any()) for handle in handles] == [False, True]
    del forgotten
    gc.collect()
    assert not handles[1].memory.any()


@needs_mkl
def test_mkl_in_64_bit_mode_is_not_used():
    code = (
        "import os; os.environ['MKL_INTERFACE_LAYER'] = 'ILP64'\n"
        "from quasiharmonic.linsolve import make_solver\n"
        "import ctypes; from quasiharmonic.linsolve import mkl\n"
        "ctypes.CDLL(mkl.find_mkl()).MKL_Get_Max_Threads()\n"
        "s = make_solver([0, 1], [0]); s.factor([2.0]); print(s.name, s.solve([2.0]))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    solver, answer = run.stdout.split()
    assert answer == "[1.]"
    assert solver in available()
    assert solver != "mkl"


def test_files_that_are_mkl(monkeypatch, tmp_path):
    """Newer versions come before older ones; those without a number are last."""
    yes = ["libmkl_rt.so.3", "libmkl_rt.so.2", "mkl_rt.2.dll", "libmkl_rt.2.dylib", "libmkl_rt.so.1", "libmkl_rt.so"]
    yes += ["mkl_rt.dll"]
    no = ["libmkl_rt.so.3.bak", "libmkl_rt.lib", "libmkl_core.so.3", "mkl_rt.py"]
    (tmp_path / "lib").mkdir()
    for file in yes + no:
        (tmp_path / "lib" / file).touch()
    monkeypatch.setattr(mkl.sys, "prefix", str(tmp_path))
    here = [Path(path).name for path in mkl.candidates() if Path(path).parent == tmp_path / "lib"]
    assert sorted(here) == sorted(yes)
    ages = [int((re.findall(r"\d+", file) or [0])[0]) for file in here]
    assert ages == sorted(ages, reverse=True)


def test_mkl_is_found_in_environments(monkeypatch, tmp_path):
    places = {"lib": ["libmkl_rt.so.2", "libmkl_rt.so.3", "libmkl_core.so.3"], "Library/bin": ["mkl_rt.2.dll"]}
    for folder, files in places.items():
        (tmp_path / folder).mkdir(parents=True)
        for file in files:
            (tmp_path / folder / file).touch()
    monkeypatch.setattr(mkl.sys, "prefix", str(tmp_path))
    candidates = mkl.candidates()
    assert next(candidates) == str(tmp_path / "lib" / "libmkl_rt.so.3")
    monkeypatch.setattr(mkl.sys, "prefix", str(tmp_path / "nowhere"))
    monkeypatch.setattr(mkl.site, "getuserbase", lambda: str(tmp_path))
    assert next(mkl.candidates()) == str(tmp_path / "lib" / "libmkl_rt.so.3")


def test_a_library_that_does_not_load(monkeypatch, tmp_path):
    fake = tmp_path / "libmkl_rt.so.3"
    fake.write_bytes(b"not a library")
    monkeypatch.setattr(mkl, "find_mkl", lambda: str(fake))
    mkl.load_mkl.cache_clear()
    try:
        with pytest.raises(ImportError, match="cannot load"):
            mkl.load_mkl()
        assert make_solver([0, 1], [0]).name != "mkl"
        monkeypatch.setattr(mkl, "find_mkl", lambda: None)
        with pytest.raises(ImportError, match="pip install mkl"):
            mkl.load_mkl()
    finally:
        mkl.load_mkl.cache_clear()
