"""Images warped without folds."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import distortion, morph, surfaces, warp_along, warp_by_landmarks
from quasiharmonic.energies.bending import Plate, Pull


def blobs(height, width, centres):
    """Return an image of small bright spots."""
    y, x = np.mgrid[:height, :width]
    return sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for a, b in centres)


@pytest.mark.slow
def test_landmarks_reach_their_targets_and_the_border_stays():
    before = np.array([(30, 30), (70, 40), (50, 60)], dtype=float)
    after = np.array([(40, 22), (60, 55), (30, 68)], dtype=float)
    image = blobs(90, 100, before)
    image[0] = image[-1] = image[:, 0] = image[:, -1] = 0.5
    kept = image.copy()
    warped = warp_by_landmarks(image, before, after)
    assert warped.result.certificate.bijective
    assert np.array_equal(image, kept)
    assert warped.image.shape == image.shape
    for x, y in after.astype(int):
        assert warped.image[y, x] == pytest.approx(1, abs=1e-6)
    for side in (warped.image[0], warped.image[-1], warped.image[:, 0], warped.image[:, -1]):
        assert side == pytest.approx(0.5)


@pytest.mark.slow
def test_landmarks_that_pass_each_other():
    before = np.array([(40, 50), (60, 50)], dtype=float)
    warped = warp_by_landmarks(np.zeros((100, 100), np.uint8), before, before[::-1], resolution=32)
    assert warped.result.certificate.bijective


@pytest.mark.slow
def test_without_moved_landmarks_the_image_does_not_change():
    rng = np.random.default_rng(5)
    for image in (rng.integers(0, 255, (33, 48, 3), dtype=np.uint8), rng.normal(size=(40, 30)).astype(np.float32)):
        points = [[11.5, 9.25], [20, 20]]
        warped = warp_by_landmarks(image, points, points, resolution=16)
        assert warped.image.dtype == image.dtype
        assert warped.image == pytest.approx(image, abs=1e-5)
        empty = warp_by_landmarks(image, [], np.empty((0, 2)), resolution=16)
        assert empty.image == pytest.approx(image, abs=1e-5)


@pytest.mark.parametrize("kind", ["uint8", "int64", "uint64"])
def test_largest_and_smallest_integers_are_kept(kind):
    for extreme in (np.iinfo(kind).max, np.iinfo(kind).min):
        drawn = warp_by_landmarks(np.full((10, 12), extreme, dtype=kind), [[5, 5]], [[6, 5]], resolution=16)
        assert (drawn.image == extreme).all()


def test_a_moved_boundary():
    points, F = surfaces.grid(10, 10)
    upper = np.flatnonzero(points[:, 1] == 1)
    lifted = np.stack([points[upper, 0], 1 - 0.4 * np.sin(np.pi * points[upper, 0])], axis=1)
    moved = morph(points, F, upper, lifted)
    image = np.tile(np.arange(1, 65, dtype=np.int16), (64, 1))
    drawn = warp_along(image, points * 63, F, moved.points * 63)
    assert drawn.dtype == np.int16
    # The vacated area is empty, the rest is not, and the lower side has not changed.
    assert (drawn[60:, 20:44] == 0).all()
    assert (drawn[:30] > 0).all()
    assert np.array_equal(drawn[0], image[0])


def test_another_shape():
    points = np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]])
    image = np.arange(16).reshape(4, 4)
    drawn = warp_along(image, points, [[0, 1, 2], [0, 2, 3]], points + np.array((2, 1)), shape=(5, 7))
    assert drawn.shape == (5, 7)
    assert np.array_equal(drawn[1:, 2:6], image)
    assert drawn[0].sum() == drawn[:, :2].sum() == drawn[:, 6].sum() == 0


@pytest.mark.long
@pytest.mark.parametrize("shape", [(30, 1000), (1000, 30)])
def test_narrow_images_can_be_warped(shape):
    size = np.array(shape[::-1]) - 1.0
    along = np.where(size > 100, 0.2, 0.1)
    warped = warp_by_landmarks(np.zeros(shape, np.uint8), [0.5 * size], [(0.5 + along) * size])
    assert warped.result.certificate.bijective
    assert warped.positions[-1] == pytest.approx((0.5 + along) * size)


@pytest.mark.long
def test_landmarks_on_the_border_move_it():
    image = np.tile(np.arange(1, 65, dtype=np.int16), (64, 1))
    # The lower side bends up, the right upper corner moves in; the left side stays.
    before = [[31.5, 63], [63, 0], [20, 20]]
    after = [[31.5, 40], [50, 5], [22, 20]]
    warped = warp_by_landmarks(image, before, after, resolution=32)
    assert warped.result.certificate.bijective
    for start, end in zip(before, after, strict=True):
        assert warped.positions[(warped.points == start).all(axis=1)].tolist() == [end]
    left = warped.points[:, 0] == 0
    assert np.array_equal(warped.positions[left], warped.points[left])
    # A straight line from the corner, which stays, to the landmark.
    lower = (warped.points[:, 1] == 63) & (warped.points[:, 0] <= 31.5)
    assert warped.positions[lower, 1] == pytest.approx(63 - 23 * warped.points[lower, 0] / 31.5)
    assert warped.positions[lower, 0] == pytest.approx(warped.points[lower, 0])
    assert (warped.image[50:, 24:40] == 0).all()
    assert (warped.image[:, 0] == image[:, 0]).all()
    with pytest.raises(ValueError, match="crosses itself"):
        warp_by_landmarks(image, [[31.5, 63]], [[31.5, -10]])


@pytest.mark.slow
@pytest.mark.parametrize("shape", [None, (90, 150)])
def test_rasterised_triangles_agree_with_located_points(shape, monkeypatch):
    rng = np.random.default_rng(2)
    image = rng.normal(size=(60, 90))
    points, F = surfaces.grid(4, 4)
    upper = np.flatnonzero(points[:, 1] == 1)
    moved = morph(points, F, upper, points[upper] + [0.1, -0.2]).points
    size = (89, 59)
    quick = warp_along(image, points * size, F, moved * size, shape=shape)
    monkeypatch.setattr("quasiharmonic.apps.image_warp.LARGE", np.inf)
    slow = warp_along(image, points * size, F, moved * size, shape=shape)
    assert np.array_equal(quick == 0, slow == 0)
    assert quick == pytest.approx(slow, abs=1e-9)


def test_points_without_a_position_are_named():
    points = np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]])
    lost = points.copy()
    lost[2, 1] = np.nan
    for before, after, message in ((lost, points, "points is not finite at vertex 2"), (points, lost, "positions is")):
        with pytest.raises(ValueError, match=message):
            warp_along(np.zeros((4, 4)), before, [[0, 1, 2], [0, 2, 3]], after)


@pytest.mark.long
def test_an_impossible_warp_has_advice():
    with pytest.raises(RuntimeError, match="Move them less, or give more landmarks"):
        warp_by_landmarks(np.zeros((50, 50)), [[31.5, 49], [20, 20]], [[31.5, 30], [31.5, 40]], resolution=16)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros(5), [[1, 1]], [[1, 1]]), "image must have shape"),
        ((np.zeros((9, 9), complex), [[1, 1]], [[1, 1]]), "real numbers"),
        ((np.zeros((9, 9)), [[1, 1, 1]], [[1, 1]]), r"landmarks must have shape \(n, 2\)"),
        ((np.zeros((9, 9)), [[1, 1]], [[1, 8]]), "target: point 0 not inside"),
        ((np.zeros((9, 9)), [[1, np.nan]], [[1, 1]]), "landmarks is not finite at point 0"),
        (
            (np.zeros((9, 9)), [[1, 1], [1, 1]], [[1, 1], [2, 2]]),
            r"landmarks: points 0, 1 have the same position, \(1.0, 1.0\)",
        ),
        ((np.zeros((9, 9)), [[1, 1]], [[1, 1], [2, 2]]), "as many rows"),
    ],
)
def test_invalid_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        warp_by_landmarks(*arguments)


@pytest.mark.parametrize("shape", [(0, 5), (5, -1)])
def test_images_without_extent(shape):
    V, F = surfaces.grid(3, 3)
    with pytest.raises(ValueError, match=rf"shape must be two positive integers, not \({shape[0]}, {shape[1]}\)"):
        warp_along(np.zeros((9, 9)), V, F, V, shape=shape)


def test_a_map_with_inverted_triangles_is_rejected():
    points = np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]])
    with pytest.raises(ValueError, match="no inverse"):
        warp_along(np.zeros((4, 4)), points, [[0, 1, 2], [0, 2, 3]], points[::-1])


def worst_stretch(warped):
    measured = distortion(warped.points, warped.F, warped.positions)
    return np.maximum(measured.sigma1, 1 / measured.sigma2).max()


@pytest.mark.long
def test_stretch_does_not_grow_with_the_resolution():
    def stretch(resolution, **options):
        return worst_stretch(
            warp_by_landmarks(np.zeros((90, 90)), [[40, 40]], [[55, 45]], resolution=resolution, **options)
        )

    assert stretch(64) < 1.03 * stretch(16) < 2
    assert stretch(64, smoothness=0) > 1.5 * stretch(16, smoothness=0)


@pytest.mark.slow
def test_a_slight_warp_is_a_thin_plate_with_a_pin():
    at, by = np.array([40.0, 60.0]), np.array([0.5, 0.2])
    warped = warp_by_landmarks(np.zeros((101, 101)), [at], [at + by], smoothness=1e4, resolution=48)
    # Navier's series of a hinged square plate under a force at one point, relative to its value there.
    k = np.arange(1, 120)
    modes = np.sin(np.pi * k * warped.points[:, :, None] / 100)
    force = np.sin(np.pi * k * at[:, None] / 100)
    stiff = (k[:, None] ** 2 + k**2) ** 2
    lift = np.einsum("nk,nl,kl->n", modes[:, 0] * force[0], modes[:, 1] * force[1], 1 / stiff)
    lift /= np.einsum("k,l,kl->", force[0] ** 2, force[1] ** 2, 1 / stiff)
    assert warped.positions - warped.points == pytest.approx(lift[:, None] * by, abs=2e-3)


@pytest.mark.slow
def test_soft_landmarks_may_miss_their_targets():
    before, after = [[30, 30], [50, 30]], [[45, 30], [32, 33]]
    missed = []
    for weight in (1, 100, 1e4, np.inf):
        warped = warp_by_landmarks(np.zeros((61, 81)), before, after, weights=[weight, np.inf], resolution=24)
        assert warped.result.certificate.bijective
        assert warped.positions[-1].tolist() == after[1]
        missed.append(np.hypot(*(warped.positions[-2] - after[0])))
    assert missed[0] > 1.5 * missed[1] > 20 * missed[2] > missed[3] == 0
    # Two landmarks with the same target both come close to it.
    both = warp_by_landmarks(np.zeros((61, 81)), before, [[40, 30], [40, 30]], weights=[1e3, 1e3], resolution=24)
    assert both.result.certificate.bijective
    assert np.abs(both.positions[-2:] - (40, 30)).max() < 3


@pytest.mark.slow
def test_curves_are_mapped_to_curves():
    t = np.linspace(0, 1, 40)
    line = np.stack([20 + 50 * t, 0 * t + 40], axis=1)
    bow = np.stack([25 + 40 * t, 40 - 15 * np.sin(np.pi * t)], axis=1)
    angle = 2 * np.pi * t
    ring = np.stack([45 + 8 * np.cos(angle), 62 + 8 * np.sin(angle)], axis=1)
    ring[-1] = ring[0]
    curves = [(line[[0, -1]], bow), (ring, np.add(ring, (6, 0)))]
    warped = warp_by_landmarks(np.zeros((81, 91)), [[20, 20]], [[25, 22]], curves=curves, resolution=32)
    assert warped.result.certificate.bijective
    assert warped.positions[(warped.points == (20, 20)).all(axis=1)].tolist() == [[25, 22]]
    on_line = (warped.points[:, 1] == 40) & (np.abs(warped.points[:, 0] - 45) <= 25)
    assert np.count_nonzero(on_line) > 15
    # Equal parts of one curve are mapped to equal parts of the other.
    arc = np.append(0, np.cumsum(np.hypot(*np.diff(bow, axis=0).T)))
    part = (warped.points[on_line, 0] - 20) / 50 * arc[-1]
    expected = np.stack([np.interp(part, arc, bow[:, axis]) for axis in (0, 1)], axis=1)
    assert warped.positions[on_line] == pytest.approx(expected, abs=0.05)


SQUARE = np.array([[20, 20], [40, 20], [40, 40], [20, 40], [20, 20]])


@pytest.mark.parametrize(("factor", "resolution"), [(1.1, 64), (1.3, 48), (1.5, 24)])
def test_corners_of_curves_may_become_straight(factor, resolution):
    image = np.zeros((60, 80))
    warp = warp_by_landmarks(image, [], [], curves=[(SQUARE, SQUARE * [factor, 1])], resolution=resolution)
    assert warp.certificate.bijective


def test_points_at_equal_positions_up_to_rounding_are_one():
    angle = np.linspace(0, 2 * np.pi, 101)
    circle = np.stack([40 + 15 * np.cos(angle), 30 + 15 * np.sin(angle)], axis=1)
    assert (circle[0] != circle[-1]).any()
    spoke = np.array([[10.0, 30.0], circle[50] + 1e-14])
    curves = [(circle, circle), (spoke, spoke)]
    warp = warp_by_landmarks(np.zeros((60, 80)), [circle[50]], [circle[50]], weights=[1e-6], curves=curves)
    near = np.abs(warp.points - circle[50]).max(axis=1) < 1e-9
    assert near.sum() == 1
    np.testing.assert_allclose(warp.positions[near], circle[50:51], atol=1e-9)
    with pytest.raises(ValueError, match="landmarks: points 0, 1 have the same position"):
        warp_by_landmarks(np.zeros((60, 80)), [[10, 10], [10, 10 + 1e-14]], [[10, 10], [11, 10]])


def test_one_or_two_landmarks_suffice():
    for before, after in (([[30, 20]], [[38, 25]]), ([[30, 20], [12, 30]], [[38, 25], [12, 22]])):
        warped = warp_by_landmarks(np.zeros((41, 51)), before, after, resolution=16)
        assert warped.result.certificate.bijective
        assert warped.positions[-len(after) :].tolist() == after


def test_the_plate_energy_has_the_stated_gradient():
    V, F = surfaces.grid(5, 4)
    dice = np.random.default_rng(0)
    pull, unit = Pull(np.array([8]), np.array([[0.4, 0.1]]), np.array([2.0])), 0.5
    plate = Plate(V, F, np.array([7, 8, 13]), 0.3, pull, unit)
    w, step = dice.normal(size=(2, len(V), 2)).view(np.complex128)[..., 0]
    slope = (plate.value(w + 1e-3 * step) - plate.value(w - 1e-3 * step)) / 2e-3
    assert slope == pytest.approx(np.vdot(plate.gradient(w), step).real, rel=1e-9)
    bend = plate.value(w + step) - 2 * plate.value(w) + plate.value(w - step)
    assert bend == pytest.approx(2 * unit**2 * np.vdot(step, plate.matrix() @ step).real, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": [1, 1]}, r"weights must have shape \(1,\)"),
        ({"weights": [0]}, "the weight is not positive at landmark 0"),
        ({"weights": [1], "smoothness": 0}, "weights have no effect without smoothness"),
        ({"smoothness": -1}, "smoothness must be a finite number"),
        ({"resolution": 1}, "resolution must be an integer of at least 2"),
        ({"curves": [([[1, 1], [2, 2]],)]}, "curve 0 must be two polylines, before and after, not 1"),
        ({"curves": [([[1, 1]], [[1, 1], [2, 2]])]}, "curve 0 must be two polylines"),
        ({"curves": [([[1, 1], [np.nan, 2]], [[1, 1], [2, 2]])]}, "curve 0 is not finite at point 1"),
        ({"curves": [([[1, 1], [1, 1]], [[1, 1], [2, 2]])]}, "curve 0 has no length"),
        ({"curves": [([[1, 1], [5, 1]], [[1, 1], [2, 20]])]}, "curve 0, after: points .* not inside the image"),
        (
            {"curves": [([[1, 1], [4, 4]], [[1, 1], [4, 5]])]},
            r"curve 0 moves its point \(4.0, 4.0\) to \(4.0, 5.0\), but",
        ),
        ({"curves": [([[1, 1], [2, 1]], [[1, 1], [2, 2]]), ([[3, 3], [2, 1]], [[3, 3], [2, 3]])]}, "curve 1 moves its"),
        ({"curves": [([[1, 1], [6, 1], [6, 6], [1, 1]], [[1, 1], [6, 1], [6, 6], [1, 2]])]}, "curve 0 moves its point"),
    ],
)
def test_invalid_landmark_options(options, message):
    with pytest.raises(ValueError, match=message):
        warp_by_landmarks(np.zeros((9, 9)), [[4, 4]], [[5, 4]], **options)


def test_soft_landmarks_on_the_border_are_rejected():
    with pytest.raises(ValueError, match="weights: landmark 0 on the border"):
        warp_by_landmarks(np.zeros((9, 9)), [[0, 4]], [[0, 5]], weights=[3])
