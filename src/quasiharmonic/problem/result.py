"""The result of a solver: the map, its certificate, and the stages that ran."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.io.objects import make_trimesh
from quasiharmonic.util.arrays import ReadOnly, count_of
from quasiharmonic.util.outcome import Displayable, Outcome, as_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from trimesh import Trimesh

    from quasiharmonic.problem.diagnosis import Diagnosis


class Status(Enum):
    """Why a call ended; the value is a message for the user with the outcome and the next action.

    See Also
    --------
    MapResult : Has a status, and the message of it.
    results.UnwrapStatus : The statuses of `unwrap`.

    Examples
    --------
    >>> from quasiharmonic import Status
    >>> Status.INJECTIVE.value
    'Every triangle is strictly positive, verified exactly.'
    """

    INJECTIVE = "Every triangle is strictly positive, verified exactly."
    STALLED = (
        "Stalled: some triangles are still inverted and the energy has converged to a positive value. "
        "No known obstruction forbids a map, but this mesh and this target may still allow none. Split the edges of "
        "the inverted triangles (injective_map: refine=True; qhm map: --refine), or move the target."
    )
    IMPOSSIBLE = (
        "No such map exists for this mesh and this target. This is the best map found. Remove the "
        "obstructions that the diagnosis names."
    )
    OUT_OF_ITERATIONS = (
        "Some triangles were still inverted after the last iteration. "
        "The energy was still falling: allow more iterations."
    )
    INTERRUPTED = "Interrupted. This is the best map so far: use it as the initial map of a new call to continue."
    TIME_LIMIT = "The time limit ended the work. This is the best map so far: allow more time to improve it."
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
        "distortion was found. Try a smaller eta or another energy."
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
        "No linear solver could factor the system. This is the best map so far. Try another "
        "linear_solver or another reference."
    )

    @property
    def acceptable(self) -> bool:
        """Whether a result with this status is a success if its map is injective.

        A collapsed map is not usable, and an interrupted call may have changed only a part of the map.
        """
        return self not in (Status.COLLAPSED, Status.INTERRUPTED)

    @property
    def converged(self) -> bool:
        """Whether no small change of the map lowers the minimised energy noticeably."""
        return self in (Status.INJECTIVE, Status.POLISHED, Status.NEARBY)

    @classmethod
    def of(cls, success: bool) -> Status:
        """Return the status of a call that only succeeds or fails."""
        return cls.INJECTIVE if success else cls.STALLED

    @classmethod
    def most_severe(cls, statuses: Iterable[Status]) -> Status:
        """Return the status of several maps together: that of the map that made the least progress."""
        return min(statuses, key=_MOST_SEVERE_FIRST.index)


_MOST_SEVERE_FIRST = (
    Status.INTERRUPTED,
    Status.TIME_LIMIT,
    # Search and refinement without an injective map.
    Status.IMPOSSIBLE,
    Status.TOO_MANY_SPLITS,
    Status.PRECISION_LIMIT,
    Status.ROUNDED,
    Status.UNSOLVABLE,
    Status.STALLED,
    Status.OUT_OF_ITERATIONS,
    # An injective map that overlaps itself where a bijective one was requested; otherwise the success of a search.
    Status.INJECTIVE,
    # Polish and animation.
    Status.COLLAPSED,
    Status.UNIMPROVED,
    Status.STILL_FALLING,
    Status.EXHAUSTED,
    Status.NEARBY,
    Status.POLISHED,
)


@dataclass(frozen=True)
class Stage:
    """One stage of a solve and its effect.

    Attributes
    ----------
    name : str
        Name of the stage, for logs.
    n_iterations : int
        Evaluations of the objective. The evaluation of the initial map is not counted.
    seconds : float
        Wall time.
    inverted : tuple of int
        Number of triangles that are not strictly positive, before and after.
    energy : tuple of float
        V₃ divided by the target's area, before and after (dimensionless). For a polish, the mean energy.
    kept : bool
        Whether the result of the stage was kept. A result that makes the map worse is discarded.

    See Also
    --------
    MapResult : Lists them as ``stages``.

    Examples
    --------
    >>> from quasiharmonic import boundary_loops, injective_map
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> [stage.inverted[1] for stage in injective_map(V, F, rim, V[rim], polish="mips").stages]
    [0, 0]
    """

    name: str
    n_iterations: int
    seconds: float
    inverted: tuple[int, int]
    energy: tuple[float, float]
    kept: bool = True

    def __str__(self) -> str:
        before, after = (f"{count:,}" for count in self.inverted)
        kept = "" if self.kept else ", discarded"
        return f"{self.name}: {self.n_iterations} iterations, {self.seconds:.3g} s, {before} → {after} inverted{kept}"

    def to_dict(self) -> dict[str, Any]:
        """Return the stage as a dictionary for JSON."""
        # JSON has no infinity, and the energy before the first stage is infinite.
        energy = [e if math.isfinite(e) else None for e in self.energy]
        return vars(self) | {"inverted": list(self.inverted), "energy": energy}


@dataclass(frozen=True)
class Step:
    """One entry of the history: the state of the map at one iteration.

    Attributes
    ----------
    iteration : int
    inverted : int
        Triangles whose area is not positive, in floating point; if there are none, verified exactly.
    energy : float
        V₃ divided by the target's area (dimensionless). It is 0 only at injective maps, and decreases towards them. In
        a polish, the mean energy.

    See Also
    --------
    MapResult : Lists them as ``history``.

    Examples
    --------
    >>> from quasiharmonic import flatten
    >>> from quasiharmonic.surfaces import disk
    >>> history = flatten(*disk(4)).history
    >>> history[0].iteration, history[-1].inverted
    (0, 0)
    """

    iteration: int
    inverted: int
    energy: float


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The map at one iteration; ``history[iteration]`` has its inverted triangles and energy.

    Attributes
    ----------
    iteration : int
    uv : (n, 2) float64
        Positions of the vertices.

    See Also
    --------
    MapResult : Lists them as ``path``.

    Examples
    --------
    >>> from quasiharmonic import flatten
    >>> from quasiharmonic.surfaces import starfish, disk
    >>> path = flatten(*disk(4), record_every=1).path
    >>> path[0].iteration, path[0].uv.shape
    (0, (61, 2))
    """

    iteration: int
    uv: NDArray[np.float64]


@dataclass(frozen=True)
class RefinementAttempt:
    """One refinement stage of `injective_map` with ``refine``.

    Attributes
    ----------
    name : str
        The mesh that was mapped: the given mesh, which edges were split, or that the map was constructed.
    added : int
        Number of added vertices, after the removal of those that the map did not need.
    injective : bool
        Whether the map is injective (certified).
    seconds : float
        Wall time.

    See Also
    --------
    injective_map : Makes attempts with ``refine=True``.
    MapResult : Lists them as ``refinement_attempts``.

    Examples
    --------
    >>> from quasiharmonic import injective_map
    >>> V, F = [[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]]
    >>> result = injective_map(V, F, range(4), [[0, 0], [0.5, 0.4], [1, 0], [0.5, 1]], refine=True)
    >>> attempt = result.refinement_attempts[-1]
    >>> attempt.injective, attempt.added
    (True, 1)
    """

    name: str
    added: int
    injective: bool
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the attempt as a dictionary for JSON."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False, repr=False)
class MapResult(ReadOnly, Displayable, Outcome):
    """A map of the mesh into the plane, with its certificate.

    Attributes
    ----------
    uv : (n, 2) float64
        Positions of the vertices; fixed vertices are exactly at their target positions. Writeable: the certificate
        keeps its own copy.
    status : Status
        Outcome of the solve and the next action.
    certificate : Certificate
        The exact certificate of ``uv``.
    stages : list of Stage
        The stages that ran, in order.
    history : list of Step
        Number of inverted triangles and energy at every iteration. `flatten` of several pieces lists one piece after
        another, each with its own energy.
    diagnosis : Diagnosis or None
        Obstructions to a map, if no map was found.
    linear_solver : str
        Name of the linear solver.
    seconds : float
        Wall time of the call, including the certificate.
    mu : (f,) complex128 or None
        Beltrami coefficients of the tensors of this map. If the map is injective, `quasi_harmonic_map` of them returns
        the same map. None after a polish.
    reference : str
        The reference triangles in whose frames ``mu`` is expressed.
    path : list of Snapshot
        Intermediate maps, if the caller asked to record them.
    V : (n, 2) or (n, 3) float64 or None
        Rest positions of the mapped mesh, for plots and distortion measures; not writeable. None if the caller passed
        no surface.
    refined : Refined or None
        The refined mesh that was mapped and its relation to the given mesh, if edges were split (``refine``). The given
        vertices keep their indices.
    refinement_attempts : list of RefinementAttempt
        The attempts in order, if ``refine`` allowed to split edges.
    crowded : (c,) int64
        With ``PRECISION_LIMIT``, the fixed vertices next to the triangles that stay inverted.

    See Also
    --------
    Status : What each status means.
    Certificate : The exact verdict on the map.
    InverseMap : The inverse of the map.

    Examples
    --------
    >>> from quasiharmonic import flatten
    >>> from quasiharmonic.surfaces import disk
    >>> result = flatten(*disk(4))
    >>> result.success, result.status.name, result.uv.shape
    (True, 'POLISHED', (61, 2))
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
            # A read-only view; the caller's own array stays writeable.
            object.__setattr__(self, "V", self.V.view())
        self._seal()

    def _read_only(self) -> list[NDArray[np.float64]]:
        return [] if self.V is None else [self.V]

    @property
    def added(self) -> int:
        """Number of added vertices; they follow the given vertices."""
        return 0 if self.refined is None else len(self.refined.parents)

    @property
    def F(self) -> NDArray[np.int64]:
        """The triangles (f, 3) int64 that the certificate covers."""
        return self.certificate.F

    @property
    def injective(self) -> bool:
        """Whether every triangle is strictly positive (certified)."""
        return self.certificate.injective

    @property
    def success(self) -> bool:
        """Whether the map is injective (certified), has not collapsed, and the call was not interrupted."""
        return self.injective and self.status.acceptable

    @property
    def converged(self) -> bool:
        """Whether the minimised energy has converged; see `Status`. A search without polish converges at 0."""
        return self.injective and self.status.converged

    @property
    def energy(self) -> float:
        """The minimised energy of the map: a mean over the rest area; NaN if none was computed.

        After a search without polish it is V₃ divided by the target's area, which is 0 only at injective maps. After
        `harmonise` it is the energy plus the conformal term. The energy of a class of the caller is reported unchanged.
        """
        kept = [stage.energy[1] for stage in self.stages if stage.kept]
        before = [stage.energy[0] for stage in self.stages[:1]] or [step.energy for step in self.history[-1:]]
        return (kept or before or [math.nan])[-1]

    @property
    def n_iterations(self) -> int:
        """Iterations over all stages."""
        return sum(stage.n_iterations for stage in self.stages)

    def after(self, earlier: MapResult) -> MapResult:
        """Return this result with the stages, history, path and time of an earlier call before its own."""
        shift = len(earlier.history) - (self.history[0].iteration if self.history else 0)
        return replace(
            self,
            stages=earlier.stages + self.stages,
            history=earlier.history + self.history,
            path=earlier.path + [Snapshot(one.iteration + shift, one.uv) for one in self.path],
            seconds=earlier.seconds + self.seconds,
        )

    @classmethod
    def combine(cls, results: Sequence[MapResult], uv: NDArray[np.float64], certificate: Certificate) -> MapResult:
        """Combine the results of several surfaces into one for all of them, with positions ``uv`` (n, 2)."""
        return cls(
            uv=uv,
            status=Status.most_severe(result.status for result in results),
            certificate=certificate,
            stages=[stage for result in results for stage in result.stages],
            history=[step for result in results for step in result.history],
            path=results[0].path if len(results) == 1 else [],
            diagnosis=results[0].diagnosis,
            linear_solver=results[0].linear_solver,
            seconds=sum(result.seconds for result in results),
        )

    def short_repr(self) -> str:
        steps = count_of("iteration", "iterations", self.n_iterations)
        return f"{self.certificate.short_repr()}, {steps}, {self.seconds:.3g} s"

    def summary(self) -> str:
        """Return a few lines of text: outcome, certificate, stages, and the diagnosis if there is one."""
        lines = [self.status.value, self.certificate.summary()]
        lines += [str(stage) for stage in self.stages]
        lines.append(f"{self.seconds:.3g} s in total, solved by {self.linear_solver or 'no linear solver'}")
        return "\n".join(lines if self.diagnosis is None else [*lines, self.diagnosis.summary()])

    def plot(self, kind: str = "map", *, measure: str = "isometric") -> Figure:
        """Draw the surface and its map, or the convergence history.

        Parameters
        ----------
        kind : {"map", "distortion", "texture", "convergence"}
            ``"map"``: the surface beside the map, inverted triangles in red. ``"distortion"``: both coloured by a
            measure, with its histogram. ``"texture"``: both with a checkerboard. ``"convergence"``: inverted triangles
            and energy by iteration.
        measure : str
            For ``"distortion"``: one of `quasiharmonic.energies.measures.MEASURES`.

        Returns
        -------
        matplotlib Figure
            Notebooks display it directly; see `quasiharmonic.plot`.

        Raises
        ------
        ValueError
            If ``kind`` or ``measure`` is unknown, or ``V`` is None.
        """
        return self._draw(kind, measure=measure)

    def to_trimesh(self) -> Trimesh:
        """Return the mesh as a trimesh.Trimesh with ``uv`` as texture coordinates; needs trimesh.

        Raises
        ------
        ValueError
            If ``V`` is None.
        """
        if self.V is None:
            raise ValueError("the result has no rest positions (V): the caller passed no surface")
        return make_trimesh(self.V, self.F, self.uv)

    def to_dict(self) -> dict[str, Any]:
        """Return the report of ``--json``: all data except the map itself, in plain Python types."""
        report = {
            **super().to_dict(),
            **as_plain(self, "injective", "linear_solver", "stages"),
            "history": [
                vars(step) | {"energy": step.energy if math.isfinite(step.energy) else None} for step in self.history
            ],
            **as_plain(self, "diagnosis"),
        }
        if self.refinement_attempts:
            report |= {"added_vertices": self.added, **as_plain(self, "refinement_attempts", "crowded")}
        return report
