"""Every format that meshes and their maps are read and written in goes through the same trials."""

from __future__ import annotations

import pytest

from quasiharmonic import io
from shared.formats import try_format, with_map


def test_what_is_written_is_read():
    # STL has no room for a map.
    assert set(io.READERS) - set(io.MAP_WRITERS) == {".stl"}
    assert set(io.MAP_WRITERS) < set(io.READERS)
    assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in io.READERS)


@pytest.mark.parametrize("suffix", io.MAP_WRITERS)
def test_format(suffix, tmp_path):
    try_format(io.READERS[suffix], with_map(io.MAP_WRITERS[suffix]), tmp_path / f"mesh{suffix}")


@pytest.mark.parametrize("suffix", io.MAP_WRITERS)
def test_suffix_chooses_the_format(suffix, tmp_path):
    try_format(io.read_mesh, io.write_map, tmp_path / f"mesh{suffix.upper()}")
