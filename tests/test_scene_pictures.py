"""A scene of several meshes through ``qhm unwrap --bake``, drawn from six sides before and after."""

from __future__ import annotations

import json
from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image

import hard_models as models
from quasiharmonic.surfaces import starfish
from shared.commands import run
from shared.gltf_files import Gltf, opened

SIDE = 64


def picture():
    x, y = np.meshgrid(np.arange(64) / 64, np.arange(64) / 64)
    layers = [0.5 + 0.4 * np.sin(2 * np.pi * (a * x + b * y)) for a, b in ((1, 0), (0, 1), (1, 1))]
    file = BytesIO()
    Image.fromarray((255 * np.stack(layers, axis=2)).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def write_scene(path):
    """Four meshes at five nodes: one twice, one mirrored, one of half the size; two materials, one with a texture.

    The file has a camera, an animation, a skin and a morph target, too.
    """
    made = Gltf()
    tree = made.tree
    tree["images"] = [{"bufferView": made.view(picture()), "mimeType": "image/png"}]
    tree["textures"] = [{"source": 0}]
    tree["materials"] = [
        {"name": "painted", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "doubleSided": True},
        {"name": "red", "pbrMetallicRoughness": {"baseColorFactor": [0.6, 0.1, 0.1, 1]}, "doubleSided": True},
    ]
    shapes = models.box(1, 2, 0.5), models.tube(12), starfish(1, 6), models.box(0.7, 0.7, 0.7)
    for k, (V, F) in enumerate(shapes):
        V = V.astype("f4")
        table = {"POSITION": made.accessor(V, min=V.min(axis=0).tolist(), max=V.max(axis=0).tolist())}
        if k != 3:
            table["TEXCOORD_0"] = made.accessor((0.2 * V[:, :2] + 0.1 * V[:, 2:]).astype("f4"))
        primitive = {"attributes": table, "indices": made.accessor(F.ravel().astype("u2")), "material": int(k == 3)}
        if k == 2:
            primitive["targets"] = [{"POSITION": made.accessor(0.1 * V)}]
            table["JOINTS_0"] = made.accessor(np.zeros((len(V), 4), "u1"))
            table["WEIGHTS_0"] = made.accessor(np.tile([1, 0, 0, 0], (len(V), 1)).astype("f4"))
        made.mesh(primitive, name=f"mesh {k}", extras={"number": k})
    times, moves = (
        made.accessor(np.array([0.0, 1], "f4"), min=[0.0], max=[1.0]),
        made.accessor(np.eye(2, 3, dtype="f4")),
    )
    tree["animations"] = [
        {
            "samplers": [{"input": times, "output": moves}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
        }
    ]
    tree["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    tree["skins"] = [{"joints": [4]}]
    tree["nodes"] = [
        {"mesh": 0, "name": "one", "extras": {"kept": 1}},
        {"mesh": 0, "name": "again", "translation": [4, 0, 0]},
        {"mesh": 1, "name": "mirrored", "scale": [-1, 1, 1], "translation": [0, 4, 0]},
        {"mesh": 2, "name": "half", "scale": [0.5, 0.5, 0.5], "translation": [4, 4, 0]},
        {"mesh": 3, "name": "cube", "translation": [2, 2, 2], "camera": 0},
    ]
    tree["scenes"] = [{"nodes": [0, 1, 2, 3, 4]}]
    path.write_bytes(made.glb())


def draw(path, side):
    """Colours (n, n, 3) from 0 to 255, and which pixels are covered, of a file that trimesh opens, from one side."""
    scene = trimesh.load(path)
    axis, sign = divmod(side, 2)
    depth = np.full((SIDE, SIDE), -np.inf)
    colours = np.zeros((SIDE, SIDE, 3))
    low, high = scene.bounds
    scale = (SIDE - 2) / (high - low).max()
    for mesh in scene.dump():
        material = mesh.visual.material
        factor = np.ones(3) if material.baseColorFactor is None else material.baseColorFactor[:3] / 255
        pixels = None if material.baseColorTexture is None else np.asarray(material.baseColorTexture.convert("RGB"))
        places = (np.array(mesh.vertices) - low) * scale + 1
        uv = None if mesh.visual.uv is None else np.array(mesh.visual.uv)
        for triangle in mesh.faces.tolist():
            corners = np.roll(np.array(places[triangle]), -axis, axis=1)
            flat, far = corners[:, 1:], (1 - 2 * sign) * corners[:, 0]
            first, last = np.floor(flat.min(axis=0)).astype(int), np.ceil(flat.max(axis=0)).astype(int)
            i, j = np.meshgrid(*(np.arange(a, b) for a, b in zip(first, last, strict=True)), indexing="ij")
            edges = np.stack([flat[1] - flat[0], flat[2] - flat[0]], axis=1)
            if abs(np.linalg.det(edges)) < 1e-9:
                continue
            weights = np.stack([i + 0.5, j + 0.5], axis=-1).reshape(-1, 2) - flat[0]
            weights = weights @ np.linalg.inv(edges).T
            weights = np.column_stack([1 - weights.sum(axis=1), weights])
            near = weights @ far
            seen = (weights >= 0).all(axis=1) & (near > depth[i, j].ravel() + 1e-6)
            at = i.ravel()[seen], j.ravel()[seen]
            depth[at] = near[seen]
            colour = np.ones((seen.sum(), 3))
            if pixels is not None:
                colour = look_up(pixels, weights[seen] @ uv[triangle])
            colours[at] = 255 * to_srgb(colour * factor)
    return colours, np.isfinite(depth)


def to_srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def to_linear(values):
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def look_up(pixels, uv):
    """Linear colours by bilinear interpolation of an sRGB image that repeats."""
    height, width = pixels.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - i)[:, None], (y - j)[:, None]
    corner = [to_linear(pixels[(j + dj) % height, (i + di) % width] / 255) for dj in (0, 1) for di in (0, 1)]
    return (1 - b) * ((1 - a) * corner[0] + a * corner[1]) + b * ((1 - a) * corner[2] + a * corner[3])


@pytest.mark.long
@pytest.mark.parametrize("instances", ["share", "own"])
def test_a_scene_looks_the_same_from_six_sides(tmp_path, instances):
    source, out = tmp_path / "in.glb", tmp_path / "out.glb"
    write_scene(source)
    arguments = ["--bake", "--resolution", 1024, "--instances", instances, "--json", tmp_path / "report.json"]
    assert run("unwrap", source, "-o", out, *arguments) == 0
    assert json.loads((tmp_path / "report.json").read_text())["bake"]["success"] is True
    before, after = opened(source.read_bytes())[0], opened(out.read_bytes())[0]
    for kept in ("scenes", "animations", "cameras", "skins"):
        assert after[kept] == before[kept]
    assert [node | {"mesh": 0} for node in after["nodes"]] == [node | {"mesh": 0} for node in before["nodes"]]
    assert len(after["meshes"]) == (4 if instances == "share" else 5)
    names = {mesh["name"]: mesh for mesh in after["meshes"]}
    assert {name: mesh["extras"]["number"] for name, mesh in names.items()} == {f"mesh {k}": k for k in range(4)}
    assert [material["name"] for material in after["materials"]] == ["painted", "red"]
    (primitive,) = names["mesh 2"]["primitives"]
    assert set(primitive["attributes"]) == {"POSITION", "TEXCOORD_0", "JOINTS_0", "WEIGHTS_0"}
    assert len(primitive["targets"]) == 1
    for side in range(6):
        (old, covered), (new, same) = draw(source, side), draw(out, side)
        np.testing.assert_array_equal(covered, same)
        assert covered.mean() > 0.05
        assert np.abs(old - new)[covered].mean() <= 2
