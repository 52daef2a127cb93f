"""Problems of an archive, a tar or Parquet file, which is read as a stream."""

from __future__ import annotations

import os
import posixpath
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Any, BinaryIO

from quasiharmonic.io import suffixes
from quasiharmonic.io.mesh_files import INPUTS
from quasiharmonic.io.untrusted import MAX_BYTES
from quasiharmonic.ui.batch.records import load_pyarrow
from quasiharmonic.ui.batch.tar_stream import Damage, open_tar, read_members

# Suffixes of archives.
_TAR = ".tar", ".tar.gz", ".tgz"
_PARQUET = ".parquet"
#: Columns of a Parquet file with the names of its problems; the first that exists counts.
KEYS = "__key__", "problem", "name"
# Extensions of meshes, and of the list of fixed vertices.
_MESHES = frozenset(suffixes("read"))
_FIXED = "handles.txt", "txt"
# Problem folders in a tar file have these files, so that the folder is the name.
_FOLDER_FILES = {name: name.partition(".")[2] for name in (*INPUTS, "handles.txt")}
# Rows of a Parquet file in memory.
_ROWS = 64


@dataclass
class Sample:
    """Problem of an archive.

    Attributes
    ----------
    key : str
        Its name in the archive.
    files : dict of str to bytes
        Contents of the mesh and of the list of fixed vertices by extension, such as ``"obj"`` and ``"txt"``.
    error : str or None
        Why the problem cannot be used.
    """

    key: str
    files: dict[str, bytes] = field(default_factory=dict)
    error: str | None = None

    @property
    def mesh(self) -> str | None:
        """Extension of the mesh."""
        return next((extension for extension in self.files if _is_mesh(extension)), None)

    @property
    def fixed(self) -> str | None:
        """Extension of the list of fixed vertices."""
        return next((extension for extension in self.files if extension in _FIXED), None)


def is_archive(name: str) -> bool:
    """Whether the name is that of an archive."""
    return name.lower().endswith((*_TAR, _PARQUET))


def is_parquet(path: str | os.PathLike[str]) -> bool:
    """Whether a path or URL is that of a Parquet file."""
    return os.fspath(path).lower().endswith(_PARQUET)


def results_name(name: str) -> str:
    """Return the name of the results of an archive: results are not compressed."""
    for suffix in (".tar.gz", ".tgz"):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)] + ".tar"
    return name


def read_samples(path: Path, limit: int | None = None) -> Iterator[Sample]:
    """Read the problems of an archive, in order. Members of a tar file have at most ``limit`` bytes.

    Only the names of the problems stay in memory.

    Consecutive members of a tar file with the same name up to the first dot are one problem, as in WebDataset. So are
    the members ``input.obj`` or ``input.ply`` and ``handles.txt`` of a folder. In a Parquet file each row is a problem:
    the columns are named by the extensions, and the column ``__key__``, ``problem`` or ``name`` has the name. Of a mesh
    in OBJ and PLY, OBJ counts, as in a folder.

    Yields
    ------
    Sample
        A problem that cannot be read has an ``error``. OSError if the archive cannot be opened.
    """
    seen: set[str] = set()
    for sample in _parquet_samples(path) if is_parquet(path) else _tar_samples(path, limit or MAX_BYTES):
        _check_sample(sample, seen, is_parquet(path))
        seen.add(sample.key)
        yield sample


def _check_sample(sample: Sample, seen: set[str], is_row: bool) -> None:
    """Set the error of a sample that cannot be used."""
    first, second = (name.partition(".")[2] for name in INPUTS)
    if first in sample.files:
        sample.files.pop(second, None)
    meshes = [extension for extension in sample.files if _is_mesh(extension)]
    if sample.key in seen:
        sample.error = f"the name {sample.key} is used twice in the archive"
        sample.key = next(name for number in count(2) if (name := f"{sample.key} ({number})") not in seen)
    elif sample.error is not None:
        return
    elif not meshes:
        sample.error = "it has no mesh"
    elif len(meshes) > 1:
        why = "remove all of these columns but one" if is_row else "the name of a problem ends at the first dot"
        sample.error = f"it has several meshes: {', '.join(meshes)} ({why})"


def _is_mesh(extension: str) -> bool:
    return posixpath.splitext("." + extension.lower())[1] in _MESHES or "." + extension.lower() in _MESHES


def _split(name: str) -> tuple[str, str]:
    """Return key and extension of a member's name."""
    folder, base = posixpath.split(_drop_parent_parts(name))
    if base in _FOLDER_FILES and folder:
        return folder, _FOLDER_FILES[base]
    stem, _, extension = base.partition(".")
    return posixpath.join(folder, stem), extension


def _drop_parent_parts(name: str) -> str:
    """Return a name without the parts that lead out of a folder, because results repeat it."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    return "/".join(parts)


def _is_wanted(name: str) -> bool:
    extension = _split(name)[1]
    return extension in _FIXED or _is_mesh(extension)


def _tar_samples(path: Path, limit: int) -> Iterator[Sample]:
    """Yield the problems of a tar file. One without a list of fixed vertices beside damage may have lost it."""
    lists = False  # Whether problems have lists
    before: Sample | Damage | None = None
    here: Sample | Damage | None = None
    with open_tar(os.fspath(path)) as file:
        for after in chain(_tar_parts(file, limit), [None]):
            if isinstance(here, Damage):
                yield Sample(f"damaged-{here.start}", error=f"damaged at byte {here.start}: {here.what}")
            elif here is not None:
                lists = lists or here.fixed is not None
                if lists and here.fixed is None and (isinstance(before, Damage) or isinstance(after, Damage)):
                    here.error = "its list of fixed vertices may be lost, because the archive is damaged next to it"
                yield here
            before, here = here, after


def _tar_parts(file: BinaryIO, limit: int) -> Iterator[Sample | Damage]:
    """Yield consecutive members of a tar file with the same key as one problem, and damage in between."""
    sample: Sample | None = None
    for member in read_members(file, _is_wanted, limit):
        if not isinstance(member, Damage) and posixpath.basename(member.name).startswith("."):
            continue
        key, extension = ("", "") if isinstance(member, Damage) else _split(member.name)
        if sample is not None and (isinstance(member, Damage) or key != sample.key):
            yield sample
            sample = None
        if isinstance(member, Damage):
            yield member
            continue
        sample = sample or Sample(key)
        if member.link is not None and _is_wanted(member.name):
            what = f"{ascii(member.name)[1:-1]} is a link to {ascii(member.link)[1:-1]}, which a stream cannot follow"
            sample.error = f"{what}: repack with tar --hard-dereference -h"
        if member.data is not None:
            sample.files[extension] = member.data
    if sample is not None:
        yield sample


def _parquet_samples(path: Path) -> Iterator[Sample]:
    parquet = load_pyarrow()
    import pyarrow

    number = 0
    try:
        with parquet.ParquetFile(path) as file:
            names = file.schema_arrow.names
            key = next((name for name in KEYS if name in names), None)
            columns = [name for name in names if name == key or name in _FIXED or _is_mesh(name)]
            for group in range(file.num_row_groups):
                end = number + file.metadata.row_group(group).num_rows
                try:
                    for rows in file.iter_batches(_ROWS, row_groups=[group], columns=columns):
                        for row in rows.to_pylist():
                            yield _row_sample(row, key, number)
                            number += 1
                except (OSError, pyarrow.ArrowException) as error:
                    what = f"rows {number} to {end - 1} are damaged: {error}"
                    yield Sample(f"damaged-{number}", error=what)
                    number = end
    except (OSError, pyarrow.ArrowException) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        yield Sample(f"damaged-{number}", error=f"the archive is damaged: {error}")


def _row_sample(row: Mapping[str, Any], key: str | None, number: int) -> Sample:
    """Return the problem of a row; lists of fixed vertices may be text or lists of integers."""
    named = None if key is None else row[key]
    sample = Sample(f"{number:09d}" if named is None else _drop_parent_parts(str(named)) or f"{number:09d}")
    for name, value in row.items():
        if name == key or value is None:
            continue
        if isinstance(value, str):
            sample.files[name] = value.encode("utf-8", "surrogateescape")
        elif isinstance(value, bytes):
            sample.files[name] = value
        elif isinstance(value, list) and name in _FIXED:
            sample.files[name] = "".join(f"{vertex}\n" for vertex in value).encode()
        else:
            sample.error = f"column {name} has values of an unknown type"
    return sample
