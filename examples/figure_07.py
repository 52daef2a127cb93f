"""Figure 7: the two parameterisations
======================================

The curves |ξ| ↦ |μ|, and the |ξ| that a given σ₁/σ₂ needs. It grows logarithmically for tanh and exponentially for
si-log.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, panels, run, save
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS


def main(output: Path) -> dict[str, Any]:
    figure, [axes] = panels(1, 2, (5, 4))
    for k, ax in enumerate(axes):
        ax.set_position((0.08 + 0.5 * k, 0.15, 0.39, 0.75))
    numbers = {}
    for name, parameterisation in PARAMETERISATIONS.items():
        rho = np.linspace(0, 5, 400)
        axes[0].plot(rho, rho * parameterisation.radial(rho)[0], color=COLORS[name], lw=2, label=name)
        distortion = np.geomspace(1, 1000, 400)[1:]
        far = parameterisation.inverse((distortion - 1) / (distortion + 1))
        shown = far < 1e12
        axes[1].plot(distortion[shown], far[shown], color=COLORS[name], lw=2, label=name)
        numbers[name] = {
            "|μ| at |ξ| = 1": float(parameterisation.radial(np.ones(1))[0][0]),
            "|ξ| at |μ| = 0.9": float(parameterisation.inverse(np.array([0.9]))[0]),
        }
    axes[0].set(xlabel="|ξ|", ylabel="|μ| = r(|ξ|)", ylim=(0, 1))
    axes[1].set(xlabel="σ₁/σ₂", ylabel="|ξ| that it takes", xscale="log", yscale="log", xlim=(1, 1000))
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.legend()
    save(figure, output, "figure_07")
    return numbers


if __name__ == "__main__":
    run(main)
