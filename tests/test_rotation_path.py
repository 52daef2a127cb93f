"""`RotationPath`: paths along which triangles rotate."""

import numpy as np
import pytest

from quasiharmonic import boundary_loops
from quasiharmonic.apps.flattening.multilevel import map_to_disk
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.line_search import RotationPath
from quasiharmonic.surfaces import grid, random_delaunay

rng = np.random.default_rng(5)
V, F = random_delaunay(120, 3)
ENERGY = DeformationEnergy(V, F, SymmetricDirichlet())
W = V.view(np.complex128).ravel() + 0.02 * (rng.normal(size=len(V)) + 1j * rng.normal(size=len(V)))
FIXED = np.array([7])


@pytest.fixture(scope="module")
def turning():
    return RotationPath(F, ENERGY.g, len(V), FIXED)


def held(direction):
    """Return a direction that moves the map and leaves the fixed vertex in place."""
    return direction - direction[FIXED]


def test_begins_along_the_direction(turning):
    direction = rng.normal(size=len(V)) + 1j * rng.normal(size=len(V))
    direction[FIXED] = 0
    path = turning.path(W, direction)
    # Central differences have an error from the third derivative, a rotation by some hundred turns.
    slope = (path(1e-5) - path(-1e-5)) / 2e-5
    np.testing.assert_allclose(slope, direction, atol=1e-4)
    assert (path(0.0) == W).all()
    assert (path(3.0)[FIXED] == W[FIXED]).all()


@pytest.mark.parametrize("rate", [1j, 0.5, 0.3 - 2j])
def test_a_similarity_is_followed_to_its_end(turning, rate):
    path = turning.path(W, held(rate * W))
    for t in (0.5, 1.0, 4.0):
        factor = np.exp(1j * t * rate.imag) * (1 + t * rate.real)
        np.testing.assert_allclose(path(t) - W[FIXED], factor * held(W), atol=1e-12)


def test_a_strip_rolls_up_without_strain():
    square, F = grid(120, 2)
    w = 6 * square[:, 0] + 0.1j * square[:, 1]
    energy = DeformationEnergy(np.stack([w.real, w.imag], axis=1), F, SymmetricDirichlet())
    direction = 0.5j * w**2
    path = RotationPath(F, energy.g, w.size, np.array([0])).path(w, direction)
    # At the end the strip has turned by 3 radians, around a circle of twenty times its width.
    assert energy.value(path(0.5)) < 0.01
    assert energy.value(w + 0.5 * direction) > 1


def test_is_not_made_without_a_positive_definite_laplacian():
    # A vertex without triangles has a row of zeros.
    assert RotationPath.of(F, ENERGY.g, len(V) + 1, FIXED) is None


@pytest.mark.slow
def test_a_coil_is_unrolled_in_few_steps():
    square, F = grid(400, 2)
    angle = 20 * square[:, 0]
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (1 + 0.15 * square[:, 1:])
    V = np.column_stack([ring, 0.05 * angle])
    start = map_to_disk(V, F, boundary_loops(F, len(V)))
    energy = DeformationEnergy(V, F, ReweightedDirichlet())
    descent = SurfaceDescent(energy, start, "auto")
    # On straight lines alone it takes 112.
    steps = sum(1 for _ in descend(descent, SymmetricDirichlet(), 1e-4))
    assert steps < 85
    assert descent.distortion < 1e-4
