"""The tables of ``benchmarks/polish_speed.py``."""

from __future__ import annotations

import pytest

import phases
import polish_speed
from quasiharmonic import Problem, polish, solve
from shared.datasets import star_of


@pytest.fixture
def first():
    """A problem and its first map."""
    problem = Problem(*star_of(10, depth=0.5))
    return problem, solve(problem).uv


def test_every_step_and_its_time_are_recorded(first):
    problem, uv = first
    run = polish_speed.measure(problem, uv, "superlu")
    result = polish(problem.V, problem.F, uv, fixed=problem.fixed, linear_solver="superlu")
    assert run.energies == [step.energy for step in result.history]
    assert run.seconds == sorted(run.seconds)
    assert run.seconds[-1] <= run.whole
    assert set(run.by_phase) == set(polish_speed.PHASES)
    assert sum(run.by_phase.values()) <= run.whole + 1e-3


def test_near_is_the_first_step_within_two_per_cent():
    run = polish_speed.PolishRun([0.1, 0.2, 0.3, 0.4], [9.0, 2.05, 2.04, 2.0], 0.5, {})
    assert run.near(2.0) == (0.3, 2)
    assert run.near(1.0) is None


@pytest.mark.slow
def test_tables(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(phases, "clock", phases.clock)  # the script changes this
    polish_speed.main(["--triangles", "500", "-r", "1", "--solvers", "superlu", "-o", str(tmp_path / "table.md")])
    written = (tmp_path / "table.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in written.splitlines() if "cat" in line]
    assert [row[0] for row in rows] == ["cat on R", "cat on R"]
    assert rows[0][2] == "superlu"
    seconds, steps, whole, all_steps = (float(cell) for cell in rows[0][3:7])
    assert seconds <= whole
    assert 0 < steps <= all_steps
    above = [float(cell.split(",")[1].rstrip("%")) for cell in rows[1][1:]]
    assert above == sorted(above, reverse=True)
    assert above[-1] < 2
    assert "cat on R" in capsys.readouterr().out
