"""Heat around a cylinder that travels through a channel: finite elements on a moving mesh, 200 steps.

    python benchmarks/moving_heat.py [-o FOLDER]

The cylinder circles in the channel without rotating. The inviscid fluid's velocity is a = ∇φ, with φ harmonic and its
normal derivative that of the walls. A hot spot is advected and diffuses::

    d/dt ∫ u v + ∫ (κ ∇u − u (a − w)) · ∇v = 0      for each v that moves with the mesh, whose velocity is w

The discretisation uses linear elements of scikit-fem, with all terms except the masses at the middle of the step. No
heat crosses a wall, so the total heat is constant. A triangle's area is quadratic in time, so the midpoint gives its
change exactly and a uniform temperature stays uniform (the geometric conservation law). Both properties are measured at
every step. The run ends if a triangle is inverted in the mesh or in the mesh at the middle of the step.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP1, ElementVector, FacetBasis, LinearForm, MeshTri
from skfem.helpers import dot, grad
from skfem.models.poisson import laplace, mass

from mesh_movers import Extended, Mover, Ours, elasticity, harmonic
from moving_scenes import Scene, travelling_hole
from quasiharmonic import inverted_triangles
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine

CONDUCTIVITY, LAPS, PERIOD = 0.02, 2.5, 10.0
MOVERS = {
    "MovingMesh": Ours,
    "elasticity": partial(Extended, extension=elasticity, from_rest=False),
    "elasticity, from the first": partial(Extended, extension=elasticity, from_rest=True),
    "harmonic": partial(Extended, extension=harmonic, from_rest=False),
}


@dataclass
class History:
    """The measurements, step by step.

    Attributes
    ----------
    heat : list of float
        ∫ u relative to its initial value, minus 1.
    uniform : list of float
        Maximum deviation from 1 of the temperature that was 1 everywhere.
    quality : list of float
        The worst mean ratio of the mesh.
    meshes, temperatures : list
        At each step.
    """

    heat: list[float] = field(default_factory=list)
    uniform: list[float] = field(default_factory=list)
    quality: list[float] = field(default_factory=list)
    meshes: list[FloatArray] = field(default_factory=list)
    temperatures: list[FloatArray] = field(default_factory=list)


@BilinearForm
def carried(u, v, w):
    """The transport term −∫ u (a − w) · ∇v."""
    return -u * dot(w["flow"].grad - w["mesh"], grad(v))


@LinearForm
def displaced(v, w):
    """The flux of a moving wall, ∮ w · n v."""
    return dot(w["mesh"], w.n) * v


def _mesh(V: FloatArray, F: IntArray) -> MeshTri:
    return MeshTri(np.ascontiguousarray(V.T), np.ascontiguousarray(F.T))


def step(V: FloatArray, there: FloatArray, F: IntArray, u: FloatArray, dt: float) -> FloatArray:
    """Return the temperatures (n, k) after a step in which the mesh moves from ``V`` to ``there``."""
    middle = _mesh((V + there) / 2, F)
    basis, vectors = Basis(middle, ElementTriP1(), intorder=3), Basis(middle, ElementVector(ElementTriP1()), intorder=3)
    velocity = np.zeros(vectors.N)
    velocity[vectors.nodal_dofs] = ((there - V) / dt).T
    rim = FacetBasis(middle, ElementTriP1(), intorder=3)
    pushed = displaced.assemble(rim, mesh=rim.with_element(ElementVector(ElementTriP1())).interpolate(velocity))
    K = laplace.assemble(basis).tocsc()
    # The potential is determined up to a constant, so one of its values is set to 0.
    flow = np.append(0.0, splu(K[1:, 1:]).solve(pushed[1:]))
    C = carried.assemble(basis, flow=basis.interpolate(flow), mesh=vectors.interpolate(velocity))
    before, after = (mass.assemble(Basis(_mesh(P, F), ElementTriP1(), intorder=2)) for P in (V, there))
    A = (dt / 2) * (CONDUCTIVITY * K + C)
    return splu((after + A).tocsc()).solve((before - A) @ u)


def run(scene: Scene, mover: Mover, steps: int) -> History:
    """Move the mesh and its heat for the given number of steps, or until a triangle is inverted."""
    V, F, dt = scene.V, scene.F, LAPS * PERIOD / steps
    spot = np.exp(-((V[:, 0] - 0.7) ** 2 + V[:, 1] ** 2) / 0.05)
    u = np.stack([spot, np.ones(len(V))], axis=1)
    total = _heat(V, F, spot)
    history = History([0.0], [0.0], [mean_ratio(V, F).min()], [V], [spot])
    for k in range(1, steps + 1):
        there = mover.step(scene.target(k / steps))
        if there is None or inverted_triangles(F, there).size or inverted_triangles(F, (V + there) / 2).size:
            break
        u = step(V, there, F, u, dt)
        V = there
        history.heat.append(_heat(V, F, u[:, 0]) / total - 1)
        history.uniform.append(float(np.abs(u[:, 1] - 1).max()))
        history.quality.append(float(mean_ratio(V, F).min()))
        history.meshes.append(V)
        history.temperatures.append(u[:, 0])
    return history


def _heat(V: FloatArray, F: IntArray, u: FloatArray) -> float:
    """Return ∫ u."""
    a, b, c = V[F].transpose(1, 0, 2)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return float(area @ u[F].mean(axis=1))


def draw(scene: Scene, histories: dict[str, History], steps: int, path: Path) -> None:
    """Plot the mesh at four times, as moved by this library, and the measurements over the steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.4), layout="constrained")
    grid = figure.add_gridspec(3, 4, height_ratios=[0.75, 0.75, 1])
    ours = histories["MovingMesh"]
    for i, k in enumerate(np.linspace(0, len(ours.meshes) - 1, 8).astype(int)):
        ax = figure.add_subplot(grid[i // 4, i % 4])
        V, u = ours.meshes[k], ours.temperatures[k]
        ax.tripcolor(*V.T, scene.F, u, shading="gouraud", cmap="inferno", vmin=0, vmax=max(0.15, 0.7 * float(u.max())))
        ax.triplot(*V.T, scene.F, color="white", lw=0.15, alpha=0.5)
        ax.set_aspect("equal")
        ax.set_axis_off()
        ax.set_title(f"step {k}", fontsize=9)
    quality, law = figure.add_subplot(grid[2, :2]), figure.add_subplot(grid[2, 2:])
    for name, history in histories.items():
        (line,) = quality.semilogy(history.quality, lw=2.2 if name == "MovingMesh" else 1.2, label=name)
        if len(history.quality) <= steps:
            quality.plot(len(history.quality) - 1, history.quality[-1], "x", color=line.get_color())
    quality.set_ylabel("worst mean ratio")
    quality.set_xlabel("step")
    quality.legend(fontsize=8)
    law.semilogy(np.abs(ours.heat[1:]) + 1e-17, label="heat, off by (relative)")
    law.semilogy(np.array(ours.uniform[1:]) + 1e-17, label="a uniform temperature, off by")
    law.set_xlabel("step")
    law.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"))
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    scene = travelling_hole(laps=LAPS)
    histories = {name: run(scene, make(scene), options.steps) for name, make in MOVERS.items()}
    draw(scene, histories, options.steps, options.output / "moving_heat.png")
    numbers = {
        name: {
            "valid steps": len(history.meshes) - 1,
            "worst mean ratio on the way": min(history.quality),
            "heat off by at most": max(map(abs, history.heat)),
            "uniform temperature off by at most": max(history.uniform),
        }
        for name, history in histories.items()
    }
    (options.output / "moving_heat.md").write_text(table(numbers), encoding="utf-8")
    print(json.dumps(numbers, indent=2))


def table(numbers: dict[str, dict[str, float]]) -> str:
    """Return a Markdown table of the numbers of all methods."""
    heads = list(next(iter(numbers.values())))
    lines = [
        f"{machine()}, scikit-fem {version('scikit-fem')}\n",
        f"| mesh | {' | '.join(heads)} |",
        "|---" * (1 + len(heads)) + "|",
    ]
    for name, row in numbers.items():
        lines.append(
            f"| {name} | {' | '.join(f'{row[head]:.2g}' if row[head] < 1 else str(row[head]) for head in heads)} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
