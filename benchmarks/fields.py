"""Repair of displacement fields with known folds, compared with Gaussian smoothing.

    python benchmarks/fields.py -o DIR

Each field is a smooth wave plus bumps on a jittered lattice; each bump inverts a few cells, and no two are equal.
Fields have 1, 50 and 5,000 bumps. The measure is the distance from the given field over all pixels. It compares
`quasiharmonic.nearest_invertible` with the narrowest Gaussian, found by bisection, that brings all determinants above
the same bound.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from quasiharmonic import nearest_invertible
from quasiharmonic.apps.displacement_fields.nearest import fold_free
from quasiharmonic.util.arrays import FloatArray
from speed import machine

# Spacing of the bumps' lattice in pixels, and number of bumps of each field.
CELL, COUNTS = 12, (1, 50, 5000)
LEAST = 0.01


def synthetic(folds: int, seed: int = 0) -> FloatArray:
    """Return a field (h, w, 2) with this number of inverted bumps."""
    dice = np.random.default_rng(seed)
    side = max(6, int(np.ceil(np.sqrt(folds))) + 1)
    size = CELL * side
    y, x = np.mgrid[:size, :size].astype(float)
    field = np.stack([2 * np.sin(y / 23), 2 * np.cos(x / 29)], axis=-1)
    places = dice.permutation(side * side)[:folds]
    for row, column in zip(*np.divmod(places, side), strict=True):
        at = (np.array((row, column)) + 0.5 + dice.uniform(-0.1, 0.1, 2)) * CELL
        angle, height, width = dice.uniform(0, 2 * np.pi), dice.uniform(3, 5), dice.uniform(1.2, 1.6)
        part = np.s_[max(0, int(at[0]) - 12) : int(at[0]) + 13, max(0, int(at[1]) - 12) : int(at[1]) + 13]
        bump = height * np.exp(-((y[part] - at[0]) ** 2 + (x[part] - at[1]) ** 2) / (2 * width**2))
        field[part] += bump[..., None] * np.array((np.cos(angle), np.sin(angle)))
    return field


def lowest(field: FloatArray) -> float:
    """Return the lowest determinant at a corner of a cell."""
    h, w = field.shape[:2]
    places = field + np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1)
    along, down = np.diff(places, axis=1), np.diff(places, axis=0)
    pairs = [(a, d) for a in (along[:-1], along[1:]) for d in (down[:, :-1], down[:, 1:])]
    return float(min((a[..., 0] * d[..., 1] - a[..., 1] * d[..., 0]).min() for a, d in pairs))


def smoothed_until_invertible(field: FloatArray) -> tuple[FloatArray, float]:
    """Return the field smoothed by the narrowest sufficient Gaussian, and its standard deviation in pixels."""

    def smooth(deviation: float) -> FloatArray:
        return np.stack([gaussian_filter(field[..., k], deviation, mode="nearest") for k in (0, 1)], axis=-1)

    low, high = 0.0, 1.0
    while lowest(smooth(high)) <= LEAST:
        low, high = high, 2 * high
    while high - low > 0.01 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lowest(smooth(middle)) <= LEAST else (low, middle)
    return smooth(high), high


def apart(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Return the root mean square and the largest distance of two fields."""
    square = ((one - other) ** 2).sum(axis=2)
    return float(np.sqrt(square.mean())), float(np.sqrt(square.max()))


def main(output: Path, counts: tuple[int, ...] = COUNTS) -> list[dict[str, float]]:
    rows = []
    for count in counts:
        field = synthetic(count)
        began = time.process_time()
        mended = nearest_invertible(field, min_jacobian=LEAST)
        seconds = time.process_time() - began
        assert fold_free(mended.field).all()
        assert lowest(mended.field) > LEAST
        smooth, deviation = smoothed_until_invertible(field)
        near, smoothing = apart(mended.field, field), apart(smooth, field)
        rows.append(
            {
                "bumps": count,
                "side": len(field),
                "cells": mended.folds,
                "moved": float(mended.moved_mask.mean()),
                "rms": near[0],
                "largest": near[1],
                "bijective": bool(mended.certificate.bijective),
                "seconds": seconds,
                "deviation": deviation,
                "smoothed rms": smoothing[0],
                "smoothed largest": smoothing[1],
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    output.mkdir(parents=True, exist_ok=True)
    (output / "fields.md").write_text(f"{machine()}\n\n{table(rows)}", encoding="utf-8")
    return rows


def table(rows: list[dict[str, float]]) -> str:
    """Return the rows in Markdown."""
    heads = "bumps", "pixels", "cells that fold", "pixels moved", "distance: RMS", "maximum", "Gaussian: RMS", "maximum"
    lines = [f"| {' | '.join(heads)} | CPU seconds |", "|---" * (1 + len(heads)) + "|"]
    for row in rows:
        cells = f"{row['bumps']:,}", f"{row['side']}²", f"{row['cells']:,}", f"{row['moved']:.1%}"
        distances = (f"{row[key]:.3f}" for key in ("rms", "largest", "smoothed rms", "smoothed largest"))
        lines.append(f"| {' | '.join([*cells, *distances])} | {row['seconds']:.2g} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="DIR", help="folder (figures)")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, metavar="N", help="how many bumps")
    print(json.dumps(main(**vars(parser.parse_args())), indent=2))
