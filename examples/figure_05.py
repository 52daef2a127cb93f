"""Figure 5: the paths of tanh and si-log on a curved surface that goes onto a G
================================================================================

The paper maps Lucy and counts gradients. tanh is injective in fewer than 60; si-log takes 190 and its MIPS energy is an
order of magnitude below that of other methods. TLC has no injective map after 10,000 quasi-Newton steps and one after
113 projected Newton steps; 28,000 further steps do not reach si-log's energy. SBP takes orders of magnitude more. This
example runs neither program. `Untangling` minimises SBP's regularised energy by Newton's method on the positions.

The surface is an angel with 8,510 triangles, of which Tutte's embedding inverts 747. tanh takes 16 iterations and
reaches MIPS 22.0; si-log takes 106 and reaches 6.8. Both remove most inversions in the first ten iterations, and the
last few triangles take most of the time. `Untangling` takes 40 Newton steps, each as long as several iterations of
tanh. After its first step nearly all triangles are inverted; at the 31st nearly all become positive at once. Its MIPS
is 2.8. V₃ need not decrease at every step, because VectorAdam has no line search.
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
