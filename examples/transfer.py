"""One surface with the triangles of another
============================================

A cat's head and a dome are mapped onto the unit square. The dome's triangles take the shape of the cat.
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


def map_to_square(V: FloatArray, F: NDArray[np.int64]) -> InverseMap:
    """The inverse of a map onto the unit square that preserves angles as far as possible."""
    problem = onto(V, F, SQUARE)
    return InverseMap(V, F, solve(problem, polish="mips").uv)


def dome(rings: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Half an egg over the unit disk, meshed in rings."""
    flat, F = surfaces.disk(rings)
    r = np.hypot(*flat.T)
    return np.column_stack([flat * np.sinc(r / 2)[:, None] * np.pi / 2, 1.3 * np.cos(r * np.pi / 2)]), F


def main(output: Path, size: int = 40) -> dict[str, Any]:
    cat, egg = map_to_square(*surfaces.cat(size)), map_to_square(*dome(size // 2))
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
        "vertices without a corresponding point": int(np.isnan(remeshed).any(axis=1).sum()),
        "there and back": float(np.abs(cat.surface(back) - cat.V).max() / np.ptp(cat.V)),
    }


if __name__ == "__main__":
    run(main)
