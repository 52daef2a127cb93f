"""A network that aligns landmarks
==================================

A small network learns tensors for which the landmarks of many surfaces coincide in the plane (PyTorch). Top: surfaces;
middle: maps before training; bottom: after.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import INK, flips, panels, run, save, show
from quasiharmonic import Problem, surfaces
from quasiharmonic.plot import plot_surface

Array = NDArray[np.float64]
# Weight of the penalty on tensors other than the identity.
PRICE = 0.002


def faces(V: Array, count: int, seed: int) -> tuple[Array, NDArray[np.int64]]:
    """Random surfaces (count, n, 3) over a disk, and their landmarks (count, 4)."""
    rng = np.random.default_rng(seed)
    z = V @ (1, 1j)
    shapes, marks = np.empty((count, len(V), 3)), np.empty((count, 4), dtype=np.int64)
    for k in range(count):
        middle = 0.15 * (rng.standard_normal() + 1j * rng.standard_normal())
        apart = (0.38 + 0.06 * rng.standard_normal()) * np.exp(0.25j * rng.standard_normal())
        length = (0.32 + 0.05 * rng.standard_normal()) * np.exp(1j * (-np.pi / 2 + 0.25 * rng.standard_normal()))
        eyes = middle + np.array([-apart, apart]) + 0.15j
        nose = middle + np.array([0.1j, 0.1j + length])
        height = sum(0.35 * np.exp(-(np.abs(z - eye) ** 2) / 0.03) for eye in eyes)
        along = np.clip(((z - nose[0]) / (nose[1] - nose[0])).real, 0, 1)
        height = height + 0.3 * np.exp(-(np.abs(z - nose[0] - along * (nose[1] - nose[0])) ** 2) / 0.01)
        shapes[k] = np.column_stack([V, height * (1 - np.abs(z) ** 2)])
        marks[k] = [np.argmin(np.abs(z - place)) for place in (*eyes, *nose)]
    return shapes, marks


def features(shapes: Array, F: NDArray[np.int64], marks: NDArray[np.int64]) -> Array:
    """Network input of every triangle: (count, f, 14)."""
    corners = shapes[:, F]
    middle = corners.mean(axis=2)
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    places = np.take_along_axis(shapes, marks[:, :, None], axis=1)[:, None]
    away = (places - middle[:, :, None])[..., :2]
    return np.concatenate([middle, normal, away.reshape(*away.shape[:2], -1)], axis=2)


def main(output: Path, size: int = 8, steps: int = 150, count: int = 60) -> dict[str, Any]:
    import torch

    from quasiharmonic.torch import quasi_harmonic_map

    torch.manual_seed(0)
    V, F = surfaces.disk(size)
    rim = np.flatnonzero(np.abs(V @ (1, 1j)) > 1 - 1e-9)
    rim = rim[np.argsort(np.angle(V[rim] @ (1, 1j)))]
    problem = Problem(V, F, rim, V[rim])
    # Turn a coefficient from the disk's frame, which the network uses, into the triangle's own frame.
    side = (V[F[:, 1]] - V[F[:, 0]]) @ (1, 1j)
    turn = torch.tensor((side.conj() / np.abs(side)) ** 2)
    network = torch.nn.Sequential(
        torch.nn.Linear(14, 48), torch.nn.Tanh(), torch.nn.Linear(48, 48), torch.nn.Tanh(), torch.nn.Linear(48, 2)
    ).double()
    with torch.no_grad():
        network[-1].weight *= 0.01
        network[-1].bias *= 0

    def maps(seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        xi = torch.view_as_complex(network(seen).contiguous())
        size = torch.abs(xi) + 1e-9
        mu = 0.9 * torch.tanh(size) / size * xi
        return quasi_harmonic_map(problem, mu * turn, reference="rest"), mu

    def landmarks(uv: torch.Tensor, marks: NDArray[np.int64]) -> torch.Tensor:
        return uv[torch.arange(len(uv))[:, None], torch.tensor(marks)]

    (shapes, marks), (others, others_marks) = faces(V, count, 1), faces(V, 12, 2)
    seen, others_seen = (torch.tensor(features(*x)) for x in ((shapes, F, marks), (others, F, others_marks)))
    with torch.no_grad():
        plain = quasi_harmonic_map(problem, reference="rest")
        before = plain.expand(len(others), -1, -1)
        # The targets are the mean positions of the training faces' landmarks under identity tensors.
        places = landmarks(plain.expand(len(shapes), -1, -1), marks).mean(dim=0)

    def apart(uv: torch.Tensor, marks: NDArray[np.int64]) -> torch.Tensor:
        return ((landmarks(uv, marks) - places) ** 2).sum(dim=-1).mean()

    optimiser = torch.optim.Adam(network.parameters(), lr=0.02)
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        uv, mu = maps(seen)
        loss = apart(uv, marks) + PRICE * (mu.abs() ** 2).mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    with torch.no_grad():
        after, _ = maps(others_seen)
    figure, axes = panels(3, 4, (2.4, 2.6))
    for k in range(4):
        plot_surface(others[k], F, axes[0][k])
        for row, uv, title in ((1, before[k], "before"), (2, after[k], "after")):
            show(axes[row][k], problem, uv.numpy(), title, pins=False)
            axes[row][k].plot(*places.numpy().T, "+", ms=13, mew=1.5, color=INK)
            axes[row][k].plot(*uv.numpy()[others_marks[k]].T, "o", ms=5, color=INK, mfc="white")
    save(figure, output, "learned_landmarks")
    return {
        "triangles": len(F),
        "loss": [losses[0], losses[-1]],
        "apart before": float(apart(before, others_marks)) ** 0.5,
        "apart": float(apart(after, others_marks)) ** 0.5,
        "inverted": sum(flips(problem, uv.numpy()) for uv in after),
    }


if __name__ == "__main__":
    run(main)
