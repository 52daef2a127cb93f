"""Arrays and calls for the tests of inputs."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.surfaces import disk

V, F = disk(2)
UV = V[:, :2].copy()
N = len(V)
LOOPS = boundary_loops(F, N)
RIM = np.concatenate(LOOPS)
SQUARE = [[(-3, -3), (3, -3), (3, 3), (-3, 3)]]
