"""One state of the page: a problem, its map, and how it was made. Undoing goes from one to another."""

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
from quasiharmonic.ui.studio.recipes import Recipe
from quasiharmonic.util.arrays import FloatArray

#: Obstructions and elements of each that are told; a picture of more says no more.
_MOST_TOLD = 20
_MOST_ELEMENTS = 2000


@dataclass(frozen=True, eq=False)
class SessionState:
    """One state of the page.

    Attributes
    ----------
    problem : Problem
        The boundary's loops one after another, and then pins, held where they are.
    result : MapResult
        Its map.
    recipe : Recipe
    corners : tuple of int
        Boundary vertices at which sides end, in the order of the outline's corners.
    chosen : tuple of (int, int)
        Vertices that the visitor has sent to a corner, and its number.
    """

    problem: Problem
    result: MapResult
    recipe: Recipe
    corners: tuple[int, ...] = ()
    chosen: tuple[tuple[int, int], ...] = ()

    @property
    def pins(self) -> list[int]:
        """Vertices inside that are held, in the order in which they were pinned."""
        edge = sum(map(len, self.problem.domain.loops))
        return [int(v) for v in self.problem.fixed[edge:]]

    @property
    def held(self) -> list[int]:
        """Boundary vertices at corners that somebody has chosen, or their angles: what does not slide."""
        return list(self.corners) if self.recipe.corners == "auto" else [v for v, _ in self.chosen]

    @property
    def in_place(self) -> bool:
        """Whether the map's held vertices are where they are to be."""
        return np.array_equal(self.result.uv[self.problem.fixed], self.problem.target)

    def with_target(self, target: FloatArray) -> SessionState:
        """The same with its held vertices elsewhere, by hand."""
        recipe = replace(self.recipe, outline=None, corners=None, free=False, energy=None, slide=False)
        return replace(self, problem=self.problem.with_target(target), recipe=recipe, chosen=())


class Measured:
    """Numbers about a map; measured now and then while it moves, so that a large one is not held up by them."""

    def __init__(self, V: FloatArray, F: Array) -> None:
        self._V, self._F = V, F
        self._when, self._cost = -np.inf, 0.0
        self.numbers: dict[str, Any] = {}
        self.scale = 1.0

    def look(self, uv: FloatArray, *, now: bool) -> dict[str, Any]:
        """Energy and worst stretch of a map; those of a little while ago unless it has to be ``now``."""
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
    """What is certain about the map that is shown."""
    bad = len(certificate.inverted) + len(certificate.degenerate) + len(certificate.nonfinite)
    return {
        "injective": certificate.injective,
        "bijective": bool(certificate.bijective),
        "flips": bad,
        "verdict": certificate.summary(),
    }


def bad_triangles(certificate: Certificate) -> Array:
    """Triangles that are not positive, (k,) uint32."""
    some = np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])
    return np.sort(some).astype(np.uint32)


def told(moment: SessionState) -> list[dict[str, Any]]:
    """What forbids a map, or a bijective one, as the page marks it."""
    diagnosis, loops = moment.result.diagnosis, moment.problem.domain.loops
    if diagnosis is None:
        return []
    # What has a place of its own tells more than what is said of whole loops.
    found = sorted(diagnosis.obstructions, key=lambda one: not (one.vertices.size or one.edges.size))
    return [
        {
            "message": one.message,
            "advice": one.advice,
            "forbids": one.forbids.value,
            "vertices": one.vertices.tolist()[:_MOST_ELEMENTS],
            "edges": (one.edges.tolist() or _around([loops[k] for k in one.loops]))[:_MOST_ELEMENTS],
            "triangles": one.triangles.tolist()[:_MOST_ELEMENTS],
        }
        for one in found[:_MOST_TOLD]
    ]


def _around(loops: list[Array]) -> list[list[int]]:
    """Edges of loops."""
    return [edge for loop in loops for edge in np.stack([loop, np.roll(loop, -1)], axis=1).tolist()]
