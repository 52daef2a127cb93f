from __future__ import annotations

import json
import re
from itertools import count, islice
from pathlib import Path

import numpy as np
import pytest

import campaign
import phases
import problems
import small_problems
import speed
import stages
import tetrahedral_problems
from quasiharmonic import Problem, boundary_loops, certify, certify_tetrahedra, injective_tetrahedra, solve
from quasiharmonic.solver.search.stages import stages_of

pytestmark = pytest.mark.long

FEASIBLE = ["noise", "jam", "flow", "swirl", "adrift", "pins", "spiral", "comb", "maze", "limbs", "carved"]


@pytest.mark.parametrize("family", problems.FAMILIES)
@pytest.mark.parametrize("difficulty", [0.0, 0.55, 1.0])
def test_a_problem_is_well_formed_and_has_its_known_solution(family, difficulty):
    case = problems.make(family, 3, difficulty, triangles=150)
    problem = Problem(case.V, case.F, case.fixed, case.target)
    assert 20 <= len(case.F) <= 700
    assert 1 <= len(problem.domain.loops) <= 4
    assert case.feasible == (family in FEASIBLE)
    if case.V.shape[1] == 2:
        assert certify(case.F, case.V).injective
    if case.feasible:
        certificate = certify(case.F, case.hidden)
        assert certificate.injective
        assert certificate.bijective == case.simple
        np.testing.assert_array_equal(case.hidden[case.fixed], case.target)


@pytest.mark.parametrize("family", problems.FAMILIES)
def test_the_name_determines_a_problem(family):
    first = problems.make(family, 5, 0.7, triangles=100)
    again = problems.make(*problems.parse(first.name), triangles=100)
    for one, other in zip(first[:4], again[:4], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first.target, problems.make(family, 6, 0.7, triangles=100).target)


@pytest.mark.parametrize("family", tetrahedral_problems.FAMILIES)
def test_a_problem_of_tetrahedra_has_its_known_solution(family):
    case = tetrahedral_problems.make(family, 1, 300)
    for points in (case.X, case.hidden):
        certificate = certify_tetrahedra(case.T, points)
        assert certificate.injective
        assert np.array_equal(case.fixed, np.unique(certificate.boundary))
    begin = case.X.copy()
    begin[case.fixed] = case.target
    assert len(certify_tetrahedra(case.T, begin, boundary=False).inverted)
    assert injective_tetrahedra(case.X, case.T, case.fixed, case.target, start=case.start, polish=False).success


def test_pins_are_interior_vertices():
    case = problems.make("pins", 1, 0.5, triangles=200)
    assert Problem(case.V, case.F, case.fixed, case.target).domain.pins.size > 0


def test_rest_meshes_have_slivers_and_extreme_areas():
    ratios, angles = [], []
    for seed in range(30):
        case = problems.make("flow", seed, 1.0, triangles=60)
        V = np.column_stack([case.V, np.zeros((len(case.V), 3 - case.V.shape[1]))])
        a, b, c = V[case.F].transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        longest = np.max([((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
        ratios.append(area.max() / area.min())
        angles.append((area / longest).min())
    assert max(ratios) > 1e9
    assert min(angles) < 1e-5


def test_unknown_families_are_rejected():
    with pytest.raises(ValueError, match="no family 'mace'"):
        problems.parse("mace:1:0.5")


def test_names_cover_all_families_and_difficulties():
    names = [problems.parse(name) for name in campaign.names(1600, list(problems.FAMILIES))]
    assert len(set(names)) == 1600
    for family in problems.FAMILIES:
        hard = np.array([difficulty for f, _, difficulty in names if f == family])
        counts = np.histogram(hard, bins=5, range=(0, 1))[0]
        assert counts.min() >= 18


def test_a_campaign_runs_resumes_and_is_summarised(tmp_path, capsys, quick_campaign):
    output = tmp_path / "results.jsonl"
    todo = list(campaign.names(3, ["swirl", "limbs", "comb"]))
    started = campaign.campaign(todo, output, limit=60)
    first = next(started)
    started.close()
    assert first["name"] == todo[0]
    # Simulate a kill in the middle of a line.
    with output.open("a") as file:
        file.write('{"name": "comb:0')
    rest = list(campaign.campaign(todo, output, limit=60))
    assert [record["name"] for record in rest] == todo[1:]
    assert [record["name"] for record in campaign.read(output)] == todo
    assert list(campaign.campaign(todo, output)) == []
    # With other settings the problems are not done yet, and a failure reports these settings.
    (other,) = campaign.campaign(todo[:1], output, limit=60, max_iterations=1, strategy="paper")
    again = campaign.summary([other | {"outcome": "exception", "message": "lost"}])
    assert f"--case {todo[0]} --strategy paper --max-iterations 1 " in again
    output.write_text("".join(output.read_text().splitlines(keepends=True)[:-1]))

    campaign.main(["--summary", str(output)])
    text = capsys.readouterr().out
    assert "limbs" in text
    assert "among 3 problems" in text


def test_a_hang_is_a_result_and_the_next_problem_is_solved(tmp_path, monkeypatch, quick_campaign):
    start = campaign.Worker.start
    spares = [-30.0, 30.0]

    def impatient(worker):
        start(worker)
        worker.spare = spares.pop(0)

    monkeypatch.setattr(campaign.Worker, "start", impatient)
    # A mesh of 45,000 triangles, which is not solved within the first second.
    todo = ["pins:96:0.831", "swirl:0:0.1"]
    first, second = campaign.campaign(todo, tmp_path / "results.jsonl", limit=30)
    assert first["outcome"] == "timeout"
    assert campaign.failed(first)
    assert second["outcome"] == "injective"


@pytest.mark.parametrize(
    ("trouble", "outcome"),
    [("raise KeyError('lost')", "exception"), ("__import__('warnings').warn('hm')", "warning")],
)
def test_errors_are_recorded(monkeypatch, trouble, outcome):
    solve = campaign.solve

    def solve_or_fail(*args, **options):
        exec(trouble)
        return solve(*args, **options)

    monkeypatch.setattr(campaign, "solve", solve_or_fail)
    record = campaign.run("swirl:0:0.1")
    assert record["outcome"] == outcome
    assert campaign.failed(record)
    assert "--case swirl:0:0.1" in campaign.summary([record])
    json.dumps(record, allow_nan=False)


def test_an_error_of_a_generator_is_a_failure_with_a_summary(monkeypatch):
    def broken(rng, difficulty, size):
        raise AssertionError("no solution")

    monkeypatch.setitem(problems.FAMILIES, "maze", broken)
    record = campaign.run("maze:0:0.1")
    assert record["outcome"] == "exception"
    assert "exception: AssertionError('no solution')" in campaign.summary([record])


def test_no_map_is_no_failure_without_a_known_solution():
    assert not campaign.failed({"outcome": "not injective", "feasible": False})
    assert campaign.failed({"outcome": "not injective", "feasible": True})


@pytest.mark.parametrize(
    "name",
    ["jam:15:0.771", "jam:20:0.861", "spiral:83:0.797", pytest.param("jam:84:0.415", marks=pytest.mark.nightly)],
)
def test_fallbacks_solve_problems_that_the_search_over_tensors_does_not(name):
    """Problems whose last triangles have almost no space, or whose target overlaps itself."""
    case = problems.make(*problems.parse(name))
    problem = Problem(case.V, case.F, case.fixed, case.target)
    assert not solve(problem, strategy=stages_of("speed", problem)[:1]).injective
    result = solve(problem)
    assert result.injective
    assert len(result.stages) > 1
    assert result.stages[-1].inverted[0] > 0


def test_loops_drift_as_rigid_bodies():
    draft = problems.FAMILIES["adrift"](np.random.default_rng(2), 1.0, 400)
    loops = boundary_loops(draft.F, len(draft.z))
    outer, *inner = sorted(loops, key=lambda loop: np.ptp(draft.z[loop].real), reverse=True)
    np.testing.assert_allclose(draft.image[outer], draft.z[outer], atol=1e-14)
    turned, carried = [], []
    for loop in inner:
        before, after = draft.z[loop], draft.image[loop]
        turn = (after - after[0])[1:] / (before - before[0])[1:]
        np.testing.assert_allclose(turn, turn[0], rtol=1e-9)
        assert abs(turn[0]) == pytest.approx(1)
        turned.append(abs(turn[0] - 1))
        carried.append(abs(after.mean() - before.mean()))
    assert max(turned) > 0.01
    assert max(carried) > 1e-3


def test_a_timeout_is_a_failure_of_a_feasible_family():
    solved = {"name": "jam:0:0.5", "strategy": "speed", "family": "jam", "difficulty": 0.5, "feasible": True,
              "simple": True, "outcome": "injective", "stages": [("vector-adam, tanh", 1, 5, 0, 0.1)],
              "iterations": 3, "seconds": 0.1}  # fmt: skip
    late = {"name": "jam:1:0.5", "strategy": "speed", "family": "jam", "difficulty": 0.5,
            "outcome": "timeout", "message": "over 9 s"}  # fmt: skip
    text = campaign.summary([solved, late])
    assert next(line for line in text.splitlines() if line.startswith("feasible ")).split()[6] == "1/2"
    assert "1 failures among 2 problems, 2 of them known to be feasible" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--strategy", "fast"], "invalid choice"),
        (["--case", "bogus:1:0.5"], "no family 'bogus'"),
        (["--case", "maze:1"], "no name of a problem"),
        (["--summary", "nowhere.jsonl"], "no file nowhere.jsonl"),
        (["--families", "maze,bogus"], "no family bogus"),
    ],
)
def test_invalid_calls_of_a_campaign_are_rejected(arguments, message, tmp_path, monkeypatch, capsys):
    """Invalid calls fail before any problem runs."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        campaign.main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_summary_counts_the_problems_that_each_fallback_adds():
    def record(name, outcome, *stages):
        listed = [(stage, 1, 5, 0, 0.1) for stage in stages]
        return {"name": name, "strategy": "speed", "family": "jam", "difficulty": 0.5, "feasible": True, "simple": True,
                "outcome": outcome, "stages": listed, "iterations": 3, "seconds": 0.1, "triangles": 9,
                "energy": 0.1}  # fmt: skip

    records = [
        record("jam:0:0.5", "injective", "vector-adam, tanh"),
        record("jam:1:0.5", "injective", "vector-adam, tanh", "patches"),
        record("jam:2:0.5", "injective", "vector-adam, tanh", "patches"),
        record("jam:3:0.5", "not injective", "vector-adam, tanh", "patches"),
    ]
    table = campaign.summary(records).split("solved up to each stage")[1].splitlines()
    assert table[1].split() == ["family", "of", "vector-adam", "patches"]
    assert table[2].split() == ["jam", "4", "1", "3"]
    assert table[3].split() == ["all", "4", "1", "3"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--strategy", "fast"], "invalid choice"),
        (["--triangles", "0"], "0 is less than 1"),
        (["-r", "0"], "0 is less than 1"),
        (["nowhere"], "no input.obj in nowhere"),
        (["--join", "nowhere.csv"], "nowhere.csv holds no records"),
        (["--join", "other.csv"], "other.csv holds no records"),
    ],
)
def test_invalid_calls_of_the_speed_benchmark_are_rejected(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("other.csv").write_text("name,value\na,1\n", encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        speed.main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["other.csv"]


def test_speed_is_measured_merged_and_limited(tmp_path, capsys, monkeypatch):
    """A tool that exceeds the limit gets no larger problem, including this project's own."""
    # A clock that counts its calls: on a busy machine any part of a call may wait.
    monkeypatch.setattr(phases, "clock", map(float, count()).__next__)
    once = ["--peers", "-r", "1", "--letters", "C", "-o", str(tmp_path)]
    speed.main([*once, "--triangles", "100", "300", "--limit", "1e-9"])
    assert "cat on C, 294 triangles: every tool has exceeded the limit" in capsys.readouterr().out
    (first,) = speed.read_csv(tmp_path / "speed.csv")
    assert first.injective
    assert 0.4 * first.median < sum(first.phases[0].values()) < first.median
    assert "| 96 | " in (tmp_path / "speed.md").read_text()
    other = speed.Record("cat on C", 294, speed.YARDSTICK, [0.5], injective=False)
    speed.write_csv([first, other], tmp_path / "both.csv")
    speed.main([*once, "--triangles", "--join", str(tmp_path / "both.csv")])
    text = (tmp_path / "speed.md").read_text()
    assert "| triangles | quasiharmonic, s | igl.harmonic, s |" in text
    assert re.search(r"^\| 96 – 294 \| [\d.e-]+ \| 0.5 \|$", text, re.MULTILINE)
    assert (tmp_path / "speed.png").stat().st_size > 0


@pytest.mark.parametrize("name", small_problems.SETS)
def test_sets_of_small_problems(name):
    some = list(islice(small_problems.SETS[name](200), 4))
    assert all(120 <= len(F) <= 280 for _, F, _, _ in some)
    assert len({target.tobytes() for _, _, _, target in some}) == 4
    assert small_problems.together(some, 1) == small_problems.one_by_one(some)
    shared = all(np.array_equal(some[0][0], V) for V, _, _, _ in some)
    assert shared == (name == "one mesh")


def test_label_and_contribution_of_a_stage():
    outcomes = stages.outcomes(["noise:1:0.1", "comb:0:0.1"], "paper")
    assert all(outcome.result.injective and np.isfinite(outcome.mips) for outcome in outcomes)
    assert stages.kind(outcomes[0].result.stages[0]) == "vector-adam, si-log"
    first = stages.stages("paper", outcomes).splitlines()[2]
    assert first.startswith("| vector-adam, si-log | 2 |")
