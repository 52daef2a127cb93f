"""The map in a mesh file, and problems from a mesh file and a file of fixed vertices."""

import json

import numpy as np
import pytest

from quasiharmonic import io, solve
from quasiharmonic.io import MeshFileError
from quasiharmonic.ui.cli import main
from shared.datasets import write_problem
from shared.obj_files import SQUARE, SQUARE_VT, bits, both_readers_agree
from shared.obj_reader import written
from shared.solvable_problems import star_problem

# The map in a mesh


def test_map_without_seams(put):
    shared = io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"))
    assert io.map_of(shared).tolist() == [[0, 0], [2, 0], [2, 2], [0, 2]]
    # The same coordinates with another index are the same position.
    doubled = io.read_mesh(put(SQUARE + SQUARE_VT + "vt -0 0\nf 1/1 2/2 3/3\nf 1/5 3/3 4/4\n"))
    assert io.map_of(doubled).tolist() == io.map_of(shared).tolist()


def test_map_with_seams_is_rejected_with_a_vertex(put):
    seams = io.read_mesh(put(SQUARE + SQUARE_VT + "vt 5 5\nvt 6 5\nf 1/1 2/2 3/3\nf 1/5 3/6 4/4\n"))
    with pytest.raises(MeshFileError, match=r"more than one pair of texture coordinates for vertices 0, 2 \(0-based\)"):
        io.map_of(seams)
    uv, seam = io.vertex_places(seams)
    assert seam.tolist() == [True, False, True, False]
    assert uv[[1, 3]].tolist() == [[2, 0], [0, 2]]
    V, F, places = io.cut_at_seams(seams)
    assert F.tolist() == [[0, 1, 2], [4, 5, 3]]
    assert np.array_equal(V, seams.V[[0, 1, 2, 3, 0, 2]])
    assert np.array_equal(places[F], seams.vt[seams.FT])


def test_rounding_in_z_leaves_a_mesh_planar(put):
    mesh = io.read_mesh(put(SQUARE.replace("v 1 1 0", "v 1 1 1e-17") + "f 1 2 3\nf 1 3 4\n"))
    assert (mesh.V[:, 2] != 0).any()
    assert np.array_equal(io.map_of(mesh), mesh.V[:, :2])
    with pytest.raises(MeshFileError, match="is not planar"):
        io.map_of(io.read_mesh(put(SQUARE.replace("v 1 1 0", "v 1 1 1e-3") + "f 1 2 3\nf 1 3 4\n")))


def test_map_of_some_faces_only_is_rejected(put):
    with pytest.raises(MeshFileError, match=r"face 1 \(0-based\) without texture coordinates"):
        io.map_of(io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\nf 1 3 4\n")))
    with pytest.raises(MeshFileError, match=r"face 1 \(0-based\) .*qhm unwrap --faces"):
        io.map_of(io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3 4/4\nf 1 3 4\n")))


def test_a_vertex_without_a_face_has_no_position(put):
    uv = io.map_of(io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\n")))
    assert np.isnan(uv).tolist() == [[False] * 2] * 3 + [[True] * 2]


def test_positions_are_the_map_of_a_planar_mesh(put):
    planar = io.read_mesh(put(SQUARE.replace(" 0\n", " 7\n") + "f 1 2 3\n"))
    assert io.map_of(planar).tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]
    with pytest.raises(MeshFileError, match="no texture coordinates and is not planar"):
        io.map_of(io.read_mesh(put(SQUARE + "v 0 0 1\nf 1 2 3\nf 1 2 5\n")))
    # Flat surfaces of the cortex have vertices outside the map.
    assert io.map_of(io.read_mesh(put(SQUARE + "v 0 0 1\nf 1 2 3\n"))).shape == (5, 2)


# Problems


FAN = (
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv .5 .5 1\n"
    "vt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\nvt 1.5 0.25\n"
    "f 1/1 2/2 5/5\nf 2/2 3/3 5/5\nf 3/3 4/4 5/5\nf 4/4 1/1 5/5\n"
)


def test_without_handles_the_boundary_is_fixed(put, tmp_path):
    for source in (put(FAN, "input.obj"), tmp_path):
        V, F, fixed, target = io.read_problem(source)
        assert (V.shape, F.shape, fixed.tolist()) == ((5, 3), (4, 3), [0, 1, 2, 3])
        assert target.tolist() == [[0, 0], [2, 0], [2, 2], [0, 2]]


def test_handles_may_pin_the_interior(put, tmp_path):
    put(FAN, "input.obj")
    handles = put("# pins\n3\n4\n\n 0 # corner\r\n1\n2", "handles.txt")
    for problem in (io.read_problem(tmp_path), io.read_problem(tmp_path / "input.obj", handles)):
        assert problem.fixed.tolist() == [3, 4, 0, 1, 2]
        assert problem.target.tolist() == [[0, 2], [1.5, 0.25], [0, 0], [2, 0], [2, 2]]
    # A mesh file named directly is used without the handles file next to it.
    assert io.read_problem(tmp_path / "input.obj").fixed.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0\n1\n5\n", "vertex 5 does not exist in a mesh of 5 vertices at line 3; indices count from 0"),
        ("0\n-1\n", "vertex -1 does not exist in a mesh of 5 vertices at line 2"),
        ("0\n1\n\n1\n", "vertex 1, already named at line 2, again at line 4"),
        ("0\n1 2\n", "'1 2' is not an integer at line 2; give one vertex index per line"),
        ("1.0\n", "'1.0' is not an integer at line 1"),
        (f"{10**30}\n", "far too large at line 1"),
        ("# none\n\n", "lists no vertices"),
        (b"\xff\xfe0\0", "UTF-16"),
        (b"0\n\0", "a NUL byte at line 2"),
    ],
)
def test_malformed_handles_are_named_with_their_line(put, text, message):
    with pytest.raises(MeshFileError) as caught:
        io.read_handles(put(text, "handles.txt"), 5)
    assert message in str(caught.value)


def test_problems_without_target_positions(put, tmp_path):
    with pytest.raises(MeshFileError, match="the fixed vertices have no target positions"):
        io.read_problem(put(SQUARE + "f 1 2 3\nf 1 3 4\n"))
    with pytest.raises(MeshFileError, match="no such file"):
        io.read_problem(tmp_path)
    pinned = put("3\n", "handles.txt")
    with pytest.raises(MeshFileError, match=r"no texture coordinates for the fixed vertex 3 \(0-based\)"):
        io.read_problem(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\n"), pinned)
    torn = put(SQUARE + SQUARE_VT + "vt 5 5\nf 1/1 2/2 3/3\nf 1/5 3/3 4/4\n")
    with pytest.raises(MeshFileError, match=r"more than one pair of texture coordinates for the fixed vertex 0 "):
        io.read_problem(torn)
    assert io.read_problem(torn, pinned).target.tolist() == [[0, 2]]
    closed = "f 1/1 3/3 2/2\nf 1/1 2/2 4/4\nf 2/2 3/3 4/4\nf 3/3 1/1 4/4\n"
    with pytest.raises(MeshFileError, match="no boundary"):
        io.read_problem(put(SQUARE + SQUARE_VT + closed))


def test_problems_in_every_combination_of_formats(tmp_path):
    V, F, fixed, target = star_problem()
    path, out = tmp_path / "star" / "input.obj", tmp_path / "out.obj"
    write_problem(path.parent, V, F, fixed, target)
    assert both_readers_agree(path)
    mesh = io.read_mesh(path)
    assert all(map(np.array_equal, io.read_problem(path.parent), (V, F, fixed, target)))
    uv = io.map_of(mesh)
    assert np.array_equal(uv[fixed], target)
    moved = uv + np.random.default_rng(0).normal(size=uv.shape)
    io.write_map(out, mesh, moved)
    # Written as plain text, without the library.
    found = written(out)
    assert bits(found.uv) == bits(moved)
    assert np.array_equal(found.F, F)
    again = io.read_mesh(out)
    assert bits(again.V) == bits(found.V) == bits(V)
    assert bits(io.map_of(again)) == bits(moved)


def test_a_folder_is_solved_by_a_single_descent(tmp_path, capsys):
    V, F, fixed, target = star_problem(6)[:4]
    write_problem(tmp_path / "a", V, F, fixed, target)
    result = solve(io.read_problem(tmp_path / "a"))
    assert result.success
    history = result.to_dict()["history"]
    assert [step["iteration"] for step in history] == [step.iteration for step in result.history]
    assert json.loads(json.dumps(history))[-1]["inverted"] == 0
    descent = "--functional", "sobolev", "--parameterisation", "si-log", "--iterations", "3"
    command = ["map", str(tmp_path / "a"), "-o", str(tmp_path / "m.obj"), "--no-polish", *descent]
    main([*command, "--json", str(tmp_path / "r.json")])
    report = json.loads((tmp_path / "r.json").read_text())
    assert [stage["name"] for stage in report["stages"]] == ["vector-adam, si-log, sobolev"]
    assert report["n_iterations"] <= 3
    assert main([*command, "--strategy", "paper"]) == 2
    assert "omit --functional, or --strategy" in capsys.readouterr().err
