"""Maps of triangle meshes into the plane with no inverted triangle, certified exactly.

The public names are imported when they are first used, so that ``import quasiharmonic`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .airmesh import AirMesh, Moment
    from .certificate import Certificate, certify, flipped_triangles, is_injective
    from .cutting import Opened, cut_open
    from .diagnosis import Diagnosis, diagnose
    from .energies import Energy
    from .flattening.flatten import flatten
    from .harmonising import harmonise
    from .inject import injective_map, quasi_harmonic_map, solve
    from .inverse import InverseMap, SurfacePoints
    from .measures import Distortion, distortion
    from .morphing import Morphed, morph
    from .polishing import polish
    from .problem import Problem
    from .refinement import Refined, RefinedProblem, refine, refine_problem
    from .repairing import Repaired, RepairedIsland, repair
    from .result import MapResult, Snapshot, Stage, Status, Step
    from .strategy import Descent
    from .transfer import SurfaceMap
    from .warping import Warped, warp_along, warp_by_landmarks

__version__ = "0.1.0"

_HOME = {
    "AirMesh": "airmesh",
    "Certificate": "certificate",
    "Descent": "strategy",
    "Diagnosis": "diagnosis",
    "Distortion": "measures",
    "Energy": "energies",
    "InverseMap": "inverse",
    "MapResult": "result",
    "Moment": "airmesh",
    "Morphed": "morphing",
    "Opened": "cutting",
    "Problem": "problem",
    "Refined": "refinement",
    "RefinedProblem": "refinement",
    "Repaired": "repairing",
    "RepairedIsland": "repairing",
    "Snapshot": "result",
    "Stage": "result",
    "Status": "result",
    "Step": "result",
    "SurfaceMap": "transfer",
    "SurfacePoints": "inverse",
    "Warped": "warping",
    "certify": "certificate",
    "cut_open": "cutting",
    "diagnose": "diagnosis",
    "distortion": "measures",
    "flatten": "flattening.flatten",
    "flipped_triangles": "certificate",
    "harmonise": "harmonising",
    "injective_map": "inject",
    "is_injective": "certificate",
    "morph": "morphing",
    "polish": "polishing",
    "quasi_harmonic_map": "inject",
    "refine": "refinement",
    "refine_problem": "refinement",
    "repair": "repairing",
    "solve": "inject",
    "warp_along": "warping",
    "warp_by_landmarks": "warping",
}

__all__ = [
    "AirMesh",
    "Certificate",
    "Descent",
    "Diagnosis",
    "Distortion",
    "Energy",
    "InverseMap",
    "MapResult",
    "Moment",
    "Morphed",
    "Opened",
    "Problem",
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
    "certify",
    "cut_open",
    "diagnose",
    "distortion",
    "flatten",
    "flipped_triangles",
    "harmonise",
    "injective_map",
    "is_injective",
    "morph",
    "polish",
    "quasi_harmonic_map",
    "refine",
    "refine_problem",
    "repair",
    "solve",
    "warp_along",
    "warp_by_landmarks",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
