"""Enumerate the problems of a data set: their names and files."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from quasiharmonic.io import problem_files, suffixes
from quasiharmonic.io.errors import check_path
from quasiharmonic.io.mesh_files import INPUTS
from quasiharmonic.io.registry import is_surface_name
from quasiharmonic.util.arrays import check_bool

#: A file that marks a folder as the output of a run; problems are not searched there.
MARKER = "qhm-batch.json"
#: Bytes of a small mesh file, of about 1,500 triangles; for larger meshes most searches start differently.
SMALL_FILE = 100_000
#: Bytes of the files of one group, of about 28,000 triangles.
GROUP_OF_FILES = 1_500_000
# Largest number of problems in a group. If one of them fails, the rest of the group is solved one by one.
_MAX_GROUP = 64
# First bytes of FreeSurfer's surfaces and patches, of gzip (GIFTI), and of FreeSurfer's text files.
_STARTS = b"\xff\xff\xfe", b"\xff\xff\xfd", b"\xff\xff\xff\xff", b"\x1f\x8b", b"#!ascii"
# Endings of archives and compressed files that are not read.
_UNSUPPORTED = ".zip", ".7z", ".rar", ".bz2", ".tbz2", ".xz", ".txz", ".zst", ".lz4", ".gz"

# Start of a comment in a list; file names may contain "#" too.
_COMMENT = re.compile(r"(?:^|\s)#")


@dataclass(frozen=True)
class ProblemFiles:
    """Files of one problem.

    Attributes
    ----------
    name : str
        Path in the data set, parts separated by ``/``: unique, and equal in every run.
    mesh : Path
        Absolute path of the mesh.
    fixed : Path or None
        Absolute path of the list of fixed vertices, if there is one.
    results : Path or None
        Absolute path of the folder for its map and record; by default ``results/NAME`` in the run's folder.
    source : str or None
        Source of the problem for its record; by default ``mesh``.
    error : str or None
        Why the problem cannot be used, if this is known.
    """

    name: str
    mesh: Path
    fixed: Path | None
    results: Path | None = None
    source: str | None = None
    error: str | None = None


def find_problems(source: str | os.PathLike[str], *, plain: bool = False) -> Iterator[ProblemFiles]:
    """Find every problem of a data set, one after another in the order of their names.

    Parameters
    ----------
    source : path
        A folder, a mesh, or a list. Folders are searched at any depth, including symbolic links. A list is a text file
        with one folder or mesh per line, relative to the list's folder; blank lines and comments are skipped. A comment
        begins with ``#`` at the start of a line or after a space.
    plain : bool
        Take every mesh as a problem. Otherwise a problem is a folder with ``input.obj`` or ``input.ply`` and, usually,
        ``handles.txt``, or a mesh file that is named itself.

    Yields
    ------
    ProblemFiles
        Folders with the output of a run are skipped.

    Raises
    ------
    ValueError
        If the source does not exist, or a line of a list names a missing path or a folder without problems.
    OSError
        If a folder or the list cannot be read.
    """
    check_path("source", source)
    check_bool("plain", plain)
    path = Path(os.path.abspath(source))
    if path.is_dir():
        yield from _find_problems_below(path, "", plain, frozenset())
    elif not path.exists():
        raise ValueError(f"there is no folder, list or mesh {source}")
    elif is_surface_name(path):
        yield ProblemFiles(path.name, path, None)
    else:
        yield from _read_list(path, plain)


def group_small(problems: Iterable[ProblemFiles]) -> Iterator[list[ProblemFiles]]:
    """Group small problems, by the sizes of their mesh files, in order.

    Yields
    ------
    list of ProblemFiles
        Large problems, and those whose files cannot be read, are alone in their list.
    """
    group: list[ProblemFiles] = []
    size = 0
    for problem in problems:
        try:
            bytes_ = os.stat(problem.mesh).st_size
        except OSError:
            bytes_ = SMALL_FILE + 1
        if group and (size + bytes_ > GROUP_OF_FILES or len(group) == _MAX_GROUP):
            yield group
            group, size = [], 0
        if bytes_ > SMALL_FILE:
            yield [problem]
        else:
            group.append(problem)
            size += bytes_
    if group:
        yield group


def _find_problems_below(
    folder: Path, name: str, plain: bool, above: frozenset[tuple[int, int]]
) -> Iterator[ProblemFiles]:
    """Yield the problems in a folder and below; ``above`` are the enclosing folders, to detect cyclic links."""
    try:
        status = folder.stat()
        here = (status.st_dev, status.st_ino)
        if here in above:
            return
        with os.scandir(folder) as entries:
            kinds = sorted((entry.name, _is_folder(entry)) for entry in entries)
    except OSError as error:
        # Skipping the folder would silently lose its problems.
        raise OSError(f"{folder}: the folder cannot be read: {error.strerror or error}") from error
    files = {entry for entry, is_folder in kinds if not is_folder}
    if MARKER in files:
        return
    if not plain and not files.isdisjoint(INPUTS):
        name = name or folder.name
        yield ProblemFiles(name, *problem_files(folder))
    for entry, is_folder in kinds:
        inner = f"{name}/{entry}" if name else entry
        if is_folder:
            yield from _find_problems_below(folder / entry, inner, plain, above | {here})
        elif plain and not entry.startswith(".") and _is_surface(folder / entry):
            yield ProblemFiles(inner, folder / entry, None)


def _is_surface(path: Path) -> bool:
    """Whether a file in a folder is a surface, by its name. A damaged one is, so that it is reported.

    Other files, such as ``lh.thickness``, have names like FreeSurfer's surfaces, so these are known by their content.
    """
    if path.suffix.lower() in suffixes("read"):
        return True
    if not is_surface_name(path):
        return False
    if not path.is_file():
        return True
    try:
        with open(path, "rb") as file:
            return file.read(len(_STARTS[-1])).startswith(_STARTS)
    except OSError:
        return True


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Whether a directory entry is a folder; cyclic links are not."""
    try:
        return entry.is_dir()
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        return False


def list_lines(path: Path) -> Generator[tuple[int, str]]:
    """Yield the numbers and contents of the lines of a list, without comments and blank lines."""
    with open(path, encoding="utf-8-sig", errors="surrogateescape") as lines:
        for number, line in enumerate(lines, 1):
            text = _COMMENT.split(line, maxsplit=1)[0].strip()
            if text:
                yield number, text


def _check_supported(path: Path) -> None:
    """Raise a ValueError if a file is an archive or compressed, and not read."""
    if path.suffix.lower() in _UNSUPPORTED:
        raise ValueError(
            f"{path}: {path.suffix} files are not supported: pack the data set as .tar, .tar.gz or .parquet"
        )


def _read_list(path: Path, plain: bool) -> Iterator[ProblemFiles]:
    _check_supported(path)
    seen = set()
    with closing(list_lines(path)) as lines:
        for number, text in lines:
            place = Path(os.path.abspath(path.parent / text))
            if not (place.is_dir() or (is_surface_name(place) and place.is_file())):
                if place.is_file():
                    _check_supported(place)
                raise ValueError(
                    f"{path}: line {number}: there is no folder and no mesh file {text[:100]!r}; "
                    "give one on each line of the list"
                )
            base = path.parent if place.is_relative_to(path.parent) else Path(place.anchor)
            name = place.relative_to(base).as_posix()
            if place.is_dir():
                found = _find_problems_below(place, "" if name == "." else name, plain, frozenset())
            else:
                found = iter([ProblemFiles(name, place, None)])
            none = True
            for problem in found:
                none = False
                if problem.name not in seen:
                    seen.add(problem.name)
                    yield problem
            if none:
                wanted = "a mesh" if plain else "a folder with input.obj or input.ply"
                raise ValueError(
                    f"{path}: line {number}: there is no problem in the folder {text[:100]!r}: give {wanted}, or a "
                    "folder that contains such folders"
                )
