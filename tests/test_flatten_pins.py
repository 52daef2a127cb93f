"""Pins with a free boundary: bijective maps with every pin at its target position, or a reason for failure."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from quasiharmonic import Status, certify, flatten
from quasiharmonic.apps.flattening import pin_search
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.flattening.pin_obstructions import find_pin_obstructions, select_without_air
from quasiharmonic.apps.flattening.pin_search import PinSearch, move_onto_pins
from quasiharmonic.geometry.mesh.topology import boundary_loops, edges
from quasiharmonic.problem.diagnosis import Diagnosis, Obstruction
from quasiharmonic.results import Forbids, Kind
from quasiharmonic.surfaces import annulus, cat, disk, grid, random_delaunay
from quasiharmonic.util.options import FlattenOptions

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
DONE = {Status.POLISHED, Status.EXHAUSTED, Status.STILL_FALLING}


def swirled(uv, angle):
    """Rotate around the centre, more near the centre than far from it."""
    z = (uv - uv.mean(axis=0)) @ (1, 1j)
    z = z * np.exp(1j * angle * np.clip(1 - abs(z) / abs(z).max(), 0, 1))
    return np.stack([z.real, z.imag], axis=1)


def solved(V, F, fixed, target, **options):
    """Flatten and check the promises of the result independently."""
    given = V.copy(), F.copy(), np.copy(fixed), np.copy(target)
    result = flatten(V, F, fixed=fixed, target=target, **options)
    assert all(np.array_equal(a, b) for a, b in zip(given, (V, F, fixed, target), strict=True))
    assert np.array_equal(result.uv[fixed], np.asarray(target, dtype=np.float64))
    verdict = certify(F, result.uv)
    assert verdict.bijective, verdict.summary()
    assert result.certificate.bijective
    assert result.status in DONE
    return result


def energy_by_hand(V, F, uv):
    """Return the mean symmetric Dirichlet energy, 0 for an isometry, from singular values."""
    V = np.column_stack([V, np.zeros(len(V))])[:, :3]
    a, b = V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    length = np.linalg.norm(a, axis=1)
    along = (a * b).sum(axis=1) / length
    height = np.linalg.norm(b - (along / length)[:, None] * a, axis=1)
    rest = np.moveaxis(np.array([[length, along], [0 * length, height]]), 2, 0)
    image = np.stack([uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]], axis=2)
    s = np.linalg.svd(image @ np.linalg.inv(rest), compute_uv=False)
    return np.average((s**2 + s**-2.0).sum(axis=1) - 4, weights=length * height)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [1.0, -4.0])
@pytest.mark.parametrize("surface", [cat(10), random_delaunay(400, 1), disk(10), grid(18, 18)])
def test_pins_of_a_swirl_are_reached(surface, angle):
    V, F = surface
    flat = flatten(V, F).uv
    hidden = swirled(flat, angle)
    fixed = np.random.default_rng(0).choice(len(V), 40, replace=False)
    result = solved(V, F, fixed, hidden[fixed])
    found = energy_by_hand(V, F, result.uv)
    assert np.isclose(result.history[-1].energy, found, rtol=1e-9)
    # The original swirl is one solution, but not the best.
    assert not certify(F, hidden).injective or found < energy_by_hand(V, F, hidden)


def test_a_hole_is_turned_and_the_outside_follows():
    V, F = annulus(8)
    inner = min(boundary_loops(F, len(V)), key=len)
    turned = V[inner] @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + 3
    result = solved(V, F, inner, turned)
    # The whole surface rotates as a rigid body, because nothing else is fixed.
    assert result.history[-1].energy < 1e-9
    assert np.allclose(result.uv, V @ [[0, 1], [-1, 0]] + 3, atol=1e-4)


@pytest.mark.slow
def test_vertices_that_must_pass_each_other():
    V, F = disk(6)
    fixed = np.array([3, 23, 43, 63, 83])
    solved(V, F, fixed, np.random.default_rng(0).permutation(V[fixed]))


def test_any_number_of_pins_from_one_to_all():
    V, F = disk(5)
    solved(V, F, [7], [[3.0, -1.0]])
    solved(V, F, [7, 60], [[0.0, 0.0], [0.0, 2.0]])
    everything = np.arange(len(V))
    result = solved(V, F, everything, 2 * V)
    assert np.array_equal(result.uv, 2 * V)


@pytest.mark.slow
def test_a_boundary_fixed_inside_out_is_reached():
    V, F = disk(6)
    loop = boundary_loops(F, len(V))[0][:18]
    solved(V, F, loop, V[loop] * [1, -1])


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e150, 1e-150])
def test_the_unit_of_length_does_not_matter(scale):
    V, F = disk(4)
    fixed, target = np.array([1, 50, 60]), np.array([[0.0, 0], [1, 0], [2, 0.3]])
    ordinary = solved(V, F, fixed, target)
    other = solved(scale * V, F, fixed, scale * target)
    assert np.allclose(other.uv / scale, ordinary.uv, rtol=0, atol=1e-6)
    # If pins are so far apart or so close that the energy overflows, it is still lowered.
    far = solved(V, F, fixed, scale * target)
    energies = [step.energy for step in far.history[-far.stages[-1].n_iterations - 1 :]]
    assert np.isfinite(energies).all()
    assert energies[-1] < 0.99 * energies[0]


@pytest.mark.slow
def test_is_deterministic():
    V, F = cat(8)
    fixed = np.arange(0, len(V), 9)
    target = swirled(flatten(V, F).uv, 2.5)[fixed]
    first, second = (flatten(V, F, fixed=fixed, target=target) for _ in range(2))
    assert np.array_equal(first.uv, second.uv)


@pytest.mark.slow
def test_the_requested_energy_is_minimised():
    V, F = cat(8)
    fixed, target = np.array([5, 100, 150]), np.array([[0.0, 0], [1, 0], [0.5, 1.5]])
    plain = solved(V, F, fixed, target)
    angles = solved(V, F, fixed, target, energy="mips")
    weighted = solved(V, F, fixed, target, weights=np.where(np.arange(len(F)) < 50, 100.0, 1.0))
    assert not np.allclose(angles.uv, plain.uv, atol=1e-3)
    assert not np.allclose(weighted.uv, plain.uv, atol=1e-3)
    for result in (plain, angles, weighted):
        energies = [step.energy for step in result.history[-result.stages[-1].n_iterations - 1 :]]
        assert energies[-1] <= energies[0]


def impossible(V, F, fixed, target):
    result = flatten(V, F, fixed=fixed, target=target)
    assert result.status is Status.IMPOSSIBLE
    assert not result.certificate.bijective
    assert not certify(F, result.uv).bijective
    assert np.array_equal(result.uv[fixed], np.asarray(target, dtype=np.float64))
    return result.diagnosis.obstructions


def test_impossible_problems_are_named():
    V, F = disk(6)
    (shared,) = impossible(V, F, [3, 40], [[0.0, 0], [0, 0]])
    assert shared.kind is Kind.PIN
    assert shared.vertices.tolist() == [3, 40]
    assert shared.forbids is Forbids.BIJECTIVE
    (wrong,) = impossible(V, F, F[5], [[0.0, 0], [0, 1], [1, 0]])
    assert wrong.kind is Kind.INVERTED_TRIANGLE
    assert wrong.triangles.tolist() == [5]
    assert wrong.forbids is Forbids.INJECTIVE
    solved(V, F, F[5], [[0.0, 0], [1, 0], [0, 1]])
    first, second = F[50, :2], F[100, :2]
    (crossing,) = impossible(V, F, [*first, *second], [[0.0, 0], [1, 1], [1, 0], [0, 1]])
    assert {frozenset(e) for e in crossing.edges.tolist()} == {frozenset(first.tolist()), frozenset(second.tolist())}
    (on,) = impossible(V, F, [*F[5, :2], 80], [[0.0, 0], [1, 0], [0.5, 0]])
    assert 80 in on.vertices
    (within,) = impossible(V, F, [*F[5], 80], [[0.0, 0], [1, 0], [0, 1], [0.2, 0.2]])
    assert within.vertices.tolist() == [80, *F[5]]


@pytest.mark.slow
def test_a_boundary_fixed_with_the_wrong_orientation_is_named():
    V, F = disk(4)
    loop = boundary_loops(F, len(V))[0]
    (patch,) = impossible(V, F, loop, V[loop] * [1, -1])
    assert patch.kind is Kind.INVERTED_PATCH


@pytest.mark.slow
@pytest.mark.parametrize(("twist", "possible"), [(0.3, True), (1.0, True), (1.3, False)])
def test_a_vertex_without_a_position_among_surrounding_pins_is_named(twist, possible):
    # The ring around the centre becomes a star with three bent arms, until no point sees all of it.
    V, F = disk(3)
    ring = np.arange(1, 7)
    ring = ring[np.argsort(np.arctan2(V[ring, 1], V[ring, 0]))]
    star = np.array([1.0, 0.1] * 3) * np.exp(1j * np.arange(6) * np.pi / 3)
    star[1::2] *= np.exp(1j * twist)
    place = np.stack([star.real, star.imag], axis=1)
    if possible:
        solved(V, F, ring, place)
    else:
        (blind,) = impossible(V, F, ring, place)
        assert blind.kind is Kind.HALF_PLANES
        assert blind.vertices[0] == 0


def test_pins_of_an_existing_map_are_never_called_impossible():
    rng = np.random.default_rng(5)
    for seed in range(10):
        V, F = random_delaunay(120, seed)
        fixed = rng.choice(len(V), 60, replace=False)
        assert not find_pin_obstructions(F, len(V), fixed, V[fixed]).obstructions


def test_obstructions_that_only_air_edges_cause_prove_nothing(monkeypatch):
    V, F = disk(3)
    sizes = []

    def forbid(problem, **options):
        """A solver that names an air edge in every diagnosis."""
        air = edges(problem.domain.F, problem.n).interior[-1:]
        assert air.max() >= len(V)
        sizes.append(problem.n)
        reason = Obstruction(Kind.CHORD, Forbids.INJECTIVE, "", split=air)
        uv = np.zeros((problem.n, 2))
        return SimpleNamespace(uv=uv, status=Status.IMPOSSIBLE, diagnosis=Diagnosis((reason,)), stages=[], history=[])

    monkeypatch.setattr(pin_search, "solve", forbid)
    # Two of three vertices change places, so that the free map does not fit.
    result = flatten(V, F, fixed=[20, 26, 32], target=V[[20, 32, 26]])
    assert result.status is Status.STALLED
    assert result.diagnosis is None
    # Both frames were tried, each with four further splits.
    assert len(sizes) == 10
    assert sizes[1:5] == [sizes[0] + k for k in range(1, 5)]


@pytest.mark.parametrize("kind", Kind)
def test_obstructions_by_the_boundary_need_air(kind):
    F = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    diagnosis = Diagnosis((Obstruction(kind, Forbids.INJECTIVE, "", vertices=[0]),))
    local = {Kind.COLLAPSED_EDGE, Kind.INVERTED_TRIANGLE, Kind.INVERTED_PATCH, Kind.CHORD}
    if_surrounded = {Kind.HALF_PLANES, Kind.HIDDEN}
    assert (select_without_air(diagnosis, F, 4, np.array([1, 2])) is not None) == (kind in local)
    assert (select_without_air(diagnosis, F, 4, np.array([1, 2, 3])) is not None) == (kind in local | if_surrounded)
    assert select_without_air(diagnosis, F, 0, np.array([], dtype=int)) is None


def test_malformed_input_is_rejected():
    V, F = disk(3)
    for fixed, target, message in (
        ([], np.zeros((0, 2)), "fixed has no vertex"),
        ([1, 1], np.zeros((2, 2)), "fixed contains vertex 1 more than once"),
        ([1, 99], np.zeros((2, 2)), "refers to vertex 99"),
        ([1], [[np.nan, 0.0]], "not finite at row 0"),
        ([1], [[0.0, 0.0, 0.0]], r"shape \(1, 2\)"),
        ([0.5], [[0.0, 0.0]], "integer"),
        ([1], None, "give fixed and target together"),
    ):
        with pytest.raises(ValueError, match=message):
            flatten(V, F, fixed=fixed, target=target)
    with pytest.raises(ValueError, match="unit_square"):
        flatten(V, F, fixed=[1], target=[[0.0, 0.0]], unit_square=True)


@pytest.mark.parametrize("at", [1, 5, 40])
def test_ctrl_c_returns_the_best_map_so_far(at):
    V, F = cat(12)
    fixed = np.arange(0, len(V), 5)
    target = swirled(flatten(V, F).uv, 3.0)[fixed]
    seen = []

    def callback(step):
        seen.append(step)
        if len(seen) == at:
            raise KeyboardInterrupt

    result = flatten(V, F, fixed=fixed, target=target, callback=callback)
    assert result.status is Status.INTERRUPTED
    assert len(seen) == at
    assert np.array_equal(result.uv[fixed], target)


@pytest.mark.parametrize(
    ("ended", "told"),
    [
        (Status.STALLED, Status.INJECTIVE),
        (Status.OUT_OF_ITERATIONS, Status.INJECTIVE),
        (Status.INTERRUPTED, Status.INTERRUPTED),
        (Status.ROUNDED, Status.ROUNDED),
        (Status.IMPOSSIBLE, Status.IMPOSSIBLE),
    ],
)
def test_a_map_that_overlaps_itself_has_the_more_specific_status(ended, told):
    V, F = grid(40, 2)
    z = (1 + V[:, 1]) * np.exp(-2.4j * np.pi * V[:, 0])
    uv = np.stack([z.real, z.imag], axis=1)
    settings = FlattenOptions(max_iterations=10)
    piece = Piece(V, F)
    run = PinSearch(piece, np.array([5]), np.ldexp(uv[5:6], piece.exponent), settings, None)
    run.keep(uv)
    run.status = ended
    result = run.result()
    assert result.injective
    assert not result.certificate.bijective
    assert result.status is told


@pytest.mark.long
def test_if_another_scaffold_does_not_help_the_search_restarts():
    V, F = random_delaunay(38, 14)
    target = np.array([[1.115, 0.998], [0.849, 1.151], [1.933, 0.916], [1.675, 0.112], [0.771, 1.121]])
    solved(V, F, [26, 15, 24, 2, 33], target)


@pytest.mark.nightly
def test_on_a_larger_mesh_the_search_restarts_too():
    # Three pins of 250 vertices, two of them next to each other on the boundary, which must swap sides.
    rng = np.random.default_rng(3)
    V, F = random_delaunay(int(rng.integers(40, 300)), 3)
    count = int(rng.integers(2, 25))
    fixed = rng.choice(len(V), count, replace=False)
    solved(V, F, fixed, rng.random((count, 2)) * rng.choice([1, 2]))


def test_least_squares_of_a_similarity():
    rng = np.random.default_rng(2)
    uv = rng.normal(size=(20, 2))
    turn = 3 * np.array([[np.cos(1), np.sin(1)], [-np.sin(1), np.cos(1)]])
    fixed = np.array([3, 5, 11])
    assert np.allclose(move_onto_pins(uv, fixed, (uv @ turn + 7)[fixed]), uv @ turn + 7)
    # For one vertex, a translation; for vertices that share a target, no scaling to zero.
    assert np.allclose(move_onto_pins(uv, fixed[:1], np.array([[1.0, 2.0]])), uv - uv[3] + (1, 2))
    assert np.allclose(move_onto_pins(uv, fixed, np.ones((3, 2))), uv - uv[fixed].mean(0) + 1)


@pytest.mark.slow
def test_the_benchmark_makes_and_solves_problems(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import pins

    monkeypatch.setattr(pins, "SMALLEST", 60)
    monkeypatch.setattr(pins, "LARGEST", 200)
    monkeypatch.setitem(pins.WEAKEST, "multiply_wound", 2.0)
    names = pins.names(7, list(pins.FAMILIES))
    assert [name.partition(":")[0] for name in names] == list(pins.FAMILIES)
    for name in names:
        case, again = pins.make(name), pins.make(name)
        assert certify(case.F, case.hidden).bijective
        assert np.array_equal(case.hidden[case.fixed], case.target)
        assert 1 <= len(case.fixed) <= 200
        assert np.array_equal(case.hidden, again.hidden)
    results = tmp_path / "pins.jsonl"
    assert pins.main(["-n", "3", "-o", str(results)]) == 0
    lines = results.read_text().splitlines()
    assert len(lines) == 3
    # Finished problems are not repeated, nor is an incomplete line read.
    results.write_text("\n".join(lines[:2]) + "\n" + lines[2][:30])
    assert pins.main(["-n", "3", "-o", str(results)]) == 0
    assert len(pins.read(results)) == 3
    assert "3/3" in capsys.readouterr().out
