"""Adversarial families of problems: each generates problems with the documented property."""

from __future__ import annotations

import numpy as np
import pytest

import campaign
import outlines
import problems
from quasiharmonic import Problem, boundary_loops, certify
from quasiharmonic.geometry.exact.loops import check_loops

pytestmark = pytest.mark.long

UNKNOWN = "snowflake", "filling"


def made(family, difficulty=1.0, seed=3):
    return problems.make(family, seed, difficulty, triangles=200)


def sides(case):
    """Side lengths of the known solution's triangles, (f, 3)."""
    corners = case.hidden[case.F]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


@pytest.mark.parametrize("family", problems.ADVERSARIAL)
@pytest.mark.parametrize("difficulty", [0.0, 0.4, 0.8])
def test_a_problem_is_well_formed_and_has_its_known_solution(family, difficulty):
    case = made(family, difficulty)
    problem = Problem(case.V, case.F, case.fixed, case.target)
    assert case.feasible == (family not in UNKNOWN)
    assert np.isfinite(case.V).all()
    assert problem.n == len(case.V)
    if case.feasible:
        certificate = certify(case.F, case.hidden)
        assert certificate.injective
        assert certificate.bijective == case.simple
        np.testing.assert_array_equal(case.hidden[case.fixed], case.target)
    again = problems.make(*problems.parse(case.name), triangles=200)
    for one, other in zip(case[:4], again[:4], strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_published_families_are_unchanged():
    """The order and names of the families determine the names of a campaign's problems, and those the problems."""
    published = "noise jam flow swirl adrift pins spiral comb maze limbs carved polygon star whirl teeth glyph moved"
    assert list(problems.FAMILIES) == published.split()
    assert not set(problems.FAMILIES) & set(problems.ADVERSARIAL)


def test_needles_have_an_aspect_ratio_of_a_million():
    case = problems.make("needles", 1, 1.0, triangles=60)
    spread = np.linalg.svd(case.target - case.target.mean(axis=0), compute_uv=False)
    assert spread[0] / spread[1] > 1e5


def test_sizes_differ_by_a_hundred_million():
    lengths = sides(made("sizes"))
    assert lengths.max() / lengths.min() > 1e8


def test_a_hub_has_five_thousand_neighbours():
    case = made("hub")
    assert np.bincount(case.F.ravel()).max() == 5000
    radii = np.linalg.norm(case.target, axis=1)
    assert radii.max() / radii.min() > 1e4


def test_hilberts_curve_visits_every_cell_once_and_steps_by_one():
    curve = outlines.hilbert(4)
    cells = np.unique(np.round([curve.real, curve.imag]), axis=1)
    assert cells.shape == (2, 256)
    assert cells.min() == 0
    assert cells.max() == 15
    np.testing.assert_allclose(abs(np.diff(curve)), 1)


def test_a_strip_along_hilberts_curve_does_not_touch_itself():
    case = made("hilbert")
    assert case.simple
    # A box of 16 × 16 cells; the strip turns in nearly all of them.
    np.testing.assert_allclose(np.ptp(case.target, axis=0), 16, atol=1)


def test_kochs_snowflake_has_its_corners_and_its_area():
    """At level n the area is (8 / 5) of the triangle's (the limit) minus (3 / 5) (4 / 9)ⁿ of it."""
    for level in range(5):
        z = outlines.koch(level)
        assert len(z) == 3 * 4**level
        np.testing.assert_allclose(abs(np.roll(z, -1) - z), 1)
        area = 0.5 * (z.conj() * np.roll(z, -1)).imag.sum()
        np.testing.assert_allclose(area, np.sqrt(3) / 4 * 9**level * (8 - 3 * (4 / 9) ** level) / 5)
    case = problems.make("koch", 0, 0.9)
    (loop,) = boundary_loops(case.F, len(case.V))
    corners = outlines.koch(4)
    assert abs(corners[:, None] - case.target @ (1, 1j)).min(axis=1).max() < 1e-9
    assert len(loop) == len(corners)
    assert case.simple


def test_coils_shrink_to_a_millionth():
    radii = np.linalg.norm(made("coil").target, axis=1)
    assert radii.max() / radii.min() > 1e5


def test_gaps_are_a_ten_billionth():
    case = made("gaps")
    assert case.simple
    # The nearest two boundary vertices that are not neighbours on the boundary.
    z = case.target @ (1, 1j)
    apart = abs(z[:, None] - z)
    np.fill_diagonal(apart, np.inf)
    assert 0.5e-10 < apart.min() < 2e-10


@pytest.mark.parametrize(("difficulty", "holes"), [(0.0, 1), (0.5, 45), (1.0, 90)])
def test_a_sieve_has_ninety_holes(difficulty, holes):
    case = made("sieve", difficulty)
    assert len(boundary_loops(case.F, len(case.V))) == 1 + holes


def test_three_thousand_vertices_are_pinned():
    case = made("nailed")
    assert Problem(case.V, case.F, case.fixed, case.target).domain.pins.size > 2900


def test_scales_reach_the_ends_of_doubles():
    exponents = []
    for seed in range(12):
        case = made("scales", seed=seed)
        exponents.append([np.log10(np.ptp(points, axis=0).max()) for points in (case.V, case.target)])
    for low, high in zip(np.min(exponents, axis=0), np.max(exponents, axis=0), strict=True):
        assert low < -299
        assert high > 299


@pytest.mark.parametrize("family", UNKNOWN)
@pytest.mark.parametrize("difficulty", [0.1, 0.5, 0.95])
def test_outlines_are_simple(family, difficulty):
    target = made(family, difficulty).target
    meeting, reasons = check_loops([np.arange(len(target))], target)
    assert not len(meeting)
    assert not reasons


def test_a_snowflake_is_reached_at_every_corner():
    target = made("snowflake", 0.6).target @ (1, 1j)
    assert abs(outlines.koch(3)[:, None] - target).min(axis=1).max() < 1e-12


def test_an_option_runs_a_campaign_of_these_families(tmp_path, capsys, quick_campaign):
    output = tmp_path / "results.jsonl"
    assert campaign.main(["--adversarial", "-n", "2", "-o", str(output)]) == 0
    assert [record["family"] for record in campaign.read(output)] == ["needles", "sizes"]
    assert "needles" in capsys.readouterr().out
