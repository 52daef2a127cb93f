"""What a solver hands back: the map, the verdict on it, and what was done to get there."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.mesh.refinement import Refined
from quasiharmonic.util.arrays import ReadOnly
from quasiharmonic.util.display import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from quasiharmonic.problem.diagnosis import Diagnosis


class Status(Enum):
    """What happened, and what to do next; the value is a sentence for the user."""

    INJECTIVE = "Every triangle is strictly positive, verified exactly."
    STALLED = (
        "Stalled: some triangles are still inverted and the energy has converged to a positive value. "
        "No known obstruction forbids a map, but this mesh and this target may still allow none."
    )
    IMPOSSIBLE = (
        "No such map exists for this mesh and this target. The diagnosis names the obstructions and how to remove "
        "them. This is the best map found."
    )
    OUT_OF_ITERATIONS = (
        "Some triangles were still inverted after the last iteration. "
        "The energy was still falling: allow more iterations."
    )
    INTERRUPTED = "Interrupted. This is the best map so far."
    ROUNDED = (
        "The map is injective in the solver's own coordinates, but its smallest triangles invert when the "
        "positions are rounded to double precision at the target's offset. Move the target nearer to the origin."
    )
    POLISHED = (
        "Every triangle is strictly positive, verified exactly, and the distortion has converged: "
        "no small change of the map lowers it noticeably."
    )
    STILL_FALLING = (
        "Every triangle is strictly positive, verified exactly. The distortion was still falling after the last "
        "iteration: allow more iterations to lower it further."
    )
    EXHAUSTED = (
        "Every triangle is strictly positive, verified exactly. Double precision limits the distortion: it has no "
        "better map near this one. If energy='mips' has left tiny triangles, use energy='symmetric-dirichlet'. "
        "Another linear_solver may also lower the distortion further."
    )
    COLLAPSED = (
        "Every triangle is strictly positive, verified exactly, but the map has collapsed: it stretches triangles far "
        "more than this surface requires, and no other start has led to a better map. Use more cuts (find_cuts with "
        "a smaller min_gain), give an initial map (start), or use energy='symmetric-dirichlet'."
    )
    NEARBY = (
        "Every triangle is strictly positive, verified exactly. The distortion has converged under the condition that "
        "this frame stays close to the frames before and after it."
    )
    UNIMPROVED = (
        "Every triangle is strictly positive, verified exactly, but the map is unchanged: no injective map with less "
        "distortion was found. A smaller eta may help."
    )
    PRECISION_LIMIT = (
        "A finer mesh has a map, but double precision cannot express it at the vertices listed: the target is too "
        "narrow there. Move the target nearer to the origin, or widen it."
    )
    TOO_MANY_SPLITS = (
        "A finer mesh has a map, but it needs too many new vertices: pins and holes lie in another order than in the "
        "mesh. Use fewer pins, or place them in the order of the mesh. This is the best map of the input mesh."
    )
    UNSOLVABLE = (
        "No linear solver could factor the system. This is the best map so far. "
        "Another linear solver or reference triangle may help."
    )


@dataclass(frozen=True)
class Stage:
    """One thing that ran, and what it brought.

    Attributes
    ----------
    name : str
        What ran, in words a log can show.
    iterations : int
        Evaluations of the objective; the very first one of all, the start, is not counted.
    seconds : float
    inverted : tuple of int
        Triangles not strictly positive before and after.
    energy : tuple of float
        V₃ over the target's area before and after (dimensionless); for a polish, the mean energy.
    kept : bool
        Whether its result was taken on; what makes a map worse is discarded.
    """

    name: str
    iterations: int
    seconds: float
    inverted: tuple[int, int]
    energy: tuple[float, float]
    kept: bool = True

    def __str__(self) -> str:
        before, after = (f"{flips:,}" for flips in self.inverted)
        kept = "" if self.kept else ", discarded"
        return f"{self.name}: {self.iterations} iterations, {self.seconds:.3g} s, {before} → {after} inverted{kept}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "inverted": list(self.inverted),
            # JSON has no infinity: before the first stage there is no energy.
            "energy": [e if isfinite(e) else None for e in self.energy],
            "kept": self.kept,
        }


@dataclass(frozen=True)
class Step:
    """One line of the history: the state of the map at one iteration.

    Attributes
    ----------
    iteration : int
    inverted : int
        Triangles whose area, in floating point, is not positive.
    energy : float
        V₃ over the target's area: dimensionless, 0 only at injective maps, and the smaller the nearer. In a
        polish, the mean energy.
    """

    iteration: int
    inverted: int
    energy: float


@dataclass(frozen=True)
class Snapshot:
    """The map at one iteration; flips and energy are ``history[iteration]``.

    Attributes
    ----------
    iteration : int
    uv : (n, 2) float64
    """

    iteration: int
    uv: NDArray[np.float64]


@dataclass(frozen=True)
class RefinementAttempt:
    """One rung of the ladder that `injective_map` climbs with ``refine``.

    Attributes
    ----------
    name : str
        What was mapped: the mesh as given, or with which edges split.
    added : int
        Vertices that the mesh had more than the one given, after those were taken out that the map did not need.
    injective : bool
        Whether its map is (certified).
    seconds : float
    """

    name: str
    added: int
    injective: bool
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"name": self.name, "added": self.added, "injective": self.injective, "seconds": self.seconds}


@dataclass(frozen=True, repr=False)
class MapResult(ReadOnly, Displayable):
    """A map of the mesh into the plane.

    Attributes
    ----------
    uv : (n, 2) float64
        Positions, the fixed vertices exactly at their target. Yours to write to: the certificate has a copy
        of its own, and stays about that.
    status : Status
        What happened and what to do next.
    certificate : Certificate
        The exact verdict on ``uv``.
    stages : list of Stage
        What ran, how long, what it brought.
    history : list of Step
        Flips and energy at every iteration.
    diagnosis : Diagnosis or None
        What forbids a map, examined where none was found.
    linear_solver : str
        The backend that solved the linear systems.
    seconds : float
        Wall time from the call to the verdict.
    mu : (f,) complex128 or None
        Beltrami coefficients of the tensors of this map: where it is injective, `quasi_harmonic_map` of them
        gives it back. None after a polish.
    reference : str
        The triangles in whose frames they are expressed.
    path : list of Snapshot
        Maps on the way, where the caller asked to have them recorded.
    V : (n, 2) or (n, 3) float64 or None
        Rest positions of what was mapped, for pictures and measures, not writeable; None where whoever made the map did
        not say.
    refined : Refined or None
        Where edges were split (``refine``): the mesh that this is a map of, and how it came from the one given. Old
        vertices keep their numbers.
    refinement_attempts : list of Rung
        What was tried, in order, where edges might be split.
    crowded : (c,) int64
        With ``PRECISION_LIMIT`` the fixed vertices next to what stays inverted.
    """

    uv: NDArray[np.float64]
    status: Status
    certificate: Certificate
    stages: list[Stage] = field(default_factory=list)
    history: list[Step] = field(default_factory=list)
    diagnosis: Diagnosis | None = None
    linear_solver: str = ""
    seconds: float = 0.0
    mu: NDArray[np.complex128] | None = None
    reference: str = "equilateral"
    path: list[Snapshot] = field(default_factory=list)
    V: NDArray[np.float64] | None = None
    refined: Refined | None = None
    refinement_attempts: list[RefinementAttempt] = field(default_factory=list)
    crowded: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if self.V is not None:
            # Seen through this result alone: whoever handed it over may still write.
            object.__setattr__(self, "V", self.V.view())
        self._seal()

    def _read_only(self) -> list[NDArray[np.float64]]:
        return [] if self.V is None else [self.V]

    @property
    def added(self) -> int:
        """Vertices that were added, after the old ones."""
        return 0 if self.refined is None else len(self.refined.parents)

    @property
    def F(self) -> NDArray[np.int64]:
        """The triangles (f, 3) int64, as they were judged."""
        return self.certificate.F

    @property
    def injective(self) -> bool:
        """Whether every triangle is strictly positive (certified)."""
        return self.certificate.injective

    @property
    def iterations(self) -> int:
        """Iterations over all stages."""
        return sum(stage.iterations for stage in self.stages)

    def short_repr(self) -> str:
        steps = f"{self.iterations} iteration{'' if self.iterations == 1 else 's'}"
        return f"{self.certificate.short_repr()}, {steps}, {self.seconds:.3g} s"

    def summary(self) -> str:
        """Say in a few lines what happened, what is certified, what ran, and what forbids a map where that is known."""
        lines = [self.status.value, self.certificate.summary()]
        lines += [str(stage) for stage in self.stages]
        lines.append(f"{self.seconds:.3g} s in total, solved by {self.linear_solver or 'no linear solver'}")
        return "\n".join(lines if self.diagnosis is None else [*lines, self.diagnosis.summary()])

    def plot(self, kind: str = "map", *, measure: str = "isometric") -> Figure:
        """Draw the surface and its map, or how the search went.

        Parameters
        ----------
        kind : {"map", "distortion", "texture", "convergence"}
            The surface beside the map, inverted triangles in red; both coloured by a measure, and its histogram; with
            a checkerboard; or flips and energy by iteration.
        measure : str
            For ``"distortion"``: one of `quasiharmonic.energies.measures.MEASURES`.

        Returns
        -------
        matplotlib Figure
            Displayable by notebooks as it is; see `quasiharmonic.plot`.

        Raises
        ------
        ValueError
            When there is no such kind or measure, or the result does not know its surface.
        """
        figure: Figure = self._draw(kind, measure=measure)
        return figure

    def to_dict(self) -> dict[str, Any]:
        """The report of ``--json``: everything but the map itself, in plain Python types."""
        return {
            "injective": self.injective,
            "status": self.status.name.lower(),
            "message": self.status.value,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "linear_solver": self.linear_solver,
            "stages": [stage.to_dict() for stage in self.stages],
            "certificate": self.certificate.to_dict(),
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_dict(),
            **(self._refinement() if self.refinement_attempts else {}),
        }

    def _refinement(self) -> dict[str, Any]:
        """What the report says where edges might be split."""
        return {
            "added_vertices": self.added,
            "refinement_attempts": [rung.to_dict() for rung in self.refinement_attempts],
            "crowded": self.crowded.tolist(),
        }
