"""MFEM's mesh files (``MFEM mesh v1.0``, ``v1.2`` and ``v1.3``): text, with straight elements."""

from __future__ import annotations

import re
from functools import partial

import numpy as np

from quasiharmonic.io.fem.mesh_parts import MeshParts, select_elements
from quasiharmonic.io.fem.number_tables import TableReader, replace_numbers
from quasiharmonic.io.untrusted import check_end
from quasiharmonic.util.arrays import FloatArray, IntArray

_SECTION = re.compile(rb"^[ \t]*([a-z_]+)[ \t\r]*$", re.MULTILINE)
# Sections of named sets, without their ending, and those with the elements that they refer to.
_SETS = {b"bdr_attribute": b"boundary", b"attribute": b"elements"}
_SET = re.compile(rb'"([^"]*)"\s+\d+((?:\s+\d+)*)')
# Number of vertices, and VTK's kind, of MFEM's geometries: point, segment, triangle, square, tetrahedron, cube, prism,
# pyramid.
_SIZES = 1, 2, 3, 4, 4, 8, 6, 5
_KINDS = 1, 3, 5, 9, 10, 12, 13, 14


def read_mfem(data: bytes, solid: bool = False) -> MeshParts:
    """Parse an MFEM mesh file, with its tetrahedra and hexahedra if ``solid``.

    ValueError if the file is not an MFEM mesh file or ends early, or the mesh is not conforming or has curved elements
    (``nodes``).
    """
    head = data[:200].lstrip().split(b"\n", 1)[0].strip()
    if not re.fullmatch(rb"MFEM mesh v1\.[023]", head):
        raise ValueError("it does not start with MFEM mesh v1.0, v1.2 or v1.3")
    # Comments become blanks, so that every number keeps its place.
    plain = re.sub(rb"#[^\n]*", lambda found: b" " * len(found[0]), data)
    sections = {found[1]: found.end() for found in _SECTION.finditer(plain)}
    if b"nodes" in sections:
        raise ValueError("it has curved elements (nodes): save it as a mesh of straight elements")
    for name in b"elements", b"vertices":
        if name not in sections:
            raise ValueError(f"it has no section {name.decode()}")
    begins = sorted(sections.values())

    def span(name: bytes) -> tuple[int, int]:
        begin = sections[name]
        later = [plain.rfind(b"\n", 0, other) + 1 for other in begins if other > begin]
        return begin, later[0] if later else len(plain)

    vertices = TableReader(plain, *span(b"vertices"), None)
    count, axes = vertices.read_numbers("i8", 2).tolist()
    if axes not in (2, 3):
        raise ValueError(f"its vertices have {axes} coordinates, not two or three")
    table = vertices.read_tables(count, ("f8", axes))[0]
    points = np.zeros((count, 3))
    points[:, :axes] = table.values
    begin, end = span(b"elements")
    F = select_elements(*_cells([int(word) for word in plain[begin:end].split()]), count, solid)
    cells = {name: plain[slice(*span(name))] for name in (b"boundary", b"elements") if name in sections}
    named = {name: plain[slice(*span(name + b"_sets"))] for name in _SETS if name + b"_sets" in sections}

    def replace_points(new: FloatArray) -> bytes:
        return replace_numbers(data, table, new[:, :axes])

    return MeshParts(points, F, np.dtype(np.float64), {}, replace_points, partial(_find_sets, cells, named))


def _cells(numbers: list[int]) -> tuple[IntArray, IntArray, IntArray]:
    """Return the vertices of all cells, where each cell begins, and VTK's kinds.

    The numbers are the count of cells, then for each its attribute, its geometry, and its corners.
    """
    connectivity: list[int] = []
    starts, kinds, at = [0], [], 1
    for _ in range(numbers[0]):
        geometry = numbers[at + 1]
        if not 0 <= geometry < len(_SIZES):
            raise ValueError(f"an element has the unknown geometry {geometry}")
        size = _SIZES[geometry]
        corners = numbers[at + 2 : at + 2 + size]
        check_end(size, len(corners))
        connectivity += corners
        starts.append(len(connectivity))
        kinds.append(_KINDS[geometry])
        at += 2 + size
    return np.array(connectivity, dtype=np.int64), np.array(starts), np.array(kinds, dtype=np.int64)


def _find_sets(cells: dict[bytes, bytes], named: dict[bytes, bytes]) -> dict[str, IntArray]:
    """Return the vertices of the named sets of attributes, and of the attributes of the boundary, by number."""
    of: dict[bytes, list[tuple[int, IntArray]]] = {}
    for name, text in cells.items():
        numbers = [int(word) for word in text.split()]
        connectivity, starts, kinds = _cells(numbers)
        # Before the corners of a cell are its attribute and its geometry.
        attributes = [numbers[1 + 2 * k + int(start)] for k, start in enumerate(starts[:-1])]
        of[name] = list(zip(attributes, np.split(connectivity, starts[1:-1]), strict=True)) if len(kinds) else []

    def gather(name: bytes, wanted: set[int]) -> IntArray:
        parts = [corners for attribute, corners in of.get(name, ()) if attribute in wanted]
        return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *parts]))

    numbered = sorted({one for one, _ in of.get(b"boundary", ())})
    sets = {f"boundary:{one}": gather(b"boundary", {one}) for one in numbered}
    for kind, text in named.items():
        of_kind = _SETS[kind]
        for name, members in _SET.findall(text):
            full = f"{of_kind.decode()}:{name.decode('utf-8', 'replace')}"
            sets[full] = gather(of_kind, set(map(int, members.split())))
    return sets
