"""The tables of ``benchmarks/distortion.py``."""

from __future__ import annotations

import numpy as np
import pytest

import distortion as benchmark
from quasiharmonic import boundary_loops
from quasiharmonic.surfaces import grid
from shared.datasets import star_of, write_problem


@pytest.fixture
def folder(tmp_path):
    """A star, and a square whose target crosses itself."""
    write_problem(tmp_path / "set" / "star", *star_of(6, depth=0.5))
    V, F = grid(3, 3)
    (loop,) = boundary_loops(F, len(V))
    target = V[loop].copy()
    target[[1, 5]] = target[[5, 1]]
    write_problem(tmp_path / "set" / "crossed", np.column_stack([V, 0 * V[:, 0]]), F, loop, target)
    return tmp_path / "set"


def rows(text):
    """Return the cells of each problem row of a Markdown table."""
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [row for row in found if row[0].startswith("set/")]


@pytest.mark.slow
def test_tables(folder, capsys):
    benchmark.compare([folder])
    crossed, star, crossed_stretch, star_stretch = rows(capsys.readouterr().out)
    assert crossed[:3] == ["set/crossed", "18", "–"]
    assert set(crossed[2:]) == set(crossed_stretch[2:]) == {"–"}
    mips = [float(cell.split()[0]) for cell in star[2:]]
    seconds = [float(cell.split()[1].strip("()")) for cell in star[2:]]
    first, _, harmonised, polished, *_ = mips
    assert polished <= harmonised * 1.01 < first
    assert min(seconds[2:]) >= seconds[0] > 0
    # No map goes below the bound given by the boundary; the energy that includes lengths comes closest.
    forced, *worst = map(float, star_stretch[1:])
    assert 1 < forced <= min(worst) * 1.01
    assert worst[-1] == min(worst)


@pytest.mark.slow
def test_a_strategy_that_fails_has_no_numbers_of_another(folder, capsys, monkeypatch):
    found = benchmark.first_map
    monkeypatch.setattr(benchmark, "first_map", lambda p, strategy: None if strategy == "paper" else found(p, strategy))
    benchmark.compare([folder / "star"])
    both = rows(capsys.readouterr().out)
    assert len(both) == 2
    for row in both:
        assert row[3] == "–"
        assert "–" not in row[4:]
