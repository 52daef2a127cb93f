"""Gmsh's MSH files, versions 2 and 4, text and binary: nodes, elements, and data of nodes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import groupby
from typing import TypeAlias

import numpy as np

from quasiharmonic.geometry.mesh.elements import join_elements, join_solids
from quasiharmonic.io.fem.mesh_parts import SUPPORTED, MeshParts
from quasiharmonic.io.fem.number_tables import Table, TableReader, replace_numbers, stack_tables
from quasiharmonic.io.untrusted import check_end
from quasiharmonic.util.arrays import FloatArray, IntArray

# Number of nodes of each kind of element that is read, and of the kinds that are skipped: lines and points.
_ELEMENTS = {2: 3, 3: 4, 9: 6}
_POINTS_AND_LINES = {1: 2, 8: 3, 15: 1, 26: 4, 27: 5, 28: 6}
# The same for meshes in space, which may have elements of lower dimension on their boundary.
_SOLIDS = {4: 4, 5: 8}
_SURFACES = {**_ELEMENTS, 10: 9, 16: 8, 20: 9, 21: 10, 22: 12, 23: 15, 36: 16, 37: 25}
# Dimension of each kind of element.
_DIMENSIONS = {
    15: 0,
    **dict.fromkeys((1, 8, 26, 27, 28), 1),
    **dict.fromkeys(_SURFACES, 2),
    **dict.fromkeys(_SOLIDS, 3),
}
_GROUP_KINDS = "point", "curve", "surface", "volume"
# Sections of the entities of version 4. In a mesh that was partitioned, elements belong to those of the second.
_ENTITIES = b"Entities", b"PartitionedEntities"
# Elements of a kind: the kind, the physical group (version 2) or entity (version 4) of each, and the tags of the nodes.
_Block: TypeAlias = tuple[int, IntArray, IntArray]
_NAMES = {
    4: "tetrahedron",
    5: "hexahedron",
    6: "prism",
    7: "pyramid",
    10: "second-order quadrangle",
    11: "second-order tetrahedron",
    12: "second-order hexahedron",
    16: "second-order quadrangle",
    20: "third-order triangle",
    21: "third-order triangle",
    22: "fourth-order triangle",
    23: "fourth-order triangle",
    36: "third-order quadrangle",
    37: "fourth-order quadrangle",
}


def read_gmsh(data: bytes, solid: bool = False) -> MeshParts:
    """Parse an MSH file, with its tetrahedra and hexahedra if ``solid``.

    ValueError if the file is not MSH of version 2 or 4, ends early, or has other elements than points, lines, triangles
    of three or six nodes and quadrilaterals of four.
    """
    version, order, position = _format(data)
    nodes: list[tuple[IntArray, Table]] = []
    elements: list[IntArray] = []
    blocks: list[_Block] = []
    spans = {}
    later: dict[str, list[tuple[int, int]]] = {}
    for name, begin, end in _sections(data, position):
        if name == b"Nodes":
            nodes.append(_nodes(data, begin, end, version, order))
        elif name == b"ParametricNodes":
            raise ValueError("nodes with parameters are not supported in version 2: save it as 4.1, or without them")
        elif name == b"Elements":
            blocks = list(_blocks(data, begin, end, version, order, solid))
            found = [nodes for kind, _, nodes in blocks if kind in (_SOLIDS if solid else _ELEMENTS)]
            elements.append((join_solids if solid else join_elements)(found))
        elif name in (b"PhysicalNames", *_ENTITIES):
            spans[name] = begin, end
        elif name == b"NodeData":
            title = TableReader(data, begin, end, "<")
            if int(title.read_words()[0]) > 0:
                later.setdefault(_decode_name(title.read_line()), []).append((begin, end))
    if not (nodes and elements):
        raise ValueError(f"there is no section ${'Elements' if nodes else 'Nodes'}")
    tags, numbers = nodes[0][0], elements[0]
    # Gmsh writes the same mesh again with every view that it appends.
    if not (
        all(np.array_equal(t, tags) and np.array_equal(p.values, nodes[0][1].values) for t, p in nodes[1:])
        and all(np.array_equal(other, numbers) for other in elements[1:])
    ):
        raise ValueError("it has several meshes: save each in a separate file")
    place = stack_tables([table for _, table in nodes], 3)
    known = np.argsort(tags, kind="stable")
    at = np.searchsorted(tags, numbers, sorter=known).clip(max=max(len(tags) - 1, 0))
    F = known[at] if len(tags) else numbers
    wrong = numbers[tags[F] != numbers] if len(tags) else numbers.ravel()
    if wrong.size:
        raise ValueError(f"an element refers to node {wrong[0]}, which does not exist")
    if version == "2":
        # Version 2 repeats an element for each of its physical groups.
        F = F[np.sort(np.unique(np.sort(F, axis=1), axis=0, return_index=True)[1])]
    # Use the last time step.
    fields = {
        title: partial(_node_data, data, *values[-1], order, tags[known], known) for title, values in later.items()
    }
    return MeshParts(
        nodes[0][1].values.astype(np.float64),
        F.astype(np.int64),
        np.dtype(np.float64),
        fields,
        lambda points: replace_numbers(data, place, np.tile(points, (len(nodes), 1))),
        lambda: _find_sets(data, spans, version, order, blocks, (tags[known], known)),
    )


def _format(data: bytes) -> tuple[str, str | None, int]:
    """Return the version ("2", "4.0" or "4.1"), the byte order (None for text), and the end of the section."""
    begin = data.find(b"$MeshFormat")
    reader = TableReader(data, max(begin, 0), len(data), "<")
    reader.read_line()
    words = reader.read_words()
    if begin < 0 or len(words) != 3:
        raise ValueError("it does not start like an MSH file of version 2 or 4")
    version = words[0].decode("ascii", "replace")
    version = "2" if version.split(".")[0] == "2" else "4.0" if version == "4" else version
    if version not in ("2", "4.0", "4.1"):
        raise ValueError(f"version {version} is not supported: save it as 2.2 or 4.1")
    if words[2] != b"8":
        raise ValueError(f"numbers of {words[2].decode('ascii', 'replace')} bytes are not supported: save it with 8")
    order: str | None = None
    if words[1] == b"1":
        one = data[reader.position : reader.position + 4]
        order = "<" if one == b"\x01\0\0\0" else ">"
    end = data.find(b"$EndMeshFormat", reader.position)
    if end < 0:
        raise ValueError("it ends too early")
    return version, order, end + len(b"$EndMeshFormat")


def _sections(data: bytes, position: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield the name, the start and the end of each section."""
    while (position := data.find(b"$", position)) >= 0:
        stop = data.find(b"\n", position)
        name = data[position + 1 : stop].strip()
        end = data.find(b"$End" + name, stop)
        if stop < 0 or end < 0:
            raise ValueError(f"the section ${name.decode('ascii', 'replace')} does not end")
        yield name, stop + 1, end
        position = end + 4 + len(name)


def _nodes(data: bytes, begin: int, end: int, version: str, order: str | None) -> tuple[IntArray, Table]:
    """Return the tags of nodes and the table of their positions."""
    if version == "2":
        head = TableReader(data, begin, end, "<")
        count = int(head.read_words()[0])
        tags, place = TableReader(data, head.position, end, order).read_tables(count, ("i4", 1), ("f8", 3))
        return tags.values[:, 0].astype(np.int64), place
    reader = TableReader(data, begin, end, order)
    blocks = int(reader.read_numbers("u8", 2 if version == "4.0" else 4)[0])
    numbers, values = [np.empty(0, dtype=np.int64)], []
    for _ in range(blocks):
        first, second, parametric = reader.read_numbers("i4", 3).tolist()
        count = int(reader.read_numbers("u8", 1)[0])
        # The parameters of a node on its curve or surface may follow its position.
        width = 3 + (parametric and (first if version == "4.1" else second))
        if version == "4.1":
            numbers.append(reader.read_numbers("u8", count).astype(np.int64))
            values += reader.read_tables(count, ("f8", width))
        else:
            tags, place = reader.read_tables(count, ("i4", 1), ("f8", width))
            numbers.append(tags.values[:, 0].astype(np.int64))
            values.append(place)
    if not values:
        raise ValueError("there are no nodes")
    return np.concatenate(numbers), stack_tables(values, 3)


def _blocks(data: bytes, begin: int, end: int, version: str, order: str | None, solid: bool) -> Iterator[_Block]:
    """Yield the blocks of elements, of all kinds."""
    if version == "2":
        head = TableReader(data, begin, end, "<")
        count = int(head.read_words()[0])
        if order is None:
            yield from _element_lines(list(map(int, data[head.position : end].split())), count, solid)
            return
        reader = TableReader(data, head.position, end, order)
    else:
        reader = TableReader(data, begin, end, order)
        count = int(reader.read_numbers("u8", 2 if version == "4.0" else 4)[0])
    while count > 0:
        # In version 2, tags of the element follow its number; it counts the elements, version 4 their blocks.
        if version == "2":
            kind, size, tags = reader.read_numbers("i4", 3).tolist()
            group = 0
        else:
            first, second, kind = reader.read_numbers("i4", 3).tolist()
            group = second if version == "4.1" else first
            size, tags = int(reader.read_numbers("u8", 1)[0]), 0
        nodes = _nodes_of(kind, solid)
        table = reader.read_tables(size, ("u8" if version == "4.1" else "i4", 1 + tags + nodes))[0].values
        groups = table[:, 1] if tags else np.full(len(table), group)
        yield kind, groups.astype(np.int64), table[:, 1 + tags :].astype(np.int64)
        count -= max(size, 1) if version == "2" else 1


def _element_lines(numbers: list[int], count: int, solid: bool) -> Iterator[_Block]:
    """Yield the elements of lines "number kind tags … nodes …" of version 2."""
    found: list[tuple[int, int, list[int]]] = []
    at = 0
    for _ in range(count):
        check_end(at + 3, len(numbers))
        kind, stop = numbers[at + 1], at + 3 + numbers[at + 2] + _nodes_of(numbers[at + 1], solid)
        group = numbers[at + 3] if numbers[at + 2] else 0
        found.append((kind, group, numbers[stop - _nodes_of(kind, solid) : stop]))
        at = stop
    check_end(at, len(numbers))
    for kind, rows in groupby(found, lambda one: one[0]):
        _, groups, nodes = zip(*rows, strict=True)
        yield kind, np.array(groups, dtype=np.int64), np.array(nodes, dtype=np.int64)


def _decode_name(quoted: bytes) -> str:
    """Return a name without its quotes; it may itself contain quotes."""
    return quoted.removeprefix(b'"').removesuffix(b'"').decode("utf-8", "replace")


def _find_sets(
    data: bytes,
    spans: dict[bytes, tuple[int, int]],
    version: str,
    order: str | None,
    blocks: list[_Block],
    tags: tuple[IntArray, IntArray],
) -> dict[str, IntArray]:
    """Return the nodes of the physical groups by dimension and name, or number without a name.

    ``tags`` are the sorted tags of the nodes, and the nodes in this order.
    """
    names = {}
    if b"PhysicalNames" in spans:
        for line in data[slice(*spans[b"PhysicalNames"])].split(b"\n")[1:]:
            words = line.strip().split(None, 2)
            if len(words) == 3:
                names[int(words[0]), int(words[1])] = _decode_name(words[2])
    groups: dict[tuple[int, int], list[int]] | None = None
    if version != "2":
        groups = {}
        for section in _ENTITIES:
            if section in spans:
                groups |= _groups_of_entities(data, spans[section], version, order, section != _ENTITIES[0])
    found: dict[str, list[IntArray]] = {}
    for kind, numbers, nodes in blocks:
        dimension = _DIMENSIONS[kind]
        for number in np.unique(numbers).tolist():
            own = nodes[numbers == number].ravel()
            where = tags[1][np.searchsorted(tags[0], own).clip(max=len(tags[0]) - 1)]
            for group in ([number] * (number != 0)) if groups is None else groups.get((dimension, number), ()):
                # The sign of a group in version 4 is the orientation of its elements.
                name = names.get((dimension, abs(group)), str(abs(group)))
                found.setdefault(f"{_GROUP_KINDS[dimension]}:{name}", []).append(where)
    return {name: np.unique(np.concatenate(parts)) for name, parts in found.items()}


def _groups_of_entities(
    data: bytes, span: tuple[int, int], version: str, order: str | None, partitioned: bool
) -> dict[tuple[int, int], list[int]]:
    """Return the physical groups of the entities of version 4, by their dimensions and tags."""
    reader, groups = TableReader(data, *span, order), {}
    if partitioned:
        _, ghosts = reader.read_numbers("u8", 2).tolist()
        reader.skip_numbers("i4", 2 * ghosts)
    for dimension, count in enumerate(reader.read_numbers("u8", 4).tolist()):
        for _ in range(count):
            tag = int(reader.read_numbers("i4", 1)[0])
            if partitioned:
                # Skip the entity that was divided, and the partitions.
                reader.skip_numbers("i4", 2)
                reader.skip_numbers("i4", int(reader.read_numbers("u8", 1)[0]))
            reader.skip_numbers("f8", 3 if version == "4.1" and dimension == 0 else 6)
            groups[dimension, tag] = reader.read_numbers("i4", int(reader.read_numbers("u8", 1)[0])).tolist()
            if dimension:
                reader.skip_numbers("i4", int(reader.read_numbers("u8", 1)[0]))
    return groups


def _nodes_of(kind: int, solid: bool) -> int:
    known = {**_POINTS_AND_LINES, **(_SOLIDS | _SURFACES if solid else _ELEMENTS)}
    if kind not in known:
        name = _NAMES.get(kind, f"number {kind}")
        raise ValueError(f"cells of type {name} are not supported: use {SUPPORTED[solid]}")
    return known[kind]


def _node_data(data: bytes, begin: int, end: int, order: str | None, tags: IntArray, which: IntArray) -> FloatArray:
    """Return values at every node, NaN at nodes without value; (n, k)."""
    head = TableReader(data, begin, end, "<")
    for _ in range(2):  # Skip the names, then the real numbers.
        for _ in range(int(head.read_words()[0])):
            head.read_line()
    integers = [int(head.read_words()[0]) for _ in range(int(head.read_words()[0]))]
    _, components, count = integers[:3]
    table, values = TableReader(data, head.position, end, order).read_tables(count, ("i4", 1), ("f8", components))
    result = np.full((len(tags), components), np.nan)
    node = table.values[:, 0].astype(np.int64)
    at = np.searchsorted(tags, node).clip(max=len(tags) - 1)
    known = tags[at] == node
    result[which[at[known]]] = values.values[known]
    return result
