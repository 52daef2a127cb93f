"""The command ``qhm``: exit statuses, files, reports and messages."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import problems
from quasiharmonic import __version__, distortion, io
from quasiharmonic.linsolve import available
from quasiharmonic.surfaces import random_delaunay
from quasiharmonic.ui import cli
from shared.commands import run
from shared.meshes import boundary_of, lift, signed_areas
from shared.obj_reader import written
from shared.solvable_problems import star_problem, turned_ring


def write_problem(folder, V, F, fixed, target, handles=True):
    uv = np.full((len(V), 2), 0.5)
    uv[fixed] = target
    io.write_obj(folder / "input.obj", io.MeshData(V, F).with_map(uv))
    if handles:
        (folder / "handles.txt").write_text("".join(f"{i}\n" for i in fixed))
    return folder / "input.obj"


@pytest.fixture
def star(tmp_path):
    return write_problem(tmp_path, *star_problem())


class TestMap:
    def test_writes_a_certified_map(self, star, tmp_path, capsys):
        out, report, picture = tmp_path / "out.obj", tmp_path / "report.json", tmp_path / "out.png"
        assert run("map", star, "-o", out, "--json", report, "--plot", picture) == 0
        V, F, fixed, target = star_problem()
        written = io.read_mesh(out)
        uv = io.map_of(written)
        np.testing.assert_array_equal(written.F, F)
        np.testing.assert_array_equal(written.V, V)
        np.testing.assert_array_equal(uv[fixed], target)
        assert signed_areas(F, uv).min() > 0
        facts = json.loads(report.read_text())
        assert facts["injective"] is True
        assert facts["inverted"] == facts["degenerate"] == []
        assert facts["n_iterations"] > 0
        assert facts["seconds"] > 0
        assert facts["linear_solver"]
        assert sum(stage["n_iterations"] for stage in facts["stages"]) == facts["n_iterations"]
        assert facts["triangles"] == len(F)
        assert picture.read_bytes().startswith(b"\x89PNG")
        said = capsys.readouterr()
        assert "Injective: all" in said.out
        assert said.err == ""

    def test_folder_with_handles_and_pins(self, tmp_path):
        V, F = random_delaunay(150, seed=3)
        fixed = np.append(boundary_of(F), np.argmin((V**2).sum(axis=1)))
        target = np.vstack([V[fixed[:-1]], [[0.3, 0.1]]])
        write_problem(tmp_path, V, F, fixed, target)
        assert run("map", tmp_path, "-o", tmp_path / "out.obj") == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(tmp_path / "out.obj"))[fixed], target)

    def test_only_json_goes_to_standard_output(self, star, tmp_path, capsys):
        assert run("map", star, "-o", tmp_path / "out.off", "--json", "-") == 0
        assert json.loads(capsys.readouterr().out)["injective"] is True
        assert run("check", tmp_path / "out.off") == 0

    def test_a_map_that_is_not_injective_is_written_and_reported(self, tmp_path, capsys):
        problem = write_problem(tmp_path, *turned_ring(180))
        out = tmp_path / "out.obj"
        assert run("map", problem, "-o", out, "--max-iterations", 2, "--json", tmp_path / "r.json") == 1
        said = capsys.readouterr().out
        assert re.search(r"Not injective: of \d+ triangles, \d+ are inverted", said)
        assert "more iterations" in said
        facts = json.loads((tmp_path / "r.json").read_text())
        assert facts["injective"] is False
        assert facts["inverted"]
        assert run("check", out) == 1

    @pytest.mark.parametrize("scale", [1e-300, 1e160])
    def test_pictures_of_any_scale(self, tmp_path, scale):
        V, F, fixed, target = star_problem(n=120)
        problem = write_problem(tmp_path, V * scale, F, fixed, target / scale)
        arguments = "--plot", tmp_path / "p.png", "--reference", "rest"
        assert run("map", problem, "-o", tmp_path / "o.obj", *arguments) == 0
        assert (tmp_path / "p.png").exists()

    @pytest.mark.parametrize("strategy", ["speed", "paper"])
    @pytest.mark.parametrize("reference", ["equilateral", "rest", "corrected"])
    def test_options_reach_the_solver(self, star, tmp_path, strategy, reference):
        arguments = "--strategy", strategy, "--reference", reference, "--linear-solver", "superlu"
        report = tmp_path / "r.json"
        assert run("map", star, "-o", tmp_path / "o.obj", *arguments, "--json", report) == 0
        facts = json.loads(report.read_text())
        assert facts["linear_solver"] == "superlu"
        assert ("si-log" in facts["stages"][0]["name"]) == (strategy == "paper")


def bad_meshes():
    """Return (name, V, F, words) of meshes that `qhm map` must reject."""
    V, F = random_delaunay(60, seed=2)
    V = lift(V)
    inner = next(t for t in range(len(F)) if not np.isin(F[t], boundary_of(F)).any())
    flat = V.copy()
    flat[F[inner, 0]] = flat[F[inner, 1]]
    mixed = F.copy()
    mixed[inner] = mixed[inner][::-1]
    return [
        ("zero area", flat, F, "zero area in the rest mesh"),
        ("repeated triangle", V, np.vstack([F, F[3]]), "repeated"),
        ("non-manifold edge", V, np.vstack([F, [*F[inner, :2], boundary_of(F)[0]]]), "in more than two triangles"),
        ("mixed winding", V, mixed, "mixed winding"),
        ("vertex twice in a face", V, np.vstack([F, [0, 0, 1]]), "used twice"),
        ("closed", np.eye(4)[:, :3], np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]), "no boundary"),
    ]


class TestRejects:
    @pytest.mark.parametrize(("name", "V", "F", "words"), bad_meshes(), ids=[m[0] for m in bad_meshes()])
    def test_bad_meshes(self, tmp_path, capsys, name, V, F, words):
        problem = write_problem(tmp_path, V, F, np.arange(3), np.zeros((3, 2)), handles=False)
        assert run("map", problem, "-o", tmp_path / "out.obj") == 2
        said = capsys.readouterr()
        assert words in said.err
        assert said.out == ""
        assert not (tmp_path / "out.obj").exists()

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("", "no "),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces|no triangles|no texture"),
            ("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "line 3"),
            ("v 0 0 0\nv 1 0 0\nv 0 inf 0\nf 1 2 3\n", "line 3"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n", "line 4"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3 1\n", "uses a vertex twice"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "texture coordinates"),
        ],
    )
    def test_bad_files(self, tmp_path, capsys, text, words):
        (tmp_path / "in.obj").write_text(text)
        assert run("map", tmp_path / "in.obj", "-o", tmp_path / "out.obj") == 2
        assert re.search(words, capsys.readouterr().err)
        assert not (tmp_path / "out.obj").exists()

    def test_fixed_vertices_that_miss_part_of_the_boundary(self, star, tmp_path, capsys):
        lines = (tmp_path / "handles.txt").read_text().split()
        (tmp_path / "some.txt").write_text("\n".join(lines[3:]))
        assert run("map", star, "-o", tmp_path / "out.obj", "--fixed", tmp_path / "some.txt") == 2
        assert "not in fixed" in capsys.readouterr().err

    def test_missing_input_and_unwritable_output(self, star, tmp_path, capsys):
        assert run("map", tmp_path / "none.obj", "-o", tmp_path / "out.obj") == 2
        assert "none.obj" in capsys.readouterr().err
        assert run("map", star, "-o", tmp_path / "nowhere" / "out.obj") == 2
        assert "nowhere" in capsys.readouterr().err
        assert run("map", star, "-o", tmp_path / "out.xyz") == 2
        assert ".obj, .off" in capsys.readouterr().err

    def test_invalid_call(self, star, capsys):
        with pytest.raises(SystemExit) as stop:
            run("map", star)
        assert stop.value.code == 2
        assert "-o" in capsys.readouterr().err

    def test_outputs_that_would_overwrite_inputs(self, star, tmp_path, capsys):
        before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
        out = tmp_path / "out.obj"
        for extra in (
            ("--json", out),
            ("--json", star),
            ("--plot", out),
            ("--plot", tmp_path / "p.jpg"),
            ("--fixed", tmp_path / "handles.txt", "--json", tmp_path / "handles.txt"),
            ("--plot", tmp_path / "x.png", "--json", tmp_path / "x.png"),
        ):
            assert run("map", star, "-o", out, *extra) == 2
            assert re.search("replace|also the file|as .png", capsys.readouterr().err)
            assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
        assert run("check", star, "--json", star) == 2
        assert run("map", star, "-o", star) == 0

    def test_messages_name_the_file_and_its_numbering(self, tmp_path, capsys):
        _, V, F, _ = bad_meshes()[0]
        problem = write_problem(tmp_path, V, F, np.arange(3), np.zeros((3, 2)), handles=False)
        assert run("map", problem, "-o", tmp_path / "out.obj") == 2
        assert "input.obj" in (said := capsys.readouterr().err)
        assert "(indices count from 0)" in said
        assert run("map", problem, "-o", tmp_path / "out.obj", "--reference", "equilateral") in (0, 1)


class TestReportFailures:
    """After a map is written, an error message must not claim that nothing was written."""

    def test_full_standard_output(self, star, tmp_path):
        if os.name != "posix" or not Path("/dev/full").exists():
            pytest.skip("no /dev/full on this system")
        command = [sys.executable, "-m", "quasiharmonic", "map", str(star), "-o", str(tmp_path / "o.obj")]
        with open("/dev/full", "w", encoding="utf-8") as full:
            done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 3
        assert "is written, but the report failed" in done.stderr
        assert "Traceback" not in done.stderr
        assert run("check", tmp_path / "o.obj") == 0

    @pytest.mark.slow
    @pytest.mark.parametrize(("arguments", "both"), [("map {} -o {}", True), ("measure {} --export {}", False)])
    def test_full_standard_error_and_exports(self, star, tmp_path, arguments, both):
        if os.name != "posix" or not Path("/dev/full").exists():
            pytest.skip("no /dev/full on this system")
        written = tmp_path / ("o.obj" if both else "o.csv")
        command = [sys.executable, "-m", "quasiharmonic", *arguments.format(star, written).split()]
        with open("/dev/full", "w", encoding="utf-8") as full:
            done = subprocess.run(command, stdout=full, stderr=full if both else subprocess.DEVNULL)
        assert done.returncode == 3
        assert written.exists()

    @pytest.mark.slow
    @pytest.mark.skipif(os.name != "posix", reason="closes a stream by the shell")
    @pytest.mark.parametrize(("more", "status"), [("| true", 3), (">&-", 0), ("--json - >&-", 3)])
    def test_closed_standard_output(self, star, tmp_path, more, status):
        command = f"set -o pipefail; {sys.executable} -m quasiharmonic map {star} -o {tmp_path / 'o.obj'} {more}"
        done = subprocess.run(["bash", "-c", command], stderr=subprocess.PIPE, text=True)
        assert done.returncode == status
        assert ("is written, but the report failed" in done.stderr) == (status == 3)
        assert "Traceback" not in done.stderr
        assert run("check", tmp_path / "o.obj") == 0

    def test_interrupt_while_drawing(self, star, tmp_path, capsys, monkeypatch):
        def interrupt(*arguments, **more):
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.ui.plot.save_map_figure", interrupt)
        assert run("map", star, "-o", tmp_path / "o.obj", "--plot", tmp_path / "p.png") == 3
        assert "o.obj is written; interrupted" in capsys.readouterr().err

    def test_interrupt_while_the_written_map_is_certified(self, star, tmp_path, capsys, monkeypatch):
        def interrupt(mesh):
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.io.cut_at_seams", interrupt)
        assert run("map", star, "-o", tmp_path / "o.obj") == 3
        assert "o.obj is written; interrupted" in capsys.readouterr().err
        assert (tmp_path / "o.obj").exists()

    def test_interrupt_before_there_is_a_map(self, star, tmp_path, capsys, monkeypatch):
        def interrupt(self, xi):
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.solver.field.objective.Objective.evaluate", interrupt)
        assert run("map", star, "-o", tmp_path / "o.obj") == 2
        assert "nothing was written" in capsys.readouterr().err
        assert not (tmp_path / "o.obj").exists()

    def test_ascii_console(self, star, tmp_path):
        command = [sys.executable, "-m", "quasiharmonic", "check", str(star)]
        plain = {
            **os.environ,
            "LC_ALL": "C",
            "PYTHONUTF8": "0",
            "PYTHONCOERCECLOCALE": "0",
            "PYTHONIOENCODING": "ascii",
        }
        done = subprocess.run(command, capture_output=True, env=plain)
        assert done.returncode == 1
        assert done.stdout.isascii()

    @pytest.mark.slow
    @pytest.mark.skipif(os.name != "posix", reason="closes a stream by the shell")
    def test_closed_standard_error(self, star, tmp_path):
        command = f"{sys.executable} -m quasiharmonic map {star} -o {tmp_path / 'o.obj'} 2>&-"
        assert subprocess.run(command, shell=True, capture_output=True).returncode == 0

    def test_distortion_is_drawn(self, star, tmp_path):
        from matplotlib.image import imread

        out, picture = tmp_path / "o.obj", tmp_path / "p.png"
        assert run("map", star, "-o", out, "--plot", picture, "--kind", "distortion") == 0
        assert run("plot", out, "-o", tmp_path / "again.png", "--kind", "distortion") == 0
        # The picture is the same as that of the written file.
        np.testing.assert_array_equal(imread(picture), imread(tmp_path / "again.png"))

    def test_no_first_map_to_draw(self, star, tmp_path, monkeypatch):
        from quasiharmonic.linsolve import NotPositiveDefinite

        def fail(*arguments, **more):
            raise NotPositiveDefinite("as asked")

        monkeypatch.setattr("quasiharmonic.solver.mapping.quasi_harmonic_map", fail)
        assert run("map", star, "-o", tmp_path / "o.obj", "--plot", tmp_path / "p.png") == 0
        assert (tmp_path / "p.png").exists()


class TestObstructions:
    def test_nothing_found(self, star, capsys):
        run("check", star, "--json", "-")
        facts = json.loads(capsys.readouterr().out)
        assert facts["injective"] or not facts["diagnosis"]["obstructions"]

    def test_names_the_obstacle_to_a_map(self, tmp_path, capsys):
        V, F, fixed, target = star_problem(n=80)
        problem = write_problem(tmp_path, V, F, fixed, target * [1, -1])
        assert run("check", problem, "--json", "-") == 1
        facts = json.loads(capsys.readouterr().out)
        assert facts["diagnosis"]["obstructions"]
        assert run("map", problem, "-o", tmp_path / "o.obj", "--json", tmp_path / "r.json") == 1
        said = capsys.readouterr().out
        assert "No injective map exists" in said
        report = json.loads((tmp_path / "r.json").read_text())
        assert report["status"] == "impossible"
        assert report["diagnosis"]["obstructions"]


class TestPolish:
    def test_a_few_steps_by_default(self, star, tmp_path, monkeypatch):
        facts, maps = {}, {}
        for name, options in {"unasked": [], "none": ["--no-polish"], "asked": ["--polish", "blend"]}.items():
            out, report = tmp_path / f"{name}.obj", tmp_path / f"{name}.json"
            assert run("map", star, "-o", out, "--json", report, *options) == 0
            facts[name], maps[name] = json.loads(report.read_text()), io.map_of(io.read_mesh(out))
        assert [stage["name"] for stage in facts["unasked"]["stages"]][-1] == "polish, blend"
        assert len(facts["none"]["stages"]) == len(facts["unasked"]["stages"]) - 1
        assert facts["none"]["status"] == facts["unasked"]["status"] == "injective"
        assert facts["asked"]["status"] == "polished"
        V, F, _, _ = star_problem()
        worst = {name: distortion(V, F, uv).statistics("isometric").maximum for name, uv in maps.items()}
        assert worst["unasked"] < 0.9 * worst["none"]
        # Maps of large meshes are not polished by default.
        monkeypatch.setattr("quasiharmonic.energies.polishing.LARGEST_SMOOTHED", 100)
        assert run("map", star, "-o", tmp_path / "large.obj") == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(tmp_path / "large.obj")), maps["none"])

    def test_not_by_default_where_distortion_is_undefined(self, tmp_path):
        V, F, fixed, target = star_problem(n=120)
        V = np.asarray(V, dtype=float).copy()
        inner = next(t for t in range(len(F)) if not np.isin(F[t], fixed).any())
        V[F[inner, 0]] = V[F[inner, 1]]
        problem = write_problem(tmp_path, V, F, fixed, target)
        arguments = "--reference", "equilateral", "--json", tmp_path / "r.json"
        assert run("map", problem, "-o", tmp_path / "o.obj", *arguments) == 0
        assert "polish" not in json.loads((tmp_path / "r.json").read_text())["stages"][-1]["name"]

    def test_not_with_and_without_polish(self, star, tmp_path, capsys):
        with pytest.raises(SystemExit):
            run("map", star, "-o", tmp_path / "o.obj", "--polish", "mips", "--no-polish")
        assert "not allowed" in capsys.readouterr().err

    def test_lowers_distortion_and_stays_certified(self, star, tmp_path, capsys):
        first, polished = tmp_path / "first.obj", tmp_path / "polished.obj"
        assert run("map", star, "-o", first, "--no-polish") == 0
        assert run("polish", first, "-o", polished, "--energy", "mips", "--json", tmp_path / "r.json") == 0
        facts = json.loads((tmp_path / "r.json").read_text())
        before, after = (facts[name]["mips"]["mean"] for name in ("distortion_before", "distortion"))
        assert after < before
        assert f"MIPS from {before:.3g} to {after:.3g} on average" in capsys.readouterr().out
        assert run("check", polished) == 0
        both = tmp_path / "both.obj"
        assert run("map", star, "-o", both, "--polish", "mips") == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(both)), io.map_of(io.read_mesh(polished)))

    def test_rejects_a_map_with_inverted_triangles(self, star, tmp_path, capsys):
        assert run("polish", star, "-o", tmp_path / "o.obj") == 2
        assert "injective" in capsys.readouterr().err
        assert not (tmp_path / "o.obj").exists()

    def test_energy_names_are_those_of_the_library(self):
        from quasiharmonic import linsolve
        from quasiharmonic.energies.polishing import ENERGIES
        from quasiharmonic.solver.search import harmonising, strategy
        from quasiharmonic.ui.cli import arguments

        assert tuple(strategy.STRATEGIES) == arguments.STRATEGIES
        assert set(arguments.ENERGIES) == set(ENERGIES)
        assert set(arguments.HARMONISED) == set(harmonising.ENERGIES)
        assert set(arguments.LINEAR_SOLVERS) - {"auto"} == set(linsolve.BACKENDS)


class TestHarmonise:
    @pytest.mark.parametrize("energy", ["arap", "mips"])
    def test_lowers_distortion_and_stays_certified(self, star, tmp_path, energy):
        first, out, report = tmp_path / "first.obj", tmp_path / "out.obj", tmp_path / "r.json"
        assert run("map", star, "-o", first, "--no-polish") == 0
        assert run("harmonise", first, "-o", out, "--energy", energy, "--json", report) == 0
        facts = json.loads(report.read_text())
        assert facts["distortion"][energy]["mean"] < facts["distortion_before"][energy]["mean"]
        assert facts["injective"]
        assert run("check", out) == 0
        _, _, fixed, target = star_problem()
        np.testing.assert_array_equal(io.map_of(io.read_mesh(out))[fixed], target)

    def test_options_reach_the_solver(self, star, tmp_path):
        first, report = tmp_path / "first.obj", tmp_path / "r.json"
        assert run("map", star, "-o", first) == 0
        arguments = "--eta", 0.5, 0.25, "--max-iterations", 6, "--linear-solver", "superlu", "--json", report
        assert run("harmonise", first, "-o", tmp_path / "o.obj", "--energy", "springs", *arguments) == 0
        facts = json.loads(report.read_text())
        assert [s["name"] for s in facts["stages"][:2]] == [f"harmonise, springs, η = {eta}" for eta in (0.5, 0.25)]
        assert all(s["n_iterations"] <= 6 for s in facts["stages"][:2])
        assert facts["linear_solver"] == "superlu"
        # The map does not have the size of its surface.
        assert run("harmonise", first, "-o", tmp_path / "o.obj", "--energy", "springs", "--unscaled", *arguments) == 0
        unscaled = json.loads(report.read_text())
        assert unscaled["stages"][0]["energy"] != facts["stages"][0]["energy"]

    def test_rejects_maps_it_cannot_start_from(self, star, tmp_path, capsys):
        assert run("harmonise", star, "-o", tmp_path / "o.obj", "--energy", "mips") == 2
        assert "injective" in capsys.readouterr().err
        assert run("harmonise", star, "-o", tmp_path / "o.obj", "--eta", "-1") == 2
        assert "eta must be a positive number" in capsys.readouterr().err
        assert not (tmp_path / "o.obj").exists()

    @pytest.mark.parametrize("command", ["polish", "harmonise"])
    def test_rejects_flat_rest_triangles(self, star, tmp_path, capsys, command):
        """The message does not advise options that the command does not have."""
        first = tmp_path / "first.obj"
        assert run("map", star, "-o", first) == 0
        mesh = io.read_mesh(first)
        mesh.V[mesh.F[5, 0]] = mesh.V[mesh.F[5, 1]]
        io.write_obj(first, mesh)
        capsys.readouterr()
        assert run(command, first, "-o", tmp_path / "o.obj") == 2
        error = capsys.readouterr().err
        assert "of zero area in the rest mesh: distortion is undefined there" in error
        assert "reference" not in error


class TestCheck:
    def test_exit_statuses(self, star, tmp_path, capsys):
        assert run("check", star) == 1
        assert "Not injective" in capsys.readouterr().out
        run("map", star, "-o", tmp_path / "out.obj")
        assert run("check", tmp_path / "out.obj", "--json", "-") == 0
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["bijective"] is True
        assert run("check", tmp_path / "none.obj") == 2

    def test_as_float32(self, tmp_path, capsys):
        """A triangle that is positive in double precision only."""
        uv = np.array([[0, 0], [1, 0], [0.5, 1e-50]])
        io.write_obj(tmp_path / "thin.obj", io.MeshData(np.eye(3), np.array([[0, 1, 2]])).with_map(uv))
        assert run("check", tmp_path / "thin.obj") == 0
        assert run("check", tmp_path / "thin.obj", "--as", "float32") == 1
        assert "Not injective" in capsys.readouterr().out


class TestDemo:
    def test_a_folder_that_cannot_be_created(self, tmp_path, capsys):
        (tmp_path / "file").touch()
        assert run("demo", "-o", tmp_path / "file" / "demo") == 2
        assert f"cannot create the folder {tmp_path / 'file' / 'demo'}" in capsys.readouterr().err

    @pytest.mark.slow
    def test_writes_three_files(self, tmp_path, capsys):
        assert run("demo", "-o", tmp_path / "d") == 0
        assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["demo.json", "demo.obj", "demo.png"]
        facts = json.loads((tmp_path / "d" / "demo.json").read_text())
        assert facts["injective"]
        assert facts["bijective"]
        assert str(tmp_path / "d") in capsys.readouterr().out
        assert run("check", tmp_path / "d" / "demo.obj") == 0


def test_help_imports_no_numerics():
    """`qhm --help` must not import NumPy."""
    code = (
        "import sys; from quasiharmonic.ui.cli import main\n"
        "try: main(['map', '--help'])\n"
        "except SystemExit: pass\n"
        "import quasiharmonic; assert not {'numpy', 'scipy', 'matplotlib'} & set(sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_subcommand_has_help(command):
    """The command's page in the documentation is made from the help texts alone."""
    parser = cli.CommandParser()
    commands = parser.add_subparsers()
    import_module(f"quasiharmonic.ui.cli.commands.{command}").add_parser(commands)
    ((name, subparser),) = commands.choices.items()
    assert name == command
    assert re.search(rf"^  {name} +\w+", cli.parser_of([]).format_help(), re.MULTILINE)
    assert re.search(rf"^examples:\n(  qhm {name}\b.*\n)+\Z", subparser.format_help(), re.MULTILINE)
    # An option without help text would stand alone on its line.
    assert not re.findall(r"^  -[^ ]+(?:, --[\w-]+)?(?: [A-Z]+)?$(?!\n {10})", subparser.format_help(), re.MULTILINE)


def test_module_runs_as_the_command():
    done = subprocess.run([sys.executable, "-m", "quasiharmonic", "--version"], capture_output=True, text=True)
    assert done.stdout.startswith("qhm ")


@pytest.mark.parametrize("pure", ["", "1"])
def test_version_names_the_environment(pure):
    command = [sys.executable, "-m", "quasiharmonic", "--version"]
    done = subprocess.run(command, env=os.environ | {"QUASIHARMONIC_PURE": pure}, capture_output=True, text=True)
    first, python, packages, loops, solvers = done.stdout.splitlines()
    assert (done.returncode, first) == (0, f"qhm {__version__}")
    assert platform.python_version() in python
    assert f"numpy {np.__version__}" in packages
    assert solvers == f"linear solvers: {', '.join(available())}"
    if pure:
        assert loops == "loops: in NumPy, because QUASIHARMONIC_PURE is set"
    else:
        built = find_spec("quasiharmonic.util.kernels._compiled") is not None
        assert loops.startswith("loops: compiled" if built else "loops: in NumPy: ")


@pytest.mark.slow
def test_progress_on_a_terminal_only(star, tmp_path):
    """On a pseudo-terminal, progress lines are overwritten, and nothing remains."""
    pty = pytest.importorskip("pty")
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "quasiharmonic", "map", str(star), "-o", str(tmp_path / "out.obj")]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=follower)
    os.close(follower)
    shown = os.read(leader, 1 << 16).decode()
    os.close(leader)
    assert done.returncode == 0
    assert "iteration" in shown
    assert "inverted 0" in shown
    assert re.search(r"\r +\r$", shown)


# One problem of every family that is feasible by construction and that Tutte's embedding does not solve.
MADE = ["noise:1:0.6", "flow:2:0.6", "swirl:3:0.5", "pins:4:0.5", "spiral:5:0.5", "comb:6:0.5", "maze:7:0.5"]


@pytest.mark.parametrize("name", MADE)
def test_generated_problems(name, tmp_path):
    """Every problem is solved, and the written text file contains the same injective map."""
    V, F, fixed, target, *_ = problems.make(*problems.parse(name))
    out = tmp_path / "out.obj"
    source = write_problem(tmp_path, V, F, fixed, target)
    assert run("map", source, "--no-polish", "-o", out, "--fixed", tmp_path / "handles.txt") == 0
    found = written(out)
    np.testing.assert_array_equal(found.V[:, : V.shape[1]], V)
    np.testing.assert_array_equal(found.F, F)
    np.testing.assert_array_equal(found.uv[fixed], target)
    assert found.signs().min() == 1
