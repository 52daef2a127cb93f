"""A photo warped by landmarks
==============================

The border stays fixed and nothing folds. For your own photo: ``python examples/warped_photo.py --photo me.jpg
--landmarks points.txt``, with a line ``x y x' y'`` for each landmark.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cbook import get_sample_data
from matplotlib.image import imread

from common import panels, save
from quasiharmonic import warp_by_landmarks
from quasiharmonic.util.arrays import FloatArray

SMILE = np.array(
    [
        (218, 187, 210, 181),
        (310, 185, 318, 179),
        (237, 277, 218, 260),
        (302, 275, 321, 258),
        (268, 278, 268, 290),
        (268, 325, 268, 333),
    ],
    dtype=float,
)


def whirl(x: float, y: float, radius: float, angle: float) -> FloatArray:
    """Landmarks on a circle turned about its centre."""
    around = radius * np.exp(2j * np.pi * np.arange(10) / 10)
    before, after = around + complex(x, y), around * np.exp(1j * angle) + complex(x, y)
    return np.stack([before.real, before.imag, after.real, after.imag], axis=1)


def main(output: Path, photo: Path | None = None, landmarks: Path | None = None) -> dict[str, Any]:
    if photo is None:
        with get_sample_data("grace_hopper.jpg") as file:
            image = imread(file, format="jpg")
    else:
        image = imread(photo)
    moves = np.concatenate([SMILE, whirl(255, 480, 60, 2 * np.pi / 3)]) if landmarks is None else np.loadtxt(landmarks)
    moves = moves.reshape(-1, 4)
    warped = warp_by_landmarks(image, moves[:, :2], moves[:, 2:])

    figure, ((left, mesh, right),) = panels(1, 3, (4.2, 5.4))
    for ax, shown in ((left, image), (right, warped.image)):
        ax.imshow(shown)
        ax.set_axis_off()
    left.plot(*moves[:, :2].T, "o", color="white", mec="black", markersize=4)
    left.plot(*np.stack([moves[:, [0, 2]], moves[:, [1, 3]]]).transpose(0, 2, 1), color="white", lw=1)
    mesh.triplot(*warped.positions.T, warped.F, lw=0.4, color="0.2")
    mesh.set(xlim=left.get_xlim(), ylim=left.get_ylim(), aspect="equal")
    mesh.set_axis_off()
    for ax, title in ((left, "landmarks"), (mesh, "where the picture goes"), (right, "warped")):
        ax.set_title(title, size=11)
    save(figure, output, "warped_photo")
    return {
        "pixels": list(image.shape[:2]),
        "landmarks": len(moves),
        "bijective": warped.result.certificate.bijective,
        "iterations": warped.result.n_iterations,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="DIR", help="folder (figures)")
    parser.add_argument("--photo", type=Path, help="PNG or JPEG")
    parser.add_argument("--landmarks", type=Path, help="text file, a line x y x' y' for each")
    print(json.dumps(main(**vars(parser.parse_args())), indent=2))
