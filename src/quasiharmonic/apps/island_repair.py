"""Repair of one island, patch by patch.

    inverted triangles ──▶ free vertices within some rings of them ──▶ a map of each patch with fixed boundary ─┐
            ▲                                                                                                   │
            └────────────────── more rings ◀────────── unchanged ◀──────── no map found ◀───────────────────────┤
                  other vertices polished ◀── vertices returned to old positions ◀── found ◀────────────────────┘

Each patch either becomes positive on all its triangles or stays unchanged, so a repair never makes a map worse. The
last patch is the whole island.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.coarsening import mark_rings
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.splitting import fans, renumber
from quasiharmonic.geometry.mesh.topology import boundary_edges, components
from quasiharmonic.io.seamed_mesh import Island
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis, diagnose
from quasiharmonic.problem.diagnosis.obstruction import Obstruction, renumber_obstruction
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.solver.mapping import solve_problem
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, edge_names, mark, names_of
from quasiharmonic.util.options import MapOptions, PolishOptions, RepairOptions


class IslandRepairTuning(NamedTuple):
    """Numbers that tune the patches of an island."""

    # Numbers of rings of free vertices around inverted triangles, tried in turn.
    rings: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
    # Maximum share of free vertices in the interior of the island.
    max_share: float = 0.5
    # Iterations on a patch other than the whole island.
    patch_iterations: int = 100


_TUNING = IslandRepairTuning()


class IslandRepair:
    """The repair of one island of a mesh with vertices ``V``; the vertices ``fixed`` and the boundary stay unchanged.

    Attributes
    ----------
    uv : (m, 2) float64
        Current positions of the island's vertices.
    reason : str
        Why triangles are still inverted; empty before this is known.
    diagnosis : Diagnosis or None
        The obstruction to a map, in the mesh's numbering.
    n_iterations : int
        Iterations of all searches and descents so far.
    """

    def __init__(self, V: FloatArray, island: Island, fixed: IntArray, options: RepairOptions) -> None:
        self.island = island
        self.uv = island.uv.copy()
        self.reason = ""
        self.diagnosis: Diagnosis | None = None
        self.n_iterations = 0
        self._F, self._V = island.F, V[island.vertices]
        self._fixed = mark(len(self.uv), boundary_edges(self._F, len(self.uv)))
        self._fixed |= np.isin(island.vertices, fixed)
        self._options = options
        # Vertices with more inverted triangles are more likely to be misplaced, and return to their positions last.
        suspicion = np.bincount(self._F[self.inverted].ravel(), minlength=len(self.uv))
        self._innocence = np.argsort(np.argsort(-suspicion, kind="stable"))

    @property
    def inverted(self) -> IntArray:
        """The island's triangles that are not strictly positive, ascending."""
        return inverted_triangles(self._F, self.uv)

    @property
    def moved_mask(self) -> BoolArray:
        """Which of the island's vertices have moved; (m,) bool."""
        return np.asarray((self.uv != self.island.uv).any(axis=1) & ~(np.isnan(self.uv).any(axis=1)))

    def run(self) -> None:
        """Repair the island: first by patches, unless it is to be mapped as a whole, then as a whole."""
        tried: set[bytes] = set()
        whole = self._options.whole
        for rings in () if whole else _TUNING.rings:
            free = self._find_near(self._find_repairable(), rings)
            if not 0 < np.count_nonzero(free) <= _TUNING.max_share * np.count_nonzero(~self._fixed):
                break
            for patch in self._components(free):
                if patch.tobytes() not in tried:
                    tried.add(patch.tobytes())
                    self._attempt(patch, _TUNING.patch_iterations, keep=True)
        if self._find_repairable().size:
            for part in self._components(~self._fixed):
                if inverted_triangles(self._F[part[self._F].any(axis=1)], self.uv).size:
                    self._attempt(part, self._options.max_iterations, keep=not whole)
        if self.inverted.size:
            self._explain()

    def _find_repairable(self) -> IntArray:
        """Inverted triangles that have a free vertex."""
        left = self.inverted
        return left[~self._fixed[self._F[left]].all(axis=1)]

    def _find_near(self, triangles: IntArray, rings: int) -> BoolArray:
        """Interior vertices within a number of rings of triangles; the triangles' own vertices are the first ring."""
        return mark_rings(self._F, mark(len(self.uv), self._F[triangles]), rings - 1) & ~self._fixed

    def _components(self, free: BoolArray) -> Iterator[BoolArray]:
        """Split free vertices into the sets that edges connect."""
        among = free[self._F]
        touched = among.any(axis=1)
        # In every triangle, fixed vertices are replaced by a free one, so that triangles join free vertices only.
        one = np.take_along_axis(self._F, among.argmax(axis=1)[:, None], axis=1)
        label = components(np.where(among, self._F, one)[touched], len(free))
        for first in np.unique(label[free]):
            yield free & (label == first)

    def _patch(self, free: BoolArray) -> tuple[Problem, IntArray, IntArray]:
        """Return the patch of triangles at free vertices, and the island's indices of its vertices and triangles.

        Its other vertices are fixed. If its boundary passes through a vertex several times, the patch has several
        copies of the vertex.
        """
        triangles = np.flatnonzero(free[self._F].any(axis=1))
        F, first = renumber(fans(self._F[triangles])[0], self._F[triangles])
        vertices = self._F[triangles].ravel()[first]
        fixed = np.flatnonzero(~free[vertices])
        problem = Problem(self._V[vertices], F, fixed, self.uv[vertices[fixed]], reference="equilateral")
        return problem, vertices, triangles

    def _attempt(self, free: BoolArray, iterations: int, *, keep: bool) -> None:
        """Map a patch again; if this fails, nothing changes.

        With ``keep``, vertices return to their old positions if this inverts no triangle.
        """
        try:
            problem, vertices, triangles = self._patch(free)
        except ValueError as error:
            self.reason = str(error)
            return
        # Tutte's embedding suffices for most patches. If it fails, the diagnosis shows whether a map can exist.
        for allowed in (1, iterations):
            options = MapOptions(
                max_iterations=allowed, linear_solver=self._options.linear_solver, callback=self._options.callback
            )
            result = solve_problem(problem, options)
            if self._count(result).injective:
                self._use_map(free, vertices, result.uv, keep)
                return
            self.reason = result.status.value
            if result.diagnosis is not None:
                self._store_diagnosis(result.diagnosis, vertices, triangles)
                if result.diagnosis.forbids_injective:
                    return

    def _use_map(self, free: BoolArray, vertices: IntArray, uv: FloatArray, keep: bool) -> None:
        """Use a patch's map; undo it if triangles wind several times around a vertex."""
        before = self.uv.copy()
        self.uv[vertices] = uv
        self._polish(self._restore(free) if keep else free)
        if not np.array_equal(free, ~self._fixed) and self._is_multiply_wound(free):
            self.uv = before
            self.reason = (
                "The maps found for a part of the island wind more than once around one of its vertices. Flatten the "
                "island again."
            )

    def _restore(self, moved: BoolArray) -> BoolArray:
        """Return vertices to their old positions where possible; return the mask of those that stay moved."""
        moved, start = moved.copy(), self.island.uv
        F = self._F[moved[self._F].any(axis=1)]
        able = np.asarray(np.isfinite(start).all(axis=1))
        while True:
            back = moved & able
            for i in range(3):
                rows = F[moved[F[:, i]] & able[F[:, i]]]
                a, b, c = start[rows[:, i]], self.uv[rows[:, i - 2]], self.uv[rows[:, i - 1]]
                back[rows[orientation(a, b, c) <= 0, i]] = False
            # Two vertices of a triangle must not return at once; take the one that is least likely to be misplaced.
            turn = np.where(back, self._innocence, -1)
            first = turn[F].max(axis=1)
            for i in range(3):
                back[F[turn[F[:, i]] < first, i]] = False
            if not back.any():
                return moved
            self.uv[back] = start[back]
            moved &= ~back

    def _polish(self, free: BoolArray) -> None:
        """Lower the distortion of free vertices' triangles, for patches without degenerate rest triangles."""
        for part in self._components(free):
            problem, vertices, _ = self._patch(part)
            if not rest_shapes(problem.V, problem.F).flat.size:
                options = PolishOptions(linear_solver=self._options.linear_solver, callback=self._options.callback)
                polished = polish_map(problem.domain, self.uv[vertices], options)
                self.uv[vertices] = self._count(polished).uv

    def _count(self, result: MapResult) -> MapResult:
        """Count a result's iterations and return it; if Ctrl-C ended it, raise KeyboardInterrupt to end the repair."""
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        self.n_iterations += result.n_iterations
        return result

    def _is_multiply_wound(self, free: BoolArray) -> bool:
        """Whether triangles wind more than once around an interior vertex of the patch; positive triangles can do so.

        Boundary vertices are not checked, because the fixed boundary may force this.
        """
        patch = mark(len(self.uv), self._F[free[self._F].any(axis=1)])
        around = self._F[patch[self._F].any(axis=1)]
        F, first = renumber(fans(around)[0], around)
        found = certify(F, self.uv[around.ravel()[first]])
        return bool(found.multiply_wound.size and np.setdiff1d(found.multiply_wound, np.concatenate(found.loops)).size)

    def _explain(self) -> None:
        """Set the reason for remaining inverted triangles, unless an attempt already has."""
        island, left = self.island, self.inverted
        nowhere = np.flatnonzero(self._fixed & ~np.isfinite(self.uv).all(axis=1))
        corners = island.vertices[self._F]
        twice = np.flatnonzero((np.roll(corners, 1, axis=1) == corners).any(axis=1))
        if nowhere.size:
            which = names_of("vertex", "vertices", island.vertices[nowhere])
            self.reason = f"No finite position for the boundary {which}. Give it one, or flatten the island again."
        elif twice.size:
            which = names_of("triangle", "triangles", island.triangles[twice])
            self.reason = f"A vertex is used twice in {which}. Remove such triangles with clean."
        elif self._fixed[self._F[left]].all(axis=1).any():
            # Triangles with three boundary vertices belong to no patch.
            boundary = np.flatnonzero(self._fixed)
            problem = Problem(self._V, self._F, boundary, self.uv[boundary], reference="equilateral")
            self._store_diagnosis(diagnose(problem), np.arange(len(self.uv)), np.arange(len(self._F)))

    def _store_diagnosis(self, found: Diagnosis, vertices: IntArray, triangles: IntArray) -> None:
        """Store a patch's diagnosis in the mesh's numbering."""
        vertices, triangles = self.island.vertices[vertices], self.island.triangles[triangles]
        self.diagnosis = replace(
            found, obstructions=tuple(_renumber(o, vertices, triangles) for o in found.obstructions)
        )
        if found.forbids_injective:
            self.reason = self.diagnosis.summary()


def _renumber(found: Obstruction, vertices: IntArray, triangles: IntArray) -> Obstruction:
    """Renumber the elements of an obstruction; its message then names the new numbers."""
    there = renumber_obstruction(found, vertices, triangles)
    if np.array_equal(vertices, np.arange(len(vertices))) and np.array_equal(triangles, np.arange(len(triangles))):
        return there
    elements = (
        (there.triangles, names_of("triangle", "triangles", there.triangles)),
        (there.vertices, names_of("vertex", "vertices", there.vertices)),
        (there.edges, edge_names(there.edges)),
    )
    which = ", ".join(text for array, text in elements if array.size)
    return replace(there, message=f"{found.kind.name.capitalize().replace('_', ' ')}: {which or 'everywhere'}.")
