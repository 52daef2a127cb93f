"""Maps of triangle meshes into the plane with no inverted triangle, certified exactly.

The public names are imported when they are first used, so that ``import quasiharmonic`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module

# As of `typing`, whose import would take longer than all else here.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from quasiharmonic.animation.animated import animate
    from quasiharmonic.animation.frames import Animation, FrameStep
    from quasiharmonic.apply.airmesh import AirMesh, Moment
    from quasiharmonic.apply.cutting import Opened, cut_open
    from quasiharmonic.apply.inverse import InverseMap, SurfacePoints
    from quasiharmonic.apply.repairing import Repaired, RepairedIsland, repair
    from quasiharmonic.apply.transfer import SurfaceMap
    from quasiharmonic.apply.warping import Warped, warp_along, warp_by_landmarks
    from quasiharmonic.curves import Rails
    from quasiharmonic.cuts.finding import find_cuts
    from quasiharmonic.descent import Descent
    from quasiharmonic.energy.energies import Energy
    from quasiharmonic.energy.measures import Distortion, distortion
    from quasiharmonic.energy.polishing import polish
    from quasiharmonic.exact.certificate import Certificate, certify, flipped_triangles, is_injective
    from quasiharmonic.exact.diagnosis import Diagnosis, diagnose
    from quasiharmonic.flattening.distance_descent import keep_distances
    from quasiharmonic.flattening.flattened import flatten
    from quasiharmonic.flattening.patterns import write_pattern
    from quasiharmonic.gradients.derivative import Derivative
    from quasiharmonic.gradients.flattened import flatten_derivative
    from quasiharmonic.gradients.polished import polish_derivative
    from quasiharmonic.gradients.tensors import quasi_harmonic_derivative
    from quasiharmonic.ladder.mapping import injective_map
    from quasiharmonic.ladder.refining import RefinedProblem, refine, refine_problem
    from quasiharmonic.mesh.refinement import Refined
    from quasiharmonic.problem import Problem
    from quasiharmonic.registration.inverse import InverseField, inverse_field
    from quasiharmonic.registration.nearest import InvertibleField, nearest_invertible
    from quasiharmonic.result import MapResult, Snapshot, Stage, Status, Step
    from quasiharmonic.search.harmonising import harmonise
    from quasiharmonic.search.many import injective_maps
    from quasiharmonic.search.solving import quasi_harmonic_map, solve
    from quasiharmonic.simulation.morphed import Morphed
    from quasiharmonic.simulation.morphing import morph
    from quasiharmonic.simulation.moving import MovingMesh

__version__ = "0.1.0"

_HOME = {
    "AirMesh": "apply.airmesh",
    "Animation": "animation.frames",
    "Certificate": "exact.certificate",
    "Derivative": "gradients.derivative",
    "Descent": "descent",
    "Diagnosis": "exact.diagnosis",
    "Distortion": "energy.measures",
    "Energy": "energy.energies",
    "FrameStep": "animation.frames",
    "InverseField": "registration.inverse",
    "InverseMap": "apply.inverse",
    "InvertibleField": "registration.nearest",
    "MapResult": "result",
    "Moment": "apply.airmesh",
    "Morphed": "simulation.morphed",
    "MovingMesh": "simulation.moving",
    "Opened": "apply.cutting",
    "Problem": "problem",
    "Rails": "curves",
    "Refined": "mesh.refinement",
    "RefinedProblem": "ladder.refining",
    "Repaired": "apply.repairing",
    "RepairedIsland": "apply.repairing",
    "Snapshot": "result",
    "Stage": "result",
    "Status": "result",
    "Step": "result",
    "SurfaceMap": "apply.transfer",
    "SurfacePoints": "apply.inverse",
    "Warped": "apply.warping",
    "animate": "animation.animated",
    "certify": "exact.certificate",
    "cut_open": "apply.cutting",
    "diagnose": "exact.diagnosis",
    "distortion": "energy.measures",
    "find_cuts": "cuts.finding",
    "flatten": "flattening.flattened",
    "flatten_derivative": "gradients.flattened",
    "flipped_triangles": "exact.certificate",
    "harmonise": "search.harmonising",
    "injective_map": "ladder.mapping",
    "injective_maps": "search.many",
    "inverse_field": "registration.inverse",
    "is_injective": "exact.certificate",
    "keep_distances": "flattening.distance_descent",
    "morph": "simulation.morphing",
    "nearest_invertible": "registration.nearest",
    "polish": "energy.polishing",
    "polish_derivative": "gradients.polished",
    "quasi_harmonic_derivative": "gradients.tensors",
    "quasi_harmonic_map": "search.solving",
    "refine": "ladder.refining",
    "refine_problem": "ladder.refining",
    "repair": "apply.repairing",
    "solve": "search.solving",
    "warp_along": "apply.warping",
    "warp_by_landmarks": "apply.warping",
    "write_pattern": "flattening.patterns",
}

__all__ = [
    "AirMesh",
    "Animation",
    "Certificate",
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
    "Moment",
    "Morphed",
    "MovingMesh",
    "Opened",
    "Problem",
    "Rails",
    "Refined",
    "RefinedProblem",
    "Repaired",
    "RepairedIsland",
    "Snapshot",
    "Stage",
    "Status",
    "Step",
    "SurfaceMap",
    "SurfacePoints",
    "Warped",
    "animate",
    "certify",
    "cut_open",
    "diagnose",
    "distortion",
    "find_cuts",
    "flatten",
    "flatten_derivative",
    "flipped_triangles",
    "harmonise",
    "injective_map",
    "injective_maps",
    "inverse_field",
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
_MODULES = ("atlas", "batch", "curves", "io", "linsolve", "notebook", "plot", "surfaces", "targets")


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
