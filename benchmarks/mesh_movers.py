"""Methods that move a mesh with its boundary: those of finite-element codes, and this library's.

Each method is constructed from a `Scene` and has ``step(target)``, which returns all vertices with the scene's
``fixed`` vertices at ``target``. Linear methods start every step either from the first mesh or from the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

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


def compact(V: FloatArray, F: IntArray, given: tuple[IntArray, IntArray], way: FloatArray) -> FloatArray:
    """Extend by Wendland's C² function (de Boer, van der Schoot, Bijl 2007); radius 2, about the channels' height."""
    radius = 2.0

    def kernel(a: FloatArray, b: FloatArray) -> FloatArray:
        far = np.minimum(cdist(a, b) / radius, 1)
        return (1 - far) ** 4 * (4 * far + 1)

    parts = []
    for k, at in enumerate(given):
        parts.append(kernel(V, V[at]) @ np.linalg.solve(kernel(V[at], V[at]), way[at, k]))
    return np.stack(parts, axis=1)


class Kratos:
    """Kratos' mesh-moving solvers with default settings.

    Parameters
    ----------
    scene : Scene
    kind : {"structural_similarity", "laplacian"}
    """

    def __init__(self, scene: Scene, kind: str) -> None:
        import KratosMultiphysics as KM  # noqa: N817, their own name for it

        KM.Logger.GetDefaultOutput().SetSeverity(KM.Logger.Severity.WARNING)
        from KratosMultiphysics.MeshMovingApplication import python_solvers_wrapper_mesh_motion as wrapper

        self._scene, self._kratos = scene, KM
        model = KM.Model()
        part = model.CreateModelPart("mesh")
        settings = KM.Parameters(
            """{"solver_type": "KIND", "model_part_name": "mesh", "domain_size": 2, "buffer_size": 3, "echo_level": 0,
            "model_import_settings": {"input_type": "use_input_model_part"}, "time_stepping": {"time_step": 1.0},
            "calculate_mesh_velocity": false}""".replace("KIND", kind)
        )
        self._solver = wrapper.CreateSolverByParameters(model, settings, "OpenMP")
        self._solver.AddVariables()
        for i, (x, y) in enumerate(scene.V, 1):
            part.CreateNewNode(i, x, y, 0.0)
        properties = part.CreateNewProperties(0)
        for i, corners in enumerate((scene.F + 1).tolist(), 1):
            part.CreateNewElement("Element2D3N", i, corners, properties)
        self._solver.ImportModelPart()
        self._solver.PrepareModelPart()
        self._solver.AddDofs()
        self._solver.Initialize()
        self._part, self._time = part, 0.0
        nodes = [part.GetNode(i + 1) for i in range(len(scene.V))]
        self._nodes = nodes
        for axis, variable in enumerate((KM.MESH_DISPLACEMENT_X, KM.MESH_DISPLACEMENT_Y)):
            for v in scene.given()[axis].tolist():
                nodes[v].Fix(variable)
        for node in nodes:
            node.Fix(KM.MESH_DISPLACEMENT_Z)

    def step(self, target: FloatArray) -> FloatArray:
        KM, scene = self._kratos, self._scene
        self._time = self._solver.AdvanceInTime(self._time)
        way = target - scene.V[scene.fixed]
        for axis, variable in enumerate((KM.MESH_DISPLACEMENT_X, KM.MESH_DISPLACEMENT_Y)):
            at = np.isin(scene.fixed, scene.given()[axis])
            for v, u in zip(scene.fixed[at].tolist(), way[at, axis].tolist(), strict=True):
                self._nodes[v].SetSolutionStepValue(variable, u)
        self._solver.InitializeSolutionStep()
        self._solver.Predict()
        self._solver.SolveSolutionStep()
        self._solver.FinalizeSolutionStep()
        return np.array([(node.X, node.Y) for node in self._nodes])


class Ours:
    """`quasiharmonic.MovingMesh` with default settings."""

    def __init__(self, scene: Scene) -> None:
        from quasiharmonic import MovingMesh

        self._mesh, self._body = MovingMesh(scene.V, scene.F, scene.body, slide=scene.slide), scene.body.size

    def step(self, target: FloatArray) -> FloatArray | None:
        try:
            return self._mesh.advance(target[: self._body])
        except RuntimeError:
            return None


class MorphResult:
    """`quasiharmonic.morph` with default settings; each displacement is one step from the first mesh."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def step(self, target: FloatArray) -> FloatArray | None:
        from quasiharmonic import morph

        scene = self._scene
        morphed = morph(scene.V, scene.F, scene.body, target[: scene.body.size], slide=scene.slide)
        return morphed.points if morphed.valid else None
