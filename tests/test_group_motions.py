"""``qhm morph --group``: named sets of nodes, rigid motions in order, and series of steps."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from quasiharmonic import morph
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.fem.files import read_fem, read_volume
from quasiharmonic.surfaces import annulus, grid
from quasiharmonic.ui.cli import main
from quasiharmonic.ui.display import draw
from shared.meshes import boundary_of
from shared.tetrahedral_meshes import box

POINTS, F = annulus(4)
RIM = boundary_of(F)
BODY = np.array([k for k in RIM if np.abs(POINTS[k]).max() < 0.7 * np.abs(POINTS[RIM]).max()])
WALLS = np.setdiff1d(RIM, BODY)


def in_rows(rows):
    return "\n".join(" ".join(map(str, row)) for row in rows)


def gmsh22():
    """A file of version 2 with points of two groups, the second without a name."""
    nodes = in_rows([k + 10, x, y, 0] for k, (x, y) in enumerate(POINTS.tolist()))
    ends = [[15, 2, group, 1, k + 10] for group, some in ((7, BODY), (8, WALLS)) for k in some.tolist()]
    rows = [*ends, *([2, 2, 9, 1, *(row + 10).tolist()] for row in F)]
    elements = in_rows([k + 1, *row] for k, row in enumerate(rows))
    return (
        '$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n2\n0 7 "the body"\n2 9 "fluid"\n$EndPhysicalNames\n'
        f"$Nodes\n{len(POINTS)}\n{nodes}\n$EndNodes\n$Elements\n{len(rows)}\n{elements}\n$EndElements\n"
    )


def gmsh4(version):
    """A file of version 4: an entity for each boundary node, which is in a group, and a surface in none."""
    place = "0 0 0" if version == "4.1" else "0 0 0 0 0 0"
    group = {**dict.fromkeys(BODY.tolist(), 7), **dict.fromkeys(WALLS.tolist(), -8)}
    entities = "\n".join(f"{k} {place} 1 {group[k]}" for k in RIM.tolist())
    nodes = in_rows([k + 10, x, y, 0] for k, (x, y) in enumerate(POINTS.tolist()))
    if version == "4.1":
        count = len(POINTS)
        numbers = "\n".join(str(k + 10) for k in range(count))
        nodes = f"1 {count} 10 {count + 9}\n2 1 0 {count}\n{numbers}\n" + in_rows([*p, 0] for p in POINTS.tolist())
        head = f"{len(RIM) + 1} {len(RIM) + len(F)} 1 {len(RIM) + len(F)}"
        blocks = [f"0 {k} 15 1\n{i + 1} {k + 10}" for i, k in enumerate(RIM.tolist())] + [f"2 1 2 {len(F)}"]
    else:
        nodes = f"1 {len(POINTS)}\n1 2 0 {len(POINTS)}\n{nodes}"
        head = f"{len(RIM) + 1} {len(RIM) + len(F)}"
        blocks = [f"{k} 0 15 1\n{i + 1} {k + 10}" for i, k in enumerate(RIM.tolist())] + [f"1 2 2 {len(F)}"]
    rows = in_rows([len(RIM) + 1 + k, *(row + 10).tolist()] for k, row in enumerate(F))
    return (
        f"$MeshFormat\n{version.removesuffix('.0')} 0 8\n$EndMeshFormat\n"
        '$PhysicalNames\n1\n0 7 "the body"\n$EndPhysicalNames\n'
        f"$Entities\n{len(RIM)} 0 1 0\n{entities}\n1 0 0 0 1 1 1 0 0\n$EndEntities\n$Nodes\n{nodes}\n$EndNodes\n"
        f"$Elements\n{head}\n" + "\n".join(blocks) + f"\n{rows}\n$EndElements\n"
    )


def partitioned(version):
    """The file of version 4 after a partition: its elements belong to parts of entities, and one entity is a ghost."""
    before, rest = gmsh4(version).split("$Entities\n")
    entities, after = rest.split("$EndEntities\n")
    head, *points, surface = entities.splitlines()
    parts = [f"{k} 0 1 2 1 2 {more}" for k, more in (line.split(" ", 1) for line in points)]
    parts.append("1 2 5 1 2 " + surface.split(" ", 1)[1])
    return (
        f"{before}$Entities\n0 0 1 0\n5 0 0 0 1 1 1 0 0\n$EndEntities\n"
        f"$PartitionedEntities\n2\n1\n99 2\n{head}\n" + "\n".join(parts) + f"\n$EndPartitionedEntities\n{after}"
    )


def vtk():
    flags = np.isin(np.arange(len(POINTS)), BODY) + 2 * np.isin(np.arange(len(POINTS)), WALLS)
    return (
        f"# vtk DataFile Version 3.0\nmesh\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(POINTS)} double\n"
        + in_rows([*p, 0] for p in POINTS.tolist())
        + f"\nCELLS {len(F)} {4 * len(F)}\n"
        + in_rows([3, *row] for row in F.tolist())
        + f"\nCELL_TYPES {len(F)}\n"
        + "5\n" * len(F)
        + f"CELL_DATA {len(F)}\nSCALARS first int 1\nLOOKUP_TABLE default\n{'1 ' + '0 ' * (len(F) - 1)}\n"
        + f"POINT_DATA {len(POINTS)}\nSCALARS part int 1\nLOOKUP_TABLE default\n{' '.join(map(str, flags.tolist()))}\n"
    )


def mfem():
    edges = [(1, k, k) for k in BODY.tolist()] + [(2, k, k) for k in WALLS.tolist()]
    return (
        f"MFEM mesh v1.3\n\ndimension\n2\n\nelements\n{len(F)}\n"
        + in_rows([5, 2, *row] for row in F.tolist())
        + f"\n\nboundary\n{len(edges)}\n"
        + in_rows([group, 1, a, b] for group, a, b in edges)
        + '\n\nbdr_attribute_sets\n2\n"the body" 1 1\n"both" 2 1 2\n'
        + f"\nvertices\n{len(POINTS)}\n2\n"
        + in_rows(POINTS.tolist())
        + "\n"
    )


FILES = {
    "22.msh": (gmsh22, "the body", "8"),
    "40.msh": (lambda: gmsh4("4.0"), "the body", "8"),
    "41.msh": (lambda: gmsh4("4.1"), "the body", "8"),
    "parts-40.msh": (lambda: partitioned("4.0"), "the body", "8"),
    "parts-41.msh": (lambda: partitioned("4.1"), "the body", "8"),
    "a.vtk": (vtk, "part=1", "part=2"),
    "a.mesh": (mfem, "the body", "2"),
}


@pytest.mark.parametrize("name", FILES)
def test_sets_of_every_format(tmp_path, name):
    write, body, walls = FILES[name]
    (tmp_path / name).write_text(write())
    mesh = read_fem(tmp_path / name)
    np.testing.assert_array_equal(mesh.find_set(body), BODY)
    np.testing.assert_array_equal(mesh.find_set(walls), WALLS)
    with pytest.raises(MeshFileError, match=f"no group 'nose'; available: .*{re.escape(repr(body))}"):
        mesh.find_set("nose")


def test_sets_of_cells_and_of_several_attributes(tmp_path):
    (tmp_path / "a.vtk").write_text(vtk())
    assert set(read_fem(tmp_path / "a.vtk").find_set("first")) == set(F[0])
    (tmp_path / "a.mesh").write_text(mfem())
    assert set(read_fem(tmp_path / "a.mesh").find_set("both")) == set(RIM)


@pytest.mark.parametrize(
    ("name", "text", "own", "kinds"),
    [
        ("a.msh", gmsh22().replace('"fluid"', '"the body"'), "the body", ("point", "surface")),
        ("b.msh", gmsh22().replace(" 2 2 9 ", " 2 2 8 "), "8", ("point", "surface")),
        ("a.vtk", vtk().replace("first", "part"), "part=1", ("point", "cell")),
        ("a.mesh", mfem() + '\nattribute_sets\n1\n"the body" 1 5\n', "the body", ("boundary", "elements")),
    ],
)
def test_groups_with_the_same_name(tmp_path, name, text, own, kinds):
    (tmp_path / name).write_text(text)
    mesh = read_fem(tmp_path / name)
    first, second = (f"{kind}:{own}" for kind in kinds)
    with pytest.raises(MeshFileError, match=f"several groups are called '{own}'; use '{first}' or '{second}'"):
        mesh.find_set(own)
    with pytest.raises(MeshFileError, match=f"available: .*'{first}'.*, '{second}'"):
        mesh.find_set("nose")
    np.testing.assert_array_equal(mesh.find_set(first), WALLS if own == "8" else BODY)
    np.testing.assert_array_equal(mesh.find_set(second), np.unique(F[0]) if name == "a.vtk" else np.unique(F))


def test_names_with_quotes(tmp_path):
    (tmp_path / "a.msh").write_text(gmsh22().replace("the body", 'the "body"'))
    np.testing.assert_array_equal(read_fem(tmp_path / "a.msh").find_set('the "body"'), BODY)


def test_empty_groups_are_not_listed(tmp_path):
    (tmp_path / "a.vtk").write_text(vtk().replace("\n1 0", "\n0 0"))
    with pytest.raises(
        MeshFileError, match="no group 'first'; available: 'part', 'part=0', 'part=1', 'part=2', 'first=0'"
    ):
        read_fem(tmp_path / "a.vtk").find_set("first")


def test_a_group_without_elements(tmp_path, capsys):
    count, edges = len(POINTS), len(RIM)
    text = mfem().replace(f"boundary\n{edges}\n", f"boundary\n{edges + 1}\n3 1 {count} {count}\n") + "9 9\n"
    (tmp_path / "a.mesh").write_text(text.replace(f"vertices\n{count}", f"vertices\n{count + 1}"))
    motions = "--group", "2", "--group", "3", "--translate", "1,0"
    assert main(["morph", str(tmp_path / "a.mesh"), "-o", str(tmp_path / "b.mesh"), *motions]) == 2
    assert "no element uses a node of the group '3'; omit it" in capsys.readouterr().err
    assert not (tmp_path / "b.mesh").exists()


def call(tmp_path, *options, name="a.mesh"):
    (tmp_path / name).write_text(FILES[name][0]())
    out = tmp_path / f"out_{name}"
    return main(["morph", str(tmp_path / name), "-o", str(out), *options]), out


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--translate", "-0.05,0.02"], lambda w: w - 0.05 + 0.02j),
        (["--rotate", "30", "--centre", "0.1,0"], lambda w: 0.1 + (w - 0.1) * np.exp(1j * np.pi / 6)),
        (["--translate", "0.1,0", "--scale", "0.5"], lambda w: w.mean() + 0.1 + 0.5 * (w - w.mean())),
        (["--scale", "0.5", "--translate", "0.1,0", "--centre", "0,0"], lambda w: 0.5 * w + 0.1),
        (["--translate", "0.1,0", "--scale", "0.5", "--centre", "0,0"], lambda w: 0.5 * (w + 0.1)),
    ],
)
def test_motions_are_applied_in_their_order(tmp_path, options, expected):
    status, out = call(tmp_path, "--group", "the body", *options)
    assert status == 0
    x, y = read_fem(out).points[BODY].T
    np.testing.assert_allclose(x + 1j * y, expected(POINTS[BODY] @ [1, 1j]), atol=1e-14)


def test_a_series_ends_like_its_last_file(tmp_path, capsys):
    report = tmp_path / "report.json"
    options = "--group", "the body", "--rotate", "50", "--steps", "5", "--json", str(report)
    status, out = call(tmp_path, *options, name="22.msh")
    assert status == 0
    assert "5 of 5 steps" in capsys.readouterr().out
    listed = re.findall(r'file="(.*?)"', out.with_suffix(".pvd").read_text())
    assert listed == [f"out_22_{k:04d}.vtu" for k in range(6)]
    meshes = [read_fem(tmp_path / name) for name in listed]
    np.testing.assert_array_equal(meshes[0].points, POINTS)
    np.testing.assert_array_equal(meshes[-1].points, read_fem(out).points)
    turned = POINTS[BODY] @ [1, 1j]
    for k, mesh in enumerate(meshes):
        np.testing.assert_array_equal(mesh.F, F)
        there = turned.mean() + (turned - turned.mean()) * np.exp(1j * np.radians(10 * k))
        np.testing.assert_allclose(mesh.points[BODY] @ [1, 1j], there, atol=1e-14)
    facts = json.loads(report.read_text())
    # The report compares the last mesh with the first one.
    once = morph(POINTS, F, BODY, meshes[-1].points[BODY])
    assert facts["quality_before"]["minimum"] == once.quality_before.min()
    assert facts["quality_after"]["minimum"] == pytest.approx(once.quality_after.min(), rel=1e-2)


@pytest.fixture
def interrupts(monkeypatch):
    """Interrupt the second call of `morph` when its mesh is valid."""
    calls = []

    def interrupt(step):
        if not step.inverted:
            raise KeyboardInterrupt

    def interrupted(*args, **options):
        calls.append(options)
        return morph(*args, **options | ({"callback": interrupt} if len(calls) == 2 else {}))

    monkeypatch.setattr("quasiharmonic.apps.mesh_motion.morphing.morph", interrupted)


def test_an_interrupted_series_fails(tmp_path, capsys, interrupts):
    assert call(tmp_path, "--group", "the body", "--rotate", "50", "--steps", "5")[0] == 1
    written = capsys.readouterr().out
    assert "every triangle is positive" in written
    assert "2 of 5 steps\nInterrupted." in written


def write_solid(path):
    """Write a box with a flag at its upper nodes."""
    X, T = box(2, 2, 2)
    top = (X[:, 2] == X[:, 2].max()).astype(int)
    path.write_text(
        f"# vtk DataFile Version 3.0\nmesh\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(X)} double\n"
        f"{in_rows(X.tolist())}\nCELLS {len(T)} {5 * len(T)}\n{in_rows([4, *row] for row in T.tolist())}\n"
        f"CELL_TYPES {len(T)}\n{'10 ' * len(T)}\n"
        f"POINT_DATA {len(X)}\nSCALARS top int 1\nLOOKUP_TABLE default\n{' '.join(map(str, top))}\n"
    )
    return X, T, top


def test_an_interrupted_series_of_a_solid_fails(tmp_path, capsys, interrupts):
    write_solid(tmp_path / "a.vtk")
    call = "morph", str(tmp_path / "a.vtk"), "-o", str(tmp_path / "b.vtk"), "--group", "top", "--translate", "0,0,0.2"
    assert main([*call, "--steps", "3"]) == 1
    assert "2 of 3 steps\nInterrupted." in capsys.readouterr().out


def test_a_solid_in_steps(tmp_path, capsys):
    X, T, top = write_solid(tmp_path / "a.vtk")
    source, out = str(tmp_path / "a.vtk"), tmp_path / "b.vtk"
    turn = "--group", "top", "--rotate", "20", "--axis", "1,1,1", "--centre", "0,0,0"
    assert main(["morph", source, "-o", str(out), *turn, "--steps", "2"]) in (0, 1)
    # A rotation about the diagonal by 120° would permute the axes; three of 40° do.
    moved = read_volume(out).points[top == 1]
    cos, sin = np.cos(np.radians(20)), np.sin(np.radians(20))
    cycle = (1 + 2 * cos) / 3, (1 - cos) / 3 - sin / 3**0.5, (1 - cos) / 3 + sin / 3**0.5
    matrix = np.array([np.roll(cycle, k) for k in range(3)])
    np.testing.assert_allclose(moved, X[top == 1] @ matrix.T, atol=1e-14)
    series = read_volume(tmp_path / "b_0001.vtu")
    assert len(series.F) == len(T)
    capsys.readouterr()
    assert main(["measure", source, "--json", "-"]) == 0
    assert 0 < json.loads(capsys.readouterr().out)["quality"]["minimum"] <= 1
    assert main(["plot", source, "-o", str(tmp_path / "a.png")]) == 0


def test_a_cut_through_tetrahedra():
    X, T = box(3, 3, 3)
    top = np.flatnonzero(X[:, 2] == X[:, 2].max())
    result = morph(X, T, top, X[top] - [0, 0, 0.3 * np.ptp(X[:, 2])], slide=True)
    before, after, _ = draw(result, "quality").axes
    for ax, points in ((before, result.points_before), (after, result.points)):
        polygons = [path.vertices[:4] for path in ax.collections[0].get_paths()]
        x, y = np.array(polygons).transpose(2, 0, 1)
        areas = 0.5 * np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1))
        low, high = points.min(axis=0), points.max(axis=0)
        axis = int(np.ptp(points, axis=0).argmin())
        # The cuts of the tetrahedra cover the section of the box once.
        assert areas.sum() == pytest.approx(np.delete(high - low, axis).prod())


@pytest.mark.parametrize(("height", "advised"), [(0.005, True), (0.5, False)])
def test_remesh_is_advised_where_the_quality_is_lost(height, advised):
    points, triangles = grid(4, 4)
    rim = boundary_of(triangles)
    said = morph(points, triangles, rim, points[rim] * [1, height]).summary()
    assert ("Remesh around (" in said) == advised
    X, T = box(2, 2, 2)
    top = np.flatnonzero(X[:, 2] == X[:, 2].max())
    said = morph(X, T, top, X[top] * [1, 1, height], slide=True).summary()
    assert ("Remesh around (" in said) == advised


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--translate", "1,0", "--group", "2"], "--translate needs a group"),
        (["--group", "2", "--translate", "1,0,0"], "--translate must have 2 numbers"),
        (["--group", "2", "--axis", "0,0,1"], "--axis is for meshes in space"),
        (["--group", "2", "--centre", "0,0", "--centre", "1,0"], "--centre is given twice"),
        (
            ["--group", "2", "--translate", "0,0", "--centre", "0,0"],
            "--centre of --group 2 has no effect without --rotate or",
        ),
        (["--group", "2", "--scale", "2", "--group", "both"], "another one that moves differently"),
    ],
)
def test_contradictions(tmp_path, capsys, options, message):
    assert call(tmp_path, *options)[0] == 2
    assert message in capsys.readouterr().err
