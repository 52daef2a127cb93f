"""Placement of one boundary loop along one contour: the start, and the vertices at corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.targets.boundary.chord_clearance import make_room
from quasiharmonic.targets.boundary.chords import STRAIGHT, flat_chords
from quasiharmonic.targets.boundary.correspondence import Held, at, best_start, off, places_along
from quasiharmonic.util.arrays import FloatArray, IntArray

# Maximum number of starts to try, nearest to the best fit first, if chords lack space.
_MOST_STARTS = 256
# Number of rotations to try for a hole.
_TURNS = 48
# Additional deviation of a target from its contour allowed for chords, as a share of the larger side.
_STRAY = 0.02


@dataclass(frozen=True, eq=False)
class Placement:
    """One boundary loop and its contour.

    Attributes
    ----------
    s : (n,) float64
        Parameters of the vertices along the loop.
    contour : (k, 2) float64
    pins : list of (int, float)
        Vertices with given parameters along the contour.
    chords : (c, 2) int64
        Interior edges between vertices of the loop.
    names : (n,) int64
        The loop's vertices.
    corner_angle : float
        Degrees.
    """

    s: FloatArray
    contour: FloatArray
    pins: list[tuple[int, float]]
    chords: IntArray
    names: IntArray
    corner_angle: float

    def laid(self, start: int = 0) -> tuple[FloatArray, bool]:
        """Return positions and whether chords have space; without pins, ``start`` goes to the contour's first point."""
        pins: Held = self.pins or [(start, 0.0)]
        along = self._along(pins)
        places = at(self.contour, along)
        if self._fits(places):
            return places, True
        roomy = make_room(self.s, self.contour, pins, corner_angle=self.corner_angle, chords=self.chords)
        if roomy is None:
            return places, False
        moved = self._along(roomy)
        other = at(self.contour, moved)
        # Vertices moved away from a bend cut it off, so limit the deviation.
        allowed = off(self.contour, along, places) + _STRAY * float(np.ptp(self.contour, axis=0).max())
        near = off(self.contour, moved, other) <= allowed
        return (other, True) if near and self._fits(other) else (places, False)

    def _along(self, pins: Held) -> FloatArray:
        return places_along(self.s, self.contour, pins, corner_angle=self.corner_angle, names=self.names)

    def _fits(self, places: FloatArray) -> bool:
        """Whether chords have space and the positions bound a region."""
        least = STRAIGHT * float(np.ptp(self.contour, axis=0).max())
        if next(flat_chords(self.chords, places, least), None) is not None:
            return False
        here = np.arange(len(places))
        return not len(contacts(places, np.stack([here, np.roll(here, -1)], axis=1), 0).pairs)

    def fitted(self, flat: FloatArray) -> FloatArray:
        """Positions from the best start, or from the nearest start that leaves chords space if one exists."""
        first = best_start(self.s, flat, self.contour)
        best, roomy = self.laid(first)
        away = np.minimum((self.s - self.s[first]) % 1.0, (self.s[first] - self.s) % 1.0)
        for start in np.argsort(away, kind="stable")[1 : 1 if self.pins else _MOST_STARTS]:
            if roomy:
                break
            places, roomy = self.laid(int(start))
            best = places if roomy else best
        return best

    def choices(self) -> list[FloatArray]:
        """Positions from starts all around the loop, restricted to those that leave chords space if any do."""
        if self.pins:
            return [self.laid()[0]]
        wanted = np.arange(_TURNS) / _TURNS
        starts = np.unique(np.searchsorted(self.s, wanted, side="right") - 1)
        found = [self.laid(int(start)) for start in starts]
        return [places for places, roomy in found if roomy] or [places for places, _ in found]
