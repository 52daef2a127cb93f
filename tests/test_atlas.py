"""Maps with seams: every command and function works island by island, and files preserve the seams."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from quasiharmonic import atlas, io, targets
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.geometry.exact.triangles import find_concave
from quasiharmonic.surfaces import grid, starfish
from shared.commands import run
from shared.meshes import lift
from shared.seam_meshes import strips


def seamed(path, mirrored=None, stacked=False):
    """Write a file whose map is cut into three strips, optionally with one mirrored or with all of them overlapping."""
    V, F, uv, FT, strip = strips(6)
    if stacked:
        for k in range(3):
            uv[np.unique(FT[strip == k])] -= [3 * k, 0]
    if mirrored is not None:
        uv[np.unique(FT[strip == mirrored])] *= [-1, 1]
    io.write_obj(path, io.MeshData(V, F, vt=uv, FT=FT))
    return SeamedMesh(V, F, FT, uv)


def vertex_lines(path):
    return [line for line in path.read_text().splitlines() if line.startswith("v ")]


def faces(path):
    """The face lines with vertex indices only."""
    return [re.sub(r"/\d*", "", line) for line in path.read_text().splitlines() if line.startswith("f ")]


@pytest.fixture
def source(tmp_path):
    seamed(tmp_path / "in.obj")
    return tmp_path / "in.obj"


class TestCommands:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        "command",
        [
            ["polish"],
            ["polish", "--free"],
            ["polish", "--free", "--pack"],
            ["polish", "--slide"],
            ["harmonise"],
            ["map"],
            ["map", "--to", "disk"],
            ["flatten"],
            ["flatten", "--start"],
            ["flatten", "--pack", "--padding", "20"],
            ["repair"],
        ],
        ids=" ".join,
    )
    def test_every_island_is_injective_and_the_surface_is_unchanged(self, source, tmp_path, command):
        out, told = tmp_path / "out.obj", tmp_path / "told.json"
        assert run(command[0], source, "-o", out, "--json", told, *command[1:]) == 0
        verdict = atlas.certify(io.mapped(io.read_mesh(out)))
        assert len(verdict.islands) == 3
        assert verdict.bijective
        assert vertex_lines(out) == vertex_lines(source)
        assert faces(out) == faces(source)
        report = json.loads(told.read_text())
        assert report["injective"] is True
        assert len(report["islands"]) == 3
        if "--pack" in command:
            uv = io.read_mesh(out).vt
            assert uv.min() >= 0
            assert uv.max() <= 1
            assert not len(verdict.overlapping)

    def test_borders_are_fixed_or_free(self, source, tmp_path):
        before = io.mapped(io.read_mesh(source))
        energy = {}
        for name, options in {"kept": [], "free": ["--free"]}.items():
            run("polish", source, "-o", tmp_path / "out.obj", "--json", tmp_path / "told.json", *options)
            energy[name] = json.loads((tmp_path / "told.json").read_text())["distortion"]["symmetric_dirichlet"]["mean"]
            after = io.mapped(io.read_mesh(tmp_path / "out.obj"))
            for one, other in zip(before.islands, after.islands, strict=True):
                rim = np.unique(one.F[(one.F < 0).any(axis=1)]) if name == "free" else boundary(one)
                assert np.array_equal(one.uv[rim], other.uv[rim])
                # Each island stays near its position, even if its border is free.
                assert np.linalg.norm(one.uv.mean(axis=0) - other.uv.mean(axis=0)) < 0.2
        assert energy["free"] < energy["kept"]

    def test_measure_plot_and_check(self, source, tmp_path, capsys):
        assert run("measure", source) == 0
        assert run("plot", source, "-o", tmp_path / "a.png") == 0
        capsys.readouterr()
        assert run("check", source, "--json", tmp_path / "told.json") == 0
        said = capsys.readouterr().out
        assert "3 islands: 3 injective, 3 bijective." in said
        assert len(json.loads((tmp_path / "told.json").read_text())["verdict"]["islands"]) == 3

    def test_seams_are_ignored_or_chosen(self, source, tmp_path):
        out = tmp_path / "out.obj"
        assert run("flatten", source, "-o", out, "--seams", "none") == 0
        assert len(io.mapped(io.read_mesh(out)).islands) == 1
        mesh = io.read_mesh(source)
        (tmp_path / "edges.txt").write_text("".join(f"{a} {b}  # a seam\n" for a, b in seams_at(mesh, 1 / 3)))
        assert run("flatten", source, "-o", out, "--seams", tmp_path / "edges.txt") == 0
        assert len(io.mapped(io.read_mesh(out)).islands) == 2

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("0 1\n0 400000\n", "line 2"),
            ("0 1\n2 " + "9" * 5000, f"'{'9' * 40}...' is far too large at line 2"),
            ("0 x\n", "is not an edge"),
            ("0 100\n", "not an edge of the mesh, so it cannot be cut"),
        ],
    )
    def test_invalid_lists_of_edges(self, source, tmp_path, capsys, text, words):
        (tmp_path / "edges.txt").write_text(text)
        assert run("flatten", source, "-o", tmp_path / "out.obj", "--seams", tmp_path / "edges.txt") == 2
        assert words in capsys.readouterr().err
        assert not (tmp_path / "out.obj").exists()

    def test_a_refined_atlas_keeps_its_vertices(self, source, tmp_path):
        out = tmp_path / "out.obj"
        assert run("map", source, "-o", out, "--to", "star:5", "--refine") == 0
        assert vertex_lines(out)[: len(vertex_lines(source))] == vertex_lines(source)
        assert atlas.certify(io.mapped(io.read_mesh(out))).bijective


class TestMirroredAndStacked:
    @pytest.mark.slow
    def test_a_mirrored_island_stays_mirrored_and_is_reported(self, tmp_path, capsys):
        before = seamed(tmp_path / "in.obj", mirrored=1)
        assert run("check", tmp_path / "in.obj") == 0
        assert "Mirrored, every triangle negative: island 1" in capsys.readouterr().out
        for command in ("polish", "harmonise", "map", "repair"):
            assert run(command, tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 0
            assert "irrored" in capsys.readouterr().out
            after = io.mapped(io.read_mesh(tmp_path / "out.obj"))
            assert atlas.certify(after).mirrored.tolist() == [1]
            rim = boundary(before.islands[1])
            assert np.array_equal(after.islands[1].uv[rim], before.islands[1].uv[rim])

    def test_a_mirrored_island_is_measured_from_the_other_side(self, tmp_path, capsys):
        seamed(tmp_path / "in.obj")
        run("measure", tmp_path / "in.obj", "--json", tmp_path / "straight.json")
        seamed(tmp_path / "in.obj", mirrored=1)
        run("measure", tmp_path / "in.obj", "--json", tmp_path / "mirrored.json")
        assert "mirrored island 1 measured with reversed orientation" in capsys.readouterr().out
        one, other = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("straight", "mirrored"))
        assert other["isometric"] == pytest.approx(one["isometric"])
        assert run("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 0
        said = capsys.readouterr().out
        assert "inf" not in said
        assert "strictly positive" not in said

    def test_flattening_mirrors_no_island(self, tmp_path):
        seamed(tmp_path / "in.obj", mirrored=1)
        assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 0
        assert not atlas.certify(io.mapped(io.read_mesh(tmp_path / "out.obj"))).mirrored.size

    @pytest.mark.slow
    def test_overlapping_islands_are_reported_and_left(self, tmp_path, capsys):
        seamed(tmp_path / "in.obj", stacked=True)
        assert run("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 0
        assert "Islands overlap or touch each other" in capsys.readouterr().out
        assert run("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--pack") == 0
        assert "Islands lie on" not in capsys.readouterr().out


class TestCut:
    @pytest.mark.long
    def test_a_closed_surface_stays_watertight(self, tmp_path):
        V, F = starfish(3, 8)
        (tmp_path / "in.obj").write_text(
            "".join(f"v {x:.7f} {y:.4f} {z:.3e} # {i}\n" for i, (x, y, z) in enumerate(V))
            + "usemtl one\n"
            + "".join(f"f {a} {b} {c}\n" for a, b, c in F + 1)
        )
        out, told = tmp_path / "out.obj", tmp_path / "told.json"
        assert run("flatten", tmp_path / "in.obj", "-o", out, "--cut", "--json", told) == 0
        assert vertex_lines(out) == vertex_lines(tmp_path / "in.obj")
        assert faces(out) == faces(tmp_path / "in.obj")
        mapped = io.mapped(io.read_mesh(out))
        assert len(mapped.seams) == json.loads(told.read_text())["cut_edges"] > 0
        # The written seams can be read and used by further commands.
        for command in (["polish"], ["flatten"], ["map", "--to", "letter:G", "--refine"], ["repair"]):
            assert run(command[0], out, "-o", tmp_path / "then.obj", *command[1:]) == 0
            if command[0] != "map":
                assert vertex_lines(tmp_path / "then.obj") == vertex_lines(tmp_path / "in.obj")
                assert np.array_equal(io.mapped(io.read_mesh(tmp_path / "then.obj")).seams, mapped.seams)

    def test_a_disk_is_no_error(self, tmp_path, capsys):
        V, F = grid(6, 6)
        io.write_obj(tmp_path / "in.obj", io.MeshData(lift(V), F))
        assert run("map", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--to", "disk", "--cut") == 0
        assert "nothing to cut" in capsys.readouterr().out
        assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--cut") == 0

    def test_given_edges_count_as_cuts(self, tmp_path, capsys):
        V, F = grid(6, 6)
        io.write_obj(tmp_path / "in.obj", io.MeshData(lift(V), F))
        (tmp_path / "edges.txt").write_text("0 8")
        call = "map", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--to", "disk", "--seams", tmp_path / "edges.txt"
        assert run(*call, "--cut") == 0
        assert "cut along 1 edge:" in capsys.readouterr().out

    def test_cuts_run_along_edges_of_quads(self, tmp_path):
        write_cube(tmp_path / "in.obj", 4)
        out = tmp_path / "out.obj"
        assert run("flatten", tmp_path / "in.obj", "-o", out, "--cut") == 0
        assert vertex_lines(out) == vertex_lines(tmp_path / "in.obj")
        assert faces(out) == faces(tmp_path / "in.obj")
        mesh = io.read_mesh(out)
        assert mesh.faces == 96
        inside = {tuple(sorted(e)) for e in mesh.polygons.diagonals(mesh.F).tolist()}
        assert not inside & {tuple(e) for e in io.mapped(mesh).seams.tolist()}

    def test_a_seam_inside_a_quad_is_rejected(self, tmp_path, capsys):
        write_cube(tmp_path / "in.obj", 2)
        mesh = io.read_mesh(tmp_path / "in.obj")
        a, b = mesh.polygons.diagonals(mesh.F)[0]
        (tmp_path / "edges.txt").write_text(f"{a} {b}\n")
        given = ["--seams", tmp_path / "edges.txt"]
        assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj", *given) == 2
        assert f"edge ({a}, {b}) inside a polygon" in capsys.readouterr().err


class TestSeenFromOutside:
    def test_the_boundary_is_that_of_the_seams(self, source, tmp_path, capsys):
        assert run("check", source, "--boundary", "--json", tmp_path / "told.json") == 0
        loops = json.loads((tmp_path / "told.json").read_text())["loops"]
        assert len(loops) == 3
        # Loops use the mesh's own vertex numbers, so vertices at a seam occur in two loops.
        vertices = np.concatenate([loop["vertices"] for loop in loops])
        assert vertices.max() < len(io.read_mesh(source).V)
        assert len(np.unique(vertices)) < len(vertices)

    @pytest.mark.long
    def test_a_batch_with_seams_has_a_report(self, source, tmp_path, quick_workers):
        assert run("batch", tmp_path, "-o", tmp_path / "out", "--flatten", "-j", "1") == 0
        assert run("batch", "-o", tmp_path / "out", "--report") == 0

    def test_isometric_islands_are_released(self, tmp_path):
        write_cube(tmp_path / "in.obj", 1)
        text = (tmp_path / "in.obj").read_text().replace("f ", "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf ", 1)
        lines = text.splitlines()
        for i, line in enumerate(lines):
            if line.startswith("f "):
                lines[i] = "f " + " ".join(f"{v}/{k + 1}" for k, v in enumerate(line.split()[1:]))
        (tmp_path / "in.obj").write_text("\n".join(lines) + "\n")
        assert run("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--free") == 0

    def test_a_face_without_coordinates_is_named(self, tmp_path, capsys):
        V, F = grid(3, 3)
        io.write_obj(tmp_path / "in.obj", io.MeshData(V, F).with_map(V))
        text = (tmp_path / "in.obj").read_text()
        last = text.splitlines()[-1]
        (tmp_path / "in.obj").write_text(text.replace(last, re.sub(r"/\d*", "", last)))
        for options in ([], ["--cut"]):
            assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj", *options) == 2
            assert "face 17 (0-based) without texture coordinates" in capsys.readouterr().err
        assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--seams", "none") == 0


class TestErrors:
    def test_an_island_that_is_not_injective_is_named(self, tmp_path, capsys):
        mesh = seamed(tmp_path / "in.obj")
        uv = mesh.uv.copy()
        inner = np.setdiff1d(mesh.FT[mesh.islands[1].triangles], rim_rows(mesh, 1))[0]
        uv[inner] += 5
        io.write_obj(tmp_path / "in.obj", io.MeshData(mesh.V, mesh.F, vt=uv, FT=mesh.FT))
        assert run("polish", tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 2
        first = mesh.islands[1].triangles[0]
        assert f"the island at triangle {first} (" in capsys.readouterr().err
        assert not (tmp_path / "out.obj").exists()

    def test_faces_without_coordinates_among_others(self, source, tmp_path, capsys):
        lines = source.read_text().splitlines()
        at = next(i for i, line in enumerate(lines) if line.startswith("f "))
        lines[at] = re.sub(r"/\d*", "", lines[at])
        source.write_text("\n".join(lines) + "\n")
        for command in ("polish", "flatten", "map"):
            assert run(command, source, "-o", tmp_path / "out.obj") == 2
            assert "face 0 (0-based) without texture coordinates" in capsys.readouterr().err
        assert not (tmp_path / "out.obj").exists()

    @pytest.mark.slow
    def test_an_island_with_a_handle_is_named(self, tmp_path, capsys):
        i, j = np.divmod(np.arange(100), 10)
        u, v = 2 * np.pi * i / 10, 2 * np.pi * j / 10
        V = np.stack([(3 + np.cos(v)) * np.cos(u), (3 + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)
        a, b, c, d = (((i + di) % 10) * 10 + (j + dj) % 10 for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
        F = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])[1:]
        io.write_obj(tmp_path / "in.obj", io.MeshData(np.vstack([V, V + 9]), np.vstack([F, F + 100])))
        assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 2
        said = capsys.readouterr().err
        assert "the island at triangle 0 (199 triangles)" in said
        assert "1 handle" in said
        assert run("flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--cut") == 0


class TestConvexity:
    @pytest.mark.parametrize(
        ("ring", "convex"),
        [
            ([(0, 0), (1, 0), (1, 1), (0, 1)], True),
            ([(0, 0), (1, 0), (0.4, 0.4), (0, 1)], False),
            ([(0, 0), (1, 0), (2, 0), (1, 1)], False),
            ([(0, 1), (1, 1), (1, 0), (0, 0)], False),
            ([(0, 0), (1, 1), (1, 0), (0, 1)], False),
            # A pentagram turns left at every corner and winds twice.
            ([(np.cos(a), np.sin(a)) for a in 4 * np.pi * np.arange(5) / 5], False),
        ],
    )
    def test_convex_rings_are_recognised(self, ring, convex):
        uv = np.array(ring, dtype=float)
        mesh = io.models.meshdata.polygon_mesh(
            np.column_stack([uv, np.zeros(len(uv))]), np.arange(len(uv)), np.array([0, len(uv)])
        )
        assert (find_concave(mesh.polygons, mesh.F, uv).size == 0) == convex

    def test_the_command_names_the_islands(self, tmp_path, capsys):
        (tmp_path / "dart.obj").write_text("v 0 0 0\nv 1 0 0\nv 0.4 0.4 0\nv 0 1 0\nv 1 1 0\nf 1 2 3 4\nf 2 5 4 3\n")
        assert run("check", tmp_path / "dart.obj") == 0
        said = capsys.readouterr().out
        assert "on the 4 triangles that stand for its 2 faces" in said
        assert run("check", tmp_path / "dart.obj", "--any-triangulation") == 1
        assert "face 0 not convex in the plane" in capsys.readouterr().out


class TestFunctions:
    def test_fixed_vertices_must_exist(self):
        V, F, uv, FT, _ = strips(4)
        with pytest.raises(ValueError, match="fixed refers to vertex 9999"):
            atlas.polish(SeamedMesh(V, F, FT, uv), fixed=[9999])

    def test_an_interrupting_callback_leaves_the_other_islands_unchanged(self):
        V, F, uv, FT, _ = strips(6)
        mesh = SeamedMesh(V, F, FT, uv)

        def stop(step):
            if step.iteration == 2:
                raise KeyboardInterrupt

        mapped = atlas.polish(mesh, callback=stop)
        assert mapped.status.name == "INTERRUPTED"
        assert len(mapped.islands) == 1
        assert np.array_equal(mapped.mesh.islands[2].uv, mesh.islands[2].uv)
        assert mapped.verdict().injective

    def test_the_input_is_not_changed(self):
        V, F, uv, FT, _ = strips(4)
        copies = [array.copy() for array in (V, F, uv, FT)]
        atlas.flatten(SeamedMesh(V, F, FT, uv))
        assert all(np.array_equal(a, b) for a, b in zip((V, F, uv, FT), copies, strict=True))

    def test_pins_determine_the_size(self):
        V, F, uv, FT, _ = strips(4)
        with pytest.raises(ValueError, match="fixed vertices determine the size of the map"):
            atlas.flatten(SeamedMesh(V, F, FT, uv), fixed=[0], unit_square=True)

    def test_weights_and_pins(self):
        V, F, uv, FT, _ = strips(4)
        mesh = SeamedMesh(V, F, FT, uv)
        pinned = [mesh.islands[1].vertices[12]]
        mapped = atlas.flatten(mesh, fixed=pinned, weights=np.ones(len(F)))
        assert np.array_equal(mapped.mesh.islands[1].uv[12], mesh.islands[1].uv[12])
        with pytest.raises(ValueError, match="weights"):
            atlas.flatten(mesh, weights=np.ones(3))


def boundary(island):
    sides = np.stack([island.F, np.roll(island.F, -1, axis=1)], axis=2).reshape(-1, 2)
    rows, count = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    return np.unique(rows[count == 1])


def rim_rows(mesh, which):
    island = mesh.islands[which]
    rim = boundary(island)
    rows = mesh.FT[island.triangles]
    return np.unique(rows[np.isin(island.F, rim)])


def seams_at(mesh, x):
    ends = np.stack([mesh.F, np.roll(mesh.F, -1, axis=1)], axis=2).reshape(-1, 2)
    along = ends[(np.abs(mesh.V[ends, 0] - x) < 1e-9).all(axis=1)]
    return np.unique(np.sort(along, axis=1), axis=0).tolist()


def write_cube(path, k):
    """A cube whose sides are k × k quads."""
    t = np.linspace(-1, 1, k + 1)
    x, y = (a.ravel() for a in np.meshgrid(t, t))
    one = np.ones_like(x)
    sides = [(x, y, one), (y, x, -one), (one, x, y), (-one, y, x), (y, one, x), (x, -one, y)]
    V = np.concatenate([np.stack(side, axis=1) for side in sides])
    corner = (np.arange(k)[:, None] * (k + 1) + np.arange(k)).ravel()
    quads = np.stack([corner, corner + 1, corner + k + 2, corner + k + 1], axis=1)
    quads = np.concatenate([quads + s * (k + 1) ** 2 for s in range(6)])
    _, first, same = np.unique(V.round(6), axis=0, return_index=True, return_inverse=True)
    text = "".join(f"v {a:g} {b:g} {c:g}\n" for a, b, c in V[first])
    path.write_text(text + "".join("f {} {} {} {}\n".format(*row) for row in same.ravel()[quads] + 1))


class TestOutlines:
    def test_each_chosen_island_goes_to_a_copy_of_an_outline(self, tmp_path):
        mesh = seamed(tmp_path / "in.obj")
        vertex = int(mesh.islands[2].vertices[0])
        found = atlas.injective_map(mesh, to="rect:2x1", corners={vertex: 1}, islands=[0, 2])
        assert found.verdict().bijective
        assert np.array_equal(found.mesh.islands[1].uv, mesh.islands[1].uv)
        boxes = [(found.mesh.islands[k].uv.min(axis=0), np.ptp(found.mesh.islands[k].uv, axis=0)) for k in (0, 2)]
        np.testing.assert_allclose([size for _, size in boxes], [[2, 1], [2, 1]])
        np.testing.assert_allclose(boxes[1][0] - boxes[0][0], [2.1, 0], atol=1e-12)
        corner = boxes[1][0] + [boxes[1][1][0], 0]
        np.testing.assert_allclose(found.mesh.islands[2].uv[0], corner, atol=1e-12)
        contours = targets.outline("rect:2x1")
        again = atlas.injective_map(mesh, to=contours, corners={vertex: 1}, islands=[0, 2])
        assert np.array_equal(again.mesh.uv, found.mesh.uv)
        for options, words in (({"fixed": [0], "to": "disk"}, "omit fixed or to"), ({"corners": "auto"}, "by to")):
            with pytest.raises(ValueError, match=words):
                atlas.injective_map(mesh, **options)
