"""How far a boundary can move before the mesh that follows it is inverted, by method.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/mesh_motion.py [-o FOLDER] [--only SCENE ...]

In each of six scenes (`moving_scenes`), every method (`mesh_movers`) takes steps until a triangle is inverted or the
scene ends. Inversion is certified exactly. The steps of `morph` are independent, so it runs at every eighth step only.
Write mesh_motion.md, mesh_motion.png, and mesh_motion.csv with the displacement at the last valid step, the worst and
the mean triangle quality, and CPU time per step. The baseline is one solve of linear elasticity, interleaved with the
steps. Requires scikit-fem (``pip install scikit-fem``).
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from mesh_movers import Extended, Following, Morphing, Mover, elasticity, harmonic, thin_plate
from moving_scenes import SCENES, Scene
from quasiharmonic import inverted_triangles
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.util.arrays import FloatArray
from speed import machine

OURS, MORPH = "MovingMesh", "morph"
#: Methods by name and start of each step.
METHODS: dict[tuple[str, str], Callable[[Scene], Mover]] = {
    (name, base): partial(Extended, extension=extension, from_rest=base == "first")
    for name, extension in (
        ("harmonic", harmonic),
        ("thin plate", thin_plate),
        ("elasticity", elasticity),
    )
    for base in ("first", "last")
}
METHODS[OURS, "last"] = Following
METHODS[MORPH, "first"] = Morphing
#: Methods with expensive steps take only every k-th step and the last one; the value is k.
SELDOM = {(MORPH, "first"): 8}
#: Color and width of the line of each method in the plot.
DRAWN = {
    ("harmonic", "last"): ("#8c8c8c", 1.4),
    ("thin plate", "last"): ("#55a868", 1.4),
    ("elasticity", "last"): ("#c44e52", 1.4),
    (MORPH, "first"): ("#dd8452", 1.4),
    (OURS, "last"): ("#1f3f8f", 2.6),
}
#: Scenes with a known upper bound of the motion.
TURNING = ("turning disk", "sliding walls")
# In every this many steps, one elasticity solve is timed as the baseline.
_YARDSTICK = 8


@dataclass
class Run:
    """The result of one method in one scene.

    Attributes
    ----------
    at : list of int
        The valid steps that were taken.
    quality : list of (4,)
        At each: worst and mean of the triangles' shape, and of their similarity to the first mesh, as mean ratios.
    moves : list of float
        Maximum vertex displacement since the previous one of these steps, relative to that of the body.
    seconds : list of float
        CPU seconds of each step.
    """

    at: list[int] = field(default_factory=list)
    quality: list[tuple[float, float, float, float]] = field(default_factory=list)
    moves: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """The last valid step, or 0 if there is none."""
        return self.at[-1] if self.at else 0


def likeness(scene: Scene, V: FloatArray) -> FloatArray:
    """Return the mean ratio 2 det J / |J|² of each triangle's Jacobian from the first mesh; 1 for a similarity."""
    now, first = (np.diff(P[scene.F], axis=1).transpose(0, 2, 1) for P in (V, scene.V))
    J = now @ np.linalg.inv(first)
    return 2 * np.linalg.det(J) / np.sum(J**2, axis=(1, 2))


def race(scene: Scene, steps: int | None = None) -> tuple[dict[tuple[str, str], Run], list[float]]:
    """Run all methods, interleaved step by step; return their runs and the seconds of single elasticity solves."""
    runs = {key: Run() for key in METHODS}
    movers = {key: make(scene) for key, make in METHODS.items()}
    last = dict.fromkeys(METHODS, scene.V)
    yardstick: list[float] = []
    for k in range(1, (scene.steps if steps is None else steps) + 1):
        target = scene.target(k / scene.steps)
        for key, mover in list(movers.items()):
            if k % SELDOM.get(key, 1) and k < scene.steps:
                continue
            began = time.process_time()
            V = mover.step(target)
            runs[key].seconds.append(time.process_time() - began)
            if V is None or not np.isfinite(V).all() or inverted_triangles(scene.F, V).size:
                del movers[key]
                continue
            shape, like = mean_ratio(V, scene.F), likeness(scene, V)
            runs[key].at.append(k)
            runs[key].quality.append((shape.min(), shape.mean(), like.min(), like.mean()))
            way = np.linalg.norm(V - last[key], axis=1)
            runs[key].moves.append(float(way.max() / way[scene.body].max()))
            last[key] = V
        if k % _YARDSTICK == 1:
            way = np.zeros_like(scene.V)
            way[scene.fixed] = target - scene.V[scene.fixed]
            began = time.process_time()
            elasticity(scene.V, scene.F, scene.given(), way)
            yardstick.append(time.process_time() - began)
        if not movers:
            break
    return runs, yardstick


def forbidden_beyond(scene: Scene) -> float:
    """Return an upper bound, in degrees, of the rotation of a body around the origin, for any mesh motion.

    Seen from the origin, an edge spans less than 2 arccos(r / R), where r is the radius of a disk inside the body and
    R that of one around the walls. A chain of edges from the body to a fixed vertex of the walls winds by the rotation
    plus its initial winding. The sum of its edges' spans therefore bounds the rotation.
    """
    F, z = scene.F, scene.V @ (1, 1j)
    span = 2 * np.arccos(np.abs(z[scene.body]).min() / np.abs(z).max())
    i, j = np.unique(np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1), axis=0).T
    turn = np.angle(z[j] / z[i])
    weights = csr_array(
        (np.concatenate([span + turn, span - turn]), (np.r_[i, j], np.r_[j, i])), shape=(z.size, z.size)
    )
    still = scene.walls
    if scene.slide:
        still = still[(np.abs(scene.V[still]) == np.abs(scene.V).max(axis=0)).all(axis=1)]
    return float(np.degrees(dijkstra(weights, indices=scene.body, min_only=True)[still].min()))


def rows(name: str, scene: Scene, runs: dict[tuple[str, str], Run], yardstick: list[float]) -> list[dict[str, object]]:
    """Return the table's rows for a scene."""
    unit = float(np.median(yardstick))
    found = []
    for (method, base), run in runs.items():
        quality = np.array(run.quality).reshape(-1, 4)
        lowest, means = quality.min(axis=0, initial=1), quality.mean(axis=0) if run.steps else np.full(4, np.nan)
        found.append(
            {
                "scene": name,
                "triangles": len(scene.F),
                "method": method,
                "from": base,
                "valid to": scene.extent(run.steps / scene.steps),
                "unit": scene.unit,
                "steps": run.steps,
                "of": scene.steps,
                "worst shape": lowest[0],
                "mean shape": means[1],
                "worst likeness": lowest[2],
                "mean likeness": means[3],
                "largest move": max(run.moves, default=np.nan),
                "ms a step": 1e3 * float(np.mean(run.seconds)),
                "median ms": 1e3 * float(np.median(run.seconds)),
                "elasticity solves": float(np.mean(run.seconds)) / unit,
            }
        )
    return found


def table(found: list[dict[str, object]], scenes: dict[str, Scene]) -> str:
    """Return a description of the scenes, and a Markdown table of the last valid step of each method in each scene."""
    lines = [f"{machine()}, scikit-fem {version('scikit-fem')}", ""]
    for name, scene in scenes.items():
        about = (SCENES[name].__doc__ or "").split("\n")[0]
        about += f" {len(scene.F):,} triangles, {scene.steps} steps; ends with {scene.end}."
        if name in TURNING:
            about += f" No motion of this mesh can turn the body further than {forbidden_beyond(scene):,.0f}°."
        lines.append(f"- **{name.capitalize()}.** {about}")
    heads = [f"{name}, {scene.unit}" for name, scene in scenes.items()]
    lines += ["", f"| method | each step from | {' | '.join(heads)} | elasticity solves |"]
    lines.append("|---" * (len(scenes) + 3) + "|")
    for method, base in dict.fromkeys((row["method"], row["from"]) for row in found):
        runs = {row["scene"]: row for row in found if (row["method"], row["from"]) == (method, base)}
        cells = [str(method), f"the {base} mesh"]
        for name in scenes:
            row = runs[name]
            end = "**" if row["steps"] == row["of"] else ""
            cells.append(f"{end}{row['valid to']:.4g}{end}")
        costs = sorted(float(row["elasticity solves"]) for row in runs.values())
        lines.append(f"| {' | '.join(cells)} | {costs[0]:.2g} – {costs[-1]:.2g} |")
    return "\n".join(lines) + "\n"


def draw(races: dict[str, dict[tuple[str, str], Run]], scenes: dict[str, Scene], path: Path) -> None:
    """Plot the worst quality over the displacement: a panel for each scene, a line for each method of `DRAWN`."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(12, 7.6), layout="constrained")
    axes = figure.subplots(2, (len(races) + 1) // 2, squeeze=False)
    for ax, (name, runs) in zip(axes.ravel(), races.items(), strict=False):
        scene = scenes[name]
        for key, (color, width) in DRAWN.items():
            run = runs[key]
            x = [scene.place_on_axis(at / scene.steps) for at in run.at]
            y = [worst for worst, *_ in run.quality]
            ax.plot(x, y, color=color, lw=width)
            ax.plot(x[-1:], y[-1:], "x" if run.steps < scene.steps else "o", color=color, ms=7, mew=2)
        ax.set_yscale("log")
        ax.set_ylim(1e-5, 1.3)
        if scene.log:
            ax.set_xscale("log")
            ax.invert_xaxis()
        ax.set_title(name)
        ax.set_xlabel(scene.axis)
        ax.grid(alpha=0.25)
    for ax in axes[:, 0]:
        ax.set_ylabel("quality of the worst triangle\n(1: equilateral, 0: degenerate)")
    handles = [Line2D([], [], color=color, lw=width, label=method) for (method, _), (color, width) in DRAWN.items()]
    ends = {"o": "end of the scene reached", "x": "the next step inverts a triangle or fails"}
    handles += [Line2D([], [], color="0.3", ls="", marker=mark, mew=2, label=text) for mark, text in ends.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"))
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    found, races, scenes = [], {}, {}
    for name in options.only:
        scene = scenes[name] = SCENES[name]()
        races[name], yardstick = race(scene)
        found += rows(name, scene, races[name], yardstick)
        text = table(found, scenes)
        (options.output / "mesh_motion.md").write_text(text, encoding="utf-8")
        with (options.output / "mesh_motion.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(found[0]))
            writer.writeheader()
            writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in found)
        draw(races, scenes, options.output / "mesh_motion.png")
        print(f"{name}: done", flush=True)
    print(text)


if __name__ == "__main__":
    main()
