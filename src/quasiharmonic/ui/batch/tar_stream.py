"""Read a tar file as a stream, past damaged members."""

from __future__ import annotations

import gzip
import tarfile
import zlib
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

from quasiharmonic.io.untrusted import MAX_BYTES

_BLOCK = tarfile.BLOCKSIZE
_CHUNK = 1 << 20
# Types of headers about the next member: its long name and link (GNU), and extended attributes (POSIX).
_LONG_NAME, _LONG_LINK, _ATTRIBUTES = tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.XHDTYPE
# Type of a header about all members.
_GLOBAL = tarfile.XGLTYPE
# Longest header about the next member, in bytes.
_MAX_HEADER = 1 << 20


class Member(NamedTuple):
    """File in a tar file."""

    name: str
    data: bytes | None  # None if it was not asked for
    start: int  # Offset of the first header that belongs to the member
    end: int  # Offset after its data and padding
    link: str | None = None  # The file that a hard or symbolic link refers to; a link has no data


class Damage(NamedTuple):
    """Part of a tar file that cannot be read."""

    start: int  # Offset
    what: str


class _ShortReadError(Exception):
    """The file ends within a member."""


def open_tar(path: str) -> BinaryIO:
    """Open a tar file for reading; gzip compression is detected."""
    with open(path, "rb") as file:
        compressed = file.read(2) == b"\x1f\x8b"
    return gzip.open(path, "rb") if compressed else open(path, "rb")  # type: ignore[return-value]


def read_members(
    file: BinaryIO, wanted: Callable[[str], bool] = lambda name: True, limit: int = MAX_BYTES
) -> Iterator[Member | Damage]:
    """Read the files of a tar file one after another, in constant memory.

    Parameters
    ----------
    file : binary file
        The tar file, at its start.
    wanted : callable, optional
        Whether to read the data of a member of this name.
    limit : int
        Largest number of bytes of a member that is read.

    Yields
    ------
    Member or Damage
        Regular files and links, and parts that cannot be read: damaged and too large ones. After a damaged header the
        next valid one is searched.
    """
    reader = _TarReader(file)
    try:
        yield from reader.members(wanted, limit)
    except _ShortReadError:
        yield Damage(reader.start, "the archive ends within this member")
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        yield Damage(reader.start, f"the compressed archive is damaged: {error}")


class _TarReader:
    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._offset = 0
        self.start = 0

    def members(self, wanted: Callable[[str], bool], limit: int) -> Iterator[Member | Damage]:
        damaged = ended = False
        attributes: dict[str, str] = {}
        self.start = 0
        while block := self._file.read(_BLOCK):
            if not attributes:
                self.start = self._offset
            self._offset += len(block)
            try:
                info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
            except tarfile.EOFHeaderError:  # type: ignore[attr-defined]
                ended, damaged = True, False
                continue
            except tarfile.HeaderError as error:
                # The data of a damaged member are not headers either; one report is enough.
                if not damaged:
                    yield Damage(self.start, str(error))
                damaged, attributes = True, {}
                continue
            damaged = False
            if info.type in (_LONG_NAME, _LONG_LINK, _ATTRIBUTES):
                if info.size > _MAX_HEADER:
                    yield Damage(self.start, "a header is too long")
                    damaged = True
                    continue
                attributes |= _attributes(info.type, self._read(info.size))
                continue
            name = attributes.get("path", info.name)
            size = int(attributes.get("size", info.size))
            link = attributes.get("linkpath", info.linkname)
            attributes = {}
            if info.islnk() or info.issym():
                yield Member(name, None, self.start, self._offset, link)
            elif not info.isreg():
                self._skip(info.size if info.type == _GLOBAL else 0)
            elif wanted(name) and size > limit:
                self._skip(size)
                what = f"the member {ascii(name)[:80]} has {size:,} bytes, more than the bound of {limit:,}"
                yield Damage(self.start, what)
            elif wanted(name):
                data = self._read(size)
                yield Member(name, data, self.start, self._offset)
            else:
                self._skip(size)
                yield Member(name, None, self.start, self._offset)
        if not ended:
            yield Damage(self._offset, "the archive has no end mark, so members may be missing")

    def _read(self, size: int) -> bytes:
        parts = []
        left = size
        while left:
            part = self._file.read(min(left, _CHUNK))
            if not part:
                raise _ShortReadError
            parts.append(part)
            left -= len(part)
        padding = -size % _BLOCK
        if len(self._file.read(padding)) < padding:
            raise _ShortReadError
        self._offset += size + padding
        return b"".join(parts)

    def _skip(self, size: int) -> None:
        whole = size + -size % _BLOCK
        if not whole:
            return
        # Seek to the last byte and read it, because seeking behind the end is no error.
        self._file.seek(whole - 1, 1)
        if not self._file.read(1):
            raise _ShortReadError
        self._offset += whole


def _attributes(kind: bytes, data: bytes) -> dict[str, str]:
    """Return name, link and size from a header about the next member; others are ignored."""
    if kind in (_LONG_NAME, _LONG_LINK):
        return {"path" if kind == _LONG_NAME else "linkpath": data.rstrip(b"\0").decode("utf-8", "surrogateescape")}
    found = {}
    while data:
        length, space, _ = data.partition(b" ")
        if not space or not length.isdigit() or int(length) <= len(length) + 1:
            break
        key, _, value = data[len(length) + 1 : int(length)].rstrip(b"\n").partition(b"=")
        if key in (b"path", b"linkpath") or (key == b"size" and value.isdigit()):
            found[key.decode()] = value.decode("utf-8", "surrogateescape")
        data = data[int(length) :]
    return found


def global_comment(block: bytes) -> str | None:
    """Return the comment of a tar file whose first bytes are given, if it begins with a global header."""
    try:
        info = tarfile.TarInfo.frombuf(block[:_BLOCK], "utf-8", "surrogateescape")
    except tarfile.HeaderError:
        return None
    data = block[_BLOCK : _BLOCK + info.size]
    length, _, rest = data.partition(b" ")
    key, _, value = rest[: -1 if rest.endswith(b"\n") else None].partition(b"=")
    if info.type != _GLOBAL or key != b"comment" or not length.isdigit() or int(length) != len(data):
        return None
    return value.decode("utf-8", "replace")


def pack_member(name: str, data: bytes) -> bytes:
    """Return a member with its header and padding."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    header = info.tobuf(tarfile.PAX_FORMAT, "utf-8", "surrogateescape")
    return header + data + b"\0" * (-len(data) % _BLOCK)


def pack_comment(text: str) -> bytes:
    """Return a global header with a comment."""
    return tarfile.TarInfo.create_pax_global_header({"comment": text})


#: End of a tar file.
END_MARK = b"\0" * (2 * _BLOCK)
