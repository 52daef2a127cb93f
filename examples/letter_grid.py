"""An outline fitted to a grid
==============================

The outline of a letter is optimised so that marked interior points lie on a grid. Left: before; middle: after;
right: both outlines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from common import INK, RED, flips, panels, run, save, show
from quasiharmonic import Problem, polish_derivative, solve, surfaces
from quasiharmonic.targets import boundary_to, filled, letter

Array = NDArray[np.float64]
# Weight of the outline's squared displacement, relative to the squared distance of the marks.
PRICE = 1e-4
# Width of the smoothing kernel along the outline, in vertices.
WIDTH = 2.0


def smooth(field: Array, width: float) -> Array:
    """Convolve a field (k, 2) along the outline with a bell ``width`` vertices wide; the operation is self-adjoint."""
    frequency = np.fft.rfftfreq(len(field))
    bell = np.exp(-0.5 * (2 * np.pi * frequency * width) ** 2)
    return np.fft.irfft(bell[:, None] * np.fft.rfft(field, axis=0), n=len(field), axis=0)


def main(output: Path, size: int = 26, steps: int = 40) -> dict[str, Any]:
    V, F = surfaces.cat(size)
    fixed, drawn = boundary_to(V, F, filled(letter("H")))
    problem = Problem(V, F, fixed, drawn)
    first = solve(problem, polish="symmetric-dirichlet")
    # The marks are vertices near the nodes of a grid in the first map, after a bend.
    stems, bar = np.linspace(0.08, 0.65, 6), [(0.33, 0.382), (0.42, 0.382), (0.51, 0.382)]
    nodes = np.array([(x, y) for x in (0.14, 0.23, 0.605, 0.695) for y in stems] + bar)
    bent = nodes + 0.02 * np.sin([9, 14] * nodes[:, ::-1] + [0.5, 0.3])
    marks = np.array([np.argmin(np.linalg.norm(first.uv - place, axis=1)) for place in bent])
    # After too long a step the map may be in another local minimum, so each search starts at the best map so far.
    start, lowest = first.uv, np.inf

    def value(bends: Array) -> tuple[float, Array]:
        nonlocal start, lowest
        bends = bends.reshape(-1, 2)
        moved = problem.with_target(drawn + smooth(bends, WIDTH))
        found = solve(moved, polish="symmetric-dirichlet", start=start)
        if not found.injective:
            return 1e3, np.zeros(bends.size)
        derivative = polish_derivative(V, F, found.uv, fixed=fixed)
        off = derivative.uv[marks] - nodes
        cotangent = np.zeros((len(V), 2))
        cotangent[marks] = off
        slope = smooth(derivative.vjp(cotangent).target, WIDTH) + PRICE * bends
        height = 0.5 * float((off**2).sum() + PRICE * (bends**2).sum())
        if height < lowest:
            start, lowest = derivative.uv, height
        return height, slope.ravel()

    best = minimize(value, np.zeros(drawn.size), jac=True, method="L-BFGS-B", options={"maxiter": steps})
    fitted = problem.with_target(drawn + smooth(best.x.reshape(-1, 2), WIDTH))
    last = polish_derivative(V, F, solve(fitted, polish="symmetric-dirichlet", start=start).uv, fixed=fixed).uv

    def off(uv: Array) -> float:
        return float(np.sqrt(((uv[marks] - nodes) ** 2).sum(axis=1).mean()))

    figure, axes = panels(1, 3, (3.6, 4.4))
    for ax, one, uv, title in ((axes[0][0], problem, first.uv, "the letter"), (axes[0][1], fitted, last, "fitted")):
        show(ax, one, uv, title, pins=False)
        ax.plot(*nodes.T, "+", ms=11, color=INK)
        ax.plot(*uv[marks].T, "o", ms=4.5, color=RED)
    for one, style, name in ((problem, ":", "the letter"), (fitted, "-", "fitted")):
        axes[0][2].plot(*np.append(one.target, one.target[:1], axis=0).T, style, color=INK, label=name)
    axes[0][2].plot(*nodes.T, "+", ms=11, color=INK)
    axes[0][2].set_aspect("equal")
    axes[0][2].set_axis_off()
    axes[0][2].legend(loc="upper center", fontsize=9, frameon=False)
    save(figure, output, "letter_grid")
    return {
        "triangles": len(F),
        "marks": len(nodes),
        "evaluations": int(best.nfev),
        "off at first": off(first.uv),
        "off": off(last),
        "outline moved by": float(np.linalg.norm(fitted.target - drawn, axis=1).max()),
        "inverted": flips(fitted, last),
    }


if __name__ == "__main__":
    run(main)
