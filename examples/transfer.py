"""From one surface to another: a cat with the triangles of a dome, by way of the unit square
=============================================================================================

Two meshes that have nothing in common, a cat's head and a dome, are both mapped onto the unit square, φ and ψ. Where
the maps are bijective, which is decided exactly, so is ψ⁻¹∘φ from the cat to the dome, and whatever is known on the
one can be brought to the vertices of the other. Here it is the cat's own shape: the dome's triangles take it on.

Both squares' sides are along the axes, so that the boundaries, too, have their partners: all 1,261 vertices of the
dome. There and back again, no vertex of the cat is further than 1e-14 of its size from where it was.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import FloatArray, onto, panels, run, save
from quasiharmonic import InverseMap, SurfaceMap, solve, surfaces, targets
from quasiharmonic.plot import plot_map, plot_surface

SQUARE = targets.rectangle(1, 1)


def squared(V: FloatArray, F: NDArray[np.int64]) -> InverseMap:
    """The inverse of a map onto the unit square that keeps angles as well as it can."""
    problem = onto(V, F, SQUARE)
    return InverseMap(V, F, solve(problem, polish="mips").uv)


def dome(rings: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Half an egg over the unit disk, meshed in rings."""
    flat, F = surfaces.disk(rings)
    r = np.hypot(*flat.T)
    return np.column_stack([flat * np.sinc(r / 2)[:, None] * np.pi / 2, 1.3 * np.cos(r * np.pi / 2)]), F


def main(output: Path, size: int = 40) -> dict[str, Any]:
    cat, egg = squared(*surfaces.cat(size)), squared(*dome(size // 2))
    to_cat = SurfaceMap(egg, cat)
    remeshed = to_cat.transfer(cat.V)

    start = cat.vertices()
    back = to_cat(to_cat.inverse()(start))
    figure, axes = panels(1, 4, (3.4, 3.7))
    for ax, title in zip(
        axes[0],
        ("the cat's head", "its map φ", "the dome's map ψ, painted with the cat", "the dome's triangles as a cat"),
        strict=True,
    ):
        ax.set_title(title, size=10)
    plot_surface(cat.V, cat.F, axes[0][0])
    plot_map(cat.V, cat.F, cat.uv, ax=axes[0][1])
    plot_map(remeshed, egg.F, egg.uv, ax=axes[0][2])
    plot_surface(remeshed, egg.F, axes[0][3])
    save(figure, output, "transfer")
    return {
        "triangles": [len(cat.F), len(egg.F)],
        "bijective": [bool(mapped.certificate.bijective) for mapped in (cat, egg)],
        "onto": to_cat.onto,
        "vertices without a partner": int(np.isnan(remeshed).any(axis=1).sum()),
        "there and back": float(np.abs(cat.surface(back) - cat.V).max() / np.ptp(cat.V)),
    }


if __name__ == "__main__":
    run(main)
