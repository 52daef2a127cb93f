"""A UV map repaired
====================

Two islands with inverted triangles (red), before and after ``repair``. Dots are the vertices that moved.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import INK, RED, FloatArray, onto, panels, run, save
from quasiharmonic import inverted_triangles, repair, solve, surfaces, targets
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.plot import plot_map, plot_surface
from quasiharmonic.util.arrays import IntArray


def halves(V: FloatArray, F: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut along the middle and lay the halves side by side: UV positions (m, 2), and their indices for every corner."""
    right = V[F, 0].mean(axis=1) > 0
    places, FT = [], np.empty_like(F)
    for side, middle in ((~right, -0.8), (right, 0.8)):
        used, local = np.unique(F[side], return_inverse=True)
        local = local.reshape(-1, 3)
        problem = onto(V[used], local, targets.ellipse(0.7, 1.0))
        FT[side] = local + sum(map(len, places))
        places.append(solve(problem, polish="symmetric-dirichlet").uv + np.array([middle, 0.0]))
    return np.concatenate(places), FT


def main(output: Path, size: int = 24) -> dict[str, Any]:
    V, F = surfaces.cat(size)
    uv, FT = halves(V, F)
    inner = np.setdiff1d(FT, boundary_edges(FT, len(uv)))
    left, rng = inner[uv[inner, 0] < 0], np.random.default_rng(3)
    dragged = rng.choice(left, 8, replace=False)
    brushed = inner[np.hypot(*(uv[inner] - [0.9, 0.1]).T) < 0.3]
    damaged = uv.copy()
    damaged[dragged] += rng.normal(0, 0.1, (dragged.size, 2))
    damaged[brushed] += rng.normal(0, 0.04, (brushed.size, 2))

    result = repair(V, F, damaged, FT=FT)
    moved = np.flatnonzero((result.uv != damaged).any(axis=1))

    figure, axes = panels(1, 3, (4.4, 3.6))
    plot_surface(V, F, axes[0][0])
    axes[0][0].set_title("the surface", size=10)
    # The surface cut along the seams has one vertex per UV position.
    cut = np.empty((len(uv), 3))
    cut[FT] = V[F]
    for ax, places, title in zip(axes[0][1:], (damaged, result.uv), ("damaged", "repaired"), strict=True):
        flips = inverted_triangles(FT, places)
        plot_map(cut, FT, places, inverted=flips, ax=ax)
        verdict = f"{flips.size} inverted" if flips.size else "none inverted"
        ax.set_title(f"{title}\n{verdict}", size=10, color=RED if flips.size else INK)
    axes[0][2].plot(*result.uv[moved].T, "o", ms=1.5, color="black")
    save(figure, output, "repair")
    return {
        "inverted before": [len(island.inverted_before) for island in result.islands],
        "inverted": [len(island.inverted) for island in result.islands],
        "dragged or brushed": len(dragged) + len(brushed),
        "moved": len(moved),
        "moved of those nobody touched": len(np.setdiff1d(moved, np.concatenate([dragged, brushed]))),
        "boundary moved": len(np.setdiff1d(moved, inner)),
    }


if __name__ == "__main__":
    run(main)
