"""An island on the page: its map, its constraints, and its numbers on the page and in the model."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import MIRROR
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.studio.session.outlines import Outline
from quasiharmonic.util.arrays import FloatArray, IntArray


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
        """The mapping problem; AssertionError before there is one."""
        assert self.fixed is not None
        assert self.target is not None
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

    def same(self, other: Numbering | None) -> bool:
        """Return whether another numbering has the same vertices and triangles."""
        return (
            other is not None
            and np.array_equal(self.starts, other.starts)
            and np.array_equal(self.F, other.F)
            and np.array_equal(self.origin, other.origin)
        )
