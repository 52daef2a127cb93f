"""Nested dissection: permutations, separators, and fill compared with other orderings."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from quasiharmonic import boundary_loops, surfaces
from quasiharmonic.linsolve import dissection, laplacian, mkl, takes_order
from quasiharmonic.linsolve.dissection import nested_dissection
from quasiharmonic.linsolve.laplacian import Laplacian
from shared.examples import examples


def edges_of(F, n):
    pairs = np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1)
    return np.divmod(np.unique(pairs[:, 0] * n + pairs[:, 1]), n)


def graded(n):
    """An irregular disk with triangles twenty times as large at the boundary as at the centre, and a regular one."""
    V, F = surfaces.random_delaunay(n, 2)
    z = V[:, 0] + 1j * V[:, 1]
    w = np.exp(1.5 * z)
    return np.column_stack([w.real, w.imag]), F


def strip():
    V, F = surfaces.grid(300, 6)
    return V * [50, 1], F


MESHES = {
    "regular": lambda: surfaces.grid(40, 40),
    "irregular": lambda: surfaces.random_delaunay(1500, 1),
    "graded": lambda: graded(1500),
    "ring": lambda: surfaces.annulus(36),
    "curved": lambda: surfaces.cat(20),
    "strip": strip,
}


@pytest.fixture(params=MESHES, scope="module")
def mesh(request):
    V, F = MESHES[request.param]()
    return V, *edges_of(F, len(V))


def pattern(n, tail, head):
    """Return a matrix with this graph that can be factored without pivoting."""
    A = sp.coo_array((-np.ones(tail.size), (tail, head)), shape=(n, n)).tocsr()
    A = A + A.T
    return sp.csc_array(A + sp.csr_array(sp.diags(np.asarray(abs(A).sum(axis=1)).ravel() + 1)))


def fill(n, tail, head, order=None):
    """Return the number of entries of the factor for an elimination order; the default is minimum degree."""
    A = pattern(n, tail, head)
    if order is not None:
        A = A[order][:, order]
    method = "MMD_AT_PLUS_A" if order is None else "NATURAL"
    return splu(A, permc_spec=method, diag_pivot_thresh=0.0, options={"SymmetricMode": True}).L.nnz


def metis(n, tail, head):
    """Return the METIS order, through PARDISO."""
    A = sp.csr_array(sp.triu(pattern(n, tail, head), format="csr"))
    A.sort_indices()
    handle = mkl.Handle(A.indptr.astype(np.int32), A.indices.astype(np.int32), A.data, sequential=False, ordered=False)
    order = np.zeros(n, dtype=np.int32)
    handle.iparm[1], handle.iparm[4] = 2, 2
    arguments = list(handle.arguments)
    arguments[9] = ctypes.c_void_p(order.ctypes.data)
    handle.arguments = tuple(arguments)
    handle.check(11)
    handle.release()
    return order


def test_every_vertex_occurs_once(mesh):
    V, tail, head = mesh
    before = V.copy(), tail.copy(), head.copy()
    order = nested_dissection(V, tail, head)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(V)))
    for array, known in zip((V, tail, head), before, strict=True):
        np.testing.assert_array_equal(array, known)
    np.testing.assert_array_equal(nested_dissection(V, tail, head), order)


@pytest.mark.slow
def test_fill_is_close_to_that_of_minimum_degree(mesh):
    """1.0 to 1.2 times as much; 1.4 times for the strip, which is unsuitable for dissection."""
    V, tail, head = mesh
    assert fill(len(V), tail, head, nested_dissection(V, tail, head)) < 1.5 * fill(len(V), tail, head)


@pytest.mark.skipif(mkl.find_mkl() is None, reason="METIS comes with MKL")
def test_fill_is_close_to_that_of_metis(mesh):
    """0.95 to 1.2 times as much."""
    V, tail, head = mesh
    known = fill(len(V), tail, head, metis(len(V), tail, head))
    assert fill(len(V), tail, head, nested_dissection(V, tail, head)) < 1.25 * known


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_size_and_third_coordinate_do_not_matter(scale):
    V, F = surfaces.random_delaunay(1000, 1)
    edges = edges_of(F, len(V))
    order = nested_dissection(V, *edges)
    np.testing.assert_array_equal(nested_dissection(V * scale, *edges), order)
    np.testing.assert_array_equal(nested_dissection(np.column_stack([V, np.zeros(len(V))]), *edges), order)


def test_numbering_of_the_vertices_has_little_effect():
    V, F = surfaces.grid(40, 40)
    shuffled = np.random.default_rng(0).permutation(len(V))
    place = np.argsort(shuffled)
    tail, head = edges_of(place[F], len(V))
    order = nested_dissection(V[shuffled], tail, head)
    straight = edges_of(F, len(V))
    assert fill(len(V), tail, head, order) < 1.05 * fill(len(V), *straight, nested_dissection(V, *straight))


@pytest.mark.parametrize("n", [1, 2, 3, 40])
def test_few_vertices(n):
    V = np.column_stack([np.arange(n), np.zeros(n)]) * 1.0
    order = nested_dissection(V, np.arange(n - 1), np.arange(1, n))
    assert sorted(order) == list(range(n))


def test_poor_cuts_are_rejected():
    V, F = surfaces.grid(60, 60)
    edges = edges_of(F, len(V))
    turn = 12 * np.pi * V[:, 0]
    rolled = np.column_stack([(1 + V[:, 0]) * np.cos(turn), (1 + V[:, 0]) * np.sin(turn), 2 * V[:, 1]])
    assert sorted(nested_dissection(V, *edges)) == list(range(len(V)))
    assert nested_dissection(rolled, *edges) is None
    assert nested_dissection(V * [1, 50], *edges) is None
    assert nested_dissection(np.zeros_like(V), *edges) is None
    assert nested_dissection(np.random.default_rng(0).permutation(V), *edges) is None


@pytest.mark.slow
@examples(25)
@given(n=st.integers(2, 60), share=st.floats(0.5, 4), seed=st.integers(0, 2**32 - 1))
def test_separators_separate(n, share, seed):
    """Arbitrary graphs with an arbitrary bisection: without the separator, the part falls into its two halves."""
    rng = np.random.default_rng(seed)
    bits = 2 * dissection.BITS
    code = rng.integers(2 ** (bits + 2), size=n).astype(np.int32)
    tail, head = rng.integers(n, size=(2, int(share * n)))
    tail, head = tail[tail != head], head[tail != head]
    rank = dissection.separators(code, 2, tail, head)
    for k in range(1, bits + 3):
        inside = (rank < k)[tail] & (rank < k)[head]
        crossing = (code[tail] >> k == code[head] >> k) & (code[tail] >> k - 1 != code[head] >> k - 1)
        assert not np.any(inside & crossing)


@pytest.mark.slow
@examples(50)
@given(m=st.integers(1, 12), n=st.integers(1, 12), density=st.floats(0.05, 1), seed=st.integers(0, 2**32 - 1))
def test_covers_are_minimal(m, n, density, seed):
    joined = np.random.default_rng(seed).random((m, n)) < density
    joined[0, 0] = True
    u, v = np.nonzero(joined)
    us, vs = dissection.smallest_cover(u, v + m)
    assert (np.isin(u, us) | np.isin(v + m, vs)).all()
    assert len(us) + len(vs) == matching(joined)


def matching(joined):
    """Return the size of a maximum matching, by augmenting paths."""
    mate = {}

    def free(i, seen):
        for j in np.flatnonzero(joined[i]):
            if j not in seen:
                seen.add(j)
                if j not in mate or free(mate[j], seen):
                    mate[j] = i
                    return True
        return False

    return sum(free(i, set()) for i in range(len(joined)))


def test_a_separator_leaves_two_halves():
    """The last vertices in the order, as many as the first cut has, divide a grid into two almost equal parts."""
    V, F = surfaces.grid(64, 64)
    n = len(V)
    tail, head = edges_of(F, n)
    order = nested_dissection(V, tail, head)
    left = np.ones(n, dtype=bool)
    left[order[-65:]] = False
    kept = left[tail] & left[head]
    graph = sp.coo_array((np.ones(kept.sum()), (tail[kept], head[kept])), shape=(n, n))
    sizes = np.bincount(connected_components(graph, directed=False)[1][left])
    assert sorted(sizes[sizes > 0])[0] > 0.45 * n


# --- in the Laplacian -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["auto", "superlu"])
def test_the_laplacian_is_the_same_in_every_order(monkeypatch, solver):
    V, F = surfaces.random_delaunay(1000, 1)
    (loop,) = boundary_loops(F, len(V))
    rng = np.random.default_rng(0)
    stiffness = -0.2 - rng.random((3, len(F)))
    w = rng.standard_normal(len(V)) + 1j * rng.standard_normal(len(V))
    answers = []
    for least in (10**9, 0):
        monkeypatch.setattr(laplacian, "DISSECT_FROM", least)
        operator = Laplacian(F, len(V), loop, solver, V).factor(stiffness)
        map_ = operator.extend(w)
        answers.append((map_, operator.respond(w), operator.flux(map_)))
        ascending = bool(np.all(np.diff(operator.laplacian.free) > 0))
        assert ascending == (least > 0 or not takes_order(solver))
        np.testing.assert_array_equal(np.sort(operator.laplacian.free), np.setdiff1d(np.arange(len(V)), loop))
    for one, other in zip(*answers, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_a_solver_without_an_order_option_keeps_the_mesh_s_numbering(monkeypatch):
    pytest.importorskip("qdldl")
    monkeypatch.setattr(laplacian, "DISSECT_FROM", 0)
    V, F = surfaces.random_delaunay(1000, 1)
    (loop,) = boundary_loops(F, len(V))
    assert np.all(np.diff(Laplacian(F, len(V), loop, "qdldl", V).free) > 0)
    assert not np.all(np.diff(Laplacian(F, len(V), loop, "superlu", V).free) > 0)
    # Whichever solver "auto" chooses.
    monkeypatch.setattr("quasiharmonic.linsolve.mkl.find_mkl", lambda: None)
    monkeypatch.setattr("quasiharmonic.linsolve.packages.Cholmod.is_installed", classmethod(lambda cls: False))
    unaware = Laplacian(F, len(V), loop, "auto", V)
    assert unaware.solver.name == "qdldl"
    assert np.all(np.diff(unaware.free) > 0)


def test_one_fixed_vertex_and_a_free_boundary(monkeypatch):
    V, F = surfaces.random_delaunay(1000, 1)
    stiffness = np.full((3, len(F)), -1.0)
    load = np.random.default_rng(0).standard_normal(len(V)) + 0j
    answers = []
    for least in (10**9, 0):
        monkeypatch.setattr(laplacian, "DISSECT_FROM", least)
        operator = Laplacian(F, len(V), np.array([17]), points=V).factor(stiffness)
        answers.append(operator.respond(load))
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-10)


def test_without_good_cuts_the_solver_chooses_the_order(monkeypatch):
    monkeypatch.setattr(laplacian, "DISSECT_FROM", 0)
    V, F = surfaces.grid(40, 40)
    (loop,) = boundary_loops(F, len(V))
    w = np.random.default_rng(0).standard_normal(len(V)) + 0j
    answers = []
    for points in (np.zeros_like(V), None):
        operator = Laplacian(F, len(V), loop, points=points)
        assert (np.diff(operator.free) > 0).all()
        answers.append(operator.factor(np.full((3, len(F)), -1.0)).extend(w))
    np.testing.assert_array_equal(*answers)
