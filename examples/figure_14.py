"""Figures 14 and 16: distortion and time over a data set
=========================================================

The paper shows the distribution of MIPS over the maps of a benchmark (Du et al. 2020), lower than TLC's, and the time
for each of its meshes beside that of SBP: 0.01 to 5 s for most, where SBP takes 1 to 100 s.

Here are the first 80 problems of a set that is generated (``benchmarks/dataset.py``), or with ``--data FOLDER`` those
of the benchmark itself. All are solved: by the paper's strategy, ``quality``, with si-log first and tanh where that
does not get through, in 0.03 s (median; 7 s at most), and by ``speed``, with tanh first, in 0.01 s (0.3 s). Half of the
meshes have fewer than 200 triangles and a boundary made to be hard; on them si-log does not keep angles better, as it
does on smooth surfaces (Figures 5 and 8): median MIPS is 15 against 12. Polished for least MIPS it is 4.7.

TLC and SBP are other programs; ``qhm report --against`` draws both figures against records of theirs.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from common import BENCHMARKS, COLORS, panels, save
from quasiharmonic import batch
from quasiharmonic.report.numbers import load

sys.path.append(str(BENCHMARKS))
from dataset import drawn, plan, write

RUNS = {
    "quality": (batch.Settings(strategy="quality"), COLORS["si-log"]),
    "speed": (batch.Settings(strategy="speed"), COLORS["tanh"]),
    "speed, then least MIPS": (batch.Settings(strategy="speed", polish="mips"), (0.35, 0.55, 0.25)),
}


def generate(folder: Path, count: int) -> None:
    """The first problems of the generated data set."""
    for kind, family, seed, difficulty, triangles in plan(count):
        write(folder / kind / f"{seed:05d}_{family}", drawn(family, seed, difficulty, triangles))


def main(output: Path, size: int = 80, data: Path | None = None) -> dict[str, Any]:
    runs = {}
    with TemporaryDirectory() as scratch:
        if data is None:
            data = Path(scratch, "data")
            generate(data, size)
        for name, (settings, _) in RUNS.items():
            folder = Path(scratch, name)
            batch.run(data, folder, settings, jobs=1)
            runs[name] = load(folder)
    figure, (axes,) = panels(1, 2, (5.6, 4.4))
    numbers: dict[str, Any] = {}
    for k, ax in enumerate(axes):
        ax.set_position((0.07 + 0.5 * k, 0.13, 0.41, 0.75))
        ax.grid(alpha=0.3)
    for name, run in runs.items():
        good, color = run.certified, RUNS[name][1]
        mips, seconds, triangles = (run.column(column)[good] for column in ("mips", "seconds", "triangles"))
        bins = np.geomspace(1e-2, 1e5, 29)
        axes[0].hist(mips, bins=bins, histtype="step", lw=2, color=color, label=name)
        axes[1].plot(triangles, seconds, "o", ms=4, alpha=0.7, color=color)
        numbers[name] = {
            "problems": len(run.rows),
            "certified": int(good.sum()),
            "MIPS": {f"{q} %": float(f"{np.percentile(mips, q):.3g}") for q in (25, 50, 75, 95)},
            "seconds": {f"{q} %": float(f"{np.percentile(seconds, q):.2g}") for q in (50, 95, 100)},
        }
    axes[0].set(xscale="log", xlabel="MIPS energy", ylabel="maps", title="Figure 14")
    axes[1].set(xscale="log", yscale="log", xlabel="triangles", ylabel="seconds, file to file", title="Figure 16")
    axes[0].legend()
    save(figure, output, "figure_14")
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="DIR", help="folder (figures)")
    parser.add_argument("--size", type=int, default=80, help="problems to generate (80)")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="a data set of one's own, such as the benchmark")
    print(json.dumps(main(**vars(parser.parse_args())), indent=2, ensure_ascii=False))
