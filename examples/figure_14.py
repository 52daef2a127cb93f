"""Figures 14 and 16: distortion and time over a data set
=========================================================

2,010 generated problems, from ``benchmarks/records/evaluation.csv.gz``: MIPS and time by size and family.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from common import BENCHMARKS, COLORS, panels, run, save

sys.path.append(str(BENCHMARKS))
from recorded import SIZES, Row, by_family, by_si_log, in_bands, number, read_evaluation

SHOWN = {"paper": COLORS["si-log"], "speed": COLORS["tanh"]}
QUANTILES = 10, 50, 90


def ratio(rows: list[Row]) -> np.ndarray:
    """MIPS of si-log's map divided by that of tanh's."""
    return number(rows, "paper_mips") / number(rows, "tanh_mips")


def draw_families(ax: Axes, rows: list[Row]) -> dict[str, list[float]]:
    """Draw a bar per family from the 10th to the 90th percentile, with the median."""
    found = {}
    for family, some in by_family(by_si_log(rows)).items():
        if some:
            low, middle, high = np.percentile(ratio(some), QUANTILES)
            found[family] = [round(float(q), 2) for q in (low, middle, high)]
            ax.plot([low, high], [family] * 2, lw=5, color="0.75", solid_capstyle="butt")
            ax.plot(middle, family, "o", color=COLORS["si-log"])
    ax.invert_yaxis()
    return found


def main(output: Path) -> dict[str, Any]:
    rows = read_evaluation()
    figure, axes = panels(2, 2, (5.8, 4.6))
    for i, line in enumerate(axes):
        for j, ax in enumerate(line):
            ax.set_position((0.08 + 0.5 * j, 0.57 - 0.5 * i, 0.4, 0.37))
            ax.grid(alpha=0.3)
    (left, right), (sizes, families) = axes
    both = [row for row in rows if row["paper_mips"] and row["speed_mips"]]
    numbers: dict[str, Any] = {"problems": len(rows), "solved by both": len(both)}
    for name, color in SHOWN.items():
        mips, seconds = number(both, f"{name}_mips"), number(rows, f"{name}_seconds")
        left.hist(mips, bins=np.geomspace(1e-2, 1e5, 43), histtype="step", lw=2, color=color, label=name)
        right.plot(number(rows, "triangles"), seconds, ".", ms=3, alpha=0.5, color=color)
        numbers[name] = {
            "solved": int((number(rows, f"{name}_stage") > 0).sum()),
            "MIPS": {f"{q} %": float(f"{np.percentile(mips, q):.3g}") for q in (25, 50, 75, 95)},
            "seconds": {f"{q} %": float(f"{np.percentile(seconds, q):.2g}") for q in (50, 95, 100)},
        }
    pairs = by_si_log(rows)
    sizes.plot(number(pairs, "triangles"), ratio(pairs), ".", ms=3, alpha=0.4, color="0.5")
    numbers["si-log"] = {"first": sum(row["paper_stage"] == "1" for row in rows), "compared": len(pairs)}
    numbers["lower"] = round(float((ratio(pairs) < 1).mean()), 2)
    numbers["by size"] = {}
    for (name, some), low, high in zip(in_bands(pairs, "triangles", SIZES).items(), SIZES, SIZES[1:], strict=False):
        quantiles = np.percentile(ratio(some), QUANTILES)
        for q, style in zip(quantiles, (":", "-", ":"), strict=True):
            sizes.plot([low, high], [q, q], style, lw=2, color=COLORS["si-log"])
        numbers["by size"][name] = [round(float(q), 2) for q in quantiles]
    numbers["by family"] = draw_families(families, rows)
    left.set(xscale="log", xlabel="MIPS energy", ylabel="maps", title="Figure 14")
    right.set(xscale="log", yscale="log", xlabel="triangles", ylabel="CPU seconds", title="Figure 16")
    title = "MIPS of si-log's map over tanh's"
    sizes.set(xscale="log", yscale="log", xlabel="triangles", title=title, ylim=(0.1, 30))
    families.set(xscale="log", title=f"{title}: 10, 50, 90 %", xlim=(0.1, 30))
    for ax, line in ((sizes, "axhline"), (families, "axvline")):
        getattr(ax, line)(1, color="black", lw=1)
    left.legend()
    save(figure, output, "figure_14")
    return numbers


if __name__ == "__main__":
    run(main)
