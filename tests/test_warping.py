"""Pictures warped without folds."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import morph, surfaces, warp_along, warp_by_landmarks


def blobs(height, width, centres):
    """A picture of small bright spots."""
    y, x = np.mgrid[:height, :width]
    return sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for a, b in centres)


def test_landmarks_arrive_and_the_border_stays():
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


def test_landmarks_that_pass_each_other():
    before = np.array([(40, 50), (60, 50)], dtype=float)
    warped = warp_by_landmarks(np.zeros((100, 100), np.uint8), before, before[::-1])
    assert warped.result.certificate.bijective


def test_no_landmark_moved_is_the_same_picture():
    rng = np.random.default_rng(5)
    for image in (rng.integers(0, 255, (33, 48, 3), dtype=np.uint8), rng.normal(size=(40, 30)).astype(np.float32)):
        points = [[11.5, 9.25], [20, 20]]
        warped = warp_by_landmarks(image, points, points)
        assert warped.image.dtype == image.dtype
        assert warped.image == pytest.approx(image, abs=1e-5)
        empty = warp_by_landmarks(image, [], np.empty((0, 2)))
        assert empty.image == pytest.approx(image, abs=1e-5)


def test_a_moved_boundary():
    points, F = surfaces.grid(10, 10)
    upper = np.flatnonzero(points[:, 1] == 1)
    lifted = np.stack([points[upper, 0], 1 - 0.4 * np.sin(np.pi * points[upper, 0])], axis=1)
    moved = morph(points, F, upper, lifted)
    image = np.tile(np.arange(1, 65, dtype=np.int16), (64, 1))
    drawn = warp_along(image, points * 63, F, moved.points * 63)
    assert drawn.dtype == np.int16
    # What was pushed away is empty, the rest is not, and the lower side is as it was.
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


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(30, 1000), (1000, 30)])
def test_narrow_pictures_leave_a_way(shape):
    size = np.array(shape[::-1]) - 1.0
    along = np.where(size > 100, 0.2, 0.1)
    warped = warp_by_landmarks(np.zeros(shape, np.uint8), [0.5 * size], [(0.5 + along) * size])
    assert warped.result.certificate.bijective
    assert warped.moved[-1] == pytest.approx((0.5 + along) * size)


@pytest.mark.slow
def test_landmarks_on_the_border_take_it_along():
    image = np.tile(np.arange(1, 65, dtype=np.int16), (64, 1))
    # The lower side bends up, the right upper corner comes in; the left side stays.
    before = [[31.5, 63], [63, 0], [20, 20]]
    after = [[31.5, 40], [50, 5], [22, 20]]
    warped = warp_by_landmarks(image, before, after)
    assert warped.result.certificate.bijective
    for start, end in zip(before, after, strict=True):
        assert warped.moved[(warped.points == start).all(axis=1)].tolist() == [end]
    left = warped.points[:, 0] == 0
    assert np.array_equal(warped.moved[left], warped.points[left])
    # Straight from the corner, which stays, to the landmark.
    lower = (warped.points[:, 1] == 63) & (warped.points[:, 0] <= 31.5)
    assert warped.moved[lower, 1] == pytest.approx(63 - 23 * warped.points[lower, 0] / 31.5)
    assert warped.moved[lower, 0] == pytest.approx(warped.points[lower, 0])
    assert (warped.image[50:, 24:40] == 0).all()
    assert (warped.image[:, 0] == image[:, 0]).all()
    with pytest.raises(ValueError, match="crosses itself"):
        warp_by_landmarks(image, [[31.5, 63]], [[31.5, -10]])


@pytest.mark.parametrize("shape", [None, (300, 500)])
def test_filled_triangles_are_as_located_ones(shape, monkeypatch):
    rng = np.random.default_rng(2)
    image = rng.normal(size=(200, 300))
    points, F = surfaces.grid(4, 4)
    upper = np.flatnonzero(points[:, 1] == 1)
    moved = morph(points, F, upper, points[upper] + [0.1, -0.2]).points
    size = (299, 199)
    quick = warp_along(image, points * size, F, moved * size, shape=shape)
    monkeypatch.setattr("quasiharmonic.apply.warping.LARGE", np.inf)
    slow = warp_along(image, points * size, F, moved * size, shape=shape)
    assert np.array_equal(quick == 0, slow == 0)
    assert quick == pytest.approx(slow, abs=1e-9)


def test_points_without_a_place_are_named():
    points = np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]])
    lost = points.copy()
    lost[2, 1] = np.nan
    for before, after, message in ((lost, points, "points is not finite at vertex 2"), (points, lost, "moved is not")):
        with pytest.raises(ValueError, match=message):
            warp_along(np.zeros((4, 4)), before, [[0, 1, 2], [0, 2, 3]], after)


@pytest.mark.slow
def test_a_warp_that_cannot_be_says_what_to_do():
    with pytest.raises(RuntimeError, match="Move them less far"):
        warp_by_landmarks(np.zeros((50, 50)), [[31.5, 49], [20, 20]], [[31.5, 30], [31.5, 40]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros(5), [[1, 1]], [[1, 1]]), "image must have shape"),
        ((np.zeros((9, 9), complex), [[1, 1]], [[1, 1]]), "real numbers"),
        ((np.zeros((9, 9)), [[1, 1, 1]], [[1, 1]]), r"landmarks must have shape \(n, 2\)"),
        ((np.zeros((9, 9)), [[1, 1]], [[1, 8]]), "moved: point 0 not inside"),
        ((np.zeros((9, 9)), [[1, np.nan]], [[1, 1]]), "landmarks is not finite at point 0"),
        (
            (np.zeros((9, 9)), [[1, 1], [1, 1]], [[1, 1], [2, 2]]),
            r"landmarks: points 0, 1 are at the same place, \(1.0, 1.0\)",
        ),
        ((np.zeros((9, 9)), [[1, 1]], [[1, 1], [2, 2]]), "as many rows"),
    ],
)
def test_wrong_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        warp_by_landmarks(*arguments)


@pytest.mark.parametrize("shape", [(0, 5), (5, -1)])
def test_pictures_without_extent(shape):
    V, F = surfaces.grid(3, 3)
    with pytest.raises(ValueError, match=rf"shape must be positive, not \({shape[0]}, {shape[1]}\)"):
        warp_along(np.zeros((9, 9)), V, F, V, shape=shape)


def test_a_map_with_folds_is_refused():
    points = np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]])
    with pytest.raises(ValueError, match="no inverse"):
        warp_along(np.zeros((4, 4)), points, [[0, 1, 2], [0, 2, 3]], points[::-1])
