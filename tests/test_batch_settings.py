"""Data sets with settings: outlines, free boundaries, corners, cuts and islands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import batch, boundary_loops, certify, distortion, flatten, io
from quasiharmonic.geometry.curves import Curve
from quasiharmonic.surfaces import annulus, cat, disk, grid, refine
from quasiharmonic.targets import outline, outline_curves, signed_area
from quasiharmonic.ui.cli import main
from shared.datasets import record_of, star_of

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]


OCTAHEDRON = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])


class TestSettings:
    def test_plain_meshes_mapped_to_an_outline(self, stars, tmp_path):
        io.write_off(stars / "ring.off", io.MeshData(*annulus(6)))
        settings = batch.Settings(to="letter:O")
        progress = batch.run(stars, tmp_path / "out", settings, jobs=1)
        assert progress.outcomes == {"injective": 5}
        (outer, hole), curves = outline("letter:O"), outline_curves("letter:O")
        for name, loops in (("a/input.obj", [outer]), ("ring.off", [outer, hole])):
            written = io.read_mesh(tmp_path / "out" / "results" / name / "map.obj")
            uv = io.map_of(written)
            areas = [abs(signed_area(uv[loop])) for loop in boundary_loops(written.F, len(uv))]
            np.testing.assert_allclose(sorted(areas), sorted(abs(signed_area(c)) for c in loops), rtol=0.2)
            # The boundary vertices are on the outline, up to the chords that it is sampled with.
            away = np.min([curve.nearest(uv[boundary_loops(written.F, len(uv))[0]])[1] for curve in curves], axis=0)
            assert away.max() < 1e-5

    def test_boundaries_that_slide(self, stars, tmp_path):
        energies = []
        for slide in (False, True):
            settings = batch.Settings(to="letter:O", polish="symmetric-dirichlet", slide=slide)
            assert batch.run(stars / "a", tmp_path / f"{slide}", settings, jobs=1).outcomes == {"injective": 1}
            written = io.read_mesh(tmp_path / f"{slide}" / "results" / "input.obj" / "map.obj")
            uv = io.map_of(written)
            energies.append(distortion(written.V, written.F, uv).statistics("symmetric_dirichlet").mean)
        assert energies[1] < 0.95 * energies[0]
        (loop,) = boundary_loops(written.F, len(uv))
        # Distances from the font's curves, not from chords of them.
        away = np.min([curve.nearest(uv[loop])[1] for curve in outline_curves("letter:O")], axis=0)
        assert away.max() < 1e-14

    def test_pieces_and_the_corner_angle_are_those_of_the_map_command(self, tmp_path):
        """A vertex that is assigned to a side slides on it; every point is a corner with an angle of 0."""
        (tmp_path / "set").mkdir()
        V, F = grid(6, 6)
        io.write_obj(tmp_path / "set" / "a.obj", io.MeshData(V, F))
        corners, sides = "near:0,0,0,near:1,0,0,near:1,1,0,near:0,1,0", tmp_path / "pieces.txt"
        sides.write_text("3 0\n")
        given = {"to": "rect:2x1", "corners": corners, "polish": "symmetric-dirichlet", "slide": True}
        settings = batch.Settings(**given, pieces=str(sides))
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).outcomes == {"injective": 1}
        map_file = tmp_path / "map.obj"
        options = ["--to", "rect:2x1", "--corners", corners, "--slide", "--polish", "symmetric-dirichlet"]
        assert (
            main(["map", str(tmp_path / "set" / "a.obj"), "-o", str(map_file), *options, "--pieces", str(sides)]) == 0
        )
        again = io.map_of(io.read_mesh(tmp_path / "out" / "results" / "a.obj" / "map.obj"))
        np.testing.assert_allclose(again, io.map_of(io.read_mesh(map_file)), atol=1e-9)
        sides.write_text("3 9\n")
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).outcomes == {"invalid": 1}
        assert "sides 0 … 3" in record_of(tmp_path / "out", "a.obj")["error"]
        with pytest.raises(ValueError, match="set slide as well"):
            batch.run(tmp_path / "set", tmp_path / "b", batch.Settings(to="rect:2x1", pieces=str(sides)))
        with pytest.raises(ValueError, match="font applies only to"):
            batch.run(tmp_path / "set", tmp_path / "b", batch.Settings(font="x.ttf"))

    def test_boundaries_slide_on_their_exact_curves(self, stars, tmp_path):
        settings = batch.Settings(polish="symmetric-dirichlet", slide=True)
        assert batch.run(stars / "a", tmp_path / "out", settings, jobs=1).outcomes == {"injective": 1}
        written = io.read_mesh(tmp_path / "out" / "results" / "a" / "map.obj")
        loop, target = star_of(5, depth=0.7)[2:]
        uv = io.map_of(written)
        assert Curve.polygon(target).nearest(uv[loop])[1].max() < 1e-14
        assert np.abs(uv[loop] - target).max() > 1e-3

    def test_free_boundaries(self, tmp_path):
        V, F = cat(5)
        (tmp_path / "set" / "rings").mkdir(parents=True)
        io.write_off(tmp_path / "set" / "rings" / "ring.off", io.MeshData(*annulus(6)))
        io.write_obj(tmp_path / "set" / "cat.obj", io.MeshData(V, F))
        closed = io.MeshData(np.eye(4)[:, :3], np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
        io.write_obj(tmp_path / "set" / "closed.obj", closed)
        flat = io.MeshData(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
        io.write_obj(tmp_path / "set" / "flat.obj", flat)
        settings = batch.Settings(flatten=True, energy="mips")
        progress = batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1)
        assert progress.outcomes == {"bijective": 2, "invalid": 2}
        assert (progress.solved, progress.failed) == (2, 2)
        record = record_of(tmp_path / "out", "cat.obj")
        written = io.read_mesh(tmp_path / "out" / "results" / "cat.obj" / "map.obj")
        assert certify(written.F, io.map_of(written)).bijective
        assert (record["outcome"], record["certified"], record["bijective"]) == ("bijective", True, True)
        assert (record["vertices"], record["triangles"], record["loops"]) == (len(V), len(F), 1)
        assert record["status"] == "polished"
        # The energy is the mean of this measure.
        assert record["energy"] == pytest.approx(record["mips"], rel=1e-9)
        np.testing.assert_array_equal(io.map_of(written), flatten(V, F, energy="mips").uv)
        assert record_of(tmp_path / "out", "rings/ring.off")["loops"] == 2
        assert "closed" in record_of(tmp_path / "out", "closed.obj")["error"]
        assert "zero area" in record_of(tmp_path / "out", "flat.obj")["error"]
        # Finished problems are not solved again; a different energy solves them again.
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).resumed == 4
        cats = tmp_path / "set" / "cat.obj"
        assert batch.run(cats, tmp_path / "out", batch.Settings(flatten=True), jobs=1).resumed == 0
        other = batch.Settings(flatten=True, energy="distances")
        assert batch.run(cats, tmp_path / "out", other, jobs=1).outcomes == {"bijective": 1}
        assert "guarded descent, distances" in record_of(tmp_path / "out", "cat.obj")["stages"]

    def test_corners_by_angle_and_by_position(self, tmp_path):
        """Corners by angle for any sheet, by position for aligned sheets; a file of corners is part of the input."""
        for name, cells in (("a", (9, 6)), ("b", (5, 8))):
            (tmp_path / "set").mkdir(exist_ok=True)
            io.write_obj(tmp_path / "set" / f"{name}.obj", io.MeshData(*grid(*cells)))
        chosen = tmp_path / "corners.txt"
        chosen.write_text("near:0,0,0\nnear:1,0,0\nnear:1,1,0\nnear:0,1,0\n")
        for corners in ("auto", "near:0,0,0,near:1,0,0,near:1,1,0,near:0,1,0", str(chosen)):
            settings = batch.Settings(to="rect:3x1", corners=corners)
            progress = batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1)
            assert progress.outcomes == {"injective": 2}
            assert progress.resumed == 0
            for name, corner in (("a", [0, 9, 69, 60]), ("b", [0, 5, 53, 48])):
                uv = io.map_of(io.read_mesh(tmp_path / "out" / "results" / f"{name}.obj" / "map.obj"))
                assert uv[corner].tolist() == [[0, 0], [3, 0], [3, 1], [0, 1]]
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).resumed == 2
        chosen.write_text("near:0,0,0 0\n")
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).resumed == 0
        chosen.write_text("near:0,0,0\n")
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).outcomes == {"invalid": 2}
        assert "1 corner vertex for a contour with 4 corners" in record_of(tmp_path / "out", "a.obj")["error"]

    def test_started_from_the_files_map_and_packed(self, tmp_path):
        V, F = grid(4, 4)
        V = np.column_stack([V, V[:, 0] * V[:, 1]])
        uv = flatten(V, F).uv
        V, F = np.concatenate([V, V + 9]), np.concatenate([F, F + len(V)])
        (tmp_path / "set").mkdir()
        io.write_map(tmp_path / "set/two.obj", io.MeshData(V, F), np.concatenate([uv, uv + 9]))
        iterations = []
        for start in (False, True):
            settings = batch.Settings(flatten=True, start=start, pack=True)
            assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).solved == 1
            iterations.append(record_of(tmp_path / "out", "two.obj")["iterations"])
        assert iterations[1] < iterations[0]
        uv = io.read_mesh(tmp_path / "out/results/two.obj/map.obj").vt
        assert uv.min() >= 0
        assert 0.6 < uv.max() <= 1

    @pytest.mark.parametrize("options", [{"to": "letter:H", "refine": True}, {"flatten": True}])
    def test_surfaces_that_cannot_be_flattened_are_cut(self, tmp_path, options):
        """Cuts are seams: vertices and faces are unchanged. With an outline, a disk is not cut."""
        source = tmp_path / "set"
        source.mkdir()
        V, F = refine(*(np.vstack([np.eye(3), -np.eye(3)]), OCTAHEDRON))
        V, F = refine(V, F)
        io.write_obj(source / "closed.obj", io.MeshData(V / np.linalg.norm(V, axis=1)[:, None], F))
        io.write_obj(source / "disk.obj", io.MeshData(*cat(8)))
        wanted = "bijective" if "flatten" in options else "injective"
        assert batch.run(source, tmp_path / "none", batch.Settings(**options), jobs=1).outcomes == {
            wanted: 1,
            "invalid": 1,
        }
        settings = batch.Settings(cut=True, **options)
        assert batch.run(source, tmp_path / "out", settings, jobs=1).outcomes == {wanted: 2}
        before, after = (
            io.read_mesh(path) for path in (source / "closed.obj", tmp_path / "out/results/closed.obj/map.obj")
        )
        record = record_of(tmp_path / "out", "closed.obj")
        assert record["cut_edges"] > 0
        assert (record["islands"], record["loops"]) == (1, 1)
        added = record.get("added_vertices", 0)
        assert len(after.V) == len(before.V) + added
        np.testing.assert_array_equal(after.V[: len(before.V)], before.V)
        if not added:
            np.testing.assert_array_equal(after.F, before.F)
        # The surface stays closed: the cut is in the map alone.
        assert not boundary_loops(after.F, len(after.V))
        assert certify(*io.cut_at_seams(after)[1:]).injective
        if wanted == "injective":
            assert record_of(tmp_path / "out", "disk.obj")["cut_edges"] == 0

    def test_edges_without_space_are_split(self, tmp_path):
        V, F = disk(1)
        ring = np.arange(1, 7)
        tips = 1.2 * (V[ring] + V[np.roll(ring, -1)]) / 2
        V, F = np.vstack([V, tips]), np.vstack([F, np.stack([np.roll(ring, -1), ring, len(V) + np.arange(6)], axis=1)])
        (tmp_path / "set").mkdir()
        io.write_obj(tmp_path / "set" / "ears.obj", io.MeshData(V, F))
        assert batch.run(tmp_path / "set", tmp_path / "a", batch.Settings(to="rect:2x1"), jobs=1).solved == 0
        settings = batch.Settings(to="rect:2x1", refine=True)
        assert batch.run(tmp_path / "set", tmp_path / "b", settings, jobs=1).solved == 1
        record = record_of(tmp_path / "b", "ears.obj")
        assert record["added_vertices"] >= 2
        assert record["vertices"] == len(V) + record["added_vertices"]
        written = io.read_mesh(tmp_path / "b" / "results" / "ears.obj" / "map.obj")
        np.testing.assert_array_equal(written.V[: len(V), :2], V)

    def test_islands_keep_their_borders(self, tmp_path):
        """Each island of a file with seams is mapped with its border kept; onto an outline, each fills its own copy."""
        V, F = grid(6, 4)
        left = V[F].mean(axis=1)[:, 0] < 0.5
        uv = np.vstack([V, V * (-1, 1) + (4, 0)])
        mesh = io.MeshData(V, F, uv, np.where(left[:, None], F, F + len(V)))
        (tmp_path / "set").mkdir()
        io.write_obj(tmp_path / "set" / "input.obj", mesh)
        batch.run(tmp_path / "set", tmp_path / "out", jobs=1)
        (name,) = (path.parent for path in (tmp_path / "out" / "results").rglob("map.obj"))
        record = json.loads((name / "record.json").read_text())
        assert (record["outcome"], record["islands"], record["fixed"]) == ("injective", 2, 2 * 14)
        written = io.read_mesh(name / "map.obj")
        border = np.isin(
            F, np.concatenate([loop for part in (F[left], F[~left]) for loop in boundary_loops(part, len(V))])
        )
        np.testing.assert_array_equal(written.vt[written.FT][border], uv[mesh.FT][border])
        settings = batch.Settings(to="rect:2x1", refine=True)
        batch.run(tmp_path / "set" / "input.obj", tmp_path / "to", settings, jobs=1)
        record = record_of(tmp_path / "to", "input.obj")
        assert (record["outcome"], record["bijective"], record["islands"]) == ("injective", True, 2)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (
                {"flatten": True, "corners": "auto"},
                "corners needs a given boundary, but flatten leaves the boundary free",
            ),
            ({"flatten": True, "refine": True}, "refine needs a given boundary, but flatten leaves the boundary free"),
            ({"cut": True}, "cut applies only to plain meshes with an outline: give the outline by to"),
            ({"corners": "auto"}, "corners applies only to plain meshes with an outline"),
            ({"to": "rect:1x1", "corners": "near:1,2"}, "'near:1,2' is not one of V, V:K and V:X:Y"),
            ({"flatten": True, "to": "letter:O"}, "to needs a given boundary, but flatten leaves the boundary free"),
            (
                {"flatten": True, "polish": "mips"},
                "polish needs a given boundary, but flatten leaves the boundary free",
            ),
            ({"flatten": True, "slide": True}, "slide needs a given boundary, but flatten leaves the boundary free"),
            (
                {"slide": True},
                "the boundary slides only while distortion is lowered: give an energy as well, by polish",
            ),
            ({"energy": "mips"}, "energy applies only to flatten"),
            ({"flatten": True, "energy": "arap"}, "energy must be one of .*arap-barrier, distances, not 'arap'"),
        ],
    )
    def test_options_incompatible_with_free_boundaries(self, stars, tmp_path, options, message):
        with pytest.raises(ValueError, match=message):
            batch.run(stars, tmp_path / "out", batch.Settings(**options))
        assert not (tmp_path / "out").exists()

    def test_a_drawing_is_part_of_the_input(self, stars, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("outline.csv").write_text("0,0\n2,0\n2,1\n0,1\n", encoding="utf-8")
        settings = batch.Settings(to="outline.csv")
        assert batch.run(stars / "a", "out", settings).solved == 1
        assert batch.run(stars / "a", "out", settings).resumed == 1
        Path("outline.csv").write_text("0,0\n3,0\n3,1\n0,1\n", encoding="utf-8")
        assert batch.run(stars / "a", "out", settings).resumed == 0
        with pytest.raises(ValueError, match="blob"):
            batch.run(stars, "other", batch.Settings(to="blob:3"))
        assert not Path("other").exists()


class TestMapFormat:
    def test_binary_maps_are_the_same_and_replace_others(self, stars, tmp_path):
        """Bit for bit; resumed, checked, merged and reported like OBJ files, from problems in either format."""
        ply = batch.Settings(map_format="ply")
        source = tmp_path / "binary" / "p"
        source.mkdir(parents=True)
        io.write_ply(source / "input.ply", io.read_mesh(stars / "a" / "input.obj"))
        (source / "handles.txt").write_bytes((stars / "a" / "handles.txt").read_bytes())
        out = tmp_path / "out"
        assert batch.run(stars, out, jobs=1).solved == 4
        maps = {path.parent: io.read_mesh(path) for path in (out / "results").rglob("map.obj")}
        assert len(maps) == 4
        for shard in ("1/2", "2/2"):
            assert main(["batch", str(stars), "-o", str(out), "--map-format", "ply", "-j1", "--shard", shard]) == 0
        assert main(["batch", "-o", str(out), "--merge", "--report"]) == 0
        assert (out / "report.html").read_text().count("data:image/png") > 3
        assert batch.run(stars, out, ply, jobs=1).resumed == 4
        for folder, mesh in maps.items():
            assert sorted(path.name for path in folder.iterdir()) == ["map.ply", "record.json"]
            found = io.read_mesh(folder / "map.ply")
            np.testing.assert_array_equal(found.V, mesh.V)
            np.testing.assert_array_equal(io.map_of(found), io.map_of(mesh))
        assert main(["check", str(folder / "map.ply")]) == 0
        assert batch.run(tmp_path / "binary", tmp_path / "b", ply, jobs=1).solved == 1
        once, again = (path / "results" / name / "map.ply" for path, name in ((out, "a"), (tmp_path / "b", "p")))
        np.testing.assert_array_equal(io.map_of(io.read_mesh(once)), io.map_of(io.read_mesh(again)))
        (out / "results/a/map.ply").write_bytes(once.read_bytes()[:-1])
        assert batch.run(stars, out, ply, jobs=1).resumed == 3

    def test_models(self, tmp_path):
        (tmp_path / "set").mkdir()
        io.write_obj(
            tmp_path / "set" / "octahedron.obj",
            io.MeshData(np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 0, 0], [0, 0, -1]]), OCTAHEDRON),
        )
        settings = batch.Settings(unwrap={}, map_format="ply")
        assert batch.run(tmp_path / "set", tmp_path / "out", settings, jobs=1).outcomes == {"bijective": 1}
        assert main(["check", str(tmp_path / "out/results/octahedron.obj/map.ply")]) == 0
