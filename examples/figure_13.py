"""Figures 13 to 16: beside TLC and SBP, from records of theirs
=============================================================

The paper shows maps of TLC alone (Figure 13) and of SBP alone (Figure 15). Figure 14 shows MIPS over a benchmark, lower
than TLC's. Figure 16 shows times of 0.01 to 5 s for most meshes where SBP takes 1 to 100 s.

TLC and SBP are not installable packages. Their results on 68 problems of this project's generator, with 300 to 6,000
triangles, were measured once. ``benchmarks/records`` keeps the results with versions, settings and machine, but not the
maps. Figures 13 and 15 are therefore drawn as statistics. TLC's first maps have median MIPS energies of 90 and 46,
this project's 14. SBP minimises its energy until it has converged and reaches 6.4, below this project's first maps.
The claim of Figure 14 about TLC is thus reproduced; the paper makes no such claim about SBP. After polishing for least
MIPS all methods reach 6.3 to 6.6.

Of 44 problems known to have a map this project solves 44, SBP 42, TLC-QN 36 and TLC-PN 34, with default tolerances. In
CPU time it is faster than SBP on 49 of 50 problems that both solve, and than TLC-PN on 41 of 43. TLC-QN is close: its
median time is 1.5 times as long, and it is faster on 17 of 42. This project's defaults were developed on problems of
this generator, and those of the other programs elsewhere.

The comparison used version 0.1.0 of this project. `Untangling`, which minimises SBP's regularised energy by Newton's
method, was run later on the same problems. Compared with `speed` on the same day it solves 43 of the 44 in 2.2
times the time, with MIPS energies of 9.6. ``benchmarks/rivals.py --anew`` runs this project's solver again.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from common import BENCHMARKS, COLORS, GREEN, INK, panels, run, save

sys.path.append(str(BENCHMARKS))
from rivals import kept, on_common_problems, recorded, summary

PROGRAMS = {
    "ours speed": COLORS["tanh"],
    "TLC-PN": (0.45, 0.25, 0.6),
    "TLC-QN": (0.75, 0.5, 0.8),
    "SBP": GREEN,
    "anew untangling": INK,
}


def main(output: Path) -> dict[str, Any]:
    rows = on_common_problems([*recorded(), *kept()])
    figure, (axes,) = panels(1, 2, (5.6, 4.4))
    for k, ax in enumerate(axes):
        ax.set_position((0.07 + 0.5 * k, 0.13, 0.41, 0.75))
        ax.grid(alpha=0.3)
    bins = np.geomspace(1e-1, 1e5, 25)
    for name, color in PROGRAMS.items():
        runs = [row[name] for row in rows.values() if row[name].injective]
        axes[0].hist([r.mips for r in runs], bins=bins, histtype="step", lw=2, color=color, label=name)
        axes[1].plot([r.triangles for r in runs], [r.seconds for r in runs], "o", ms=4, alpha=0.7, color=color)
    axes[0].set(xscale="log", xlabel="MIPS energy of injective maps", ylabel="maps", title="Figures 13 to 15")
    axes[1].set(xscale="log", yscale="log", xlabel="triangles", ylabel="CPU seconds", title="Figure 16")
    axes[1].set_xticks([300, 1000, 3000], ["300", "1,000", "3,000"])
    axes[1].set_xticks([], minor=True)
    axes[0].legend(fontsize=9)
    save(figure, output, "figure_13")
    return {"problems": len(rows), **summary(rows, [*list(PROGRAMS)[:-1], "anew speed", "anew untangling"])}


if __name__ == "__main__":
    run(main)
