"""Folds of displacement fields on voxels with trilinear interpolation: a sufficient test by Bernstein coefficients."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from math import comb

import numpy as np
import pytest

from quasiharmonic.apps.displacement_fields.nearest import fold_free, least_coefficients
from quasiharmonic.apps.displacement_fields.nearest_voxels import VoxelGrid
from quasiharmonic.ui.cli import main


def determinant(corners, x, y, z):
    """The Jacobian determinant of the trilinear map of a cell, exactly; corners (z, y, x, 3) are fractions."""
    columns = []
    for axis in range(3):
        column = [Fraction(0)] * 3
        for k, j, i in product(range(2), repeat=3):
            bits, at = (i, j, k), (x, y, z)
            weight = Fraction(1)
            for other in range(3):
                one = at[other] if bits[other] else 1 - at[other]
                weight *= (1 if bits[other] else -1) if other == axis else one
            column = [c + weight * p for c, p in zip(column, corners[k][j][i], strict=True)]
        columns.append(column)
    (a, b, c), (d, e, f), (g, h, i) = columns
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def random_cell(seed, size):
    return size * np.random.default_rng(seed).normal(size=(2, 2, 2, 3))


@pytest.mark.parametrize("seed", range(6))
def test_the_least_coefficient_is_that_of_interpolation(seed):
    """Values at 27 points determine the polynomial, and the coefficients follow from a linear system."""
    field = random_cell(seed, 0.4)
    spacing = np.array([1.0, 0.5, 2.0])
    grid = VoxelGrid(field.shape[:3], spacing)
    exact = [[[[Fraction(float(v)) for v in p] for p in row] for row in plane] for plane in grid.positions(field)]
    nodes = [Fraction(0), Fraction(1, 2), Fraction(1)]
    values = np.array([[[float(determinant(exact, x, y, z)) for x in nodes] for y in nodes] for z in nodes])
    basis = np.array([[comb(2, m) * float(t) ** m * float(1 - t) ** (2 - m) for m in range(3)] for t in nodes])
    inverse = np.linalg.inv(basis)
    coefficients = np.einsum("am,bn,cp,mnp->abc", inverse, inverse, inverse, values) / np.prod(spacing)
    assert least_coefficients(grid, field)[0, 0, 0] == pytest.approx(coefficients.min(), abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_certified_cells_have_no_fold_at_any_sample(seed):
    field = random_cell(seed, 0.25)
    exact = VoxelGrid(field.shape[:3], 1.0).positions(field).tolist()
    exact = [[[[Fraction(v) for v in p] for p in row] for row in plane] for plane in exact]
    least = min(
        determinant(exact, Fraction(x, 6), Fraction(y, 6), Fraction(z, 6)) for x, y, z in product(range(7), repeat=3)
    )
    if fold_free(field, interpolation="trilinear").all():
        assert least > 0
    # A cell with a fold at a corner is never certified.
    folded = field.copy()
    folded[0, 0, 0, 0] += 3
    assert not fold_free(folded, interpolation="trilinear").any()


def test_tetrahedra_may_be_positive_where_the_trilinear_map_folds():
    found = [random_cell(seed, 0.35) for seed in range(300)]
    linear = np.array([fold_free(field).all() for field in found])
    trilinear = np.array([fold_free(field, interpolation="trilinear").all() for field in found])
    assert (linear & ~trilinear).any()
    assert trilinear.any()
    with pytest.raises(ValueError, match="interpolation must be one of"):
        fold_free(found[0], interpolation="cubic")
    with pytest.raises(ValueError, match="only to volumes"):
        fold_free(np.zeros((4, 4, 2)), interpolation="trilinear")


def test_cells_of_fixed_voxels_are_named(tmp_path, capsys):
    field = np.zeros((4, 4, 2, 3))
    # All voxels of two slices are on the border.
    field[1, 2, 1, 0] = -1.5
    np.save(tmp_path / "in.npy", field)
    assert main(["field", str(tmp_path / "in.npy"), "-o", str(tmp_path / "out.npy"), "--fix-border"]) == 2
    said = capsys.readouterr().err
    assert "All eight voxels of some of these cells are fixed; the first of each is voxels (0, 1, 0)" in said


@pytest.mark.slow
def test_the_command_verifies_the_interpolation(tmp_path, capsys):
    z, y, x = np.mgrid[:8, :8, :8]
    field = np.zeros((8, 8, 8, 3))
    field[..., 0] = 2.5 * np.exp(-((x - 3) ** 2 + (y - 4) ** 2 + (z - 4) ** 2) / 3)
    np.save(tmp_path / "in.npy", field)
    command = ["field", str(tmp_path / "in.npy"), "-o", str(tmp_path / "out.npy"), "--interpolation", "trilinear"]
    for bound in ("0.001", "0.3"):
        status = main([*command, "--min-jacobian", bound])
        said = capsys.readouterr()
        if status == 0:
            assert fold_free(np.load(tmp_path / "out.npy"), interpolation="trilinear").all()
        else:
            assert status == 2
            assert "may fold with trilinear interpolation" in said.err
            assert not (tmp_path / "out.npy").exists()
    assert status == 0
