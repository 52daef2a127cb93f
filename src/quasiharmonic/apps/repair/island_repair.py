"""Repair of one island, patch by patch.

    inverted triangles ──▶ vertices within some rings of them are free ──▶ a map of each patch, its boundary held ─┐
            ▲                                                                                                      │
            └──────────────────────── more rings ◀────────── left as it was ◀──── none found ◀─────────────────────┤
                         the others polished ◀── vertices put back where they were ◀── found ◀─────────────────────┘

A patch either comes out with all its triangles positive or is left as it was, so a repair makes no map worse. The last
patch of all is the whole island.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.fans import fans, renumbered
from quasiharmonic.geometry.mesh.seams import Island
from quasiharmonic.geometry.mesh.shapes import rest_shapes
from quasiharmonic.geometry.mesh.topology import boundary_edges, components
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis, diagnose
from quasiharmonic.problem.diagnosis.obstruction import Obstruction
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, named, named_edges

# Rings of vertices around inverted triangles that may move, tried in turn ...
_RINGS = 1, 2, 3, 4, 6, 8, 12, 16, 24, 32
# ... while at most this part of the island's interior may; and iterations on a patch that is not the whole island.
_MOST, _ITERATIONS = 0.5, 100


class IslandRepair:
    """An island on its way.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        The mesh's vertices.
    island : Island
    max_iterations : int
        Linear solves to spend at most on the whole island.
    linear_solver : str
    callback : callable, optional
        Called with a `Step` at every iteration.

    Attributes
    ----------
    uv : (m, 2) float64
        Where the island's vertices are by now.
    reason : str
        Why triangles are still inverted, once that is known.
    diagnosis : Diagnosis or None
        What forbids a map, by the mesh's own numbers.
    """

    def __init__(
        self,
        V: FloatArray,
        island: Island,
        *,
        max_iterations: int,
        linear_solver: str,
        callback: Callable[[Step], object] | None,
    ) -> None:
        self.island = island
        self.uv = island.uv.copy()
        self.reason = ""
        self.diagnosis: Diagnosis | None = None
        self._F, self._V = island.F, V[island.vertices]
        self._held = np.zeros(len(self.uv), dtype=np.bool_)
        self._held[boundary_edges(self._F, len(self.uv))] = True
        self._max_iterations = max_iterations
        self._linear_solver = linear_solver
        self._callback = callback
        # The more inverted triangles a vertex has, the more likely it is the one that is out of place.
        suspicion = np.bincount(self._F[self.inverted].ravel(), minlength=len(self.uv))
        self._innocence = np.argsort(np.argsort(-suspicion, kind="stable"))

    @property
    def inverted(self) -> IntArray:
        """The island's triangles that are not strictly positive, ascending."""
        return inverted_triangles(self._F, self.uv)

    @property
    def moved_mask(self) -> BoolArray:
        """Which of the island's vertices are no longer where they were; (m,) bool."""
        return np.asarray((self.uv != self.island.uv).any(axis=1) & ~(np.isnan(self.uv).any(axis=1)))

    def run(self, whole: bool) -> None:
        """Repair what can be, by patches first unless the ``whole`` island may change."""
        tried: set[bytes] = set()
        for rings in () if whole else _RINGS:
            free = self._around(self._repairable(), rings)
            if not 0 < np.count_nonzero(free) <= _MOST * np.count_nonzero(~self._held):
                break
            for patch in self._components(free):
                if patch.tobytes() not in tried:
                    tried.add(patch.tobytes())
                    self._attempt(patch, _ITERATIONS, keep=True)
        if self._repairable().size:
            for part in self._components(~self._held):
                if inverted_triangles(self._F[part[self._F].any(axis=1)], self.uv).size:
                    self._attempt(part, self._max_iterations, keep=not whole)
        if self.inverted.size:
            self._explain()

    def _repairable(self) -> IntArray:
        """Inverted triangles that have a vertex to move."""
        left = self.inverted
        return left[~self._held[self._F[left]].all(axis=1)]

    def _around(self, triangles: IntArray, rings: int) -> BoolArray:
        """Interior vertices within some rings of triangles; their own are the first."""
        near: BoolArray = np.zeros(len(self.uv), dtype=np.bool_)
        near[self._F[triangles]] = True
        for _ in range(rings - 1):
            near[self._F[near[self._F].any(axis=1)]] = True
        return near & ~self._held

    def _components(self, free: BoolArray) -> Iterator[BoolArray]:
        """Take free vertices apart into those that no edge joins."""
        among = free[self._F]
        touched = among.any(axis=1)
        # Vertices that are not free make way for one that is, so that triangles join free vertices only.
        one = np.take_along_axis(self._F, among.argmax(axis=1)[:, None], axis=1)
        label = components(np.where(among, self._F, one)[touched], len(free))
        for first in np.unique(label[free]):
            yield free & (label == first)

    def _patch(self, free: BoolArray) -> tuple[Problem, IntArray, IntArray]:
        """The patch of triangles that touch free vertices, the others held.

        Where its boundary passes through a vertex repeatedly, the vertex is there repeatedly.

        Returns
        -------
        problem : Problem
        vertices, triangles : (m,), (k,) int64
            Which of the island its own are.
        """
        triangles = np.flatnonzero(free[self._F].any(axis=1))
        F, first = renumbered(fans(self._F[triangles])[0], self._F[triangles])
        vertices = self._F[triangles].ravel()[first]
        held = np.flatnonzero(~free[vertices])
        problem = Problem(self._V[vertices], F, held, self.uv[vertices[held]], reference="equilateral")
        return problem, vertices, triangles

    def _attempt(self, free: BoolArray, iterations: int, *, keep: bool) -> None:
        """Map a patch anew; where that fails, nothing changes.

        With ``keep``, vertices return to where they were as far as that inverts nothing.
        """
        try:
            problem, vertices, triangles = self._patch(free)
        except ValueError as error:
            self.reason = str(error)
            return
        # Tutte's embedding does for most patches; where it does not, what forbids a map is known next.
        for allowed in (1, iterations):
            result = solve(problem, max_iterations=allowed, linear_solver=self._linear_solver, callback=self._callback)
            if _uninterrupted(result).injective:
                self._take(free, vertices, result.uv, keep)
                return
            self.reason = result.status.value
            if result.diagnosis is not None:
                self._blame(result.diagnosis, vertices, triangles)
                if result.diagnosis.forbids_injective:
                    return

    def _take(self, free: BoolArray, vertices: IntArray, uv: FloatArray, keep: bool) -> None:
        """Accept a patch's map."""
        before = self.uv.copy()
        self.uv[vertices] = uv
        self._polish(self._put_back(free) if keep else free)
        if not np.array_equal(free, ~self._held) and self._overwound(free):
            self.uv = before
            self.reason = "The maps found for a part of the island wind more than once around one of its vertices."

    def _put_back(self, moved: BoolArray) -> BoolArray:
        """Return vertices to where they were; those that could not be."""
        moved, start = moved.copy(), self.island.uv
        F = self._F[moved[self._F].any(axis=1)]
        able = np.asarray(np.isfinite(start).all(axis=1))
        while True:
            back = moved & able
            for i in range(3):
                rows = F[moved[F[:, i]] & able[F[:, i]]]
                a, b, c = start[rows[:, i]], self.uv[rows[:, i - 2]], self.uv[rows[:, i - 1]]
                back[rows[orientation(a, b, c) <= 0, i]] = False
            # Each may, but not two of a triangle at once: the first in line.
            turn = np.where(back, self._innocence, -1)
            first = turn[F].max(axis=1)
            for i in range(3):
                back[F[turn[F[:, i]] < first, i]] = False
            if not back.any():
                return moved
            self.uv[back] = start[back]
            moved &= ~back

    def _polish(self, free: BoolArray) -> None:
        """Lower the distortion of free vertices' triangles, as far as their rest shapes are any."""
        for part in self._components(free):
            problem, vertices, _ = self._patch(part)
            if not rest_shapes(problem.V, problem.F).flat.size:
                polished = polish_map(
                    problem.domain, self.uv[vertices], linear_solver=self._linear_solver, callback=self._callback
                )
                self.uv[vertices] = _uninterrupted(polished).uv

    def _overwound(self, free: BoolArray) -> bool:
        """Whether triangles wind more than once around an interior vertex of the patch, as positive ones can.

        At boundary vertices the boundary, which stays, may leave no choice.
        """
        patch = np.zeros(len(self.uv), dtype=np.bool_)
        patch[self._F[free[self._F].any(axis=1)]] = True
        around = self._F[patch[self._F].any(axis=1)]
        F, first = renumbered(fans(around)[0], around)
        found = certify(F, self.uv[around.ravel()[first]])
        return bool(found.multiply_wound.size and np.setdiff1d(found.multiply_wound, np.concatenate(found.loops)).size)

    def _explain(self) -> None:
        """Say why there still are inverted triangles, as far as no attempt has said it."""
        island, left = self.island, self.inverted
        nowhere = np.flatnonzero(self._held & ~np.isfinite(self.uv).all(axis=1))
        corners = island.vertices[self._F]
        twice = np.flatnonzero((np.roll(corners, 1, axis=1) == corners).any(axis=1))
        if nowhere.size:
            self.reason = (
                f"No finite position for the boundary {named('vertex', 'vertices', island.vertices[nowhere])}."
            )
        elif twice.size:
            self.reason = f"A vertex is used twice in {named('triangle', 'triangles', island.triangles[twice])}."
        elif self._held[self._F[left]].all(axis=1).any():
            # Triangles that the boundary alone inverts are part of no patch.
            boundary = np.flatnonzero(self._held)
            problem = Problem(self._V, self._F, boundary, self.uv[boundary], reference="equilateral")
            self._blame(diagnose(problem), np.arange(len(self.uv)), np.arange(len(self._F)))

    def _blame(self, found: Diagnosis, vertices: IntArray, triangles: IntArray) -> None:
        """Keep a patch's diagnosis, by the mesh's numbers."""
        vertices, triangles = self.island.vertices[vertices], self.island.triangles[triangles]
        self.diagnosis = replace(
            found, obstructions=tuple(_renamed(o, vertices, triangles) for o in found.obstructions)
        )
        if found.forbids_injective:
            self.reason = self.diagnosis.summary()


def _uninterrupted(result: MapResult) -> MapResult:
    """A result, unless Ctrl-C has ended the search: that is meant for the whole repair."""
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def _renamed(found: Obstruction, vertices: IntArray, triangles: IntArray) -> Obstruction:
    """An obstruction by other numbers of vertices and triangles; its message then names the elements anew."""
    there = replace(
        found,
        vertices=vertices[found.vertices],
        edges=vertices[found.edges],
        triangles=triangles[found.triangles],
        split=vertices[found.split],
    )
    if np.array_equal(vertices, np.arange(len(vertices))) and np.array_equal(triangles, np.arange(len(triangles))):
        return there
    elements = (
        (there.triangles, named("triangle", "triangles", there.triangles)),
        (there.vertices, named("vertex", "vertices", there.vertices)),
        (there.edges, named_edges(there.edges)),
    )
    which = ", ".join(text for array, text in elements if array.size)
    return replace(there, message=f"{found.kind.name.capitalize().replace('_', ' ')}: {which or 'everywhere'}.")
