"""State of a page: a model, its seams, the map, its islands, and how it was computed; undo and redo switch states."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import MIRROR
from quasiharmonic.apps.atlas.atlas_verdict import certify as certify_islands
from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.recipes import Recipe
from quasiharmonic.ui.studio.surface import PageSurface
from quasiharmonic.ui.studio.validation import Outline
from quasiharmonic.util.arrays import FloatArray, IntArray


class StateLimits(NamedTuple):
    """Limits of the state that is sent to the page."""

    # Maximum numbers of obstructions and of elements per obstruction.
    obstructions: int = 20
    elements: int = 2000
    # Islands above this number are not checked for overlaps with each other after each change.
    checked: int = 2000


_LIMITS = StateLimits()
_NO_MAP = "there is no map yet: unwrap or flatten the model first"


@dataclass(frozen=True, eq=False)
class SessionState:
    """State of a page."""

    sheet: PageSurface
    mesh: SeamedMesh  # The surface with its seams and its map
    islands: tuple[IslandState, ...]  # Those of the mesh, in its order
    recipe: Recipe  # How the map was computed
    selected: tuple[int, ...] = (0,)  # Indices of the selected islands, ascending, at least one
    from_file: bool = True  # Whether the seams are those of the file
    drawn: IntArray | None = None  # (k, 2): edges of the seams that the user drew, if they changed
    forbidden: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))  # (k, 2): never seams

    @cached_property
    def numbering(self) -> Numbering:
        """Numbers of vertices and triangles on the page."""
        return Numbering(self.mesh, self.islands)

    @property
    def active(self) -> IslandState:
        """The first selected island."""
        return self.islands[self.selected[0]]

    @property
    def mapped(self) -> bool:
        """Whether every island has a map."""
        return all(one.result is not None for one in self.islands)

    @property
    def injective(self) -> bool:
        """Whether every island has a map without inverted triangles."""
        return all(one.injective for one in self.islands)

    @property
    def in_place(self) -> bool:
        """Whether the fixed vertices of the map are at their target positions."""
        return all(one.in_place for one in self.islands)

    @cached_property
    def overlapping(self) -> IntArray:
        """Pairs (p, 2) of islands that share points of the plane."""
        if not self.mapped or len(self.islands) == 1 or len(self.islands) > _LIMITS.checked:
            return np.empty((0, 2), dtype=np.int64)
        return certify_islands(self.mesh).overlapping

    @property
    def uv(self) -> FloatArray:
        """The map of all islands (n, 2), in the numbering of the page."""
        return np.concatenate([place(one) for one in self.islands])

    @cached_property
    def signs(self) -> FloatArray:
        """Factors (n, 2) from the map on the page to one in which mirrored islands are reflected."""
        return np.concatenate([np.broadcast_to(one.sign, one.island.uv.shape) for one in self.islands])

    # --- the first selected island ------------------------------------------------------------------------------------

    @property
    def result(self) -> MapResult:
        """The result of the active island; ValueError before there is one."""
        if self.active.result is None:
            raise ValueError(_NO_MAP)
        return self.active.result

    @property
    def problem(self) -> Problem:
        """The problem of the active island."""
        return self.active.problem

    @property
    def pins(self) -> list[int]:
        """Fixed interior vertices, in the numbering of the page."""
        return self._numbers([one.pins for one in self.islands])

    @property
    def corners(self) -> list[int]:
        """Corners of all islands, in the numbering of the page."""
        return self._numbers([one.corners for one in self.islands])

    def _numbers(self, vertices: list[tuple[int, ...]]) -> list[int]:
        """Return vertices of each island in the numbering of the page."""
        return [int(v + start) for some, start in zip(vertices, self.numbering.starts, strict=False) for v in some]

    def with_island(self, k: int, island: IslandState) -> SessionState:
        """Return the state with another island of index ``k``; the mesh is unchanged."""
        islands = (*self.islands[:k], island, *self.islands[k + 1 :])
        return replace(self, islands=islands)

    def __getstate__(self) -> dict[str, Any]:
        """Return the contents for a snapshot; what can be computed again is left out."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


def place(one: IslandState) -> FloatArray:
    """Return the map (m, 2) of an island on the page; NaN if it has none."""
    return one.island.uv if one.result is None else one.result.uv * one.sign


class DistortionMonitor:
    """Distortion of a moving map; measured only now and then, so that large maps stay responsive."""

    def __init__(self, V: FloatArray, F: Array) -> None:
        self._V, self._F = V, F
        self._when, self._cost = -np.inf, 0.0
        self._numbers: dict[str, Any] = {}

    def look(self, uv: FloatArray, reflected: FloatArray, *, now: bool) -> dict[str, Any]:
        """Return energy, worst stretch, used space and scale of a map; recent values unless ``now`` is True.

        ``reflected`` is the map with mirrored islands reflected.
        """
        began = time.perf_counter()
        if now or began - self._when > max(0.15, 8 * self._cost):
            measured = distortion(self._V, self._F, reflected)
            defined = ~np.isnan(measured.isometric)
            with np.errstate(invalid="ignore"):
                energy = float(measured.share[defined] @ measured.symmetric_dirichlet[defined])
            worst = float(measured.isometric[defined].max()) if defined.any() else np.inf
            self._numbers = {
                "energy": energy if np.isfinite(energy) else None,
                "worst": worst if np.isfinite(worst) else None,
                "used": _find_used_space(self._F, uv),
                "packed": bool(uv.min() >= 0 and uv.max() <= 1),
                "scale": measured.scale if np.isfinite(measured.scale) else 1.0,
            }
            self._when = time.perf_counter()
            self._cost = self._when - began
        return self._numbers


def _find_used_space(F: Array, uv: FloatArray) -> float | None:
    """Return the share of the unit square that the map covers; if the map leaves the square, that of its box."""
    a, b, c = (uv[F[:, k]] for k in range(3))
    area = float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)
    low, high = uv.min(axis=0), uv.max(axis=0)
    box = 1.0 if low.min() >= 0 and high.max() <= 1 else float(np.prod(high - low))
    return area / box if box > 0 and np.isfinite(area / box) else None


def verdict(certificates: list[Certificate], overlapping: int) -> dict[str, Any]:
    """Return the certificates of all islands as entries of a message."""
    bad = sum(len(one.inverted) + len(one.degenerate) + len(one.nonfinite) for one in certificates)
    bijective = [bool(one.bijective) for one in certificates]
    if len(certificates) == 1:
        words = certificates[0].summary()
    else:
        words = f"{len(bijective)} islands: {sum(one.injective for one in certificates)} injective, {sum(bijective)} "
        pairs = f"{overlapping} {'pairs overlap' if overlapping > 1 else 'pair overlaps'}"
        words += f"bijective. {pairs if overlapping else 'No two overlap'}."
    return {
        "injective": all(one.injective for one in certificates),
        "bijective": all(bijective) and not overlapping,
        "overlapping": overlapping,
        "flips": bad,
        "verdict": words,
    }


def bad_triangles(certificates: list[Certificate]) -> Array:
    """Return the triangles that are not positive, (k,) uint32, in the numbering of the page."""
    start, found = 0, [np.empty(0, dtype=np.int64)]
    for one in certificates:
        found += [one.inverted + start, one.degenerate + start, one.nonfinite + start]
        start += one.triangles
    return np.sort(np.concatenate(found)).astype(np.uint32)


def describe_obstructions(state: SessionState) -> list[dict[str, Any]]:
    """Return the obstructions to a map, or to a bijective map, as the page marks them."""
    found = []
    for one, start, first in zip(
        state.islands, state.numbering.starts.tolist(), state.numbering.first_triangles.tolist(), strict=False
    ):
        diagnosis = None if one.result is None else one.result.diagnosis
        if diagnosis is None:
            continue
        loops = one.problem.domain.loops
        # Obstructions with vertices or edges are more specific than those of whole loops.
        for each in sorted(diagnosis.obstructions, key=lambda one: not (one.vertices.size or one.edges.size)):
            edges = each.edges if each.edges.size else np.array(_around([loops[k] for k in each.loops]), dtype=np.int64)
            found.append(
                {
                    "message": each.message,
                    "advice": each.advice,
                    "forbids": each.forbids.value,
                    "vertices": (each.vertices + start).tolist()[: _LIMITS.elements],
                    "edges": (edges.reshape(-1, 2) + start).tolist()[: _LIMITS.elements],
                    "triangles": (each.triangles + first).tolist()[: _LIMITS.elements],
                }
            )
    if found and state.recipe.dragged:
        return [_describe_drag(found)]
    return found[: _LIMITS.obstructions]


def _describe_drag(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what a drag did, in place of the obstructions that follow from it."""
    crossing = any(one["edges"] and "crosses itself" in one["message"] for one in found)
    what = (
        "another side, so the boundary crosses itself" if crossing else "the opposite side, so the map is turned over"
    )
    return {**found[0], "message": f"It was dragged across {what}.", "advice": "Drag it back.", "undo": True}


def _around(loops: list[Array]) -> list[list[int]]:
    """Return the edges of loops."""
    return [edge for loop in loops for edge in np.stack([loop, np.roll(loop, -1)], axis=1).tolist()]


@dataclass(eq=False)
class IslandState:
    """One island; it is not changed, except for what it computes once.

    Its result and its problem belong to the reflection of the island if it is mirrored.
    """

    island: Island
    mirrored: bool = False
    result: MapResult | None = None  # Its map; None before there is one
    fixed: IntArray | None = None  # (k,): the fixed vertices of the problem; None before there is one
    target: FloatArray | None = None  # (k, 2): their target positions
    pins: tuple[int, ...] = ()  # Fixed interior vertices, in the order in which they were pinned
    outline: Outline | None = None  # The outline of the boundary; None if it was moved since, or is free
    corners: tuple[int, ...] = ()  # Boundary vertices at which sides end, in the order of the outline's corners
    # Vertices that the user assigned to a corner, and the numbers of the corners
    chosen: tuple[tuple[int, int], ...] = ()
    by_angle: bool = False  # Whether the corners were found by angle

    @cached_property
    def problem(self) -> Problem:
        """The mapping problem; ValueError before there is one."""
        if self.fixed is None or self.target is None:
            raise ValueError(_NO_MAP)
        return Problem(self.island.V, self.island.F, self.fixed, self.target)

    @cached_property
    def loops(self) -> list[IntArray]:
        """Boundary loops; empty if the boundary is not simple."""
        try:
            return boundary_loops(self.island.F, len(self.island.V))
        except ValueError:
            return []

    @property
    def sign(self) -> FloatArray:
        """Factor (2,) from the positions of the result to those on the page, and back."""
        return MIRROR if self.mirrored else np.ones(2)

    @property
    def injective(self) -> bool:
        """Whether there is a map without inverted triangles."""
        return self.result is not None and self.result.injective

    @property
    def in_place(self) -> bool:
        """Whether the fixed vertices of the map are at their target positions."""
        if self.result is None or self.fixed is None or self.target is None:
            return True
        return np.array_equal(self.result.uv[self.fixed], self.target)

    def with_problem(self, problem: Problem) -> IslandState:
        """Return the island with another problem, whose analyses are kept."""
        other = replace(self, fixed=problem.fixed, target=problem.target)
        # Stored, so that they are not computed again.
        other.problem, other.loops = problem, self.loops
        return other

    def with_target(self, target: FloatArray) -> IslandState:
        """Return the island with other target positions, as after a drag; it then has no outline."""
        return replace(self.with_problem(self.problem.with_target(target)), outline=None, chosen=(), by_angle=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return the contents for a snapshot; what can be computed again is left out."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


class Numbering:
    """Numbers of vertices and triangles on the page: those of one island after another."""

    def __init__(self, mesh: SeamedMesh, islands: tuple[IslandState, ...]) -> None:
        self.starts = np.cumsum([0, *(len(one.island.vertices) for one in islands)])
        self.first_triangles = np.cumsum([0, *(len(one.island.F) for one in islands)])
        self.origin = np.concatenate([one.island.vertices for one in islands])
        self.F = np.concatenate([one.island.F + start for one, start in zip(islands, self.starts, strict=False)])
        self.V = mesh.V[self.origin]

    def find(self, vertex: int) -> tuple[int, int]:
        """Return island and own number of a vertex of the page."""
        k = int(np.searchsorted(self.starts, vertex, side="right")) - 1
        return k, vertex - int(self.starts[k])

    def equals(self, other: Numbering | None) -> bool:
        """Return whether another numbering has the same vertices and triangles."""
        return (
            other is not None
            and np.array_equal(self.starts, other.starts)
            and np.array_equal(self.F, other.F)
            and np.array_equal(self.origin, other.origin)
        )
