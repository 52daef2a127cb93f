"""Extreme numbers and meshes, each with its defined result."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from quasiharmonic import (
    Problem,
    Status,
    certify,
    diagnose,
    distortion,
    flatten,
    flatten_derivative,
    injective_map,
    inverted_triangles,
    io,
    keep_distances,
    polish,
    polish_derivative,
    refine_problem,
)
from quasiharmonic.linsolve import available
from quasiharmonic.results import Kind
from quasiharmonic.surfaces import cat, disk, grid, random_delaunay
from quasiharmonic.targets import boundary_to
from quasiharmonic.ui.cli import main
from shared.infeasible_problems import OBSTRUCTED, moved, onto
from shared.meshes import boundary_of, signed_areas
from shared.polygons import circle
from shared.small_meshes import eared
from shared.solvable_problems import star_problem

SCALES = [1e-300, 1e-150, 1e-12, 1e12, 1e150, 1e300]


def through_all(V, F, fixed, target, **more):
    """Return the certified map of a problem that has one, after everything else was tried on it, too."""
    problem = Problem(V, F, fixed, target, **more)
    assert diagnose(problem).obstructions == ()
    result = injective_map(V, F, fixed, target, **more)
    assert result.status is Status.INJECTIVE
    assert result.certificate.bijective
    assert np.isfinite(result.uv).all()
    np.testing.assert_array_equal(result.uv[fixed], target)
    return result.uv


@cache
def star_map(reference):
    """The map of the star where both scales are 1."""
    uv = through_all(*star_problem(n=60), reference=reference)
    uv.setflags(write=False)
    return uv


@cache
def obstructions_of(name):
    problem, _ = OBSTRUCTED[name]
    found = [o.message for o in diagnose(problem).obstructions]
    assert found
    return found


class TestScales:
    @pytest.mark.long
    @pytest.mark.parametrize("scale", SCALES)
    @pytest.mark.parametrize("reference", [None, "rest", "corrected"])
    def test_of_the_rest_mesh(self, scale, reference):
        V, F, fixed, target = star_problem(n=60)
        uv = through_all(V * scale, F, fixed, target, reference=reference)
        # Only rounding depends on it.
        np.testing.assert_allclose(uv, star_map(reference), atol=1e-6)

    @pytest.mark.parametrize("scale", SCALES)
    def test_of_the_target(self, scale):
        V, F, fixed, target = star_problem(n=60)
        uv = through_all(V, F, fixed, target * scale)
        np.testing.assert_allclose(uv / scale, star_map(None), atol=1e-6)

    @pytest.mark.parametrize(("rest", "image"), [(1e-150, 1e-150), (1e150, 1e150), (1e-150, 1e150), (1e150, 1e-150)])
    def test_of_both_in_a_polish(self, rest, image):
        V, F, fixed, target = star_problem(n=60)
        uv = through_all(V * rest, F, fixed, target * image)
        better = polish(V * rest, F, uv, fixed=fixed, energy="mips", max_iterations=5)
        assert better.injective
        before, after = (distortion(V * rest, F, w) for w in (uv, better.uv))
        assert np.isfinite(before.mips).all()
        assert after.statistics("mips").mean < before.statistics("mips").mean
        np.testing.assert_allclose(before.mips, distortion(V, F, uv / image).mips, rtol=1e-9)

    @pytest.mark.parametrize("image", [1e-300, 1e300])
    def test_measures_that_overflow(self, image):
        V, F = disk(3)
        found = distortion(V / image, F, V * image)
        np.testing.assert_allclose(found.mips, 0, atol=1e-9)
        assert not found.inverted.size
        json.dumps(found.to_dict(), allow_nan=False)

    @pytest.mark.slow
    @pytest.mark.parametrize("scale", [1e-150, 1e150])
    @pytest.mark.parametrize("name", ["no kernel", "nothing sees all", "too few edges across"])
    def test_of_obstructions(self, scale, name):
        problem, _ = OBSTRUCTED[name]
        found = diagnose(problem.with_target(problem.target * scale))
        assert [o.message for o in found.obstructions] == obstructions_of(name)

    @pytest.mark.parametrize("scale", [1e-150, 1e150])
    def test_extreme_scales_in_files(self, scale, tmp_path, capsys):
        V, F, fixed, target = star_problem(n=60)
        uv = np.zeros((len(V), 2))
        uv[fixed] = target * scale
        io.write_obj(tmp_path / "in.obj", io.MeshData(V / scale, F).with_map(uv))
        assert main(["map", str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj")]) == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(tmp_path / "out.obj"))[fixed], target * scale)

    @pytest.mark.slow
    def test_targets_of_the_size_of_the_least_positive_doubles_cause_no_warning(self):
        """Their curvatures underflow to zero, by which a Newton step would divide."""
        V, F = cat(4)
        fixed, target = boundary_to(V, F, "letter:R")
        result = injective_map(V, F, fixed, target * 5e-324)
        assert not result.injective
        assert np.isfinite(result.uv).all()


class TestOffsets:
    @pytest.mark.parametrize("offset", [1e3, 1e6, 1e8])
    def test_many_times_the_size(self, offset):
        V, F, fixed, target = star_problem(n=60)
        away = offset * np.array([1.0, -0.7])
        uv = through_all(V, F, fixed, target + away)
        assert signed_areas(F, uv - away).min() > 0
        through_all(V + offset, F, fixed, target)

    def test_beyond_the_resolution_of_doubles(self):
        """The positions coincide: the problem is impossible, and there is no other failure."""
        V, F, fixed, target = star_problem(n=60)
        result = injective_map(V, F, fixed, target + 1e17)
        assert result.status is Status.IMPOSSIBLE
        assert {o.kind for o in result.diagnosis.obstructions} >= {Kind.SIGNED_AREA, Kind.COLLAPSED_EDGE}
        assert np.isfinite(result.uv).all()
        with pytest.raises(ValueError, match="zero area in the rest mesh"):
            injective_map(V + 1e17, F, fixed, target)

    def test_one_distant_vertex(self):
        V, F, fixed, target = star_problem(n=60)
        target = target.copy()
        target[0] *= 1e12
        result = injective_map(V, F, fixed, target, max_iterations=60)
        assert np.isfinite(result.uv).all()
        assert result.injective == (not inverted_triangles(F, result.uv).size)


class TestSinglePrecision:
    def write(self, path, uv):
        V, F = disk(4)
        io.write_obj(path, io.MeshData(V, F).with_map(uv(V)))
        return str(path)

    def test_triangles_below_the_spacing_of_single_precision_are_reported(self, tmp_path, capsys):
        path = self.write(tmp_path / "far.obj", lambda V: V + 1e8)
        assert main(["check", path]) == 0
        assert "Injective" in capsys.readouterr().out
        assert main(["check", path, "--as", "float32", "--json", "-"]) == 1
        facts = json.loads(capsys.readouterr().out)
        assert facts["precision"] == "float32"
        # All of a disk of radius 1 is one point where the spacing of single precision is 8.
        assert len(facts["degenerate"]) == facts["triangles"]

    def test_no_other_triangles_are_reported(self, tmp_path, capsys):
        def shrunk(V):
            uv = V + 1.0
            uv[:7] = 1.0 + 1e-9 * V[:7]  # the innermost ring, smaller than 2⁻²³
            return uv

        path = self.write(tmp_path / "part.obj", shrunk)
        assert main(["check", path, "--json", "-"]) == 0
        capsys.readouterr()
        assert main(["check", path, "--as", "float32", "--json", "-"]) == 1
        facts = json.loads(capsys.readouterr().out)
        _, F = disk(4)
        assert sorted(facts["degenerate"] + facts["inverted"]) == np.flatnonzero((F < 7).sum(axis=1) >= 2).tolist()

    def test_beyond_its_range(self, tmp_path, capsys):
        path = self.write(tmp_path / "large.obj", lambda V: V * 1e60)
        assert main(["check", path]) == 0
        capsys.readouterr()
        assert main(["check", path, "--as", "float32", "--json", "-"]) == 1
        said = json.loads(capsys.readouterr().out)["certificate"]
        assert said["nonfinite"]
        assert said["bijective"] is False


class TestRestMeshes:
    def flat(self):
        V, F, fixed, target = star_problem(n=60)
        inner = next(t for t in F if not np.isin(t, fixed).any())
        V = V.copy()
        V[inner[0]] = V[inner[1]]
        return V, F, fixed, target

    def test_zero_area_needs_an_option(self):
        V, F, fixed, target = self.flat()
        for reference in (None, "rest"):
            with pytest.raises(ValueError, match="zero area in the rest mesh; choose the reference 'equilateral'"):
                injective_map(V, F, fixed, target, reference=reference)
        for reference in ("equilateral", "corrected"):
            uv = through_all(V, F, fixed, target, reference=reference)
        with pytest.raises(ValueError, match="zero area"):
            polish(V, F, uv, fixed=fixed)

    @pytest.mark.parametrize("squash", [[0, 0, 0], [1, 0, 0]])
    @pytest.mark.parametrize("reference", ["equilateral", "corrected"])
    def test_that_are_a_point_or_a_line(self, squash, reference):
        V, F, fixed, target = star_problem(n=60)
        through_all(V * squash, F, fixed, target, reference=reference)

    def test_extreme_proportions(self):
        V, F, fixed, target = star_problem(n=60)
        through_all(V * [1, 1e-6, 1], F, fixed, target, reference="rest")
        through_all(V * [1, 1e-6, 1], F, fixed, target)


class TestCollinearRuns:
    @pytest.mark.parametrize("turn", [0.0, 0.3])
    def test_along_straight_sides(self, turn):
        V, F = grid(9, 7)
        fixed = boundary_of(F)
        target = V[fixed] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        # In the rotated one, rounding bends the sides by an ulp; some ears do not survive this.
        problem = Problem(V, F, fixed, target)
        if turn:
            refine_problem(problem)
        else:
            through_all(V, F, fixed, target)

    @pytest.mark.slow
    @pytest.mark.parametrize("raised", [0.0, 1.0, -1.0])
    def test_an_ear_on_them_has_no_space(self, raised):
        """The middle of three vertices on a slanted line, and the effect of one unit in its last place."""
        tip = [1.5, 0.5 - raised * np.spacing(0.5)]
        problem = moved(eared(), {0: [0, 0], 1: tip, 2: [3, 1], 3: [0, 4]})
        flat = [o for o in diagnose(problem).obstructions if o.kind is Kind.INVERTED_TRIANGLE]
        assert len(flat) == (raised <= 0)
        refined = refine_problem(problem)
        assert not refined.diagnosis.forbids_injective
        new = refined.problem
        assert injective_map(new.V, new.F, new.fixed, new.target, reference="equilateral").injective

    def test_in_a_certificate(self):
        V, F = grid(5, 5)
        assert certify(F, V).bijective
        over = V.copy()
        over[boundary_of(F)[2]] = V[boundary_of(F)[1]] / 2  # back along the side
        assert not certify(F, over).bijective


class TestSmallMeshes:
    ONE = np.eye(3)[:, :2], np.array([[0, 1, 2]])
    TWO = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])

    @pytest.mark.parametrize("mesh", [ONE, TWO])
    def test_without_a_free_vertex(self, mesh):
        V, F = mesh
        fixed = np.arange(len(V))
        uv = through_all(V, F, fixed, V)
        assert polish(V, F, uv, fixed=fixed).injective
        assert np.allclose(distortion(V, F, uv).mips, 0)
        mirrored = injective_map(V, F, fixed, V * [-1, 1])
        assert mirrored.status is Status.IMPOSSIBLE
        assert mirrored.diagnosis.obstructions[0].kind is Kind.REVERSED

    def test_meshes_without_triangles_are_rejected(self):
        V, F = np.empty((0, 2)), np.empty((0, 3), dtype=int)
        with pytest.raises(ValueError, match="no triangles"):
            injective_map(V, F, [], V)
        with pytest.raises(ValueError, match="no triangles"):
            distortion(V, F, V)
        assert not certify(F, V).injective
        assert inverted_triangles(F, V).size == 0

    def test_one_free_vertex(self):
        V, F = np.array([[0, 0], [1, 0], [0, 1], [0.3, 0.3]]), np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]])
        through_all(V, F, [2, 0, 1], V[[2, 0, 1]] * 7 - 3)


class TestCrossingTargets:
    def test_are_mapped_where_possible(self):
        """A band that overlaps itself: the map is injective per triangle and not bijective."""
        V, F = grid(24, 3)
        t, radius = -2 * np.pi * 1.3 * V[:, 0], 1 + V[:, 1]
        fixed = boundary_of(F)
        target = np.stack([radius * np.cos(t), radius * np.sin(t)], axis=1)[fixed]
        result = injective_map(V, F, fixed, target)
        assert result.status is Status.INJECTIVE
        assert result.certificate.bijective is False

    @pytest.mark.slow
    def test_are_impossible_if_they_turn_too_little(self):
        V, F = random_delaunay(60, seed=1)
        (loop,) = onto((V, F), circle(len(boundary_of(F)))).domain.loops
        t = 2 * np.pi * (np.arange(len(loop)) + 0.3) / len(loop)
        result = injective_map(V, F, loop, np.stack([np.sin(t), np.sin(2 * t)], axis=1))
        assert result.status is Status.IMPOSSIBLE
        assert Kind.TURNING_NUMBER in {o.kind for o in result.diagnosis.obstructions}
        assert np.isfinite(result.uv).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite(bad):
    V, F = disk(3)
    fixed = boundary_of(F)
    broken = V.copy()
    broken[4, 1] = bad
    target = V[fixed].copy()
    target[2, 0] = bad
    with pytest.raises(ValueError, match="V is not finite at vertex 4"):
        injective_map(broken, F, fixed, V[fixed])
    with pytest.raises(ValueError, match="target is not finite at row 2"):
        injective_map(V, F, fixed, target)
    with pytest.raises(ValueError, match="uv is not finite at vertex 4"):
        polish(V, F, broken, fixed=fixed)
    with pytest.raises(ValueError, match="uv is not finite at vertex 4"):
        distortion(V, F, broken)
    # Certificates also apply to broken maps.
    certificate = certify(F, broken)
    assert certificate.nonfinite.tolist() == np.flatnonzero((F == 4).any(axis=1)).tolist()
    assert not certificate.injective


class TestFlatteningAtScales:
    @pytest.mark.parametrize("scale", [1e-322, pytest.param(1e-310, marks=pytest.mark.nightly), 1e-300, 1.0, 1e300])
    @pytest.mark.parametrize("place", [[0.0, 0.0], [1.0, 2.0], [1e-300, 1e-300], [1e300, 2.0], [1.7e308, -1.7e308]])
    def test_one_pin_at_any_position_gives_finite_positions(self, scale, place):
        V, F = cat(2)
        result = flatten(V / np.abs(V).max() * scale, F, fixed=[3], target=[place], record_every=1)
        assert np.isfinite(result.uv).all()
        assert all(np.isfinite(snapshot.uv).all() for snapshot in result.path)
        np.testing.assert_array_equal(result.uv[3], place)
        if not result.certificate.bijective:
            # Doubles do not distinguish triangles of this size so far from the origin.
            assert result.status is Status.ROUNDED
            assert np.abs(place).max() > 1e10 * scale

    @pytest.mark.parametrize("pins", [{}, {"fixed": [3, 9], "target": [[1e308, 2], [-1e308, 3.0]]}])
    def test_maps_beyond_the_range_of_doubles_are_rejected(self, pins):
        V, F = cat(6)
        scale = 1.0 if pins else 1e308
        with pytest.raises(ValueError, match="range of doubles"):
            flatten(V / np.abs(V).max() * scale, F, **pins)

    @pytest.mark.slow
    @pytest.mark.parametrize("flat", [1e-6, 1e-7, 1e-8, 1e-9])
    @pytest.mark.parametrize("energy", ["symmetric-dirichlet", "distances"])
    def test_thin_disks(self, flat, energy):
        V, F = disk(2)
        thin = np.column_stack([V * [1, flat], np.zeros(len(V))])
        assert flatten(thin, F, energy=energy).certificate.bijective
        assert keep_distances(thin, F, thin[:, :2]).certificate.bijective

    @pytest.mark.parametrize("flat", [1.2e-16, 1e-17, 1e-30, 1.2e-124, 1e-153])
    @pytest.mark.parametrize("axis", [0, 1])
    @pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips", "distances"])
    def test_disks_too_thin_for_doubles_are_not_changed(self, flat, axis, energy):
        """Their energy is dominated by rounding and would lead to collapsed maps."""
        V, F = disk(4)
        V[:, axis] *= flat
        for start in ({}, {"start": V}):
            result = flatten(V, F, energy=energy, **start)
            assert result.status is Status.EXHAUSTED
            assert result.certificate.bijective
            laid = result.uv[:, np.argmax(np.ptp(result.uv, axis=0))]
            laid = np.abs(laid - laid[0])
            reach = np.abs(V[:, 1 - axis] - V[0, 1 - axis])
            np.testing.assert_allclose(laid, reach, rtol=0, atol=1e-12)
            assert np.ptp(result.uv, axis=0).min() == pytest.approx(np.ptp(V[:, axis]), rel=1e-9)

    def test_thin_disks_where_two_solvers_fail(self):
        if "rslab" not in available():
            pytest.skip("rslab is not installed")
        V, F = disk(4)
        assert flatten(V * [2.1837492746569184e-09, 1], F, linear_solver="rslab").certificate.bijective


@pytest.mark.parametrize("scale", [1e-310, 1e-200, 1e-100, 1e100, 1e200, 1e300])
def test_derivatives_are_finite_or_rejected(scale):
    V, F = np.array([[0, 0, 0], [1, 0, 0], [0.3, 0.8, 0]]) * scale, np.array([[0, 1, 2]])
    uv = flatten(V, F).uv
    for derivative_of in (
        lambda: flatten_derivative(V, F, uv),
        lambda: polish_derivative(V, F, uv, fixed=[0, 1, 2]),
    ):
        if 1e-150 < scale < 1e150:
            derivative = derivative_of()
            assert np.isfinite(derivative.jvp(rest=1e-3 * V)).all()
        else:
            with pytest.raises(ValueError, match="triangle 0 at rest are outside the range of doubles"):
                derivative_of()


def test_derivatives_next_to_the_largest_double():
    """The area of each triangle is a double, but their sum overflows."""
    V, F = disk(2)
    rim = boundary_of(F)
    for map_scale in (1.0, 1e154):
        derivative = polish_derivative(1e154 * V, F, map_scale * V, fixed=rim)
        assert np.isfinite(derivative.jvp(rest=1e151 * V)).all()
    derivative = flatten_derivative(1e154 * V, F, 1e154 * V, energy="mips")
    np.testing.assert_allclose(derivative.jvp(rest=1e151 * V), 1e151 * derivative.uv / 1e154, rtol=1e-9, atol=1e140)
    with pytest.raises(ValueError, match="the energy or its derivatives leave the range of doubles at uv"):
        flatten_derivative(1e154 * V, F, V)
