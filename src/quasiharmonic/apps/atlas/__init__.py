"""Maps with seams: the library's functions, applied to each island.

Every function takes a `SeamedMesh` in place of ``V, F, uv`` and has the name of the function for one surface. The
package builds on `apps.flattening` and `solver`. Start reading in `working`. Names are imported at their first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.apps.atlas.mapped import MappedAtlas, MappedIsland
    from quasiharmonic.apps.atlas.verdict import AtlasVerdict, IslandVerdict, certify
    from quasiharmonic.apps.atlas.working import flatten, harmonise, injective_map, pack, polish
    from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh

_HOME = {
    "AtlasVerdict": "apps.atlas.verdict",
    "Island": "geometry.mesh.seams",
    "IslandVerdict": "apps.atlas.verdict",
    "MappedAtlas": "apps.atlas.mapped",
    "MappedIsland": "apps.atlas.mapped",
    "SeamedMesh": "geometry.mesh.seams",
    "certify": "apps.atlas.verdict",
    "flatten": "apps.atlas.working",
    "harmonise": "apps.atlas.working",
    "injective_map": "apps.atlas.working",
    "pack": "apps.atlas.working",
    "polish": "apps.atlas.working",
}

__all__ = [
    "AtlasVerdict",
    "Island",
    "IslandVerdict",
    "MappedAtlas",
    "MappedIsland",
    "SeamedMesh",
    "certify",
    "flatten",
    "harmonise",
    "injective_map",
    "pack",
    "polish",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"quasiharmonic.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
