"""Figure 20: collision avoidance
=================================

Shapes (blue) pressed into an hourglass, a flask and a bend. The air (yellow) has no weight, and nothing overlaps.
Columns: the problem, the paper's method and a barrier method.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from shapely import LineString, Point, Polygon, contains_xy, union_all

from common import INK, panels, run, save
from quasiharmonic import AirMesh, Certificate, certify, harmonise, injective_map
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP, AreaBarrier, Combination, UnsignedARAP
from quasiharmonic.energies.newton.newton_descent import newton_descent
from quasiharmonic.geometry.exact.constrained_delaunay import constrained_delaunay
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

#: Half the width and height of the initial box of each figure, and points along its lower, right, upper, left side.
BOX, COUNTS = (1.5, 2.0), (24, 32, 24, 32)


@dataclass(frozen=True, eq=False)
class Scene:
    """A figure and the air around it as one mesh.

    Attributes
    ----------
    V : (n, 2) float64
        Rest positions; the rim's vertices come last.
    F : (f, 3) int64
    body : (f,) bool
        True for triangles of the figure, False for air.
    rim : (k,) int64
    """

    V: FloatArray
    F: IntArray
    body: BoolArray
    rim: IntArray


def limb(radius: float, *joints: tuple[float, float]) -> Polygon:
    return LineString(joints).buffer(radius)


def holes(*circles: tuple[float, float, float]) -> Polygon:
    return union_all([Point(x, y).buffer(radius) for x, y, radius in circles])


def man() -> Polygon:
    """A man with holes, like cheese."""
    parts = [
        Point(0, 1.0).buffer(0.36),
        limb(0.33, (0, 0.42), (0, -0.3)),
        limb(0.155, (-1.0, 0.62), (0, 0.4), (1.0, 0.62)),
        limb(0.18, (-0.48, -1.3), (-0.14, -0.4), (0.14, -0.4), (0.48, -1.3)),
    ]
    eyes, buttons = (
        ((-0.13, 1.08, 0.07), (0.13, 1.08, 0.07)),
        ((0, 0.44, 0.11), (0.09, 0.1, 0.11), (-0.08, -0.24, 0.11)),
    )
    return union_all(parts).buffer(0.05).buffer(-0.05).difference(holes(*eyes, (0, 0.82, 0.06), *buttons))


def starfish() -> Polygon:
    """A starfish of seven arms around a hole."""
    tips = [(1.15 * float(np.cos(t)), 1.15 * float(np.sin(t))) for t in 2 * np.pi * (np.arange(7) / 7 + 0.03)]
    body = union_all([Point(0, 0).buffer(0.42), *(limb(0.13, (0, 0), tip) for tip in tips)])
    return body.buffer(0.05).buffer(-0.05).difference(holes((0, 0, 0.2)))


def wrench() -> Polygon:
    """A bar with an open jaw at each end, and a hole."""
    bar = union_all([limb(0.16, (0, -1.1), (0, 1.1)), Point(0, 1.25).buffer(0.42), Point(0, -1.25).buffer(0.42)])
    jaws = union_all([limb(0.14, (0, 1.3), (0, 2.0)), limb(0.14, (0, -1.3), (0, -2.0))])
    return bar.buffer(0.06).buffer(-0.06).difference(jaws).difference(holes((0, 0.5, 0.07)))


def around(corners: Sequence[complex], bulge: float = 0.0) -> FloatArray:
    """Points along a polygon's four sides, which ``bulge`` bends outwards."""
    points = []
    for a, b, count in zip(corners, [*corners[1:], corners[0]], COUNTS, strict=True):
        t = np.arange(count) / count
        points.append(a + t * (b - a) - 4j * bulge * t * (1 - t) * (b - a))
    z = np.concatenate(points)
    return np.stack([z.real, z.imag], axis=1)


def box() -> FloatArray:
    a, b = BOX
    return around([complex(-a, -b), complex(a, -b), complex(a, b), complex(-a, b)], bulge=0.02)


def hourglass(neck: float = 0.22) -> FloatArray:
    """The box, smaller and narrowed in the middle."""
    x, y = 0.72 * box().T
    return np.stack([x * (neck + (1 - neck) * np.clip(np.abs(y), 0, 1) ** 1.5), 1.2 * y], axis=1)


def flask(neck: float = 0.3) -> FloatArray:
    """The box, smaller and with a long neck above."""
    x, y = 0.62 * box().T
    t = np.clip((y + 0.2) / 0.6, 0, 1)
    return np.stack([x * (1 + (neck - 1) * t * t * (3 - 2 * t)), 1.1 * y], axis=1)


def bend(width: float = 0.3) -> FloatArray:
    """The box, narrowed and bent into most of a circle."""
    x, y = box().T
    angle, radius = np.pi * (0.5 + 0.7 * y / BOX[1]), 0.8 - width * x
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1) * (-1, 1)


SCENES = {
    "man into an hourglass": (man, hourglass),
    "starfish into a flask": (starfish, flask),
    "wrench into a bend": (wrench, bend),
}


def scene(shape: Polygon, spacing: float) -> Scene:
    """Mesh a shape and the air up to the box, with point distances of about ``spacing``."""
    rim, loops = box(), []
    for ring in (shape.exterior, *shape.interiors):
        at = np.arange(max(8, round(ring.length / spacing)))
        loops.append(np.array([ring.interpolate(t, normalized=True).coords[0] for t in at / len(at)]))
    x, y = np.meshgrid(np.arange(-1.6, 1.6, spacing), np.arange(-2.1, 2.1, spacing * np.sqrt(0.75)))
    x[::2] += spacing / 2
    inner = np.stack([x.ravel(), y.ravel()], axis=1)
    lines = union_all([LineString([*loop, loop[0]]) for loop in (*loops, rim)])
    inner = inner[contains_xy(Polygon(rim), *inner.T) & ~contains_xy(lines.buffer(0.6 * spacing), *inner.T)]
    V = np.concatenate([*loops, inner, rim])
    first = np.cumsum([0, *map(len, loops)])
    segments = np.concatenate(
        [
            np.stack([k + np.arange(len(loop)), k + np.roll(np.arange(len(loop)), -1)], axis=1)
            for k, loop in zip(first, loops, strict=False)
        ]
    )
    hull = len(V) - len(rim) + np.arange(len(rim))
    F = constrained_delaunay(V, segments, hull)
    return Scene(V, F, contains_xy(Polygon(loops[0], loops[1:]), *V[F].mean(axis=1).T), hull)


def newton(here: Scene, uv: FloatArray, air_weight: float = 1e-3, steps: int = 300) -> tuple[FloatArray, int]:
    """Minimise ARAP with a barrier on the same mesh; return the map and the number of steps."""
    weights = np.where(here.body, 1.0, air_weight)
    energy = DeformationEnergy(here.V, here.F, Combination((1.0, ARAP()), (0.1, AreaBarrier())), weights=weights)
    (descent, model), taken = newton_descent(energy, uv, here.rim, 0, "auto"), 0
    while taken < steps and descent.step(1e-4) is None:
        taken += 1
    return model.positions(descent.w), taken


def draw(ax: Axes, points: FloatArray, body: IntArray, air: IntArray, title: str) -> None:
    for triangles, face, edge in ((air, "#fbe7a1", "#e3b93c"), (body, "#4f7fd0", "#24447e")):
        ax.add_collection(PolyCollection(points[triangles], facecolors=face, edgecolors=edge, linewidths=0.25))
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(title, size=9, color=INK)


def main(output: Path, size: int = 10, iterations: int = 200, scenes: int = 3) -> dict[str, Any]:
    figure, axes = panels(scenes, 5, (2.6, 3.2))
    numbers: dict[str, Any] = {}
    for row, (name, (shape, container)) in zip(axes, SCENES.items(), strict=False):
        here, target = scene(shape(), 1 / size), container()
        body, air = here.F[here.body], here.F[~here.body]
        used, own = np.unique(body, return_inverse=True)
        own = own.reshape(-1, 3)
        elastic = DeformationEnergy(here.V[used], own, UnsignedARAP())
        numbers[name] = {"triangles": len(here.F), "of the figure": len(body)}

        def note(
            how: str,
            points: FloatArray,
            began: float,
            certificate: Certificate,
            solves: int | None = None,
            elastic: DeformationEnergy = elastic,
            row: dict[str, Any] = numbers[name],
        ) -> float:
            spent = time.process_time() - began
            energy = elastic.value(points @ (1, 1j))
            row[how] = {"energy": float(f"{energy:.3g}"), "bijective": certificate.bijective, "solves": solves}
            row[how]["CPU seconds"] = float(f"{spent:.2g}")
            return energy

        began = time.process_time()
        first = injective_map(here.V, here.F, here.rim, target)
        energy = note("first map", first.uv[used], began, first.certificate, first.n_iterations)
        draw(row[0], first.uv, body, air, f"{name}:\nfirst map, ARAP {energy:.3f}")
        weights = here.body.astype(np.float64)
        for ax, how, options in (
            (row[1], "paper's way", {}),
            (row[2], "paper's way, longer", {"max_iterations": iterations}),
            (None, "paper's way, η = 1e-4", {"max_iterations": iterations, "eta": 1e-4}),
        ):
            began = time.process_time()
            result = harmonise(
                *(here.V, here.F, first.uv),
                fixed=here.rim,
                energy="arap-unsigned",
                weights=weights,
                scaled=False,
                **options,
            )
            energy = note(how, result.uv[used], began, result.certificate, len(result.history) - 1)
            if ax is not None:
                draw(ax, result.uv, body, air, f"{how}:\n{len(result.history) - 1} solves, ARAP {energy:.3f}")
        began = time.process_time()
        uv, steps = newton(here, first.uv)
        energy = note("barrier, the same air", uv[used], began, certify(here.F, uv), steps)
        draw(row[3], uv, body, air, f"barrier, the same air:\n{steps} Newton steps, ARAP {energy:.3f}")
        began = time.process_time()
        moment = AirMesh(here.V[used], own, [here.V[here.rim]]).advance([target])
        energy = note("barrier, fresh air", moment.points[: len(used)], began, moment.certificate)
        draw(row[4], moment.points, moment.F, moment.air, f"barrier, fresh air:\nARAP {energy:.3f}")
    save(figure, output, "figure_20")
    return numbers


if __name__ == "__main__":
    run(main)
