"""Materials and images: those of an OBJ file are found, and written files refer to their image."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import flatten, io
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io import MeshData, MeshFileError
from quasiharmonic.plot import plot_texture, save_texture_figure
from quasiharmonic.surfaces import cat, disk, grid
from quasiharmonic.ui.cli import main
from shared.commands import run

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
HALVES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


@pytest.fixture
def qhm(capfd):
    """Run the command; return its exit status and output."""

    def call(*arguments):
        capfd.readouterr()
        return run(*arguments), *capfd.readouterr()

    return call


def gradient(path, width=64, height=32):
    """An image whose red grows to the right and whose green grows upwards."""
    from PIL import Image

    across, up = (np.arange(width) + 0.5) / width, (np.arange(height)[::-1] + 0.5) / height
    pixels = np.stack(np.broadcast_arrays(across[None], up[:, None], 0.5), axis=2)
    Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(path)
    return path


def test_a_hundred_materials_and_all_other_data_are_preserved(tmp_path, qhm):
    """Negative indices, unused and repeated positions, a material per face."""
    V, F = grid(10, 5)
    lines = ["mtllib all.mtl", "o sheet", *(f"v {x!r} {y!r} {x * y!r}" for x, y in V.tolist())]
    lines += ["vt 7 7", *(f"vt {x!r} {y!r}" for x, y in V.tolist()), "vt 8 8"]
    n = len(V)
    # The corner of the first face refers to a second copy of its position.
    lines += ["vt " + " ".join(map(repr, V[F[0, 0]].tolist())), "vn 0 0 1"]
    for k, face in enumerate(F.tolist()):
        lines += [f"usemtl m{k:03}", f"s {k % 2}"]
        corners = [f"{i - n}/{i - n - 2}/-1" for i in face]
        if k == 0:
            corners[0] = f"{face[0] - n}/-1/-1"
        lines.append("f " + " ".join(corners))
    assert len(F) == 100
    (tmp_path / "in.obj").write_text("\n".join(lines) + "\n")
    (tmp_path / "all.mtl").write_text("newmtl m000\n")
    status, said, told = qhm("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj")
    assert status == 0, said + told
    assert told == ""
    before, after = io.read_obj(tmp_path / "in.obj"), io.read_obj(tmp_path / "out.obj")
    for name in ("V", "F", "FT", "FN", "statement_faces"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.statements == before.statements
    assert after.normals == before.normals
    assert len(after.vt) == len(before.vt)
    np.testing.assert_array_equal(after.vt[[0, n + 1]], [[7, 7], [8, 8]])
    np.testing.assert_array_equal(after.vt[-1], after.vt[F[0, 0] + 1])


@pytest.mark.parametrize("name", ["all.mtl", "my colours.mtl", "sub/all.mtl"])
def test_a_library_is_found_from_another_folder(name, tmp_path):
    there, library = tmp_path / "a" / "b", tmp_path / "in" / name
    there.mkdir(parents=True)
    library.parent.mkdir(parents=True)
    library.write_text("newmtl x\n")
    line = f"mtllib {name}"
    source = tmp_path / "in" / "mesh.obj"
    source.write_text(f"{line}\n{SQUARE}usemtl x\n{HALVES}")
    mesh = io.read_mesh(source)
    io.write_mapped(there / "out.obj", mesh)
    named = (there / "out.obj").read_text().splitlines()[0]
    assert named == f"mtllib ../../in/{name}"
    assert (there / named.removeprefix("mtllib ")).read_text() == "newmtl x\n"
    assert io.not_held(there / "out.obj", mesh) == []
    # A reference that is valid from the new file does not change, even if it finds another library.
    io.write_mapped(tmp_path / "in" / "out.obj", mesh)
    assert (tmp_path / "in" / "out.obj").read_text().startswith(line + "\n")
    (there / name).parent.mkdir(exist_ok=True)
    (there / name).write_text("another\n")
    io.write_mapped(there / "out.obj", mesh)
    assert (there / "out.obj").read_text().startswith(line + "\n")


def test_several_libraries_keep_their_quotes(tmp_path):
    (tmp_path / "my in").mkdir()
    source = tmp_path / "my in" / "mesh.obj"
    for line, names in (
        ('"my colours.mtl" "b.mtl"', ["my colours.mtl", "b.mtl"]),
        ("a.mtl b.mtl", ["a.mtl", "b.mtl"]),
        ('"my colours.mtl"', ["my colours.mtl"]),
    ):
        for name in names:
            (source.parent / name).touch()
        source.write_text(f"mtllib {line}\n{SQUARE}{HALVES}")
        io.write_mapped(tmp_path / "out.obj", io.read_mesh(source))
        written = (tmp_path / "out.obj").read_text().splitlines()[0]
        assert written == "mtllib " + " ".join(f'"my in/{name}"' for name in names)


def test_a_missing_library_keeps_its_name(tmp_path):
    source = tmp_path / "mesh.obj"
    source.write_text("mtllib  gone.mtl here.mtl\n" + SQUARE + HALVES)
    (tmp_path / "here.mtl").write_text("")
    (tmp_path / "out").mkdir()
    mesh = io.read_mesh(source)
    io.write_mapped(tmp_path / "out" / "x.obj", mesh)
    assert (tmp_path / "out" / "x.obj").read_text().startswith("mtllib gone.mtl ../here.mtl\n")
    io.write_mapped(tmp_path / "x.obj", mesh)
    assert (tmp_path / "x.obj").read_text().startswith("mtllib  gone.mtl here.mtl\n")


@pytest.mark.slow
def test_a_written_obj_refers_to_its_image(tmp_path, qhm):
    trimesh = pytest.importorskip("trimesh", reason="an independent reader of OBJ and its materials")
    picture = gradient(tmp_path / "photo.png")
    (tmp_path / "in.obj").write_text("mtllib old.mtl\nusemtl old\no kept\n" + SQUARE + "usemtl old\n" + HALVES)
    out = tmp_path / "my map.obj"
    status, said, told = qhm("polish", tmp_path / "in.obj", "-o", out, "--texture", picture)
    assert status == 0, said + told
    assert "its own materials" in told
    assert (tmp_path / "my_map-texture.png").read_bytes() == picture.read_bytes()
    text = out.read_text()
    assert "old" not in text
    assert "o kept\n" in text
    there = trimesh.load(out, process=False)
    seen = trimesh.visual.color.uv_to_color(there.visual.uv, there.visual.material.image)[:, :2] / 255
    np.testing.assert_allclose(seen, there.vertices[:, :2], atol=1 / 32)


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_another_library_draws_a_glb_with_its_image(suffix, tmp_path):
    """The colours at vertices, as read by the other library and as drawn here, are those of the image."""
    trimesh = pytest.importorskip("trimesh", reason="an independent reader of glTF and its materials")
    flat, F = grid(12, 9)
    uv = 0.04 + 0.92 * flat / np.ptp(flat, axis=0) + 0.03 * np.sin(flat[:, ::-1])
    V = np.column_stack([flat, np.sin(flat).sum(axis=1)])
    mesh = MeshData(V, F, texture=io.read_texture(gradient(tmp_path / "photo.png")))
    io.write_map(tmp_path / f"cat{suffix}", mesh, uv)
    there = trimesh.load(tmp_path / f"cat{suffix}", process=False, force="mesh")
    colours = there.visual.to_color().vertex_colors[:, :2] / 255
    np.testing.assert_allclose(colours, uv, atol=1 / 16)
    image = plot_texture(V, F, io.map_of(io.read_mesh(tmp_path / f"cat{suffix}")), texture=tmp_path / "photo.png")
    drawn = image.axes[1].images[0]
    pixels, (left, right, low, high) = np.asarray(drawn.get_array()), drawn.get_extent()
    inner = uv[np.setdiff1d(np.arange(len(V)), boundary_edges(F, len(V)))]
    column = (inner[:, 0] - left) / (right - left) * pixels.shape[1]
    row = (high - inner[:, 1]) / (high - low) * pixels.shape[0]
    found = pixels[row.astype(int), column.astype(int), :3]
    # Lighting darkens all colours of the plane equally, so their ratios do not change.
    expected = np.column_stack([inner, np.full(len(inner), 0.5)])
    shares = [c / c.sum(axis=1, keepdims=True) for c in (found, expected)]
    assert np.abs(shares[0] - shares[1]).max() < 0.05


def test_the_checkerboard_is_a_repeating_image(tmp_path):
    from PIL import Image

    texture = io.checkerboard()
    (tmp_path / "board.png").write_bytes(texture.data)
    pixels = np.asarray(Image.open(tmp_path / "board.png"))
    assert pixels.shape == (512, 512, 3)
    assert io.read_texture(tmp_path / "board.png") == texture
    assert (pixels[0] != pixels[-1]).any(axis=1).all()
    assert (pixels[:, 0] != pixels[:, -1]).any(axis=1).all()
    assert len(np.unique(pixels @ (1 << 16, 1 << 8, 1))) == 2


@pytest.mark.long
def test_an_image_repeats_and_its_transparent_parts_are_white(tmp_path):
    from PIL import Image

    Image.fromarray(np.array([[[255, 0, 0, 255], [0, 0, 0, 0]]], dtype=np.uint8)).save(tmp_path / "two.png")
    V, F = grid(2, 2)
    image = plot_texture(V, F, 2 * V - 1, texture=tmp_path / "two.png").axes[1].images[0].get_array()
    middle = image[len(image) // 3]
    red = middle[:, 0] > 2 * middle[:, 1]
    covered = np.flatnonzero(middle[:, 3] == 1)
    # Two units across, half of each red.
    assert np.count_nonzero(np.diff(red[covered].astype(int))) in (3, 4)
    assert 0.4 < red[covered].mean() < 0.6


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_missing_image_is_named_and_nothing_is_written(suffix, tmp_path, qhm):
    (tmp_path / "in.obj").write_text(SQUARE + HALVES)
    (tmp_path / "text.png").write_text("no picture")
    before = sorted(tmp_path.iterdir())
    for name, message in (("gone.png", "no such file"), ("text.png", "not a PNG or JPEG")):
        for command in (("polish", tmp_path / "in.obj", "-o", tmp_path / f"out{suffix}"),
                        ("plot", tmp_path / "in.obj", "-o", tmp_path / "out.png")):  # fmt: skip
            status, _, told = qhm(*command, "--texture", tmp_path / name)
            assert status == 2
            assert name in told
            assert message in told
    assert sorted(tmp_path.iterdir()) == before


def test_a_damaged_image_is_named(tmp_path):
    V, F = grid(2, 2)
    whole = gradient(tmp_path / "photo.png").read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MeshFileError, match=r"half\.png: is a damaged image"):
        save_texture_figure(tmp_path / "out.png", V, F, V, texture=tmp_path / "half.png")
    assert not (tmp_path / "out.png").exists()


@pytest.mark.long
def test_an_image_is_drawn_on_the_surface_only(tmp_path, qhm):
    (tmp_path / "in.obj").write_text(SQUARE + HALVES)
    asked = "plot", tmp_path / "in.obj", "-o", tmp_path / "out.png", "--texture", gradient(tmp_path / "photo.png")
    status, _, told = qhm(*asked, "--kind", "distortion")
    assert status == 2
    assert "--kind distortion" in told
    status, *_ = qhm(*asked[:4], "--texture", tmp_path / "out.png")
    assert status == 2
    assert qhm(*asked)[0] == 0


def test_files_written_with_an_obj_replace_no_other_files(tmp_path, qhm):
    (tmp_path / "in.obj").write_text(SQUARE + HALVES)
    picture = gradient(tmp_path / "out-texture.png")
    kept = picture.read_bytes()
    status, _, told = qhm("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--texture", picture)
    assert status == 2
    assert "would replace another file" in told
    assert picture.read_bytes() == kept
    assert not (tmp_path / "out.obj").exists()
    status, _, told = qhm("polish", tmp_path / "in.obj", "-o", tmp_path / "out.ply", "--texture", "checkerboard")
    assert status == 2
    assert ".ply files cannot store an image; supported: .obj, .glb, .gltf" in told


@pytest.mark.slow
def test_commands_from_format_to_format(tmp_path, qhm):
    """An STL is flattened into a GLB, which is certified in single precision; lost data is reported first."""
    trimesh = pytest.importorskip("trimesh", reason="an independent writer of STL")
    V, F = cat(8)
    trimesh.Trimesh(V, F, process=False).export(tmp_path / "cat.stl")
    status, said, told = qhm(
        "flatten", tmp_path / "cat.stl", "-o", tmp_path / "flat.glb", "--unit-square", "--texture", "checkerboard"
    )
    assert status == 0, said + told
    assert "flat.glb will not have: digits beyond single precision" in told
    status, said, told = qhm("check", tmp_path / "flat.glb")
    assert status == 0, said + told
    status, said, told = qhm("map", tmp_path / "flat.glb", "--to", "disk", "-o", tmp_path / "disk.ply")
    assert status == 0, said + told
    quads = "f 1/1 2/2 3/3 4/4\n"
    (tmp_path / "quad.obj").write_text(SQUARE + quads)
    status, said, told = qhm("polish", tmp_path / "quad.obj", "-o", tmp_path / "quad.glb")
    assert status == 0, said + told
    assert "polygons, which are written as triangles" in told
    status, _, told = qhm("flatten", tmp_path / "cat.stl", "-o", tmp_path / "flat.stl")
    assert status == 2
    assert ".stl files cannot be written" in told


def test_seams_cannot_be_written_to_an_off_file(tmp_path, qhm):
    torn = SQUARE.replace("vt 0 1\n", "vt 0 1\nvt 5 5\nvt 6 6\n") + "f 1/1 2/2 3/3\nf 1/5 3/6 4/4\n"
    (tmp_path / "torn.obj").write_text(torn)
    status, _, told = qhm("repair", tmp_path / "torn.obj", "-o", tmp_path / "out.off")
    assert status == 2
    assert "seams" in told
    status, _, told = qhm("polish", tmp_path / "torn.obj", "-o", tmp_path / "out.off")
    assert status == 2
    assert not (tmp_path / "out.off").exists()


@pytest.mark.slow
def test_a_model_is_drawn_with_its_own_texture(tmp_path, qhm):
    V, F = cat(4)
    texture = io.read_texture(gradient(tmp_path / "photo.png"))
    uv = flatten(V, F, unit_square=True).uv
    pictures = {}
    for name in ("model.obj", "model.glb"):
        model = tmp_path / name
        io.write_mapped(model, MeshData(V, F, texture=texture).with_map(uv))
        assert io.own_texture(io.read_mesh(model)) == texture
        assert qhm("plot", model, "-o", tmp_path / f"{name}.png", "--kind", "texture")[0] == 0
        pictures[name] = (tmp_path / f"{name}.png").read_bytes()
    for name in ("photo.png", "checkerboard"):
        asked = tmp_path / name if name == "photo.png" else name
        assert qhm("plot", tmp_path / "model.obj", "-o", tmp_path / "given.png", "--texture", asked)[0] == 0
        pictures[name] = (tmp_path / "given.png").read_bytes()
    # The positions of a .glb have single precision.
    own, single, given, board = pictures.values()
    assert own == given != board
    assert single != board


def test_models_without_a_usable_texture_have_none(tmp_path):
    V, F = cat(4)
    mesh = MeshData(V, F).with_map(V[:, :2])
    for name in ("a.obj", "a.glb", "a.ply"):
        io.write_mapped(tmp_path / name, mesh)
        assert io.own_texture(io.read_mesh(tmp_path / name)) is None
    text = (tmp_path / "a.obj").read_text()
    (tmp_path / "b.obj").write_text("mtllib b.mtl\n" + text)
    assert io.own_texture(io.read_mesh(tmp_path / "b.obj")) is None
    (tmp_path / "b.mtl").write_text("newmtl m\nmap_Kd missing.png\nmap_Kd b.mtl\n")
    assert io.own_texture(io.read_mesh(tmp_path / "b.obj")) is None


def test_names_of_textures_include_all_kinds_of_images(tmp_path):
    V, F = disk(2)
    model = tmp_path / "m.obj"
    io.write_mapped(model, MeshData(V, F).with_map(V[:, :2]))
    entries = (
        "newmtl a\nKd 1 1 1\nmap_Kd -s 2 2 2 ../colour.png\nmap_aat on\nnorm C:\\all\\normal.png\nbump -bm 1 b.png\n"
    )
    (tmp_path / "m.mtl").write_text(f"{entries}newmtl b\nMap_Kd ../colour.png\n")
    model.write_text(f"mtllib m.mtl\n{model.read_text()}")
    assert io.texture_names(io.read_mesh(model)) == ["colour.png", "normal.png", "b.png"]


def test_names_of_textures_are_those_that_use_the_map(tmp_path):
    V, F = disk(2)
    model = tmp_path / "m.glb"
    io.write_mapped(model, MeshData(V, F, texture=io.checkerboard()).with_map(V[:, :2]))
    mesh = io.read_mesh(model)
    tree = mesh.carried.document.tree
    tree["meshes"][0]["primitives"][0]["material"] = 0
    tree["images"] = [{"uri": f"{k}.png"} for k in range(6)] + [{"name": "seven", "uri": "7.png"}, {"bufferView": 0}]
    tree["textures"] = [{"source": k} for k in range(8)]
    tree["textures"][5]["extensions"] = {"EXT_texture_webp": {"source": 4}}
    tree["materials"] = [
        {
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
            "occlusionTexture": {"index": 1, "texCoord": 1},
            "normalTexture": {"index": 2, "texCoord": 1, "extensions": {"KHR_texture_transform": {"texCoord": 0}}},
            "extensions": {"KHR_materials_clearcoat": {"clearcoatTexture": {"index": 5}}},
            "emissiveTexture": {"index": 6},
        },
        {"emissiveTexture": {"index": 7}},
    ]
    assert io.texture_names(mesh) == ["0.png", "2.png", "5.png", "4.png", "seven"]
    assert io.texture_names(mesh, 1) == ["1.png"]
    for damaged in ({"index": 99}, {"index": "x"}, {"index": 0, "extensions": 3}):
        tree["materials"] = [{"normalTexture": damaged}]
        assert io.texture_names(mesh) == []


@pytest.mark.slow
@pytest.mark.parametrize("words", [["flatten"], ["polish"], ["map", "--to", "disk"], ["repair", "--whole"]])
def test_commands_name_textures_that_do_not_fit_a_new_map(tmp_path, capsys, words):
    V, F = disk(4)
    model, out = tmp_path / "m.obj", tmp_path / "out.obj"
    uv = V[:, :2] * [1, 2]
    uv[0] += 9 if words[0] == "repair" else 0
    io.write_mapped(
        model, MeshData(np.column_stack([V[:, :2], V[:, 0] ** 2]), F, texture=io.checkerboard()).with_map(uv)
    )
    assert main([words[0], str(model), *words[1:], "-o", str(out), "--json", str(tmp_path / "r.json")]) == 0
    sentence = "the new coordinates do not fit the textures of the file: m-texture.png"
    assert sentence in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["old_textures"] == ["m-texture.png"]
    assert main([words[0], str(model), *words[1:], "-o", str(out), "--texture", "checkerboard"]) == 0
    assert "do not fit" not in capsys.readouterr().out


@pytest.mark.slow
def test_textures_fit_a_map_that_does_not_change(tmp_path, capsys):
    V, F = disk(4)
    model = tmp_path / "m.glb"
    io.write_mapped(model, MeshData(V, F, texture=io.checkerboard()).with_map(V[:, :2]))
    assert main(["repair", str(model), "-o", str(tmp_path / "out.glb")]) == 0
    assert "do not fit" not in capsys.readouterr().out
