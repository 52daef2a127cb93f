"""glTF files written as OBJ files keep their materials and images."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image

from quasiharmonic import bake, io
from quasiharmonic.surfaces import starfish
from shared.commands import run
from shared.gltf_files import Gltf


def picture(kind="PNG"):
    file = BytesIO()
    Image.fromarray(np.add.outer(np.arange(8) * 30, [0, 10, 20]).astype(np.uint8)[None]).save(file, kind)
    return file.getvalue()


def write_model(path, wrap=10497, **second):
    """Two halves with materials of one image; ``second`` has further entries of the second material."""
    made = Gltf()
    made.tree["images"] = [{"bufferView": made.view(picture()), "mimeType": "image/png"}]
    made.tree["samplers"] = [{"wrapS": wrap, "wrapT": wrap}]
    made.tree["textures"] = [{"source": 0}, {"source": 0, "sampler": 0}]
    made.tree["materials"] = [
        {"name": "plain one", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}},
        {
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 1},
                "baseColorFactor": [1, 0.5, 0.25, 0.5],
                "metallicFactor": 0,
            },
            "alphaMode": "BLEND",
            "emissiveFactor": [0.25, 0, 0],
            **second,
        },
    ]
    V, F = starfish(2, 12)
    half = len(F) // 2
    table = {"POSITION": made.accessor(V.astype("f4")), "TEXCOORD_0": made.accessor((0.3 * V[:, :2]).astype("f4"))}
    parts = [F[:half], F[half:]]
    made.mesh(
        *({"attributes": dict(table), "indices": made.accessor(f.ravel().astype("u2")), "material": k}
          for k, f in enumerate(parts))
    )  # fmt: skip
    path.write_bytes(made.glb())
    return io.read_mesh(path)


def test_materials_and_images_are_beside_the_file(tmp_path):
    mesh = write_model(tmp_path / "in.glb")
    folder = tmp_path / "made"
    folder.mkdir()
    io.write_mapped(folder / "a model.obj", mesh)
    assert sorted(path.name for path in folder.iterdir()) == [
        "a model.obj",
        "a_model-texture-0.png",
        "a_model-texture.mtl",
    ]
    assert (folder / "a_model-texture-0.png").read_bytes() == picture()
    assert io.not_held("out.obj", mesh) == []
    # The file shows what the first one shows.
    written, other = io.read_mesh(folder / "a model.obj"), mesh.with_map(0.5 + 0.1 * mesh.V[:, :2])
    one, two = (bake(model, other, size=64) for model in (mesh, written))
    assert not two.problems
    np.testing.assert_array_equal(one.colour, two.colour)
    np.testing.assert_array_equal(one.emission, two.emission)
    opened = trimesh.load(folder / "a model.obj")
    images = [geometry.visual.material.image for geometry in opened.geometry.values()]
    assert len(images) == 2
    pixels = np.asarray(Image.open(BytesIO(picture())))
    assert all(np.array_equal(np.asarray(image.convert("RGB")), pixels) for image in images)


def test_what_libraries_do_not_have_is_listed(tmp_path):
    mesh = write_model(tmp_path / "in.glb", occlusionTexture={"index": 0}, emissiveTexture={"index": 0, "texCoord": 1})
    assert io.not_held("out.obj", mesh) == ["images of materials for emission", "images of materials for occlusion"]
    clamped = write_model(tmp_path / "in.glb", wrap=33071)
    assert io.not_held("out.obj", clamped) == ["images that do not repeat"]


def test_a_failure_leaves_no_files(tmp_path):
    mesh = write_model(tmp_path / "in.glb")
    target = tmp_path / "sub"
    target.mkdir()
    (target / "out.obj").mkdir()
    with pytest.raises(OSError, match=r"out\.obj"):
        io.write_mapped(target / "out.obj", mesh)
    assert [path.name for path in target.iterdir()] == ["out.obj"]


def test_a_single_material_without_name(tmp_path):
    made = Gltf()
    V, F = starfish(2, 12)
    made.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}]
    made.mesh(
        {"attributes": {"POSITION": made.accessor(V.astype("f4"))},
         "indices": made.accessor(F.ravel().astype("u2")), "material": 0}
    )  # fmt: skip
    (tmp_path / "in.glb").write_bytes(made.glb())
    assert run("unwrap", tmp_path / "in.glb", "-o", tmp_path / "out.obj", "--resolution", 256) == 0
    assert "usemtl 0" in (tmp_path / "out.obj").read_text()
    assert "Kd 0.0 1.0 0.0" in (tmp_path / "out-texture.mtl").read_text()


def test_files_without_materials_have_no_library(tmp_path):
    made = Gltf()
    V, F = starfish(2, 12)
    made.mesh(
        {"attributes": {"POSITION": made.accessor(V.astype("f4"))}, "indices": made.accessor(F.astype("u2").ravel())}
    )
    (tmp_path / "in.glb").write_bytes(made.glb())
    io.write_mapped(tmp_path / "out.obj", io.read_mesh(tmp_path / "in.glb").with_map(V[:, :2]))
    assert not (tmp_path / "out-texture.mtl").exists()
