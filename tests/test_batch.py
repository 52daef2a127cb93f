"""Data sets on one machine: all problems are found and recorded, and a failure does not affect other problems."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import batch, boundary_loops, certify, distortion, flatten, io
from quasiharmonic.geometry.curves import Curve
from quasiharmonic.surfaces import annulus, cat, disk, grid, refine
from quasiharmonic.targets import outline, outline_curves, signed_area
from quasiharmonic.ui.batch import driver, records, supervisor
from quasiharmonic.ui.batch import settings as settings_module
from quasiharmonic.ui.batch.settings import sources
from quasiharmonic.ui.batch.supervisor import Finished
from quasiharmonic.ui.cli import main
from shared.datasets import record_of, star_of, write_problem, write_stars

pytestmark = pytest.mark.slow

OCTAHEDRON = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])


def names(source, **options):
    return [problem.name for problem in batch.find_problems(source, **options)]


@pytest.fixture
def stars(tmp_path):
    """Four problems at several folder depths."""
    return write_stars(tmp_path / "set", ["a", "b/c", "b/d/e", "z"])


class TestFinding:
    def test_any_depth_in_order(self, stars):
        (stars / "b" / "notes.txt").write_text("no problem")
        (stars / "b" / "other.obj").write_text("no problem by itself")
        found = list(batch.find_problems(stars))
        assert [problem.name for problem in found] == ["a", "b/c", "b/d/e", "z"]
        assert found[1].mesh == stars / "b/c/input.obj"
        assert found[1].fixed == stars / "b/c/handles.txt"

    @pytest.mark.skipif(os.name != "posix", reason="makes links and pipes")
    def test_unreadable_files_are_invalid_and_delay_nothing(self, stars, tmp_path):
        (stars / "a" / "handles.txt").unlink()
        (stars / "a" / "handles.txt").symlink_to("nowhere")
        (stars / "z" / "input.obj").unlink()
        os.mkfifo(stars / "z" / "input.obj")
        assert batch.run(stars, tmp_path / "out", jobs=1).outcomes == {"injective": 2, "invalid": 2}
        a, z = (record_of(tmp_path / "out", name)["error"] for name in "az")
        assert re.fullmatch(r"\S+/a/handles.txt: cannot be read: No such file or directory", a)
        assert re.fullmatch(r"\S+/z/input.obj: cannot be read: it is not a regular file", z)

    def test_an_unreadable_folder_is_reported(self, stars, tmp_path, monkeypatch):
        def refuse(folder):
            if folder == stars / "b" / "d":
                raise PermissionError(errno.EACCES, "Permission denied", str(folder))
            return scandir(folder)

        scandir = os.scandir
        monkeypatch.setattr(os, "scandir", refuse)
        with pytest.raises(OSError, match=r"\S+/b/d: the folder cannot be read: Permission denied"):
            batch.run(stars, tmp_path / "out")

    def test_a_problem_folder_may_contain_others(self, stars):
        write_stars(stars, ["b"])
        assert names(stars) == ["a", "b", "b/c", "b/d/e", "z"]
        assert names(stars / "a") == ["a"]
        assert names(stars / "b") == ["b", "b/c", "b/d/e"]
        (stars / "a" / "handles.txt").unlink()
        assert next(batch.find_problems(stars)).fixed is None

    def test_plain_meshes(self, stars):
        (stars / "b" / "other.OFF").write_text("")
        assert names(stars, plain=True) == [
            "a/input.obj", "b/c/input.obj", "b/d/e/input.obj", "b/other.OFF", "z/input.obj",
        ]  # fmt: skip
        assert names(stars / "a" / "input.obj") == ["input.obj"]

    def test_every_entry_of_a_list_is_a_folder(self, stars):
        (stars / "empty").mkdir()
        (stars / "notes").mkdir()
        (stars / "notes" / "other.obj").write_text("no problem by itself")
        for name in ("empty", "notes"):
            (stars / "list.txt").write_text(f"a\n{name}\nz\n")
            with pytest.raises(ValueError, match=rf"list.txt: line 2: there is no problem in the folder '{name}'"):
                names(stars / "list.txt")
        assert names(stars / "list.txt", plain=True)[1] == "notes/other.obj"
        # A problem listed twice is found once.
        (stars / "list.txt").write_text("b/c\nb\nb\n")
        assert names(stars / "list.txt") == ["b/c", "b/d/e"]

    @pytest.mark.skipif(os.name != "posix", reason="makes links")
    def test_cyclic_links_delay_nothing(self, stars):
        (stars / "one").symlink_to("two")
        (stars / "two").symlink_to("one")
        (stars / "b" / "self").symlink_to("self")
        (stars / "b" / "nowhere").symlink_to("missing")
        (stars / "b" / "up").symlink_to("..")
        assert names(stars) == ["a", "b/c", "b/d/e", "z"]

    def test_lists(self, stars, tmp_path):
        elsewhere = write_stars(tmp_path / "elsewhere", ["y"])
        text = f"# a list\n\nz # the last\nb\n{elsewhere}/y\nb/c\na/input.obj\n"
        (stars / "list.txt").write_text(text)
        assert names(stars / "list.txt") == ["z", "b/c", "b/d/e", f"{elsewhere}/y".lstrip("/"), "a/input.obj"]
        write_stars(stars, ["no#1"])
        (stars / "list.txt").write_bytes(b"\xef\xbb\xbfno#1\r\n\t# from another system\r\n")
        assert names(stars / "list.txt") == ["no#1"]
        (stars / "list.txt").write_text("a\nnowhere\n")
        with pytest.raises(ValueError, match=r"list.txt: line 2: .*nowhere"):
            names(stars / "list.txt")
        (stars / "list.txt").write_bytes(b"\x89PNG\r\n\x1a\0")
        with pytest.raises(ValueError, match=r"line 1: there is no folder and no mesh file '\\udc89PNG'"):
            names(stars / "list.txt")
        with pytest.raises(ValueError, match="there is no folder, list or mesh"):
            names(stars / "none")

    def test_output_is_not_used_as_input(self, stars):
        batch.run(stars, stars / "out", jobs=1)
        assert names(stars) == ["a", "b/c", "b/d/e", "z"]
        assert len(names(stars, plain=True)) == 4

    @pytest.mark.skipif(os.name != "posix", reason="makes links")
    def test_links_are_followed_except_cycles(self, stars):
        (stars / "linked").symlink_to(stars / "b")
        (stars / "b" / "back").symlink_to(stars)
        assert names(stars) == ["a", "b/c", "b/d/e", "linked/c", "linked/d/e", "z"]


class TestRun:
    def test_maps_and_records(self, stars, tmp_path):
        seen = []
        progress = batch.run(stars, tmp_path / "out", jobs=2, callback=lambda p: seen.append((p.done, p.failed)))
        assert (progress.total, progress.done, progress.solved, progress.failed) == (4, 4, 4, 0)
        assert progress.outcomes == {"injective": 4}
        assert seen[-1] == (4, 0)
        for name in ("a", "b/c", "b/d/e", "z"):
            mesh = io.read_mesh(stars / name / "input.obj")
            written = io.read_mesh(tmp_path / "out" / "results" / name / "map.obj")
            fixed = io.read_handles(stars / name / "handles.txt", len(mesh.V))
            uv = io.map_of(written)
            np.testing.assert_array_equal(written.V, mesh.V)
            np.testing.assert_array_equal(written.F, mesh.F)
            np.testing.assert_array_equal(uv[fixed], io.map_of(mesh)[fixed])
            assert certify(mesh.F, uv).injective
            record = record_of(tmp_path / "out", name)
            assert record["certified"]
            assert (record["vertices"], record["triangles"]) == (len(mesh.V), len(mesh.F))
            assert record["flips_after"] == 0
            assert record["iterations"] == sum(stage["n_iterations"] for stage in json.loads(record["stages"]))
            parts = [v for k, v in record.items() if k.startswith("seconds_")]
            assert 0 < sum(parts) <= record["seconds"]
            assert record["mips"] > 0
            assert record["isometric"] >= 1
            assert set(json.loads(record["versions"])) == {"quasiharmonic", "python", "numpy", "scipy"}
            assert set(record) <= set(batch.COLUMNS)
        assert record["flips_before"] > 0  # of the last problem; the first ones are easy
        table = list(batch.read_table(tmp_path / "out" / "records.csv"))
        assert [row["problem"] for row in table] == ["a", "b/c", "b/d/e", "z"]
        for row in table:
            expected = record_of(tmp_path / "out", row["problem"])
            assert {k: v for k, v in row.items() if v is not None} == {
                k: v for k, v in expected.items() if v is not None
            }

    def test_distortion_is_that_of_the_map(self, stars, tmp_path):
        """Compare with singular values computed in the test."""
        batch.run(stars / "a", tmp_path / "out", batch.Settings(polish="mips"))
        mesh = io.read_mesh(tmp_path / "out" / "results" / "a" / "map.obj")
        a, b, c = mesh.V[mesh.F, :2].transpose(1, 0, 2)
        p, q, r = io.map_of(mesh)[mesh.F].transpose(1, 0, 2)
        J = np.stack([q - p, r - p], axis=2) @ np.linalg.inv(np.stack([b - a, c - a], axis=2))
        sigma = np.linalg.svd(J, compute_uv=False)
        area = np.abs(np.cross(np.pad(b - a, [(0, 0), (0, 1)]), np.pad(c - a, [(0, 0), (0, 1)]))[:, 2])
        ratio = sigma[:, 0] / sigma[:, 1]
        record = record_of(tmp_path / "out", "a")
        assert record["mips"] == pytest.approx(np.average(ratio + 1 / ratio - 2, weights=area), rel=1e-9)
        sigma = sigma * np.sqrt(area.sum() / (area * sigma.prod(axis=1)).sum())
        assert record["isometric"] == pytest.approx(max(sigma.max(), 1 / sigma.min()), rel=1e-9)
        assert record["seconds_polish"] > 0
        assert record["status"] == "polished"

    def test_a_rerun_solves_new_problems_only(self, stars, tmp_path):
        out = tmp_path / "out"
        batch.run(stars, out, jobs=1)
        stamps = {path: path.stat().st_mtime_ns for path in out.rglob("map.obj")}
        write_problem(stars / "a", *star_of(4))  # other contents
        (out / "results/b/c/record.json").write_text('{"key": "cut sho')
        os.truncate(out / "results/b/d/e/map.obj", 100)  # as a power failure might
        (out / "results/b/c/.qhm-0123.tmp").write_text("left by a kill")
        progress = batch.run(stars, out, jobs=1)
        assert (progress.solved, progress.resumed) == (4, 1)
        again = {path for path, stamp in stamps.items() if path.stat().st_mtime_ns != stamp}
        assert again == {out / "results" / name / "map.obj" for name in ("a", "b/c", "b/d/e")}
        assert not list(out.rglob("*.tmp"))
        assert batch.run(stars, out, jobs=1).resumed == 4
        assert batch.run(stars, out, batch.Settings(strategy="paper"), jobs=1).resumed == 0

    def test_problems_of_another_version_are_solved_again(self, stars, tmp_path, monkeypatch):
        assert batch.run(stars / "a", tmp_path / "out").resumed == 0
        assert batch.run(stars / "a", tmp_path / "out").resumed == 1
        package = tmp_path / "package"
        (package / "ui" / "report").mkdir(parents=True)
        monkeypatch.setattr(settings_module, "__file__", str(package / "ui" / "batch" / "settings.py"))
        states = []
        for file, text in (
            ("__init__.py", ""),
            ("solving.py", "a = 1"),
            ("solving.py", "a = 2"),
            ("ui/report/page.py", "only shows"),
        ):
            (package / file).write_text(text)
            states.append(settings_module.sources_digest.__wrapped__())
        assert len(set(states)) == 3
        assert states[2] == states[3]
        monkeypatch.setattr(settings_module, "sources_digest", lambda: states[0])
        assert batch.run(stars / "a", tmp_path / "out").resumed == 0

    def test_one_run_at_a_time(self, stars, tmp_path):
        pytest.importorskip("fcntl")
        out, refused = tmp_path / "out", []

        def again(progress):
            with pytest.raises(OSError, match=r"another run is writing to .*out"):
                batch.run(stars, out)
            refused.append(progress.done)

        assert batch.run(stars, out, jobs=1, callback=again).solved == 4
        assert refused[-1] == 4
        assert batch.run(stars, out).resumed == 4

    def test_files_of_other_origin_are_not_overwritten(self, stars, tmp_path):
        for out in (stars, stars / "b", stars / "a"):
            with pytest.raises(ValueError, match=r"contains a problem, .*input.obj: choose another folder"):
                batch.run(stars, out)
            assert not list(stars.rglob("qhm-batch*"))
        (tmp_path / "records.csv").write_text("mine")
        with pytest.raises(OSError, match=r"has a records.csv that belongs to no run"):
            batch.run(stars, tmp_path)
        assert (tmp_path / "records.csv").read_text() == "mine"
        assert not (tmp_path / "results").exists()
        # An output folder above the problems is allowed.
        (tmp_path / "records.csv").unlink()
        assert batch.run(stars / "b", stars).solved == batch.run(stars / "b", stars).resumed == 2

    def test_no_process_starts_if_everything_is_done(self, stars, tmp_path, monkeypatch):
        batch.run(stars, tmp_path / "out", jobs=1)
        monkeypatch.setattr(supervisor, "COMMAND", ["/nonexistent"])
        assert batch.run(stars, tmp_path / "out").resumed == 4

    def test_plain_meshes_mapped_to_an_outline(self, stars, tmp_path):
        io.write_off(stars / "ring.off", io.MeshData(*annulus(6)))
        settings = batch.Settings(to="letter:O")
        progress = batch.run(stars, tmp_path / "out", settings, jobs=1)
        assert progress.outcomes == {"injective": 5}
        (outer, hole) = outline("letter:O")
        for name, loops in (("a/input.obj", [outer]), ("ring.off", [outer, hole])):
            written = io.read_mesh(tmp_path / "out" / "results" / name / "map.obj")
            uv = io.map_of(written)
            areas = [abs(signed_area(uv[loop])) for loop in boundary_loops(written.F, len(uv))]
            np.testing.assert_allclose(sorted(areas), sorted(abs(signed_area(c)) for c in loops), rtol=0.2)

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

    def test_corners(self, tmp_path):
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
        V, F = disk(2)
        ring = np.arange(len(V) - 12, len(V))
        tips = 1.2 * (V[ring] + V[np.roll(ring, -1)]) / 2
        V, F = np.vstack([V, tips]), np.vstack([F, np.stack([np.roll(ring, -1), ring, len(V) + np.arange(12)], axis=1)])
        (tmp_path / "set").mkdir()
        io.write_obj(tmp_path / "set" / "ears.obj", io.MeshData(V, F))
        assert batch.run(tmp_path / "set", tmp_path / "a", batch.Settings(to="rect:2x1"), jobs=1).solved == 0
        settings = batch.Settings(to="rect:2x1", refine=True)
        assert batch.run(tmp_path / "set", tmp_path / "b", settings, jobs=1).solved == 1
        record = record_of(tmp_path / "b", "ears.obj")
        assert record["added_vertices"] >= 8
        assert record["vertices"] == len(V) + record["added_vertices"]
        written = io.read_mesh(tmp_path / "b" / "results" / "ears.obj" / "map.obj")
        np.testing.assert_array_equal(written.V[: len(V), :2], V)

    def test_islands(self, tmp_path):
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

    def test_parquet(self, stars, tmp_path):
        pytest.importorskip("pyarrow")
        batch.run(stars, tmp_path / "out", jobs=1, table="parquet")
        table = list(batch.read_table(tmp_path / "out" / "records.parquet"))
        assert [row["problem"] for row in table] == ["a", "b/c", "b/d/e", "z"]
        assert table[0]["certified"] is True
        batch.run(stars, tmp_path / "out", jobs=1)
        assert [*batch.read_table(tmp_path / "out" / "records.csv")] == table
        assert not (tmp_path / "out" / "records.parquet").exists()

    def test_rejected_calls(self, stars, tmp_path):
        (tmp_path / "empty").mkdir()
        with pytest.raises(ValueError, match=r"no problems in .*empty"):
            batch.run(tmp_path / "empty", tmp_path / "out")
        for wrong in ({"jobs": 0}, {"threads": 0}, {"time_limit": -1.0}, {"memory_limit": 0}, {"table": "xls"}):
            with pytest.raises(ValueError, match=next(iter(wrong)) if "table" not in wrong else "csv or .parquet"):
                batch.run(stars, tmp_path / "out", **wrong)
        for name, value in (
            ("strategy", "hope"),
            ("polish", "soap"),
            ("reference", "x"),
            ("linear_solver", "abacus"),
            ("max_iterations", 0),
        ):
            with pytest.raises(ValueError, match=f"{name} must be .*, not {value!r}"):
                batch.run(stars, tmp_path / "out", batch.Settings(**{name: value}))
        with pytest.raises(ValueError, match="jobs"):
            batch.run(stars, tmp_path / "out", jobs=2, scheduler="tcp://localhost:1")
        assert not (tmp_path / "out").exists()
        (tmp_path / "file").write_text("")
        with pytest.raises(OSError, match="cannot create the folder"):
            batch.run(stars, tmp_path / "file" / "out")
        with pytest.raises(OSError, match="it is not a folder"):
            batch.run(stars, tmp_path / "file")

    def test_worker_that_does_not_start(self, stars, tmp_path, monkeypatch, capsys):
        monkeypatch.setattr(supervisor, "COMMAND", [sys.executable, "-c", "raise SystemExit('no such luck')"])
        with pytest.raises(batch.WorkerError, match="no such luck"):
            batch.run(stars, tmp_path / "out")
        monkeypatch.setattr(supervisor, "COMMAND", ["/nonexistent"])
        assert main(["batch", str(stars), "-o", str(tmp_path / "out")]) == 2
        assert "cannot start /nonexistent" in capsys.readouterr().err

    def test_memory_of_the_driver_does_not_grow_with_the_problems(self, tmp_path, monkeypatch):
        """Thousands of folders, each with one unread file."""

        def attend_all(supervisor, some):
            for files in some:
                folder = supervisor.orders.folder(files)
                records.clear(folder)
                records.write_record(folder, {"problem": files.name, "outcome": "injective"})
                yield Finished(files.name, "injective", 0.0)

        def look(progress):
            if progress.done in (100, 1000):
                held = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/batch/*.py")])
                sizes[progress.done] = sum(trace.size for trace in held.traces)

        monkeypatch.setattr(supervisor.Supervisor, "attend_all", attend_all)
        for k in range(1000):
            folder = tmp_path / "set" / f"{k // 50}" / f"{k}"
            folder.mkdir(parents=True)
            (folder / "input.obj").touch()
        sizes = {}
        tracemalloc.start()
        try:
            assert batch.run(tmp_path / "set", tmp_path / "out", jobs=1, callback=look).solved == 1000
        finally:
            tracemalloc.stop()
        # A list of the problems would take half a megabyte.
        assert sizes[1000] < sizes[100] + 50_000

    def test_an_interrupt_stops_at_once_and_keeps_finished_results(self, stars, tmp_path, failing_worker):
        write_stars(stars, ["y_sleep"])

        def interrupt(progress):
            if progress.done >= 3:
                raise KeyboardInterrupt

        began = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            batch.run(stars, tmp_path / "out", jobs=2, callback=interrupt)
        assert time.monotonic() - began < 120
        assert not (tmp_path / "out/results/y_sleep/record.json").exists()
        assert record_of(tmp_path / "out", "a")["certified"]


class TestTables:
    @pytest.mark.parametrize("suffix", [".csv", ".parquet"])
    def test_written_tables_are_read_back(self, tmp_path, suffix):
        if suffix == ".parquet":
            pytest.importorskip("pyarrow")
        row = {"problem": 'caf\u00e9, "x"\n', "certified": True, "mips": 0.1 + 0.2}
        rows = [{**row, "vertices": k, "error": None} for k in range(2500)]
        records.write_table(tmp_path / f"t{suffix}", iter(rows))
        read = list(records.read_table(tmp_path / f"t{suffix}"))
        assert len(read) == 2500
        assert [row["vertices"] for row in read] == list(range(2500))
        assert {k: v for k, v in read[0].items() if v is not None} == {**row, "vertices": 0}

    def test_names_that_are_not_unicode(self, tmp_path):
        records.write_table(tmp_path / "t.csv", [{"problem": "bad\udcff"}])
        assert next(records.read_table(tmp_path / "t.csv"))["problem"] == r"bad\udcff"

    def test_foreign_tables(self, tmp_path):
        path = tmp_path / "tlc.csv"
        path.write_text("problem,seconds,host\na,1.5,x\nb,,y\n")
        assert list(records.read_table(path)) == [
            {"problem": "a", "seconds": 1.5, "host": "x"},
            {"problem": "b", "seconds": None, "host": "y"},
        ]
        for text, words in (
            ("name,seconds\na,1\n", "record 1 has no problem; a column `problem` is needed"),
            ("problem,seconds\na,fast\n", "record 1: 'fast' is not a valid float for seconds"),
            ("problem,certified\na,maybe\n", "'maybe' is not a valid bool"),
        ):
            path.write_text(text)
            with pytest.raises(io.MeshFileError, match=words):
                list(records.read_table(path))
        with pytest.raises(io.MeshFileError, match="cannot be read as a table"):
            list(records.read_table(tmp_path / "none.csv"))
        with pytest.raises(ValueError, match=r"csv or .parquet"):
            list(records.read_table(tmp_path / "t.xls"))

    def test_a_missing_map_is_made_again(self, stars, tmp_path):
        out = tmp_path / "out"
        batch.run(stars / "a", out)
        (record,) = (out / "results").rglob("record.json")
        maps = [path for path in record.parent.iterdir() if path != record]
        assert batch.run(stars / "a", out).resumed == 1
        for spoil in (lambda path: path.write_bytes(path.read_bytes()[:-9]), lambda path: path.unlink()):
            whole = [path.read_bytes() for path in maps]
            for path in maps:
                spoil(path)
            assert batch.run(stars / "a", out).resumed == 0
            assert [path.read_bytes() for path in maps] == whole

    def test_invalid_tables(self, tmp_path):
        pytest.importorskip("pyarrow")
        table = tmp_path / "records.parquet"
        for text in (b"", b"PAR1 and nothing else"):
            table.write_bytes(text)
            with pytest.raises(ValueError, match=r"records\.parquet: cannot be read as a table"):
                list(batch.read_table(table))

    def test_a_memory_limit_on_systems_without_support(self, stars, tmp_path, monkeypatch):
        monkeypatch.setattr(driver, "resident", lambda pid: None)
        with pytest.raises(ValueError, match=r"needs psutil on this system: pip install 'quasiharmonic\[batch\]'"):
            batch.run(stars, tmp_path / "out", memory_limit=1 << 30)

    def test_parquet_without_pyarrow(self, stars, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        with pytest.raises(ImportError, match=r"pip install 'quasiharmonic\[batch\]'"):
            batch.run(stars, tmp_path / "out", table="parquet")
        assert not (tmp_path / "out").exists()


class TestCommand:
    def test_exit_statuses(self, stars, tmp_path, capsys):
        out = str(tmp_path / "out")
        assert main(["batch", str(stars), "-o", out, "-j", "1", "--memory-limit", "2G"]) == 0
        said = capsys.readouterr()
        assert "4 of 4 problems have a certified injective map" in said.out
        assert said.err == ""
        (stars / "a" / "input.obj").write_text("nonsense")
        assert main(["batch", str(stars), "-o", out]) == 1
        assert "the others: 1 input cannot be used" in capsys.readouterr().out
        assert main(["batch", str(stars / "b"), "-o", out, "-j", "1", "--flatten", "--energy", "mips"]) == 0
        assert "2 of 2 problems have a certified bijective map" in capsys.readouterr().out
        sliding = ["--polish", "mips", "--slide"]
        assert main(["batch", str(stars / "b"), "-o", out, "-j", "1", "--to", "disk", *sliding]) == 0
        assert main(["batch", str(stars / "b"), "-o", out, "--slide"]) == 2
        assert "give an energy as well, by polish" in capsys.readouterr().err
        assert main(["batch", str(tmp_path / "none"), "-o", out]) == 2
        assert "there is no folder" in capsys.readouterr().err

    def test_full_disk(self, tmp_path, capsys, failing_worker):
        write_stars(tmp_path / "set", ["full"])
        assert main(["batch", str(tmp_path / "set"), "-o", str(tmp_path / "out")]) == 2
        assert "o space left" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("text", "value"), [("800M", 800 << 20), ("4G", 4 << 30), ("1.5 GiB", 3 << 29), ("7k", 7168)]
    )
    def test_sizes(self, text, value, monkeypatch):
        asked = []

        def run(*arguments, memory_limit, **options):
            asked.append(memory_limit)
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.ui.batch.run", run)
        assert main(["batch", "set", "-o", "out", "--memory-limit", text]) == 2
        assert asked == [value]

    @pytest.mark.parametrize("text", ["", "4X", "-1G", "0", "1.2.3G", "."])
    def test_invalid_sizes(self, text, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["batch", "set", "-o", "out", f"--memory-limit={text}"])
        assert stop.value.code == 2
        assert "is not a size" in capsys.readouterr().err

    def test_on_a_terminal_and_in_a_log(self, stars, tmp_path):
        pty = pytest.importorskip("pty")
        leader, follower = pty.openpty()
        # Print every problem, however fast they follow each other.
        often = (
            "import sys; from quasiharmonic.ui.cli import main; from quasiharmonic.ui.cli.commands import batch; "
            "batch.LIVE = batch.LOG = 0; main(sys.argv[1:])"
        )
        command = [sys.executable, "-c", often, "batch", str(stars), "-j", "1", "-o"]
        run = subprocess.Popen([*command, str(tmp_path / "1")], stdout=subprocess.DEVNULL, stderr=follower)
        os.close(follower)
        shown = ""
        # At the terminal's end, reading raises an error on Linux and returns nothing elsewhere.
        with contextlib.suppress(OSError):
            while part := os.read(leader, 1 << 12):
                shown += part.decode()
        os.close(leader)
        assert run.wait() == 0
        assert re.search(r"\d/4 done   0 failed   \S+/s", shown)
        assert " left" in shown
        assert re.search(r"\r +\r$", shown)
        done = subprocess.run([*command, str(tmp_path / "2")], capture_output=True, text=True)
        lines = done.stderr.splitlines()
        assert lines[-1].startswith("4/4 done")
        assert "\r" not in done.stderr


def test_records_depend_on_every_source_that_changes_results():
    names = [name for name, _ in sources()]
    assert {"solver/field/tensor.py", "util/kernels/__init__.py", "ui/batch/worker.py"} <= {*names}
    assert not [name for name in names if name.startswith("ui/cli/")]
