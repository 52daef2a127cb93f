"""A reader of OBJ files for checking maps independently of the library."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from shared.exact import exact_orientation


class Written(NamedTuple):
    """The content of an OBJ file.

    Attributes
    ----------
    V : (n, 3) float64
        Its ``v`` records.
    F : (f, 3) int64
        Its triangles.
    uv : (n, 2) float64
        The ``vt`` record of each vertex, NaN for vertices without one.
    """

    V: np.ndarray
    F: np.ndarray
    uv: np.ndarray

    def signs(self):
        """Signs of the triangles' areas in the plane, in rational arithmetic."""
        return np.array([exact_orientation(*self.uv[corners]) for corners in self.F])


def written(path):
    """Read a file of triangles in which every vertex has at most one UV position."""
    rows = {"v": [], "vt": [], "f": []}
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        word, *rest = line.split() or [""]
        if word in rows:
            rows[word].append(rest)
    V, vt = ([[float(x) for x in row] for row in rows[word]] for word in ("v", "vt"))
    uv = np.full((len(V), 2), np.nan)
    F = []
    for corners in rows["f"]:
        pairs = [[int(index) - 1 for index in corner.split("/")[:2]] for corner in corners]
        for vertex, place in pairs:
            assert np.isnan(uv[vertex]).all() or uv[vertex].tolist() == vt[place]
            uv[vertex] = vt[place]
        F.append([vertex for vertex, _ in pairs])
    return Written(np.array(V), np.array(F), uv)
