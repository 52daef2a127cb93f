"""The command ``qhm``: exit statuses, files, reports and messages."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

import problems
from quasiharmonic import __version__, io
from quasiharmonic.linsolve import available
from quasiharmonic.surfaces import grid, random_delaunay
from quasiharmonic.ui import cli
from shared.commands import run, write_input
from shared.meshes import boundary_of, lift, signed_areas
from shared.obj_reader import written
from shared.solvable_problems import star_problem, turned_ring


class TestMap:
    @pytest.mark.slow
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
        write_input(tmp_path, V, F, fixed, target)
        assert run("map", tmp_path, "-o", tmp_path / "out.obj") == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(tmp_path / "out.obj"))[fixed], target)

    def test_only_json_goes_to_standard_output(self, star, tmp_path, capsys):
        assert run("map", star, "-o", tmp_path / "out.off", "--json", "-") == 0
        assert json.loads(capsys.readouterr().out)["injective"] is True
        assert run("check", tmp_path / "out.off") == 0

    def test_a_map_that_is_not_injective_is_written_and_reported(self, tmp_path, capsys):
        problem = write_input(tmp_path, *turned_ring(180))
        out = tmp_path / "out.obj"
        assert run("map", problem, "-o", out, "--max-iterations", 2, "--json", tmp_path / "r.json") == 1
        said = capsys.readouterr().out
        assert re.search(r"Not injective: of \d+ triangles, \d+ are inverted", said)
        assert "more iterations" in said
        facts = json.loads((tmp_path / "r.json").read_text())
        assert facts["injective"] is False
        assert facts["inverted"]
        assert run("check", out) == 1

    @pytest.mark.slow
    @pytest.mark.parametrize("scale", [1e-300, 1e160])
    def test_pictures_of_any_scale(self, tmp_path, scale):
        V, F, fixed, target = star_problem(n=120)
        problem = write_input(tmp_path, V * scale, F, fixed, target / scale)
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
        problem = write_input(tmp_path, V, F, np.arange(3), np.zeros((3, 2)), handles=False)
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

    @pytest.mark.slow
    def test_messages_name_the_file_and_its_numbering(self, tmp_path, capsys):
        _, V, F, _ = bad_meshes()[0]
        problem = write_input(tmp_path, V, F, np.arange(3), np.zeros((3, 2)), handles=False)
        assert run("map", problem, "-o", tmp_path / "out.obj") == 2
        assert "input.obj" in (said := capsys.readouterr().err)
        assert "(indices count from 0)" in said
        assert run("map", problem, "-o", tmp_path / "out.obj", "--reference", "equilateral") in (0, 1)


class TestObstructions:
    def test_nothing_found(self, star, capsys):
        run("check", star, "--json", "-")
        facts = json.loads(capsys.readouterr().out)
        assert facts["injective"] is False
        assert facts["diagnosis"]["obstructions"] == []
        assert not facts["diagnosis"]["forbids_injective"]

    def test_names_the_obstacle_to_a_map(self, tmp_path, capsys):
        V, F, fixed, target = star_problem(n=80)
        problem = write_input(tmp_path, V, F, fixed, target * [1, -1])
        assert run("check", problem, "--json", "-") == 1
        facts = json.loads(capsys.readouterr().out)
        assert facts["diagnosis"]["obstructions"]
        assert run("map", problem, "-o", tmp_path / "o.obj", "--json", tmp_path / "r.json") == 1
        said = capsys.readouterr().out
        assert "No injective map exists" in said
        report = json.loads((tmp_path / "r.json").read_text())
        assert report["status"] == "impossible"
        assert report["diagnosis"]["obstructions"]


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

    @pytest.mark.long
    def test_writes_three_files(self, tmp_path, capsys):
        assert run("demo", "-o", tmp_path / "d") == 0
        assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["demo.json", "demo.obj", "demo.png"]
        facts = json.loads((tmp_path / "d" / "demo.json").read_text())
        assert facts["injective"]
        assert facts["bijective"]
        assert str(tmp_path / "d") in capsys.readouterr().out
        assert run("check", tmp_path / "d" / "demo.obj") == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "order"),
    [
        ("flatten", ["--energy", "--max-iterations", "--time-limit", "--weights", "--rings", "--pack"]),
        ("polish", ["--fixed", "--energy", "--max-iterations", "--time-limit", "--free", "--slide", "--pack"]),
        ("harmonise", ["--fixed", "--energy", "--max-iterations", "--eta", "--unscaled", "--pack"]),
        ("map", ["--fixed", "--to", "--strategy", "--max-iterations", "--time-limit", "--refine", "--reference"]),
        ("morph", ["--positions", "--energy", "--slide", "--slide-plane", "--rest", "--max-iterations"]),
    ],
)
def test_help_lists_own_options_before_shared_ones(command, order, capsys):
    with pytest.raises(SystemExit):
        run(command, "--help")
    described = re.findall(r"^  (?:-\w \S+, )?(--[\w-]+)", capsys.readouterr().out, re.MULTILINE)
    shared = ["--linear-solver"] if command == "map" else ["--linear-solver", "--json"]
    assert [name for name in described if name in (*order, *shared)] == [*order, *shared]


def test_help_names_what_an_option_takes(capsys):
    for command, parts in (
        ("morph", ["MESH\n", "-o MESH, --output MESH"]),
        ("flatten", ["-o OUTPUT, --output OUTPUT", "--time-limit SECONDS"]),
        ("batch", ["for --to: boundary vertices", "for --to: minimum turn"]),
    ):
        with pytest.raises(SystemExit):
            run(command, "--help")
        said = capsys.readouterr().out
        assert [part for part in parts if part not in said] == []


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("batch in -o out --time-limit soon", "soon is not a time in seconds"),
        ("batch in -o out --time-limit -1", "-1 is not a time in seconds"),
        ("batch in -o out --corner-angle wide", "wide is not an angle from 0 to 180 degrees"),
        ("batch in -o out --corner-angle 200", "200 is not an angle from 0 to 180 degrees"),
        ("flatten in.obj -o out.obj --rings many", "many is not an integer of at least 1"),
        ("flatten in.obj -o out.obj --max-iterations -1", "-1 is not an integer of at least 0"),
    ],
)
def test_a_wrong_number_is_named_with_what_the_option_takes(call, message, capsys):
    with pytest.raises(SystemExit):
        cli.main(call.split())
    assert capsys.readouterr().err.endswith(f": {message}\n")


def test_polish_has_a_time_limit(star, tmp_path, capsys):
    assert run("map", star, "-o", tmp_path / "map.obj") == 0
    assert run("polish", tmp_path / "map.obj", "-o", tmp_path / "out.obj", "--time-limit", "1e-9") == 2
    assert "no map was computed within the time limit of 1e-09 s" in capsys.readouterr().err
    assert run("polish", tmp_path / "map.obj", "-o", tmp_path / "out.obj", "--time-limit", "60", "--free") == 0


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
def test_every_subcommand_has_help(command, capsys):
    """The command's page in the documentation is made from the help texts alone."""
    with pytest.raises(SystemExit):
        cli.parser_of([command]).parse_args([command, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: qhm {command} ")
    assert re.search(rf"^  {command} +\w+", cli.parser_of([]).format_help(), re.MULTILINE)
    assert re.search(rf"^examples:\n(  qhm {command}\b.*\n)+\Z", text, re.MULTILINE)
    # An option without help text would stand alone on its line.
    assert not re.findall(r"^  -[^ ]+(?:, --[\w-]+)?(?: [A-Z]+)?$(?!\n {10})", text, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("pure", ["", "1"])
def test_version_names_the_environment(pure):
    """The module runs as the command."""
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


# One problem of every family that is feasible by construction and that Tutte's embedding does not solve.
MADE = ["noise:1:0.6", "flow:2:0.6", "swirl:3:0.5", "pins:4:0.5", "spiral:5:0.5", "comb:6:0.5", "maze:7:0.5"]


@pytest.mark.parametrize("name", MADE)
def test_generated_problems(name, tmp_path):
    """Every problem is solved, and the written text file contains the same injective map."""
    V, F, fixed, target, *_ = problems.make(*problems.parse(name))
    out = tmp_path / "out.obj"
    source = write_input(tmp_path, V, F, fixed, target)
    assert run("map", source, "--no-polish", "-o", out, "--fixed", tmp_path / "handles.txt") == 0
    found = written(out)
    np.testing.assert_array_equal(found.V[:, : V.shape[1]], V)
    np.testing.assert_array_equal(found.F, F)
    np.testing.assert_array_equal(found.uv[fixed], target)
    assert found.signs().min() == 1


@pytest.mark.parametrize(
    ("gap", "said"),
    [
        (5 / 2048, "Islands are at least 5 texels apart at 2048 × 2048."),
        (9 / 2048, "Islands are more than 8 texels apart at 2048 × 2048."),
        (0.0, "Islands overlap or touch each other: 0 and 1"),
        (0.9, None),
    ],
)
def test_check_measures_the_gap_between_islands(tmp_path, capsys, gap, said):
    V, F = grid(2, 2)
    V = np.concatenate([0.25 * V, 0.25 * V + [0.25 + gap, 0]])
    io.write_mapped(tmp_path / "a.obj", io.MeshData(V, np.concatenate([F, F + 9])).with_map(V))
    assert run("check", tmp_path / "a.obj") == 0
    out = capsys.readouterr().out
    assert said in out if said else "apart" not in out
