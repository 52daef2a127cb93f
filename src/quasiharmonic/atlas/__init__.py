"""Maps with seams: what the library does to a surface, done to each island of one.

Every function takes a `SeamedMesh` in the place of ``V, F, uv``, and has the name of the one that takes these. As the
package's own, the names are imported when they are first used: a command that maps needs nothing that flattens.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.atlas.mapped import MappedAtlas, MappedIsland
    from quasiharmonic.atlas.verdict import AtlasVerdict, IslandVerdict, certify
    from quasiharmonic.atlas.working import flatten, harmonise, injective_map, pack, polish
    from quasiharmonic.mesh.seams import Island, SeamedMesh

_HOME = {
    "AtlasVerdict": "atlas.verdict",
    "Island": "mesh.seams",
    "IslandVerdict": "atlas.verdict",
    "MappedAtlas": "atlas.mapped",
    "MappedIsland": "atlas.mapped",
    "SeamedMesh": "mesh.seams",
    "certify": "atlas.verdict",
    "flatten": "atlas.working",
    "harmonise": "atlas.working",
    "injective_map": "atlas.working",
    "pack": "atlas.working",
    "polish": "atlas.working",
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
