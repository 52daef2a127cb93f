"""Messages between a page and its worker: a JSON header followed by arrays, in one buffer.

The format is the same in both directions and for sockets and notebook widgets. ``static/frames.js`` implements the
other end::

    bytes 0-3   length H of the header, unsigned, little-endian (as all numbers are)
    then        H bytes of JSON in UTF-8, padded with spaces so that the arrays begin at a multiple of 8
    then        the arrays, each at a multiple of 8 from there: header["arrays"] = {name: [type, shape, offset]}
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

#: NumPy types by their names in a header.
TYPES = {"u1": "<u1", "u4": "<u4", "i4": "<i4", "f4": "<f4", "f8": "<f8"}
_NAMES = {np.dtype(kind): name for name, kind in TYPES.items()}
# Maximum length of a header. It is parsed before any other check, and valid headers are short.
_LONGEST = 1 << 20


class ProtocolError(ValueError):
    """A message is malformed."""


class MessageFrame(NamedTuple):
    """A message: its header and its arrays."""

    # Plain JSON; ``kind`` is the type of a message to the page, ``do`` the command of a message from the page
    header: dict[str, Any]
    arrays: dict[str, Array]  # Arrays by name; read-only in a decoded message


def encode(header: Mapping[str, Any], arrays: Mapping[str, Array] | None = None) -> bytes:
    """Return the buffer of a header and arrays of the types in `TYPES`; KeyError for another type."""
    described, parts, offset = {}, [], 0
    for name, array in (arrays or {}).items():
        contiguous = np.ascontiguousarray(array)
        described[name] = [_NAMES[contiguous.dtype], list(contiguous.shape), offset]
        parts.append(contiguous.tobytes())
        parts.append(bytes(-contiguous.nbytes % 8))
        offset += contiguous.nbytes + -contiguous.nbytes % 8
    text = json.dumps({**header, "arrays": described}, allow_nan=False).encode()
    text += b" " * (-(4 + len(text)) % 8)
    return b"".join([len(text).to_bytes(4, "little"), text, *parts])


def decode(data: bytes) -> MessageFrame:
    """Decode a buffer from an untrusted source; ProtocolError if it is malformed."""
    length = int.from_bytes(data[:4], "little")
    if len(data) < 4 or length > min(_LONGEST, len(data) - 4):
        raise ProtocolError("a message is shorter than its header says")
    try:
        header = json.loads(data[4 : 4 + length])
        if not isinstance(header, dict):
            raise ProtocolError("a message has no header")
        arrays = {str(name): _array(data, 4 + length, *about) for name, about in header.pop("arrays", {}).items()}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ProtocolError(f"a message cannot be read: {error}") from None
    return MessageFrame(header, arrays)


def _array(data: bytes, start: int, kind: str, shape: list[int], offset: int) -> Array:
    if kind not in TYPES or not all(isinstance(extent, int) and extent >= 0 for extent in [*shape, offset]):
        raise ProtocolError("the description of an array is invalid")
    dtype = np.dtype(TYPES[kind])
    count = math.prod(shape)
    if start + offset + count * dtype.itemsize > len(data):
        raise ProtocolError("an array is shorter than its description")
    return np.frombuffer(data, dtype, count, start + offset).reshape(shape)
