"""``qhm polish`` and ``qhm harmonise``."""

from __future__ import annotations

import json
from contextlib import contextmanager
from unittest.mock import Mock

import numpy as np
import pytest

from quasiharmonic import boundary_loops, distortion, io, polish
from quasiharmonic.surfaces import disk
from quasiharmonic.util.progress import end_work
from shared.commands import run, write_input
from shared.solvable_problems import star_problem


class TestPolish:
    @pytest.mark.slow
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
        problem = write_input(tmp_path, V, F, fixed, target)
        arguments = "--reference", "equilateral", "--json", tmp_path / "r.json"
        assert run("map", problem, "-o", tmp_path / "o.obj", *arguments) == 0
        assert "polish" not in json.loads((tmp_path / "r.json").read_text())["stages"][-1]["name"]

    def test_not_with_and_without_polish(self, star, tmp_path, capsys):
        with pytest.raises(SystemExit):
            run("map", star, "-o", tmp_path / "o.obj", "--polish", "mips", "--no-polish")
        assert "not allowed" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("stop", "status", "message"),
        [
            (lambda step: end_work(), "time_limit", "The time limit ended the work."),
            (Mock(side_effect=KeyboardInterrupt), "interrupted", "Interrupted. This is the best map so far"),
        ],
        ids=["time limit", "Ctrl-C"],
    )
    def test_the_few_steps_end_early(self, star, tmp_path, monkeypatch, capsys, stop, status, message):
        """The time limit is also that of the polish, and the text report says why the work ended."""
        callbacks = iter([None, stop])

        @contextmanager
        def progress_line():
            yield next(callbacks)

        monkeypatch.setattr("quasiharmonic.ui.cli.process.progress_line", progress_line)
        out, report = tmp_path / "o.obj", tmp_path / "r.json"
        assert run("map", star, "-o", out, "--time-limit", 60, "--json", report) == 0
        assert next(callbacks, "none left") == "none left"
        facts = json.loads(report.read_text())
        assert (facts["status"], facts["injective"]) == (status, True)
        assert message in capsys.readouterr().out
        assert run("check", out) == 0

    @pytest.mark.slow
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


class TestHarmonise:
    @pytest.mark.slow
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

    @pytest.mark.slow
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

    def test_counts_the_islands_that_are_unchanged(self, tmp_path, capsys):
        V, F = disk(4)
        uv = np.concatenate([V, V + np.array([3, 0])])
        mesh = io.MeshData(uv.copy(), np.concatenate([F, F + len(V)]))
        uv[np.hypot(*uv.T) < 0.5] += [0.2, 0.05]
        io.write_obj(tmp_path / "m.obj", mesh.with_map(uv))
        arguments = tmp_path / "m.obj", "-o", tmp_path / "o.obj", "--energy", "area", "--max-iterations", 5
        assert run("harmonise", *arguments) == 0
        said = capsys.readouterr().out
        assert "Worst outcome, on 1 of 2 islands: Every triangle is strictly positive, verified exactly, but" in said

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


@pytest.mark.parametrize(
    ("energy", "name"), [("symmetric-dirichlet", "symmetric Dirichlet"), ("mips", "MIPS"), ("blend", "blend")]
)
def test_the_minimised_energy_is_reported_first(tmp_path, capsys, energy, name):
    V, F = disk(4)
    turn = 1.0 - (V**2).sum(axis=1)
    uv = V * np.cos(turn)[:, None] + V[:, ::-1] * [-1, 1] * np.sin(turn)[:, None]
    io.write_mapped(tmp_path / "m.obj", io.MeshData(V, F).with_map(uv))
    assert run("polish", tmp_path / "m.obj", "-o", tmp_path / "o.obj", "--energy", energy, "--max-iterations", 2) == 0
    result = polish(V, F, uv, energy=energy, max_iterations=2)
    line = f"{name} from {result.history[0].energy:.3g} to {result.energy:.3g} on average, isometric distortion from "
    assert line in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("outline", [[], ["--to", "disk"]])
def test_listed_vertices_do_not_slide(tmp_path, outline):
    V, F = disk(4)
    uv = V.copy()
    # The inner vertices are moved, so that the boundary slides.
    uv[np.hypot(*uv.T) < 0.5] += [0.2, 0.05]
    io.write_mapped(tmp_path / "m.obj", io.MeshData(V, F).with_map(uv))
    (rim,) = boundary_loops(F)
    fixed = np.append(rim[::3], 0)
    (tmp_path / "fixed.txt").write_text("".join(f"{k}\n" for k in fixed))
    options = ["--slide", *outline, "--fixed", tmp_path / "fixed.txt"]
    assert run("polish", tmp_path / "m.obj", "-o", tmp_path / "o.obj", *options) == 0
    found = io.map_of(io.read_mesh(tmp_path / "o.obj"))
    np.testing.assert_array_equal(found[fixed], uv[fixed])
    assert np.abs(found - uv)[np.setdiff1d(rim, fixed)].max() > 1e-4
