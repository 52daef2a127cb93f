"""Placement of one boundary loop along one contour: the start, and the vertices at corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.targets.boundary.chord_clearance import clear_chords
from quasiharmonic.targets.boundary.chords import STRAIGHT, flat_chords
from quasiharmonic.targets.boundary.correspondence import Held, find_start, max_deviation, places_along, points_at
from quasiharmonic.util.arrays import FloatArray, IntArray, cyclic_pairs

# Maximum number of starts to try, nearest to the best fit first, if chords lack space.
_MAX_STARTS = 256
# Number of rotations to try for a hole.
_ROTATIONS = 48
# Additional deviation of a target from its contour allowed for chords, as a share of the larger side.
_ALLOWED_DEVIATION = 0.02


@dataclass(frozen=True, eq=False)
class CornerPlacement:
    """One boundary loop and its contour."""

    s: FloatArray  # (n,): parameters of the vertices along the loop
    contour: FloatArray  # (k, 2)
    pins: list[tuple[int, float]]  # Vertices with given parameters along the contour
    chords: IntArray  # (c, 2): interior edges between vertices of the loop
    names: IntArray  # (n,): the loop's vertices
    corner_angle: float  # Degrees

    def place(self, start: int = 0) -> tuple[FloatArray, bool]:
        """Return positions and whether chords have space; without pins, ``start`` goes to the contour's first point."""
        pins: Held = self.pins or [(start, 0.0)]
        along = self._along(pins)
        positions = points_at(self.contour, along)
        if self._fits(positions):
            return positions, True
        clear = clear_chords(self.s, self.contour, pins, corner_angle=self.corner_angle, chords=self.chords)
        if clear is None:
            return positions, False
        moved = self._along(clear)
        other = points_at(self.contour, moved)
        # Vertices moved away from a bend cut it off, so limit the deviation.
        allowed = max_deviation(self.contour, along, positions) + _ALLOWED_DEVIATION * float(
            np.ptp(self.contour, axis=0).max()
        )
        near = max_deviation(self.contour, moved, other) <= allowed
        return (other, True) if near and self._fits(other) else (positions, False)

    def _along(self, pins: Held) -> FloatArray:
        return places_along(self.s, self.contour, pins, corner_angle=self.corner_angle, names=self.names)

    def _fits(self, positions: FloatArray) -> bool:
        """Whether chords have space and the positions bound a region."""
        min_bulge = STRAIGHT * float(np.ptp(self.contour, axis=0).max())
        if next(flat_chords(self.chords, positions, min_bulge), None) is not None:
            return False
        here = np.arange(len(positions))
        return not len(contacts(positions, cyclic_pairs(here), 0).pairs)

    def fit(self, flat: FloatArray) -> FloatArray:
        """Positions from the best start, or from the nearest start that leaves chords space if one exists."""
        first = find_start(self.s, flat, self.contour)
        best, clear = self.place(first)
        away = np.minimum((self.s - self.s[first]) % 1.0, (self.s[first] - self.s) % 1.0)
        for start in np.argsort(away, kind="stable")[1 : 1 if self.pins else _MAX_STARTS]:
            if clear:
                break
            positions, clear = self.place(int(start))
            best = positions if clear else best
        return best

    def choices(self) -> list[FloatArray]:
        """Positions from starts all around the loop, restricted to those that leave chords space if any do."""
        if self.pins:
            return [self.place()[0]]
        wanted = np.arange(_ROTATIONS) / _ROTATIONS
        starts = np.unique(np.searchsorted(self.s, wanted, side="right") - 1)
        found = [self.place(int(start)) for start in starts]
        return [positions for positions, clear in found if clear] or [positions for positions, _ in found]
