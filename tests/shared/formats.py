"""Tests for every mesh format: a round trip preserves maps, and a reader rejects invalid files with a message."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import certify
from quasiharmonic.io import MeshData, MeshFileError, find_format, map_of, write_map
from quasiharmonic.surfaces import disk

GARBAGE = b"", b"\0" * 64, b"no mesh\n", b"PK\x03\x04" + b"\xff" * 60, bytes(range(256)) * 4

SINGLE = ".glb", ".gltf", ".gii", ".surf", ".patch.3d"


def maps():
    """A planar mesh, and two maps that differ from its positions: one injective, the other with inverted triangles."""
    V, F = disk(4)
    uv = V * (1 + 0.3 * V[:, :1]) / 3
    inverted = uv.copy()
    inner = int(np.argmin((V**2).sum(axis=1)))
    inverted[inner] = uv[F[(inner == F).any(axis=1)]].max(axis=(0, 1)) + 1
    return MeshData(V, F), [uv, inverted]


def single(uv, suffix):
    """A map after a round trip: coordinates are rounded to single precision, and glTF stores v downwards."""
    if suffix not in (".glb", ".gltf"):
        return uv.astype(np.float32).astype(np.float64)
    down = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).astype(np.float32).astype(np.float64)
    return np.stack([down[:, 0], 1 - down[:, 1]], axis=1)


def with_map(write):
    """Wrap a writer of a mesh with its map as a writer that takes both."""
    return lambda path, mesh, uv: write(path, mesh.with_map(uv))


def try_format(read, write, path):
    """Test a reader and a writer of maps at a path with their suffix: round trips, bad maps and damaged files."""
    mesh, uvs = maps()
    if find_format(path).suffix == ".patch.3d":
        # Its triangles are those of a surface beside it.
        write_map(path.with_name("mesh.surf"), mesh, mesh.V[:, :2])
    for uv in uvs:
        write(path, mesh, uv)
        again = read(path)
        suffix = find_format(path).suffix
        kept = single(uv, suffix) if suffix in SINGLE else uv
        np.testing.assert_array_equal(again.F, mesh.F)
        np.testing.assert_array_equal(map_of(again).view(np.int64), kept.view(np.int64))
        expected, found = certify(mesh.F, kept), certify(again.F, map_of(again))
        np.testing.assert_array_equal(found.inverted, expected.inverted)
    assert expected.inverted.size
    assert not certify(mesh.F, uvs[0]).inverted.size

    whole = path.read_bytes()
    for bad in (uv[:-1], np.full_like(uv, np.nan)):
        with pytest.raises(ValueError, match="uv"):
            write(path, mesh, bad)
        assert path.read_bytes() == whole

    for garbage in (*GARBAGE, whole[: len(whole) // 2]):
        path.write_bytes(garbage)
        with pytest.raises(MeshFileError, match=path.name):
            read(path)
    for cut in range(0, len(whole), max(len(whole) // 25, 1)):
        path.write_bytes(whole[:cut] + b"\xff" + whole[cut + 1 :])
        try:
            read(path)
        except MeshFileError as error:
            str(error).encode()
    path.unlink()
    for make in (lambda: None, path.mkdir):
        make()
        with pytest.raises(MeshFileError, match=path.name):
            read(path)
