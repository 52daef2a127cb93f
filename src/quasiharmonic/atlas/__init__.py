"""Maps with seams: what the library does to a surface, done to each island of one.

Every function takes a `SeamedMesh` in the place of ``V, F, uv``, and has the name of the one that takes these.
"""

from quasiharmonic.atlas.mapped import MappedAtlas, MappedIsland
from quasiharmonic.atlas.verdict import AtlasVerdict, IslandVerdict, certify
from quasiharmonic.atlas.working import flatten, harmonise, injective_map, pack, polish
from quasiharmonic.mesh.seams import Island, SeamedMesh

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
