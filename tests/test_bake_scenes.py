"""Scenes of several materials, meshes and nodes through ``qhm unwrap --bake``: what is shown before and after."""

from __future__ import annotations

import json
from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image

from quasiharmonic import bake, io
from quasiharmonic.surfaces import starfish
from shared.commands import run
from shared.gltf_files import Gltf, opened


def picture(seed):
    """A smooth image of 64 × 64 pixels, as PNG."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(64) / 64, np.arange(64) / 64)
    layers = [0.5 + 0.4 * np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in rng.integers(-2, 3, (3, 3)).tolist()]
    file = BytesIO()
    Image.fromarray((255 * np.stack(layers, axis=2)).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


@pytest.fixture
def scene(tmp_path):
    """Two meshes; one of two primitives, of which one has no material; mirrored and scaled nodes, and an instance."""
    made = Gltf()
    tree = made.tree
    tree["images"] = [{"bufferView": made.view(picture(k)), "mimeType": "image/png"} for k in range(3)]
    tree["textures"] = [{"source": k} for k in range(3)]
    tree["materials"] = [
        {"name": "first", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "roughnessFactor": 0.5}},
        {
            "name": "second",
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}, "baseColorFactor": [1, 0.5, 1, 0.5]},
            "alphaMode": "BLEND",
            "extras": {"kept": True},
        },
        {"name": "unused", "pbrMetallicRoughness": {"baseColorTexture": {"index": 2}}},
    ]
    V, F = starfish(3, 12)
    V, places = V.astype("f4"), (0.3 * V[:, :2]).astype("f4")
    half = len(F) // 2
    shared = {"POSITION": made.accessor(V), "TEXCOORD_0": made.accessor(places)}
    made.mesh(
        {"attributes": dict(shared), "indices": made.accessor(F[:half].ravel().astype("u2")), "material": 0},
        {"attributes": dict(shared), "indices": made.accessor(F[half:].ravel().astype("u2"))},
        name="body",
    )
    made.mesh(
        {"attributes": dict(shared), "indices": made.accessor(F.ravel().astype("u2")), "material": 1}, name="other"
    )
    tree["nodes"] = [
        {"mesh": 0, "name": "mirrored", "scale": [-1, 1, 1]},
        {"mesh": 1, "name": "small", "scale": [0.5, 0.5, 0.5], "translation": [9, 0, 0]},
        {"mesh": 1, "name": "again", "translation": [0, 9, 0]},
    ]
    tree["scenes"] = [{"nodes": [0, 1, 2]}]
    (tmp_path / "scene.glb").write_bytes(made.glb())
    return tmp_path / "scene.glb"


def shown(path, weights):
    """Colours (f, 3) that trimesh shows at one point of each triangle, by mesh, in the nearest pixel."""
    found = {}
    for name, mesh in trimesh.load(path).geometry.items():
        colour = np.ones((len(mesh.faces), 3))
        material = getattr(mesh.visual, "material", None)
        if material is None:  # White, as glTF specifies.
            found[name] = colour
            continue
        if material.baseColorTexture is not None:
            pixels = np.asarray(material.baseColorTexture.convert("RGB")) / 255
            uv = np.einsum("c,fcd->fd", weights, mesh.visual.uv[mesh.faces])
            height, width = pixels.shape[:2]
            column, row = np.floor(uv[:, 0] * width).astype(int), np.floor((1 - uv[:, 1]) * height).astype(int)
            colour = pixels[row % height, column % width]
        factor = np.ones(3) if material.baseColorFactor is None else material.baseColorFactor[:3] / 255
        found[name] = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4) * factor
    return found


@pytest.mark.slow
def test_a_scene_shows_the_same_and_keeps_the_rest(scene, tmp_path):
    out, report = tmp_path / "out.glb", tmp_path / "report.json"
    assert run("unwrap", scene, "-o", out, "--resolution", 1024, "--bake", "--json", report) == 0
    facts = json.loads(report.read_text())["bake"]
    assert facts["success"] is True
    # The roughness of the materials differs.
    assert facts["metallic_roughness"] is True
    before, after = opened(scene.read_bytes())[0], opened(out.read_bytes())[0]
    assert after["nodes"] == before["nodes"]
    assert after["scenes"] == before["scenes"]
    assert [mesh["name"] for mesh in after["meshes"]] == ["body", "other"]
    materials = {material.get("name"): material for material in after["materials"]}
    assert set(materials) == {"first", "second", "unused", None}
    assert materials["second"]["alphaMode"] == "BLEND"
    assert materials["second"]["extras"] == {"kept": True}
    # The images of the colours and of the roughness, and that of the material that no triangle uses.
    assert len(after["images"]) == len(after["textures"]) == 3
    for index in (material["pbrMetallicRoughness"]["baseColorTexture"]["index"] for material in after["materials"]):
        assert 0 <= after["textures"][index]["source"] < 3
    weights = np.array([0.3, 0.3, 0.4])
    one, other = shown(scene, weights), shown(out, weights)
    assert one.keys() == other.keys()
    for name in one:
        assert np.abs(one[name] - other[name]).mean() < 0.02


def test_images_stay_readable_where_other_views_are_removed(scene, tmp_path):
    """All numbers of the file are where its accessors say, although the bytes of old images are gone."""
    old = io.read_mesh(scene)
    result = bake(old, old.with_map(0.5 + 0.05 * old.V[:, :2]), size=64)
    io.write_mapped(tmp_path / "new.gltf", result.mesh)
    new = io.read_mesh(tmp_path / "new.gltf")
    assert np.array_equal(new.V, old.V)
    assert np.array_equal(new.F, old.F)
    assert np.abs(new.corner_uv - result.mesh.corner_uv).max() < 1e-7
    with Image.open(BytesIO(io.own_texture(new).data)) as image:
        assert np.array_equal(np.asarray(image), result.colour)
