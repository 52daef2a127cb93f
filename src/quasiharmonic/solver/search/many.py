"""Many problems in one call: small ones together, and all of them on as many cores as there are."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import energy_named, polished
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.problem.batched import posed_each
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.search.batched import GROUP, SMALL, Patterns, beginning_alike, first_stage
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.solver.search.stages import ResumedStage, Stages
from quasiharmonic.solver.search.strategy import STRATEGIES, stages_of
from quasiharmonic.util.arrays import check_callback, check_choice, whole_number

#: A problem as arrays: ``V, F, fixed, target`` as `quasiharmonic.Problem` takes them.
Arrays = tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]

# Groups that are solved together, at most: what is left of them after the first iterations is joined.
_GROUPS = 4
# What is solved together is no more than such a part of all that was before, so that no thread is left with much while
# the others have nothing to do any more.
_PART = 8
# Seconds between two calls of a callback while nothing is finished, and between two looks for an interrupt.
_TICK = 0.2


def injective_maps(
    problems: Iterable[Problem | Arrays],
    *,
    reference: Reference | None = None,
    strategy: str | Stages = "speed",
    polish: str | Energy | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    jobs: int | None = None,
    errors: str = "raise",
    callback: Callable[[int], object] | None = None,
) -> Iterator[MapResult | ValueError]:
    """Solve many problems: what `injective_map` does for one, several times as many a second where they are small.

    Parameters
    ----------
    problems : iterable of Problem or of (V, F, fixed, target)
        As `injective_map` takes them; any number, read as they are needed. A mesh that is the same as the one before,
        with the same vertices fixed, is looked at once.
    reference : {"equilateral", "rest", "corrected"}, optional
        For those that are given as arrays; see `injective_map`. With another than ``"equilateral"`` each problem is
        solved by itself.
    strategy, polish, max_iterations, linear_solver
        As of `injective_map`, for all of them.
    jobs : int, optional
        Threads to solve with; by default as many as there are cores. No matter to the maps.
    errors : {"raise", "yield"}
        What becomes of a problem that is malformed: a ValueError that names its number is raised when it is its turn,
        after which nothing more is to be had, or it takes the place of the result.
    callback : callable, optional
        Called with the number of problems that are done whenever that has grown, and a few times a second besides.
        It may raise, which ends all.

    Yields
    ------
    MapResult
        In the order of the problems. That no map was found is no error, as of `injective_map`. Its ``seconds`` are a
        share of what was spent on several at a time.

    Raises
    ------
    ValueError
        When an option is none that there is; when a problem is malformed, with its number counted from 0.
    ImportError
        When the linear solver named is not installed.

    Notes
    -----
    Meshes of up to 4,000 triangles are laid side by side, and the first stage of the search is run on some 28,000
    triangles at a time; what is left of up to four such groups after two iterations goes on together. Each walks
    the way that it would walk alone: the same call gives the same maps, whatever ``jobs``, and they are those of
    `injective_map` but for rounding, which may lead a long search elsewhere. Ctrl-C ends all within a fraction of a
    second, as does closing the iterator.

    Examples
    --------
    A disk onto twenty ellipses:

    >>> from quasiharmonic import injective_maps
    >>> from quasiharmonic.surfaces import disk
    >>> from quasiharmonic.geometry.mesh.topology import boundary_loops
    >>> V, F = disk(6)
    >>> (loop,) = boundary_loops(F, len(V))
    >>> results = injective_maps((V, F, loop, V[loop] * [1, 0.1 * k]) for k in range(1, 21))
    >>> sum(result.injective for result in results)
    20
    """
    whole_number("max_iterations", max_iterations, least=1)
    if jobs is not None:
        whole_number("jobs", jobs, least=1)
    check_choice("errors", errors, ("raise", "yield"))
    check_callback(callback)
    if reference is not None:
        check_choice("reference", reference, get_args(Reference))
    if isinstance(strategy, str):
        check_choice("strategy", strategy, STRATEGIES)
    lower = None if polish is None else energy_named(polish)
    settings = _Settings(reference, strategy, lower, max_iterations, linear_solver)
    return _results(iter(problems), settings, jobs or _cores(), errors == "raise", callback)


@dataclass(frozen=True)
class _Settings:
    """What all problems have in common."""

    reference: Reference | None
    strategy: str | Stages
    lower: Energy | None
    max_iterations: int
    linear_solver: str


def _results(
    problems: Iterator[Any], settings: _Settings, jobs: int, raising: bool, callback: Callable[[int], object] | None
) -> Iterator[MapResult | ValueError]:
    """Have groups solved, a few more at a time than there are threads, and hand out what comes of them in order."""
    stop = threading.Event()
    workers = threading.local()

    def work(first: int, group: list[Any]) -> list[MapResult | Exception]:
        if not hasattr(workers, "own"):
            workers.own = _Worker(settings, stop)
        own: _Worker = workers.own
        return own.solve(first, group)

    groups, waiting, done = _groups(problems), deque[Future[list[MapResult | Exception]]](), 0
    pool = ThreadPoolExecutor(jobs, thread_name_prefix="injective_maps")
    try:
        while True:
            while len(waiting) <= jobs and (group := next(groups, None)) is not None:
                waiting.append(pool.submit(work, *group))
            if not waiting:
                return
            for found in _awaited(waiting.popleft(), done, callback):
                if isinstance(found, Exception) and (raising or not isinstance(found, ValueError)):
                    raise found
                done += 1
                yield found
            if callback is not None:
                callback(done)
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def _awaited(
    future: Future[list[Any]], done: int, callback: Callable[[int], object] | None
) -> list[MapResult | ValueError]:
    """What comes of a group; meanwhile the callback is called now and then, and Ctrl-C is heard."""
    while True:
        try:
            return future.result(timeout=_TICK)
        except NotYet:
            if callback is not None:
                callback(done)


def _groups(problems: Iterator[Any]) -> Iterator[tuple[int, list[Any]]]:
    """Problems in their order, as many together as are to be solved together; and the number of the first."""
    first, group, size, before = 0, list[Any](), 0, 0
    for given in problems:
        triangles = _triangles(given)
        most = GROUP * min(max(before // (_PART * GROUP), 1), _GROUPS)
        if group and (size + triangles > most or triangles > SMALL):
            yield first, group
            before += size
            first, group, size = first + len(group), [], 0
        group.append(given)
        size += triangles
    if group:
        yield first, group


def _triangles(given: Any) -> int:
    """How many triangles a problem has, as far as can be told before it is looked at."""
    try:
        return len(given.F if isinstance(given, Problem) else given[1])
    except (TypeError, IndexError, KeyError):
        return 0


class _Worker:
    """A thread that solves groups of problems, and what it keeps from one to the next."""

    def __init__(self, settings: _Settings, stop: threading.Event) -> None:
        self._settings = settings
        self._stop = stop
        self._patterns = Patterns(settings.linear_solver)
        self._last: Problem | None = None

    def solve(self, first: int, group: Sequence[Any]) -> list[MapResult | Exception]:
        """The results of some problems, or what was raised; ``first`` is the number of the first of them."""
        ready = self._posed_at_once(group)
        posed = [self._posed(first + k, given, ready.get(k)) for k, given in enumerate(group)]
        begun: dict[int, MapResult | ResumedStage] = {}
        problems = {k: one for k, one in enumerate(posed) if not isinstance(one, Exception)}
        for descent, some in beginning_alike(problems, self._settings.strategy).items():
            found = first_stage(
                [problems[k] for k in some],
                descent,
                self._patterns,
                self._settings.max_iterations,
                self._still_wanted,
            )
            begun |= {k: one for k, one in zip(some, found, strict=True) if one is not None}
        return [
            problem if isinstance(problem, Exception) else self._finished(first + k, problem, begun.get(k))
            for k, problem in enumerate(posed)
        ]

    def _posed_at_once(self, group: Sequence[Any]) -> dict[int, Problem]:
        """Those given as arrays that have a small mesh each, unless something is the matter with one of them."""
        if self._settings.reference is not None:
            return {}
        fresh = dict[int, Any]()
        before: Sequence[Any] | None = None
        if self._last is not None:
            before = self._last.V, self._last.F, self._last.fixed
        for k, given in enumerate(group):
            if isinstance(given, Problem):
                continue
            if not isinstance(given, Sequence) or len(given) != 4:
                return {}
            if not all(isinstance(array, np.ndarray) for array in given) or _triangles(given) > SMALL:
                return {}
            if before is None or not all(map(_same, before, given[:3])):
                fresh[k] = given
            before = given[:3]
        posed = posed_each(list(fresh.values())) if len(fresh) > 1 else None
        return {} if posed is None else dict(zip(fresh, posed, strict=True))

    def _posed(self, number: int, given: Any, ready: Problem | None) -> Problem | Exception:
        """A problem, on the domain of the one before if that is the same; ``ready`` if it is posed already."""
        self._still_wanted()
        if isinstance(given, Problem):
            return given
        try:
            if not isinstance(given, Sequence) or len(given) != 4:
                raise ValueError("give each as a Problem or as V, F, fixed, target")
            V, F, fixed, target = given
            last, reference = self._last, self._settings.reference
            if last is not None and _same(last.V, V) and _same(last.F, F) and _same(last.fixed, fixed):
                return last.with_target(target)
            self._last = Problem(V, F, fixed, target, reference=reference) if ready is None else ready
        except Exception as error:
            return _numbered(number, error)
        return self._last

    def _finished(self, number: int, problem: Problem, begun: MapResult | ResumedStage | None) -> MapResult | Exception:
        """The result of one problem, whatever has been done for it so far."""
        settings = self._settings
        try:
            if isinstance(begun, MapResult):
                if settings.lower is None:
                    return begun
                return polished(
                    problem,
                    begun,
                    energy=settings.lower,
                    linear_solver=settings.linear_solver,
                    callback=self._still_wanted,
                )
            stages: str | Stages = settings.strategy
            if begun is not None:
                stages = [begun, *stages_of(stages, problem)[1:]]
            result = solve(
                problem,
                strategy=stages,
                polish=settings.lower,
                max_iterations=settings.max_iterations,
                linear_solver=settings.linear_solver,
                callback=self._still_wanted,
            )
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
        except Exception as error:
            return _numbered(number, error)
        return result if begun is None else replace(result, seconds=result.seconds + begun.stage.seconds)

    def _still_wanted(self, _: Step | None = None) -> None:
        """Break off where nobody waits any more."""
        if self._stop.is_set():
            raise KeyboardInterrupt


def _same(array: np.ndarray[Any, Any], given: Any) -> bool:
    """Whether what is given is an array of the same shape and numbers."""
    if given is array:
        return True
    return isinstance(given, np.ndarray) and given.shape == array.shape and np.array_equal(array, given)


def _numbered(number: int, error: Exception) -> Exception:
    """An error that says of which problem it is."""
    if isinstance(error, ValueError):
        numbered = ValueError(f"problem {number}: {error}")
        numbered.__cause__ = error
        return numbered
    error.add_note(f"in problem {number}")
    return error


def _cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1
