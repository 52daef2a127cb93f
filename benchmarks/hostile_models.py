"""Unwrap hostile models: thin triangles, spheres of NumPy's kind, boxes, voxels, profiles, soups, rough surfaces.

Others are hard-surface models with noise, almost symmetric models, dented spheres, long strips, reliefs, plates with
holes, and twisted bands.

    python benchmarks/hostile_models.py -n 2000

Every model is unwrapped with five bounds in turn. A *failure* is an exception other than a ValueError for a model
without area, a chart that is not bijective, or a result that does not reproduce the model. The last line has the number
of failures.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hard_models
from hard_models import Mesh, blocks, split_edges
from quasiharmonic import unwrap

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from sculptures import surface_net

BOUNDS = 1.05, 1.1, 1.2, 1.5, 3.0


def sphere(random: np.random.Generator) -> Mesh:
    """A grid of angles up to π, whose last pole has almost coincident vertices."""
    n = int(random.integers(4, 70))
    m = max(n // 2, 2) + 1
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.linspace(0, np.pi, m), indexing="ij")
    a = (np.arange(n)[:, None] * m + np.arange(m - 1)).ravel()
    b = (a + m) % (n * m)
    V = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    V *= np.exp(random.normal(0, 0.3, 3))
    if random.random() < 0.5:
        V = V.astype(np.float32).astype(np.float64)
    return V, np.concatenate([np.stack([a, a + 1, b + 1], axis=1), np.stack([a, b + 1, b], axis=1)])


def voxels(random: np.random.Generator) -> Mesh:
    """Random blocks, which touch at edges and vertices, too."""
    size = int(random.integers(2, 5))
    solid = random.random((size, size, size)) < random.uniform(0.2, 0.8)
    solid[0, 0, 0] = True
    return split_edges(*blocks(solid), int(random.integers(0, 3)))


def box(random: np.random.Generator) -> Mesh:
    """A box of random sides, with equal triangles or with slivers."""
    V, F = split_edges(*blocks(np.ones((1, 1, 1), dtype=bool)), int(random.integers(0, 5)))
    return V ** random.choice([1.0, 3.0, 9.0]) * np.exp(random.normal(0, 1.5, 3)), F


def profile(random: np.random.Generator) -> Mesh:
    """An extruded star or a staircase of blocks with random sides."""
    times = int(random.integers(0, 4))
    if random.random() < 0.5:
        heights = random.integers(1, 5, int(random.integers(2, 6)))
        V, F = blocks(np.arange(heights.max())[None, None] < heights[:, None, None])
        steps = np.cumsum(random.uniform(0.2, 1, (3, 8)), axis=1)
        V = np.stack([steps[k, V[:, k].astype(int)] for k in range(3)], axis=1)
        return split_edges(V, F, times)
    n = int(random.integers(3, 12))
    angle, radius = np.arange(n) * 2 * np.pi / n, random.uniform(0.3, 1.2, n)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)], axis=1)
    V = np.concatenate([ring, ring, np.zeros((2, 3))]) + np.repeat([0, 1, 0, 1], [n, n, 1, 1])[:, None] * [0, 0, 0.7]
    i = np.arange(n)
    j = (i + 1) % n
    sides = [(i, j, j + n), (i, j + n, i + n), (j, i, 2 * n + 0 * i), (i + n, j + n, 2 * n + 1 + 0 * i)]
    return split_edges(V, np.concatenate([np.stack(side, axis=1) for side in sides]), times)


def thin(random: np.random.Generator) -> Mesh:
    """Random triangles, most of them thin or of very different sizes."""
    n, f = int(random.integers(3, 20)), int(random.integers(1, 30))
    V = random.normal(size=(n, 3))
    V *= 10.0 ** random.uniform(-9, 0, (n, 1)) if random.random() < 0.5 else [1, 1e-8, 0]
    return V, np.stack([random.permutation(n)[:3] for _ in range(f)])


def soup(random: np.random.Generator) -> Mesh:
    """Triangles without common vertices, whose corners are equal or almost equal."""
    V, F = (voxels, sphere, box)[random.integers(3)](random)
    F = F[:200]
    jitter = random.choice([0, 1e-12, 1e-7, 1e-4])
    return V[F].reshape(-1, 3) + jitter * random.normal(size=(F.size, 3)), np.arange(F.size).reshape(-1, 3)


def scales(random: np.random.Generator) -> Mesh:
    """Several spheres and boxes whose sizes differ by up to nine powers of ten."""
    parts = [(sphere, box)[random.integers(2)](random) for _ in range(3)]
    first = np.cumsum([0, *(len(V) for V, _ in parts)])
    V = np.concatenate([V * 10.0 ** random.uniform(-9, 0) + k for k, (V, _) in enumerate(parts)])
    return V, np.concatenate([F + start for (_, F), start in zip(parts, first, strict=False)])


def rough(random: np.random.Generator) -> Mesh:
    """The zero set of a noisy field."""
    waves = random.normal(size=(12, 3)) * random.uniform(2, 8)
    phase, weight = random.uniform(0, 7, 12), random.uniform(0, 0.08)

    def field(x: NDArray[np.float64]) -> NDArray[np.float64]:
        noise: NDArray[np.float64] = np.sin(x @ waves.T + phase).sum(axis=-1)
        return np.linalg.norm(x, axis=-1) - 0.7 + weight * noise

    return surface_net(field, [-1.9] * 3, [1.9] * 3, float(random.choice([0.4, 0.25, 0.15])))


def almost_flat(random: np.random.Generator) -> Mesh:
    """A model of flat faces with noise of 1e-7 to 1e-3 of its size."""
    made = (hard_models.stairs, hard_models.channel, hard_models.house, hard_models.plate, hard_models.gear)
    V, F = split_edges(*made[random.integers(5)](), int(random.integers(0, 2)))
    size = float(np.linalg.norm(np.ptp(V, axis=0)))
    return V + 10.0 ** random.uniform(-7, -3) * size * random.normal(size=V.shape), F


def almost_symmetric(random: np.random.Generator) -> Mesh:
    """A model of mirrored parts, some vertices of which may be moved by up to 1e-3 of its size."""
    half = hard_models.moved(hard_models.together(box(random), profile(random)), [2, 0, 0])
    body = hard_models.robot()
    V, F = hard_models.together(body, hard_models.mirrored(half))
    moved = random.random((len(V), 1)) < random.choice([0, 0.01, 1])
    return V + moved * 10.0 ** random.uniform(-8, -3) * random.normal(size=V.shape), F


def dented(random: np.random.Generator) -> Mesh:
    """A sphere with creases all over."""
    return hard_models.golf_ball(random, int(random.integers(1, 4)), random.uniform(0.01, 0.3))


def long_strip(random: np.random.Generator) -> Mesh:
    """A belt or a tube that is longer than the texture."""
    n = int(random.integers(20, 200))
    if random.random() < 0.5:
        return hard_models.tube(int(random.integers(3, 20)), random.uniform(0.05, 0.5), n / 4, n)
    x = np.cumsum(random.uniform(0.2, 1, n))
    wave = np.stack([x, 0 * x, np.sin(x) * random.uniform(0, 1)], axis=1)
    return hard_models.sheet(np.stack([wave, wave + np.array([0, 1, 0])], axis=1))


def relief(random: np.random.Generator) -> Mesh:
    """Hundreds of small flats, many of which touch themselves or others in vertices and at edges."""
    return hard_models.terrain(int(random.integers(4, 16)), random)


def holes(random: np.random.Generator) -> Mesh:
    """A plate with up to a hundred holes, or a flat sheet with up to a thousand."""
    across, deep = random.integers(1, 11, 2).tolist()
    if random.random() < 0.5:
        V, F = hard_models.pierced(4 * across, 3 * deep, random.uniform(0.01, 0.49), 8)
        return V, F[random.random(len(F)) < random.choice([1.0, 0.9])]
    return hard_models.plate(across, deep, random.uniform(0.01, 0.49), 10.0 ** random.uniform(-3, 0), 8)


def twisted(random: np.random.Generator) -> Mesh:
    """A band of flats that is closed after up to five half turns."""
    n = int(random.integers(3, 60))
    return hard_models.twisted_band(n, half_turns=int(random.integers(0, 6)), width=random.uniform(0.05, 0.9))


FAMILIES: tuple[Callable[[np.random.Generator], Mesh], ...] = (
    sphere, voxels, box, profile, thin, soup, scales, rough,
    almost_flat, almost_symmetric, dented, long_strip, relief, holes, twisted,
)  # fmt: skip


def find_fault(V: NDArray[np.float64], F: NDArray[np.int64], bound: float) -> str:
    """Unwrap a model; return what is wrong, or an empty text."""
    try:
        result = unwrap(V, F, max_stretch=bound, resolution=1024, padding=1)
    except ValueError as error:
        known = "are degenerate" in str(error) or "do not fit" in str(error)
        return "" if known else f"ValueError: {error}"
    except Exception:
        return traceback.format_exc(limit=-1).replace("\n", " ")
    vmapping, indices, _ = result
    if not result.certificate.bijective:
        return result.certificate.summary()
    return "" if np.array_equal(vmapping[indices], F) else "the vertices of triangles differ"


def main() -> int:
    """Unwrap models and count failures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=2000, help="number of models")
    parser.add_argument("--first", type=int, default=0, help="number of the first model")
    parser.add_argument("--family", choices=[family.__name__ for family in FAMILIES], help="this family alone")
    arguments = parser.parse_args()
    failures = 0
    for k in range(arguments.first, arguments.first + arguments.n):
        family = FAMILIES[k % len(FAMILIES)]
        if arguments.family:
            family = next(one for one in FAMILIES if one.__name__ == arguments.family)
        V, F = family(np.random.default_rng(k))
        bound, begin = BOUNDS[k // len(FAMILIES) % len(BOUNDS)], time.process_time()
        fault = find_fault(V, F, bound)
        seconds = time.process_time() - begin
        if fault or seconds > 60:
            print(f"{k}: {family.__name__}, {len(F)} triangles, bound {bound}, {seconds:.0f} s: {fault}", flush=True)
        failures += bool(fault)
    print(f"{failures} failures among {arguments.n} models")
    return int(failures > 0)


if __name__ == "__main__":
    raise SystemExit(main())
