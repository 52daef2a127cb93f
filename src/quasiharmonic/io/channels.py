"""Several texture coordinates of one mesh: read a channel of a file, and write a map into a channel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.formats.gltf.reader import CarriedGltf, read_channel
from quasiharmonic.io.formats.ply import CarriedPly, read_second_places
from quasiharmonic.io.models.meshdata import MeshData, with_corner_map
from quasiharmonic.util.arrays import check_integer, names_of


def select_channel(mesh: MeshData, channel: int) -> MeshData:
    """Return a mesh that was read from a file with the texture coordinates of another channel as its map.

    Channel k is ``TEXCOORD_k`` in glTF files. In PLY files, channel 1 is ``texcoord1`` of the faces. Written to a file,
    the map is in this channel again.

    Raises
    ------
    MeshFileError
        If the file does not have this channel.
    """
    check_integer("channel", channel, minimum=0)
    return place_map(_find_channel(mesh, channel), mesh, channel)


def place_map(mapped: MeshData, mesh: MeshData, channel: int) -> MeshData:
    """Return a mesh with a map that is to be written into a channel, and the channels below from a mesh of a file.

    ``mapped`` has the triangles of ``mesh``. Triangles without coordinates in a channel below get those of the map.
    MeshFileError if the map does not cover them either, or the file does not have a channel below.
    """
    below = tuple(_find_channel(mesh, k).corner_uv.copy() for k in range(channel))
    for k, corners in enumerate(below):
        bare = np.flatnonzero(np.isnan(corners).any(axis=(1, 2)))
        corners[bare] = mapped.corner_uv[bare]
        bare = bare[np.isnan(corners[bare]).any(axis=(1, 2))]
        if bare.size:
            raise MeshFileError(
                mesh.source,
                f"has no texture coordinates {k} in {names_of('triangle', 'triangles', bare)} (0-based), but channel "
                f"{channel} requires those below it",
                remedy=f"write channel {k} first",
            )
    return replace(mapped, lower_maps=below)


def _find_channel(mesh: MeshData, channel: int) -> MeshData:
    """Return the mesh with a channel as its map."""
    if channel == len(mesh.lower_maps):
        return mesh
    carried, corners = mesh.carried, None
    if channel < len(mesh.lower_maps):
        corners = mesh.lower_maps[channel]
    elif isinstance(carried, CarriedGltf):
        corners = read_channel(carried, channel)
    elif isinstance(carried, CarriedPly) and channel == 1:
        corners = read_second_places(mesh, carried)
    if corners is None:
        raise MeshFileError(
            mesh.source, f"has no texture coordinates {channel}", remedy="give a channel of the file; the first is 0"
        )
    return with_corner_map(mesh, corners)
