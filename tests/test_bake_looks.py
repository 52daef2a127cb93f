"""What `bake` reads of the looks of OBJ and PLY files, and what it lists as not baked."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from quasiharmonic import bake, io

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
PIXELS = np.random.default_rng(0).integers(0, 256, (4, 4, 3), dtype=np.uint8)


def with_material(folder, entries, *names):
    """Write a textured square whose material has some entries, and the image by several names; return the mesh."""
    file = BytesIO()
    Image.fromarray(PIXELS).save(file, "PNG")
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(file.getvalue())
    (folder / "m.mtl").write_text(f"newmtl m\n{entries}\n")
    (folder / "old.obj").write_text("mtllib m.mtl\n" + SQUARE)
    return io.read_mesh(folder / "old.obj")


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ("map_Kd my own t.png", "my own t.png"),
        ('map_Kd "my t.png"', "my t.png"),
        ("map_Kd sub\\t.png", "sub/t.png"),
        ("map_Kd -blendu on -texres 512 -s 1 1 1 t.png", "t.png"),
        ("map_Kd -unknown 7 t.png", "t.png"),
    ],
)
def test_names_of_images(tmp_path, entry, name):
    old = with_material(tmp_path, entry, name)
    result = bake(old, old, size=4)
    assert result.success, result.summary()
    assert np.array_equal(result.colour[..., :3], PIXELS)
    assert io.own_texture(old) is not None
    assert io.texture_names(old) == [name.rpartition("/")[2]]


def test_a_name_with_a_blank_is_not_that_of_another_file(tmp_path):
    old = with_material(tmp_path, "map_Kd my t.png", "t.png")
    result = bake(old, old, size=4)
    assert len(result.problems) == 1
    assert "my t.png" in result.problems[0]


@pytest.mark.parametrize("library", ["gone.mtl", "../m.mtl", "other.mtl"])
def test_a_material_that_no_library_in_the_folder_has_is_listed(tmp_path, library):
    (tmp_path / "sub").mkdir()
    (tmp_path / "m.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "sub/other.mtl").write_text("newmtl n\nKd 1 0 0\n")
    text = f"mtllib {library}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    (tmp_path / "sub/a.obj").write_text(text)
    old = io.read_mesh(tmp_path / "sub/a.obj")
    assert bake(old, old, size=4).problems == ("material m is in no material library in the folder of the file",)


@pytest.mark.parametrize("line", ['"c d.mtl"', 'n.mtl "c d.mtl"', '"c d.mtl" n.mtl', "c d.mtl"])
def test_names_of_libraries_may_have_blanks_and_quotes(tmp_path, line):
    (tmp_path / "c d.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(f"mtllib {line}\n{SQUARE}")
    old = io.read_mesh(tmp_path / "a.obj")
    result = bake(old, old, size=4)
    assert result.problems == ()
    assert (result.colour[..., :3] == [255, 0, 0]).all()


def test_an_image_is_repeated_and_shifted(tmp_path):
    old = with_material(tmp_path, "map_Kd -s 2 1 -o 0 0.5 t.png", "t.png")
    result = bake(old, old, size=(8, 4))
    assert result.success
    assert np.array_equal(result.colour[..., :3], np.roll(np.tile(PIXELS, (1, 2, 1)), 2, axis=0))


def test_factors_and_what_is_not_baked(tmp_path):
    entries = "Pr 0.25\nPm 1\nPs 0\nPc 0.5\ndisp d.png\nrefl -type sphere r.png\nmap_Kd -mm 0 0.5 -o 0.5 t.png"
    old = with_material(tmp_path, entries, "t.png")
    result = bake(old, old, size=4)
    texture = result.mesh.texture
    assert (texture.metallic, texture.roughness) == (1.0, 0.25)
    assert result.problems == (
        "Pc of material m is not baked",
        "disp of material m is not baked",
        "refl of material m is not baked",
        "-mm of map_Kd of material m is not baked",
    )


def write_ply(path, columns, rows, face="", colour="", remark=""):
    lines = ["ply", "format ascii 1.0", *([f"comment {remark}"] if remark else []), "element vertex 4"]
    lines += [f"property {kind} {name}" for kind, name in columns]
    lines += ["element face 2", "property list uchar int vertex_indices", *([face] if face else []), "end_header"]
    lines += [" ".join(map(str, row)) for row in rows]
    path.write_text("\n".join([*lines, f"3 0 1 2 {colour}", f"3 0 2 3 {colour}", ""]))
    return io.read_mesh(path)


CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
XYZ = [("double", name) for name in "xyz"]


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({"face": "property uchar red", "colour": "7"}, "red of face"),
        ({"remark": "TextureFile t.png"}, "TextureFile t.png"),
        ({"columns": [*XYZ, ("uchar", "diffuse_red")], "rows": [(*p, 7) for p in CORNERS]}, "diffuse_red of vertex"),
    ],
)
def test_looks_of_ply_files_that_are_not_read_are_named(tmp_path, more, named):
    old = write_ply(tmp_path / "old.ply", **({"columns": XYZ, "rows": CORNERS} | more))
    result = bake(old, old.with_map(old.V[:, :2]), size=4)
    assert result.problems == (f"{named} is not baked",)
    assert io.not_held(tmp_path / "new.glb", old) == [named]
    assert io.not_held(tmp_path / "new.ply", old) == []


def test_opacity_of_vertices_is_baked(tmp_path):
    columns = [*XYZ, *(("uchar", name) for name in ("red", "green", "blue", "alpha"))]
    old = write_ply(tmp_path / "old.ply", columns, [(*p, 255, 0, 0, 51) for p in CORNERS])
    result = bake(old, old.with_map(old.V[:, :2]), size=4)
    assert result.success
    assert (result.colour == [255, 0, 0, 51]).all()
    assert result.mesh.texture.alpha_mode == "BLEND"


def test_colours_that_are_none_are_named_and_their_number_is_checked():
    V, F = np.array(CORNERS, float), np.array([[0, 1, 2], [0, 2, 3]])
    old = io.MeshData(V, F, extra=np.full((4, 3), 255.0))
    new = old.with_map(V[:, :2])
    assert "colours of vertices are not baked" in bake(old, new, size=4).summary()
    with pytest.raises(ValueError, match="extra data for 3 vertices, but 4 vertices"):
        bake(io.MeshData(V, F, extra=np.ones((3, 3))), new, size=4)


def test_triangles_that_leave_the_unit_square_are_counted():
    V, F = np.array(CORNERS, float), np.array([[0, 1, 2], [0, 2, 3]])
    old = io.MeshData(V, F)
    baked = bake(old, old.with_map(3 * V[:, :2] - 1), size=4)
    unbaked = "2 triangles reach beyond the unit square of the new texture coordinates, where nothing is baked"
    assert unbaked in baked.problems[0]
    assert "correct the models as listed" in baked.message
    assert bake(old, old.with_map(V[:, :2] * (1 + 1e-9)), size=4).success
    with pytest.raises(ValueError, match="no texture coordinates in the unit square"):
        bake(old, old.with_map(V[:, :2] + [1, 0]), size=4)
