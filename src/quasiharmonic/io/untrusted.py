"""Read untrusted files: text and numbers, within bounds for decompressed and announced sizes, and for nested JSON.

Regular blocks of numbers are read at once, other lines one by one.
"""

from __future__ import annotations

import base64
import json
import math
import os
import re
import stat
import zlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.errors import MeshFileError, check_path, report_damage
from quasiharmonic.util.arrays import count_of
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
        except (ValueError, EOFError, RecursionError, MemoryError, TokenError) as error:
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


# First bytes of common files that are not plain text.
_FOREIGN = {
    b"\xff\xfe": ("is UTF-16 text", "save it as UTF-8"),
    b"\xfe\xff": ("is UTF-16 text", "save it as UTF-8"),
    b"\x1f\x8b": ("is compressed by gzip", "unpack it first"),
    b"PK\x03\x04": ("is a zip archive", "unpack it first"),
    b"BZh": ("is compressed by bzip2", "unpack it first"),
    b"\xfd7zXZ": ("is compressed by xz", "unpack it first"),
}
_NUMERIC = b"0123456789.eE+-"
# An exponent in Fortran notation.
_FORTRAN = re.compile(rb"(?<=[0-9.])[dD](?=[+-]?[0-9])")
_INTEGER = re.compile(rb"[+-]?[0-9]+")


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read the bytes of a file; MeshFileError if it does not exist or cannot be read."""
    check_path("path", path)
    with report_damage(path, "is not a file name: "):
        try:
            mode = os.stat(path).st_mode
            if stat.S_ISDIR(mode):
                raise MeshFileError(path, "is a directory", remedy="name a file")
            if not stat.S_ISREG(mode):
                raise MeshFileError(path, "is not a regular file")
            return Path(path).read_bytes()
        except FileNotFoundError as error:
            raise MeshFileError(path, "there is no such file") from error
        except OSError as error:
            raise MeshFileError(path, f"cannot be read: {error.strerror or error}") from error


def read_text(path: str | os.PathLike[str]) -> bytes:
    """Read a text file; MeshFileError if it cannot be read or is not text.

    Each line ends with a single newline, and there is no byte order mark. The contents need not be valid UTF-8: only
    names and comments contain non-ASCII characters, and these are passed through.
    """
    return as_text(path, read_bytes(path))


def as_text(path: str | os.PathLike[str], data: bytes) -> bytes:
    """Return the contents of a file as `read_text` does; ``path`` is for messages."""
    for start, (what, remedy) in _FOREIGN.items():
        if data.startswith(start):
            raise MeshFileError(path, what, remedy=remedy)
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    nul = data.find(b"\0")
    if nul >= 0:
        line = data.count(b"\n", 0, nul) + 1
        raise MeshFileError(path, "a NUL byte", line, "this is a binary or a damaged file")
    return data if data.endswith(b"\n") or not data else data + b"\n"


def content_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the non-empty lines of a text without comments (``#``), each with its number."""
    for line, raw in enumerate(BytesIO(data), 1):
        if text := raw.split(b"#", 1)[0].strip():
            yield line, text


def quote_token(token: bytes) -> str:
    """Quote a piece of a file for a message, shortened and in ASCII."""
    text = ascii(token[:40].decode("utf-8", "replace"))
    return text if len(token) <= 40 else f"{text[:-1]}...'"


def number(token: bytes) -> float:
    """Convert decimal text to the nearest double; raise `ValueError` with a clear message for anything else."""
    try:
        # Reject what Python accepts but files do not mean: 1_000, or words for infinity.
        value = math.nan if b"_" in token else float(_FORTRAN.sub(b"e", token))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{quote_token(token)} is not a finite number")
    return value


def is_number(token: bytes) -> bool:
    """Return whether `number` accepts a piece of text."""
    try:
        number(token)
    except ValueError:
        return False
    return True


def integer(token: bytes) -> int:
    """Convert decimal text to an integer below 10¹⁸; raise `ValueError` with a clear message for anything else."""
    if len(token) <= 18 and token.isdigit():
        return int(token)
    if not _INTEGER.fullmatch(token):
        raise ValueError(f"{quote_token(token)} is not an integer")
    digits = token.lstrip(b"+-").lstrip(b"0")
    if len(digits) > 18:
        raise ValueError(f"{quote_token(token)} is far too large")
    value = int(digits or b"0")
    return -value if token.startswith(b"-") else value


def number_table(block: bytes, keyword: bytes, rows: int) -> NDArray[np.float64] | None:
    """Read lines of numbers that all have the same form, at once: (rows, k) float64 with 1 ≤ k ≤ 8.

    Each line of the block starts with ``keyword``, which may be empty, and ends with a newline. None if the lines
    differ in form or contain anything but finite numbers.
    """
    separators = block[: block.index(b"\n")].count(b" ")
    columns = separators if keyword else separators + 1
    # Without its numbers every line must be the same. Two separators enclose at most one number, so the right total
    # means that no number is missing.
    frame = keyword + b" " * separators + b"\n"
    is_even = 1 <= columns <= 8 and block.translate(None, _NUMERIC) == frame * rows
    numbers = block.translate(None, keyword).split() if is_even else []
    if not is_even or len(numbers) != rows * columns:
        even = _collapse_blanks(block)
        return None if even == block else number_table(even, keyword, rows)
    try:
        # float() rounds correctly and is as fast as any array function.
        values = np.fromiter(map(float, numbers), np.float64, len(numbers))
    except ValueError:
        return None
    return values.reshape(rows, columns) if np.isfinite(values).all() else None


def integer_table(block: bytes, form: bytes, rows: int) -> NDArray[np.int64] | None:
    r"""Read lines of non-negative integers that all have the same form, at once: (rows, k) int64.

    ``form`` is a line with ``1`` for every number: ``b"f 1/1 1/1 1/1\n"``. Numbers that are too large become 2⁶³ - 1.
    None if a line has another form.
    """
    frame = form.replace(b"1", b"")
    if block.translate(None, b"0123456789") != frame * rows:
        even = _collapse_blanks(block)
        return None if even == block else integer_table(even, form, rows)
    # As in `number_table`. In addition, reject digits where the form has none.
    for joint in {form[i : i + 2] for i in range(len(form) - 1)}:
        if b"1" not in joint and block.count(joint) != form.count(joint) * rows:
            return None
    columns = form.count(b"1")
    separators = bytes(set(frame))
    plain = block.translate(bytes.maketrans(separators, b" " * len(separators)))
    values = np.fromstring(plain, dtype=np.int64, sep=" ")
    return values.reshape(rows, columns) if values.size == rows * columns else None


def _collapse_blanks(block: bytes) -> bytes:
    """Replace runs of blanks by single ones and remove those at the ends of lines."""
    block = block.replace(b"\t", b" ")
    while b"  " in block:
        block = block.replace(b"  ", b" ")
    return block.replace(b" \n", b"\n")


def read_pairs(path: str | os.PathLike[str], what: str) -> Iterator[tuple[int, list[int]]]:
    """Read lines of two whole numbers each; yield line numbers, counted from 1, and numbers.

    Blanks, tabs, commas and colons separate the numbers. A comment starts with ``#``. MeshFileError if the file cannot
    be read, or for any other line; ``what`` says what each line must be.
    """
    for at, line in enumerate(read_text(path).split(b"\n"), 1):
        words = line.partition(b"#")[0].replace(b",", b" ").replace(b":", b" ").split()
        if not words:
            continue
        if len(words) != 2 or not all(word.isdigit() for word in words):
            shown_line = line[:60].decode("utf-8", "replace")
            raise MeshFileError(path, f"is not {what}, two whole numbers from 0 on: {shown_line!r}", at)
        with report_damage(path, line=at, remedy="indices count from 0"):
            numbers = list(map(integer, words))
        yield at, numbers


def read_rows(path: str | os.PathLike[str], columns: int, names: Sequence[bytes] = ()) -> list[tuple[int, list[float]]]:
    """Read lines with ``columns`` numbers each; return line numbers, counted from 1, and numbers.

    Blanks, tabs and commas separate numbers, which may be in quotes. In a line with semicolons, semicolons separate
    numbers and commas are decimal points, as in spreadsheets of many countries. Exponents have an e, or a d as in
    Fortran. A comment starts with ``#``. A first line without numbers is a heading. MeshFileError if the file cannot be
    read, or a line has another count of numbers or anything but finite numbers, or the heading has the ``names`` in
    another order, or nothing follows it.
    """
    rows, heading = list[tuple[int, list[float]]](), b""
    for at, text in content_lines(read_text(path).replace(b'"', b"")):
        if b";" in text:
            words = [word.strip().replace(b",", b".") for word in text.split(b";")]
        else:
            words = text.replace(b",", b" ").split()
        if at == 1 and not any(is_number(word) for word in words):
            named = [word.lower() for word in words if word.lower() in names]
            if named != sorted(named, key=names.index):
                raise MeshFileError(path, f"the columns are not in the order {b', '.join(names).decode()}", at)
            heading = text
            continue
        if len(words) != columns:
            raise MeshFileError(path, f"not {count_of('number', 'numbers', columns)}: {quote_token(text)}", at)
        with report_damage(path, line=at):
            rows.append((at, [number(word) for word in words]))
    if heading and not rows:
        raise MeshFileError(path, f"no numbers after the heading {quote_token(heading)}", 1)
    return rows
