"""Folders of small problems for the tests of `quasiharmonic.batch`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from quasiharmonic import boundary_loops, io
from quasiharmonic.surfaces import disk

# Fields of a record that describe the run, not the result.
PASSING = {"peak_memory", "threads", "time_limit", "memory_limit", "stages"}


def star_of(rings, depth=0.5, tips=5):
    """A disk onto a star."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    angle = np.linspace(0, 2 * np.pi, len(loop), endpoint=False)
    radius = depth + (1 - depth) * np.abs((angle * tips / np.pi) % 2 - 1)
    return V, F, loop, radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def write_problem(folder, V, F, fixed, target):
    """Write one problem as a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    uv = np.full((len(V), 2), 0.5)
    uv[fixed] = target
    io.write_obj(folder / "input.obj", io.MeshData(V, F).with_map(uv))
    (folder / "handles.txt").write_text("".join(f"{i}\n" for i in fixed))
    return folder


def write_stars(root, names, rings=5):
    """Write a different star problem for every name."""
    for k, name in enumerate(names):
        write_problem(root / name, *star_of(rings, depth=0.7 - 0.4 * k / len(names)))
    return root


def record_of(out, name):
    """Read the record of a problem from its file."""
    return json.loads((Path(out) / "results" / name / "record.json").read_text())


def lasting(record):
    """The part of a record that must be the same in every run."""
    return {k: v for k, v in record.items() if k not in PASSING and not k.startswith("seconds")}
