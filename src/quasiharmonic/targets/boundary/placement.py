"""One boundary loop laid along one contour: where it starts, and which of its vertices take the corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.targets.boundary.chord_clearance import make_room
from quasiharmonic.targets.boundary.chords import STRAIGHT, flat_chords
from quasiharmonic.targets.boundary.correspondence import Held, at, best_start, off, places_along
from quasiharmonic.util.arrays import FloatArray, IntArray

# Starts that are tried, nearest to the best fit first, where chords have no room.
_MOST_STARTS = 256
# Ways around to turn a hole.
_TURNS = 48
# How much further a target may stray from its contour for the sake of chords, as a share of the larger side.
_STRAY = 0.02


@dataclass(frozen=True, eq=False)
class Placement:
    """One boundary loop and the contour that it goes to.

    Attributes
    ----------
    s : (n,) float64
        Where the vertices lie along the loop.
    contour : (k, 2) float64
    pins : list of (int, float)
        Vertices whose place along the contour is given.
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
        """Places, and whether chords have room; ``start`` goes to the contour's first point if nothing is given."""
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
        # Vertices that are drawn away from a bend cut it off.
        allowed = off(self.contour, along, places) + _STRAY * float(np.ptp(self.contour, axis=0).max())
        near = off(self.contour, moved, other) <= allowed
        return (other, True) if near and self._fits(other) else (places, False)

    def _along(self, pins: Held) -> FloatArray:
        return places_along(self.s, self.contour, pins, corner_angle=self.corner_angle, names=self.names)

    def _fits(self, places: FloatArray) -> bool:
        """Whether chords have room, and the places are in order around a region."""
        least = STRAIGHT * float(np.ptp(self.contour, axis=0).max())
        if next(flat_chords(self.chords, places, least), None) is not None:
            return False
        here = np.arange(len(places))
        return not len(contacts(places, np.stack([here, np.roll(here, -1)], axis=1), 0).pairs)

    def fitted(self, flat: FloatArray) -> FloatArray:
        """Places from the start that fits best, or the nearest one that leaves chords room if there is any."""
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
        """Places from starts all around; only those that leave chords room if there are any."""
        if self.pins:
            return [self.laid()[0]]
        wanted = np.arange(_TURNS) / _TURNS
        starts = np.unique(np.searchsorted(self.s, wanted, side="right") - 1)
        found = [self.laid(int(start)) for start in starts]
        return [places for places, roomy in found if roomy] or [places for places, _ in found]
