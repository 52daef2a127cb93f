"""``qhm bake`` and ``qhm unwrap --bake``: files, reports and exit statuses."""

from __future__ import annotations

import json
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from quasiharmonic import io
from quasiharmonic.surfaces import grid, starfish
from shared.commands import run
from shared.gltf_files import opened


@pytest.fixture
def coloured(tmp_path):
    """A starfish with colours that are its positions, as PLY; returns its path."""
    V, F = starfish(3, 12)
    colours = np.rint(255 * (V - V.min(axis=0)) / np.ptp(V, axis=0)) / 255
    io.write_ply(tmp_path / "old.ply", io.MeshData(V, F, extra=colours))
    return tmp_path / "old.ply"


def test_unwrap_bakes_the_colours_of_vertices(coloured, tmp_path, capfd):
    out, report = tmp_path / "out.glb", tmp_path / "report.json"
    assert run("unwrap", coloured, "-o", out, "--resolution", 128, "--bake", "--json", report) == 0
    facts = json.loads(report.read_text())
    assert facts["success"] is True
    assert facts["bake"]["success"] is True
    assert facts["bake"]["same_mesh"] is True
    assert facts["bake"]["size"] == [128, 128]
    assert "Baked base colour at 128 x 128" in capfd.readouterr().out
    # The colours at the centres of triangles are their positions again.
    mesh = io.read_mesh(out)
    with Image.open(BytesIO(io.own_texture(mesh).data)) as image:
        pixels = np.asarray(image) / 255
    u, v = mesh.corner_uv.mean(axis=1).T
    shown = pixels[((1 - v) * 128).astype(int), (u * 128).astype(int)]
    V = mesh.V
    wanted = ((V - V.min(axis=0)) / np.ptp(V, axis=0))[mesh.F].mean(axis=1)
    assert np.median(np.abs(shown - wanted)) < 0.02


def test_bake_from_another_mesh_and_the_exit_status(coloured, tmp_path):
    V, F = starfish(2, 8)
    io.write_obj(tmp_path / "coarse.obj", io.MeshData(V, F))
    assert run("unwrap", tmp_path / "coarse.obj", "-o", tmp_path / "new.obj", "--resolution", 64) == 0
    call = ["bake", coloured, tmp_path / "new.obj", "--size", "64x32", "--json", tmp_path / "r.json", "-o"]
    assert run(*call, tmp_path / "out.obj", "--max-distance", 2) == 0
    facts = json.loads((tmp_path / "r.json").read_text())
    assert (facts["size"], facts["same_mesh"], facts["missing"]) == ([64, 32], False, 0)
    assert facts["new"] == str(tmp_path / "new.obj")
    with Image.open(tmp_path / "out-texture.png") as image:
        assert image.size == (64, 32)
    # With a small bound, texels between the two surfaces are missing.
    assert run(*call, tmp_path / "out.glb", "--max-distance", 1e-9, "--jpeg") == 1
    assert json.loads((tmp_path / "r.json").read_text())["missing"] > 0
    assert opened((tmp_path / "out.glb").read_bytes())[0]["images"][0]["mimeType"] == "image/jpeg"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["out.ply"], "cannot store an image"),
        (["out.glb", "--size", "9000"], "at most 8192"),
        (["new.obj", "--json", "new-texture.mtl"], "would replace another file"),
    ],
)
def test_wrong_calls_write_nothing(tmp_path, capfd, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    uv, F = grid(2, 2)
    io.write_map("old.obj", io.MeshData(uv, F), uv)
    before = sorted(tmp_path.iterdir())
    assert run("bake", "old.obj", "old.obj", "-o", *options) == 2
    assert words in capfd.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--texture", "checkerboard"], "omit --texture"),
        (["--tiles", 2], "omit --tiles"),
        (["--resolution", 9000], "at most 8192"),
    ],
)
def test_options_that_exclude_baking(coloured, tmp_path, capfd, options, words):
    assert run("unwrap", coloured, "-o", tmp_path / "out.glb", "--bake", *options) == 2
    assert words in capfd.readouterr().err
    assert not (tmp_path / "out.glb").exists()


def test_unwrap_says_that_a_texture_is_missing(tmp_path, capfd):
    V, F = starfish(2, 12)
    lines = [*(f"v {x} {y} {z}" for x, y, z in V), *(f"vt {x} {y}" for x, y, _ in 0.4 + 0.2 * V), "usemtl painted"]
    lines += ["f " + " ".join(f"{k}/{k}" for k in corners) for corners in F + 1]
    (tmp_path / "in.obj").write_text("\n".join(["mtllib in.mtl", *lines, ""]))
    (tmp_path / "in.mtl").write_text("newmtl painted\nmap_Kd gone.png\n")
    out, report = tmp_path / "out.glb", tmp_path / "report.json"
    assert run("unwrap", tmp_path / "in.obj", "-o", out, "--resolution", 64, "--bake", "--json", report) == 1
    assert "gone.png" in capfd.readouterr().out
    assert json.loads(report.read_text())["success"] is False
    assert io.read_mesh(out).FT is not None
