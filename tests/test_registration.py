"""Displacement fields: folds, the nearest field without folds, and inverses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import minimize

from quasiharmonic import certify, inverse_field, nearest_invertible
from quasiharmonic.apps.displacement_fields.nearest import fold_free
from quasiharmonic.apps.displacement_fields.patch_descent import FoldPenalty, ThinBarrier
from quasiharmonic.energies.derivatives import check_energy


def pixels(h, w):
    return np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).astype(float)


def bump(h, w, x, y, width, push):
    """Return a field that displaces pixels around one point."""
    at = pixels(h, w) - (x, y)
    return np.exp(-(at**2).sum(axis=2) / (2 * width**2))[..., None] * np.array(push, dtype=float)


def wobble(h, w, size, seed=0, width=4):
    """Return a smooth random field."""
    dice = np.random.default_rng(seed)
    return np.stack([gaussian_filter(dice.normal(size=(h, w)), width) for _ in range(2)], axis=-1) * size


def determinants(field):
    """Return determinants at the four corners of each cell, by their definition; (4, h - 1, w - 1)."""
    places = pixels(*field.shape[:2]) + field
    along, down = np.diff(places, axis=1), np.diff(places, axis=0)
    pairs = [(a, d) for a in (along[:-1], along[1:]) for d in (down[:, :-1], down[:, 1:])]
    return np.stack([a[..., 0] * d[..., 1] - a[..., 1] * d[..., 0] for a, d in pairs])


def test_a_field_without_folds_is_returned():
    field = wobble(30, 40, 10)
    mended = nearest_invertible(field)
    assert np.array_equal(mended.field, field)
    assert (mended.folds, mended.patches, mended.distance) == (0, 0, 0)
    assert not mended.moved_mask.any()
    assert mended.certificate.bijective
    assert "does not fold" in mended.summary()


@pytest.mark.slow
def test_one_fold_is_repaired_and_the_rest_does_not_change():
    field = wobble(50, 60, 10) + bump(50, 60, 30, 25, 2.5, (6, 1))
    kept = field.copy()
    mended = nearest_invertible(field)
    assert np.array_equal(field, kept)
    assert determinants(field).min() < -0.3
    assert fold_free(mended.field).all()
    assert determinants(mended.field).min() > 0.01
    assert fold_free(mended.field.astype(np.float32)).all()
    assert mended.certificate.bijective
    assert mended.patches == 1
    assert np.array_equal(mended.field[~mended.moved_mask], field[~mended.moved_mask])
    away = np.hypot(*(pixels(50, 60) - (30, 25)).transpose(2, 0, 1)) > 12
    assert not mended.moved_mask[away].any()
    apart = np.sqrt(((mended.field - field) ** 2).sum(axis=2).mean())
    assert mended.distance == pytest.approx(apart, rel=1e-12)
    # A Gaussian narrow enough to leave no folds gives a much larger change.
    smooth = next(
        made
        for made in (
            np.stack([gaussian_filter(field[..., k], s) for k in (0, 1)], axis=-1) for s in np.arange(0.5, 5, 0.1)
        )
        if determinants(made).min() > 0.01
    )
    assert apart < 0.5 * np.sqrt(((smooth - field) ** 2).sum(axis=2).mean())


@pytest.mark.slow
@pytest.mark.parametrize("push", [(2.4, 0.3), (-0.9, 2.2)])
def test_other_methods_find_no_nearer_field(push):
    field = bump(7, 7, 3.1, 2.9, 1.1, push)
    mended = nearest_invertible(field)
    assert mended.folds > 0

    def apart(x):
        return ((x - field.ravel()) ** 2).sum(), 2 * (x - field.ravel())

    bound = {"type": "ineq", "fun": lambda x: determinants(x.reshape(field.shape)).ravel() - 0.01}
    for start in (mended.field, 0 * field):
        found = minimize(apart, start.ravel(), jac=True, method="SLSQP", constraints=bound, options={"maxiter": 200})
        other = np.sqrt(found.fun / 49)
        assert mended.distance == pytest.approx(other, rel=0.005)
        assert mended.distance > 0.99 * other


def test_folds_are_those_of_bilinear_interpolation():
    dice = np.random.default_rng(4)
    field = dice.normal(size=(25, 25, 2)) * 0.35
    corners = determinants(field)
    # Corners (first, below, right, last) of each cell; the determinant is bilinear and has no mixed term.
    s, t = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
    places = pixels(25, 25) + field
    a, b, c, d = places[:-1, :-1], places[:-1, 1:], places[1:, :-1], places[1:, 1:]
    lowest = np.full(corners.shape[1:], np.inf)
    for one, other in zip(s.ravel(), t.ravel(), strict=True):
        along, down = (1 - other) * (b - a) + other * (d - c), (1 - one) * (c - a) + one * (d - b)
        lowest = np.minimum(lowest, along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    assert 0.2 < fold_free(field).mean() < 0.9
    assert np.array_equal(fold_free(field), lowest > 0)


def test_a_fold_that_one_diagonal_does_not_detect():
    field = np.zeros((4, 4, 2))
    field[1, 1] = 0.7
    seen = [[5, 6, 10], [5, 10, 9]]
    assert certify(seen, (pixels(4, 4) + field).reshape(-1, 2), boundary=False).injective
    assert np.argwhere(~fold_free(field)).tolist() == [[1, 1]]
    assert fold_free(nearest_invertible(field).field).all()


@pytest.mark.slow
def test_fixed_pixels_do_not_move():
    field = bump(24, 24, 3, 12, 2.0, (-4, 2))
    border = np.ones((24, 24), dtype=bool)
    border[1:-1, 1:-1] = False
    field[border] = 0
    mended = nearest_invertible(field, fixed=border)
    assert not mended.moved_mask[border].any()
    assert fold_free(mended.field).all()
    assert mended.distance > nearest_invertible(field).distance
    with pytest.raises(ValueError, match=r"all fixed; the first of each is pixels \("):
        nearest_invertible(field, fixed=np.ones((24, 24), dtype=bool))
    swapped = np.zeros((5, 7, 2))
    swapped[2, 2, 0], swapped[2, 4, 0] = 2, -2
    with pytest.raises(RuntimeError, match=r"keeps the fixed pixels; folds remain at pixels \(1, 2\), "):
        nearest_invertible(swapped, fixed=np.hypot(swapped[..., 0], swapped[..., 1]) > 0)


@pytest.mark.slow
def test_the_unit_of_length_does_not_matter():
    field = bump(30, 30, 15, 15, 2.0, (5, 2))
    one, other = nearest_invertible(field), nearest_invertible(4 * field, spacing=4)
    assert np.array_equal(4 * one.field, other.field)
    stretched = nearest_invertible(field * (0.5, 2), spacing=(0.5, 2))
    assert stretched.folds == one.folds
    assert fold_free(stretched.field, spacing=(0.5, 2)).all()


@pytest.mark.slow
def test_noise_with_a_large_offset_is_repaired_in_double_precision():
    field = np.random.default_rng(3).normal(size=(14, 15, 2)) * 0.3 + 1e6
    assert not fold_free(field, spacing=0.1).all()
    mended = nearest_invertible(field, spacing=0.1, min_jacobian=0)
    assert fold_free(mended.field, spacing=0.1).all()
    with pytest.raises(ValueError, match="subtract the mean displacement"):
        nearest_invertible(field + 1e16, spacing=0.1)


@pytest.mark.slow
def test_rounding_that_folds_a_part_far_from_zero_is_reported():
    field = np.random.default_rng(3).normal(size=(14, 15, 2)) * 0.3
    messages = []
    # Where most pixels are near zero, the bound of rounding is small. Not every offset rounds to a fold.
    for offset in np.linspace(1.3e13, 3.4e13, 12):
        far = field.copy()
        far[:, 8:] += offset
        try:
            assert nearest_invertible(far, spacing=0.1).success
        except RuntimeError as error:
            messages.append(str(error))
    assert messages
    assert all("rounding folds the new field" in message for message in messages)


@pytest.mark.parametrize("far", [1e8, 1e200])
def test_one_distant_pixel_leaves_the_rest_alone(far):
    field = wobble(24, 26, 0.2)
    field[11, 9] = far, -0.3 * far
    mended = nearest_invertible(field)
    assert mended.certificate.bijective
    y, x = np.nonzero(mended.moved_mask)
    assert mended.moved_mask[11, 9]
    assert mended.distance == pytest.approx(far * np.hypot(1, 0.3) / np.sqrt(24 * 26), rel=1e-6)
    assert max(np.abs(y - 11).max(), np.abs(x - 9).max()) < 6


def test_an_inverted_field_has_a_nearest_one_without_folds():
    places = pixels(12, 12)
    field = np.stack([11 - 2 * places[..., 0], 0.1 * places[..., 1]], axis=-1)
    mended = nearest_invertible(field)
    assert mended.folds == 121
    assert mended.certificate.injective
    assert fold_free(mended.field).all()


def test_the_barrier_has_the_stated_derivatives():
    assert check_energy(ThinBarrier(0.05, 3.0)).passed


@pytest.mark.parametrize("unit", [1e-150, 1e-80, 1e80, 1e150])
def test_the_unit_of_a_field_does_not_matter_to_its_inverse(unit):
    field = nearest_invertible(wobble(20, 25, 12)).field
    plain, same = inverse_field(field), inverse_field(field * unit, spacing=unit)
    assert same.error < 1e-12 * unit
    np.testing.assert_array_equal(same.outside, plain.outside)
    np.testing.assert_allclose(same.field / unit, plain.field, atol=1e-12)


@pytest.mark.parametrize("spacing", [1.0, (0.5, 3.0)])
def test_field_and_inverse_cancel(spacing):
    field = nearest_invertible(wobble(40, 50, 25) * spacing, spacing=spacing).field
    back = inverse_field(field, spacing=spacing)
    inside = ~back.outside
    assert 0.8 < inside.mean() < 1
    assert np.isnan(back.field[back.outside]).all()
    assert back.error < 1e-12
    grid = pixels(40, 50) * spacing
    source = (grid + back.field)[inside]
    x, y = (source / spacing).T
    there = np.stack([map_coordinates(field[..., k], (y, x), order=1, mode="nearest") for k in (0, 1)], axis=-1)
    assert source + there == pytest.approx(grid[inside], abs=1e-12)
    assert "% of the pixels lie outside" in back.summary()


def test_inverse_of_a_field_with_a_closed_form():
    A = np.array([[0.9, 0.2], [-0.1, 1.1]])
    grid = pixels(20, 30)
    middle = np.array((14.5, 9.5))
    back = inverse_field((grid - middle) @ A.T + middle - grid)
    inverse = (grid - middle) @ np.linalg.inv(A).T + middle
    inside = ((inverse >= 0) & (inverse <= (29, 19))).all(axis=2)
    assert np.array_equal(back.outside, ~inside)
    assert (grid + back.field)[inside] == pytest.approx(inverse[inside], abs=1e-12)


def test_fields_without_an_inverse_are_rejected():
    with pytest.raises(ValueError, match=r"folds.*pixels \(\d+, \d+\).*nearest_invertible"):
        inverse_field(bump(20, 20, 10, 10, 2, (5, 0)))
    # A strip rolled up beyond its start: no cell folds, but the ends overlap.
    x, y = pixels(6, 60).transpose(2, 0, 1)
    angle, radius = x * 2 * np.pi / 50, 30 - y
    rolled = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)[:, ::-1]
    field = rolled - pixels(6, 60)
    if not fold_free(field).all():
        field = rolled * (1, -1) - pixels(6, 60)
    assert fold_free(field).all()
    with pytest.raises(ValueError, match=r"no inverse\. Injective.*Not bijective"):
        inverse_field(field)


WRONG = np.zeros((5, 6, 2))
LOST = WRONG.copy()
LOST[1, 4, 0], LOST[3, 2, 1] = np.nan, np.inf


@pytest.mark.parametrize("function", [nearest_invertible, inverse_field, fold_free])
@pytest.mark.parametrize(
    ("field", "options", "message"),
    [
        (LOST, {}, r"field is not finite at pixels \(1, 4\), \(3, 2\), row and column"),
        (np.zeros((2, 5, 6)), {}, r"not \(2, 5, 6\): pass numpy.moveaxis\(field, 0, -1\)"),
        (np.zeros((4, 5, 6, 2)), {}, "field must have shape"),
        (np.zeros((1, 6, 2)), {}, "at least 2 × 2 pixels"),
        (WRONG + 1j, {}, "field must contain real numbers"),
        (WRONG, {"spacing": (1, 0)}, "spacing must be a positive number, or two"),
        (WRONG, {"spacing": (1, 1, 1)}, "spacing must be a positive number, or two"),
    ],
)
def test_invalid_fields(function, field, options, message):
    with pytest.raises(ValueError, match=message):
        function(field, **options)


def test_invalid_options():
    with pytest.raises(ValueError, match="min_jacobian must be at least 0 and less than 1, not 1"):
        nearest_invertible(WRONG, min_jacobian=1)
    with pytest.raises(ValueError, match=r"min_jacobian must be at least 0 and less than 1, not '0\.5'"):
        nearest_invertible(WRONG, min_jacobian="0.5")
    with pytest.raises(ValueError, match=r"fixed must be a bool array of shape \(5, 6\)"):
        nearest_invertible(WRONG, fixed=[0, 1])


@pytest.mark.slow
def test_deep_folds_of_smooth_noise_move_only_pixels_near_them():
    field = wobble(200, 260, 1, 1, 8)
    field *= 4.11 / field.std()
    mended = nearest_invertible(field)
    assert mended.folds > 300
    assert fold_free(mended.field).all()
    assert np.array_equal(mended.field[~mended.moved_mask], field[~mended.moved_mask])
    assert mended.moved_mask.sum() < 1200
    assert mended.distance < 0.0385


def test_every_patch_of_moved_pixels_has_a_fold():
    """Some cells near the bound are in patches while these descend, without being folds."""
    field = wobble(120, 160, 1, 0, 8)
    field *= 4.7 / field.std()
    result = nearest_invertible(field)
    assert result.folds > 300
    moved, folded = (result.field != field).any(axis=-1), np.zeros(field.shape[:2], dtype=bool)
    for y, x in np.argwhere((determinants(field) <= 0.01).any(axis=0)):
        folded[y : y + 2, x : x + 2] = True
    patch, count = ndimage.label(moved, np.ones((3, 3)))
    assert count > 1
    assert np.isin(np.arange(1, count + 1), patch[folded]).all()
    assert ndimage.distance_transform_edt(~folded)[moved].max() < 12
    assert determinants(result.field).min() > 0.01


def test_the_penalty_of_folds_has_correct_derivatives():
    assert check_energy(FoldPenalty(0.1, 0.4)).passed


def test_a_field_far_from_zero_is_rejected_instead_of_reported_as_folded():
    field = np.full((10, 10, 2), 1e12)
    assert nearest_invertible(field).folds == 0
    with pytest.raises(ValueError, match="subtract the mean displacement"):
        nearest_invertible(100 * field)
    # A large scale is no obstacle.
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    assert nearest_invertible(1e9 * np.stack([x, y], axis=-1)).folds == 0
