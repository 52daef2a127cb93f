"""``qhm unwrap`` as a user calls it: files, exit statuses, reports."""

from __future__ import annotations

import inspect
import json
import signal

import numpy as np
import pytest

from quasiharmonic import io, unwrap
from quasiharmonic.atlas import pack_charts
from quasiharmonic.geometry.mesh.topology import components
from quasiharmonic.surfaces import starfish
from quasiharmonic.ui.cli import parser_of
from shared.cleaning import cube
from shared.commands import run

V, F = starfish(2, 4)


@pytest.fixture
def model(tmp_path):
    io.write_obj(tmp_path / "model.obj", io.MeshData(V, F))
    return tmp_path / "model.obj"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".gltf"])
def test_writes_certified_coordinates(model, tmp_path, capsys, suffix):
    out, report = tmp_path / f"out{suffix}", tmp_path / "report.json"
    assert run("unwrap", model, "-o", out, "--resolution", 256, "--json", report) == 0
    written = io.read_mesh(out)
    assert written.vt.min() >= 0
    assert written.vt.max() <= 1
    facts = json.loads(report.read_text())
    assert facts["success"] is True
    assert facts["certificate"]["bijective"] is True
    assert facts["triangles"] == len(F) == len(written.F)
    said = capsys.readouterr().out
    for words in ("chart", "seam", "stretch", "of the texture used"):
        assert words in said


@pytest.mark.slow
def test_materials_groups_and_attributes_stay(tmp_path):
    lines = [f"v {x!r} {y!r} {z!r} 0.5 0.25 1\n" for x, y, z in V.tolist()]
    faces = [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in F.tolist()]
    half = len(faces) // 2
    head = ["mtllib some.mtl\n", *lines, "g arm\n", "usemtl red\n", *faces[:half], "g rest\n", *faces[half:]]
    (tmp_path / "model.obj").write_text("".join(head))
    assert run("unwrap", tmp_path / "model.obj", "-o", tmp_path / "out.obj", "--resolution", 256) == 0
    text = (tmp_path / "out.obj").read_text()
    order = [text.index(word) for word in ("mtllib some.mtl", "g arm", "usemtl red", "g rest")]
    assert order == sorted(order)
    assert text.count(" 0.5 0.25 1\n") == len(V)
    written = io.read_mesh(tmp_path / "out.obj")
    np.testing.assert_array_equal(written.V, V)
    np.testing.assert_array_equal(written.F, F)


CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
g one\nf 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nusemtl two\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_polygons_stay(tmp_path, suffix):
    (tmp_path / "cube.obj").write_text(CUBE)
    report = tmp_path / "report.json"
    assert run("unwrap", tmp_path / "cube.obj", "-o", tmp_path / f"out{suffix}", "--json", report) == 0
    written = io.read_mesh(tmp_path / f"out{suffix}")
    assert len(written.F) == 12
    assert json.loads(report.read_text())["divided_polygons"] == 0
    # A .glb has triangles only.
    assert written.faces == (12 if suffix == ".glb" else 6)


def test_polygons_that_seams_cross_are_divided(tmp_path):
    """Seams of the input cross the diagonals of a face."""
    lines = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "v 2 0 0", "v 2 1 0", "g first", "f 1 2 3 4", "g second"]
    (tmp_path / "model.obj").write_text("\n".join([*lines, "f 2 5 6 3", ""]))
    mesh = io.read_mesh(tmp_path / "model.obj")
    divided = mesh.polygons.divide(np.array([True, False]))
    assert divided.sizes.tolist() == [3, 3, 4]
    assert sorted(mesh.F.ravel()[divided.corners[:3]].tolist()) == sorted(mesh.F[0].tolist())


@pytest.mark.slow
def test_defects_are_reported(tmp_path, capsys):
    spoilt = np.concatenate([F, F[:1], [[0, 0, 1]]])
    io.write_obj(tmp_path / "model.obj", io.MeshData(V, spoilt))
    assert run("unwrap", tmp_path / "model.obj", "-o", tmp_path / "out.obj", "--resolution", 256) == 0
    said = capsys.readouterr().out
    assert "triangles repeated" in said
    assert "triangles that use a vertex twice" in said
    assert len(io.read_mesh(tmp_path / "out.obj").F) == len(spoilt)


@pytest.mark.long
def test_seams_of_the_file_and_edge_costs(model, tmp_path):
    first, second = tmp_path / "first.obj", tmp_path / "second.obj"
    assert run("unwrap", model, "-o", first, "--resolution", 256) == 0
    assert run("unwrap", first, "-o", second, "--keep-seams", "--resolution", 256) == 0
    seams = [{tuple(edge) for edge in io.mapped(io.read_mesh(path)).seams.tolist()} for path in (first, second)]
    assert seams[0] <= seams[1]
    (tmp_path / "costs.txt").write_text("".join(f"{i} {j} 50\n" for i, j in seams[0]))
    costs = ["--edge-costs", tmp_path / "costs.txt"]
    assert run("unwrap", model, "-o", second, "--resolution", 256, *costs) == 0
    assert {tuple(edge) for edge in io.mapped(io.read_mesh(second)).seams.tolist()} != seams[0]
    (tmp_path / "costs.txt").write_text("0 99999 2\n")
    assert run("unwrap", model, "-o", second, *costs) == 2


@pytest.mark.parametrize(
    ("last", "said"),
    [("1 2 0", "the factor 0 is not positive at line 3"), ("1 0 7", "edge (1, 0) has two factors, 5 and 7 at line 3")],
)
def test_wrong_edge_costs_are_named_by_their_line(model, tmp_path, capsys, last, said):
    costs = tmp_path / "costs.txt"
    costs.write_text(f"# factors\n0 1 5\n{last}\n")
    assert run("unwrap", model, "-o", tmp_path / "out.obj", "--edge-costs", costs) == 2
    assert f"{costs}: {said}" in capsys.readouterr().err


def test_wrong_input_writes_nothing(model, tmp_path, capsys):
    out = tmp_path / "out.obj"
    for options in (["--max-stretch", "0.5"], ["--keep-seams"], ["--memory", "1M"]):
        assert run("unwrap", model, "-o", out, *options) == 2
        assert not out.exists()
        assert capsys.readouterr().err.startswith("qhm unwrap: ")
    assert run("unwrap", model, "-o", tmp_path / "out.off") == 2


@pytest.mark.slow
@pytest.mark.parametrize("where", ["targets.cuts.find.shorten_cuts", "apps.unwrapping.stages.certify_charts"])
def test_interrupt_writes_nothing(where, model, tmp_path, monkeypatch, capsys):
    def interrupt(*args, **options):
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the interrupt was lost")

    monkeypatch.setattr(f"quasiharmonic.{where}", interrupt)
    assert run("unwrap", model, "-o", tmp_path / "out.obj") == 2
    assert capsys.readouterr().err == "qhm unwrap: interrupted, nothing was written\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.obj"]


@pytest.mark.slow
def test_memory_is_bounded_in_every_phase(model, tmp_path, monkeypatch, capsys):
    """The process exceeds the bound while charts are packed."""
    used = [10 << 20]
    monkeypatch.setattr("quasiharmonic.ui.batch.supervisor.resident", lambda pid: used[-1])

    def pack(*args, **options):
        used.append(900 << 20)
        return pack_charts(*args, **options)

    monkeypatch.setattr("quasiharmonic.apps.unwrapping.placing.pack_charts", pack)
    call = ["unwrap", model, "-o", tmp_path / "out.obj", "--resolution", 256, "--memory"]
    assert run(*call, "800M") == 2
    assert "used more than 800 MiB of memory (--memory), nothing was written" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.obj"]
    assert run(*call, "1G") == 0


@pytest.mark.slow
def test_vertices_at_one_position_share_coordinates(tmp_path):
    """Triangles that have their own vertices are joined in the file's map as in the certified one."""
    corners = V[F].reshape(-1, 3)
    io.write_obj(tmp_path / "model.obj", io.MeshData(corners, np.arange(len(corners)).reshape(-1, 3)))
    report = tmp_path / "report.json"
    call = ["unwrap", tmp_path / "model.obj", "-o", tmp_path / "out.obj", "--resolution", 256, "--json", report]
    assert run(*call) == 0
    written = io.read_mesh(tmp_path / "out.obj")
    np.testing.assert_array_equal(written.V, corners)
    islands = components(written.FT, len(written.vt))[written.FT[:, 0]]
    assert len(np.unique(islands)) == json.loads(report.read_text())["charts"]


def test_the_default_bound_is_that_of_the_function():
    parser = parser_of(["unwrap"])
    options = parser.parse_args(["unwrap", "model.obj", "-o", "out.obj"])
    for name in (
        "max_stretch",
        "max_charts",
        "padding",
        "texels_per_unit",
        "tiles",
        "stack",
        "outward",
        "seed",
        "jobs",
    ):
        assert getattr(options, name) == inspect.signature(unwrap).parameters[name].default
    assert options.resolution == (2048, 2048)


@pytest.mark.slow
def test_a_soup_is_reported_with_a_remedy(tmp_path, capsys):
    V, F = starfish(3, 4)
    corners, own = V[F].reshape(-1, 3), np.arange(F.size).reshape(-1, 3)
    jitter = 1e-7 * np.random.default_rng(0).normal(size=corners.shape)
    for name, points, close in (("equal", corners, False), ("moved", corners + jitter, True)):
        path = tmp_path / f"{name}.obj"
        lines = ["v {!r} {!r} {!r}\n".format(*point) for point in points.tolist()]
        path.write_text("".join([*lines, *("f {} {} {}\n".format(*row) for row in (own + 1).tolist())]))
        assert run("unwrap", path, "-o", tmp_path / "out.obj", "--resolution", 256, "--json", tmp_path / "r.json") == 0
        # Vertices at the same position are merged.
        assert ("Weld these vertices with --weld 1e-06." in capsys.readouterr().out) == close
        assert bool(json.loads((tmp_path / "r.json").read_text())["close_vertices"]) == close
        run("flatten", path, "-o", tmp_path / "out.obj", "--max-iterations", 1)
        assert "Weld these vertices" in capsys.readouterr().err


@pytest.mark.slow
def test_tangents_are_dropped_and_textures_that_do_not_fit_are_named(tmp_path, capsys):
    V, F = starfish(3, 4)
    model = tmp_path / "model.glb"
    first = unwrap(V, F, resolution=256, max_stretch=2)
    texture = io.checkerboard()
    io.write_mapped(model, io.MeshData(V, F, vt=first.uvs, FT=first.indices, texture=texture))
    read = io.read_mesh(model)
    # The file gets tangents: those of another attribute of the same number of vertices.
    document = read.carried.document
    for shape in document.tree["meshes"]:
        for primitive in shape["primitives"]:
            primitive["attributes"]["TANGENT"] = document.add(np.ones((read.carried.pools[0].count, 4), np.float32))
    model.write_bytes(document.encode(binary=True))
    assert b"TANGENT" in model.read_bytes()
    kept, new = tmp_path / "kept.glb", tmp_path / "new.glb"
    io.write_mapped(kept, io.read_mesh(model))
    assert b"TANGENT" in kept.read_bytes()
    assert run("unwrap", model, "-o", new, "--resolution", 256) == 0
    out, err = capsys.readouterr()
    assert b"TANGENT" not in new.read_bytes()
    assert "tangents, because the texture coordinates changed" in err
    assert "do not fit the textures of the file: image 0" in out
    assert run("unwrap", model, "-o", new, "--resolution", 256, "--texture", "checkerboard") == 0
    assert "do not fit" not in capsys.readouterr().out


def spoilt(F):
    """Triangles with mixed winding, a repeated and a degenerate one."""
    G = F.copy()
    G[3] = G[3, ::-1]
    return np.concatenate([G, G[7:8], [[G[9, 0], G[9, 1], G[9, 0]]]])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".glb", ".ply"])
def test_written_models_with_defects_pass_the_check_chart_by_chart(tmp_path, capsys, suffix):
    V, F = starfish(3, 4)
    G = spoilt(F)
    source, out = tmp_path / "model.obj", tmp_path / f"out{suffix}"
    lines = ["v {!r} {!r} {!r}\n".format(*point) for point in V.tolist()]
    source.write_text("".join([*lines, *("f {} {} {}\n".format(*row) for row in (G + 1).tolist())]))
    assert run("unwrap", source, "-o", out, "--resolution", 256) == 0
    capsys.readouterr()
    assert run("check", out, "--json", tmp_path / "r.json") == 0
    said = capsys.readouterr().out
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["injective"]
    assert report["reversed_triangles"] == [3]
    # In GLB files, a triangle that uses a vertex twice is kept, too.
    assert report["repeated_triangles"] == [len(F)]
    assert report["degenerate_triangles"] == [len(F) + 1]
    assert "triangle 3: verified with the winding of the neighbours" in said
    assert run("plot", out, "-o", tmp_path / "out.png") == 0


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("reversed", "triangle 0: verified with the winding of the neighbours"),
        ("repeated", "triangle 12: left out, because an earlier triangle has the same vertices"),
    ],
)
def test_the_check_of_a_box_with_a_defect_measures_the_gaps_between_its_charts(tmp_path, capsys, kind, said):
    V, F = cube()
    first, rest = (F[:1, ::-1], F[1:]) if kind == "reversed" else (F[:1], np.concatenate([F[1:], F[:1]]))
    io.write_obj(tmp_path / "box.obj", io.MeshData(V, np.concatenate([first, rest])))
    options = ["--resolution", 512, "--symmetry", "none"]
    assert run("unwrap", tmp_path / "box.obj", "-o", tmp_path / "out.obj", *options) == 0
    charts = capsys.readouterr().out.split(" charts,")[0].split()[-1]
    assert run("check", tmp_path / "out.obj") == 0
    out = capsys.readouterr().out
    assert f"{charts} islands: {charts} injective, {charts} bijective." in out
    assert said in out
    assert "Islands are more than 8 texels apart" in out


@pytest.mark.slow
def test_an_inverted_triangle_in_a_model_with_defects_is_found(tmp_path):
    V, F = starfish(3, 4)
    G = spoilt(F)
    result = unwrap(V, G, resolution=256)
    # A vertex far from its neighbours inverts triangles; the repeated triangle may also have coordinates of its own.
    moved, own = result.uvs.copy(), result.indices.copy()
    moved[result.indices[12, 0]] += 0.3
    own[len(F)] = own[20]
    for vt, FT in ((moved, result.indices), (result.uvs, own)):
        io.write_mapped(tmp_path / "m.obj", io.MeshData(V, G, vt=vt, FT=FT))
        assert run("check", tmp_path / "m.obj") == 1


def round_sphere(count):
    """A sphere whose vertices at the poles almost coincide."""
    u, v = np.meshgrid(np.arange(count) * 2 * np.pi / count, np.linspace(0, np.pi, count // 2 + 1), indexing="ij")
    a = (np.arange(count)[:, None] * (count // 2 + 1) + np.arange(count // 2)).ravel()
    b = (a + count // 2 + 1) % u.size
    V = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    return V, np.concatenate([np.c_[a, a + 1, b + 1], np.c_[a, b + 1, b]])


def write_obj(path, V, F):
    lines = ["v {!r} {!r} {!r}\n".format(*point) for point in V.tolist()]
    path.write_text("".join([*lines, *("f {} {} {}\n".format(*row) for row in (F + 1).tolist())]))


@pytest.mark.slow
@pytest.mark.parametrize("mixed", [False, True])
def test_triangles_without_area_in_single_precision_are_verified_with_their_charts(tmp_path, mixed):
    V, F = round_sphere(12)
    if mixed:
        F[::5] = F[::5, ::-1]
    write_obj(tmp_path / "m.obj", V * [1, 1.3, 0.7] + [0.1, -0.7, 0.9], F)
    assert run("unwrap", tmp_path / "m.obj", "-o", tmp_path / "o.glb", "--resolution", 256) == 0
    assert run("check", tmp_path / "o.glb", "--json", tmp_path / "r.json") == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["bijective"]
    read = io.read_mesh(tmp_path / "o.glb")
    collapsed = np.flatnonzero((np.roll(read.F, 1, axis=1) == read.F).any(axis=1))
    corners = read.vt[read.FT[collapsed]]
    sides = corners[:, 1:] - corners[:, :1]
    own = collapsed[np.linalg.det(sides) != 0]
    # Some of these triangles have an area in the texture, and none of them is left out.
    assert own.size
    assert not np.isin(own, report["degenerate_triangles"]).any()
    # The file fails if one of them is folded over, or lies on a chart.
    one = read.FT[own[0]]
    (first, second), (apex,) = ((one[read.F[own[0]] == k]) for k in (np.bincount(read.F[own[0]]).argsort()[[-1, -2]]))
    folded = read.vt.copy()
    folded[first] += 1.5 * (folded[second] - folded[first])
    lying = np.append(read.vt, [read.vt[read.FT[0]].mean(axis=0)], axis=0)
    FT = read.FT.copy()
    FT[own[0]] = np.where(one == apex, len(read.vt), one)
    for vt, rows in ((folded, read.FT), (lying, FT)):
        io.write_mapped(tmp_path / "w.obj", io.MeshData(read.V, read.F, vt=vt, FT=rows))
        assert run("check", tmp_path / "w.obj") == 1


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".glb", ".ply"])
def test_the_only_chart_of_an_inside_out_model_may_be_mirrored(tmp_path, capsys, suffix):
    V, F = round_sphere(8)
    V, inverse = np.unique(np.round(V, 9), axis=0, return_inverse=True)
    F = inverse.reshape(-1)[F]
    F = F[(np.roll(F, 1, axis=1) != F).all(axis=1)][:, ::-1]
    write_obj(tmp_path / "m.obj", V, F)
    options = ["--outward", "--max-charts", 1, "--resolution", 256]
    out = tmp_path / f"o{suffix}"
    assert run("unwrap", tmp_path / "m.obj", "-o", out, *options) == 0
    capsys.readouterr()
    assert run("check", out) == 0
    assert "1 island: 1 injective, 1 bijective.\nMirrored" in capsys.readouterr().out


def test_straighten_makes_strips_rectangles(tmp_path, capsys):
    angle, height = np.meshgrid(np.linspace(0, 2, 9), np.arange(6.0))
    radius = 3 - 0.2 * height
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    lines = [f"v {x} {y} {z}\n" for x, y, z in place.tolist()]
    lines += [f"f {k} {k + 1} {k + 10} {k + 9}\n" for k in range(1, 46) if k % 9]
    (tmp_path / "model.obj").write_text("".join(lines))
    call = ("unwrap", tmp_path / "model.obj", "-o", tmp_path / "out.obj", "--resolution", 256)
    assert run(*call, "--straighten", "--json", tmp_path / "report.json") == 0
    (strip,) = json.loads((tmp_path / "report.json").read_text())["strips"]
    assert (strip["columns"] * strip["rows"], strip["straightened"]) == (40, True)
    assert "1 of 1 strip straightened" in capsys.readouterr().out


@pytest.mark.slow
def test_seams_of_files_of_edges(model, tmp_path):
    plain = unwrap(V, F, resolution=256)
    kept, wanted = plain.seams[:2], np.array([F[0, :2], F[-1, :2]])
    np.savetxt(tmp_path / "seams.txt", wanted, fmt="%d")
    np.savetxt(tmp_path / "no_seams.txt", kept, fmt="%d")
    out, report = tmp_path / "out.obj", tmp_path / "report.json"
    files = ["--seams", tmp_path / "seams.txt", "--no-seams", tmp_path / "no_seams.txt"]
    assert run("unwrap", model, "-o", out, "--resolution", 256, "--json", report, *files) == 0
    expected = unwrap(V, F, resolution=256, seams=wanted, no_seams=kept)
    np.testing.assert_array_equal(io.read_mesh(out).corner_uv, expected.uvs[expected.indices])


@pytest.mark.slow
@pytest.mark.parametrize("which", ["groups", "materials", "file"])
def test_labels_of_the_file_or_of_a_list(tmp_path, which):
    keyword = {"groups": "g", "materials": "usemtl", "file": "#"}[which]
    corners = [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in F.tolist()]
    labels = (V[F].mean(axis=1)[:, 0] > 0).astype(int)
    faces = [f"{keyword} part{k}\n{corner}" for k, corner in zip(labels.tolist(), corners, strict=True)]
    (tmp_path / "model.obj").write_text("".join([*(f"v {x!r} {y!r} {z!r}\n" for x, y, z in V.tolist()), *faces]))
    np.savetxt(tmp_path / "labels.txt", labels, fmt="%d")
    given = tmp_path / "labels.txt" if which == "file" else which
    out = tmp_path / "out.obj"
    assert run("unwrap", tmp_path / "model.obj", "-o", out, "--resolution", 256, "--labels", given) == 0
    expected = unwrap(V, F, resolution=256, labels=labels)
    np.testing.assert_array_equal(io.read_mesh(out).corner_uv, expected.uvs[expected.indices])
    assert not np.array_equal(expected.charts, unwrap(V, F, resolution=256).charts)


@pytest.mark.parametrize(
    ("option", "text", "words"),
    [
        ("--labels", "1\n2\n", "labels.txt: 2 numbers for"),
        ("--labels", "0.5\n", "not a whole number"),
        ("--seams", "0 1 2\n", "not 2 numbers"),
        ("--no-seams", "0 100000\n", "--no-seams refers to vertex 100000"),
    ],
)
def test_wrong_files_of_seams_and_labels(model, tmp_path, capsys, option, text, words):
    (tmp_path / "labels.txt").write_text(text)
    assert run("unwrap", model, "-o", tmp_path / "out.obj", option, tmp_path / "labels.txt") == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out.obj").exists()


@pytest.mark.parametrize("which", ["groups", "materials"])
def test_labels_that_the_file_lacks(tmp_path, capsys, which):
    io.write_ply(tmp_path / "model.ply", io.MeshData(V, F))
    assert run("unwrap", tmp_path / "model.ply", "-o", tmp_path / "out.obj", "--labels", which) == 2
    assert f"model.ply: the file has no {which}: omit --labels" in capsys.readouterr().err


@pytest.mark.slow
def test_up_on_the_command_line(model, tmp_path):
    out = tmp_path / "out.obj"
    assert run("unwrap", model, "-o", out, "--resolution", 256, "--up=-z") == 0
    expected = unwrap(V, F, resolution=256, up="-z")
    np.testing.assert_array_equal(io.read_mesh(out).corner_uv, expected.uvs[expected.indices])
