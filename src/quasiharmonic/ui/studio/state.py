"""State of a page: a model, its seams, the map, its islands, and how it was computed; undo and redo switch states."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import MIRROR
from quasiharmonic.apps.atlas.atlas_verdict import certify as certify_islands
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.studio.recipes import Recipe
from quasiharmonic.ui.studio.surface import PageSurface
from quasiharmonic.ui.studio.validation import Outline
from quasiharmonic.util.arrays import FloatArray, IntArray

# Maps with more islands are not checked for overlaps after each change, because this takes seconds.
_MAX_CHECKED = 2000
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
    # (k, 2): edges of all seams that the next map shall have; None as long as these are the seams of the mesh
    wanted_seams: IntArray | None = None
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
    def is_mirrored(self) -> bool:
        """Whether the only island is mirrored: all its triangles are inverted. Of several islands this is False."""
        if len(self.islands) > 1 or self.active.result is None:
            return False
        certificate = self.active.result.certificate
        return len(certificate.inverted) == certificate.triangles

    @property
    def in_place(self) -> bool:
        """Whether the fixed vertices of the map are at their target positions."""
        return all(one.in_place for one in self.islands)

    @cached_property
    def overlapping(self) -> IntArray:
        """Pairs (p, 2) of islands that share points of the plane."""
        if not self.mapped or len(self.islands) == 1 or len(self.islands) > _MAX_CHECKED:
            return np.empty((0, 2), dtype=np.int64)
        return certify_islands(self.mesh).overlapping

    @property
    def uv(self) -> FloatArray:
        """The map of all islands (n, 2), in the numbering of the page; NaN for islands without a map.

        It is not stored, because the history has many states.
        """
        return np.concatenate([one.island.uv for one in self.islands])

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

    def select_all(self) -> SessionState:
        """Return the state with all islands selected."""
        return replace(self, selected=tuple(range(len(self.islands))))

    def with_island(self, k: int, island: IslandState) -> SessionState:
        """Return the state with another island of index ``k``; the mesh is unchanged."""
        islands = (*self.islands[:k], island, *self.islands[k + 1 :])
        return replace(self, islands=islands)

    def __getstate__(self) -> dict[str, Any]:
        """Return the contents for a snapshot; what can be computed again is left out."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def __setstate__(self, contents: dict[str, Any]) -> None:
        """Take the contents of a snapshot; in older ones `wanted_seams` has the name ``drawn``."""
        vars(self).update({"wanted_seams" if name == "drawn" else name: value for name, value in contents.items()})


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
