"""Generated problems: seeded, of many families, with adjustable difficulty.

    V, F, fixed, target = make("maze", seed=7, difficulty=0.8)[:4]

A family, a seed and a difficulty from 0 to 1 determine a problem. *Feasible* families are made from a solution: an
injective map of the mesh, whose boundary (and pins) then define the problem. The solution is stored as ``hidden``. The
other families map the boundary to outlines; it is unknown which of their problems have a solution.

Whether a map exists depends on the connectivity and the target, not on the rest mesh's shape. The shape is drawn
separately: plain, stretched to angles of 1e-6, graded over areas of 1:1e12, with single slivers, or curved.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import outlines
import planar
from adversarial import ADVERSARIAL
from planar import Draft, Mover, blank, flow, roughen, strongest
from quasiharmonic import boundary_loops, certify
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

Generator = np.random.Generator


class Case(NamedTuple):
    """A problem and its known properties.

    Attributes
    ----------
    V, F, fixed, target : arrays
        As `quasiharmonic.Problem` takes them.
    family : str
    seed : int
    difficulty : float
    feasible : bool
        Whether a solution is known to exist.
    simple : bool or None
        Whether that solution is bijective: no loop of the target crosses itself or another.
    hidden : (n, 2) float64 or None
        That solution.
    """

    V: FloatArray
    F: IntArray
    fixed: IntArray
    target: FloatArray
    family: str
    seed: int
    difficulty: float
    feasible: bool
    simple: bool | None
    hidden: FloatArray | None

    @property
    def name(self) -> str:
        """The name of the problem, as `parse` reads it."""
        return f"{self.family}:{self.seed}:{self.difficulty!r}"


def parse(name: str) -> tuple[str, int, float]:
    """Return the family, seed and difficulty of a `Case.name`.

    Raises
    ------
    ValueError
        If the text is not the name of a problem.
    """
    try:
        family, seed, difficulty = name.split(":")
    except ValueError:
        raise ValueError(f"{name!r} is no name of a problem, such as maze:7:0.8") from None
    known = FAMILIES | ADVERSARIAL
    if family not in known:
        raise ValueError(f"there is no family {family!r}; there are {', '.join(known)}")
    return family, int(seed), float(difficulty)


def make(family: str, seed: int, difficulty: float, *, triangles: int | None = None) -> Case:
    """Make a problem.

    Parameters
    ----------
    family : str
        One of `FAMILIES` or of `ADVERSARIAL`.
    seed : int
    difficulty : float
        From 0 to 1.
    triangles : int, optional
        Approximate number; by default mostly 50 to 1000, sometimes 5000 and rarely 50 000.
    """
    rng = np.random.default_rng([zlib.crc32(family.encode()), seed, round(difficulty * 1e6)])
    size = _size(rng)
    draft = (FAMILIES | ADVERSARIAL)[family](rng, difficulty, triangles or size)
    fixed = np.concatenate([*boundary_loops(draft.F, len(draft.z)), draft.pins])
    image = planar.points(draft.image)
    # Near the limits of double precision, slivers cannot be represented as well.
    V = draft.unit * dressed(rng, draft.z, draft.F, difficulty if draft.unit == 1 else 0.0)
    simple, hidden = None, None
    if draft.feasible:
        certificate = certify(draft.F, image)
        if not certificate.injective:
            raise AssertionError(f"the solution of {family}:{seed}:{difficulty} is none")
        simple, hidden = certificate.bijective, image
    return Case(V, draft.F, fixed, image[fixed], family, seed, difficulty, draft.feasible, simple, hidden)


def _size(rng: Generator) -> int:
    low, high = [(50, 1000), (1000, 5000), (50000, 50001)][rng.choice(3, p=(0.9, 0.098, 0.002))]
    return int(np.exp(rng.uniform(np.log(low), np.log(high))))


def dressed(rng: Generator, z: ComplexArray, F: IntArray, difficulty: float) -> FloatArray:
    """Return rest positions for a planar mesh, (n, 2) or (n, 3), with a positive area for every triangle."""
    z = (z - z.mean()) / np.ptp(planar.points(z), axis=0).max()
    style = rng.choice(["plain", "stretched", "graded", "slivers"])
    strength = difficulty
    rest = z
    while style != "plain" and strength > 1e-3:
        if style == "stretched":
            rest = z.real + 1j * z.imag * 10 ** (-6 * strength)
        elif style == "graded":
            # Conformal, so angles are preserved; exp is injective while the imaginary part spans less than 2π.
            a = 13.8 * strength
            rest = np.exp(a * z.real + 1j * min(a, 5.0) * z.imag)
        else:
            rest = _slivers(rng, z, F, 10 ** (-6 * strength))
        if certify(F, planar.points(rest), boundary=False).injective:
            break
        rest, strength = z, 0.5 * strength
    V = planar.points(rest)
    if rng.random() < 0.5:
        return V
    low, extent = V.min(axis=0), np.ptp(V, axis=0).max()
    x, y = ((V - low) / extent).T
    a, b, c, d = rng.normal(0, 3, 4)
    return np.column_stack([V, extent * (np.sin(a * x + b * y) + 0.3 * np.cos(c * x * y + d))])


def _slivers(rng: Generator, z: ComplexArray, F: IntArray, thin: float) -> ComplexArray:
    """Move a few vertices close to an opposite edge, up to a share ``thin``."""
    step = np.zeros_like(z)
    chosen = F[rng.random(len(F)) < 0.1]
    a, b, c = chosen.T
    step[a] = (1 - thin) * (0.5 * (z[b] + z[c]) - z[a])
    return Mover(F, len(z)).move(z, step, 0.1 * thin * planar.areas(z, F))


def _noise(rng: Generator, d: float, size: int) -> Draft:
    """Every vertex moved at random, as far as the triangles allow."""
    z, F = blank(rng, size, int(rng.integers(4)))
    return Draft(z, F, roughen(rng, z, F, 1 + int(15 * d), 10 ** (-3 - 6 * d)))


def _jam(rng: Generator, d: float, size: int) -> Draft:
    """All vertices moved along a field that converges and shears, as far as the triangles allow."""
    z, F = blank(rng, size, int(rng.integers(3)))
    mover, w = Mover(F, len(z)), z
    wave = rng.normal(0, 2.5, (4, 2))
    phase = rng.uniform(0, 2 * np.pi, 4)
    floor = 10 ** (-3 - 6 * d) * planar.areas(z, F)
    for _ in range(3 + int(60 * d)):
        s = np.sin(planar.points(w) @ wave.T + phase)
        w = mover.move(w, 0.05 * (s[:, 0] + s[:, 1] + 1j * (s[:, 2] + s[:, 3])), floor)
    return Draft(z, F, w)


def _flow(rng: Generator, d: float, size: int) -> Draft:
    """Smooth local twists, drags and pinches, each nearly as strong as the mesh allows."""
    z, F = blank(rng, size, int(rng.integers(4)))
    return Draft(z, F, flow(rng, z, F, 2 + int(14 * d), 0.5 + 0.49 * d))


def _swirl(rng: Generator, d: float, size: int) -> Draft:
    """An inner loop, or the pinned middle of a disk, rotated as far as a rotation by radius allows."""
    z, F = blank(rng, size, int(rng.integers(2)))
    loops = boundary_loops(F, len(z))
    inner = min(loops, key=lambda loop: planar.span(z[loop])) if len(loops) > 1 else None
    centre = z[inner].mean() if inner is not None else z[np.argmin(abs(z - z.mean()))]
    r = abs(z - centre)
    first = r[inner].max() if inner is not None else 0.15 * r.max()
    last = r[max(loops, key=lambda loop: planar.span(z[loop]))].min()
    turn = np.clip((last - r) / (last - first), 0, 1)
    sign = rng.choice([-1, 1])

    def turned(t: float) -> ComplexArray:
        return centre + (z - centre) * np.exp(1j * sign * t * turn)

    image = strongest(turned, F, 40.0, 0.2 + 0.79 * d)
    pins = np.argsort(r)[: int(rng.integers(2, 8))] if inner is None else np.empty(0, dtype=np.int64)
    return Draft(z, F, roughen(rng, image, F, int(4 * d)), np.setdiff1d(pins, np.concatenate(loops)))


def _adrift(rng: Generator, d: float, size: int) -> Draft:
    """Up to three inner loops, rotated and moved as rigid bodies as far as the mesh around them allows."""
    z, F = blank(rng, max(size, 150), 3)
    loops = boundary_loops(F, len(z))
    outer = max(loops, key=lambda loop: planar.span(z[loop]))
    held, rest = np.concatenate(loops), z
    for loop in [loop for _ in range(1 + int(5 * d)) for loop in loops if loop is not outer]:
        centre = z[loop].mean()
        r, first = abs(z - centre), abs(z[loop] - centre).max()
        last = r[np.setdiff1d(held, loop)].min()
        if last <= first:
            continue
        near = np.clip((last - r) / (last - first), 0, 1)
        shift = rng.uniform(0, 1) * last * np.exp(2j * np.pi * rng.random())
        moved = partial(_carried, z, near, centre, rng.choice([-1, 1]) * rng.uniform(0.3, 1), shift)
        z = strongest(moved, F, 10.0, 0.2 + 0.79 * d)
    return Draft(rest, F, roughen(rng, z, F, 1 + int(4 * d), held=held))


def _carried(z: ComplexArray, near: FloatArray, centre: complex, turn: float, shift: complex, t: float) -> ComplexArray:
    """Return points rotated around a centre and shifted, weighted by ``near``."""
    return centre + (z - centre) * np.exp(1j * turn * t * near) + 0.1 * t * near * shift


def _pins(rng: Generator, d: float, size: int) -> Draft:
    """Pinned interior vertices, from one to a third of all; with or without a moved boundary."""
    z, F = blank(rng, size, int(rng.integers(3)))
    boundary = np.concatenate(boundary_loops(F, len(z)))
    inside = np.setdiff1d(np.arange(len(z)), boundary)
    held = boundary if rng.random() < 0.5 else None
    image = flow(rng, z, F, 1 + int(5 * d), 0.3 + 0.69 * d, held)
    image = roughen(rng, image, F, 1 + int(8 * d), 10 ** (-3 - 4 * d), held)
    count = 1 + int(rng.random() * d * len(inside) / 3)
    return Draft(z, F, image, rng.choice(inside, min(count, inside.size), replace=False))


def _spiral(rng: Generator, d: float, size: int) -> Draft:
    """A straight strip wound into a spiral."""
    across = int(rng.integers(2, 6))
    along = max(8, size // (2 * across))
    z, quads = planar.cells(np.ones((across, along), dtype=bool))
    # With fewer than six steps per turn, chords would cross the next coil.
    turns, tight = min(0.4 + 5.6 * d, along / 6), rng.uniform(0.3, 0.8)
    angle = 2 * np.pi * turns * z.real / along
    radius = rng.uniform(1.1, 2) * np.pi + angle + tight * np.pi * (2 * z.imag / across - 1)
    F = planar.split(rng, quads)
    return Draft(z, F, roughen(rng, radius * np.exp(-1j * angle), F, int(4 * d)))


def _comb(rng: Generator, d: float, size: int) -> Draft:
    """A comb with teeth of increasing length."""
    width = int(rng.integers(2, 4))
    teeth = int(rng.integers(2, 7))
    depth = max(2, round((0.2 + 0.8 * d) * size / (2 * width * teeth)))
    mask = np.ones((width + depth, teeth * (width + 1) - 1), dtype=bool)
    mask[width:, width :: width + 1] = False
    return _polyomino(rng, d, mask)


def _maze(rng: Generator, d: float, size: int) -> Draft:
    """The corridors of a maze with up to three loops."""
    width = int(rng.integers(2, 4))
    rooms = max(2, round(np.sqrt(size / (4 * width * width))))
    mask = planar.maze(rng, rooms, width, int(rng.integers(4)), winding=d)
    return _polyomino(rng, d, mask)


def _polyomino(rng: Generator, d: float, mask: NDArray[np.bool_]) -> Draft:
    z, quads = planar.cells(mask)
    F = planar.split(rng, quads)
    return Draft(z, F, roughen(rng, flow(rng, z, F, int(3 * d), 0.5 * d), F, int(6 * d)))


def _limbs(rng: Generator, d: float, size: int) -> Draft:
    """A square with limbs whose segments shrink geometrically; some limbs curl."""
    body, width, limbs = (int(k) for k in rng.integers((4, 2, 1), (8, 5, 5)))
    rows = max(3, (size - 2 * body * body) // (2 * width * limbs))
    z, quads, grown = planar.limbed(body, limbs, rows, width)
    image = z.copy()
    for limb in grown:
        # With more rows, each step down to the smallest segment is smaller.
        shrink = max(10 ** (-(2 + 8 * d) * rng.uniform(0.5, 1) / rows), 0.3)
        curl = shrink * np.exp(1j * rng.uniform(-1, 1) * min(1 - shrink, 0.3))
        middle, across = z[limb[0]].mean(), z[limb[0]] - z[limb[0]].mean()
        for row in limb[1:]:
            middle = middle + 1j * (across[-1] - across[0]) / width
            across = across * curl
            image[row] = middle + across
    F = planar.split(rng, quads)
    return Draft(z, F, roughen(rng, image, F, 1 + int(5 * d), 1e-2))


def _carved(rng: Generator, d: float, size: int) -> Draft:
    """A mesh from which triangles are removed until most of its vertices lie on the boundary."""
    z, F = blank(rng, int(size * (1 + d)), int(rng.integers(3)))
    F = planar.carved(rng, F, len(z), 0.3 + 0.65 * d)
    image = flow(rng, z, F, int(4 * d), 0.8 * d)
    return Draft(z, F, roughen(rng, image, F, 1 + int(6 * d), 10 ** (-3 - 4 * d)))


def _outlined(draw: Callable[[Generator, float], list[FloatArray]]) -> Callable[[Generator, float, int], Draft]:
    """Return the family of meshes whose boundary is mapped to an outline; feasibility is unknown."""

    def family(rng: Generator, d: float, size: int) -> Draft:
        contours = draw(rng, d)
        z, F = planar.without_chords(*blank(rng, size, len(contours) - 1))
        return Draft(z, F, outlines.laid(z, F, contours), feasible=False)

    return family


def _moved(rng: Generator, d: float, size: int) -> Draft:
    """Holes rotated and moved by any amount that keeps them apart."""
    z, F = planar.without_chords(*blank(rng, size, int(rng.integers(1, 4))))
    return Draft(z, F, outlines.moved_holes(rng, z, F, d), feasible=False)


FAMILIES: dict[str, Callable[[Generator, float, int], Draft]] = {
    "noise": _noise,
    "jam": _jam,
    "flow": _flow,
    "swirl": _swirl,
    "adrift": _adrift,
    "pins": _pins,
    "spiral": _spiral,
    "comb": _comb,
    "maze": _maze,
    "limbs": _limbs,
    "carved": _carved,
    "polygon": _outlined(outlines.polygon),
    "star": _outlined(outlines.burst),
    "whirl": _outlined(outlines.whirl),
    "teeth": _outlined(outlines.teeth),
    "glyph": _outlined(outlines.glyph),
    "moved": _moved,
}
