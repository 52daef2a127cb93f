"""Sequences of maps: vertex motion between frames, for frames polished independently and for `animate`.

    python benchmarks/animation.py [-o FOLDER] [--hand FILE] [--only SCENE ...]

Scenes: an outline that becomes a star and turns (of a cat's head, and with ``--hand`` of a surface in a file), an
outline that breathes, a bar that bends, a hole that travels through a disk, a circle that becomes a letter. Each frame
is polished independently, from the previous frame, and by `animate`. For each frame, report the maximum vertex
displacement relative to the maximum boundary displacement. Report also the mean energy and CPU seconds. Write a table
and a plot.

    python benchmarks/animation.py --unpolished

Report CPU milliseconds per unpolished frame for the star, the bar and the hole with about 20,000 triangles each.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quasiharmonic import Problem, animate, boundary_loops, io, solve
from quasiharmonic.surfaces import annulus, cat, grid
from quasiharmonic.targets import boundary_to, letter
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine

FRAMES = 100
# Relative move of a vertex from which on a scene has something to plot.
JUMP = 1.1
ENERGY = "symmetric-dirichlet"

Scene = tuple[FloatArray, IntArray, IntArray, FloatArray]


def turning_star(V: FloatArray, F: IntArray, loop: IntArray, frames: int) -> Scene:
    """A circle that becomes a star, turns and becomes a circle again."""
    angle = 2 * np.pi * np.arange(loop.size) / loop.size
    targets = []
    for t in np.linspace(0, 1, frames):
        here = angle + 0.18 * np.sin(np.pi * t) * np.cos(3 * angle)
        radius = 1 + 0.75 * np.sin(np.pi * t) ** 2 * np.cos(5 * angle + 2 * np.pi * t)
        targets.append(np.stack([radius * np.cos(here), radius * np.sin(here)], axis=1))
    return V, F, loop, np.array(targets)


def cat_star(frames: int, fineness: int = 20) -> Scene:
    """The star scene on a cat's head."""
    V, F = cat(fineness)
    return turning_star(V, F, boundary_loops(F, len(V))[0], frames)


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


def bending_bar(frames: int, across: int = 10) -> Scene:
    """A bar of size 10 × 1 that bends almost into a ring, in both directions."""
    V, F = grid(10 * across, across)
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


def travelling_hole(frames: int, fineness: int = 24) -> Scene:
    """A round hole that circles in a disk, close to its boundary."""
    V, F = annulus(fineness)
    loops = sorted(boundary_loops(F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
    held = np.concatenate(loops)
    inner = V[loops[1]] * (0.25 / np.abs(V[loops[1]]).max())
    targets = []
    for t in np.linspace(0, 1, frames):
        away = 0.62 * np.sin(np.pi * t)
        centre = away * np.array([np.cos(4 * np.pi * t), np.sin(4 * np.pi * t)])
        targets.append(np.concatenate([V[loops[0]], inner + centre]))
    return V, F, held, np.array(targets)


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
    "star": cat_star,
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
    V, F, held, targets = scene
    problem = Problem(V, F, held, targets[0])
    found = {}
    for name in ("alone", "from the last", "animate"):
        began = time.process_time()
        if name == "animate":
            animation = animate(problem, targets, polish=ENERGY)
            assert animation.found.all(), animation.summary()
            uv, energies = animation.uv, animation.energies
        else:
            results, last = [], None
            for target in targets:
                start = last if name == "from the last" else None
                results.append(solve(problem.with_target(target), start=start, polish=ENERGY))
                assert results[-1].injective, results[-1].status
                last = results[-1].uv
            uv = np.stack([result.uv for result in results])
            energies = np.array([result.history[-1].energy for result in results])
        found[name] = moves(uv, targets), energies, time.process_time() - began
    return found


def unpolished(frames: int) -> None:
    """Print CPU milliseconds per frame for about 20,000 triangles; the first, solved from scratch, is excluded."""
    print("| scene | triangles | median, ms a frame | mean | longest | largest move |")
    print("|---|---|---|---|---|---|")
    fine = {"star": cat_star(frames, 58), "bar": bending_bar(frames, 32), "hole": travelling_hole(frames, 116)}
    for name, (V, F, held, targets) in fine.items():
        told: dict[int, float] = {}
        problem = Problem(V, F, held, targets[0])
        animation = animate(
            problem, targets, callback=lambda step, told=told: told.setdefault(step.frame, time.process_time())
        )
        assert animation.found.all(), animation.summary()
        each = np.diff(list(told.values())) * 1e3
        print(
            f"| {name} | {len(F):,} | {np.median(each):.1f} | {each.sum() / (frames - 1):.1f} | {each.max():.0f} "
            f"| {animation.largest_move:.2f} |",
            flush=True,
        )


def main() -> None:
    """Run the scenes, print the table and draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, help="folder for sequences.md and sequences.png")
    parser.add_argument("--hand", type=Path, help="a further surface for the turning star")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--unpolished", action="store_true", help="what unpolished frames take, and nothing else")
    options = parser.parse_args()
    if options.unpolished:
        unpolished(options.frames)
        return
    scenes = {name: SCENES[name](options.frames) for name in options.only}
    if options.hand is not None:
        mesh = io.read_mesh(options.hand)
        loop = boundary_loops(mesh.F, len(mesh.V))[0]
        scenes = {"hand": turning_star(mesh.V, mesh.F, loop, options.frames), **scenes}
    lines = [
        f"{machine()}; {options.frames} frames, {ENERGY}\n",
        "| scene | triangles | polished alone: largest move, energy, s | from the last frame | `animate` "
        "| its energy over alone |",
        "|---|---|---|---|---|---|",
    ]
    drawn = {}
    for name, scene in scenes.items():
        found = ways(scene)
        cells = [f"{np.nanmax(m):.2f}, {e.mean():.4g}, {s:.1f}" for m, e, s in found.values()]
        ratio = found["animate"][1].mean() / found["alone"][1].mean()
        lines.append(f"| {name} | {len(scene[1]):,} | {' | '.join(cells)} | {ratio:.3f} |")
        print(lines[-1], flush=True)
        drawn[name] = found
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "sequences.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
        draw(drawn, options.output / "sequences.png")


def draw(found: dict[str, dict[str, tuple[FloatArray, FloatArray, float]]], path: Path) -> None:
    """Plot the relative displacements frame by frame, for each method; scenes that have no jumps are left out."""
    from matplotlib.figure import Figure

    found = {name: ways for name, ways in found.items() if np.nanmax(ways["alone"][0]) > JUMP}
    figure = Figure(figsize=(9, 2.1 * len(found)), layout="constrained")
    axes = figure.subplots(len(found), 1, squeeze=False)[:, 0]
    for ax, (name, by_way) in zip(axes, found.items(), strict=True):
        for way, color in (("alone", "#c44e52"), ("from the last", "#dd8452"), ("animate", "#4c72b0")):
            ax.semilogy(by_way[way][0], color=color, label="polished alone" if way == "alone" else way, lw=1.2)
        ax.axhline(3, color="0.6", lw=0.8, ls="--", label="bound of animate")
        ax.set_yticks([1, 3, 10], ["1", "3", "10"])
        ax.minorticks_off()
        ax.set_ylabel(name)
    axes[0].legend(loc="upper right", fontsize=8)
    axes[0].set_title("largest move of a vertex, over the boundary's largest step", fontsize=10)
    axes[-1].set_xlabel("frame")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
