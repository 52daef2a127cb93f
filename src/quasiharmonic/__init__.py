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
    from quasiharmonic.apply.morphing import Morphed, morph
    from quasiharmonic.apply.refining import RefinedProblem, refine_problem
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
    from quasiharmonic.mesh.refinement import Refined, refine
    from quasiharmonic.problem import Problem
    from quasiharmonic.result import MapResult, Snapshot, Stage, Status, Step
    from quasiharmonic.search.harmonising import harmonise
    from quasiharmonic.search.solving import injective_map, quasi_harmonic_map, solve

__version__ = "0.1.0"

_HOME = {
    "AirMesh": "apply.airmesh",
    "Animation": "animation.frames",
    "Certificate": "exact.certificate",
    "Descent": "descent",
    "Diagnosis": "exact.diagnosis",
    "Distortion": "energy.measures",
    "Energy": "energy.energies",
    "FrameStep": "animation.frames",
    "InverseMap": "apply.inverse",
    "MapResult": "result",
    "Moment": "apply.airmesh",
    "Morphed": "apply.morphing",
    "Opened": "apply.cutting",
    "Problem": "problem",
    "Rails": "curves",
    "Refined": "mesh.refinement",
    "RefinedProblem": "apply.refining",
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
    "flipped_triangles": "exact.certificate",
    "harmonise": "search.harmonising",
    "injective_map": "search.solving",
    "is_injective": "exact.certificate",
    "keep_distances": "flattening.distance_descent",
    "morph": "apply.morphing",
    "polish": "energy.polishing",
    "quasi_harmonic_map": "search.solving",
    "refine": "mesh.refinement",
    "refine_problem": "apply.refining",
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
    "Descent",
    "Diagnosis",
    "Distortion",
    "Energy",
    "FrameStep",
    "InverseMap",
    "MapResult",
    "Moment",
    "Morphed",
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
    "flipped_triangles",
    "harmonise",
    "injective_map",
    "is_injective",
    "keep_distances",
    "morph",
    "polish",
    "quasi_harmonic_map",
    "refine",
    "refine_problem",
    "repair",
    "solve",
    "warp_along",
    "warp_by_landmarks",
    "write_pattern",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
