"""Figure 2: how the first map of si-log distributes σ₁/σ₂, on the angel that goes onto a G
========================================================================================

The paper compares si-log's first map with TLC's map after 28,000 iterations. si-log has an order of magnitude less
MIPS, and its distribution of σ₁/σ₂ lacks TLC's long tail. TLC is another program and is not run. tanh's first map is
shown instead, because tanh does not favour conformal maps either. Beside them is the map of least MIPS that
quasi-harmonisation finds from tanh's map (§11). Its mean MIPS is even lower, but a tail of triangles has large ratios.
Dotted lines are means over the surface, solid lines the worst triangles. The colours reach the worst of all three maps.

Mean MIPS is 22 for tanh, 6.8 for si-log and 1.7 for the last map. 99 % of the triangles are below 58, 11 and 22.
si-log's distribution is narrow, as in the paper (see Figure 12), except for a few triangles at the inner corner that
were untangled last. The worst of them has 2,900; the worst of the other maps have 197 and 46. In the paper si-log's
largest ratio is also below TLC's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, colorbar, first_map, flips, mips, panels, ratios, run, save, show_ratios
from quasiharmonic.solver.search.harmonising import harmonise_map
from sculptures import seven


def main(output: Path, size: int = 56) -> dict[str, Any]:
    problem = seven(size)["angel onto G"]
    runs = {name: first_map(problem, name) for name in ("tanh", "si-log")}
    maps = {name: result.uv for name, result in runs.items()}
    maps["tanh + MIPS"] = harmonise_map(problem.domain, maps["tanh"], energy="mips", conformal=0).uv
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
        numbers[name]["iterations"] = result.iterations
    colorbar(figure, drawn, extend="neither")
    save(figure, output, "figure_02")
    return numbers


if __name__ == "__main__":
    run(main)
