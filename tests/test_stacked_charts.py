"""Mirror images on top of each other: ``stack="mirrored"`` of `unwrap`."""

from __future__ import annotations

import numpy as np
import pytest

import hard_models as models
from quasiharmonic import io, unwrap
from quasiharmonic.atlas import pack_charts
from quasiharmonic.surfaces import annulus
from shared.commands import run
from shared.meshes import lift


@pytest.fixture(scope="module")
def model():
    """Two identical components and their mirror images in x."""
    points, triangles = annulus(4)
    points = lift(points) + np.array([3, 0, 0])
    count = len(points)
    points = np.concatenate([points, points + np.array([0, 7, 3])])
    V = np.concatenate([points, points * [-1, 1, 1]])
    turned = triangles[:, ::-1]
    return V, np.concatenate([triangles, triangles + count, turned + 2 * count, turned + 3 * count])


def places(result):
    """The number of charts that lie at places of their own."""
    centres = [result.uvs[np.unique(result.indices[result.charts == k])].mean(axis=0) for k in range(result.n_charts)]
    return len(np.unique(np.round(centres, 5), axis=0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "axis", "copies"), [(False, "x", 1), ("mirrored", "x", 2), (True, "x", 4), ("mirrored", None, 1)]
)
def test_only_mirror_images_are_stacked(model, stack, axis, copies):
    result = unwrap(*model, resolution=256, max_stretch=3, stack=stack, symmetry=axis)
    assert result.success
    assert result.symmetry.applied == (axis == "x")
    assert places(result) * copies == result.n_charts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "count"),
    [
        ((), 4),
        (("--stack",), 1),
        (("--stack", "mirrored"), 2),
        (("--stack", "mirrored", "--symmetry", "none"), 4),
    ],
)
def test_command_line(model, tmp_path, words, count, capsys):
    io.write_obj(tmp_path / "in.obj", io.MeshData(*model))
    call = ("unwrap", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--resolution", 256, "--max-stretch", 3)
    assert run(*call, *words) == 0
    assert ("--stack mirrored has no effect" in capsys.readouterr().out) == ("none" in words)
    written = io.read_mesh(tmp_path / "out.obj")
    size = len(written.F) // 4
    centres = [written.vt[np.unique(written.FT[k * size : (k + 1) * size])].mean(axis=0) for k in range(4)]
    assert len(np.unique(np.round(centres, 5), axis=0)) == count


def test_walls_of_one_component_are_apart_and_those_of_another_lie_on_them():
    box = np.array([[x, y, z] for x in (0, 1.0) for y in (0, 1.0) for z in (0, 1.0)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    F = np.concatenate([quads[:, :3], quads[:, (0, 2, 3)]])
    options = {"stack": True, "symmetry": None, "hard_edges": 30, "resolution": 256}
    alone = unwrap(box, F, **options)
    assert (alone.n_charts, places(alone)) == (6, 6)
    longer = np.add(box, [5, 0, 0]) * [1, 1, 2]
    three = (
        np.concatenate([box, np.add(box, [2, 0, 0])[:, ::-1] * [-1, 1, 1], longer]),
        np.concatenate([F, F + 8, F + 16]),
    )
    together = unwrap(*three, **options)
    # Faces of another solid are not those of identical components, although they are congruent.
    assert (together.n_charts, places(together)) == (18, 12)


def test_bad_input_is_named(model):
    with pytest.raises(ValueError, match="stack must be True, False or 'mirrored', not 'both'"):
        unwrap(*model, stack="both")
    square = np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]])
    with pytest.raises(ValueError, match="kinds must have 2 numbers, one per chart, not 1"):
        pack_charts([square, square], kinds=[0])


def test_charts_of_different_kinds_are_apart():
    square = np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]])
    packing = pack_charts([square] * 3, resolution=64, stack=True, kinds=[0, 1, 0])
    np.testing.assert_allclose(packing.uv[0], packing.uv[2])
    assert np.abs(packing.uv[0] - packing.uv[1]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("option", ["stack", "tile_by", "mirrored"])
def test_charts_are_chosen_for_the_texture_of_one_copy(option):
    V, F = models.box(1, 2, 3, times=3)
    alone = unwrap(V, F, resolution=512, symmetry=None)
    if option == "mirrored":
        V = V + np.array([5, 0, 0])
        images = [(V, F), (V * [-1, 1, 1], F[:, ::-1])]
        options = {"stack": "mirrored", "symmetry": "x"}
    else:
        images = [(V + np.array([5 * k, 0, 0]), F) for k in range(6)]
        options = {option: True if option == "stack" else np.repeat(range(6), len(F)), "symmetry": None}
    points = np.concatenate([points for points, _ in images])
    triangles = np.concatenate([triangles + k * len(V) for k, (_, triangles) in enumerate(images)])
    result = unwrap(points, triangles, resolution=512, **options)
    assert result.texels_per_unit > 0.96 * alone.texels_per_unit
