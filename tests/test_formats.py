"""The registry of formats: each format passes the same tests, and an unknown suffix is an error everywhere."""

from __future__ import annotations

import re
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import quasiharmonic
from quasiharmonic import io
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.io.fem.files import check_fem_output, read_fem
from quasiharmonic.surfaces import disk, grid
from quasiharmonic.ui.cli import COMMANDS, main
from shared.formats import SINGLE, try_format, with_map

BY_SUFFIX = {form.suffix: form for form in io.FORMATS}
NEEDED = "needs nibabel: .ci/optional installs it"


def needed(form):
    """The package that a round trip needs; of a patch, the triangles are in a surface of FreeSurfer."""
    return form.requires or ("nibabel" if form.read_written else "numpy")


MAPS = [
    pytest.param(form.suffix, marks=pytest.mark.skipif(not find_spec(needed(form)), reason=NEEDED))
    for form in io.FORMATS
    if form.write_map
]


def test_the_registry_is_consistent():
    assert len(BY_SUFFIX) == len(io.FORMATS)
    for form in io.FORMATS:
        assert re.fullmatch(r"\.[a-z]+(\.3d)?", form.suffix)
        assert form.read or form.read_elements or form.encode_values
        # A map that is written can be read back, and its losses are listed before.
        assert (form.write_map is None) == (form.list_losses is None)
        assert form.write_map is None or form.read is not None
        assert form.write_map is not None or not (form.seams or form.image)
    # STL cannot store a map.
    assert set(io.suffixes("read")) - set(io.suffixes("write_map")) == {".stl"}
    assert io.suffixes("read", "seams") == (".obj", ".ply", ".glb", ".gltf")
    assert io.suffixes("read_elements") == (".msh", ".vtk", ".vtu", ".mesh")
    assert io.format_names("read") == ("OBJ, OFF, PLY, GLB, glTF, STL, GIFTI, FreeSurfer patch or FreeSurfer surface")
    assert io.format_names("encode_values", "seams") == "PLY"


@pytest.mark.parametrize("suffix", MAPS)
def test_every_format_reads_back_what_it_writes(suffix, tmp_path):
    form = BY_SUFFIX[suffix]
    try_format(form.read, with_map(form.write_map), tmp_path / f"mesh{suffix}")


@pytest.mark.parametrize("suffix", MAPS)
def test_suffix_chooses_the_format(suffix, tmp_path):
    try_format(io.read_mesh, io.write_map, tmp_path / f"mesh{suffix.upper()}")


@pytest.mark.parametrize("suffix", MAPS)
def test_losses_are_listed_for_every_format(suffix):
    lost = io.not_held(f"out{suffix}", io.MeshData(*disk(2)))
    assert any("single precision" in what for what in lost) == (suffix in SINGLE)


def test_digits_that_a_glb_file_loses_are_listed_only_if_there_are_any():
    V, F = grid(4, 4)
    lost = ["digits beyond single precision"]
    for points, uv, named in ((V, V, []), (V / 3, V, lost), (V, V / 3, lost), (V, V * 2**-30, lost)):
        assert io.not_held("out.glb", io.MeshData(points, F).with_map(uv)) == named


@pytest.mark.parametrize("suffix", MAPS)
def test_seams_are_kept_or_refused(suffix, tmp_path):
    path, (V, F) = tmp_path / f"out{suffix}", disk(2)
    mesh = io.MeshData(V, F)
    # Every triangle has a place of its own.
    shifted = V[F].reshape(-1, 2) + np.repeat(4.0 * np.arange(len(F)), 3)[:, None]
    mesh = mesh.with_places(SeamedMesh(mesh.V, F, np.arange(F.size).reshape(-1, 3), shifted))
    if BY_SUFFIX[suffix].seams:
        io.write_mapped(path, mesh)
        assert io.vertex_places(io.read_mesh(path))[1].any()
    else:
        with pytest.raises(io.MeshFileError, match="more than one pair"):
            io.write_mapped(path, mesh)


@pytest.mark.parametrize("suffix", MAPS)
def test_images_are_in_the_files_that_the_registry_names(suffix, tmp_path):
    path, (V, F), form = tmp_path / f"out{suffix}", disk(2), BY_SUFFIX[suffix]
    io.write_map(path, io.MeshData(V, F), V)
    plain = path.stat().st_size
    texture = io.checkerboard()
    io.write_map(path, io.MeshData(V, F, texture=texture), V)
    beside = set() if form.companions is None else set(form.companions(path, texture))
    assert set(tmp_path.iterdir()) == {path, *beside}
    size = sum(file.stat().st_size for file in (path, *beside))
    assert (size > plain + len(texture.data)) == form.image


UNKNOWN = "mesh.xyz", "mesh", ".obj", "mesh.obj.gz"


@pytest.mark.parametrize("name", UNKNOWN)
@pytest.mark.parametrize(
    ("call", "needs"),
    [
        (io.read_mesh, ["read"]),
        (io.read_problem, ["read"]),
        (read_fem, ["read_elements"]),
        (lambda path: io.write_map(path, io.MeshData(*disk(1)), disk(1)[0]), ["write_map"]),
        (io.check_output, ["write_map"]),
        (lambda path: io.not_held(path, io.MeshData(*disk(1))), ["write_map"]),
        (lambda path: io.write_per_triangle(path, *disk(1), disk(1)[0], {}), ["encode_values"]),
        (lambda path: io.find_format(path, "write_map", "seams"), ["write_map", "seams"]),
    ],
)
def test_an_unknown_suffix_is_an_error_that_lists_the_supported_ones(call, needs, name, tmp_path):
    (tmp_path / name).write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    listed = "supported: " + ", ".join(io.suffixes(*needs))
    with pytest.raises(io.MeshFileError, match=re.escape(listed) + "$"):
        call(tmp_path / name)


# Commands that write a mesh or values, with the features that their output needs.
WRITERS = {
    "map in.obj -o {}": ["write_map"],
    "flatten in.obj -o {}": ["write_map"],
    "polish in.obj -o {}": ["write_map"],
    "harmonise in.obj -o {}": ["write_map"],
    "repair in.obj -o {}": ["write_map", "seams"],
    "measure in.obj --export {}": ["encode_values"],
}


@pytest.mark.parametrize(
    ("call", "name"),
    [
        *product(WRITERS, UNKNOWN),
        ("repair in.obj -o {}", "mesh.off"),
        ("polish in.obj -o {} --texture checkerboard", "mesh.ply"),
    ],
)
def test_commands_list_the_supported_suffixes(call, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    V, F = disk(2)
    io.write_map("in.obj", io.MeshData(V, F), V)
    assert main(call.format(name).split()) == 2
    error = capsys.readouterr().err
    needs = WRITERS.get(call, ["write_map", "image"])
    assert error.endswith(f"supported: {', '.join(io.suffixes(*needs))}\n")
    assert [path.name for path in tmp_path.iterdir()] == ["in.obj"]


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        ("refine in.obj -o mesh.xyz", "must be written as .obj"),
        ("morph in.msh --field u -o mesh.xyz", "a .msh file can only be written as .msh"),
        ("animate in.obj in.obj -o mesh.xyz", "give a moving picture (.gif, .mp4) or a folder"),
    ],
)
def test_commands_that_fix_the_format(call, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(call.split()) == 2
    assert expected in capsys.readouterr().err
    with pytest.raises(io.MeshFileError, match="could lose"):
        check_fem_output("out.vtu", "in.msh")


def test_help_texts_list_the_formats(capsys):
    listed = set()
    for command in COMMANDS:
        with pytest.raises(SystemExit):
            main([command, "--help"])
        text = " ".join(capsys.readouterr().out.split())
        listed |= {command} if io.format_names("write_map") + " file to write" in text else set()
    assert listed == {"map", "flatten", "polish", "harmonise"}


def test_the_page_accepts_the_surfaces_of_a_single_file():
    page = (Path(quasiharmonic.__file__).parent / "ui/studio/static/index.html").read_text(encoding="utf-8")
    (accepted,) = re.findall(r'<input id="open" type="file"[^>]* accept="([^"]*)"', page)
    assert accepted.split(",") == [*io.suffixes("read", "single_file"), ".svg", ".png", ".jpg", ".jpeg"]


def test_every_suffix_has_one_format():
    suffixes = [one.suffix for one in io.FORMATS]
    assert len(suffixes) == len(set(suffixes))
