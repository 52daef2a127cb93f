from fractions import Fraction

import numpy as np
import pytest

from quasiharmonic.geometry.exact.triangles import find_overlapping
from quasiharmonic.surfaces import disk, grid


def clipped_area(one, other):
    """Return the common area of two counterclockwise triangles, by clipping in fractions."""
    ring = [tuple(map(Fraction, p)) for p in one.tolist()]
    for (ax, ay), (bx, by) in zip(other.tolist(), np.roll(other, -1, axis=0).tolist(), strict=True):
        ax, ay, bx, by = map(Fraction, (ax, ay, bx, by))
        side = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in ring]
        kept = []
        for k, (here, s) in enumerate(zip(ring, side, strict=True)):
            there, t = ring[k - 1], side[k - 1]
            if (s > 0 > t) or (t > 0 > s):
                kept.append(tuple(a + (b - a) * s / (s - t) for a, b in zip(here, there, strict=True)))
            if s >= 0:
                kept.append(here)
        ring = kept
        if not ring:
            return Fraction(0)
    return sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(ring, ring[1:] + ring[:1], strict=True)) / 2


@pytest.mark.parametrize("grid", [0, 4])
def test_overlapping_triangles_have_an_intersection_with_area(grid):
    # On a coarse grid many triangles only touch, or have collinear sides.
    rng = np.random.default_rng(3)
    uv = rng.integers(0, grid + 1, (30, 3, 2)).astype(float) if grid else rng.normal(size=(30, 3, 2))
    uv *= 1 if grid else 0.3
    uv += 0 if grid else rng.normal(size=(30, 1, 2))
    a, b, c = uv.transpose(1, 0, 2)
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    uv[turn < 0] = uv[turn < 0][:, ::-1]
    uv = uv[turn != 0][:12]
    expected = [i for i in range(12) if any(clipped_area(uv[i], uv[j]) > 0 for j in range(12) if j != i)]
    assert 0 < len(expected) < 12 or grid
    assert find_overlapping(np.arange(36).reshape(-1, 3), uv.reshape(-1, 2)).tolist() == expected


def test_a_bijective_map_has_no_overlap():
    V, F = disk(6)
    assert find_overlapping(F, V).size == 0


def test_both_ends_of_a_band_with_one_and_a_half_turns_are_found():
    V, F = grid(30, 2)
    angle, radius = 3 * np.pi * V[:, 0], 2 - V[:, 1]
    uv = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    column = V[F][..., 0].min(axis=1) * 30 + 1e-9
    found = np.zeros(len(F), dtype=bool)
    found[find_overlapping(F, uv)] = True
    ends = (column < 10) | (column > 20)
    # At the ends, rounding decides.
    inside = (column > 11) & (column < 19)
    assert found[ends].all()
    assert not found[inside].any()
