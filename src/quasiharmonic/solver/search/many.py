"""Solve many problems in one call on all available cores.

A *group* has consecutive problems, which one thread solves. The first stage of its small problems runs in *batches*:
the meshes of a batch are combined into one mesh (`quasiharmonic.solver.search.first_stage`). A group has at most as
many triangles as a full batch, or it is one larger problem.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYet
from dataclasses import replace
from functools import partial
from typing import Any, TypedDict, Unpack, get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import find_energy, polish_options, polish_result
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.objects import mesh_arrays, stands_for_mesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.search.first_stage import MAX_BATCH, SMALL, Patterns, group_by_first_stage, run_first_stage
from quasiharmonic.solver.search.search import Search, finish_search
from quasiharmonic.solver.search.stages import STRATEGIES, Stages
from quasiharmonic.util.arrays import check_callback, check_choice, check_integer, check_sequence
from quasiharmonic.util.options import MapOptions, takes
from quasiharmonic.util.threads import count_cores, make_executor

#: A problem as arrays: ``V, F, fixed, target`` as `quasiharmonic.Problem` takes them.
Arrays = tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]


# Seconds between two calls of the callback while no problem finishes, and between two checks for an interrupt.
_TICK = 0.2


class ManyKeywords(TypedDict, total=False):
    """Types of the options of `injective_maps` that it shares with `injective_map`."""

    strategy: str | Stages
    polish: str | Energy | None
    max_iterations: int
    linear_solver: str


@takes(MapOptions, ManyKeywords)
def injective_maps(
    problems: Iterable[Problem | Arrays],
    *,
    reference: Reference | None = None,
    jobs: int | None = None,
    errors: str = "raise",
    callback: Callable[[int], object] | None = None,
    **options: Unpack[ManyKeywords],
) -> Iterator[MapResult | ValueError]:
    """Solve many problems as `injective_map` does, several times as many per second if they are small.

    Parameters
    ----------
    problems : iterable of Problem or of (V, F, fixed, target)
        Any number of problems, read as needed; see `injective_map`. If a problem has the same mesh and fixed vertices
        as the previous one, the mesh is analysed once.
    reference : {"equilateral", "rest", "corrected"}, optional
        Reference triangles of problems given as arrays; see `injective_map`. With a value other than ``"equilateral"``
        each problem is solved separately.
    strategy, polish, max_iterations, linear_solver
        See `injective_map`; applied to all problems.
    jobs : int, optional
        Number of threads. Default: the number of available cores. It does not affect the maps.
    errors : {"raise", "yield"}
        How to report a malformed problem. ``"raise"``: raise a ValueError with its number when its result is due and
        end the iteration. ``"yield"``: yield the ValueError instead of the result.
    callback : callable, optional
        Called with the number of finished problems when that number grows, and also several times per second. If it
        raises an exception, all work ends.

    Yields
    ------
    MapResult
        In the order of the problems. A problem without a map is not an error; see `injective_map`. For problems solved
        in a batch, ``seconds`` is a share of the batch's time.

    Raises
    ------
    ValueError
        If an option is unknown or invalid, or a problem is malformed; the message has its number, counted from 0.
    ImportError
        If the named linear solver is not installed.

    See Also
    --------
    injective_map : One problem, with all options.
    animate : A sequence of targets whose maps stay close to each other.
    quasiharmonic.batch : Files of problems.

    Notes
    -----
    Meshes of up to 4,000 triangles are combined into batches of about 28,000 triangles for the first stage of the
    search. After two iterations the unsolved problems of up to four batches are joined. Batching does not change the
    path of a problem: the same call gives the same maps for any ``jobs``. They equal the maps of `injective_map` except
    for rounding, which may lead a long search to another map. Ctrl-C and closing the iterator end all work within a
    fraction of a second.

    Examples
    --------
    Map a disk onto twenty ellipses:

    >>> from quasiharmonic import injective_maps
    >>> from quasiharmonic.surfaces import disk
    >>> from quasiharmonic.geometry.mesh.topology import boundary_loops
    >>> V, F = disk(6)
    >>> (loop,) = boundary_loops(F, len(V))
    >>> results = injective_maps((V, F, loop, V[loop] * [1, 0.1 * k]) for k in range(1, 21))
    >>> sum(result.injective for result in results)
    20
    """
    search = MapOptions(**options)
    if jobs is not None:
        check_integer("jobs", jobs, minimum=1)
    check_choice("errors", errors, ("raise", "yield"))
    check_callback(callback)
    if reference is not None:
        check_choice("reference", reference, get_args(Reference))
    if isinstance(search.strategy, str):
        check_choice("strategy", search.strategy, STRATEGIES)
    if search.polish is not None:
        find_energy(search.polish, "polish")
    check_sequence("problems", problems, "problems")
    worker = partial(_Worker, reference, search)
    return _solve_groups(iter(problems), worker, jobs or count_cores(), errors == "raise", callback)


def _solve_groups(
    problems: Iterator[Any],
    make_worker: Callable[[threading.Event], _Worker],
    jobs: int,
    raising: bool,
    callback: Callable[[int], object] | None,
) -> Iterator[MapResult | ValueError]:
    """Solve groups in threads and yield their results in order; submit a few more groups than there are threads."""
    stop = threading.Event()
    workers = threading.local()

    def work(first: int, group: list[Any]) -> list[MapResult | Exception]:
        if not hasattr(workers, "own"):
            workers.own = make_worker(stop)
        own: _Worker = workers.own
        return own.solve(first, group)

    groups, waiting, done = _group_problems(problems), deque[Future[list[MapResult | Exception]]](), 0
    pool = make_executor(jobs, "injective_maps")
    try:
        while True:
            while len(waiting) <= jobs and (group := next(groups, None)) is not None:
                waiting.append(pool.submit(work, *group))
            if not waiting:
                return
            for result in _wait_for(waiting.popleft(), done, callback):
                if isinstance(result, Exception) and (raising or not isinstance(result, ValueError)):
                    raise result
                done += 1
                yield result
            if callback is not None:
                callback(done)
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def _wait_for(
    future: Future[list[Any]], done: int, callback: Callable[[int], object] | None
) -> list[MapResult | ValueError]:
    """Wait for the results of a group; meanwhile call the callback regularly and allow Ctrl-C."""
    while True:
        try:
            return future.result(timeout=_TICK)
        except NotYet:
            if callback is not None:
                callback(done)


def _group_problems(problems: Iterator[Any]) -> Iterator[tuple[int, list[Any]]]:
    """Yield the number of the first problem of each group and the problems of the group, in order."""
    first, group, size = 0, list[Any](), 0
    for given in problems:
        triangles = _count_triangles(given)
        if group and (size + triangles > MAX_BATCH or triangles > SMALL):
            yield first, group
            first, group, size = first + len(group), [], 0
        group.append(given)
        size += triangles
    if group:
        yield first, group


def _count_triangles(given: Any) -> int:
    """Number of triangles of a problem that is not yet checked; 0 if it cannot be determined."""
    try:
        return len(given.F if isinstance(given, Problem) else given[1])
    except (TypeError, IndexError, KeyError):
        return 0


class _Worker:
    """Solver of groups of problems for one thread, with the caches that the thread reuses."""

    def __init__(self, reference: Reference | None, options: MapOptions, stop: threading.Event) -> None:
        self._reference = reference
        self._options = replace(options, callback=self._check_wanted)
        self._stop = stop
        self._patterns = Patterns(options.linear_solver)
        self._last: Problem | None = None

    def solve(self, first: int, group: Sequence[Any]) -> list[MapResult | Exception]:
        """Return the result or the exception of each problem; ``first`` is the number of the first problem."""
        posed = [self._set_up(first + k, given) for k, given in enumerate(group)]
        begun: dict[int, Search] = {}
        problems = {k: one for k, one in enumerate(posed) if not isinstance(one, Exception)}
        for descent, keys in group_by_first_stage(problems, self._options.strategy):
            outcomes = run_first_stage([problems[k] for k in keys], descent, self._patterns, self._options)
            begun |= {k: one for k, one in zip(keys, outcomes, strict=True) if one is not None}
        return [
            problem if isinstance(problem, Exception) else self._finish(first + k, problem, begun.get(k))
            for k, problem in enumerate(posed)
        ]

    def _set_up(self, number: int, given: Any) -> Problem | Exception:
        """Set up a problem, on the previous problem's domain if it is the same."""
        self._check_wanted()
        if isinstance(given, Problem):
            return given
        try:
            if isinstance(given, Sequence) and len(given) == 3 and stands_for_mesh(given[0]):
                given = (*mesh_arrays(given[0]), *given[1:])
            if not isinstance(given, Sequence) or len(given) != 4:
                raise ValueError("give each as a Problem, as V, F, fixed, target or as mesh, fixed, target")
            V, F, fixed, target = given
            last = self._last
            if last is not None and _is_same(last.V, V) and _is_same(last.F, F) and _is_same(last.fixed, fixed):
                return last.with_target(target)
            self._last = Problem(V, F, fixed, target, reference=self._reference)
        except Exception as error:
            return _add_number(number, error)
        return self._last

    def _finish(self, number: int, problem: Problem, begun: Search | None) -> MapResult | Exception:
        """Complete the search for one problem, which may have had its first stage."""
        try:
            result = finish_search(begun or Search(problem, self._options), self._options.strategy)
            if self._options.polish is not None and result.status is Status.INJECTIVE:
                result = polish_result(problem, result, polish_options(self._options))
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
        except Exception as error:
            return _add_number(number, error)
        return result

    def _check_wanted(self, _: Step | None = None) -> None:
        """Raise KeyboardInterrupt if the caller no longer waits for results."""
        if self._stop.is_set():
            raise KeyboardInterrupt


def _is_same(array: np.ndarray[Any, Any], given: Any) -> bool:
    """Whether ``given`` is an array of the same shape and values."""
    if given is array:
        return True
    return isinstance(given, np.ndarray) and given.shape == array.shape and np.array_equal(array, given)


def _add_number(number: int, error: Exception) -> Exception:
    """Add the number of the problem to an error."""
    if isinstance(error, ValueError):
        numbered = ValueError(f"problem {number}: {error}")
        numbered.__cause__ = error
        return numbered
    error.add_note(f"in problem {number}")
    return error
