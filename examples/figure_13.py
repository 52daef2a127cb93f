"""Figures 13 to 16: recorded runs of TLC and SBP
=================================================

Distortion and time on 68 generated problems, from ``benchmarks/records``. The paper shows maps and another benchmark.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from common import BENCHMARKS, COLORS, GREEN, INK, panels, run, save

sys.path.append(str(BENCHMARKS))
from recorded import on_common_problems, read_records, read_repeated_runs, summary

PROGRAMS = {
    "ours speed": COLORS["tanh"],
    "TLC-PN": (0.45, 0.25, 0.6),
    "TLC-QN": (0.75, 0.5, 0.8),
    "SBP": GREEN,
    "anew speed": INK,
}


def main(output: Path) -> dict[str, Any]:
    rows = on_common_problems([*read_records(), *read_repeated_runs()])
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
    return {"problems": len(rows), **summary(rows, list(PROGRAMS))}


if __name__ == "__main__":
    run(main)
