"""Bounds for data from files: decompressed and announced sizes, nested JSON, and names of other files."""

from __future__ import annotations

import base64
import json
import os
import re
import zlib
from contextlib import AbstractContextManager
from contextvars import ContextVar
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.progress import use_value

#: Largest number of bytes that a file may decompress to, or that its header may announce, by default.
MAX_BYTES = 4 << 30
_bound = ContextVar("bound", default=MAX_BYTES)
_CHUNK = 1 << 20
_GZIP = zlib.MAX_WBITS | 16
# The data of an array in a GIFTI file.
_GIFTI_DATA = re.compile(rb"<Data>([^<]*)</Data>")


def use_bound(limit: int | None) -> AbstractContextManager[None]:
    """Use another bound than `MAX_BYTES` in a block, such as a limit of memory; None keeps the current bound."""
    return use_value(_bound, _bound.get() if limit is None else limit)


def check_size(size: int, what: str) -> None:
    """Raise a ValueError if there are more bytes than the bound."""
    if size > _bound.get():
        raise ValueError(f"{what} {size:,} bytes, more than the bound of {_bound.get():,}")


def check_end(end: int, available: int) -> None:
    """Raise a ValueError if data must be read up to a position behind those that are there."""
    if end > available:
        raise ValueError("it ends too early")


def parse_json(text: str | bytes) -> Any:
    """Return the contents of JSON; ValueError if it is invalid or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("JSON is nested too deeply") from error


def unpack_gzip(data: bytes) -> bytes:
    """Decompress the members of a gzip file; ValueError if it is damaged, incomplete or too large."""
    parts, size = [], 0
    while data:
        member = zlib.decompressobj(_GZIP)
        while not member.eof:
            try:
                part = member.decompress(data, _CHUNK)
            except zlib.error as error:
                raise ValueError(str(error)) from error
            if not part and not member.unconsumed_tail and not member.eof:
                raise ValueError("the compressed data end too early")
            parts.append(part)
            size += len(part)
            check_size(size, "it decompresses to at least")
            data = member.unconsumed_tail
        # Zeros may follow a member.
        data = member.unused_data.lstrip(b"\0")
    return b"".join(parts)


def check_gifti(data: bytes) -> None:
    """Raise a ValueError if compressed arrays of a GIFTI file decompress to too many bytes."""
    if b"GZipBase64Binary" not in data or len(data) * 1032 < _bound.get():  # Deflate shrinks data to 1/1032 at best.
        return
    size = 0
    for found in _GIFTI_DATA.finditer(data):
        packed, member = base64.b64decode(found[1]), zlib.decompressobj()
        while packed and not member.eof:
            try:
                size += len(member.decompress(packed, _CHUNK))
            except zlib.error:
                break  # Not compressed, or damaged; the parser decides.
            check_size(size, "its arrays decompress to at least")
            packed = member.unconsumed_tail


def read_npy(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Read an array in NumPy's format .npy; ValueError if it is invalid, has objects, or announces data it lacks."""
    with open(path, "rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
        except (ValueError, EOFError, RecursionError, MemoryError) as error:
            # The first line names the error; further lines address programmers.
            raise ValueError(str(error).partition("\n")[0]) from error
        size = dtype.itemsize
        for side in shape:
            size *= int(side)
        there = os.fstat(file.fileno()).st_size - file.tell()
        if not dtype.hasobject and not 0 <= size <= there:
            raise ValueError(f"the header announces {size:,} bytes of data, but the file has {there:,}")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)


def resolve_beside(folder: Path, uri: str) -> Path:
    """Return the path of a file in a folder or below it, by its relative URI; ValueError for any other file."""
    name = unquote(uri)
    if ":" in name or "\\" in name or name.startswith("/") or ".." in Path(name).parts:
        raise ValueError(f"{ascii(uri)[:80]} is not in the folder of the file")
    return Path(os.path.normpath(folder / name))
