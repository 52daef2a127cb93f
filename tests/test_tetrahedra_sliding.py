"""Boundary vertices of tetrahedral meshes that slide along planes and straight edges."""

import json
from functools import cache
from pathlib import Path

import meshlane
import numpy as np
import pytest

from quasiharmonic import BoundaryCurves, MovingMesh, certify_tetrahedra, morph
from quasiharmonic.apps.tetrahedra.descent import ShapeEnergy
from quasiharmonic.apps.tetrahedra.result import TetrahedraStatus
from quasiharmonic.io.fem.files import read_volume
from quasiharmonic.ui.cli import main
from shared.tetrahedral_meshes import box, sphere_points

WALLS = np.array([[1, 0, 0, 0], [1, 0, 0, 1], [0, 1, 0, 0], [0, 1, 0, 1.0]])


def cube(k=4):
    """A cube with jittered inner vertices, and the vertices of its top."""
    X, T = box(k, k, k)
    inner = (X > 0).all(axis=1) & (X < 1).all(axis=1)
    X[inner] += 0.2 / k * np.random.default_rng(0).uniform(-1, 1, (inner.sum(), 3))
    return X, T, np.flatnonzero(X[:, 2] == 1)


def rotation():
    return np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]


@pytest.mark.slow
def test_walls_follow_a_piston_only_if_they_slide():
    X, T, top = cube()
    target = X[top] - (0, 0, 0.9)
    assert morph(X, T, top, target).status is TetrahedraStatus.CROSSING
    for slide in (True, WALLS):
        result = morph(X, T, top, target, slide=slide)
        assert result.success
        assert result.status is TetrahedraStatus.POLISHED
        np.testing.assert_array_equal(result.points[top], target)
        # Every vertex stays on its planes and edges to the last bit.
        for axis in range(3):
            for side in (0, 1) if axis < 2 else (0,):
                on = X[:, axis] == side
                assert (result.points[on, axis] == side).all()
        corners = ((X == 0) | (X == 1)).all(axis=1) & (X[:, 2] == 0)
        np.testing.assert_array_equal(result.points[corners], X[corners])
        bottom = X[:, 2] == 0
        assert (result.points[bottom] == X[bottom]).all() == (slide is not True)


@pytest.mark.slow
def test_sliding_does_not_depend_on_the_orientation_of_the_mesh():
    X, T, top = cube()
    target = X[top] - (0, 0, 0.5)
    Q = rotation()
    plain = morph(X, T, top, target, slide=True)
    turned = morph(X @ Q.T, T, top, target @ Q.T, slide=True)
    assert turned.success
    np.testing.assert_allclose(turned.points @ Q, plain.points, atol=1e-6)
    on = (X == 0) | (X == 1)
    np.testing.assert_allclose((turned.points @ Q)[:, :2][on[:, :2]], X[:, :2][on[:, :2]], atol=1e-14)


@pytest.mark.slow
def test_the_energy_is_minimal_along_the_walls():
    """With sliding walls the energy is lower, and no small motion of one sliding vertex lowers it further."""
    X, T, top = cube(3)
    x, y, z = X[top].T
    target = np.stack([x, y, z - 0.3 * np.sin(np.pi * x) * np.sin(np.pi * y)], axis=1)
    fixed = morph(X, T, top, target)
    result = morph(X, T, top, target, slide=True, tol=1e-12)
    assert result.energy < fixed.energy
    wall = np.flatnonzero((X[:, 0] == 0) & (X[:, 2] < 1) & (X[:, 1:] > 0).all(axis=1) & (X[:, 1] < 1))
    assert wall.size
    energy = ShapeEnergy(T, X)
    for vertex in wall:
        for axis in (1, 2):
            for step in (-1e-3, 1e-3):
                there = result.points.copy()
                there[vertex, axis] += step
                assert energy.value(there, 0.0) > energy.value(result.points, 0.0)


def test_vertices_of_a_curved_boundary_are_fixed():
    from scipy.spatial import Delaunay

    X = np.concatenate([sphere_points(60), [(0, 0, 0.1), (0.3, 0, 0)]])
    T = Delaunay(X).simplices
    result = morph(X, T, [60], [(0.2, 0.2, 0.2)], slide=True)
    assert result.success
    np.testing.assert_array_equal(result.points[:60], X[:60])


@pytest.mark.slow
def test_a_mesh_moved_in_steps_slides():
    X, T, top = cube()
    mesh = MovingMesh(X, T, top, slide=True)
    for depth in np.arange(0.1, 0.95, 0.1):
        mesh.advance(X[top] - (0, 0, depth))
    assert certify_tetrahedra(mesh.F, mesh.points).injective
    assert (mesh.points[X[:, 0] == 0, 0] == 0).all()


def test_an_initial_mesh_is_brought_onto_the_walls():
    X, T, top = cube()
    result = morph(X, T, top, X[top] - (0, 0, 0.5), slide=WALLS, start=X + 0.1)
    assert result.success
    assert (result.points[X[:, 0] == 0, 0] == 0).all()


@pytest.mark.parametrize("shift", [0, (3, -2, 7), (30, -20, 70)])
def test_oblique_walls_in_single_precision_slide(shift):
    X, T, top = cube()
    Y = (X @ rotation().T + shift).astype(np.float32)
    target = ((X[top] - (0, 0, 0.5)) @ rotation().T + shift).astype(np.float32)
    result = morph(Y, T, top, target, slide=True)
    assert result.success
    assert result.sliding.size == morph(X, T, top, X[top], slide=True).sliding.size


def test_on_a_thin_body_only_the_named_side_slides():
    X, T, _ = cube()
    thin = X * (1, 1, 1e-7)
    inner = np.flatnonzero((X[:, :2] == 0.5).all(axis=1) & (X[:, 2] == 0.5))
    result = morph(thin, T, inner, thin[inner], slide=[[0, 0, 1, 0]])
    bottom = (X[:, 2] == 0) & (X[:, :2] > 0).all(axis=1) & (X[:, :2] < 1).all(axis=1)
    np.testing.assert_array_equal(result.sliding, np.flatnonzero(bottom))


@cache
def pressed():
    X, T, top = cube()
    return morph(X, T, top, X[top] - (0, 0, 0.5), slide=WALLS)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-150, 1e150])
def test_planes_at_any_scale(scale):
    X, T, top = cube()
    planes = WALLS * (1, 1, 1, scale)
    result = morph(X * scale, T, top, (X[top] - (0, 0, 0.5)) * scale, slide=planes)
    assert result.success
    np.testing.assert_allclose(result.points / scale, pressed().points, atol=1e-6)


def test_malformed_planes():
    X, T, top = cube()
    for slide, message in (
        ([1.0, 0, 0, 0], r"planes of shape \(m, 4\), not of shape \(4,\)"),
        ([[0, 0, 0, 1.0]], "no direction in plane 0"),
        ([[1, 0, 0, 0], [1, 0, 0, 7.0]], "plane 1, .*no boundary triangle lies on it"),
        ([[1, 0, 0, np.nan]], "slide is not finite at plane 0"),
        ("x", "slide"),
        (None, "slide"),
        (BoundaryCurves(X[top[:3], :2]), "not BoundaryCurves"),
    ):
        with pytest.raises(ValueError, match=message):
            morph(X, T, top, X[top], slide=slide)
    with pytest.raises(ValueError, match="slide must be a bool or BoundaryCurves for planar meshes"):
        morph(X[top, :2], [[0, 1, 2]], [0], X[:1, :2], slide=WALLS)


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--slide"], [f for w in WALLS for f in ("--slide-plane", *map(str, w))]])
def test_qhm_morph_slides(options, tmp_path, capsys):
    X, T, top = cube()
    displacement = np.zeros_like(X)
    displacement[top, 2] = -0.9
    path, out = tmp_path / "mesh.vtu", tmp_path / "moved.vtu"
    meshlane.write(path, meshlane.Mesh(X, [("tetra", T)], point_data={"u": displacement}))
    assert main(["morph", str(path), "--field", "u", *options, "-o", str(out)]) == 0
    expected = morph(X, T, top, X[top] + displacement[top], slide=True if options == ["--slide"] else WALLS)
    np.testing.assert_array_equal(read_volume(out).points, expected.points)
    assert main(["morph", str(path), "--field", "u", "--slide", "--slide-plane", *"1000", "-o", str(out)]) == 2
    assert "--slide includes all planes" in capsys.readouterr().err
    plane = ["--slide-plane", "1", "0", "0", "-1e-9"]
    assert main(["morph", str(path), "--field", "u", *plane, "-o", str(out)]) == 1
    assert "9 boundary vertices could slide" in capsys.readouterr().out


def test_qhm_morph_reports_the_opposite_order_of_vertices(tmp_path, capsys):
    X, T, _ = cube()
    T[::3] = T[::3, [1, 0, 2, 3]]
    path, out, report = (str(tmp_path / name) for name in ("mesh.vtu", "moved.vtu", "report.json"))
    meshlane.write(path, meshlane.Mesh(X, [("tetra", T)], point_data={"u": np.zeros_like(X)}))
    assert main(["morph", path, "--field", "u", "-o", out, "--json", report]) == 0
    count = len(T[::3])
    assert json.loads(Path(report).read_text(encoding="utf-8"))["reversed"] == count
    assert f"The file lists {count} tetrahedra in the opposite order" in capsys.readouterr().out
