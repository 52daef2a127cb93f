"""The result of an animation: its frames, and the displacement of vertices between them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import BoolArray, FloatArray, check_finite, count_of, describe, names_of, real_array
from quasiharmonic.util.hints import make_dataframe
from quasiharmonic.util.outcome import SummarisedOutcome, Verdict, as_plain

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True)
class FrameStep:
    """Progress of an animation, as passed to its callback.

    Attributes
    ----------
    frame : int
        Index of the current frame, from 0.
    frames : int
        Number of frames.
    sweep : int
        0 during the search for maps, then the number of the smoothing sweep.
    move : float
        Maximum vertex displacement between frames so far, relative to that of the boundary; 0 before there are two
        frames.

    See Also
    --------
    animate : Passes it to its callback.

    Examples
    --------
    >>> from quasiharmonic import Problem, animate, boundary_loops
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> steps = []
    >>> animation = animate(Problem(V, F, rim, V[rim]), [V[rim], 2 * V[rim]], callback=steps.append)
    >>> steps[-1].frame, steps[-1].frames
    (1, 2)
    """

    frame: int
    frames: int
    sweep: int
    move: float


@dataclass(frozen=True, eq=False, repr=False)
class AnimationVerdict(Verdict):
    """The exact verdict on the frames of an animation: one certificate for each.

    See Also
    --------
    Animation : Has it as its certificate.

    Examples
    --------
    >>> from quasiharmonic import Problem, animate, boundary_loops
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> verdict = animate(Problem(V, F, rim, V[rim]), [V[rim], 2 * V[rim]]).certificate
    >>> verdict.valid, len(verdict.frames)
    (True, 2)
    """

    frames: tuple[Certificate, ...]

    @property
    def valid(self) -> bool:
        """Whether there are frames and every triangle of every frame is strictly positive."""
        return bool(self.frames) and all(frame.valid for frame in self.frames)

    @property
    def bijective(self) -> bool:
        """Whether there are frames and every frame is bijective."""
        return bool(self.frames) and all(frame.bijective for frame in self.frames)

    def summary(self) -> str:
        """Describe the verdict in one sentence."""
        positive, bijective = (sum(bool(getattr(f, name)) for f in self.frames) for name in ("valid", "bijective"))
        return f"{positive} of {count_of('frame', 'frames', len(self.frames))} injective, {bijective} bijective"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        return {**super().to_dict(), "summary": self.summary()}


@dataclass(frozen=True, eq=False)
class Animation(SummarisedOutcome, Sequence[MapResult]):
    """A sequence of maps: ``animation[t]`` is the `MapResult` of frame t.

    Attributes
    ----------
    frames : list of MapResult
        One result per target, with status, certificate, and a diagnosis if there is no map. Shorter than the targets if
        the work was interrupted.
    targets : (t, k, 2) float64
        Target positions of the fixed vertices per frame; as given, except for bridged frames.
    bridged : (t,) bool
        Frames without a map for the given target, whose target was interpolated between their neighbours.
    energies : (t,) float64
        Mean energy of each polished frame; NaN for others.
    max_motion_ratio : float or None
        Requested maximum vertex displacement between frames, relative to that of the boundary. None without
        ``polish``.
    interrupted : bool
        Whether Ctrl-C ended the work before completion.

    See Also
    --------
    animate : Makes it.
    MapResult : The result of each frame.

    Examples
    --------
    >>> from quasiharmonic import Problem, animate, boundary_loops
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> animation = animate(Problem(V, F, rim, V[rim]), [V[rim], 2 * V[rim]])
    >>> len(animation), animation[1].status.name, animation.success
    (2, 'INJECTIVE', True)
    """

    frames: list[MapResult]
    targets: FloatArray
    bridged: BoolArray
    energies: FloatArray
    max_motion_ratio: float | None = None
    interrupted: bool = False

    def __repr__(self) -> str:
        frames = count_of("frame", "frames", len(self.frames))
        return f"<Animation: {frames}, {np.count_nonzero(self.found)} injective, largest move {self.largest_move:.3g}>"

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, index: int) -> MapResult: ...
    @overload
    def __getitem__(self, index: slice) -> list[MapResult]: ...
    def __getitem__(self, index: int | slice) -> MapResult | list[MapResult]:
        return self.frames[index]

    @property
    def success(self) -> bool:
        """Whether every frame is a success and the work was not interrupted."""
        return not self.interrupted and bool(self.frames) and all(frame.success for frame in self.frames)

    @property
    def status(self) -> Status:
        """``INTERRUPTED``, or the status of the frame that made the least progress."""
        statuses = [frame.status for frame in self.frames]
        return Status.most_severe([Status.INTERRUPTED] if self.interrupted or not statuses else statuses)

    @property
    def certificate(self) -> AnimationVerdict:
        """The exact verdict on all frames."""
        return AnimationVerdict(tuple(frame.certificate for frame in self.frames))

    @property
    def n_iterations(self) -> int:
        """Iterations over all frames."""
        return sum(frame.n_iterations for frame in self.frames)

    @property
    def seconds(self) -> float:
        """Wall time over all frames."""
        return sum(frame.seconds for frame in self.frames)

    @property
    def uv(self) -> FloatArray:
        """The maps of all frames; (t, n, 2) float64, or (0, 0, 2) without frames."""
        return np.stack([frame.uv for frame in self.frames]) if self.frames else np.empty((0, 0, 2))

    @property
    def found(self) -> BoolArray:
        """Which frames have no inverted triangle, verified exactly; (t,) bool."""
        return np.array([frame.injective for frame in self.frames], dtype=bool)

    @property
    def bijective(self) -> BoolArray:
        """Which frames are bijective, verified exactly; (t,) bool."""
        return np.array([bool(frame.certificate.bijective) for frame in self.frames], dtype=bool)

    @property
    def moves(self) -> FloatArray:
        """Maximum vertex displacement between successive frames, relative to that of the boundary and pins.

        Returns
        -------
        (t - 1,) float64
            NaN if the boundary does not move or one of the two frames has no map.
        """
        found = self.found
        ratio = np.full(max(len(self.frames) - 1, 0), np.nan)
        for t in np.flatnonzero(found[1:] & found[:-1]):
            boundary = find_longest(self.targets[t + 1] - self.targets[t])
            if boundary > 0:
                ratio[t] = find_longest(self.frames[t + 1].uv - self.frames[t].uv) / boundary
        return ratio

    @property
    def largest_move(self) -> float:
        """The largest of ``moves``; 0 if there are none."""
        moves = self.moves
        return float(moves[np.isfinite(moves)].max(initial=0.0))

    def to_dataframe(self) -> DataFrame:
        """Return one row per frame: success, status, bijective, bridged, energy, and the move from the frame before.

        Needs pandas. Columns are as the attributes of the same names; ``move`` is NaN for the first frame.
        """
        return make_dataframe(
            {
                "success": [frame.success for frame in self.frames],
                "status": [frame.status.name.lower() for frame in self.frames],
                "bijective": self.bijective,
                "bridged": self.bridged[: len(self.frames)],
                "energy": self.energies[: len(self.frames)],
                "move": np.concatenate([np.full(min(len(self.frames), 1), np.nan), self.moves]),
            },
            "frame",
        )

    def summary(self) -> str:
        """Return a text with the number of certified frames, the reasons for missing ones, and the largest move."""
        found, count = self.found, count_of("frame", "frames", len(self.frames))
        lines = [f"{count}: {np.count_nonzero(found)} with every triangle strictly positive, verified exactly"]
        if not found.all():
            lines[0] += "; change the targets of the others, or use fill_gaps=True"
        if self.interrupted:
            bare = np.flatnonzero(found & np.isnan(self.energies))
            missing = "all frames were complete"
            if self.max_motion_ratio is not None:
                limiting = "the moves between frames were limited"
                missing = f"the polish of {names_of('frame', 'frames', bare)}" if bare.size else limiting
            lines.append(f"interrupted before {missing}")
        if self.bridged.any():
            lines.append(f"between their neighbours: {names_of('frame', 'frames', np.flatnonzero(self.bridged))}")
        overlapping = np.flatnonzero(found & ~self.bijective)
        if overlapping.size:
            lines.append(f"overlapping: {names_of('frame', 'frames', overlapping)}")
        for t in np.flatnonzero(~found)[:5]:
            diagnosis = self.frames[t].diagnosis
            known = diagnosis.obstructions if diagnosis is not None else ()
            lines.append(f"frame {t}: {known[0].message if known else self.frames[t].status.value}")
        more = int(np.count_nonzero(~found)) - 5
        if more > 0:
            lines.append(f"and {count_of('frame', 'frames', more)} more without a map")
        over = self.max_motion_ratio is not None and self.largest_move > self.max_motion_ratio
        beyond = f", beyond the limit of {self.max_motion_ratio:g}" if over else ""
        lines.append(f"no vertex moves more than {self.largest_move:.3g} times as far as the boundary{beyond}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return all data except the maps, for JSON."""
        return {
            **super().to_dict(),
            "frames": len(self.frames),
            "certified": int(np.count_nonzero(self.found)),
            "overlapping": np.flatnonzero(self.found & ~self.bijective).tolist(),
            "missing": np.flatnonzero(~self.found).tolist(),
            "bridged": np.flatnonzero(self.bridged).tolist(),
            **as_plain(self, "interrupted", "largest_move"),
            "moves": [None if np.isnan(move) else float(move) for move in self.moves],
            "mean_energies": [None if np.isnan(energy) else float(energy) for energy in self.energies],
            "statuses": [frame.status.name.lower() for frame in self.frames],
            "diagnoses": {
                int(t): frame.diagnosis.to_dict()
                for t, frame in enumerate(self.frames)
                if not frame.injective and frame.diagnosis is not None
            },
        }


def find_longest(moved: FloatArray) -> float:
    """Return the length of the longest displacement (k, 2)."""
    return float(np.hypot(*moved.T).max(initial=0.0))


def check_targets(targets: Iterable[ArrayLike], count: int) -> FloatArray:
    """Check a sequence of targets with ``count`` rows each and return it as one array (t, k, 2).

    Raises TypeError or ValueError; the message names the first bad frame.
    """
    if not isinstance(targets, Iterable) or isinstance(targets, str | bytes):
        raise TypeError(f"targets must be a sequence of arrays ({count}, 2), not {describe(targets)}")
    checked = []
    for t, target in enumerate(targets):
        name = f"targets: frame {t}"
        array = real_array(name, target)
        if array.shape != (count, 2):
            raise ValueError(f"{name} must have shape ({count}, 2), not {array.shape}")
        check_finite(name, "row", "rows", array)
        checked.append(array)
    if not checked:
        raise ValueError("targets has no frames")
    return np.stack(checked)
