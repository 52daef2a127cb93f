"""Search for few charts with short cuts that keep a bound on stretch.

    cuts into disks ─▶ flatten ─▶ overlaps itself much? ─ yes ─▶ divide ─────────────────┐
                          ▲              │ no                                            │
                          │        over the bound? ─ yes ─▶ extend cuts to the greatest  │
                          │              │ no               stretch, or divide ──────────┤
                          │        overlaps itself a little? ─ yes ─▶ separate, or divide┤
                          └──────────────┼───────────────────────────────────────────────┘
                                         ▼
                                       done

Charts that touch themselves along a cut, as parts that unfold without stretch do, are closed there.

All charts together may exceed the bound on one per cent of the surface, so a small chart may exceed it on more.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from quasiharmonic.apps.unwrapping.chart_cuts import divide, divide_overlap, extend_cuts
from quasiharmonic.apps.unwrapping.chart_maps import (
    FREE_SHARE,
    WorkingChart,
    flatten_chart,
    guard_chart,
    relax_thin,
)
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST
from quasiharmonic.apps.unwrapping.separation import overlapping_share, separate
from quasiharmonic.apps.unwrapping.triangle_moves import join_small_charts, move_teeth
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.splitting import fans, renumber
from quasiharmonic.geometry.mesh.topology import edge_keys, find_pairs
from quasiharmonic.util.arrays import mark
from quasiharmonic.util.progress import heartbeat, keep_time_limit
from quasiharmonic.util.threads import HAS_THREADS, count_cores, make_executor

T = TypeVar("T")
R = TypeVar("R")

Callback = Callable[[str, int, int], object]

#: The aim for charts of a coarse mesh, whose seams are carried to the surface: this fraction of the permitted stretch.
AIM_OF_CARRIED = 0.75
#: On smaller surfaces, threads mostly wait for the interpreter: with two, a search takes a quarter longer.
MANY_TRIANGLES = 200_000
# Seconds between two calls of the callback while nothing is finished.
_TICK = 0.25
# Two sides of a cut lie at the same place if their ends are at most this fraction of their length apart.
_SAME = 0.01


class SearchTuning(NamedTuple):
    """Numbers that tune the search: first it aims at a lower bound than the given one, then it keeps the given one."""

    # The aim for all other charts, as a fraction of the permitted stretch.
    aim: float = 0.65
    # Maximum number of rounds in which charts are cut further to reach the aim.
    aim_rounds: int = 12
    # Maximum number of rounds to keep the bound.
    bound_rounds: int = 24
    # Maximum number of additional charts to reach the aim, and a multiple of the root of the number of triangles.
    aim_charts: tuple[int, float] = (8, 0.125)
    # The same to keep the bound.
    bound_charts: tuple[int, float] = (64, 4.0)
    # An extension must lower the share over the bound to this fraction, or it has failed.
    success: float = 0.6
    # A chart is divided after this number of failed extensions.
    max_failures: int = 1
    # Charts are improved until this fraction of the free share remains, if all improvements succeed.
    remaining: float = 0.8
    # Overlaps of at most this share of a chart are separated without dividing the chart.
    small_overlap: float = 0.005


_TUNING = SearchTuning()


class Workers:
    """A pool of threads that reports progress and stops when the callback raises an exception.

    ``callback(phase, done, total)`` is called in the caller's thread.
    """

    def __init__(self, jobs: int | None, callback: Callback | None) -> None:
        self._jobs = jobs or count_cores() if HAS_THREADS else 1
        self._callback = callback
        self._stop = threading.Event()

    def check_wanted(self) -> None:
        """Raise KeyboardInterrupt if the caller no longer waits for results, or after a time limit."""
        heartbeat()
        if self._stop.is_set():
            raise KeyboardInterrupt

    def map(self, phase: str, function: Callable[[T], R], items: Sequence[T], triangles: int) -> list[R]:
        """Apply a function to every item, largest items first if they are so ordered; results in order of the items.

        ``triangles`` is their number on the searched surface. Few triangles are searched in the caller's thread.
        """
        self._report(phase, 0, len(items))
        if self._jobs == 1 or len(items) < 2 or triangles < MANY_TRIANGLES:
            return self._map_here(phase, function, items)
        pool = make_executor(self._jobs, "find_charts")
        try:
            futures = [pool.submit(keep_time_limit(function), item) for item in items]
            waiting: set[Future[R]] = set(futures)
            while waiting:
                done, waiting = wait(waiting, _TICK, FIRST_COMPLETED)
                for future in done:
                    future.result()
                self._report(phase, len(items) - len(waiting), len(items))
            return [future.result() for future in futures]
        except BaseException:
            self._stop.set()
            raise
        finally:
            pool.shutdown(cancel_futures=True)

    def _map_here(self, phase: str, function: Callable[[T], R], items: Sequence[T]) -> list[R]:
        results = []
        for item in items:
            results.append(function(item))
            self._report(phase, len(results), len(items))
        return results

    def _report(self, phase: str, done: int, total: int) -> None:
        heartbeat()
        if self._callback is not None:
            self._callback(phase, done, total)


def search_charts(
    charts: Sequence[WorkingChart],
    bound: float,
    *,
    max_charts: int | None,
    total_area: float,
    joinable: bool,
    workers: Workers,
    keep: Callable[[list[WorkingChart]], object],
) -> list[WorkingChart]:
    """Flatten charts and cut them further until they keep a bound on stretch or the limits are reached.

    Parameters
    ----------
    charts : sequence of WorkingChart
        Without maps, or with bijective ones that stretch no triangle too much.
    bound : float
        See `find_charts`.
    max_charts : int or None
        Maximum number of charts; more only if a chart has no injective map otherwise.
    total_area : float
        Area of the surface, which may have further charts.
    joinable : bool
        Whether no cut is demanded. Then small charts may be joined to any neighbour, slits are closed, and the search
        goes beyond the bound while that takes few charts.
    workers : Workers
    keep : callable
        Called with the charts so far, with and without maps; the search changes their maps.

    Returns
    -------
    list of WorkingChart
        All have bijective maps.
    """
    carried = any(chart.start is not None for chart in charts)
    aim = 1 + (1.0 if not joinable else AIM_OF_CARRIED if carried else _TUNING.aim) * (bound - 1)
    triangles = sum(len(chart.F) for chart in charts)
    few, many = (
        len(charts) + round(base + share * triangles**0.5) for base, share in (_TUNING.aim_charts, _TUNING.bound_charts)
    )
    keep([*charts])
    flattened = workers.map("flatten", partial(_flatten_first, aim, workers), charts, triangles)
    here = [part for parts in flattened for part in parts]
    keep(here)
    for goal, rounds, most in ((aim, _TUNING.aim_rounds, few), (bound, _TUNING.bound_rounds, many)):
        for _ in range(rounds):
            room = (most if max_charts is None else min(max_charts, most)) - len(here)
            chosen = _select(here, goal, total_area)
            if goal < bound and room <= 0 and any(stretched for _, stretched in chosen):
                break
            jobs = [
                _Job(
                    here[k],
                    stretched,
                    divisible=rank < room or (max_charts is None and not here[k].bijective),
                    halved=max_charts is not None,
                )
                for rank, (k, stretched) in enumerate(chosen)
            ]
            found = workers.map("improve", partial(_improve, goal, workers, joinable), jobs, triangles)
            changed = {k: parts for (k, _), (parts, same) in zip(chosen, found, strict=True) if not same}
            here = [part for k, chart in enumerate(here) for part in changed.get(k, [chart])]
            keep(here)
            if not changed:
                break
    here = [_close(chart, joinable) for chart in here]
    keep(here)
    overlapping = [chart for chart in here if not chart.bijective]
    workers.map("separate", partial(guard_chart, check_wanted=workers.check_wanted), overlapping, triangles)
    workers.map("improve", partial(relax_thin, bound=bound), here, triangles)
    if not joinable:
        return here
    return move_teeth(join_small_charts(here, aim, total_area, workers.check_wanted), aim)


class _Job(NamedTuple):
    """A chart to improve."""

    chart: WorkingChart
    # Whether it exceeds the bound on stretch.
    stretched: bool
    # Whether it may be divided, and whether only into two parts.
    divisible: bool
    halved: bool


def _select(charts: Sequence[WorkingChart], bound: float, total_area: float) -> list[tuple[int, bool]]:
    """Charts to be improved, most urgent first, and whether they exceed the bound on stretch."""
    share = np.array([chart.share_over(bound) * chart.surface_area / total_area for chart in charts])
    # The charts that exceed the bound most; all others together exceed it on less than the free share.
    order = np.argsort(-share, kind="stable")
    rest = np.empty(len(charts))
    rest[order] = share.sum() - np.cumsum(share[order]) + share[order]
    missed = rest > (_TUNING.remaining * FREE_SHARE if share.sum() > FREE_SHARE else np.inf)
    stretched = [bool(chart.too_long.any() or missed[k]) for k, chart in enumerate(charts)]
    chosen = [k for k, chart in enumerate(charts) if stretched[k] or not chart.bijective]
    return [(k, stretched[k]) for k in sorted(chosen, key=lambda k: (charts[k].bijective, -share[k], k))]


def _flatten_first(bound: float, workers: Workers, chart: WorkingChart) -> list[WorkingChart]:
    """Flatten a chart; if it already has a bijective map, the new one must be bijective and keep the bound as well."""
    given = chart.uv
    share = 0.0 if given is None else chart.share_over(bound)
    parts = _flatten(bound, workers, chart)
    if given is not None and (not chart.bijective or chart.too_long.any() or chart.share_over(bound) > share):
        chart.use(given)
    return parts


def _flatten(bound: float, workers: Workers, chart: WorkingChart) -> list[WorkingChart]:
    """Flatten a chart; divide it as long as it has no injective map."""
    workers.check_wanted()
    flatten_chart(chart, bound, workers.check_wanted)
    if chart.uv is not None:
        return [chart]
    return [part for half in divide(chart, bound) for part in _flatten(bound, workers, half)]


def _close(chart: WorkingChart, joinable: bool) -> WorkingChart:
    """Close the slits of a chart that touches itself, if its cuts may be closed."""
    return chart if chart.bijective or not joinable else close_slits(chart) or chart


def close_slits(chart: WorkingChart) -> WorkingChart | None:
    """Close slits: join a chart to itself at boundary edges that are one edge of the surface and lie at the same place.

    The chart may have more holes afterwards. Return None if there are no such edges, or if the joined chart has no
    injective map.
    """
    assert chart.uv is not None
    tail, head = chart.F.ravel(), chart.F[:, (1, 2, 0)].ravel()
    rim = np.flatnonzero(~mark(chart.F.size, *find_pairs(chart.F)))
    edge = edge_keys(chart.vertices[tail[rim]], chart.vertices[head[rim]], int(chart.vertices.max()) + 1)
    order = np.argsort(edge, kind="stable")
    first = np.flatnonzero(np.diff(edge[order]) == 0)
    one, other = rim[order[first]], rim[order[first + 1]]
    z = chart.uv[:, 0] + 1j * chart.uv[:, 1]
    apart = np.maximum(np.abs(z[tail[one]] - z[head[other]]), np.abs(z[head[one]] - z[tail[other]]))
    same = (apart <= _SAME * np.abs(z[tail[one]] - z[head[one]])) & (chart.cost.ravel()[one] > DEMANDED_COST)
    if not same.any():
        return None
    cut = mark(chart.F.size, np.setdiff1d(rim, np.concatenate([one[same], other[same]])))
    on_surface = chart.vertices[chart.F]
    own, corner = renumber(fans(on_surface, cut.reshape(-1, 3))[0], on_surface)
    count = np.bincount(own.ravel())
    uv = np.stack([np.bincount(own.ravel(), chart.uv[chart.F, k].ravel()) / count for k in range(2)], axis=1)
    origin = chart.F.ravel()[corner]
    try:
        closed = WorkingChart(chart.triangles, chart.vertices[origin], chart.V[origin], own, chart.cost)
    except ValueError:
        # The surface would have a handle.
        return None
    uv = np.ldexp(uv, chart.piece.exponent - closed.piece.exponent)
    if not is_injective(own, uv):
        return None
    closed.use(uv)
    return closed


def _improve(bound: float, workers: Workers, joinable: bool, job: _Job) -> tuple[list[WorkingChart], bool]:
    """Cut a chart once and flatten its parts, or separate overlaps; the flag says that the chart is unchanged."""
    chart = _close(job.chart, joinable)
    if chart is not job.chart:
        return [chart], False
    apart = chart.bijective or overlapping_share(chart) < _TUNING.small_overlap
    if apart and not job.stretched:
        if separate(chart, bound, workers.check_wanted):
            return [chart], False
        apart = False
    if apart and chart.failures < _TUNING.max_failures and (longer := extend_cuts(chart, bound)) is not None:
        parts = _flatten(bound, workers, longer)
        enough = sum(part.share_over(bound) for part in parts) <= _TUNING.success * chart.share_over(bound)
        for part in parts:
            part.failures = 0 if enough else chart.failures + 1
        return parts, False
    if not job.divisible or len(chart.F) < 2:
        return [chart], True
    parts = divide(chart, bound) if apart or not len(chart.crossings) else divide_overlap(chart, chart.crossings)
    if job.halved and len(parts) > 2:
        return [chart], True
    return [done for part in parts for done in _flatten(bound, workers, part)], False
