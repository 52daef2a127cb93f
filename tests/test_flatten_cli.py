"""``qhm flatten`` as a user calls it: files, exit statuses, messages."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.cli import main
from quasiharmonic.exact.certificate import certify
from quasiharmonic.surfaces import cat, grid


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


def test_options(head, tmp_path):
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
    assert json.loads(report.read_text())["iterations"] <= 4
    assert run("flatten", head, "-o", again, "--start") == 2


def test_closed_surfaces_are_named_and_cut(tmp_path, capsys):
    pytest.importorskip("igl")
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
    assert certify(written.F, io.map_of(written)).bijective
    assert len(written.V) > len(first)


def test_nothing_to_cut_is_no_error(head, tmp_path):
    assert run("flatten", head, "-o", tmp_path / "flat.obj", "--cut") == 0
    assert len(io.read_mesh(tmp_path / "flat.obj").V) == len(cat(6)[0])


def test_interrupted_writes_the_best_map(head, tmp_path, monkeypatch):
    from quasiharmonic.flattening import piece

    def cut_short(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(piece, "descend", cut_short)
    assert run("flatten", head, "-o", tmp_path / "flat.obj") == 0
    written = io.read_mesh(tmp_path / "flat.obj")
    assert certify(written.F, io.map_of(written)).bijective


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--weights", "nowhere.txt"], "nowhere.txt"),
        (["--cut", "--start"], "--cut makes new vertices"),
    ],
)
def test_wrong_calls(head, tmp_path, capsys, options, words):
    io.write_map(head, io.read_mesh(head), cat(6)[0][:, :2])
    assert run("flatten", head, "-o", tmp_path / "flat.obj", *options) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "flat.obj").exists()


def test_bad_weights_are_named(head, tmp_path, capsys):
    (tmp_path / "weights.txt").write_text("1\nheavy\n")
    assert run("flatten", head, "-o", tmp_path / "flat.obj", "--weights", tmp_path / "weights.txt") == 2
    assert "line 2: 'heavy' is not a number" in capsys.readouterr().err
