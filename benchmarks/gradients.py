"""Cost of gradients through maps, compared with backpropagation through the iterations of the map.

    python benchmarks/gradients.py [--size CELLS] [-r REPEATS] [--unrolled ITERATIONS]

For each kind of map, measure CPU seconds of the map alone, of preparing its derivative, and of one gradient by all
inputs. The last column is the ratio of both passes to the map alone. To prepare the derivative,
a polished or flattened map is converged to rounding and factored once more. Runs are interleaved in one process; the
minimum of the repeats counts.

``--unrolled`` (requires PyTorch) writes the map as research code does: tensors, a symmetric Dirichlet energy, and a
descent whose iterations autograd records. Both start from the same map near the optimum. Iterations continue until the
gradient differs by 1 % from the exact one, or up to the given number. Memory is the peak of the process minus its
memory before the call.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from quasiharmonic import (
    Problem,
    boundary_loops,
    flatten,
    flatten_derivative,
    injective_map,
    polish_derivative,
    quasi_harmonic_derivative,
    quasi_harmonic_map,
)
from quasiharmonic.surfaces import cat
from quasiharmonic.targets import boundary_to, filled, letter
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine

T = TypeVar("T")
# Parameters of the recorded heavy-ball descent; the step length is the largest that stayed feasible in tests.
STEP, MOMENTUM = 0.1, 0.97
BUT_REST = "quasi-harmonic, by μ and target"
COTANGENTS = np.random.default_rng(0)


def clocked(work: Callable[[], T]) -> tuple[T, float]:
    """Return the result of a function, and its seconds."""
    began = time.process_time()
    made = work()
    return made, time.process_time() - began


def bean(V: FloatArray, loop: IntArray) -> FloatArray:
    """Return boundary positions on a bean, by arc length."""
    side = np.linalg.norm(np.roll(V[loop], -1, axis=0) - V[loop], axis=1)
    t = 2 * np.pi * np.cumsum(side) / side.sum()
    return np.stack([np.cos(t) + 0.3 * np.cos(t) ** 2, 0.7 * np.sin(t) + 0.35 * np.cos(t) ** 2], axis=1)


def forth_and_back(size: int, repeats: int) -> str:
    """Return the table of forward and backward passes in Markdown."""
    V, F = cat(size)
    (loop,) = boundary_loops(F, len(V))
    onto_bean, onto_letter = Problem(V, F, loop, bean(V, loop)), Problem(V, F, *boundary_to(V, F, filled(letter("R"))))
    mu = injective_map(V, F, loop, onto_bean.target).mu
    cotangent = COTANGENTS.standard_normal((len(V), 2))

    def polished(problem: Problem) -> Any:
        return injective_map(problem.V, problem.F, problem.fixed, problem.target, polish="symmetric-dirichlet")

    tensors = (
        lambda: quasi_harmonic_map(onto_bean, mu, reference="rest"),
        lambda _: quasi_harmonic_derivative(onto_bean, mu, reference="rest"),
    )
    ways: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
        BUT_REST: tensors,
        "quasi-harmonic, by rest positions too": tensors,
        "polished, onto a bean": (
            lambda: polished(onto_bean),
            lambda found: polish_derivative(V, F, found.uv, fixed=loop),
        ),
        "polished, onto the letter R": (
            lambda: polished(onto_letter),
            lambda found: polish_derivative(V, F, found.uv, fixed=onto_letter.fixed),
        ),
        "flattened": (lambda: flatten(V, F), lambda found: flatten_derivative(V, F, found.uv)),
    }
    lines = [
        f"{machine()}; {len(F):,} triangles, CPU seconds, minimum of {repeats}\n",
        "| map | map: s | converged and factored: s | one gradient: s | both passes / map |",
        "|---|---|---|---|---|",
    ]
    for name, (forth, derive) in ways.items():
        rows = []
        for _ in range(repeats):
            found, one = clocked(forth)
            derivative, two = clocked(lambda derive=derive, found=found: derive(found))
            assert derivative.reliable

            def back(derivative: Any = derivative, by_rest: bool = name != BUT_REST) -> None:
                gradients = derivative.vjp(cotangent)
                _ = gradients.target, gradients.mu, by_rest and gradients.rest

            rows.append((one, two, clocked(back)[1]))
        one, two, three = np.min(rows, axis=0)
        # The derivative of a quasi-harmonic map computes the map itself.
        way = two if derive is tensors[1] else one + two
        besides = two - one if derive is tensors[1] else two
        lines.append(f"| {name} | {one:.3f} | {max(besides, 0):.3f} | {three:.3f} | {(way + three) / one:.2f} |")
        print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def peak() -> float:
    """Return the peak memory of the process in megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def unrolled(size: int, most: int) -> None:
    """Print the cost of recording every iteration of a descent of the same energy."""
    import torch

    V, F = cat(size)
    (loop,) = boundary_loops(F, len(V))
    problem = Problem(V, F, loop, bean(V, loop))
    began = peak()
    found, seconds = clocked(lambda: injective_map(V, F, loop, problem.target, polish="symmetric-dirichlet"))
    derivative, more = clocked(lambda: polish_derivative(V, F, found.uv, fixed=loop))
    cotangent = COTANGENTS.standard_normal((len(V), 2))
    exact, last = clocked(lambda: derivative.vjp(cotangent).target)
    print(f"\n{machine()}; {len(F):,} triangles, gradient with respect to {len(loop)} boundary positions\n")
    print("| derivative | iterations | forward: s | backward: s | MB | error of the gradient |")
    print("|---|---|---|---|---|---|")
    print(f"| exact | – | {seconds + more:.2f} | {last:.3f} | {peak() - began:.0f} | – |")
    triangles, rest = torch.tensor(F), torch.tensor(V)
    edges = torch.stack([rest[triangles[:, k]] - rest[triangles[:, 0]] for k in (1, 2)], dim=1)
    length = torch.linalg.vector_norm(edges[:, 0], dim=1)
    along = (edges[:, 0] * edges[:, 1]).sum(dim=1) / length
    across = torch.sqrt((edges[:, 1] ** 2).sum(dim=1) - along**2)
    share = length * across / (length * across).sum()
    surface = 0.5 * (length * across).sum()
    free = torch.tensor(np.setdiff1d(np.arange(len(V)), loop))
    rim = torch.tensor(loop)

    def energy(uv: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        d1, d2 = (uv[triangles[:, k]] - uv[triangles[:, 0]] for k in (1, 2))
        first = d1 / length[:, None]
        second = (d2 - along[:, None] * first) / across[:, None]
        a = scale**2 * ((first**2).sum(dim=1) + (second**2).sum(dim=1))
        det = scale**2 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        return (share * (a + a / det**2)).sum()

    # Scale each vertex by the stiffness around it, an approximation of the Hessian's diagonal.
    stiff = share / across**2 + share / length**2
    weight = torch.zeros(len(V), dtype=torch.float64)
    for k in range(3):
        weight.index_add_(0, triangles[:, k], 8 * stiff)
    rate = STEP / weight[free][:, None]

    for iterations in (100, 400, 1600, 6400):
        if iterations > most:
            break
        began = peak()
        target = torch.tensor(problem.target, requires_grad=True)

        def forth(iterations: int = iterations, target: torch.Tensor = target) -> torch.Tensor:
            uv = torch.tensor(derivative.uv).index_copy(0, rim, target)
            x, y = target[:, 0], target[:, 1]
            area = 0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum()
            scale, velocity = torch.sqrt(surface / area), torch.zeros((len(free), 2), dtype=torch.float64)
            for _ in range(iterations):
                (slope,) = torch.autograd.grad(energy(uv, scale), uv, create_graph=True)
                velocity = MOMENTUM * velocity - rate * slope[free]
                uv = uv.index_add(0, free, velocity)
            return uv

        uv, seconds = clocked(forth)
        (found_gradient,), last = clocked(
            lambda uv=uv, target=target: torch.autograd.grad(uv, target, torch.tensor(cotangent))
        )
        off = np.linalg.norm(found_gradient.numpy() - exact) / np.linalg.norm(exact)
        print(f"| recorded | {iterations} | {seconds:.2f} | {last:.2f} | {peak() - began:.0f} | {100 * off:.2g} % |")
        del uv


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=58, help="cells across the cat's head (58: 20,000 triangles)")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the table, without --unrolled")
    parser.add_argument("-r", "--repeats", type=int, default=5)
    parser.add_argument("--unrolled", type=int, default=0, metavar="ITERATIONS", help="record up to so many iterations")
    options = parser.parse_args()
    if options.unrolled:
        unrolled(options.size, options.unrolled)
    else:
        table = forth_and_back(options.size, options.repeats)
        if options.output is not None:
            options.output.write_text(table, encoding="utf-8")


if __name__ == "__main__":
    main()
