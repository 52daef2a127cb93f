"""Displacement fields on voxels: folds, repair, inverses."""

from functools import cache
from itertools import permutations

import numpy as np
import pytest

from quasiharmonic import certify_tetrahedra, inverse_field, nearest_invertible
from quasiharmonic.apps.displacement_fields.nearest_voxels import VoxelGrid, find_folded_cells
from shared.exact_space import determinant, exact
from shared.tetrahedral_meshes import folded_volume


def folds_exactly(field, spacing):
    """Whether each cell folds, in rational numbers, for the positions as stored."""
    shape = field.shape[:3]
    points = VoxelGrid(shape, spacing).positions(field)
    folds = np.zeros([count - 1 for count in shape], dtype=bool)
    for z, y, x in np.ndindex(folds.shape):
        for order in permutations(range(3)):
            corner = np.array([z, y, x])
            path = [points[tuple(corner)]]
            for axis in order:
                corner[2 - axis] += 1
                path.append(points[tuple(corner)])
            sign = round(np.linalg.det(np.eye(3)[list(order)]))
            folds[z, y, x] |= sign * determinant(exact(path)) <= 0
    return folds


@cache
def mended():
    """The result for a small volume, in voxels."""
    result = nearest_invertible(folded_volume(12, 1))
    result.field.setflags(write=False)
    return result


@pytest.mark.slow
def test_folds_agree_with_rational_numbers():
    rng = np.random.default_rng(0)
    for trial in range(12):
        field = rng.integers(-1, 2, (3, 3, 4, 3)) * rng.choice([0.5, 1.0, 1 + 2.0**-50])
        spacing = (1.0, 0.5, 2.0) if trial % 2 else 1.0
        if trial % 3 == 0:
            field, spacing = 1e-150 * field, 1e-150 * np.array(spacing)
        found = find_folded_cells(VoxelGrid(field.shape[:3], spacing), field, None)
        np.testing.assert_array_equal(found, folds_exactly(field, spacing))


@pytest.mark.slow
def test_folds_are_mended_and_nothing_else_changes():
    field = folded_volume(24, 4)
    repaired = nearest_invertible(field)
    assert repaired.folds > 10
    assert repaired.success
    assert repaired.bijective
    assert repaired.patches == 4
    assert not folds_exactly(repaired.field[:8, :8, :8], 1.0).any()
    np.testing.assert_array_equal(repaired.field[~repaired.moved_mask], field[~repaired.moved_mask])
    assert 0 < repaired.moved_mask.mean() < 0.05
    # All determinants are above the bound, and a field without folds is unchanged.
    assert not find_folded_cells(VoxelGrid(field.shape[:3], 1.0), repaired.field, 0.0099).any()
    again = nearest_invertible(repaired.field, min_jacobian=0.005)
    np.testing.assert_array_equal(again.field, repaired.field)
    assert again.folds == 0
    # The tetrahedra of all cells are a valid mesh.
    grid = VoxelGrid(field.shape[:3], 1.0)
    cells = np.ravel_multi_index(np.indices((23, 23, 23)).reshape(3, -1), field.shape[:3])
    points = grid.positions(repaired.field).reshape(-1, 3)
    assert certify_tetrahedra(grid.tetrahedra(cells), points).injective


@pytest.mark.slow
def test_the_distance_is_close_to_the_least():
    """One voxel moved through its neighbour: it returns to where the determinant is the bound."""
    field = np.zeros((5, 5, 5, 3))
    field[2, 2, 2, 0] = 1.5
    repaired = nearest_invertible(field, fixed=np.arange(125).reshape(5, 5, 5) != 62)
    assert repaired.success
    assert repaired.moved_mask.sum() == 1
    assert repaired.field[2, 2, 2] == pytest.approx((0.99, 0, 0), abs=0.05)


@pytest.mark.slow
def test_the_spacing_scales_the_field():
    field = folded_volume(12, 1)
    plain, scaled = mended(), nearest_invertible(1e-3 * field, spacing=1e-3)
    np.testing.assert_allclose(1e3 * scaled.field, plain.field, atol=1e-3)
    assert scaled.folds == plain.folds


@pytest.mark.slow
def test_the_inverse_returns_to_every_voxel():
    _, y, x = np.indices((12, 12, 12)) / 12
    field = 0.8 * np.stack([np.sin(3 * y), np.cos(2 * x), np.sin(2 * x + 3 * y)], axis=-1) * (1, 2, 3)
    back = inverse_field(field, spacing=(1, 2, 3))
    assert 0 < back.outside.mean() < 0.4
    grid = VoxelGrid((12, 12, 12), (1, 2, 3))
    cells = np.ravel_multi_index(np.indices((11, 11, 11)).reshape(3, -1), (12, 12, 12))
    rest, moved = (grid.positions(some).reshape(-1, 3) for some in (0 * field, field))
    T = grid.tetrahedra(cells)
    source = grid.positions(back.field).reshape(-1, 3)
    rng = np.random.default_rng(0)
    for voxel in rng.choice(np.flatnonzero(~back.outside.ravel()), 40, replace=False):
        # Map the source forward by the tetrahedron that contains it.
        edges = (rest[T[:, 1:]] - rest[T[:, :1]]).swapaxes(1, 2)
        weights = np.linalg.solve(edges, (source[voxel] - rest[T[:, 0]])[..., None])
        weights = np.column_stack([1 - weights[..., 0].sum(axis=1), weights[..., 0]])
        best = weights.min(axis=1).argmax()
        np.testing.assert_allclose(weights[best] @ moved[T[best]], rest[voxel], atol=1e-9)
    shift = np.zeros((4, 4, 4, 3))
    shift[..., 0] = 1.0
    moved_back = inverse_field(shift)
    assert moved_back.outside[..., 0].all()
    np.testing.assert_allclose(moved_back.field[..., 1:, :], np.broadcast_to((-1.0, 0, 0), (4, 4, 3, 3)), atol=1e-12)


def test_bad_input():
    field = np.zeros((4, 4, 4, 3))
    with pytest.raises(ValueError, match="moveaxis"):
        nearest_invertible(np.zeros((3, 5, 5, 5)))
    with pytest.raises(ValueError, match="spacing must be a positive number, or three"):
        nearest_invertible(field, spacing=(1, 2))
    with pytest.raises(ValueError, match="fixed must be a bool array"):
        nearest_invertible(field, fixed=np.zeros((4, 4), dtype=bool))
    field[1, 2, 3] = np.nan
    with pytest.raises(ValueError, match=r"not finite at voxel \(1, 2, 3\)"):
        nearest_invertible(field)
    field[1, 2, 3] = 0.0, 9.0, 0.0
    with pytest.raises(ValueError, match="the field folds"):
        inverse_field(field)
    # Folds between fixed voxels stay and are reported.
    left = nearest_invertible(field, fixed=np.ones((4, 4, 4), dtype=bool))
    assert not left.success
    assert left.remaining.any()
    np.testing.assert_array_equal(left.field, field)


@pytest.mark.slow
def test_cells_below_the_bound_remain():
    field = np.zeros((6, 6, 6, 3))
    field[3, 5, 0, 2] = -0.5
    result = nearest_invertible(field, min_jacobian=0.9, fixed=np.ones((6, 6, 6), dtype=bool))
    assert result.folds == result.remaining.sum() > 0
    assert not result.success
    assert result.bijective
    assert nearest_invertible(field, min_jacobian=0.4).folds == 0


@pytest.mark.slow
@pytest.mark.parametrize("scale", [2.0**-500, 2.0**500])
def test_the_scale_of_a_volume_does_not_matter(scale):
    field = folded_volume(12, 1)
    plain, scaled = mended(), nearest_invertible(field * scale, spacing=scale)
    assert plain.folds > 0
    np.testing.assert_array_equal(scaled.field, plain.field * scale)
    assert scaled.distance == plain.distance * scale
    back = inverse_field(scaled.field, spacing=scale).field
    np.testing.assert_array_equal(back, inverse_field(plain.field).field * scale)


def test_the_inverse_of_a_field_with_tetrahedra_that_rounding_makes_singular():
    # The third coordinate rises by one unit in the last place, so all tetrahedra are positive. From the first voxel at
    # -1, the rise at 0 is rounded away.
    rise = np.array([[2.0**-52, 2.0**-53], [2.0**-53, 2.0**-52]])
    base = np.array([[-1.0, 0.0], [0.0, 1.0]])
    field = np.zeros((2, 2, 2, 3))
    field[..., 2] = base, base + rise - 1
    assert not find_folded_cells(VoxelGrid((2, 2, 2)), field, None).any()
    back = inverse_field(field)
    # Three voxels lie in the image, at positions of mapped voxels.
    assert np.argwhere(~back.outside).tolist() == [[0, 0, 1], [0, 1, 0], [1, 1, 1]]
    np.testing.assert_allclose(back.field[0, 0, 1], 0, atol=1e-9)
