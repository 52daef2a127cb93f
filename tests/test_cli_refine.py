"""``qhm refine``: it turns a problem without a map into one with a map and changes nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from quasiharmonic import io
from shared.commands import run
from shared.infeasible_problems import OBSTRUCTED
from shared.meshes import lift, signed_areas


def write(folder, name, **more):
    """Write a problem as files; free vertices get no target positions."""
    problem, _ = OBSTRUCTED[name]
    uv = np.full((problem.n, 2), 0.25)
    uv[problem.fixed] = problem.target
    io.write_obj(folder / "input.obj", io.MeshData(lift(problem.V), problem.F, vt=uv, FT=problem.F, **more))
    (folder / "handles.txt").write_text("".join(f"{v}\n" for v in problem.fixed))
    return problem


@pytest.mark.slow
@pytest.mark.parametrize("name", ["no kernel", "nothing sees all", "chord touches a corner", "flat ear"])
def test_after_refining_there_is_a_map(tmp_path, capsys, name):
    problem = write(tmp_path, name)
    out, handles = tmp_path / "finer.obj", tmp_path / "finer.handles"
    assert run("map", tmp_path, "-o", tmp_path / "none.obj") == 1
    assert "qhm refine" in capsys.readouterr().out
    assert run("check", tmp_path) == 1
    assert "qhm refine" in capsys.readouterr().out

    assert run("refine", tmp_path, "-o", out, "--json", tmp_path / "report.json") == 0
    assert f"qhm map {out} --fixed {handles}" in capsys.readouterr().out
    capsys.readouterr()
    run("check", out, "--fixed", handles, "--json", "-")
    facts = json.loads(capsys.readouterr().out)
    assert facts["injective"] or not facts["diagnosis"]["forbids_injective"]
    assert run("map", out, "--fixed", handles, "-o", tmp_path / "map.obj") == 0

    mesh, facts = io.read_mesh(out), json.loads((tmp_path / "report.json").read_text())
    n = problem.n
    np.testing.assert_array_equal(mesh.V[:n], lift(problem.V))
    np.testing.assert_array_equal(io.map_of(mesh)[problem.fixed], problem.target)
    np.testing.assert_array_equal(io.read_handles(handles, n), problem.fixed)
    assert facts["split"] == len(mesh.V) - n > 0
    assert facts["vertices"] == len(mesh.V)
    assert facts["rounds"] >= 1
    assert facts["diagnosis"]["obstructions"] == []
    origin = json.loads((tmp_path / "finer.origin.json").read_text())
    assert origin["old_vertices"] == n
    assert origin["old_triangles"] == len(problem.F)
    assert [made["vertex"] for made in origin["new_vertices"]] == list(range(n, len(mesh.V)))
    for made in origin["new_vertices"]:
        assert sum(made["weights"]) == 1
        assert 2 <= len(made["between"]) == len(set(made["between"])) <= 3
        mean = np.array(made["weights"]) @ mesh.V[made["between"]]
        np.testing.assert_allclose(mesh.V[made["vertex"]], mean, atol=1e-15)
    parent = np.array(origin["parent_of_triangle"])
    assert (np.diff(parent) >= 0).all()
    areas = np.bincount(parent, signed_areas(mesh.F, mesh.V[:, :2]))
    np.testing.assert_allclose(areas, signed_areas(problem.F, problem.V), atol=1e-14)


def test_groups_and_normals_stay_with_their_triangles(tmp_path):
    statements = b"g left\ng right\nusemtl red\n"
    normals = {"normals": b"vn 0 0 1\nvn 0 1 0\n", "FN": np.array([[t % 2] * 3 for t in range(10)])}
    colours = {"extra": np.linspace(0, 1, 30).reshape(10, 3)}
    write(
        tmp_path,
        "chord touches a corner",
        statements=statements,
        statement_faces=np.array([0, 5, 10]),
        **normals,
        **colours,
    )
    assert run("refine", tmp_path, "-o", tmp_path / "finer.obj") == 0
    old, new = io.read_mesh(tmp_path / "input.obj"), io.read_mesh(tmp_path / "finer.obj")
    parent = np.array(json.loads((tmp_path / "finer.origin.json").read_text())["parent_of_triangle"])
    assert new.statements == statements
    assert new.statement_faces.tolist() == [0, np.searchsorted(parent, 5), len(new.F)]
    whole = np.bincount(parent)[parent] == 1
    assert 0 < whole.sum() < len(new.F)
    np.testing.assert_array_equal(new.F[whole], old.F[parent[whole]])
    np.testing.assert_array_equal(new.FN[whole], old.FN[parent[whole]])
    assert (new.FN[~whole] == -1).all()
    np.testing.assert_array_equal(new.extra[:10], old.extra)
    assert np.isfinite(new.extra).all()


def test_problems_that_refinement_cannot_solve(tmp_path, capsys):
    problem = write(tmp_path, "mirrored")
    assert run("refine", tmp_path, "-o", tmp_path / "same.obj") == 1
    said = capsys.readouterr().out
    assert "0 edges split" in said
    assert "has the opposite orientation to the mesh" in said
    assert "Next" not in said
    np.testing.assert_array_equal(io.read_mesh(tmp_path / "same.obj").F, problem.F)


def test_a_problem_without_obstacles_is_not_changed(tmp_path):
    problem = write(tmp_path, "slit")
    assert run("refine", tmp_path, "-o", tmp_path / "same.obj") == 0
    assert (tmp_path / "same.obj").read_bytes() == (tmp_path / "input.obj").read_bytes()
    assert json.loads((tmp_path / "same.origin.json").read_text())["new_vertices"] == []
    assert len(io.read_handles(tmp_path / "same.handles", problem.n)) == len(problem.fixed)


def test_vertices_without_a_target_position_get_one(tmp_path):
    problem = write(tmp_path, "no kernel")
    text = (tmp_path / "input.obj").read_text()
    bare = text.replace("9/9", "9")  # the hub
    (tmp_path / "input.obj").write_text(bare)
    assert bare != text
    assert run("refine", tmp_path, "-o", tmp_path / "finer.obj") == 0
    uv = io.map_of(io.read_mesh(tmp_path / "finer.obj"))
    assert np.isfinite(uv).all()
    np.testing.assert_array_equal(uv[8], (problem.target.min(axis=0) + problem.target.max(axis=0)) / 2)


class TestRejects:
    def test_overwriting_an_existing_file(self, tmp_path, capsys):
        write(tmp_path, "no kernel")
        source, handles = tmp_path / "input.obj", tmp_path / "handles.txt"
        links = [tmp_path / "link.obj"] if os.name == "posix" else []
        for link in links:
            link.symlink_to(source)
        os.link(source, tmp_path / "hard.obj")
        os.link(handles, tmp_path / "finer.handles")
        (tmp_path / "other.handles").write_bytes(handles.read_bytes())
        before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
        for extra in (
            (tmp_path, "-o", source),
            *((tmp_path, "-o", link) for link in links),
            (tmp_path, "-o", tmp_path / "hard.obj"),
            (tmp_path, "-o", tmp_path / "finer.obj"),
            (source, "--fixed", tmp_path / "other.handles", "-o", tmp_path / "other.obj"),
            (tmp_path, "-o", tmp_path / "new.obj", "--json", source),
            (tmp_path, "-o", tmp_path / "new.obj", "--json", tmp_path / "hard.obj"),
            (tmp_path, "-o", tmp_path / "new.obj", "--json", tmp_path / "new.origin.json"),
        ):
            assert run("refine", *extra) == 2
            said = capsys.readouterr()
            assert "would replace an input file" in said.err or "is also the file of" in said.err
            assert said.out == ""
            assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before

    @pytest.mark.parametrize("command", ["map", "check"])
    def test_a_report_in_place_of_a_hard_link_to_the_input(self, tmp_path, capsys, command):
        write(tmp_path, "slit")
        source, link = tmp_path / "input.obj", tmp_path / "link.json"
        os.link(source, link)
        output = ("-o", tmp_path / "map.obj") if command == "map" else ()
        assert run(command, source, *output, "--json", link) == 2
        assert "would replace an input file" in capsys.readouterr().err
        assert link.samefile(source)

    @pytest.mark.parametrize("output", ["finer.off", "finer", "nowhere/finer.obj"])
    def test_outputs_that_cannot_be_written(self, tmp_path, capsys, output):
        write(tmp_path, "no kernel")
        assert run("refine", tmp_path, "-o", tmp_path / output) == 2
        assert str(tmp_path / output) in capsys.readouterr().err

    def test_invalid_input(self, tmp_path, capsys):
        write(tmp_path, "no kernel")
        (tmp_path / "handles.txt").write_text("0\n1\n")
        assert run("refine", tmp_path, "-o", tmp_path / "finer.obj") == 2
        assert "not in fixed" in capsys.readouterr().err
        assert sorted(p.name for p in tmp_path.iterdir()) == ["handles.txt", "input.obj"]


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills outright")
def test_kill_9_leaves_each_file_complete_old_or_new(tmp_path):
    write(tmp_path, "nothing sees all")
    out = tmp_path / "finer.obj"
    command = [sys.executable, "-m", "quasiharmonic", "refine", str(tmp_path), "-o", str(out)]
    files = [out, tmp_path / "finer.handles", tmp_path / "finer.origin.json"]
    began = time.monotonic()
    subprocess.run(command, check=True, capture_output=True)
    took = time.monotonic() - began
    new = [path.read_bytes() for path in files]
    old = [b"old " * 99, b"older", b"oldest"]
    rng = np.random.default_rng()
    killed = 0
    for _ in range(12):
        for path, text in zip(files, old, strict=True):
            path.write_bytes(text)
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            # Most of the time passes before the command writes.
            time.sleep(took * rng.uniform(0.6, 1.1))
            process.kill()
        if process.returncode == 0:  # use less time if the machine is faster now
            took *= 0.9
        killed += process.returncode != 0
        now = [path.read_bytes() for path in files]
        assert all(text in pair for text, *pair in zip(now, old, new, strict=True))
        # The mesh is written last.
        assert now[0] == old[0] or now == new
        if killed == 2:
            break
    assert killed
