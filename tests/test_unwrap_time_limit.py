"""A time limit of `unwrap`: certified charts soon after it, and what the search had not finished."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pytest

from quasiharmonic import io, unwrap
from quasiharmonic.apps.unwrapping.draft import expect_charts, grow_charts
from quasiharmonic.apps.unwrapping.result import UnwrapStatus
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.surfaces import starfish
from quasiharmonic.util import progress
from shared.closed_surfaces import double_torus, torus
from shared.commands import run

V, F = starfish(3, 8)
NOWHERE = np.zeros(F.shape, dtype=bool)


def whole(charts):
    """All triangles of charts."""
    return np.sort(np.concatenate([chart.triangles for chart in charts]))


@pytest.mark.parametrize("bound", [1.0, 1.2, 1.5, 10.0])
def test_grown_charts_are_bijective_with_little_stretch(bound):
    charts = grow_charts(V, F, np.arange(len(F)), np.ones(F.shape), NOWHERE, bound)
    np.testing.assert_array_equal(whole(charts), np.arange(len(F)))
    for chart in charts:
        np.testing.assert_array_equal(chart.vertices[chart.F], F[chart.triangles])
        assert certify(chart.F, chart.uv).bijective
        assert chart.stretch.max() <= 3
        assert (chart.misses > 0) == (chart.stretch.max() > max(bound, 1 + 1e-6))
        sides = chart.uv[chart.F] - np.roll(chart.uv[chart.F], -1, axis=1)
        area = np.abs(np.linalg.det(sides[:, :2])).sum()
        doubled = np.linalg.norm(np.cross(*(V[F[:, k]] - V[F[:, 0]] for k in (1, 2))), axis=1)
        assert area == pytest.approx(doubled[chart.triangles].sum())


@pytest.mark.parametrize("bound", [1.05, 1.5])
def test_the_number_of_grown_charts_is_known_before(bound):
    cost = np.ones(F.shape)
    count = len(grow_charts(V, F, np.arange(len(F)), cost, NOWHERE, bound))
    assert expect_charts(V, F, cost, None, bound) == pytest.approx(count, rel=0.1)


def test_time_to_pack_many_charts_is_reserved(monkeypatch):
    module, seconds = sys.modules["quasiharmonic.apps.unwrapping.stages"], []
    monkeypatch.setattr(module, "run_until", lambda left, compute: seconds.append(left))
    loose = np.random.default_rng(0).normal(size=(3000, 3))
    result = unwrap(loose, np.arange(3000).reshape(-1, 3), time_limit=60)
    assert result.n_charts == 1000
    assert seconds[0] < 59.6


def test_charts_of_an_early_end_that_do_not_fit(monkeypatch):
    monkeypatch.setattr(sys.modules["quasiharmonic.apps.unwrapping.stages"], "run_until", lambda left, compute: None)
    loose = np.random.default_rng(0).normal(size=(300, 3))
    with pytest.raises(
        ValueError, match=r"ended early: 100 charts .* do not fit .* suffices for these charts, or more time"
    ):
        unwrap(loose, np.arange(300).reshape(-1, 3), time_limit=60, resolution=64, padding=16)


def test_the_limit_ends_work_on_the_shapes_of_many_charts():
    chart = grow_charts(V, F, np.arange(len(F)), np.ones(F.shape), NOWHERE, 1.5)[0]
    with progress.time_limit(0.0), pytest.raises(KeyboardInterrupt):
        _ = chart.shape
    assert chart.shape.area > 0


def test_higher_bounds_need_fewer_grown_charts():
    counts = [len(grow_charts(V, F, np.arange(len(F)), np.ones(F.shape), NOWHERE, bound)) for bound in (1.05, 1.5)]
    assert counts[1] < counts[0] / 2
    assert counts[1] < len(F) / 20


def test_grown_charts_of_a_part_end_at_seams():
    rows = np.arange(0, len(F), 2)
    cut = np.zeros(F.shape, dtype=bool)
    cut[:, 0] = True
    charts = grow_charts(V, F, rows, np.ones(F.shape), cut, 1.5)
    np.testing.assert_array_equal(whole(charts), rows)
    for chart in charts:
        # A side that is a seam is at the boundary of its chart.
        rim = {
            (a, b)
            for loop in boundary_loops(chart.F, len(chart.uv))
            for a, b in zip(loop, np.roll(loop, -1), strict=True)
        }
        assert all((row[0], row[1]) in rim for row in chart.F.tolist())


def test_a_tiny_limit_gives_certified_charts_within_the_bound():
    result = unwrap(V, F, time_limit=1e-3)
    assert result.status is UnwrapStatus.TIME_LIMIT
    assert result.certificate.bijective
    assert result.stretch.p99 <= 1.5
    np.testing.assert_array_equal(result.unfinished, np.arange(result.n_charts))
    assert f"{result.n_charts} charts of {result.n_charts} grown by normals" in result.summary()
    assert result.to_dict()["unfinished"] == list(range(result.n_charts))


def strike(monkeypatch, phase, call=1):
    """Let the time limit strike at the given call of the callback in a phase; return the callback."""
    now, calls = [0.0], []
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])

    def advance(step):
        calls.extend([step] * (step.phase == phase))
        if len(calls) == call:
            now[0] = 1e6

    return advance


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["cut", "flatten", "improve", "separate"])
def test_a_limit_that_strikes_in_any_phase_gives_certified_charts(phase, monkeypatch):
    points, triangles = double_torus()
    for call in (1, 2):
        result = unwrap(points, triangles, max_stretch=1.1, time_limit=1e3, callback=strike(monkeypatch, phase, call))
        assert result.status in (UnwrapStatus.TIME_LIMIT, UnwrapStatus.UNWRAPPED, UnwrapStatus.STRETCHED)
        assert result.certificate.bijective
        assert result.stretch.p99 <= 1.1 + 1e-9
        assert (result.status is UnwrapStatus.TIME_LIMIT) or not result.unfinished.size
        assert (result.charts >= 0).all()
    assert phase == "separate" or result.status is UnwrapStatus.TIME_LIMIT


def test_charts_that_the_search_has_finished_are_kept(monkeypatch):
    spheres = np.concatenate([V, V + np.array([10, 0, 0])]), np.concatenate([F, F + len(V)])
    begun = unwrap(*spheres, jobs=1, time_limit=1e3, callback=strike(monkeypatch, "flatten", 2))
    assert begun.status is UnwrapStatus.TIME_LIMIT
    assert 0 < begun.unfinished.size < begun.n_charts


def test_a_generous_limit_changes_nothing():
    one, other = (unwrap(V, F, time_limit=limit) for limit in (None, 600.0))
    np.testing.assert_array_equal(one.uvs, other.uvs)
    np.testing.assert_array_equal(one.indices, other.indices)
    assert one.status is other.status is UnwrapStatus.UNWRAPPED
    assert not other.unfinished.size


def test_seams_of_given_coordinates_stay_seams():
    given = unwrap(V, F)
    corner_uv = given.uvs[given.indices]
    result = unwrap(V, F, uv=corner_uv, time_limit=1e-3)
    assert result.status is UnwrapStatus.TIME_LIMIT
    assert {tuple(edge) for edge in given.seams.tolist()} <= {tuple(edge) for edge in result.seams.tolist()}


def test_a_callback_ends_the_search_with_the_best_charts():
    ended = []

    def stop(step):
        if step.phase == "improve" and not ended:
            ended.append(step)
            progress.end_work()

    result = unwrap(V, F, callback=stop)
    assert len(ended) == 1
    assert result.status is UnwrapStatus.TIME_LIMIT
    assert result.certificate.bijective


def test_ctrl_c_within_the_limit_propagates():
    def stop(step):
        if step.phase == "flatten":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        unwrap(V, F, time_limit=600, callback=stop)


@pytest.mark.parametrize("limit", [0, -1.0, np.nan, "soon"])
def test_a_wrong_limit_is_an_error(limit):
    with pytest.raises(ValueError, match="time_limit"):
        unwrap(V, F, time_limit=limit)


def test_the_limit_ends_work_in_threads():
    ended = []

    def work():
        while True:
            try:
                progress.heartbeat()
            except KeyboardInterrupt:
                ended.append(True)
                # Once per thread.
                progress.heartbeat()
                return

    with progress.time_limit(1e-3) as limit:
        time.sleep(2e-3)
        worker = progress.keep_time_limit(work)
    worker()
    assert ended
    assert limit.reached


def test_the_limit_ends_work_before_a_step_that_would_exceed_it():
    with progress.time_limit(60) as limit:
        progress.heartbeat(30)
        with pytest.raises(KeyboardInterrupt):
            progress.heartbeat(90)
    assert limit.reached


def test_the_command_has_the_limit(tmp_path, capsys):
    io.write_obj(tmp_path / "model.obj", io.MeshData(V, F))
    out, report = tmp_path / "out.obj", tmp_path / "report.json"
    assert run("unwrap", tmp_path / "model.obj", "-o", out, "--time-limit", 0.001, "--json", report) == 0
    facts = json.loads(report.read_text())
    assert facts["status"] == "time_limit"
    assert len(facts["unfinished"]) == facts["charts"]
    assert "grown by normals" in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.parametrize("rough", [0.0, 0.01])
@pytest.mark.parametrize("limit", [10.0, 20.0])
def test_300_000_triangles_end_within_a_second_of_the_limit(limit, rough):
    points, triangles = torus(500, 300)
    points = points + rough / 10 * np.random.default_rng(0).normal(size=points.shape)
    result = unwrap(points, triangles, time_limit=limit)
    assert result.certificate.bijective
    assert result.seconds <= limit + 1
