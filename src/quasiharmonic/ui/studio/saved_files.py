"""The files that a page saves: the model with its map, its image, and what the recorded command and script read."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from quasiharmonic import io
from quasiharmonic.ui.studio.recipes import MAP, START
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.validation import RequestError

#: Formats in which the page saves the map.
FORMATS = "obj", "glb", "ply"


def list_files(state: SessionState, form: str, texture: io.Texture | None) -> dict[str, bytes]:
    """Return the files of a map by name: the model with its map, and its image.

    In OBJ, also those that the command and the script read. RequestError if there is no map.
    """
    if form not in FORMATS:
        raise RequestError(f"unknown format {form[:20]!r}: use {', '.join(FORMATS)}")
    mesh = mapped_model(state, None if form == "ply" else texture)
    files = _write(mesh, MAP if form == "obj" else f"map.{form}")
    if form == "obj":
        recipe = state.recipe
        files |= recipe.texts | ({} if recipe.start is None else _write(recipe.start, START))
    return files


def mapped_model(state: SessionState, texture: io.Texture | None) -> io.MeshData:
    """Return the file's mesh with the map of a state and an image; RequestError if there is no map."""
    if state.mesh.uv is None:
        raise RequestError("there is no map to save yet: press Unwrap or Flatten first")
    mesh = state.sheet.mesh if state.recipe.of_file else state.sheet.mapped_file(state.mesh)
    return mesh if texture is None else replace(mesh, texture=texture)


def write_model(path: Path, mesh: io.MeshData) -> None:
    """Write a mesh in the format of the suffix; without a map as OBJ."""
    if mesh.FT is None:
        io.write_obj(path, mesh)
    else:
        io.write_mapped(path, mesh)


def _write(mesh: io.MeshData, name: str) -> dict[str, bytes]:
    """Return a mesh as a file, with the files that belong to it."""
    with tempfile.TemporaryDirectory() as folder:
        write_model(Path(folder) / name, mesh)
        return {each.name: each.read_bytes() for each in sorted(Path(folder).iterdir())}
