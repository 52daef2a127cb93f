"""Maps of triangle meshes into the plane with no inverted triangle, certified exactly.

The public names are imported when they are first used, so that ``import quasiharmonic`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .certificate import Certificate, certify, flipped_triangles, is_injective
    from .diagnosis import Diagnosis, diagnose
    from .energies import Energy
    from .inject import injective_map, quasi_harmonic_map, solve
    from .measures import Distortion, distortion
    from .polishing import polish
    from .problem import Problem
    from .refinement import Refined, refine
    from .result import MapResult, Snapshot, Stage, Status, Step
    from .strategy import Descent

__version__ = "0.1.0"

_HOME = {
    "Certificate": "certificate",
    "Descent": "strategy",
    "Diagnosis": "diagnosis",
    "Distortion": "measures",
    "Energy": "energies",
    "MapResult": "result",
    "Problem": "problem",
    "Refined": "refinement",
    "Snapshot": "result",
    "Stage": "result",
    "Status": "result",
    "Step": "result",
    "certify": "certificate",
    "diagnose": "diagnosis",
    "distortion": "measures",
    "flipped_triangles": "certificate",
    "injective_map": "inject",
    "is_injective": "certificate",
    "polish": "polishing",
    "quasi_harmonic_map": "inject",
    "refine": "refinement",
    "solve": "inject",
}

__all__ = [
    "Certificate",
    "Descent",
    "Diagnosis",
    "Distortion",
    "Energy",
    "MapResult",
    "Problem",
    "Refined",
    "Snapshot",
    "Stage",
    "Status",
    "Step",
    "certify",
    "diagnose",
    "distortion",
    "flipped_triangles",
    "injective_map",
    "is_injective",
    "polish",
    "quasi_harmonic_map",
    "refine",
    "solve",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
