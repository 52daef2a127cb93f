"""Baked textures against analytic looks, by formulas of their own; files opened again by trimesh."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import distance_transform_edt

from quasiharmonic import bake, io, unwrap
from quasiharmonic.surfaces import grid, starfish
from shared.gltf_files import SQUARE, opened, square

# Texture coordinates of the square, v downwards as in glTF; its position is (u, 1 - v).
PLACES = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype="f4")


def decoded(values):
    """Linear values of 8-bit sRGB."""
    c = np.asarray(values) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def encoded(values):
    """8-bit sRGB of linear values, not rounded."""
    c = np.asarray(values)
    return 255 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 1e-9) ** (1 / 2.4) - 0.055)


def png(pixels):
    file = BytesIO()
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(file, "PNG")
    return file.getvalue()


def noise(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def textured(path, material, images=(), samplers=(), **attributes):
    """Write the square with one material; texture k shows image k by sampler k, if there are any."""
    made = square(**({"TEXCOORD_0": PLACES} | attributes))
    tree = made.tree
    tree["images"] = [
        {"bufferView": made.view(data), "mimeType": "image/png", "name": f"i{k}"} for k, data in enumerate(images)
    ]
    tree["textures"] = [{"source": k} | ({"sampler": k} if samplers else {}) for k in range(len(images))]
    tree["samplers"] = list(samplers)
    tree["materials"] = [material]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    tree["scenes"], tree["nodes"] = [{"nodes": [0]}], [{"mesh": 0, "name": "kept", "extras": {"a": 1}}]
    path.write_bytes(made.glb())
    return io.read_mesh(path)


def colour_of(index=0, **more):
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": index} | more, "metallicFactor": 0}}


def on_square(mesh, change):
    """The mesh with texture coordinates (v upwards) that are a function of the positions in the square."""
    return mesh.with_map(change(mesh.V[:, :2]))


def quarter(xy):
    """A rotation by 90° in the unit square: u = y, v = 1 - x."""
    return np.stack([xy[:, 1], 1 - xy[:, 0]], axis=1)


def centres(size):
    """Texture coordinates (size, size, 2) of the centres of texels, v upwards."""
    u, v = np.meshgrid((np.arange(size) + 0.5) / size, 1 - (np.arange(size) + 0.5) / size)
    return np.stack([u, v], axis=2)


def test_colours_of_vertices_at_the_centres_of_texels(tmp_path):
    """Linear colours are a linear function of the position, so every texel is known."""
    linear = np.array([[1, 0.2, 0.1], [-0.5, 0.3, 0], [0, 0, 0.7]], dtype="f4").T
    colours = (np.column_stack([np.ones(4), SQUARE[:, :2]]) @ linear.T).astype("f4")
    old = textured(
        tmp_path / "old.glb", {"pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 0.25, 1]}}, COLOR_0=colours
    )
    shrunk = lambda xy: 0.1 + 0.8 * quarter(xy)  # noqa: E731
    result = bake(old, on_square(old, shrunk), size=(64, 64), padding=0)
    at = (centres(64) - 0.1) / 0.8
    x, y = 1 - at[:, :, 1], at[:, :, 0]
    inside = (x > 0) & (x < 1) & (y > 0) & (y < 1)
    wanted = encoded((np.stack([np.ones_like(x), x, y], axis=2) @ linear.T) * [1, 0.5, 0.25])
    assert result.same_mesh
    assert result.covered == inside.sum()
    assert np.abs(result.colour[inside][:, :3] - wanted[inside]).max() < 0.52
    assert (result.colour[inside][:, 3] == 255).all()
    assert bool(result)


def test_a_rotation_by_a_right_angle_moves_every_pixel_and_back(tmp_path):
    pixels = noise(32, 32, 3)
    old = textured(tmp_path / "old.glb", colour_of(), [png(pixels)])
    there = bake(old, on_square(old, quarter), size=32)
    assert np.array_equal(there.colour[:, :, :3], np.rot90(pixels, -1))
    io.write_mapped(tmp_path / "there.glb", there.mesh)
    turned = io.read_mesh(tmp_path / "there.glb")
    back = bake(turned, on_square(turned, lambda xy: xy), size=32)
    assert np.array_equal(back.colour[:, :, :3], pixels)


def bilinear(pixels, u, v, wrap):
    """Linear values of an image at one place, v downwards, pixel by pixel."""
    height, width = pixels.shape[:2]

    def index(i, side, how):
        if how == "clamp":
            return min(max(i, 0), side - 1)
        if how == "repeat":
            return i % side
        i %= 2 * side
        return i if i < side else 2 * side - 1 - i

    x, y = u * width - 0.5, v * height - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    total = np.zeros(3)
    for di in (0, 1):
        for dj in (0, 1):
            weight = abs(1 - di - (x - i)) * abs(1 - dj - (y - j))
            total += weight * decoded(pixels[index(j + dj, height, wrap[1]), index(i + di, width, wrap[0])])
    return total


@pytest.mark.parametrize("wrap", [("repeat", "mirror"), ("mirror", "clamp"), ("clamp", "repeat")])
def test_samplers_and_transforms_beyond_the_unit_square(tmp_path, wrap):
    codes = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
    pixels = noise(5, 7, 3)
    moved = {"offset": [0.3, -0.2], "rotation": 0.4, "scale": [1.5, 0.7]}
    material = colour_of(extensions={"KHR_texture_transform": moved})
    sampler = {"wrapS": codes[wrap[0]], "wrapT": codes[wrap[1]]}
    old = textured(tmp_path / "old.glb", material, [png(pixels)], [sampler], TEXCOORD_0=PLACES * 5 - 2)
    result = bake(old, on_square(old, lambda xy: xy), size=16)
    for row in range(16):
        for column in range(16):
            u, v = 5 * np.array([column + 0.5, row + 0.5]) / 16 - 2
            u, v = u * 1.5, v * 0.7
            # The rotation is clockwise on the screen, because v is downwards.
            u, v = np.cos(0.4) * u + np.sin(0.4) * v + 0.3, -np.sin(0.4) * u + np.cos(0.4) * v - 0.2
            wanted = encoded(bilinear(pixels, u, v, wrap))
            assert np.abs(result.colour[row, column, :3] - wanted).max() < 0.6


def test_samples_are_averaged_as_linear_light(tmp_path):
    board = 255 * (np.indices((32, 32)).sum(axis=0)[..., None].repeat(3, axis=2) % 2)
    old = textured(tmp_path / "old.glb", colour_of(), [png(board)])
    new = on_square(old, lambda xy: xy)
    half = int(np.rint(encoded(0.5)))
    assert half == 188
    assert (bake(old, new, size=16, samples=2).colour[:, :, :3] == half).all()
    assert np.array_equal(bake(old, new, size=32, samples=2).colour[4:8, 4:8, 0] > 188, board[4:8, 4:8, 0] > 188)


def test_another_mesh_gets_the_nearest_points_and_what_is_far_is_magenta(tmp_path):
    old = textured(tmp_path / "old.glb", colour_of(), [png(noise(16, 16, 3))])
    uv, F = grid(7, 5)
    V = np.column_stack([uv, np.full(len(uv), 1e-3)])
    same = bake(old, io.MeshData(V, F).with_map(uv), size=64)
    own = bake(old, on_square(old, lambda xy: xy), size=64)
    assert not same.same_mesh
    assert same.missing == 0
    assert np.abs(same.colour.astype(int) - own.colour).max() <= 1
    shifted = bake(
        old, io.MeshData(np.add(V, [0.5, 0, 0]), F).with_map(uv), size=64, max_distance=0.1 / 2**0.5, padding=0
    )
    # The texels whose centres are more than a tenth beside the square.
    far = np.hypot((np.arange(64) + 0.5) / 64 + 0.5 - 1, 1e-3) > 0.1
    far &= (np.arange(64) + 0.5) / 64 > 0.5
    assert shifted.missing == 64 * far.sum()
    assert not shifted
    assert (shifted.colour[:, far] == [255, 0, 255, 255]).all()
    assert not (shifted.colour[:, ~far] == [255, 0, 255, 255]).all(axis=2).any()
    assert f"{shifted.missing} texels are too far" in shifted.summary()


def test_normal_maps_turn_with_the_texture_coordinates(tmp_path):
    normal = np.array([0.6, 0.0, 0.8])
    image = png(np.tile(np.rint(127.5 * (normal + 1)), (8, 8, 1)))
    material = {"normalTexture": {"index": 0, "scale": 0.5}}
    old = textured(tmp_path / "old.glb", material, [image])
    # The tangent is along y and the bitangent against x; then mirrored.
    scaled = np.array([0.3, 0, 0.8]) / np.hypot(0.3, 0.8)
    for change, wanted in (
        (quarter, [0, -scaled[0], scaled[2]]),
        (lambda xy: quarter(xy)[:, ::-1], [-scaled[0], 0, scaled[2]]),
        (lambda xy: xy, scaled),
    ):
        result = bake(old, on_square(old, change), size=8)
        assert np.abs(result.normal / 127.5 - 1 - wanted).max() < 2 / 127.5


def test_normals_of_another_mesh_are_those_of_the_old_one_in_space(tmp_path):
    """A tilted normal map on a plane, seen from a curved sheet: formulas of the sheet's tangents."""
    image = png(np.tile([128, 128, 255], (4, 4, 1)))
    old = textured(tmp_path / "old.glb", {"normalTexture": {"index": 0}}, [image])
    uv, F = grid(40, 4)
    V = np.column_stack([uv, 0.02 * np.sin(6 * uv[:, 0])])
    result = bake(old, io.MeshData(V, F).with_map(uv), size=40)
    # Each triangle is flat; its slope along x is that of its column.
    slope = np.diff(0.02 * np.sin(6 * np.linspace(0, 1, 41))) * 40
    wanted = np.stack([slope, np.zeros(40), np.ones(40)], axis=1) / np.sqrt(1 + slope**2)[:, None]
    # Smooth tangents differ from those of the triangles, but stay in the same plane of x and z.
    assert np.abs(result.normal[20] / 127.5 - 1 - wanted).max() < 0.02


def test_metallic_roughness_occlusion_and_emission(tmp_path):
    mixed, glow = noise(8, 8, 3), noise(8, 8, 3, seed=1)
    material = {
        "pbrMetallicRoughness": {
            "metallicRoughnessTexture": {"index": 0},
            "metallicFactor": 0.5,
            "roughnessFactor": 0.25,
        },
        "occlusionTexture": {"index": 0, "strength": 0.5},
        "emissiveTexture": {"index": 1},
        "emissiveFactor": [1, 0.5, 0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
    }
    old = textured(tmp_path / "old.glb", material, [png(mixed), png(glow)])
    result = bake(old, on_square(old, quarter), size=8)
    turned = np.rot90(mixed, -1) / 255
    wanted = np.stack([1 + 0.5 * (turned[:, :, 0] - 1), 0.25 * turned[:, :, 1], 0.5 * turned[:, :, 2]], axis=2)
    assert np.abs(result.metallic_roughness / 255 - wanted).max() < 0.51 / 255
    assert np.abs(result.emission - encoded(decoded(np.rot90(glow, -1)) * [1, 0.5, 0])).max() < 0.6
    io.write_mapped(tmp_path / "new.glb", result.mesh)
    tree, _ = opened((tmp_path / "new.glb").read_bytes())
    (made,) = tree["materials"]
    assert made["pbrMetallicRoughness"]["metallicFactor"] == made["pbrMetallicRoughness"]["roughnessFactor"] == 1
    assert made["occlusionTexture"] == made["pbrMetallicRoughness"]["metallicRoughnessTexture"]
    assert made["emissiveFactor"] == [1, 1, 1]
    assert made["extensions"]["KHR_materials_emissive_strength"] == {"emissiveStrength": 4}
    assert "KHR_materials_emissive_strength" in tree["extensionsUsed"]
    assert len(tree["images"]) == len(tree["textures"]) == 3


def wide_png():
    """A PNG that announces 20,000 pixels along a side, and has none."""
    head = struct.pack(">IIBBBBB", 20000, 1, 8, 2, 0, 0, 0)
    chunk = lambda name, data: struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))  # noqa: E731
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def deep_png():
    file = BytesIO()
    Image.fromarray(np.zeros((2, 2), dtype=np.uint16)).save(file, "PNG")
    return file.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (png(noise(8, 8, 3))[:60], "texture i0 is damaged"),
        (b"GIF89a", "texture i0 is neither PNG nor JPEG"),
        (wide_png(), "texture i0 has 20000 by 1 pixels, more than 16384"),
        (deep_png(), "texture i0 has 16 bits"),
    ],
)
def test_damaged_textures_are_named_and_baked_as_their_factors(tmp_path, data, words):
    material = colour_of()
    material["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 1, 0, 1]
    old = textured(tmp_path / "old.glb", material, [data])
    result = bake(old, on_square(old, quarter), size=4)
    assert (result.colour == [188, 255, 0, 255]).all()
    assert len(result.problems) == 1
    assert words in result.problems[0]
    assert not result.success
    assert words in result.summary()


def test_references_to_nothing_are_named(tmp_path):
    old = textured(tmp_path / "old.glb", colour_of(3))
    assert "baseColorTexture of material" in bake(old, on_square(old, quarter), size=4).problems[0]
    old = textured(tmp_path / "old.glb", colour_of(texCoord=1), [png(noise(4, 4, 3))])
    result = bake(old, on_square(old, quarter), size=4)
    assert result.problems == ("texture i0 needs texture coordinates 1, which are missing",)
    assert (result.colour == 255).all()


def test_what_is_not_baked_is_named(tmp_path):
    coat = {"KHR_materials_clearcoat": {"clearcoatTexture": {"index": 0}, "clearcoatFactor": 0.5}}
    textured(tmp_path / "old.glb", colour_of() | {"extensions": coat}, [png(noise(4, 4, 3))])
    made, rest = opened((tmp_path / "old.glb").read_bytes())
    made["extensions"] = {"KHR_materials_variants": {"variants": [{"name": "red"}]}}
    made["buffers"][0]["uri"] = "old.bin"
    (tmp_path / "old.bin").write_bytes(rest)
    (tmp_path / "old.gltf").write_text(json.dumps(made))
    old = io.read_mesh(tmp_path / "old.gltf")
    result = bake(old, on_square(old, quarter), size=4)
    assert result.problems == (
        "textures of KHR_materials_clearcoat are not baked",
        "variants of materials are not baked, and keep their textures",
    )
    io.write_mapped(tmp_path / "new.glb", result.mesh)
    (material,) = opened((tmp_path / "new.glb").read_bytes())[0]["materials"]
    assert material["extensions"] == {"KHR_materials_clearcoat": {"clearcoatFactor": 0.5}}


def test_textures_by_the_second_coordinates(tmp_path):
    pixels = noise(8, 8, 3)
    old = textured(tmp_path / "old.glb", colour_of(texCoord=1), [png(pixels)], TEXCOORD_0=0 * PLACES, TEXCOORD_1=PLACES)
    assert np.array_equal(bake(old, on_square(old, quarter), size=8).colour[:, :, :3], np.rot90(pixels, -1))


def test_opacity_is_kept_where_the_material_shows_it(tmp_path):
    pixels = noise(8, 8, 4)
    for mode in ("OPAQUE", "BLEND"):
        old = textured(tmp_path / "old.glb", colour_of() | {"alphaMode": mode}, [png(pixels)])
        result = bake(old, on_square(old, quarter), size=8, jpeg=True)
        wanted = 255 if mode == "OPAQUE" else np.rot90(pixels[:, :, 3], -1)
        assert (result.colour[:, :, 3] == wanted).all()
        assert result.mesh.texture.suffix == (".jpg" if mode == "OPAQUE" else ".png")
    # Another mesh takes the mode of the old one.
    uv, F = grid(2, 2)
    io.write_mapped(tmp_path / "new.glb", bake(old, io.MeshData(uv, F).with_map(uv), size=8).mesh)
    (made,) = opened((tmp_path / "new.glb").read_bytes())[0]["materials"]
    assert made["alphaMode"] == "BLEND"


def test_the_written_file_shows_the_texture_and_keeps_the_rest(tmp_path):
    pixels = noise(16, 16, 3)
    colours = np.full((4, 3), 0.5, dtype="f4")
    old = textured(
        tmp_path / "old.glb", colour_of() | {"name": "skin", "doubleSided": True}, [png(pixels)], COLOR_0=colours
    )
    io.write_mapped(tmp_path / "new.glb", bake(old, on_square(old, quarter), size=16).mesh)
    tree, _ = opened((tmp_path / "new.glb").read_bytes())
    assert tree["nodes"] == [{"mesh": 0, "name": "kept", "extras": {"a": 1}}]
    assert len(tree["images"]) == 1
    assert [(m["name"], m["doubleSided"]) for m in tree["materials"]] == [("skin", True)]
    assert "COLOR_0" not in tree["meshes"][0]["primitives"][0]["attributes"]
    (shown,) = trimesh.load(tmp_path / "new.glb").geometry.values()
    image = np.asarray(shown.visual.material.baseColorTexture.convert("RGB"))
    wanted = encoded(0.5 * decoded(np.rot90(pixels, -1)))
    assert np.abs(image - wanted).max() < 0.6
    # At the corner of the square at the origin, trimesh shows what the old texture shows there.
    at = np.flatnonzero((shown.vertices == 0).all(axis=1))[0]
    u, v = shown.visual.uv[at]
    assert np.array_equal([u, v], [0, 1])


def test_the_result_of_unwrap_as_the_new_model(tmp_path):
    V, F = starfish(3, 12)
    colours = np.random.default_rng(0).integers(0, 256, (len(V), 3)) / 255
    io.write_ply(tmp_path / "old.ply", io.MeshData(V, F, extra=colours))
    result = unwrap(V, F)
    baked = bake(tmp_path / "old.ply", result, size=128)
    assert baked.same_mesh
    inverse = result.inverse()
    at = inverse.locate(centres(128))
    assert np.array_equal(baked.covered, at.found.sum())
    wanted = encoded(inverse.values(at, decoded(255 * colours)[F], per="corner"))
    assert np.abs(baked.colour[at.found][:, :3] - wanted[at.found]).max() < 0.6


def test_materials_of_an_obj_file(tmp_path):
    pixels = noise(8, 8, 3)
    (tmp_path / "image.png").write_bytes(png(pixels))
    (tmp_path / "all.mtl").write_text(
        "newmtl shown one\nKd 0.5 1 1\nmap_Kd -clamp on image.png\nmap_Bump other.png\n"
        "newmtl plain\nKd 0 0.5 0\nd 0.5\n"
    )
    lines = ["mtllib all.mtl", "v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += ["usemtl shown one", "f 1/1 2/2 3/3", "usemtl plain", "f 1/1 3/3 4/4"]
    (tmp_path / "old.obj").write_text("\n".join(lines) + "\n")
    old = io.read_mesh(tmp_path / "old.obj")
    result = bake(old, on_square(old, lambda xy: xy), size=8)
    x, y = np.meshgrid(np.arange(8), 7 - np.arange(8))
    below = x > y
    wanted = encoded(decoded(pixels) * [0.5, 1, 1])
    assert np.abs(result.colour[below][:, :3] - wanted[below]).max() < 0.6
    assert (result.colour[x < y] == [0, 188, 0, 128]).all()
    assert result.problems == ("map_Bump of material shown one is not baked",)
    io.write_mapped(tmp_path / "new.obj", result.mesh)
    with Image.open(tmp_path / "new-texture.png") as image:
        assert np.array_equal(np.asarray(image), result.colour)


def test_degenerate_triangles_stay_padding_and_padding_is_the_nearest_texel(tmp_path):
    V = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]])
    uv = np.array([[0.2, 0.2], [0.7, 0.25], [0.3, 0.8], [0.6, 0.6], [0.9, 0.6], [0.9, 0.9]])
    colours = np.random.default_rng(0).random((6, 3))
    old = io.MeshData(V, [[0, 1, 2], [3, 4, 5]], extra=colours).with_map(uv)
    result = bake(old, old, size=64, padding=5)
    alone = bake(replace(old, F=old.F[:1], FT=old.FT[:1]), replace(old, F=old.F[:1], FT=old.FT[:1]), size=64, padding=0)
    assert result.covered == alone.covered
    at = centres(64).reshape(-1, 2)
    weights = np.linalg.solve(np.vstack([uv[:3].T, np.ones(3)]), np.column_stack([at, np.ones(len(at))]).T)
    covered = (weights >= 0).all(axis=0).reshape(64, 64)
    assert covered.sum() == result.covered
    distance, nearest = distance_transform_edt(~covered, return_indices=True)
    beside = (distance > 0) & (distance <= 5)
    # Texels with two nearest ones may have either.
    found = (result.colour == result.colour[tuple(nearest)]).all(axis=2)
    assert found[beside].mean() > 0.9
    shown = result.colour[covered].astype(float)
    gap = np.abs(result.colour[beside].astype(float) - result.colour[tuple(nearest)][beside]).max()
    assert gap < 0.2 * np.ptp(shown, axis=0).max()
    assert (result.colour[distance > 8] == np.rint(shown.mean(axis=0))).all()


def test_the_first_of_repeated_triangles_counts():
    V = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    colours = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], 3, axis=0)
    uv = np.tile([[0, 0], [1, 0], [0, 1]], (2, 1))
    old = io.MeshData(V, [[0, 1, 2], [3, 4, 5]], extra=colours).with_map(uv)
    assert (bake(old, old, size=8).colour == [255, 0, 0, 255]).all()


def test_wrong_arguments(tmp_path):
    uv, F = grid(2, 2)
    old = io.MeshData(uv, F)
    with pytest.raises(ValueError, match="the new model has no texture coordinates: unwrap it first"):
        bake(old, old)
    with pytest.raises(ValueError, match="no texture coordinates in the unit square"):
        bake(old, old.with_map(uv + 5))
    with pytest.raises(TypeError, match="old must be a MeshData or the path of a file"):
        bake(uv, old.with_map(uv))
    with pytest.raises(ValueError, match="at most 8192"):
        bake(old, old.with_map(uv), size=10000)
    with pytest.raises(ValueError, match="samples"):
        bake(old, old.with_map(uv), samples=0)
    with pytest.raises(ValueError, match="without triangles"):
        bake(io.MeshData(uv, np.empty((0, 3), int)), old.with_map(uv))
    half = bake(old, old.with_map(np.add(uv, [0.9, 0])), size=8)
    assert "beyond the unit square" in half.problems[0]
