"""The command ``qhm field``."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from quasiharmonic import inverse_field, nearest_invertible
from quasiharmonic.ui.cli import main


@pytest.fixture
def field(tmp_path):
    y, x = np.mgrid[:30, :40]
    bump = np.exp(-((x - 20) ** 2 + (y - 15) ** 2) / 10)
    array = np.stack([5 * bump, 1 * bump], axis=-1)
    np.save(tmp_path / "field.npy", array)
    return array


@pytest.mark.slow
def test_a_field_and_its_inverse(tmp_path, field, capsys):
    paths = [str(tmp_path / name) for name in ("field.npy", "mended.npy", "back.npy")]
    options = [
        "--spacing",
        "0.5",
        "2",
        "--fix-border",
        "--min-jacobian",
        "0.02",
        "--json",
        str(tmp_path / "report.json"),
    ]
    assert main(["field", paths[0], "-o", paths[1], "--inverse", paths[2], *options]) == 0
    border = np.ones(field.shape[:2], dtype=bool)
    border[1:-1, 1:-1] = False
    mended = nearest_invertible(field, spacing=(0.5, 2), min_jacobian=0.02, fixed=border)
    assert mended.folds > 0
    assert np.array_equal(np.load(paths[1]), mended.field)
    back = inverse_field(mended.field, spacing=(0.5, 2)).field
    assert np.array_equal(np.load(paths[2]), back, equal_nan=True)
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["bijective"]
    assert told["folds"] == mended.folds
    assert "lie outside" in capsys.readouterr().out


def test_a_field_without_an_inverse(tmp_path, capsys):
    """The boundary of the field overlaps itself, but no cell is inverted."""
    t, r = np.meshgrid(np.linspace(0, 7, 80), np.linspace(20, 30, 6))
    ring = np.stack([r * np.sin(t), r * np.cos(t)], axis=-1)[:, ::-1]
    x, y = np.meshgrid(np.arange(80), np.arange(6))
    np.save(tmp_path / "ring.npy", ring * (1, -1) - np.stack([x, y], axis=-1))
    before = np.load(tmp_path / "ring.npy")
    status = main(["field", f"{tmp_path}/ring.npy", "-o", f"{tmp_path}/a.npy", "--inverse", f"{tmp_path}/b.npy"])
    assert status == 1
    assert np.array_equal(np.load(tmp_path / "a.npy"), before)
    assert not (tmp_path / "b.npy").exists()
    assert "b.npy is not written" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["field.npy", "-o", "a.obj"], "supported: .npy, .nii, .nii.gz, .mha, .nrrd"),
        (["field.npy", "-o", "field.npy"], "would replace an input file"),
        (["field.npy", "-o", "a.npy", "--spacing", "0"], "field.npy: spacing must be a positive number"),
        (["lost.npy", "-o", "a.npy"], r"lost.npy: field is not finite at pixel (2, 3), row and column"),
        (["words.npy", "-o", "a.npy"], "words.npy: is not an array of numbers in NumPy's format .npy"),
        (["none.npy", "-o", "a.npy"], "none.npy"),
        (["lost.npy", "-o", "a.mha"], "a field of lost.npy cannot be written there; use .npy"),
        (["row.npy", "-o", "a.npy", "--fix-border"], "row.npy: field must have shape (height, width, 2)"),
        (["several.npz", "-o", "a.npy"], "several.npz: is not a displacement field of a supported format"),
    ],
)
def test_invalid_calls(tmp_path, monkeypatch, field, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    field[2, 3, 0] = np.nan
    np.save("lost.npy", field)
    (tmp_path / "words.npy").write_text("words")
    np.save("row.npy", field[0, :, 0])
    np.savez("several.npz", field=field)
    assert main(["field", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "a.npy").exists()


@pytest.mark.slow
def test_a_field_on_voxels_and_its_inverse(tmp_path, capsys):
    z, y, x = np.mgrid[:9, :10, :12]
    field = np.zeros((9, 10, 12, 3))
    field[..., 0] = 4 * np.exp(-((x - 5) ** 2 + (y - 5) ** 2 + (z - 4) ** 2) / 4)
    paths = [str(tmp_path / name) for name in ("field.npy", "mended.npy", "back.npy")]
    np.save(paths[0], field)
    spacing = ["--spacing", "1", "2", "1.5", "--fix-border"]
    report = tmp_path / "report.json"
    assert main(["field", paths[0], "-o", paths[1], "--inverse", paths[2], *spacing, "--json", str(report)]) == 0
    border = np.ones(field.shape[:3], dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    mended = nearest_invertible(field, spacing=(1, 2, 1.5), fixed=border)
    assert mended.folds > 0
    assert np.array_equal(np.load(paths[1]), mended.field)
    assert np.array_equal(mended.field[border], field[border])
    assert np.array_equal(np.load(paths[2]), inverse_field(mended.field, spacing=(1, 2, 1.5)).field, equal_nan=True)
    assert json.loads(report.read_text())["folds"] == mended.folds
    assert f"{mended.folds} cells folded" in capsys.readouterr().out


@pytest.mark.slow
def test_a_volume_that_cannot_be_mended_is_not_written(tmp_path, capsys):
    field = np.zeros((4, 4, 4, 3))
    field[0, 0, 0] = 5.0
    np.save(tmp_path / "field.npy", field)
    fixed = ["field", f"{tmp_path}/field.npy", "-o", f"{tmp_path}/mended.npy", "--fix-border"]
    assert main(fixed) == 2
    assert not (tmp_path / "mended.npy").exists()
    assert "fold" in capsys.readouterr().err


@pytest.mark.parametrize("shape", [(12, 12, 2), (5, 6, 6, 3)])
def test_progress_on_a_terminal(tmp_path, capsys, monkeypatch, shape):
    np.save(tmp_path / "field.npy", np.random.default_rng(0).normal(size=shape))
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert main(["field", str(tmp_path / "field.npy"), "-o", str(tmp_path / "new.npy")]) == 0
    assert re.search(r"\riteration \d+   patches 1   free points \d+", capsys.readouterr().err)
