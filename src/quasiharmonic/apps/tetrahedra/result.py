"""Result of a search for positions of a tetrahedral mesh."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.apps.tetrahedra.certificate import TetrahedraCertificate
from quasiharmonic.apps.tetrahedra.elements import EDGES
from quasiharmonic.util.arrays import FloatArray, IntArray, names_of
from quasiharmonic.util.display import Displayable
from quasiharmonic.util.outcome import Outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class TetrahedraStatus(Enum):
    """Why a search ended; the value is a message for the user."""

    POLISHED = "Every tetrahedron is strictly positive, and the distortion has converged."
    STILL_FALLING = "Every tetrahedron is strictly positive. The distortion was still falling after the last iteration."
    FIRST_VALID = "Every tetrahedron is strictly positive."
    STALLED = (
        "Stalled: some tetrahedra are still inverted and further iterations do not help. No known obstruction forbids "
        "a valid mesh, but this mesh and this target may still allow none."
    )
    OUT_OF_ITERATIONS = "Some tetrahedra were still inverted after the last iteration: allow more iterations."
    OVERLAPPING = "Every tetrahedron is strictly positive, but the mesh overlaps itself: points are covered twice."
    INTERRUPTED = "Interrupted. This is the best mesh so far."
    IMPOSSIBLE = "No valid mesh with these fixed vertices exists. The obstructions are listed."
    CROSSING = "The boundary crosses itself at its target positions, so no valid mesh exists. Nothing was computed."


@dataclass(frozen=True)
class TetrahedraObstruction:
    """A reason why no valid mesh with these fixed vertices exists.

    Attributes
    ----------
    text : str
    vertices : tuple of int
        The vertices of the tetrahedron, edge or triangles, or the free vertex.
    """

    text: str
    vertices: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class TetrahedraResult(Outcome, Displayable):
    """A tetrahedral mesh with some fixed vertices; returned by `morph` and `injective_tetrahedra`.

    Attributes
    ----------
    points : (n, 3) float64
        All vertices; those in no tetrahedron keep their positions.
    T : (t, 4) int64
        The tetrahedra in the given order, positive at rest.
    certificate : TetrahedraCertificate
        The exact certificate of ``points``.
    status : TetrahedraStatus
    obstructions : tuple of TetrahedraObstruction
        Reasons that were found why no valid mesh exists; at most 20.
    forbidden : (k,) int64
        Inverted or degenerate tetrahedra whose four vertices are fixed.
    sliding : (k,) int64
        Boundary vertices that were free to slide; none unless ``slide`` was given.
    iterations : int
        Newton steps.
    seconds : float
    energy : float
        Mean isotropic energy relative to the rest mesh, 1 for a rotation; infinite if a tetrahedron is not positive.
    quality_before, quality_after : (t,) float64
        `tetrahedron_quality` of every tetrahedron.
    points_before : (n, 3) float64
        All vertices before the morph.
    """

    points: FloatArray
    T: IntArray
    certificate: TetrahedraCertificate
    status: TetrahedraStatus
    obstructions: tuple[TetrahedraObstruction, ...]
    forbidden: IntArray
    sliding: IntArray
    iterations: int
    seconds: float
    energy: float
    quality_before: FloatArray
    quality_after: FloatArray
    points_before: FloatArray

    @property
    def inverted(self) -> IntArray:
        """Tetrahedra that are inverted or degenerate, ascending."""
        return np.union1d(self.certificate.inverted, self.certificate.degenerate)

    @property
    def valid(self) -> bool:
        """Whether every tetrahedron is strictly positive, verified exactly."""
        return self.certificate.positive

    @property
    def success(self) -> bool:
        """Whether the search ended and the mesh is certified injective: positive tetrahedra, no point covered twice."""
        return bool(self.certificate.injective) and self.status is not TetrahedraStatus.INTERRUPTED

    @property
    def n_iterations(self) -> int:
        """Newton steps; equal to ``iterations``."""
        return self.iterations

    def summary(self) -> str:
        """Describe the outcome, the certificate, the obstructions and the quality."""
        lines = [self.status.value, self.certificate.summary()]
        if self.forbidden.size:
            which = names_of("tetrahedron", "tetrahedra", self.forbidden)
            lines.append(f"Inverted or degenerate with four fixed vertices: {which}.")
        lines += [obstruction.text for obstruction in self.obstructions[:5]]
        return "\n".join([*lines, self.describe_quality()])

    def short_repr(self) -> str:
        """Return the first line of `summary`."""
        return self.message

    def describe_quality(self) -> str:
        """Return a sentence on the quality before and after, and where to remesh if it has become poor."""
        return describe_qualities("tetrahedron", self.T, self.points, self.quality_before, self.quality_after)

    def plot(self) -> Figure:
        """Draw a cut through the mesh before and after, coloured by quality, and histograms of the quality.

        The cut is through the worst tetrahedron of the mesh after, normal to the shortest side of its bounding box.

        Returns
        -------
        matplotlib Figure
            Inverted tetrahedra are red. Notebooks display the figure directly.
        """
        return self._draw("quality")

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return {
            **super().to_dict(),
            "valid": self.valid,
            "forbidden": self.forbidden.tolist(),
            "obstructions": [{"text": o.text, "vertices": list(o.vertices)} for o in self.obstructions],
            "iterations": self.iterations,
            "energy": self.energy if np.isfinite(self.energy) else None,
            **summarise_qualities(self.quality_before, self.quality_after),
        }


def describe_qualities(what: str, F: IntArray, points: FloatArray, before: FloatArray, after: FloatArray) -> str:
    """Return a sentence on the qualities of elements before and after, and where to remesh if they have become poor."""
    if not len(after):
        return "no elements"
    worst = int(after.argmin())
    text = (
        f"{what.capitalize()} quality, 1 at best: worst {before.min():.3g} before and {after[worst]:.3g} "
        f"after ({what} {worst}), mean {before.mean():.3g} before and {after.mean():.3g} after."
    )
    if after[worst] < before.min() / 10:
        place = ", ".join(f"{x:.4g}" for x in points[F[worst]].mean(axis=0))
        text += f" Remesh around ({place}): the worst quality has fallen below a tenth of that before."
    return text


def summarise_qualities(before: FloatArray, after: FloatArray) -> dict[str, dict[str, float]]:
    """Return the minimum, the mean and the worst element of qualities before and after, for JSON."""
    return {
        name: {"minimum": float(quality.min()), "mean": float(quality.mean()), "worst": int(quality.argmin())}
        for name, quality in (("quality_before", before), ("quality_after", after))
    }


def tetrahedron_quality(T: IntArray, X: FloatArray) -> FloatArray:
    """Return the mean ratio of tetrahedra: 1 if regular, 0 without volume, negative if inverted; (t,) float64.

    This is ``12 (3 V)^(2/3) / Σ l²`` with the volume V and the edge lengths l.
    """
    p = X[T] - X[T[:, :1]]
    size = np.abs(p).max(axis=(1, 2))
    p /= np.where(size > 0, size, 1.0)[:, None, None]
    u, v, w = p[:, 1], p[:, 2], p[:, 3]
    volume = (u * np.cross(v, w)).sum(axis=1) / 6
    squares = sum(((p[:, i] - p[:, j]) ** 2).sum(axis=1) for i, j in EDGES)
    ratio = 12 * np.cbrt(3 * np.abs(volume)) ** 2 / np.where(squares > 0, squares, 1.0)
    return np.asarray(np.sign(volume) * ratio)
