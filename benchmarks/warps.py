"""Worst stretch of landmark warps by mesh resolution, with landmarks as cusps and with a second-order term.

    python benchmarks/warps.py [-o FOLDER] [--resolutions 16 32 64 128 256]

Three scenes on an image of 257 × 257 pixels: one landmark that moves by 48 pixels, six that move along a circle, a
curve that bends. *Stretch* is the larger of σ₁ and 1/σ₂, the maximum over all triangles. `cusps` is ``smoothness=0``, a
deformation energy of first derivatives alone; `smooth` is the default. Write a table and a plot.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic import distortion, warp_by_landmarks
from quasiharmonic.util.arrays import FloatArray
from speed import machine

RESOLUTIONS = (16, 32, 64, 128, 256)
SIDE = 257
KINDS = {"cusps": 0.0, "smooth": None}


def scenes() -> dict[str, dict[str, Any]]:
    """Return the arguments of `warp_by_landmarks`, by name."""
    middle = (SIDE - 1) / 2
    around = 0.2 * SIDE * np.exp(2j * np.pi * np.arange(6) / 6)
    turned = around * np.exp(0.5j)
    ring, went = (np.stack([z.real, z.imag], axis=1) + middle for z in (around, turned))
    along = np.linspace(0.25, 0.75, 9)
    line = SIDE * np.stack([along, 0.5 + 0 * along], axis=1)
    bend = SIDE * np.stack([along, 0.5 + 0.15 * np.sin(2 * np.pi * (along - 0.25) / 0.5)], axis=1)
    return {
        "one landmark": {"landmarks": [[104, 128]], "target": [[152, 128]]},
        "six, turned": {"landmarks": ring, "target": went},
        "a curve": {"landmarks": [], "target": [], "curves": [(line, bend)]},
    }


def worst(points: FloatArray, F: Any, moved: FloatArray) -> float:
    """Return the worst stretch of a map."""
    measured = distortion(points, F, moved)
    return float(np.maximum(measured.sigma1, 1 / measured.sigma2).max())


def measured(resolutions: list[int]) -> list[dict[str, Any]]:
    """Return a row for each scene, kind and resolution."""
    rows = []
    picture = np.zeros((SIDE, SIDE), dtype=np.uint8)
    for scene, given in scenes().items():
        for kind, smoothness in KINDS.items():
            for resolution in resolutions:
                began = time.process_time()
                warped = warp_by_landmarks(picture, **given, smoothness=smoothness, resolution=resolution)
                rows.append(
                    {
                        "scene": scene,
                        "kind": kind,
                        "resolution": resolution,
                        "stretch": worst(warped.points, warped.F, warped.positions),
                        "seconds": time.process_time() - began,
                        "bijective": warped.result.certificate.bijective,
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
    return rows


def plotted(rows: list[dict[str, Any]], path: Path) -> None:
    """Plot stretch over resolution, a panel for each scene."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(3.6 * len(names), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for panel, scene in zip(panels, names, strict=True):
        for kind, color in zip(KINDS, ((0.85, 0.45, 0.10), (0.16, 0.38, 0.75)), strict=True):
            own = [row for row in rows if row["scene"] == scene and row["kind"] == kind]
            panel.plot([r["resolution"] for r in own], [r["stretch"] for r in own], "o-", color=color, label=kind)
        panel.set_xscale("log", base=2)
        panel.set_yscale("log")
        ticks = sorted({row["resolution"] for row in rows})
        panel.set_xticks(ticks, [str(tick) for tick in ticks])
        panel.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        panel.minorticks_off()
        panel.set(title=scene, xlabel="cells along a side")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("worst stretch")
    panels[0].legend(frameon=False)
    figure.savefig(path, dpi=110)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows in Markdown."""
    resolutions = sorted({row["resolution"] for row in rows})
    lines = [f"| scene | landmarks | {' | '.join(map(str, resolutions))} |", "|" + "---|" * (2 + len(resolutions))]
    for scene, kind in dict.fromkeys((row["scene"], row["kind"]) for row in rows):
        own = {row["resolution"]: row["stretch"] for row in rows if (row["scene"], row["kind"]) == (scene, kind)}
        lines.append(f"| {scene} | {kind} | {' | '.join(f'{own[r]:.2f}' for r in resolutions)} |")
    return "\n".join(lines) + "\n"


def main(output: Path, resolutions: list[int]) -> None:
    rows = measured(resolutions)
    output.mkdir(parents=True, exist_ok=True)
    (output / "warps.md").write_text(f"{machine()}\n\n{table(rows)}", encoding="utf-8")
    plotted(rows, output / "warps.png")
    print(table(rows))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="FOLDER", help="(figures)")
    parser.add_argument("--resolutions", type=int, nargs="+", default=list(RESOLUTIONS), metavar="N")
    main(**vars(parser.parse_args()))
