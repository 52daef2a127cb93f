"""``qhm flatten`` as a user calls it: files, exit statuses, messages."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest

from quasiharmonic import atlas, certify, distortion, io
from quasiharmonic.surfaces import cat, grid
from quasiharmonic.ui.cli import main


@pytest.fixture
def head(tmp_path):
    V, F = cat(6)
    io.write_obj(tmp_path / "head.obj", io.MeshData(V, F))
    return tmp_path / "head.obj"


def run(*arguments):
    return main([str(a) for a in arguments])


def test_writes_a_bijective_map(head, tmp_path, capsys):
    out, report = tmp_path / "flat.obj", tmp_path / "report.json"
    assert run("flatten", head, "-o", out, "--json", report) == 0
    written = io.read_mesh(out)
    np.testing.assert_array_equal(written.V, io.read_mesh(head).V)
    assert certify(written.F, io.map_of(written)).bijective
    facts = json.loads(report.read_text())
    assert facts["bijective"] is True
    assert facts["status"] == "polished"
    assert 0 < facts["mean_energy"] < 1
    assert "Bijective" in capsys.readouterr().out


@pytest.mark.slow
def test_options_change_the_map(head, tmp_path):
    weights = tmp_path / "weights.txt"
    weights.write_text("".join(f"{1 + i % 2}  # triangle {i}\n" for i in range(len(cat(6)[1]))))
    maps = []
    for options in ([], ["--energy", "mips"], ["--weights", weights], ["--unit-square"]):
        assert run("flatten", head, "-o", tmp_path / "flat.obj", *options) == 0
        maps.append(io.map_of(io.read_mesh(tmp_path / "flat.obj")))
    assert all(not np.allclose(one, maps[0], atol=1e-4) for one in maps[1:])
    assert maps[3].max() <= 1


def test_start_from_the_file(head, tmp_path):
    out, again, report = tmp_path / "flat.obj", tmp_path / "again.obj", tmp_path / "report.json"
    assert run("flatten", head, "-o", out) == 0
    assert run("flatten", out, "-o", again, "--start", "--json", report) == 0
    assert json.loads(report.read_text())["n_iterations"] <= 4
    assert run("flatten", head, "-o", again, "--start") == 2


def test_closed_surfaces_are_named_and_cut(tmp_path, capsys):
    # A cube of 6 × 2 × 9 triangles.
    square, F = grid(3, 3)
    x, y = 2 * square.T - 1
    one = np.ones(len(square))
    sides = [(x, y, one), (y, x, -one), (one, x, y), (-one, y, x), (y, one, x), (x, -one, y)]
    V = np.concatenate([np.stack(side, axis=1) for side in sides])
    F = np.concatenate([F + k * len(square) for k in range(6)])
    _, first, flat = np.unique(V.round(6), axis=0, return_index=True, return_inverse=True)
    source, out = tmp_path / "cube.obj", tmp_path / "flat.obj"
    io.write_obj(source, io.MeshData(V[first], flat.ravel()[F]))
    assert run("flatten", source, "-o", out) == 2
    assert not out.exists()
    assert "closed" in capsys.readouterr().err
    assert run("flatten", source, "-o", out, "--cut") == 0
    written = io.read_mesh(out)
    verdict = atlas.certify(io.mapped(written))
    assert len(verdict.islands) == 1
    assert verdict.bijective
    np.testing.assert_array_equal(written.V, V[first])
    np.testing.assert_array_equal(written.F, flat.ravel()[F])


def test_an_unneeded_cut_is_no_error(head, tmp_path):
    assert run("flatten", head, "-o", tmp_path / "flat.obj", "--cut") == 0
    assert len(io.read_mesh(tmp_path / "flat.obj").V) == len(cat(6)[0])


def test_interrupted_command_writes_the_best_map(head, tmp_path, monkeypatch):
    from quasiharmonic.apps.flattening import flattening_run

    def cut_short(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(flattening_run, "descend", cut_short)
    assert run("flatten", head, "-o", tmp_path / "flat.obj") == 0
    written = io.read_mesh(tmp_path / "flat.obj")
    assert certify(written.F, io.map_of(written)).bijective


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--weights", "nowhere.txt"], "nowhere.txt"),
        (["--cut", "--start"], "which new seams discard"),
    ],
)
def test_invalid_calls(head, tmp_path, capsys, options, words):
    io.write_map(head, io.read_mesh(head), cat(6)[0][:, :2])
    assert run("flatten", head, "-o", tmp_path / "flat.obj", *options) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "flat.obj").exists()


@pytest.mark.parametrize(
    ("command", "option", "belongs"),
    [
        (["flatten"], ["--rings", 4], "--energy distances"),
        (["flatten"], ["--unit", "cm"], "--pattern"),
        (["flatten"], ["--padding", "8"], "--pack"),
        (["polish"], ["--padding", "8"], "--pack"),
        (["harmonise"], ["--padding", "8"], "--pack"),
        (["map", "--to", "disk"], ["--padding", "8"], "--pack"),
    ],
)
def test_an_option_without_effect_is_rejected(head, tmp_path, capsys, command, option, belongs):
    assert run(*command, head, "-o", tmp_path / "flat.obj", *option) == 2
    assert f"{option[0]} needs {belongs}" in capsys.readouterr().err
    assert not (tmp_path / "flat.obj").exists()


def test_rings_without_distances_are_rejected(head, capsys):
    assert run("measure", head, "--rings", 4) == 2
    assert "--rings needs --distances" in capsys.readouterr().err


def test_invalid_weights_are_named(head, tmp_path, capsys):
    (tmp_path / "weights.txt").write_text("1\nheavy\n")
    assert run("flatten", head, "-o", tmp_path / "flat.obj", "--weights", tmp_path / "weights.txt") == 2
    assert "'heavy' is not a finite number at line 2" in capsys.readouterr().err


@pytest.mark.slow
def test_distance_errors_are_reported(head, tmp_path, capsys):
    out, report = tmp_path / "flat.obj", tmp_path / "report.json"
    errors = []
    for energy in ("symmetric-dirichlet", "distances"):
        rings = ["--rings", 4] if energy == "distances" else []
        assert run("flatten", head, "-o", out, "--energy", energy, *rings, "--json", report) == 0
        facts = json.loads(report.read_text())
        assert ("distances" in facts["distortion"]) == (energy == "distances")
        assert run("measure", out, "--distances", "--rings", 4, "--json", tmp_path / "measured.json") == 0
        errors.append(json.loads((tmp_path / "measured.json").read_text())["distances"])
    assert facts["distortion"]["distances"] == pytest.approx(errors[1])
    assert errors[1]["mean"] < 0.9 * errors[0]["mean"]
    V, F = cat(6)
    assert (
        facts["distortion"]["distances"]["mean"]
        == distortion(V, F, io.map_of(io.read_mesh(out)), rings=4).distances.mean
    )
    # The report states how the distances were sampled.
    assert (errors[1]["rings"], errors[1]["crossings"], errors[1]["sources"]) == (4, 5, len(V))
    said = capsys.readouterr().out
    assert f"distances off by {100 * errors[1]['mean']:.3g} % on average" in said
    assert "at most 4 edges away. Surface distances are lengths of polylines" in said


@pytest.mark.parametrize("allowance", [0, 0.2])
def test_patterns_are_true_to_scale(tmp_path, allowance):
    """Two squares of 1 and 0.6 inch: their outlines are true to scale and far enough apart for seam allowances."""
    if allowance:
        pytest.importorskip("shapely")
    square, F = grid(3, 3)
    V = np.concatenate([np.insert(square, 2, 0, axis=1), np.insert(0.6 * square, 2, 1, axis=1)])
    io.write_obj(tmp_path / "two.obj", io.MeshData(V, np.concatenate([F, F + len(square)])))
    drawing, report = tmp_path / "two.svg", tmp_path / "report.json"
    options = ["--pattern", drawing, "--unit", "in", "--allowance", allowance, "--json", report]
    assert run("flatten", tmp_path / "two.obj", "-o", tmp_path / "flat.obj", *options) == 0
    facts = json.loads(report.read_text())
    assert facts["pattern"] == str(drawing)
    assert facts["mean_energy"] is None
    uv = io.map_of(io.read_mesh(tmp_path / "flat.obj"))
    assert uv[len(square) :, 0].min() - uv[: len(square), 0].max() > 2 * allowance
    width = float(re.search(r'width="([0-9.]+)mm"', drawing.read_text()).group(1))
    assert width == pytest.approx(25.4 * (np.ptp(uv[:, 0]) + 2 * allowance) + 10, rel=1e-4)
    assert drawing.read_text().count("<path") == (4 if allowance else 2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--pattern", "p.svg", "--unit-square"], "--pattern is true to scale, but --unit-square scales the map"),
        (["--pattern", "p.pdf"], "must be .svg or .dxf, not .pdf"),
        (["--pattern", "p.svg", "--allowance", "-1"], "allowance must be a finite number of at least 0"),
        (["--pattern", "nowhere/p.svg"], "nowhere"),
        (["--allowance", "1"], "--allowance needs --pattern"),
        (["--energy", "distances", "--fixed", "held.txt"], "omit --fixed and --weights"),
    ],
)
def test_invalid_patterns_and_distances(head, tmp_path, capsys, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    io.write_map(head, io.read_mesh(head), cat(6)[0][:, :2])
    (tmp_path / "held.txt").write_text("0\n5\n")
    assert run("flatten", head, "-o", "flat.obj", *options) == 2
    assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["head.obj", "held.txt"]


@pytest.mark.parametrize(("package", "name", "extra"), [("ezdxf", "p.dxf", "patterns"), ("shapely", "p.svg", "shapes")])
def test_missing_packages_are_named_before_any_work(head, tmp_path, capsys, monkeypatch, package, name, extra):
    for loaded in [module for module in sys.modules if module.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, package, None)
    assert run("flatten", head, "-o", tmp_path / "f.obj", "--pattern", tmp_path / name, "--allowance", 0.1) == 2
    assert f"[{extra}]'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["head.obj"]


def test_outputs_may_not_overwrite_each_other(head, tmp_path, capsys):
    drawing = tmp_path / "one.svg"
    assert run("flatten", head, "-o", tmp_path / "f.obj", "--pattern", drawing, "--json", drawing) == 2
    assert "is also the file of --pattern" in capsys.readouterr().err
