"""Figure 5: paths of tanh and si-log
=====================================

The angel onto G, by tanh, si-log and `Untangling`. si-log takes more iterations and ends at lower distortion than tanh,
as in the paper.
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
            "iterations": result.n_iterations,
            "MIPS": round(mips(problem, result.uv), 2),
        }
    curves[0].set(ylabel="inverted triangles", yscale="symlog", ylim=(0, None))
    # `Untangling` uses the map's own tensors. At an injective map V₃ is zero there, up to rounding.
    curves[1].set(ylabel="V₃ / area", yscale="log", ylim=(1e-6, 2))
    for ax in curves:
        ax.set_xlabel("iteration")
        ax.grid(alpha=0.3)
        ax.legend()
    save(figure, output, "figure_05")
    return numbers


if __name__ == "__main__":
    run(main)
