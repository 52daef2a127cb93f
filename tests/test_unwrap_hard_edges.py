"""Hard edges become seams: by angle, listed, and as the file shades them."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import io, unwrap
from quasiharmonic.surfaces import starfish
from shared.commands import run

# A strip of four squares along x; its normals are split at x = 2.
POINTS = [(x, y, 0.0) for x in range(5) for y in range(2)]
QUADS = [(2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1) for k in range(4)]
AT_2 = {(4, 5)}


def write_strip(path, corner, *, between=()):
    """Write the strip; ``corner(k, v)`` is the text of a corner of face k, ``between[k]`` a line before face k."""
    lines = [f"v {x} {y} {z}" for x, y, z in POINTS] + ["vn 0 0 1", "vn 0 0.6 0.8", "vn 0 0 2"]
    for k, quad in enumerate(QUADS):
        lines += [between[k]] if between else []
        lines.append("f " + " ".join(corner(k, v) for v in quad))
    path.write_text("\n".join(lines) + "\n")
    return path


def split_normals(k, v):
    # Equal directions of different length are one normal.
    return f"{v + 1}//{(3 if k % 2 else 1) if k < 2 else 2}"


def edges_of(result):
    return {tuple(edge) for edge in result.seams.tolist()}


def test_split_normals_of_an_obj_file(tmp_path):
    path = write_strip(tmp_path / "strip.obj", split_normals)
    for mesh in (path, str(path), io.read_mesh(path)):
        assert edges_of(unwrap(mesh, hard_edges="file", resolution=64)) == AT_2
    assert edges_of(unwrap(V=path, hard_edges="file", resolution=64)) == AT_2
    assert not edges_of(unwrap(path, resolution=64))
    # One end suffices.
    path = write_strip(tmp_path / "strip.obj", lambda k, v: f"{v + 1}//{2 if k == 2 and v == 4 else 1}")
    assert edges_of(unwrap(path, hard_edges="file", resolution=64)) == AT_2


@pytest.mark.parametrize(
    ("groups", "expected"),
    [
        (["s 1", "s 1", "s 7", "s 7"], AT_2),
        (["s 1", "", "s off", "s 0"], {(4, 5), (6, 7)}),
        (["", "s 1", "", ""], {(2, 3)}),
    ],
)
def test_smoothing_groups_of_an_obj_file(tmp_path, groups, expected):
    path = write_strip(tmp_path / "strip.obj", lambda k, v: str(v + 1), between=groups)
    assert edges_of(unwrap(path, hard_edges="file", resolution=64)) == expected


@pytest.mark.parametrize("suffix", [".glb", ".ply"])
def test_vertices_that_other_formats_split(tmp_path, suffix):
    """At x = 2, vertices have the same position and different normals."""
    points = np.array([*POINTS, POINTS[4], POINTS[5]])
    F = np.array([[a, b, c] for a, b, c, _ in QUADS] + [[a, c, d] for a, _, c, d in QUADS])
    F[(2, 6), :] = np.where(np.isin(F[(2, 6), :], (4, 5)), F[(2, 6), :] + 6, F[(2, 6), :])
    normals = b"".join(b"vn 0 0 1\n" if k in (0, 1, 2, 3, 4, 5) else b"vn 0 0.6 0.8\n" for k in range(len(points)))
    path = tmp_path / f"strip{suffix}"
    io.write_mapped(path, io.MeshData(points, F, vt=points[:, :2] / 4, FT=F, normals=normals, FN=F))
    result = unwrap(path, hard_edges="file", resolution=64)
    places = {frozenset(map(tuple, ends)) for ends in result.V[result.seams].tolist()}
    assert places == {frozenset([(2.0, 0.0, 0.0), (2.0, 1.0, 0.0)])}
    assert not len(unwrap(path, resolution=64).seams)


def test_listed_edges_and_edges_that_must_not_be_seams():
    V, F = starfish(2, 4)
    edge = sorted(F[3, :2].tolist())
    free = unwrap(V, F, resolution=128)
    assert edge not in free.seams.tolist()
    assert edge in unwrap(V, F, resolution=128, hard_edges=[edge]).seams.tolist()
    assert edge not in unwrap(V, F, resolution=128, hard_edges=[edge], no_seams=[edge]).seams.tolist()
    np.testing.assert_array_equal(unwrap(V, F, resolution=128, hard_edges=[]).seams, free.seams)


def test_wrong_hard_edges_are_named(tmp_path):
    V, F = starfish(2, 4)
    for wrong in ("file", "files", 0, 181, True, np.nan):
        with pytest.raises(ValueError, match="hard_edges"):
            unwrap(V, F, hard_edges=wrong)
    with pytest.raises(ValueError, match=r"hard_edges: edge \(0, 0\): not an edge of the mesh"):
        unwrap(V, F, hard_edges=[[0, 0]])
    path = write_strip(tmp_path / "strip.obj", lambda k, v: str(v + 1))
    with pytest.raises(ValueError, match="neither normals at all corners nor smoothing groups: pass an angle"):
        unwrap(path, hard_edges="file")


def test_hard_edges_on_the_command_line(tmp_path, capsys):
    path, out = write_strip(tmp_path / "strip.obj", split_normals), tmp_path / "out.obj"
    assert run("unwrap", path, "-o", out, "--hard-edges", "file", "--resolution", 64) == 0
    expected = unwrap(path, hard_edges="file", resolution=64)
    written = io.read_mesh(out)
    assert len(np.unique(written.vt, axis=0)) == len(np.unique(expected.uvs, axis=0)) == 12
    with pytest.raises(SystemExit):
        run("unwrap", path, "-o", out, "--hard-edges", "200")
    assert "--hard-edges: 200 is not an angle from 0 to 180 degrees" in capsys.readouterr().err
