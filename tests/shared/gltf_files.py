"""glTF files built by hand, with the features that exporters use."""

from __future__ import annotations

import base64
import json

import numpy as np

CODES = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126, "i1": 5120}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype="f4")
HALVES = np.array([[0, 1, 2], [0, 2, 3]], dtype="u2")


class Gltf:
    """A glTF document under construction: add accessors first, then meshes that use them."""

    def __init__(self):
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": []}
        self.buffer = b""

    def view(self, data, **more):
        self.buffer += b"\0" * (-len(self.buffer) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(data)} | more)
        self.buffer += data
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, table, **more):
        table = np.asarray(table)
        table = table.reshape(len(table), -1)
        accessor = {
            "bufferView": self.view(table.astype(table.dtype.newbyteorder("<")).tobytes()),
            "componentType": CODES[table.dtype.str[1:]],
            "count": len(table),
            "type": SHAPES[table.shape[1]],
        }
        self.tree["accessors"].append(accessor | more)
        return len(self.tree["accessors"]) - 1

    def mesh(self, *primitives, **more):
        self.tree["meshes"].append({"primitives": list(primitives)} | more)
        return len(self.tree["meshes"]) - 1

    def glb(self):
        self.tree["buffers"] = [{"byteLength": len(self.buffer)}]
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        body = self.buffer + b"\0" * (-len(self.buffer) % 4)
        parts = [(b"JSON", text), (b"BIN\0", body)]
        chunks = b"".join(len(data).to_bytes(4, "little") + name + data for name, data in parts)
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks

    def gltf(self, uri=None):
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.buffer).decode()
        self.tree["buffers"] = [{"byteLength": len(self.buffer), "uri": uri}]
        return json.dumps(self.tree).encode()


def square(**attributes):
    """A document with a square of two triangles and further attributes."""
    made = Gltf()
    given = {"POSITION": SQUARE} | attributes
    accessors = {name: made.accessor(table) for name, table in given.items()}
    made.mesh({"attributes": accessors, "indices": made.accessor(HALVES.ravel())})
    return made


def touching_squares():
    """A document with two meshes: squares with a common side."""
    made = Gltf()
    for x in range(2):
        at = made.accessor(SQUARE + np.float32([x, 0, 0]))
        made.mesh({"attributes": {"POSITION": at}, "indices": made.accessor(HALVES.ravel())})
    return made


def opened(data):
    """The JSON and the buffer of a binary glTF file."""
    size = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def numbers(data, index):
    """The array of an accessor of a binary glTF file, without sparse data or strides."""
    tree, buffer = opened(data)
    accessor = tree["accessors"][index]
    view = tree["bufferViews"][accessor["bufferView"]]
    kind = {code: kind for kind, code in CODES.items()}[accessor["componentType"]]
    width = {shape: width for width, shape in SHAPES.items()}[accessor["type"]]
    begin = view["byteOffset"] + accessor.get("byteOffset", 0)
    return np.frombuffer(buffer, "<" + kind, accessor["count"] * width, begin).reshape(-1, width)
