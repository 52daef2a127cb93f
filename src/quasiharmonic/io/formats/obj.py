"""Read and write Wavefront OBJ; writing a mesh that was read changes only its map."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.atomic import no_remains, write_whole
from quasiharmonic.io.formats.gltf.looks import gltf_appearance
from quasiharmonic.io.formats.gltf.reader import CarriedGltf, material_statements
from quasiharmonic.io.formats.objlines import REFUSED, read_obj_lines
from quasiharmonic.io.models.appearance import (
    Role,
    SurfaceMaterial,
    companions,
    materials_lost,
    with_libraries,
    write_material,
)
from quasiharmonic.io.models.meshdata import MeshData, OriginalLines, polygon_mesh
from quasiharmonic.io.models.textures import Texture, texture_of
from quasiharmonic.io.untrusted import as_text, integer_table, number_table, read_bytes

# Kinds of line, for the reader that parses all lines of a kind at once.
_BLANK, _VERTEX, _TEXTURE, _NORMAL, _FACE, _STATEMENT = range(6)
# Lines that this reader would take for statements, but that need the line-by-line reader.
_KEYWORDS = b"|".join([b"v", b"vt", b"vn", b"f", b"l", b"p", *sorted(REFUSED)])
_NOT_PLAIN = re.compile(rb"^(?:[\x01-\x20]|(?:" + _KEYWORDS + rb")\s)", re.MULTILINE)
# References of a corner of each form: 0 vertices, 1 texture coordinates, 2 normals.
_FORMS = {b"1": (0,), b"1/1": (0, 1), b"1//1": (0, 2), b"1/1/1": (0, 1, 2)}
_CHUNK = 100_000
# Number of first bytes in which the line ending is detected.
_DETECTED_BYTES = 4096
# Images that a library can name, and their keywords. Those of metallic-roughness are two images in libraries.
_IMAGE_KEYWORDS: dict[Role, str] = {"colour": "map_Kd", "emission": "map_Ke", "normal": "norm"}


def read_obj(path: str | os.PathLike[str]) -> MeshData:
    """Read a mesh of triangles and other polygons from an OBJ file.

    Vertices, faces and the statements between faces keep their order. Faces may refer to vertices in any form (``a``,
    ``a/b``, ``a//c``, ``a/b/c``, negative). Every ``v`` and ``vt`` must be finite, used or not. Of ``vt`` the first two
    numbers are read. Further numbers after the coordinates of a ``v`` are kept. Normals are kept unparsed, and so is
    every statement that is not geometry: groups, materials, comments and unknown statements. Blank lines and comments
    after data are dropped. A backslash at the end of a line continues it, except in a comment.

    Returns
    -------
    MeshData
        The mesh, numbers correctly rounded to double.

    Raises
    ------
    MeshFileError
        With the line, for a face of fewer than three corners, a polygon with a repeated vertex, an index out of range,
        text that is not a finite number, free-form geometry, and ``l`` or ``p`` elements whose indices are not plain
        (they cannot be kept). Also for a file that has no vertices or no faces, is missing, or is not text.
    """
    data = read_bytes(path)
    text = as_text(path, data)
    mesh = read_regular(path, text) or read_obj_lines(path, text)
    return replace(mesh, newline=b"\r\n") if b"\r\n" in data[:_DETECTED_BYTES] else mesh


def write_obj(path: str | os.PathLike[str], mesh: MeshData, *, durable: bool = True) -> None:
    """Write a mesh as an OBJ file, atomically.

    Numbers are written so that reading them returns the same doubles. The name of a material library (``mtllib``) is
    changed so that the new file refers to the same library. With a texture, two more files are written: a library and
    an image (`quasiharmonic.io.models.appearance.companions`). A mesh that was read from a glTF file gets a library of
    this name, too, and the images of its materials, ``NAME-texture-0.png`` and so on.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    mesh : MeshData
        The mesh. The order is: statements before the first vertex, vertices, texture coordinates, normals, then faces
        with the other statements at their original positions.
    durable : bool
        As in `write_whole`.

    Raises
    ------
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    """
    beside = () if mesh.texture is None else companions(path, mesh.texture)
    mesh, files = make_library(path, mesh)
    with no_remains(*beside, *files):
        for name, data in files.items():
            write_whole(name, data, durable=durable)
        if mesh.texture is not None:
            mesh = write_material(path, mesh, durable=durable)
        mesh = with_libraries(path, mesh)
        pieces = (piece.replace(b"\n", mesh.newline) for piece in _pieces(mesh))
        write_whole(path, lambda file: file.writelines(pieces), durable=durable)


def not_in_obj(mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that an OBJ file will not contain."""
    lost, looks = materials_lost(mesh), list_lost_looks(mesh)
    further = [] if mesh.carried is None else mesh.carried.further()
    if lost or looks is not None:
        further = [what for what in further if what != "materials"]
    return [*lost, *(looks or []), *further]


def read_regular(path: str | os.PathLike[str], data: bytes) -> MeshData | None:
    """Read a file whose lines of one kind all have the same form; return None for other files."""
    lines = data.count(b"\n")
    # Lines shorter than any vertex or face would need too much memory for the size of the file.
    if not lines or 4 * lines > len(data) or (b"\\" in data and b"\\\n" in data):
        return None
    ends, kinds = _classify(data)
    counts = np.bincount(kinds, minlength=6)
    if not (counts[_VERTEX] and counts[_FACE]):
        return None
    statements = _lines_of(_STATEMENT, data, ends, kinds)
    if _NOT_PLAIN.search(statements):
        return None
    positions = _lines_of(_VERTEX, data, ends, kinds)
    rows = number_table(positions, b"v", int(counts[_VERTEX]))
    if rows is None or rows.shape[1] < 3:
        return None
    vt, places = None, b""
    if counts[_TEXTURE]:
        places = _lines_of(_TEXTURE, data, ends, kinds)
        vt = number_table(places, b"vt", int(counts[_TEXTURE]))
        if vt is None or not 2 <= vt.shape[1] <= 3:
            return None
    parts = _regular_faces(_lines_of(_FACE, data, ends, kinds), counts)
    if parts is None:
        return None
    before = np.cumsum(kinds == _FACE)
    before[: int(np.argmax((kinds > _BLANK) & (kinds < _STATEMENT)))] = -1
    flat = {part: indices.ravel() for part, indices in parts.items()}
    return polygon_mesh(
        np.ascontiguousarray(rows[:, :3]),
        flat[0],
        parts[0].shape[1] * np.arange(len(parts[0]) + 1),
        places=flat.get(1),
        normal_lines=flat.get(2),
        vt=None if vt is None else np.ascontiguousarray(vt[:, :2]),
        extra=np.ascontiguousarray(rows[:, 3:]) if rows.shape[1] > 3 else None,
        lines=OriginalLines(positions, rows),
        map_lines=None if vt is None else OriginalLines(places, vt[:, :2]),
        normals=_lines_of(_NORMAL, data, ends, kinds),
        statements=statements,
        statement_faces=before[kinds == _STATEMENT],
        source=os.fspath(path),
    )


def _classify(data: bytes) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """Return the end of every line, newline included, and its kind by its first letters."""
    text = np.frombuffer(data, dtype=np.uint8)
    ends = np.flatnonzero(text == ord("\n")) + 1
    starts = np.concatenate(([0], ends[:-1]))
    # A line may have fewer than three letters; the further ones are then not used.
    first, second, third = (text.take(starts + i, mode="clip") for i in range(3))

    def blank(letter: NDArray[np.uint8]) -> NDArray[np.bool_]:
        return (letter == ord(" ")) | (letter == ord("\t"))

    kinds = np.full(ends.size, _STATEMENT, dtype=np.int8)
    kinds[first == ord("\n")] = _BLANK
    kinds[(first == ord("f")) & blank(second)] = _FACE
    kinds[(first == ord("v")) & blank(second)] = _VERTEX
    kinds[(first == ord("v")) & (second == ord("t")) & blank(third)] = _TEXTURE
    kinds[(first == ord("v")) & (second == ord("n")) & blank(third)] = _NORMAL
    return ends, kinds


def _lines_of(kind: int, data: bytes, ends: NDArray[np.int64], kinds: NDArray[np.int8]) -> bytes:
    """Return all lines of one kind, one after another."""
    member = np.concatenate(([False], kinds == kind, [False]))
    change = np.flatnonzero(member[1:] != member[:-1])
    cuts = np.concatenate(([0], ends))[change].tolist()
    return b"".join([data[start:end] for start, end in zip(cuts[::2], cuts[1::2], strict=True)])


def _regular_faces(block: bytes, counts: NDArray[np.int64]) -> dict[int, NDArray[np.int64]] | None:
    """Return the indices (p, k) of faces with k corners each, by kind of reference (see `_FORMS`)."""
    # The longest regular face has twelve indices, so a part of the line is enough.
    first = re.sub(rb"[0-9]+", b"1", block[: min(block.index(b"\n"), 250)]).split()
    corners = first[1:]
    if len(corners) not in (3, 4) or corners[0] not in _FORMS or len(set(corners)) > 1:
        return None
    table = integer_table(block, b" ".join(first) + b"\n", int(counts[_FACE]))
    if table is None:
        return None
    referred = _FORMS[corners[0]]
    parts = {}
    for column, part in enumerate(referred):
        indices = table[:, column :: len(referred)] - 1
        if indices.min() < 0 or indices.max() >= counts[(_VERTEX, _TEXTURE, _NORMAL)[part]]:
            return None
        parts[part] = indices
    ring = np.sort(parts[0], axis=1)
    # The line-by-line reader reports polygons with a repeated vertex, with their line.
    return None if len(corners) > 3 and (ring[:, 1:] == ring[:, :-1]).any() else parts


def _pieces(mesh: MeshData) -> Iterator[bytes]:
    """Yield the contents of the file to write."""
    at = np.concatenate((mesh.statement_faces, [mesh.faces]))
    statements = mesh.statements.split(b"\n")
    head = int(np.count_nonzero(at < 0))
    yield b"".join(line + b"\n" for line in statements[:head])
    rows = mesh.V if mesh.extra is None else np.hstack([mesh.V, mesh.extra])
    yield from _lines("v", mesh.lines, rows)
    if mesh.vt is not None:
        yield from _lines("vt", mesh.map_lines, mesh.vt)
    yield mesh.normals
    corners = _corner_texts(mesh)
    starts = mesh.rings.starts
    begin = 0
    for end, line in zip(at[head:].tolist(), [*statements[head:-1], b""], strict=True):
        for first in range(begin, end, _CHUNK):
            bounds = starts[first : min(first + _CHUNK, end) + 1]
            sizes = np.diff(bounds).tolist()
            forms = {size: "f" + " %s" * size + "\n" for size in set(sizes)}
            yield ("".join(map(forms.__getitem__, sizes)) % tuple(corners[bounds[0] : bounds[-1]])).encode()
        begin = end
        yield line + b"\n" if line else b""


def _lines(keyword: str, original: OriginalLines | None, rows: NDArray[np.float64]) -> Iterator[bytes]:
    """Yield rows of numbers as text; unchanged rows keep their original lines."""
    same = np.zeros(len(rows), dtype=np.bool_) if original is None else original.find_unchanged(rows)
    if original is None or not same.any():
        yield from _number_lines(keyword, rows)
        return
    texts = original.text.split(b"\n")
    # Yield runs of unchanged and of changed rows.
    ends = [*(np.flatnonzero(same[1:] != same[:-1]) + 1).tolist(), len(rows)]
    begin = 0
    for end in ends:
        if same[begin]:
            yield b"\n".join([*texts[begin:end], b""])
        else:
            yield from _number_lines(keyword, rows[begin:end])
        begin = end


def _number_lines(keyword: str, rows: NDArray[np.float64]) -> Iterator[bytes]:
    if np.isnan(rows).any():
        for row in rows.tolist():
            yield (keyword + "".join(f" {x!r}" for x in row if not math.isnan(x)) + "\n").encode()
        return
    form = keyword + " %r" * rows.shape[1] + "\n"
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        # repr() returns the shortest text that reads back as the same double.
        yield (form * len(part) % tuple(part.ravel().tolist())).encode()


def _corner_texts(mesh: MeshData) -> list[str]:
    """Return the text of every corner of every face, one after another."""
    ring = mesh.rings.corners
    parts = [None if part is None else part.ravel()[ring] for part in (mesh.F, mesh.FT, mesh.FN)]
    F, FT, FN = parts
    assert F is not None
    if FN is None and (FT is None or np.array_equal(F, FT)):
        # All corners at a vertex have the same text, so make it once per vertex.
        texts = [f"{i}" if FT is None else f"{i}/{i}" for i in range(1, len(mesh.V) + 1)]
        return list(map(texts.__getitem__, F.tolist()))
    absent = [-1] * F.size
    columns = [absent if part is None else part.tolist() for part in parts]
    texts = []
    for a, b, c in zip(*columns, strict=True):
        place = str(b + 1) if b >= 0 else ""
        texts.append(f"{a + 1}/{place}/{c + 1}" if c >= 0 else f"{a + 1}/{place}" if place else f"{a + 1}")
    return texts


def make_library(path: str | os.PathLike[str], mesh: MeshData) -> tuple[MeshData, dict[Path, bytes]]:
    """Return a mesh of a glTF file with statements that name a material library, and the files to write beside it.

    Other meshes, and those with a texture of their own, are returned without files. Images other than PNG and JPEG, and
    those of further texture coordinates, are left out.
    """
    carried = _find_carried(mesh)
    if carried is None:
        return mesh, {}
    images, lines = dict[Path, bytes](), []
    library = companions(path, Texture(b"", "", ""))[0]
    named = {name: material for name, material in zip(*_read_materials(carried), strict=True) if name}
    for name, material in named.items():
        lines += [b"newmtl " + name, *(line.encode() for line in _describe(material))]
        for role, keyword in _IMAGE_KEYWORDS.items():
            if (picture := _find_image(material, role)) is None:
                continue
            file = next((known for known, data in images.items() if data == picture.data), None)
            if file is None:
                file = library.with_name(f"{library.stem}-{len(images)}{picture.suffix}")
                images[file] = picture.data
            lines.append(os.fsencode(f"{keyword} {file.name}"))
    if not named:
        return mesh, {}
    head, at = [os.fsencode(f"mtllib {library.name}")], [-1]
    if b"usemtl " not in mesh.statements:
        head, at = [*head, b"usemtl " + next(iter(named))], [-1, 0]
    made = replace(
        mesh,
        statements=b"".join(line + b"\n" for line in head) + mesh.statements,
        statement_faces=np.concatenate([at, mesh.statement_faces]),
    )
    return made, {library: b"".join(line + b"\n" for line in lines), **images}


def list_lost_looks(mesh: MeshData) -> list[str] | None:
    """Return what the library does not have of the materials of a glTF file; None for other meshes."""
    if (carried := _find_carried(mesh)) is None:
        return None
    materials = _read_materials(carried)[1]
    uses = [(role, one, use) for one in materials for role, use in one.textures.items()]
    lost = {role for role, one, _ in uses if role not in _IMAGE_KEYWORDS or _find_image(one, role) is None}
    listed = [f"images of materials for {role.replace('_', '-')}" for role in sorted(lost)]
    # Few readers of libraries know the options of images.
    return listed + ["images that do not repeat"] * any(use.wrap != ("repeat", "repeat") for *_, use in uses)


def _find_carried(mesh: MeshData) -> CarriedGltf | None:
    """Return the glTF file of a mesh that still has its triangles, and no texture of its own."""
    carried = mesh.carried
    fits = mesh.texture is None and isinstance(carried, CarriedGltf) and carried.fits(mesh)
    return carried if fits and isinstance(carried, CarriedGltf) else None


def _read_materials(carried: CarriedGltf) -> tuple[list[bytes], tuple[SurfaceMaterial, ...]]:
    """Return the names of the materials that triangles use, empty for the default one, and these materials."""
    used = dict.fromkeys(part.entry(carried.document).get("material") for part in carried.parts)
    statements = material_statements(carried.document.tree)
    names = [b"" if k is None else statements[k].split(None, 1)[1].strip() for k in used]
    return names, gltf_appearance(carried).materials


def _find_image(material: SurfaceMaterial, role: Role) -> Texture | None:
    """Return an image that a library can name."""
    use = material.textures.get(role)
    return None if use is None or use.channel or use.image.data is None else texture_of(use.image.data)


def _describe(material: SurfaceMaterial) -> list[str]:
    """Return the entries of a library on the factors of a material."""
    red, green, blue, opacity = material.colour
    entries = [f"Kd {red!r} {green!r} {blue!r}", f"Pr {material.roughness!r}", f"Pm {material.metallic!r}"]
    if material.alpha_mode != "OPAQUE":
        entries.append(f"d {opacity!r}")
    if any(material.emission):
        entries.append("Ke " + " ".join(map(repr, material.emission)))
    return entries
