"""Maps of triangle meshes into the plane with no inverted triangle, certified exactly.

The public names are imported when they are first used, so that ``import quasiharmonic`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module

from quasiharmonic.util.display import register_renderer

# As of `typing`, whose import would take longer than all else here.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from quasiharmonic.apps.air_mesh.airmesh import AirMesh, AirMeshState
    from quasiharmonic.apps.animation.animated import animate
    from quasiharmonic.apps.animation.frames import Animation, FrameStep
    from quasiharmonic.apps.displacement_fields.inverse import InverseField, inverse_field
    from quasiharmonic.apps.displacement_fields.nearest import InvertibleField, nearest_invertible
    from quasiharmonic.apps.flattening.distances.descent import keep_distances
    from quasiharmonic.apps.flattening.flattened import flatten
    from quasiharmonic.apps.flattening.patterns import write_pattern
    from quasiharmonic.apps.gradients.derivative import Derivative
    from quasiharmonic.apps.gradients.flattened import flatten_derivative
    from quasiharmonic.apps.gradients.polished import polish_derivative
    from quasiharmonic.apps.gradients.tensors import quasi_harmonic_derivative
    from quasiharmonic.apps.inverse.inverse import InverseMap, SurfacePoints
    from quasiharmonic.apps.inverse.transfer import SurfaceMap
    from quasiharmonic.apps.mesh_motion.morphed import MorphResult
    from quasiharmonic.apps.mesh_motion.morphing import morph
    from quasiharmonic.apps.mesh_motion.moving import MovingMesh
    from quasiharmonic.apps.repair.cutting import CutMesh, cut_open
    from quasiharmonic.apps.repair.repairing import RepairedIsland, RepairResult, repair
    from quasiharmonic.apps.warping.warping import WarpResult, warp_along, warp_by_landmarks
    from quasiharmonic.energies.energies import Energy
    from quasiharmonic.energies.measures import Distortion, distortion
    from quasiharmonic.energies.polishing import polish
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.geometry.exact.certificate import Certificate
    from quasiharmonic.geometry.mesh.refinement import Refined
    from quasiharmonic.geometry.mesh.topology import boundary_loops
    from quasiharmonic.problem import Problem
    from quasiharmonic.problem.diagnosis import Diagnosis, diagnose
    from quasiharmonic.problem.result import MapResult, Snapshot, Stage, Status, Step
    from quasiharmonic.problem.verdict import certify, inverted_triangles, is_injective
    from quasiharmonic.solver.methods import Descent
    from quasiharmonic.solver.refine.mapping import injective_map
    from quasiharmonic.solver.refine.refining import RefinedProblem, refine, refine_problem
    from quasiharmonic.solver.search.harmonising import harmonise
    from quasiharmonic.solver.search.many import injective_maps
    from quasiharmonic.solver.search.solving import quasi_harmonic_map, solve
    from quasiharmonic.targets.cuts.find import find_cuts
    from quasiharmonic.ui.notebook.widget import MapWidget as MapWidget

__version__ = "0.1.0"

_HOME = {
    "AirMesh": "apps.air_mesh.airmesh",
    "Animation": "apps.animation.frames",
    "Certificate": "geometry.exact.certificate",
    "Derivative": "apps.gradients.derivative",
    "Descent": "solver.methods",
    "Diagnosis": "problem.diagnosis",
    "Distortion": "energies.measures",
    "Energy": "energies.energies",
    "FrameStep": "apps.animation.frames",
    "InverseField": "apps.displacement_fields.inverse",
    "InverseMap": "apps.inverse.inverse",
    "InvertibleField": "apps.displacement_fields.nearest",
    "MapResult": "problem.result",
    # Not in `__all__`: it needs an extra, and ``from quasiharmonic import *`` must work without.
    "MapWidget": "ui.notebook.widget",
    "AirMeshState": "apps.air_mesh.airmesh",
    "MorphResult": "apps.mesh_motion.morphed",
    "MovingMesh": "apps.mesh_motion.moving",
    "CutMesh": "apps.repair.cutting",
    "Problem": "problem",
    "BoundaryCurves": "geometry.curves",
    "Refined": "geometry.mesh.refinement",
    "RefinedProblem": "solver.refine.refining",
    "RepairResult": "apps.repair.repairing",
    "RepairedIsland": "apps.repair.repairing",
    "Snapshot": "problem.result",
    "Stage": "problem.result",
    "Status": "problem.result",
    "Step": "problem.result",
    "SurfaceMap": "apps.inverse.transfer",
    "SurfacePoints": "apps.inverse.inverse",
    "WarpResult": "apps.warping.warping",
    "animate": "apps.animation.animated",
    "boundary_loops": "geometry.mesh.topology",
    "certify": "problem.verdict",
    "cut_open": "apps.repair.cutting",
    "diagnose": "problem.diagnosis",
    "distortion": "energies.measures",
    "find_cuts": "targets.cuts.find",
    "flatten": "apps.flattening.flattened",
    "flatten_derivative": "apps.gradients.flattened",
    "inverted_triangles": "problem.verdict",
    "harmonise": "solver.search.harmonising",
    "injective_map": "solver.refine.mapping",
    "injective_maps": "solver.search.many",
    "inverse_field": "apps.displacement_fields.inverse",
    "is_injective": "problem.verdict",
    "keep_distances": "apps.flattening.distances.descent",
    "morph": "apps.mesh_motion.morphing",
    "nearest_invertible": "apps.displacement_fields.nearest",
    "polish": "energies.polishing",
    "polish_derivative": "apps.gradients.polished",
    "quasi_harmonic_derivative": "apps.gradients.tensors",
    "quasi_harmonic_map": "solver.search.solving",
    "refine": "solver.refine.refining",
    "refine_problem": "solver.refine.refining",
    "repair": "apps.repair.repairing",
    "solve": "solver.search.solving",
    "warp_along": "apps.warping.warping",
    "warp_by_landmarks": "apps.warping.warping",
    "write_pattern": "apps.flattening.patterns",
}

__all__ = [
    "AirMesh",
    "AirMeshState",
    "Animation",
    "BoundaryCurves",
    "Certificate",
    "CutMesh",
    "Derivative",
    "Descent",
    "Diagnosis",
    "Distortion",
    "Energy",
    "FrameStep",
    "InverseField",
    "InverseMap",
    "InvertibleField",
    "MapResult",
    "MorphResult",
    "MovingMesh",
    "Problem",
    "Refined",
    "RefinedProblem",
    "RepairResult",
    "RepairedIsland",
    "Snapshot",
    "Stage",
    "Status",
    "Step",
    "SurfaceMap",
    "SurfacePoints",
    "WarpResult",
    "animate",
    "boundary_loops",
    "certify",
    "cut_open",
    "diagnose",
    "distortion",
    "find_cuts",
    "flatten",
    "flatten_derivative",
    "harmonise",
    "injective_map",
    "injective_maps",
    "inverse_field",
    "inverted_triangles",
    "is_injective",
    "keep_distances",
    "morph",
    "nearest_invertible",
    "polish",
    "polish_derivative",
    "quasi_harmonic_derivative",
    "quasi_harmonic_map",
    "refine",
    "refine_problem",
    "repair",
    "solve",
    "warp_along",
    "warp_by_landmarks",
    "write_pattern",
]


# Modules that are part of what is public; they too are imported when they are first used.
_MODULES = ("atlas", "batch", "io", "linsolve", "plot", "surfaces", "targets")


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f".{name}", __name__)
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES, "__version__"])


register_renderer(lambda: import_module(".ui.display", __name__))
