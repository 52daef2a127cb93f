"""The barrier that keeps a free boundary apart: contacts against differences and brute force, steps, overlap."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from quasiharmonic import boundary_loops, certify, flatten
from quasiharmonic.apps.flattening.contacts import HATS, Rim, RimContacts
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.results import Status
from quasiharmonic.surfaces import annulus, disk, grid


def horseshoe(gap):
    """A planar strip bent until its ends are a gap apart."""
    square, F = grid(40, 4)
    r = 1 + 0.4 * (1 - square[:, 1])
    angle = (2 * np.pi - gap) * square[:, 0]
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1), F


@pytest.fixture
def pairs():
    V, F = horseshoe(0.03)
    w = in_units(V, 0)
    return Rim(boundary_loops(F, len(V))).contacts(w), w


def test_the_horseshoe_is_as_described():
    V, F = horseshoe(0.03)
    assert certify(F, V).bijective


def test_contacts_are_found_only_across_the_gap(pairs):
    found, w = pairs
    found = found.within(w, 1.0)
    assert found.reach.size
    # A vertex at one end of the strip and an edge at the other.
    vertex, tail, head = found.corners % 41
    assert np.isin(vertex, (0, 1, 39, 40)).all()
    assert (((vertex < 20) & (tail > 20) & (head > 20)) | ((vertex > 20) & (tail < 20) & (head < 20))).all()


def test_contacts_agree_with_all_pairs():
    V, F = horseshoe(0.1)
    rng = np.random.default_rng(0)
    V = V + 0.004 * rng.normal(size=V.shape)
    (loop,) = boundary_loops(F, len(V))
    found = Rim([loop]).contacts(in_units(V, 0))
    shapely = pytest.importorskip("shapely")
    polygon = shapely.Polygon(V[loop])
    after = dict(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))
    before = {b: a for a, b in after.items()}
    length = {a: np.linalg.norm(V[a] - V[b]) for a, b in after.items()}
    expected = set()
    for v, (a, b) in itertools.product(loop.tolist(), after.items()):
        edge, point = shapely.LineString([V[a], V[b]]), shapely.Point(V[v])
        along = edge.project(point) / edge.length
        # The reach is twice the smaller length of the edge and of those around the vertex.
        near = edge.distance(point) < 2 * min(length[a], (length[v] + length[before[v]]) / 2)
        end = {0: a, 1: b}.get(along)
        if near and v not in (a, b) and end not in (after[v], before[v]):
            # The segment between them leaves the vertex and reaches the edge from outside.
            foot = np.array(edge.interpolate(along, normalized=True).coords[0])
            ends = (shapely.Point(foot + (V[v] - foot) * t) for t in (1e-6, 1 - 1e-6))
            if not any(polygon.contains(place) for place in ends):
                expected.add((v, a, b))
    assert {*map(tuple, found.corners.T.tolist())} == expected != set()


def test_gradient_and_curvature(pairs):
    found, w = pairs
    near = found.within(w, 1.0)
    assert near.value(w) > 0
    rng = np.random.default_rng(0)
    direction = rng.normal(size=w.size) + 1j * rng.normal(size=w.size)
    h = 1e-7
    difference = (near.value(w + h * direction) - near.value(w - h * direction)) / (2 * h)
    gradient = near.gradient(w)
    assert float((gradient.conj() * direction).real.sum()) == pytest.approx(difference, rel=1e-5)
    v, a, _ = near.corners
    form = near.curvature(w)
    dp = sum(HATS[i].conj() * direction[c] for i, c in enumerate(near.corners))
    dq = sum(HATS[i] * direction[c] for i, c in enumerate(near.corners))
    np.testing.assert_allclose(dp + dq, direction[v] - direction[a], atol=1e-12)
    along_p, along_q = form.apply(dp, dq)
    quadratic = (along_p.conj() * dp + along_q.conj() * dq).real
    assert (quadratic >= -1e-9).all()


def test_curvature_of_one_contact():
    # A vertex directly above the middle of an edge: only its height matters.
    w = np.array([0.5 + 0.2j, 0, 1])
    one = RimContacts(np.array([[0], [1], [2]]), np.array([0.5]))
    height, reach = 0.2, 0.5
    assert one.value(w) == pytest.approx((reach / height - 1) ** 2)
    form = one.curvature(w)
    move = np.array([1j, 0, 0])
    dp, dq = (HATS.conj() * move).sum(keepdims=True), (HATS * move).sum(keepdims=True)
    along_p, along_q = form.apply(dp, dq)
    second = 2 * reach**2 / height**4 + 4 * (reach / height - 1) * reach / height**3
    assert float((along_p.conj() * dp + along_q.conj() * dq).real.sum()) == pytest.approx(second)


def test_split_edges_keep_all_contacts(pairs):
    found, w = pairs
    known, strangers = found.split(found.corners[:, ::-1], w.size)
    np.testing.assert_array_equal(known.reach, found.reach[::-1])
    assert not strangers.reach.size
    known, strangers = found.split(found.corners[:, 2:], w.size)
    np.testing.assert_array_equal(strangers.corners, found.corners[:, :2])
    assert known.value(w) + strangers.value(w) == pytest.approx(found.value(w))
    assert RimContacts.none().split(found.corners, w.size)[0].reach.max() == 0
    assert found.split(RimContacts.none().corners, w.size)[1].reach.size == found.reach.size


def test_blocks_bound_the_curvature(pairs):
    found, w = pairs
    form, (xx, xy, yy) = found.curvature(w), found.blocks(w)
    rng = np.random.default_rng(0)
    for _ in range(20):
        move = rng.normal(size=w.size) + 1j * rng.normal(size=w.size)
        dp, dq = (HATS.conj() @ move[found.corners]), (HATS @ move[found.corners])
        along_p, along_q = form.apply(dp, dq)
        coupled = float((along_p.conj() * dp + along_q.conj() * dq).real.sum())
        apart = float((xx * move.real**2 + 2 * xy * move.real * move.imag + yy * move.imag**2).sum())
        assert 0 <= coupled <= apart


@pytest.mark.parametrize("gap", [0.03, -0.03])
def test_overlap_agrees_with_the_certificate(gap):
    V, F = horseshoe(gap)
    rim = Rim(boundary_loops(F, len(V)))
    assert rim.meets_itself(V) is (not certify(F, V).bijective)
    assert bool(rim.meetings(V).size) is (gap < 0)


def test_touching_in_one_point_counts_as_overlap():
    V, F = horseshoe(0.2)
    loop = boundary_loops(F, len(V))
    rim = Rim(loop)
    assert not rim.meets_itself(V)
    V[2 * 41] = V[2 * 41 + 40]
    assert rim.meets_itself(V)


def pinched():
    """A square with a hole in which two fans of triangles meet in a point; their copies of the vertex."""
    V, F = grid(8, 8)
    middle = V[F].mean(axis=1)
    corners = [5 / 16, 5 / 16], [7 / 16, 7 / 16]
    F = F[~np.any([(np.abs(middle - corner) < 1 / 16).all(axis=1) for corner in corners], axis=0)]
    (pinch,) = np.flatnonzero((V == 3 / 8).all(axis=1))
    fan = (V[F].mean(axis=1) @ [1, -1] > 0)[:, None]
    return np.vstack([V, V[pinch]]), np.where(fan & (pinch == F), len(V), F), [pinch, len(V)]


@pytest.mark.parametrize("overlap", [0.0, 1e-12, 1e-3, 0.01])
def test_copies_of_a_vertex_that_touch_are_pulled_apart(overlap):
    V, F, copies = pinched()
    uv = V.copy()
    uv[copies] += overlap * np.array([[1, -1], [-1, 1]])
    rim = Rim(boundary_loops(F, len(V)))
    assert rim.meets_itself(uv)
    apart = rim.pull_apart(F, uv)
    assert certify(F, apart).bijective
    moved = np.linalg.norm(apart - uv, axis=1)
    assert moved.max() < max(4 * overlap, 1e-6)
    assert np.isin(copies, np.flatnonzero(moved)).all()


def test_sides_of_a_slit_are_pulled_apart():
    V, F = grid(8, 8)
    slit = np.flatnonzero((V[:, 1] == 0.5) & (V[:, 0] > 0.5))
    below = V[F].mean(axis=1)[:, 1] < 0.5
    copy = np.arange(len(V))
    copy[slit] = len(V) + np.arange(slit.size)
    V, F = np.vstack([V, V[slit]]), np.where(below[:, None], copy[F], F)
    rim = Rim(boundary_loops(F, len(V)))
    assert rim.meets_itself(V)
    assert certify(F, rim.pull_apart(F, V)).bijective


def test_large_overlaps_are_not_pulled_apart():
    V, F = horseshoe(-0.03)
    assert Rim(boundary_loops(F, len(V))).pull_apart(F, V) is None


@pytest.mark.parametrize(("seed", "guarded"), [(3, False), (12, False), (22, True)])
def test_a_surface_with_a_pinch_is_guarded_only_if_its_overlap_is_large(seed, guarded):
    V, F, copies = pinched()
    height = 0.005 * np.random.default_rng(seed).normal(size=len(V) - 1)
    V = np.column_stack([V, np.append(height, height[copies[0]])])
    result = flatten(V, F)
    assert result.certificate.bijective
    names = [stage.name.split(",")[0] for stage in result.stages]
    assert names[:3] == ["start", "free descent", "overlaps pulled apart"]
    assert names[3:] == ["guarded descent"] * guarded
    assert result.stages[-1].energy[1] == result.history[-1].energy
    assert result.history[-1].energy < 1.2 * result.stages[1].energy[1]


@pytest.mark.parametrize("surface", [horseshoe(0.02), annulus(8)], ids=["disk", "annulus"])
def test_guarded_steps_stay_bijective(surface):
    # A rest shape that is bent by more than a full turn would overlap.
    V, F = surface
    rest = np.column_stack([V, 0 * V[:, 0]])
    if len(boundary_loops(F, len(V))) == 1:
        square, _ = grid(40, 4)
        r, angle = 1 + 0.4 * (1 - square[:, 1]), 7.0 * square[:, 0]
        rest = np.stack([r * np.cos(angle), r * np.sin(angle), 0.02 * angle], axis=1)
    energy = DeformationEnergy(rest, F, SymmetricDirichlet())
    descent = SurfaceDescent(energy, V, "auto", rim=Rim(boundary_loops(F, len(V))))
    values = [descent.distortion]
    for _ in descend(descent, SymmetricDirichlet(), 1e-4):
        values.append(descent.distortion)
        assert certify(F, descent.uv).bijective
    assert values[-1] <= values[0]


def test_a_tangled_boundary_stops_a_free_descent_only_if_its_energy_no_longer_falls(monkeypatch):
    V, F = disk(12)
    x, y = V.T
    wavy = np.stack([3 * x, y, 2 * np.sin(5 * x) * np.cos(4 * y)], axis=1)
    monkeypatch.setattr(Rim, "tangled_fraction", lambda self, uv: 1.0)
    monkeypatch.setattr(Rim, "pull_apart", lambda self, F, uv: None)
    result = flatten(wavy, F, start=V * [1, 1e-6], tol=1e-16)
    # The boundary is checked after 8, 16 and 24 steps.
    assert result.status is Status.STILL_FALLING
    assert [stage.n_iterations for stage in result.stages] == [24]
    before, after = (step.energy for step in (result.history[16], result.history[24]))
    assert after > 0.95 * before
    assert result.history[16].energy < 0.95 * result.history[8].energy
