"""State of a page: a problem, its map, and how it was computed. Undo and redo switch between states."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.session.recipes import Recipe
from quasiharmonic.util.arrays import FloatArray

#: Maximum numbers of obstructions and of elements per obstruction that are sent to the page.
_MAX_OBSTRUCTIONS = 20
_MAX_ELEMENTS = 2000


@dataclass(frozen=True, eq=False)
class SessionState:
    """State of a page."""

    problem: Problem  # Its fixed vertices are the boundary loops, one after another, and then the pins
    result: MapResult  # Its map
    recipe: Recipe
    corners: tuple[int, ...] = ()  # Boundary vertices at which sides end, in the order of the outline's corners
    # Vertices that the user assigned to a corner, and the numbers of the corners
    chosen: tuple[tuple[int, int], ...] = ()

    @property
    def pins(self) -> list[int]:
        """Fixed interior vertices, in the order in which they were pinned."""
        edge = sum(map(len, self.problem.domain.loops))
        return [int(v) for v in self.problem.fixed[edge:]]

    @property
    def held(self) -> list[int]:
        """Boundary vertices at chosen or detected corners, which do not slide."""
        return list(self.corners) if self.recipe.corners == "auto" else [v for v, _ in self.chosen]

    @property
    def in_place(self) -> bool:
        """Whether the fixed vertices of the map are at their target positions."""
        return np.array_equal(self.result.uv[self.problem.fixed], self.problem.target)

    def with_target(self, target: FloatArray) -> SessionState:
        """Return the state with other target positions, as after a drag."""
        recipe = replace(self.recipe, outline=None, corners=None, free=False, energy=None, slide=False)
        return replace(self, problem=self.problem.with_target(target), recipe=recipe, chosen=())


class DistortionMonitor:
    """Distortion of a moving map; measured only now and then, so that large maps stay responsive."""

    def __init__(self, V: FloatArray, F: Array) -> None:
        self._V, self._F = V, F
        self._when, self._cost = -np.inf, 0.0
        self.numbers: dict[str, Any] = {}
        self.scale = 1.0

    def look(self, uv: FloatArray, *, now: bool) -> dict[str, Any]:
        """Return energy and worst stretch of a map; recent values unless ``now`` is True."""
        began = time.perf_counter()
        if now or began - self._when > max(0.15, 8 * self._cost):
            measured = distortion(self._V, self._F, uv)
            defined = ~np.isnan(measured.isometric)
            with np.errstate(invalid="ignore"):
                energy = float(measured.share[defined] @ measured.symmetric_dirichlet[defined])
            worst = float(measured.isometric[defined].max()) if defined.any() else np.inf
            self.numbers = {
                "energy": energy if np.isfinite(energy) else None,
                "worst": worst if np.isfinite(worst) else None,
            }
            self.scale = measured.scale if np.isfinite(measured.scale) else 1.0
            self._when = time.perf_counter()
            self._cost = self._when - began
        return self.numbers


def verdict(certificate: Certificate) -> dict[str, Any]:
    """Return the certificate as entries of a message."""
    bad = len(certificate.inverted) + len(certificate.degenerate) + len(certificate.nonfinite)
    return {
        "injective": certificate.injective,
        "bijective": bool(certificate.bijective),
        "flips": bad,
        "verdict": certificate.summary(),
    }


def bad_triangles(certificate: Certificate) -> Array:
    """Return the triangles that are not positive, (k,) uint32."""
    some = np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])
    return np.sort(some).astype(np.uint32)


def describe_obstructions(state: SessionState) -> list[dict[str, Any]]:
    """Return the obstructions to a map, or to a bijective map, as the page marks them."""
    diagnosis, loops = state.result.diagnosis, state.problem.domain.loops
    if diagnosis is None:
        return []
    # Obstructions with vertices or edges are more specific than those of whole loops.
    found = sorted(diagnosis.obstructions, key=lambda one: not (one.vertices.size or one.edges.size))
    return [
        {
            "message": one.message,
            "advice": one.advice,
            "forbids": one.forbids.value,
            "vertices": one.vertices.tolist()[:_MAX_ELEMENTS],
            "edges": (one.edges.tolist() or _around([loops[k] for k in one.loops]))[:_MAX_ELEMENTS],
            "triangles": one.triangles.tolist()[:_MAX_ELEMENTS],
        }
        for one in found[:_MAX_OBSTRUCTIONS]
    ]


def _around(loops: list[Array]) -> list[list[int]]:
    """Return the edges of loops."""
    return [edge for loop in loops for edge in np.stack([loop, np.roll(loop, -1)], axis=1).tolist()]
