"""Methods that move a mesh with its boundary: those of finite-element codes, and this library's.

Each method is constructed from a `Scene` and has ``step(target)``, which returns all vertices with the scene's
``fixed`` vertices at ``target``. Linear methods start every step either from the first mesh or from the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from scipy.interpolate import RBFInterpolator

from moving_scenes import Scene
from quasiharmonic.util.arrays import FloatArray, IntArray

#: A function of vertices (n, 2), triangles, the vertices with prescribed x and with prescribed y, and the prescribed
#: displacements (n, 2); it returns all displacements.
Extension = Callable[[FloatArray, IntArray, tuple[IntArray, IntArray], FloatArray], FloatArray]


class Mover(Protocol):
    """A method that moves a mesh."""

    def step(self, target: FloatArray) -> FloatArray: ...


class Extended:
    """Moves a mesh by extending the boundary's displacement to the interior.

    Parameters
    ----------
    scene : Scene
    extension : Extension
    from_rest : bool
        Extend the whole displacement over the first mesh, or the last step's over the last mesh.
    """

    def __init__(self, scene: Scene, extension: Extension, from_rest: bool) -> None:
        self._scene, self._extension, self._from_rest = scene, extension, from_rest
        self._here = scene.V

    def step(self, target: FloatArray) -> FloatArray:
        scene = self._scene
        base = scene.V if self._from_rest else self._here
        way = np.zeros_like(base)
        way[scene.fixed] = target - base[scene.fixed]
        given = scene.given()
        # Vertices that slide along a wall have no displacement across it.
        moved = base + self._extension(base, scene.F, given, way)
        for axis in (0, 1):
            at = np.isin(scene.fixed, given[axis])
            moved[scene.fixed[at], axis] = target[at, axis]
        self._here = moved
        return moved


def harmonic(V: FloatArray, F: IntArray, given: tuple[IntArray, IntArray], way: FloatArray) -> FloatArray:
    """Extend each component harmonically."""
    from skfem import Basis, ElementTriP1, MeshTri, condense, solve
    from skfem.models.poisson import laplace

    A = laplace.assemble(Basis(MeshTri(np.ascontiguousarray(V.T), np.ascontiguousarray(F.T)), ElementTriP1()))
    return np.stack([solve(*condense(A, x=way[:, axis], D=given[axis])) for axis in (0, 1)], axis=1)


def elasticity(V: FloatArray, F: IntArray, given: tuple[IntArray, IntArray], way: FloatArray) -> FloatArray:
    """Extend by linear elasticity, ν = 0.3; smaller triangles are stiffer (Stein, Tezduyar and Benney 2003, χ = 1)."""
    from skfem import Basis, BilinearForm, ElementTriP1, ElementVector, MeshTri, condense, solve
    from skfem.helpers import ddot, eye, sym_grad, trace
    from skfem.models.elasticity import lame_parameters

    lam, mu = lame_parameters(1.0, 0.3)

    @BilinearForm
    def stiffness(u, v, w):
        strain = sym_grad(u)
        return w["stiffening"] * ddot(lam * eye(trace(strain), 2) + 2 * mu * strain, sym_grad(v))

    basis = Basis(MeshTri(np.ascontiguousarray(V.T), np.ascontiguousarray(F.T)), ElementVector(ElementTriP1()))
    a, b, c = V[F].transpose(1, 0, 2)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    stiffening = np.broadcast_to((area.mean() / area)[:, None], basis.dx.shape)
    A = stiffness.assemble(basis, stiffening=stiffening)
    dofs = basis.nodal_dofs
    x = np.zeros(basis.N)
    x[dofs] = way.T
    solved = solve(*condense(A, x=x, D=np.concatenate([dofs[axis, given[axis]] for axis in (0, 1)])))
    return solved[dofs].T


def thin_plate(V: FloatArray, F: IntArray, given: tuple[IntArray, IntArray], way: FloatArray) -> FloatArray:
    """Extend by thin-plate splines through the boundary (SciPy's `RBFInterpolator`)."""
    if given[0] is given[1]:
        return RBFInterpolator(V[given[0]], way[given[0]], kernel="thin_plate_spline")(V)
    parts = [RBFInterpolator(V[at], way[at, k], kernel="thin_plate_spline")(V) for k, at in enumerate(given)]
    return np.stack(parts, axis=1)


class Following:
    """`quasiharmonic.MovingMesh` with default settings."""

    def __init__(self, scene: Scene) -> None:
        from quasiharmonic import MovingMesh

        self._mesh, self._body = MovingMesh(scene.V, scene.F, scene.body, slide=scene.slide), scene.body.size

    def step(self, target: FloatArray) -> FloatArray | None:
        try:
            return self._mesh.advance(target[: self._body])
        except RuntimeError:
            return None


class Morphing:
    """`quasiharmonic.morph` with default settings; each displacement is one step from the first mesh."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def step(self, target: FloatArray) -> FloatArray | None:
        from quasiharmonic import morph

        scene = self._scene
        morphed = morph(scene.V, scene.F, scene.body, target[: scene.body.size], slide=scene.slide)
        return morphed.points if morphed.valid else None
