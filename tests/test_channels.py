"""Several texture coordinates of one mesh: each channel is written beside the others, and read again."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from quasiharmonic import io
from quasiharmonic.surfaces import starfish
from shared.commands import run
from shared.gltf_files import SQUARE, Gltf, opened, square


@pytest.fixture
def model(tmp_path):
    """A starfish with a map that overlaps itself, as GLB; returns its path."""
    V, F = starfish(3, 12)
    io.write_map(tmp_path / "model.glb", io.MeshData(V, F), V[:, :2])
    return tmp_path / "model.glb"


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".ply"])
def test_unwrap_writes_a_second_channel_and_keeps_the_first(model, tmp_path, suffix):
    out, report = tmp_path / f"out{suffix}", tmp_path / "report.json"
    assert run("unwrap", model, "-o", out, "--resolution", 128, "--channel", 1, "--json", report) == 0
    assert json.loads(report.read_text())["success"] is True
    before, after = io.read_mesh(model), io.read_mesh(out)
    assert np.array_equal(before.corner_uv, after.corner_uv)
    second = io.select_channel(after, 1)
    assert np.array_equal(second.lower_maps[0], before.corner_uv)
    assert not np.array_equal(second.corner_uv, before.corner_uv)
    # Written again, both are where they were.
    again = tmp_path / f"again{suffix}"
    io.write_mapped(again, second)
    assert np.array_equal(io.select_channel(io.read_mesh(again), 1).corner_uv, second.corner_uv)
    assert np.array_equal(io.read_mesh(again).corner_uv, before.corner_uv)
    # The seams of the second channel are kept in the first one.
    seamed = ["--keep-seams", "--seams-channel", 1]
    assert run("unwrap", out, "-o", tmp_path / f"kept{suffix}", "--resolution", 128, *seamed) == 0
    kept = io.read_mesh(tmp_path / f"kept{suffix}")
    assert len(kept.vt) == len(np.unique(np.column_stack([second.F.ravel(), second.corner_uv.reshape(-1, 2)]), axis=0))


def test_the_attributes_of_a_glb_file(model, tmp_path):
    assert run("unwrap", model, "-o", tmp_path / "out.glb", "--resolution", 128, "--channel", 1) == 0
    tree, _ = opened((tmp_path / "out.glb").read_bytes())
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    assert {"POSITION", "TEXCOORD_0", "TEXCOORD_1"} <= set(attributes)
    assert len({tree["accessors"][k]["count"] for k in attributes.values()}) == 1
    assert run("unwrap", tmp_path / "out.glb", "-o", tmp_path / "third.glb", "--resolution", 128, "--channel", 2) == 0
    third = io.read_mesh(tmp_path / "third.glb")
    for k in range(2):
        one, other = (io.select_channel(mesh, k).corner_uv for mesh in (io.read_mesh(tmp_path / "out.glb"), third))
        assert np.array_equal(one, other)
    (shown,) = trimesh.load(tmp_path / "out.glb").geometry.values()
    first = io.read_mesh(tmp_path / "out.glb")
    assert np.allclose(np.sort(shown.visual.uv[shown.faces], axis=None), np.sort(first.corner_uv, axis=None))


def test_a_model_of_another_format_and_polygons(tmp_path):
    """A cube of six quadrilaterals with texture coordinates, from OBJ."""
    cube = trimesh.creation.box()
    corners = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in cube.vertices.tolist()]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += ["f " + " ".join(f"{v + 1}/{k + 1}" for k, v in enumerate(face)) for face in corners]
    (tmp_path / "cube.obj").write_text("\n".join(lines) + "\n")
    before = io.read_mesh(tmp_path / "cube.obj")
    for suffix in (".ply", ".glb"):
        out = tmp_path / f"out{suffix}"
        assert run("unwrap", tmp_path / "cube.obj", "-o", out, "--resolution", 64, "--channel", 1) == 0
        after = io.read_mesh(out)
        assert np.array_equal(after.corner_uv, before.corner_uv)
        assert not np.isnan(io.select_channel(after, 1).corner_uv).any()
    assert io.read_mesh(tmp_path / "out.ply").faces == 6


def test_tangents_stay_because_they_belong_to_the_first_channel(tmp_path):
    tangents = np.tile(np.array([1, 0, 0, 1], dtype="f4"), (4, 1))
    (tmp_path / "in.glb").write_bytes(square(TEXCOORD_0=SQUARE[:, :2], TANGENT=tangents).glb())
    for channel, kept in ((1, True), (0, False)):
        call = ["unwrap", tmp_path / "in.glb", "-o", tmp_path / "out.glb", "--resolution", 64]
        assert run(*call, "--channel", channel) == 0
        tree, _ = opened((tmp_path / "out.glb").read_bytes())
        assert ("TANGENT" in tree["meshes"][0]["primitives"][0]["attributes"]) is kept


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["out.obj", "--channel", 1], "cannot store several texture coordinates"),
        (
            ["out.glb", "--channel", 2],
            "give a channel of the file (the first is 0), or write channel 1 first",
        ),
        (["out.glb", "--keep-seams", "--seams-channel", 1], "has no texture coordinates 1"),
        (["out.glb", "--seams-channel", 1], "--seams-channel needs --keep-seams: add --keep-seams, or omit"),
        (["out.glb", "--channel", 1, "--texture", "checkerboard"], "omit --bake and --texture"),
    ],
)
def test_wrong_calls(model, monkeypatch, capfd, options, words):
    monkeypatch.chdir(model.parent)
    assert run("unwrap", "model.glb", "-o", *options) == 2
    assert words in capfd.readouterr().err
    assert not list(model.parent.glob("out*"))


def test_channels_that_cannot_be_written(model, tmp_path):
    mesh = io.read_mesh(model)
    second = replace(mesh, lower_maps=(mesh.corner_uv,))
    with pytest.raises(io.MeshFileError, match="cannot store several"):
        io.write_mapped(tmp_path / "out.obj", second)
    with pytest.raises(ValueError, match="two texture coordinates at most"):
        io.write_mapped(tmp_path / "out.ply", replace(second, lower_maps=2 * second.lower_maps))
    bare = io.MeshData(mesh.V, mesh.F)
    with pytest.raises(io.MeshFileError, match="has no texture coordinates 0 in triangles 0, 1, 2"):
        io.place_map(bare, bare, 1)
    with pytest.raises(io.MeshFileError, match="has no texture coordinates 1"):
        io.select_channel(bare, 1)


def test_meshes_without_coordinates_get_the_new_ones_below(tmp_path):
    made = Gltf()
    V, F = starfish(2, 12)
    corners = made.accessor(F.ravel().astype("u2"))
    first = (0.4 + 0.2 * V[:, :2]).astype("f4")
    made.mesh(
        {
            "attributes": {"POSITION": made.accessor(V.astype("f4")), "TEXCOORD_0": made.accessor(first)},
            "indices": corners,
        }
    )
    made.mesh({"attributes": {"POSITION": made.accessor((V + 3).astype("f4"))}, "indices": corners})
    source, out = tmp_path / "in.glb", tmp_path / "out.glb"
    source.write_bytes(made.glb())
    assert run("unwrap", source, "--channel", 1, "--resolution", 256, "-o", out) == 0
    before, after = io.read_mesh(source), io.read_mesh(out)
    second = io.select_channel(after, 1).corner_uv
    assert np.isfinite(second).all()
    half = len(F)
    np.testing.assert_array_equal(after.corner_uv[:half], before.corner_uv[:half])
    np.testing.assert_array_equal(after.corner_uv[half:], second[half:])
