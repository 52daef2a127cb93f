"""Figure 24: areas alone, or angles alone: SBP's two terms and quasi-harmonisation
=================================================================================

SBP minimises ``(1 − θ) MIPS + θ E_a`` with E_a = det J + 1/det J − 2. The paper reports that its program fails for θ =
1 on all letters but David to A, and that θ = 0 gives maps of extreme scale at the boundary. It compares the former
with its own area-preserving maps.

SBP must find an injective map first. From a given injective map, `polish` can minimise both of its terms until it has
converged. The first and the third column show this: θ = 1 does not fail, and areas are off by 0.2 to 8 % on average.
With quasi-harmonisation the area energy is less reduced within its 160 linear solves, to 5 to 35 %. Its maps have a
quarter of the shear where the target is narrow (mean MIPS of 11 against 45 on R, and 25 against 101 on H). For energies
with a barrier and second derivatives Newton's method is better; quasi-harmonisation needs neither.

The last column represents SBP itself. `Untangling` minimises its regularised energy of both terms by Newton's method on
the positions, until the first injective map. The weight of areas is 10⁻⁴ instead of 1/128. Angles are preserved as well
as by si-log or better, and areas as poorly as with θ = 0.

θ = 0 behaves as the paper says: areas span 7 to 11 orders of magnitude, and triangles at the boundary grow to between
28 and 67 times their area. si-log's first map, which minimises no angle energy, spans nearly as many but grows at most
27 times.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm

from common import INK, RED, colorbar, first_map, flips, mips, panels, run, save
from quasiharmonic import Problem, distortion, solve
from quasiharmonic.energies.energies import conformal_area_blend
from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.solver.methods import Untangling, VectorAdam
from quasiharmonic.solver.search.harmonising import harmonise_map
from quasiharmonic.util.arrays import FloatArray
from sculptures import seven

COLUMNS = "bust onto A", "rabbit onto R", "gargoyle onto H"


def maps_of(problem: Problem) -> dict[str, FloatArray]:
    """The maps to compare, by name."""
    first = solve(problem, strategy=[VectorAdam(iterations=600)]).uv
    return {
        "θ = 1: areas": polish_map(problem.domain, first, energy=conformal_area_blend(1.0)).uv,
        "(σ₁σ₂ − 1)² and V₃": harmonise_map(problem.domain, first, energy="area").uv,
        "θ = 0: angles": polish_map(problem.domain, first, energy="mips").uv,
        "si-log's first": first_map(problem, "si-log").uv,
        "SBP's energy, our way": solve(problem, strategy=[Untangling()]).uv,
    }


def show_areas(ax: Axes, problem: Problem, uv: FloatArray, title: str) -> PolyCollection:
    """Draw a map coloured by its area ratio, with mean 1, and return the collection for a colour bar."""
    ratio = distortion(problem.V, problem.F, uv).area_ratio
    drawn = PolyCollection(
        uv[problem.F], array=ratio, cmap="RdBu_r", norm=LogNorm(0.1, 10), edgecolors="face", lw=0.3, snap=False
    )
    ax.add_collection(drawn)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(title, size=9, color=RED if flips(problem, uv) else INK)
    return drawn


def main(output: Path, size: int = 40) -> dict[str, Any]:
    figure, axes = panels(len(COLUMNS), 5, (2.6, 3.0))
    numbers: dict[str, Any] = {}
    for row, name in zip(axes, COLUMNS, strict=True):
        problem = seven(size)[name]
        found: dict[str, Any] = {"triangles": len(problem.F)}
        for ax, (title, uv) in zip(row, maps_of(problem).items(), strict=True):
            d = distortion(problem.V, problem.F, uv)
            off = float(d.share @ np.abs(d.area_ratio - 1))
            drawn = show_areas(ax, problem, uv, f"{title}\nareas off by {off:.2g}, MIPS {mips(problem, uv):.3g}")
            found[title] = {
                "flips": flips(problem, uv),
                "areas off by": round(off, 4),
                "MIPS": round(mips(problem, uv), 3),
                "max(σ₁, 1/σ₂)": float(f"{d.summary('isometric').maximum:.3g}"),
            }
        numbers[name] = found
    colorbar(figure, drawn, "area over area at rest", "both")
    save(figure, output, "figure_24")
    return numbers


if __name__ == "__main__":
    run(main)
