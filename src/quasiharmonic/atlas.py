"""Maps with seams, island by island: the public names of `quasiharmonic.apps.atlas`."""

from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict, IslandVerdict, certify
from quasiharmonic.apps.atlas.island_functions import flatten, harmonise, injective_map, pack, polish
from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas, MappedIsland
from quasiharmonic.apps.atlas.packing.pack import Packing, Placement, pack_charts
from quasiharmonic.io.objects import as_seamed_mesh
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh

__all__ = [
    "AtlasVerdict",
    "Island",
    "IslandVerdict",
    "MappedAtlas",
    "MappedIsland",
    "Packing",
    "Placement",
    "SeamedMesh",
    "as_seamed_mesh",
    "certify",
    "flatten",
    "harmonise",
    "injective_map",
    "pack",
    "pack_charts",
    "polish",
]
