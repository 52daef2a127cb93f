"""Sequences of maps: vertex motion between frames, for frames polished independently and for `animate`.

    OMP_NUM_THREADS=1 python benchmarks/sequences.py [-o FOLDER] [--frames N]

Scenes: an outline that becomes a star and turns, an outline that breathes, a bar that bends, a hole that travels
through a disk, a circle that becomes a letter. Each frame is polished independently, from the previous frame, and by
`animate`. For each frame, report the maximum vertex displacement relative to the maximum boundary displacement. Report
also the mean energy and CPU seconds. Write a table, and a plot of the scenes in which a vertex moves farther than the
boundary.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quasiharmonic import Problem, animate, boundary_loops, solve
from quasiharmonic.surfaces import annulus, cat, grid
from quasiharmonic.targets import boundary_to, letter
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine

ENERGY = "symmetric-dirichlet"
#: The methods: each frame polished independently, each from the previous one, and `animate`.
ALONE, ONWARDS = "each frame alone", "each from the last frame"
WAYS = ALONE, ONWARDS, "animate"
#: Default limit of `animate` for the largest vertex motion, relative to the boundary's.
LIMIT = 3.0
#: Largest relative motion of a scene without a panel in the plot.
NOTABLE = 1.5

Scene = tuple[FloatArray, IntArray, IntArray, FloatArray]


def turning_star(frames: int) -> Scene:
    """A circle that becomes a star, turns and becomes a circle again."""
    V, F = cat(20)
    loop = boundary_loops(F, len(V))[0]
    angle = 2 * np.pi * np.arange(loop.size) / loop.size
    targets = []
    for t in np.linspace(0, 1, frames):
        here = angle + 0.18 * np.sin(np.pi * t) * np.cos(3 * angle)
        radius = 1 + 0.75 * np.sin(np.pi * t) ** 2 * np.cos(5 * angle + 2 * np.pi * t)
        targets.append(np.stack([radius * np.cos(here), radius * np.sin(here)], axis=1))
    return V, F, loop, np.array(targets)


def breathing(frames: int) -> Scene:
    """An hourglass whose waist narrows to a tenth and widens again, twice, while it shears."""
    V, F = cat(20)
    loop = boundary_loops(F, len(V))[0]
    angle = 2 * np.pi * np.arange(loop.size) / loop.size
    targets = []
    for t in np.linspace(0, 1, frames):
        waist = 1 - 0.9 * np.sin(2 * np.pi * t) ** 2
        y = np.sin(angle)
        x = np.cos(angle) * (waist + (1 - waist) * np.abs(y) ** 2) + 0.8 * np.sin(2 * np.pi * t) * y
        targets.append(np.stack([x, y], axis=1))
    return V, F, loop, np.array(targets)


def bending_bar(frames: int) -> Scene:
    """A bar of size 10 × 1 that bends almost into a ring, in both directions."""
    V, F = grid(100, 10)
    V = V * [10, 1]
    loop = boundary_loops(F, len(V))[0]
    targets = []
    for t in np.linspace(0, 1, frames):
        turn = 1.9 * np.pi * np.sin(2 * np.pi * t)
        x, y = V[loop, 0] / 10 - 0.5, V[loop, 1] - 0.5
        a = turn * x
        along, up = 10 * x * np.sinc(a / np.pi), 10 * x * a / 2 * np.sinc(a / (2 * np.pi)) ** 2
        targets.append(np.stack([along - y * np.sin(a), up + y * np.cos(a)], axis=1))
    return V, F, loop, np.array(targets)


def travelling_hole(frames: int) -> Scene:
    """A round hole that circles in a disk, close to its boundary."""
    V, F = annulus(24)
    loops = sorted(boundary_loops(F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
    fixed = np.concatenate(loops)
    inner = V[loops[1]] * (0.25 / np.abs(V[loops[1]]).max())
    targets = []
    for t in np.linspace(0, 1, frames):
        away = 0.62 * np.sin(np.pi * t)
        centre = away * np.array([np.cos(4 * np.pi * t), np.sin(4 * np.pi * t)])
        targets.append(np.concatenate([V[loops[0]], inner + centre]))
    return V, F, fixed, np.array(targets)


def becoming_letter(frames: int) -> Scene:
    """A circle that becomes a letter; every boundary vertex moves on a straight line."""
    V, F = cat(20)
    loop, first = boundary_to(V, F, letter("S"))
    angle = 2 * np.pi * np.argsort(np.argsort(_around(F, len(V), loop))) / loop.size
    disk = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Rotate the circle so that its vertices are closest to their positions on the letter.
    w, z = first[:, 0] + 1j * first[:, 1], disk[:, 0] + 1j * disk[:, 1]
    w = w - w.mean()
    z = z * np.abs(w).mean() * np.exp(1j * np.angle(np.vdot(z, w)))
    between = [z + t * (w - z) for t in np.linspace(0, 1, frames)]
    return V, F, loop, np.array([np.stack([p.real, p.imag], axis=1) for p in between])


def _around(F: IntArray, n: int, fixed: IntArray) -> IntArray:
    """Return the rank of each fixed vertex along the boundary."""
    rank = np.full(n, -1)
    loop = boundary_loops(F, n)[0]
    rank[loop] = np.arange(loop.size)
    return rank[fixed]


SCENES: dict[str, Callable[[int], Scene]] = {
    "star": turning_star,
    "hourglass": breathing,
    "bar": bending_bar,
    "hole": travelling_hole,
    "letter": becoming_letter,
}


def moves(uv: FloatArray, targets: FloatArray) -> FloatArray:
    """Return the maximum vertex displacement per step, relative to the boundary's; NaN if the boundary is static."""
    vertex = np.linalg.norm(np.diff(uv, axis=0), axis=2).max(axis=1)
    boundary = np.linalg.norm(np.diff(targets, axis=0), axis=2).max(axis=1)
    return vertex / np.where(boundary > 0, boundary, np.nan)


def ways(scene: Scene) -> dict[str, tuple[FloatArray, FloatArray, float]]:
    """Return the relative displacements, mean energies and CPU seconds of each method, by name."""
    V, F, fixed, targets = scene
    problem = Problem(V, F, fixed, targets[0])
    found = {}
    for name in WAYS:
        began = time.process_time()
        if name == "animate":
            animation = animate(problem, targets, polish=ENERGY, max_motion_ratio=LIMIT)
            assert animation.found.all(), animation.summary()
            uv, energies = animation.uv, animation.energies
        else:
            results, last = [], None
            for target in targets:
                start = last if name == ONWARDS else None
                results.append(solve(problem.with_target(target), start=start, polish=ENERGY))
                assert results[-1].injective, results[-1].status
                last = results[-1].uv
            uv = np.stack([result.uv for result in results])
            energies = np.array([result.history[-1].energy for result in results])
        found[name] = moves(uv, targets), energies, time.process_time() - began
    return found


def draw(found: dict[str, dict[str, tuple[FloatArray, FloatArray, float]]], path: Path) -> None:
    """Plot the relative displacements frame by frame, for the scenes in which they exceed `NOTABLE`."""
    from matplotlib.figure import Figure

    drawn = {name: runs for name, runs in found.items() if max(np.nanmax(m) for m, *_ in runs.values()) > NOTABLE}
    figure = Figure(figsize=(9, 2.6 * len(drawn) + 0.6), layout="constrained")
    axes = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (name, runs) in zip(axes, drawn.items(), strict=True):
        for (way, (relative, *_)), color in zip(runs.items(), ("#c44e52", "#dd8452", "#1f3f8f"), strict=True):
            ax.semilogy(np.arange(1, len(relative) + 1), relative, color=color, label=way, lw=1.4)
        ax.axhline(LIMIT, color="0.4", lw=1, ls="--", label="limit of animate (max_motion_ratio)")
        ax.set_title(name, loc="left")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("")
        ax.set_yticks([1, 3, 10])
        ax.grid(axis="y", alpha=0.3)
    figure.supylabel("largest vertex motion / largest boundary motion")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    axes[-1].set_xlabel("frame")
    figure.savefig(path, dpi=100)


def main() -> None:
    """Run the scenes, print the table and draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="folder for sequences.md and sequences.png")
    parser.add_argument("--frames", type=int, default=100, help="frames of each scene (%(default)s)")
    options = parser.parse_args()
    ratio = "ratio of energies, animate to each alone"
    lines = [
        f"{machine()}; {options.frames} frames, {ENERGY}\n",
        f"| scene | triangles | {' | '.join(f'{way}: motion, energy, s' for way in WAYS)} | {ratio} |",
        "|---" * (len(WAYS) + 3) + "|",
    ]
    found = {}
    for name, make in SCENES.items():
        scene = make(options.frames)
        found[name] = runs = ways(scene)
        cells = [f"{np.nanmax(m):.2f}, {e.mean():.4g}, {s:.1f}" for m, e, s in runs.values()]
        share = runs["animate"][1].mean() / runs[ALONE][1].mean()
        lines.append(f"| {name} | {len(scene[1]):,} | {' | '.join(cells)} | {share:.3f} |")
        print(lines[-1], flush=True)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "sequences.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
        draw(found, options.output / "sequences.png")


if __name__ == "__main__":
    main()
