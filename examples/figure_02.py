"""Figure 2: the distribution of σ₁/σ₂
======================================

First maps of tanh and si-log, and a quasi-harmonised map of the angel. Dotted: means; solid: worst triangles. The paper
shows TLC instead of tanh.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, colorbar, first_map, flips, mips, panels, ratios, run, save, show_ratios
from quasiharmonic import harmonise
from sculptures import seven


def main(output: Path, size: int = 56) -> dict[str, Any]:
    problem = seven(size)["angel onto G"]
    runs = {name: first_map(problem, name) for name in ("tanh", "si-log")}
    maps = {name: result.uv for name, result in runs.items()}
    maps["tanh + MIPS"] = harmonise(
        problem.V, problem.F, maps["tanh"], fixed=problem.fixed, energy="mips", conformal=0
    ).uv
    colors = {**COLORS, "tanh + MIPS": (0.35, 0.55, 0.25)}
    figure, axes = panels(2, len(maps), (3.6, 3.9))
    numbers: dict[str, Any] = {"triangles": len(problem.F)}
    worst = max(float(ratios(problem, uv)[0].max()) for uv in maps.values())
    for k, (name, uv) in enumerate(maps.items()):
        ratio, share = ratios(problem, uv)
        title = f"{name}: MIPS {mips(problem, uv):.3g}, σ₁/σ₂ up to {ratio.max():,.0f}"
        drawn = show_ratios(axes[0][k], problem, uv, title, worst)
        mean = float(share @ ratio)
        below = axes[1][k]
        below.set_position(((k + 0.18) / len(maps), 0.07, 0.76 / len(maps), 0.36))
        below.hist(ratio, bins=np.geomspace(1, 10_000, 121), weights=share, color=colors[name])
        below.axvline(mean, color="black", lw=0.8, ls=":")
        below.axvline(ratio.max(), color="black", lw=0.8)
        below.set(xscale="log", yscale="log", ylim=(1e-5, 1), xlabel="σ₁/σ₂", ylabel="part of the surface")
        numbers[name] = {
            "flips": flips(problem, uv),
            "MIPS": round(mips(problem, uv), 3),
            "mean": round(mean, 2),
            "99 % below": round(float(np.quantile(ratio, 0.99)), 1),
            "max": float(f"{ratio.max():.3g}"),
        }
    for name, result in runs.items():
        numbers[name]["iterations"] = result.n_iterations
    colorbar(figure, drawn, extend="neither")
    save(figure, output, "figure_02")
    return numbers


if __name__ == "__main__":
    run(main)
