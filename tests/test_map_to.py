"""`qhm map --to`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import io, surfaces, targets
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.targets import boundary_to, outline
from quasiharmonic.ui.cli import main
from shared.boundaries import plain_grid, torus
from shared.obj_reader import written

# --- the command


@pytest.fixture
def qhm(tmp_path, capsys):
    """Write a mesh without vt, map it, and return status, report and output."""

    def run(mesh, *options):
        io.write_obj(tmp_path / "in.obj", io.MeshData(*mesh))
        report = tmp_path / "report.json"
        report.unlink(missing_ok=True)
        status = main(
            ["map", str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj"), "--json", str(report), *options]
        )
        said = capsys.readouterr()
        return status, json.loads(report.read_text()) if report.exists() else None, said.out + said.err

    run.out = tmp_path / "out.obj"
    return run


@pytest.mark.parametrize("text", ["disk", "letter:G", "rect:2x1", "star:5"])
def test_the_boundary_gets_the_named_outline(qhm, text):
    V, F = surfaces.cat(12)
    status, facts, _ = qhm((V, F), "--to", text)
    assert status == 0
    assert facts["injective"]
    assert facts["to"] == text
    written = io.read_mesh(qhm.out)
    assert np.array_equal(written.F, F)
    fixed, target = boundary_to(V, F, outline(text))
    assert np.array_equal(io.map_of(written)[fixed], target)


@pytest.mark.slow
def test_outlines_from_files_may_have_holes(qhm, tmp_path):
    (tmp_path / "o.svg").write_text('<svg><path d="M0 0h4v3h-4zm1 1h1v1h-1z" fill-rule="evenodd"/></svg>')
    (tmp_path / "o.txt").write_text("0 0\n4 0\n4 3\n0 3\n\n1 1\n2 1\n2 2\n1 2\n")
    for name in ("o.svg", "o.txt"):
        status, facts, _ = qhm(surfaces.annulus(8), "--to", str(tmp_path / name))
        assert status == 0
        assert facts["bijective"]


@pytest.mark.slow
def test_to_with_corners(qhm):
    V, F = surfaces.cat(12)
    loop = boundary_loops(F, len(V))[0].tolist()
    a, b, c, d = (loop[k] for k in (5, 20, 41, 66))
    assert qhm((V, F), "--to", "rect:2x1", "--corners", f"{a},{b},{c},{d}")[0] == 0
    assert io.map_of(io.read_mesh(qhm.out))[[a, b, c, d]].tolist() == [[0, 0], [2, 0], [2, 1], [0, 1]]
    assert qhm((V, F), "--to", "rect:2x1", "--corners", f"{a}:1,{b}:1.5:1")[0] == 0
    assert io.map_of(io.read_mesh(qhm.out))[[a, b]].tolist() == [[2, 0], [1.5, 1]]


@pytest.mark.slow
def test_to_edge_by_edge_from_a_file(qhm, tmp_path):
    V, F = surfaces.cat(12)
    loop = boundary_loops(F, len(V))[0]
    square = [(0, 0), (0.5, -0.01), (1, 0), (1, 1), (0, 1)]
    (tmp_path / "o.txt").write_text("".join(f"{x} {y}\n" for x, y in square))
    chosen = loop[[2, 10, 20, 40, 70]].tolist()
    to = ["--to", str(tmp_path / "o.txt"), "--corners", str(tmp_path / "pairs"), "--corner-angle", "0"]
    for text in ("{} {}\n", "{}:{} # a comment\n\n"):
        (tmp_path / "pairs").write_text("".join(text.format(v, k) for k, v in enumerate(chosen)))
        assert qhm((V, F), *to)[0] == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(qhm.out))[chosen], square)
    status, _, said = qhm((V, F), *to[:4], "--json", str(tmp_path / "pairs"))
    assert status == 2
    assert "would replace an input" in said
    # Without it, the slight bend has no number.
    status, _, said = qhm((V, F), *to[:4])
    assert status == 2
    assert "goes to corner 4, but the contour has corners 0 to 3: 0 at (0, 0), 1 at (1, 0)" in said


def grouped(path, V, F):
    """Write an OBJ file with colours and two groups."""
    with path.open("w") as file:
        file.writelines(f"v {x} {y} {z} {k / len(V)} 0 0\n" for k, (x, y, z) in enumerate(V))
        for name, part in (("first", F[: len(F) // 2]), ("second", F[len(F) // 2 :])):
            file.write(f"g {name}\nusemtl of_{name}\n")
            file.writelines(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in part)


def groups(path):
    """Return the faces of each group, and vertices with their colours."""
    found, lines = {}, path.read_text().splitlines()
    for line in lines:
        if line.startswith("g "):
            here = found.setdefault(line[2:], [])
        if line.startswith("f "):
            here.append([int(word.split("/")[0]) - 1 for word in line.split()[1:]])
    return found, np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float)


@pytest.mark.slow
def test_cut_and_refined_files_keep_groups_and_colours(tmp_path):
    V, F = torus()
    grouped(tmp_path / "in.obj", V, F)
    out = tmp_path / "out.obj"
    assert main(["map", str(tmp_path / "in.obj"), "-o", str(out), "--to", "letter:H", "--cut", "--refine"]) == 0
    found, vertices = groups(out)
    assert list(found) == ["first", "second"]
    assert "usemtl of_second" in out.read_text()
    assert len(vertices) >= len(V)
    np.testing.assert_array_equal(vertices[: len(V), 3], np.arange(len(V)) / len(V))
    assert np.isfinite(vertices[:, 3]).all()
    # After splits, a group covers the same area of the surface.
    area = lambda V, F: np.linalg.norm(np.cross(*(V[F[:, k]] - V[F[:, 0]] for k in (1, 2))), axis=1).sum()  # noqa: E731
    for part, before in (("first", F[: len(F) // 2]), ("second", F[len(F) // 2 :])):
        assert area(vertices[:, :3], np.array(found[part])) == pytest.approx(area(V, before))


@pytest.mark.slow
def test_holes_missing_in_the_outline_are_filled(qhm):
    status, facts, said = qhm(surfaces.cat(12), "--to", "letter:B", "--font", "DejaVu Sans")
    assert status == 0
    assert facts["filled_holes"] == 2
    assert "the surface has no hole, so the 2 holes of letter:B are filled" in said


@pytest.mark.slow
def test_to_a_word(qhm):
    pytest.importorskip("shapely")
    assert qhm(surfaces.cat(20), "--to", "word:QH")[0] == 0


@pytest.mark.long
def test_rejection_and_refinement(qhm):
    V, F = surfaces.disk(2)
    ring = np.arange(len(V) - 12, len(V))
    # A triangle on every boundary edge.
    tips = 1.2 * (V[ring] + V[np.roll(ring, -1)]) / 2
    ears = np.stack([np.roll(ring, -1), ring, len(V) + np.arange(12)], axis=1)
    V, F = np.vstack([V, tips]), np.vstack([F, ears])
    status, _, said = qhm((V, F), "--to", "rect:2x1")
    assert status == 2
    assert "in.obj: the inner edges" in said
    assert "boundary vertices between which rect:2x1 does not bend outwards" in said
    assert "--refine" in said
    assert not qhm.out.exists()
    status, facts, said = qhm((V, F), "--to", "rect:2x1", "--refine")
    assert status == 0
    assert facts["added_vertices"] >= 8
    assert f"split {facts['added_vertices']} edges" in said
    written = io.read_mesh(qhm.out)
    assert np.array_equal(written.V[: len(V), :2], V)
    assert len(written.V) == len(V) + facts["added_vertices"] == facts["vertices"]


@pytest.mark.long
def test_refine_without_to(tmp_path, capsys):
    """It treats positions in the file like an outline."""
    V, F = plain_grid(4, 4)
    fixed = boundary_loops(F, len(V))[0]
    uv = np.full((len(V), 2), 0.5)
    uv[fixed] = targets.arc_length(V[fixed], targets.rectangle(1, 1), start=int(np.flatnonzero(fixed == 2)[0]))
    io.write_obj(tmp_path / "in.obj", io.MeshData(V, F).with_map(uv))
    arguments = ["map", str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj")]
    assert main(arguments) == 1
    assert main([*arguments, "--refine"]) == 0
    np.testing.assert_array_equal(io.map_of(io.read_mesh(tmp_path / "out.obj"))[fixed], uv[fixed])


@pytest.mark.slow
def test_closed_surfaces(qhm):
    status, _, said = qhm(torus(), "--to", "disk")
    assert status == 2
    assert "the surface is closed" in said
    assert "--cut" in said
    V, F = torus()
    status, facts, said = qhm((V, F), "--to", "letter:G", "--cut")
    assert status == 0
    assert f"cut along {facts['cut_edges']} edges: seams of the map" in said
    written = io.read_mesh(qhm.out)
    np.testing.assert_array_equal(written.V, V)
    np.testing.assert_array_equal(written.F, F)
    assert len(io.mapped(written).seams) == facts["cut_edges"]


def test_non_manifold_surfaces_are_reported(qhm):
    """A strip with half a twist has one boundary loop with all vertices; the error is its orientation."""
    i, V = np.arange(0, 20, 2), np.random.default_rng(0).normal(size=(20, 3))
    a, b, c, d = i, i + 1, (i + 2) % 20, (i + 3) % 20
    c[-1], d[-1] = 1, 0
    F = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    for onto in ("disk", "letter:A"):
        status, _, said = qhm((V, F), "--to", onto)
        assert status == 2
        assert "mixed winding: edge (0, 1) traversed" in said


def test_flat_triangles_are_reported_with_their_file(qhm):
    V, F = surfaces.disk(3)
    V[3] = V[0]
    status, _, said = qhm((V, F), "--to", "disk")
    assert status == 2
    assert "in.obj --to disk: triangle" in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--corners", "3"], "--corners applies only to an outline: give one by --to"),
        (["--font", "x"], "--font applies only to an outline"),
        (["--cut"], "--cut applies only to an outline"),
        (["--to", "lettr:G"], "unknown outline 'lettr:G'"),
        (["--to", "none.svg"], "none.svg: there is no such file"),
        (["--to", "disk", "--font", "x"], "'disk' takes no font"),
        (["--to", "rect:1x1", "--corners", "0"], "in.obj --to rect:1x1: vertex 0 in corners, but not on the boundary"),
        (["--to", "letter:i"], "in.obj --to letter:i: the outline is in 2 separate pieces"),
        (["--to", "rect:0x1"], "--to rect:0x1: width must be positive"),
        (["--to", "disk", "--corners", "a"], "--corners a: 'a' is not one of V, V:K and V:X:Y"),
        (["--to", "disk", "--corners", "1,,2"], "'' is not one of V"),
        (["--to", "disk", "--corners", "1:2:3:4"], "'1:2:3:4' is not one of V"),
        (["--to", "disk", "--corners", "1,2:3"], "vertex 1 has no corner or point"),
        (["--to", "disk", "--corners", "1:2,1:3"], "vertex 1 is named more than once"),
        (["--to", "disk", "--corners", "1,1"], "vertex 1 is named more than once"),
        (["--corner-angle", "0"], "--corner-angle applies only to an outline"),
        ([], "in.obj: no face refers to texture coordinates (vt), so the boundary has no targets: "),
    ],
)
def test_invalid_calls(qhm, options, message):
    status, _, said = qhm(surfaces.disk(3), *options)
    assert status == 2
    assert message in said
    assert not qhm.out.exists()


@pytest.mark.parametrize(
    "options",
    [["--to", "disk", "--fixed", "f"], ["--corner-angle", "181"], ["--corner-angle", "x"], ["--corner-angle", "nan"]],
)
def test_calls_that_cannot_be_read(qhm, options):
    with pytest.raises(SystemExit) as stop:
        qhm(surfaces.disk(3), *options)
    assert stop.value.code == 2


@pytest.mark.slow
@pytest.mark.parametrize("character", "AGHPRS")
def test_letters_of_the_paper(character, tmp_path):
    """A curved surface on each letter, by this option alone."""
    out, report = tmp_path / "out.obj", tmp_path / "report.json"
    io.write_obj(tmp_path / "cat.obj", io.MeshData(*surfaces.cat(12)))
    command = ["map", str(tmp_path / "cat.obj"), "--to", f"letter:{character}"]
    assert main([*command, "-o", str(out), "--json", str(report)]) == 0
    facts = json.loads(report.read_text())
    assert facts["bijective"]
    assert facts["n_iterations"] < 100
    assert main(["check", str(out)]) == 0
    assert written(out).signs().min() == 1
