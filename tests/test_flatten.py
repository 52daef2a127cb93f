"""Flattening with a free boundary: maps are bijective for every shape and have the least known distortion."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Status, boundary_loops, certify, flatten
from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.piece import align_with_axis
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.derivatives import check_energy
from quasiharmonic.energies.energies import Deformation, Isotropic, SymmetricDirichlet
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.surfaces import annulus, cat, disk, grid
from shared.distinct_steps import DistinctSteps


def cylinder(turns, cells=(90, 6), height=0.6, radius=1.0, steep=0.0):
    """A strip around a cylinder, which is developable: its flat shape is a rectangle, or part of a ring for a cone."""
    square, F = grid(*cells)
    angle = 2 * np.pi * turns * square[:, 0]
    r = radius + steep * square[:, 1]
    up = height * square[:, 1] + 0.9 * turns * square[:, 0]
    return np.stack([r * np.cos(angle), r * np.sin(angle), up], axis=1), F


def overlapping_ring(degrees=420.0, around=80):
    """A ring of more than one turn, with one end above the other: unrolled, its ends overlap."""
    square, F = grid(around, 5)
    angle, r = np.radians(degrees) * square[:, 0], 1 + 0.5 * square[:, 1]
    return np.stack([r * np.cos(angle), r * np.sin(angle), 0.02 * angle], axis=1), F


def mean_energy(V, F, uv):
    return DeformationEnergy(V, F, SymmetricDirichlet()).value(in_units(uv, 0))


def test_a_developable_surface_is_unrolled_without_distortion():
    V, F = cylinder(0.9)
    result = flatten(V, F)
    assert result.status is Status.POLISHED
    assert result.certificate.bijective
    assert mean_energy(V, F, result.uv) < 1e-6
    edge = np.linalg.norm(V[F[:, 0]] - V[F[:, 1]], axis=1)
    flat = np.linalg.norm(result.uv[F[:, 0]] - result.uv[F[:, 1]], axis=1)
    np.testing.assert_allclose(flat, edge, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["half cylinder", "cone", "panel"])
def test_developable_surfaces_take_few_steps(shape):
    square, F = grid(120, 60)
    x, y = square.T
    V = {
        "half cylinder": np.column_stack([np.cos(np.pi * x), np.sin(np.pi * x), 2 * y]),
        "cone": np.column_stack([0.6 * (1 + y) * np.cos(5 * x), 0.6 * (1 + y) * np.sin(5 * x), 0.8 * y]),
        "panel": np.column_stack([2 * x, y, 0.6 * x + 0.2 * y]),
    }[shape]
    result = flatten(V, F)
    assert result.status is Status.POLISHED
    assert mean_energy(V, F, result.uv) < 1e-12
    assert result.n_iterations <= 12


@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips", "blend", "arap-barrier"])
def test_energies_fall_and_maps_stay_bijective(energy):
    V, F = cat(12)
    result = flatten(V, F, energy=energy)
    assert result.certificate.bijective
    assert result.status is Status.POLISHED
    reference = flatten(V, F)
    if energy == "mips":
        # The MIPS map preserves angles best and has the surface's area.
        assert result.history[-1].energy < DeformationEnergy(V, F, _mips()).value(in_units(reference.uv, 0))
        doubled = 0.5 * np.linalg.norm(np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]), axis=1).sum()
        np.testing.assert_allclose(_area(F, result.uv), doubled, rtol=1e-6)


def _mips():
    from quasiharmonic.energies.energies import MIPS

    return MIPS()


def _area(F, uv):
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    return 0.5 * float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())


def test_holes_and_planar_meshes():
    V, F = annulus(12)
    result = flatten(V, F)
    assert result.certificate.bijective
    assert mean_energy(V, F, result.uv) < 1e-6


@pytest.mark.slow
def test_overlaps_are_avoided():
    V, F = overlapping_ring()
    result = flatten(V, F)
    assert [stage.kept for stage in result.stages if "descent" in stage.name] == [False, True]
    assert result.certificate.bijective
    # Without overlap it cannot be an isometry, but almost.
    assert 1e-4 < mean_energy(V, F, result.uv) < 0.05


@pytest.mark.slow
def test_the_reported_energy_is_that_of_the_map():
    V, F = overlapping_ring()
    result = flatten(V, F)
    assert result.history[-1].energy == pytest.approx(mean_energy(V, F, result.uv), rel=1e-9)


def test_scales():
    V, F = cat(6)
    one = flatten(V, F)
    for exponent in (-500, 500):
        other = flatten(np.ldexp(V, exponent), F)
        assert other.certificate.bijective
        np.testing.assert_array_equal(np.ldexp(other.uv, -exponent), one.uv)
    for factor in (1e-150, 1e150):
        other = flatten(V * factor, F)
        assert other.certificate.bijective
        np.testing.assert_allclose(other.uv / factor, one.uv, atol=1e-3)


def test_flattening_is_deterministic_and_does_not_change_its_input():
    V, F = cat(6)
    before = V.copy(), F.copy()
    np.testing.assert_array_equal(flatten(V, F).uv, flatten(V.astype(np.float64), F.astype(np.int32)).uv)
    np.testing.assert_array_equal(V, before[0])
    np.testing.assert_array_equal(F, before[1])


def test_an_annulus_of_twenty_triangles():
    angle = 2 * np.pi * np.arange(10) / 10
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    V = np.concatenate([ring, 0.5 * ring + (0, 0, 0.3)])
    i, j = np.arange(10), np.roll(np.arange(10), -1)
    F = np.concatenate([np.stack([i, j, j + 10], axis=1), np.stack([i, j + 10, i + 10], axis=1)])
    result = flatten(V, F)
    assert len(F) == 20
    assert result.certificate.bijective
    assert len(result.certificate.loops) == 2


def test_one_triangle():
    V = np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0.0]])
    result = flatten(V, [[0, 1, 2]])
    assert result.certificate.bijective
    np.testing.assert_allclose(np.sort([np.linalg.norm(result.uv[i] - result.uv[i - 1]) for i in range(3)]), [3, 4, 5])


class TestPlacement:
    def test_axis_and_origin(self):
        V, F = grid(8, 4)
        V = V * (4, 1)
        tilted = V @ [[np.cos(1), np.sin(1)], [-np.sin(1), np.cos(1)]]
        uv = flatten(tilted, F).uv
        np.testing.assert_allclose(uv.min(axis=0), 0, atol=1e-15)
        np.testing.assert_allclose(uv.max(axis=0), (4, 1), atol=1e-3)

    def test_the_orientation_of_the_surface_in_space_does_not_matter(self):
        V, F = cat(6)
        turned = V @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
        np.testing.assert_allclose(flatten(turned, F).uv, flatten(V, F).uv, atol=1e-3)

    def test_the_longest_axis_agrees_with_a_sum_over_small_pieces(self):
        # Compared with a sum over small pieces.
        rng = np.random.default_rng(1)
        V, F = disk(4)
        V = V * (1, 0.5) + 0.3 * V[:, :1] ** 2 + 0.01 * rng.normal(size=V.shape)
        laid = align_with_axis(F, V)
        bary = rng.dirichlet((1, 1, 1), 4000)
        samples = np.einsum("sk,fkd->fsd", bary, laid[F])
        weight = np.abs(_areas(F, laid))[:, None] / len(bary)
        centre = (weight[..., None] * samples).sum((0, 1)) / weight.sum() / len(bary)
        x, y = np.moveaxis(samples - centre, 2, 0)
        mixed, along, across = ((weight * product).sum() for product in (x * y, x * x, y * y))
        assert abs(mixed) < 0.02 * along
        assert along > across

    def test_unit_square(self):
        V, F = cat(6)
        uv = flatten(50 * V, F, unit_square=True).uv
        assert uv.min() >= 0
        assert uv.max() <= 1
        assert np.ptp(uv, axis=0).max() == pytest.approx(1)

    def test_several_pieces_are_placed_side_by_side(self):
        V, F = cat(5)
        W, G = grid(4, 3)
        both = np.concatenate([V, np.column_stack([W, np.zeros(len(W))])])
        result = flatten(both, np.concatenate([F, G + len(V)]))
        assert result.certificate.bijective
        assert result.uv[len(V) :, 0].min() > result.uv[: len(V), 0].max()


def _areas(F, uv):
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


class TestOptions:
    def test_a_given_start(self):
        V, F = cat(10)
        first = flatten(V, F)
        again = flatten(V, F, start=3 * first.uv + 7)
        assert again.n_iterations <= 4
        assert again.certificate.bijective
        assert again.history[-1].energy == pytest.approx(first.history[-1].energy, rel=1e-2)

    @pytest.mark.slow
    def test_a_start_that_overlaps_itself_is_replaced(self):
        V, F = overlapping_ring()
        start = V[:, :2] * (1, -1)  # seen from the side where triangles are counterclockwise
        assert not certify(F, start).bijective
        result = flatten(V, F, start=start)
        assert result.certificate.bijective

    def test_a_start_with_inverted_triangles_is_rejected(self):
        V, F = grid(4, 4)
        start = V.copy()
        start[12] = (2, 2)
        with pytest.raises(ValueError, match=r"\(start\) is not injective: triangles"):
            flatten(V, F, start=start)

    def test_heavily_weighted_triangles_are_distorted_less(self):
        V, F = cat(10)
        face = V[F].mean(axis=1)[:, 2] > 0.5
        density = []
        for weight in (1.0, 50.0):
            uv = flatten(V, F, weights=np.where(face, weight, 1.0)).uv
            energy = DeformationEnergy(V, F, SymmetricDirichlet())
            density.append(SymmetricDirichlet().density(energy.deform(in_units(uv, 0)))[face].mean())
        assert density[1] < 0.5 * density[0]

    def test_a_user_defined_energy(self):
        class Cautious(Isotropic):
            barrier = True

            def density(self, d: Deformation):
                return np.where(d.det > 0, 2 * (d.a + d.b - 1 - np.log(np.abs(d.det))), np.inf)

            def density_gradient(self, d: Deformation):
                return 2 - 2 / d.det, 2 + 2 / d.det

            def density_hessian(self, d: Deformation):
                return 2 / d.det**2, -2 / d.det**2, 2 / d.det**2

        V, F = cat(8)
        result = flatten(V, F, energy=Cautious())
        assert result.certificate.bijective
        assert result.history[-1].energy < result.history[0].energy

    def test_iterations_callback_and_record(self):
        V, F = cat(8)
        seen = DistinctSteps()
        result = flatten(V, F, max_iterations=3, callback=seen.append, record_every=2)
        assert result.status is Status.STILL_FALLING
        assert result.certificate.bijective
        assert seen == result.history
        assert [step.iteration for step in seen] == [0, 1, 2, 3]
        assert [snapshot.iteration for snapshot in result.path] == [0, 2]

    @pytest.mark.parametrize("surface", [cat(12), overlapping_ring()], ids=["apart", "overlapping"])
    @pytest.mark.parametrize("when", [0, 3, 5])
    def test_interrupted_with_the_best_map(self, surface, when):
        def stop(step):
            if step.iteration == when:
                raise KeyboardInterrupt

        result = flatten(*surface, callback=stop)
        assert result.status is Status.INTERRUPTED
        assert result.certificate.bijective

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"energy": "bending"}, "energy must be one of .*, arap-barrier, distances, not 'bending'"),
            ({"weights": [1.0]}, "weights must have shape"),
            ({"weights": np.zeros(32)}, "the weight is not positive at triangles 0, 1, 2"),
            ({"start": [[0, 0]]}, "start must have shape"),
            ({"max_iterations": -1}, "max_iterations"),
            ({"tol": -1}, "tol"),
            ({"fixed": [0]}, "give fixed and target together"),
        ],
    )
    def test_invalid_options(self, options, words):
        V, F = grid(4, 4)
        with pytest.raises(ValueError, match=words):
            flatten(V, F, **options)


class TestBadSurfaces:
    def test_closed(self):
        V = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        with pytest.raises(ValueError, match=r"closed.*cut"):
            flatten(V, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])

    def test_handles(self):
        # A torus without one of its squares.
        k = 6
        i, j = np.divmod(np.arange(k * k), k)
        a, b = 2 * np.pi * i / k, 2 * np.pi * j / k
        V = np.stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)], axis=1)
        right, up, both = (i + 1) % k * k + j, i * k + (j + 1) % k, (i + 1) % k * k + (j + 1) % k
        low = i * k + j
        F = np.stack([low, right, both, low, both, up], axis=1).reshape(-1, 3)[2:]
        with pytest.raises(ValueError, match=r"1 handle.*cut"):
            flatten(V, F)

    def test_a_triangle_without_area(self):
        V, F = grid(4, 4)
        V[12] = V[11]
        with pytest.raises(ValueError, match=r"triangles .* zero area in the rest mesh"):
            flatten(V, F)

    def test_not_a_surface(self):
        V = np.zeros((5, 3)) + np.arange(5)[:, None] ** [[1, 2, 3]]
        with pytest.raises(ValueError, match=r"edge \(0, 1\) in more than two triangles"):
            flatten(V, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])

    def test_the_faulty_piece_is_named(self):
        V, F = grid(3, 3)
        W = np.concatenate([np.column_stack([V, 0 * V[:, 0]]), [[0, 0, 5], [1, 0, 5], [0, 1, 5], [0, 0, 6]]])
        tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]) + len(V)
        with pytest.raises(ValueError, match=r"piece around vertex 16.*closed"):
            flatten(W, np.concatenate([F, tetrahedron]))


def test_the_proxies_have_the_gradient_of_the_energy_and_are_convex():
    rng = np.random.default_rng(0)
    p = np.exp(1j * rng.uniform(0, 6, 50)) * rng.uniform(0.5, 2, 50)
    q = p * rng.uniform(0, 0.95, 50) * np.exp(1j * rng.uniform(0, 6, 50))
    d = Deformation.of(p, q)
    energy = ReweightedDirichlet()
    assert check_energy(SymmetricDirichlet()).passed
    form = energy.curvature(d)
    assert np.linalg.eigvalsh(form.matrices()).min() > 0
    # The step to the minimum of the proxy leads to the nearest rotation: W² (J − R) is the gradient.
    to_p, to_q = p / np.abs(p) - p, -q
    along_p, along_q = form.apply(to_p, to_q)
    by_p, by_q = energy.gradient(d)
    np.testing.assert_allclose(-along_p, by_p, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(-along_q, by_q, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("sizes", "goals"), [((1e-4, 1e-5), (3e-4, 3e-5)), ((0.5, 1e-2), (1, 3e-2)), ((9, 0.4), (3, 1))]
)
def test_the_goal_of_a_proxy_is_limited_relative_to_the_size_of_a_triangle(sizes, goals):
    """Its step changes the singular values to the goals; directions do not change."""
    along_p, along_q = np.exp(0.3j), np.exp(1.1j)

    def halves(first, second):
        return np.array([(first + second) / 2 * along_p]), np.array([(first - second) / 2 * along_q])

    p, q = halves(*sizes)
    to_p, to_q = halves(*goals)
    energy, at = ReweightedDirichlet(aim=3), Deformation.of(p, q)
    pull = energy.curvature(at).apply(to_p - p, to_q - q)
    np.testing.assert_allclose(np.negative(pull), energy.gradient(at), rtol=1e-9)


def test_the_crossing_part_of_a_boundary_is_measured():
    """A strip of which two edges cross two others; the rest of its boundary is free."""
    strip, F = grid(9, 2)
    (loop,) = boundary_loops(F, len(strip))
    rim = Rim([loop])
    assert rim.tangled_fraction(strip) == 0
    crossed = strip.copy()
    upper = np.flatnonzero(strip[:, 1] == 1)
    crossed[upper[np.argsort(strip[upper, 0])][4], 1] = -1
    assert rim.tangled_fraction(crossed) == 6 / loop.size


def test_loops_are_those_of_the_surface():
    V, F = annulus(8)
    result = flatten(V, F)
    assert [loop.tolist() for loop in result.certificate.loops] == [b.tolist() for b in boundary_loops(F, len(V))]


@pytest.mark.parametrize("size", [1e-300, 1e-200, 1e-162, 1e-155, 1e155, 1e200, 1e300])
def test_a_start_of_any_size_is_scaled_to_the_surface(size):
    V, F = disk(8)
    V = np.column_stack([V, np.sqrt(1.2 - (V**2).sum(axis=1))])
    own = flatten(V, F)
    result = flatten(V, F, start=own.uv * size)
    assert result.status is Status.POLISHED
    assert result.certificate.bijective
    assert result.history[-1].energy == pytest.approx(own.history[-1].energy, rel=1e-6)


@pytest.mark.parametrize("stretch", [1.0, 1e3, 1e6, 1e8, 1e11])
@pytest.mark.parametrize("turn", [1, -1])
def test_planar_surfaces_are_their_own_maps(stretch, turn):
    V, F = grid(20, 20)
    result = flatten(V * [stretch * turn, 1], F if turn > 0 else F[:, ::-1])
    assert result.status is Status.POLISHED
    assert result.history[-1].energy < 1e-12
    assert result.certificate.bijective


def test_a_single_triangle():
    result = flatten([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]])
    assert result.certificate.bijective
    assert result.history[-1].energy < 1e-12
