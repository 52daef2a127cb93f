"""A hidden body found from outer measurements
==============================================

The outline of a body in a plate is optimised subject to Laplace's equation (scikit-fem). Upper row: the mesh of this
package; lower row: linear elasticity, which inverts triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import INK, flips, panels, run, save, show
from quasiharmonic import Problem, boundary_loops, polish_derivative, solve, surfaces

Array = NDArray[np.float64]
# Centre, and the log radius around it as a Fourier series: mean, then cosines and sines alternating.
TRUE = np.array([0.30, 0.18, -1.15, 0.10, 0.15, -0.35, -0.40, 0.10, 0.05, 0.0, 0.05, 0.0, 0.0])
START = np.array([-0.25, -0.2, np.log(0.3), *np.zeros(10)])
PATTERNS = 6
# Limit on the change of each number of the outline in one step.
LONGEST = 0.1


class Plate:
    """A mesh of the square [-1, 1]² around a body, with the potentials and derivatives on it."""

    def __init__(self, size: int) -> None:
        V, self.F = surfaces.annulus(size, hole=(-0.4, -0.4, 0.4, 0.4))
        self.rim, self.body = sorted(boundary_loops(self.F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
        self.angle = np.angle(V[self.body] @ (1, 1j))
        self.fixed = np.concatenate([self.rim, self.body])
        self.walls = V[self.rim]
        # The rest mesh has a round body.
        round_body = Problem(V, self.F, self.fixed, self.target(np.array([0, 0, np.log(0.4), *np.zeros(10)])))
        self.V = solve(round_body, polish="symmetric-dirichlet").uv
        self.problem = Problem(self.V, self.F, self.fixed, self.V[self.fixed])
        self.uv = self.V

    def outline(self, shape: Array) -> tuple[Array, Array]:
        """The body's outline (l, 2), and its derivative (l, 2, 13) with respect to the shape."""
        k = np.arange(1, 1 + (shape.size - 3) // 2)
        waves = np.stack([np.cos(k * self.angle[:, None]), np.sin(k * self.angle[:, None])], axis=2)
        basis = np.column_stack([np.ones(self.angle.size), waves.reshape(self.angle.size, -1)])
        along = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=1)
        arms = along * np.exp(basis @ shape[2:])[:, None]
        by_centre = np.broadcast_to(np.eye(2), (len(along), 2, 2))
        return shape[:2] + arms, np.concatenate([by_centre, arms[:, :, None] * basis[:, None]], axis=2)

    def target(self, shape: Array) -> Array:
        """Target positions of the fixed vertices."""
        return np.concatenate([self.walls, self.outline(shape)[0]])

    def move_mesh(self, shape: Array) -> Any:
        """The derivative of the mesh around a body, which also contains the mesh."""
        problem = self.problem.with_target(self.target(shape))
        found = solve(problem, polish="symmetric-dirichlet", start=self.uv)
        derivative = polish_derivative(self.V, self.F, found.uv, fixed=self.fixed)
        assert found.injective
        assert derivative.reliable
        self.uv = derivative.uv
        return derivative

    def potentials(self, points: Array) -> tuple[Array, Any, Array]:
        """Potentials (n, patterns) for all current patterns, the solver, and the bilinear form used."""
        from scipy.sparse.linalg import splu
        from skfem import Basis, BilinearForm, ElementTriP1
        from skfem.helpers import dot, grad

        self.basis = Basis(_mesh(points, self.F), ElementTriP1())
        stiffness = BilinearForm(lambda u, v, _: dot(grad(u), grad(v))).assemble(self.basis).tocsc()
        free = np.setdiff1d(np.arange(len(points)), self.body)
        solver = splu(stiffness[free][:, free])

        def solve_potential(load: Array) -> Array:
            out = np.zeros_like(load)
            out[free] = solver.solve(load[free])
            return out

        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.walls, axis=0), axis=1))]) / 8
        k = np.arange(1, 1 + PATTERNS // 2)
        load = np.zeros((len(points), PATTERNS))
        waves = [np.cos(2 * np.pi * k * along[:, None]), np.sin(2 * np.pi * k * along[:, None])]
        load[self.rim] = np.concatenate(waves, axis=1) * 8 / self.rim.size
        return solve_potential(load), solve_potential, along

    def misfit(self, points: Array, measured: Array) -> tuple[float, Array]:
        """Half the squared difference from the measurements over the rim, and its gradient by the nodes (n, 2)."""
        from skfem import Basis, ElementTriP1, ElementVector, LinearForm
        from skfem.helpers import div, dot, eye, grad, mul, transpose

        u, solve_potential, _ = self.potentials(points)
        difference = np.zeros_like(u)
        difference[self.rim] = (u[self.rim] - measured) * 8 / self.rim.size
        adjoint = -solve_potential(difference)
        nodes = Basis(self.basis.mesh, ElementVector(ElementTriP1()))

        # The change of the stiffness when a vector field v moves the mesh.
        def change(v: Any, w: Any) -> Any:
            stretched = eye(div(v), 2) - grad(v) - transpose(grad(v))
            return dot(mul(stretched, grad(w.u)), grad(w.a))

        form = LinearForm(change)
        gradient = sum(
            form.assemble(nodes, u=self.basis.interpolate(u[:, k]), a=self.basis.interpolate(adjoint[:, k]))
            for k in range(PATTERNS)
        )
        value = 0.5 * float(np.sum(difference[self.rim] * (u[self.rim] - measured)))
        return value, gradient.reshape(-1, 2)

    def elastic(self, shape: Array) -> Array:
        """The rest mesh moved by linear elasticity (Poisson's ratio 0.3)."""
        from skfem import Basis, ElementTriP1, ElementVector, condense
        from skfem import solve as solve_linear
        from skfem.models.elasticity import lame_parameters, linear_elasticity

        basis = Basis(_mesh(self.V, self.F), ElementVector(ElementTriP1()))
        stiffness = linear_elasticity(*lame_parameters(1.0, 0.3)).assemble(basis)
        moved = np.zeros((len(self.V), 2))
        moved[self.fixed] = self.target(shape) - self.V[self.fixed]
        held = (2 * self.fixed[:, None] + np.arange(2)).ravel()
        return self.V + solve_linear(*condense(stiffness, x=moved.ravel(), D=held)).reshape(-1, 2)


def _mesh(points: Array, F: NDArray[np.int64]) -> Any:
    from skfem import MeshTri

    return MeshTri(np.ascontiguousarray(points.T), np.ascontiguousarray(F.T), sort_t=False)


def descend(value: Callable[[Array], tuple[float, Array]], x: Array, steps: int) -> list[tuple[Array, float]]:
    """Minimise by BFGS, and return the iterates and their values; ``value`` is infinite where it is undefined."""
    inverse, (here, slope) = 0.02 * np.eye(x.size), value(x)
    path = [(x, here)]
    for _ in range(steps):
        step = -inverse @ slope
        step *= min(1.0, LONGEST / np.abs(step).max())
        for _ in range(20):
            there, next_slope = value(x + step)
            if there < here + 1e-4 * slope @ step:
                break
            step = 0.5 * step
        else:
            return path
        change = next_slope - slope
        if step @ change > 0:
            turned = np.eye(x.size) - np.outer(step, change) / (step @ change)
            inverse = turned @ inverse @ turned.T + np.outer(step, step) / (step @ change)
        x, here, slope = x + step, there, next_slope
        path.append((x, here))
    return path


def main(output: Path, size: int = 30, steps: int = 60) -> dict[str, Any]:
    hidden, plate = Plate(round(1.5 * size)), Plate(size)
    truth, _, there = hidden.potentials(hidden.move_mesh(TRUE).uv)
    _, _, here = plate.potentials(plate.V)
    known = np.concatenate([truth[hidden.rim], truth[hidden.rim[:1]]])
    measured = np.stack([np.interp(here, np.append(there, 1), row) for row in known.T], axis=1)

    def value(shape: Array) -> tuple[float, Array]:
        outline, by_shape = plate.outline(shape)
        if np.abs(outline).max() > 0.95:
            return np.inf, shape
        derivative = plate.move_mesh(shape)
        misfit, by_nodes = plate.misfit(derivative.uv, measured)
        return misfit, np.tensordot(derivative.vjp(by_nodes).target[plate.rim.size :], by_shape)

    path = descend(value, START, steps)
    inverted = [flips(plate.problem, plate.elastic(shape)) for shape, _ in path]
    last, misfit = path[-1]
    figure, axes = panels(2, 3, (3.4, 3.7))
    chosen = [0, min(8, len(path) - 1), len(path) - 1]
    true_outline = plate.outline(TRUE)[0]
    for column, number in enumerate(chosen):
        shape = path[number][0]
        for row, (name, uv) in enumerate(
            (("quasiharmonic", plate.move_mesh(shape).uv), ("elastic", plate.elastic(shape)))
        ):
            show(axes[row][column], plate.problem, uv, f"step {number}, {name}", pins=False)
            axes[row][column].plot(*np.append(true_outline, true_outline[:1], axis=0).T, "--", lw=1.5, color=INK)
    save(figure, output, "shape_from_boundary")
    outline = plate.outline(last)[0]
    return {
        "triangles": len(plate.F),
        "steps": len(path) - 1,
        "misfit at first": path[0][1],
        "misfit": misfit,
        "outline off by at first": float(np.abs(plate.outline(START)[0] - true_outline).max()),
        "outline off by": float(np.abs(outline - true_outline).max()),
        "inverted, quasiharmonic": max(
            flips(plate.problem, plate.move_mesh(shape).uv) for shape, _ in path[:: max(1, steps // 10)]
        ),
        "elastic, first inverted at step": next((k for k, count in enumerate(inverted) if count), None),
        "elastic, inverted in the end": inverted[-1],
    }


if __name__ == "__main__":
    run(main)
