"""`MovingMesh` and the descent that moves a map with its boundary."""

from __future__ import annotations

import copy
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from quasiharmonic import BoundaryCurves, MovingMesh, boundary_loops, certify
from quasiharmonic.apps.mesh_motion.moving_mesh import MovingDescent
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.energies.newton import sliding_boundary as sliding
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.polishing import scale_energy
from quasiharmonic.io import MeshData, write_obj
from quasiharmonic.problem import Domain
from quasiharmonic.surfaces import annulus, disk, grid


@pytest.fixture
def ring():
    """Return a square with a square hole: points, triangles, the walls, the hole."""
    points, F = annulus(12)
    walls, hole = sorted(boundary_loops(F, len(points)), key=lambda loop: -np.abs(points[loop]).max())
    return points, F, walls, hole


def turned(points, degrees):
    angle = np.radians(degrees)
    return points @ np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])


def winding(mesh, chain):
    """Return the degrees by which a chain of vertices winds around the origin."""
    z = mesh[chain] @ (1, 1j)
    return np.degrees(np.angle(z[1:] / z[:-1]).sum())


def test_a_rotating_hole_moves_the_mesh(ring):
    points, F, walls, hole = ring
    mesh = MovingMesh(points, F, hole)
    chain = np.flatnonzero((points[:, 1] == 0) & (points[:, 0] > 0))
    chain = chain[np.argsort(points[chain, 0])]
    assert chain.size > 3
    for degrees in range(10, 201, 10):
        there = mesh.advance(turned(points[hole], degrees))
        assert certify(mesh.F, there).bijective
        np.testing.assert_array_equal(there[hole], turned(points[hole], degrees))
        np.testing.assert_array_equal(there[walls], points[walls])
        np.testing.assert_array_equal(mesh.points, there)
    # It has not rotated in the opposite direction, although that would be shorter.
    assert winding(there, chain) == pytest.approx(-200)


def test_no_drift_after_a_closed_motion(ring):
    points, F, _, hole = ring
    mesh = MovingMesh(points, F, hole, settle=3)
    for x in (*np.linspace(0, 0.2, 8), *np.linspace(0.2, 0, 8)):
        mesh.advance(points[hole] + (x, x / 2))
    assert np.abs(mesh.points - points).max() < 1e-3


@pytest.mark.parametrize("slide", [False, True])
@pytest.mark.parametrize("again", [copy.deepcopy, lambda mesh: pickle.loads(pickle.dumps(mesh))])
def test_a_copy_continues_like_its_mesh(ring, again, slide):
    points, F, _, hole = ring
    mesh = MovingMesh(points, F, hole, slide=slide)
    # The mesh has a factor after its first step only.
    for degrees in (5, 10):
        other = again(mesh)
        there = mesh.advance(turned(points[hole], degrees))
        np.testing.assert_array_equal(other.advance(turned(points[hole], degrees)), there)


def test_a_step_is_newtons_for_the_new_boundary():
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    domain = Domain(V, F, loop)
    energy, exponent = scale_energy(domain, V, SymmetricDirichlet())

    def carried(by):
        descent = MovingDescent(energy, V, loop, exponent, "auto")
        assert descent.move(V[loop] + by * V[loop][:, ::-1] * V[loop][:, :1], 1e-4, 1) == 1
        return descent.uv, descent

    # To first order, the energy's gradient stays zero, by independent differences.
    errors = []
    for by in (1e-2, 5e-3):
        _, descent = carried(by)
        inner = np.setdiff1d(np.arange(len(V)), loop)
        slopes = []
        for v in inner[::5]:
            for way in (1, 1j):
                nudge = np.zeros(len(V), dtype=complex)
                nudge[v] = 1e-5 * way
                slopes.append((energy.value(descent.newton.w + nudge) - energy.value(descent.newton.w - nudge)) / 2e-5)
        errors.append(np.abs(slopes).max())
    assert errors[0] > 1e-9
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.slow
def test_vertices_slide_along_walls(ring):
    points, F, walls, hole = ring
    held, gliding = (MovingMesh(points, F, hole, slide=slide) for slide in (False, True))
    for degrees in range(10, 91, 10):
        for mesh in (held, gliding):
            there = mesh.advance(turned(points[hole], degrees))
    corner = (np.abs(points[walls]) == 1).all(axis=1)
    assert corner.sum() == 4
    np.testing.assert_array_equal(there[walls[corner]], points[walls[corner]])
    # They are exactly on axis-parallel walls, and move along the others.
    assert np.all(np.abs(there[walls]).max(axis=1) == 1)
    assert np.abs(there[walls] - points[walls]).max() > 0.02
    assert certify(mesh.F, there).bijective
    assert mean_ratio(there, F).min() > 1.2 * mean_ratio(held.points, F).min()


@pytest.mark.slow
@pytest.mark.parametrize("way", [(1, 0.1), (0.6, -1), (-1, 1)])
def test_a_body_close_to_a_wall_is_not_a_part_of_the_wall(ring, way):
    points, F, walls, hole = ring
    mesh = MovingMesh(points, F, hole, slide=True)
    room = np.array(way) * (1 - np.abs(points[hole]).max())
    for share in np.linspace(0.1, 0.9997, 20):
        there = mesh.advance(points[hole] + share * room)
    np.testing.assert_array_equal(there[hole], points[hole] + share * room)
    assert np.all(np.abs(there[walls]).max(axis=1) == 1)
    assert np.abs(there[walls] - points[walls]).max() > 1e-3
    assert certify(mesh.F, there).bijective


@pytest.mark.slow
def test_curved_walls_do_not_change():
    """A round wall: vertices that slide along the polygon of the first mesh never cut its corners."""
    points, F = disk(8)
    (wall,) = boundary_loops(F, len(points))
    pin = np.array([0])
    mesh = MovingMesh(points, F, pin, slide=True)
    for turn in np.linspace(0, 6 * np.pi, 40):
        there = mesh.advance([[0.5 * np.sin(turn / 2), 0.4 * np.sin(turn)]])
    sides = np.abs(points[wall[0]] - points[wall[1]]) @ (1, 1j)
    lowest = np.sqrt(1 - abs(sides) ** 2 / 4)
    radius = np.hypot(*there[wall].T)
    assert np.abs(there[wall] - points[wall]).max() > 1e-3
    assert radius.min() > lowest - 1e-12
    assert certify(mesh.F, there).bijective


@pytest.mark.parametrize("steps", [1, 10])
def test_vertices_of_straight_walls_make_way_for_moved_vertices(steps):
    """A piston moves along two walls, and some vertices of the bottom move along it."""
    points, F = grid(8, 8)
    piston, some = points[:, 1] == 1, (points[:, 1] == 0) & (np.abs(points[:, 0] - 0.5) < 0.2)
    for moved, way in ((np.flatnonzero(piston), (0, -0.6)), (np.flatnonzero(some), (0.25, 0))):
        mesh = MovingMesh(points, F, moved, slide=True)
        for share in np.linspace(0, 1, steps + 1)[1:]:
            there = mesh.advance(points[moved] + share * np.array(way))
        np.testing.assert_array_equal(there[moved], points[moved] + way)
        assert certify(mesh.F, there).bijective
        assert mean_ratio(there, F).min() > 0.3


def test_an_unreachable_boundary_leaves_the_mesh_unchanged(ring):
    points, F, _walls, hole = ring
    mesh = MovingMesh(points, F, hole)
    before = mesh.advance(points[hole] + (0.1, 0))
    with pytest.raises(RuntimeError, match=r"can be moved only .* of the way"):
        mesh.advance(points[hole] + (5, 0))
    np.testing.assert_array_equal(mesh.points, before)
    after = mesh.advance(points[hole] + (0.12, 0))
    assert certify(mesh.F, after).bijective


def test_either_orientation_of_triangles(ring):
    points, F, _walls, hole = ring
    F = F.copy()
    F[::2] = F[::2][:, [0, 2, 1]]
    mesh = MovingMesh(points, F, hole)
    assert certify(mesh.F, mesh.advance(turned(points[hole], 20))).bijective


def test_the_matrix_of_sliding_walls_is_made_once(ring, monkeypatch):
    points, F, _walls, hole = ring
    made = []

    class Counted(sliding.SlidingSystem):
        def __init__(self, *args, **options):
            made.append(1)
            super().__init__(*args, **options)

    monkeypatch.setattr(sliding, "SlidingSystem", Counted)
    mesh = MovingMesh(points, F, hole, slide=True)
    for k in range(1, 5):
        mesh.advance(points[hole] + (0.02 * k, 0.01 * k))
    assert len(made) == 1


def test_a_reused_matrix_is_as_good_as_a_new_one(ring):
    points, F, walls, hole = ring
    domain = Domain(points, F, np.concatenate([hole, walls]))

    def descent(mesh, system=None, fixed=hole):
        track = sliding.move_boundary(BoundaryCurves.around([walls], points, fixed=fixed), domain, mesh)
        # At another scale, so that stored data must be scaled.
        energy, exponent = scale_energy(Domain(3 * points, F, walls), track.uv, SymmetricDirichlet())
        model = sliding.SlidingModel(energy, track, domain.fixed, domain.loops, exponent, "auto", system)
        return NewtonDescent(model, model.start())

    first = descent(points)
    first.step(1e-4)
    inside = np.setdiff1d(np.arange(len(points)), domain.fixed)
    bent = points.copy()
    bent[inside] += 0.01 * np.sin(3 * points[inside, ::-1])
    bent[hole] *= 0.9
    again, new = descent(bent, first.model.system), descent(bent)
    assert again.model.system is first.model.system
    for one in (again, new):
        one.step(1e-4)
    assert np.abs(again.model.positions(again.w) - bent).max() > 1e-3
    np.testing.assert_array_equal(again.model.positions(again.w), new.model.positions(new.w))
    assert descent(bent, first.model.system, fixed=walls[::2]).model.system is not first.model.system


def test_a_mesh_in_place_of_points_and_triangles(ring, tmp_path):
    points, F, _walls, hole = ring
    there = turned(points[hole], 20)
    expected = MovingMesh(points, F, hole).advance(there)
    skfem = SimpleNamespace(doflocs=points.T, t=F.T, dofs=SimpleNamespace(element_dofs=F.T))
    write_obj(tmp_path / "ring.obj", MeshData(np.column_stack([points, np.zeros(len(points))]), F))
    for mesh in (skfem, SimpleNamespace(points=points, cells=[SimpleNamespace(type="triangle", data=F)])):
        np.testing.assert_array_equal(MovingMesh(mesh, hole).advance(there), expected)
        np.testing.assert_array_equal(MovingMesh(mesh, moved_vertices=hole, settle=1).F, F)
    np.testing.assert_allclose(MovingMesh(tmp_path / "ring.obj", hole).advance(there), expected, atol=1e-12)
    with pytest.raises(TypeError, match="both"):
        MovingMesh(skfem, F, hole)
    quadrilaterals = SimpleNamespace(points=points[:4], cells=[SimpleNamespace(type="quad", data=[[0, 1, 2, 3]])])
    with pytest.raises(ValueError, match=r"\(f, 3\)"):
        MovingMesh(quadrilaterals, [0])


def test_returned_arrays_belong_to_the_caller(ring):
    points, F, _walls, hole = ring
    mesh, other = MovingMesh(points, F, hole), MovingMesh(points, F, hole)
    mesh.advance(points[hole] + (0.05, 0))[:] = np.nan
    mesh.points[:] = 7
    other.advance(points[hole] + (0.05, 0))
    np.testing.assert_array_equal(mesh.advance(points[hole] + (0.1, 0)), other.advance(points[hole] + (0.1, 0)))


@pytest.mark.parametrize("exponent", [-600, 900])
def test_the_unit_of_length_does_not_matter(ring, exponent):
    points, F, _walls, hole = ring
    there = turned(points[hole], 20)
    far = MovingMesh(np.ldexp(points, exponent), F, hole).advance(np.ldexp(there, exponent))
    np.testing.assert_allclose(np.ldexp(far, -exponent), MovingMesh(points, F, hole).advance(there), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": [[0, 0], [1, 0], [np.nan, 1]]}, "points"),
        ({"points": [[0, 0], [1, 0], [2, 0]]}, "degenerate"),
        ({"moved": [7]}, "moved"),
        ({"moved": [[0]]}, r"moved_vertices must have shape \(k,\), not \(1, 1\)"),
        (
            {"points": [[0, 0], [1, 0], [0, 1], [0.1, 0.1]], "F": [[0, 1, 2], [1, 3, 2]]},
            "folded at edge \\(1, 2\\)",
        ),
        ({"energy": "arap"}, "energy must be"),
        ({"settle": 0, "slide": True}, "settle"),
        ({"settle": -1}, "settle"),
    ],
)
def test_invalid_input(change, message):
    given = {"points": [[0, 0], [1, 0], [0, 1]], "F": [[0, 1, 2]], "moved": [0], **change}
    with pytest.raises(ValueError, match=message):
        MovingMesh(given.pop("points"), given.pop("F"), given.pop("moved"), **given)


@pytest.mark.parametrize(("places", "message"), [([[0, 0], [1, 1]], "target"), ([[np.inf, 0]], "row 0")])
def test_invalid_positions(places, message):
    mesh = MovingMesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]], [0])
    with pytest.raises(ValueError, match=message):
        mesh.advance(places)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7, 17])
def test_a_body_that_comes_close_to_a_sliding_wall_does_not_slide_on_it(seed):
    points, F = annulus(12)
    walls, body = sorted(boundary_loops(F, len(points)), key=lambda loop: -np.abs(points[loop]).max())
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    mesh, ahead, gap = MovingMesh(points, F, body, slide=True), 0.0, np.inf
    corners = points[walls]
    for _ in range(200):
        there = points[body] + ahead * np.array([np.cos(angle), np.sin(angle)])
        try:
            here = mesh.advance(there)
        except RuntimeError:
            # Triangles between the body and the wall are too small: a documented outcome.
            break
        np.testing.assert_array_equal(here[body], there)
        gap = np.linalg.norm(corners, axis=1).max() - np.linalg.norm(there, axis=1).max()
        ahead += 0.3 * gap
    assert gap < 0.2 * np.ptp(corners)
