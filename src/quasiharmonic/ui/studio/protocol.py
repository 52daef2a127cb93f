"""Messages between a page and what computes for it: a header in JSON, and arrays behind it, in one buffer.

The same both ways, whatever carries it, a socket or a notebook's widget; ``static/frames.js`` is the other end::

    bytes 0-3   length H of the header, unsigned, little-endian (as all numbers are)
    then        H bytes of JSON in UTF-8, with spaces at its end so that what follows begins at a multiple of 8
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

#: What a type is called in a header.
TYPES = {"u1": "<u1", "u4": "<u4", "i4": "<i4", "f4": "<f4", "f8": "<f8"}
_NAMES = {np.dtype(kind): name for name, kind in TYPES.items()}
# Of a header: a page's has a few words, and it is parsed before anything is known of it.
_LONGEST = 1 << 20


class ProtocolError(ValueError):
    """A message is not what messages are."""


class Frame(NamedTuple):
    """A message.

    Attributes
    ----------
    header : dict
        Plain JSON; ``kind`` says what it is to the page, ``do`` what the page asks for.
    arrays : dict of str to array
        By name; read only in what has been decoded.
    """

    header: dict[str, Any]
    arrays: dict[str, Array]


def encode(header: Mapping[str, Any], arrays: Mapping[str, Array] | None = None) -> bytes:
    """Make a buffer of a header and arrays of the types in `TYPES`.

    Raises
    ------
    KeyError
        When an array has another type.
    """
    described, parts, offset = {}, [], 0
    for name, array in (arrays or {}).items():
        whole = np.ascontiguousarray(array)
        described[name] = [_NAMES[whole.dtype], list(whole.shape), offset]
        parts.append(whole.tobytes())
        parts.append(bytes(-whole.nbytes % 8))
        offset += whole.nbytes + -whole.nbytes % 8
    text = json.dumps({**header, "arrays": described}, allow_nan=False).encode()
    text += b" " * (-(4 + len(text)) % 8)
    return b"".join([len(text).to_bytes(4, "little"), text, *parts])


def decode(data: bytes) -> Frame:
    """Read a buffer.

    Raises
    ------
    ProtocolError
        When it is not what `encode` makes: nothing in it is taken on trust.
    """
    length = int.from_bytes(data[:4], "little")
    if len(data) < 4 or length > min(_LONGEST, len(data) - 4):
        raise ProtocolError("a message is shorter than it says")
    try:
        header = json.loads(data[4 : 4 + length])
        if not isinstance(header, dict):
            raise ProtocolError("a message has no header")
        arrays = {str(name): _array(data, 4 + length, *about) for name, about in header.pop("arrays", {}).items()}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ProtocolError(f"a message cannot be read: {error}") from None
    return Frame(header, arrays)


def _array(data: bytes, start: int, kind: str, shape: list[int], offset: int) -> Array:
    if kind not in TYPES or not all(isinstance(extent, int) and extent >= 0 for extent in [*shape, offset]):
        raise ProtocolError("an array is described as none can be")
    dtype = np.dtype(TYPES[kind])
    count = math.prod(shape)
    if start + offset + count * dtype.itemsize > len(data):
        raise ProtocolError("an array is shorter than it says")
    return np.frombuffer(data, dtype, count, start + offset).reshape(shape)
