"""Figure 5: the paths of tanh and si-log on a curved surface that goes onto a G
================================================================================

The paper maps Lucy and counts gradients: tanh is injective in fewer than 60, si-log in 190 and with a MIPS energy an
order of magnitude below others'. TLC has none after 10,000 steps of quasi-Newton, and one after 113 of projected
Newton, which 28,000 more do not bring near si-log's; SBP takes orders of magnitude more. Both are other programs and
not run here. SBP's regularised energy is, descended our own way by Newton's method on the positions (`Untangling`).

Here it is an angel, 8,510 triangles of which Tutte's embedding inverts 747. tanh takes 16 iterations and
ends at MIPS 22.0, si-log 106 and 6.8: the same trade. Both undo most inversions in the first ten iterations, and the
last few triangles take most of the time. `Untangling` takes 40 Newton steps, each as long as several of tanh's: after
the first nearly all triangles are inverted, at the 31st nearly all at once come right, and MIPS is 2.8. V₃ need not
fall at every step: VectorAdam's is not a line search.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from common import COLORS, GREEN, first_map, frames, mips, panels, run, save, show
from quasiharmonic import solve
from quasiharmonic.solver.methods import Untangling
from sculptures import seven

SHOTS = 5


def main(output: Path, size: int = 56) -> dict[str, Any]:
    problem = seven(size)["angel onto G"]
    figure, axes = panels(4, SHOTS, (2.5, 3.0))
    for ax in axes[3]:
        ax.remove()
    curves = [figure.add_axes((0.07 + 0.5 * k, 0.05, 0.41, 0.17)) for k in range(2)]
    numbers: dict[str, Any] = {"triangles": len(problem.F)}
    colors = COLORS | {"untangling": GREEN}
    for row, name in zip(axes, colors, strict=False):
        if name == "untangling":
            result = solve(problem, strategy=[Untangling()], record_every=1)
        else:
            result = first_map(problem, name, record_every=1)
        for ax, at in zip(row, frames([step.inverted**0.5 for step in result.history], SHOTS), strict=True):
            snapshot = result.path[at]
            show(ax, problem, snapshot.uv, f"{name}, iteration {snapshot.iteration}", size=9)
        steps = [step.iteration for step in result.history]
        curves[0].plot(steps, [step.inverted for step in result.history], color=colors[name], lw=2, label=name)
        curves[1].plot(steps, [step.energy for step in result.history], color=colors[name], lw=2, label=name)
        numbers[name] = {
            "flips at the start": result.history[0].inverted,
            "flips": len(result.certificate.inverted),
            "iterations": result.iterations,
            "MIPS": round(mips(problem, result.uv), 2),
        }
    curves[0].set(ylabel="inverted triangles", yscale="symlog", ylim=(0, None))
    # At an injective map's own tensors, which untangling has, it is zero but for rounding.
    curves[1].set(ylabel="V₃ / area", yscale="log", ylim=(1e-6, 2))
    for ax in curves:
        ax.set_xlabel("iteration")
        ax.grid(alpha=0.3)
        ax.legend()
    save(figure, output, "figure_05")
    return numbers


if __name__ == "__main__":
    run(main)
