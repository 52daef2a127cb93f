"""Readers of a data set: they find its problems, in folders or in archives, and hand over their files."""

from __future__ import annotations

import os
import posixpath
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from quasiharmonic.io.atomic import writing
from quasiharmonic.ui.batch import places
from quasiharmonic.ui.batch.problems import MARKER, ProblemFiles, find_problems, list_lines
from quasiharmonic.ui.batch.samples import Sample, is_archive, read_samples, results_name
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.shards import Shard

# Numbered archives in the notation of WebDataset: data-{0000..0015}.tar.
_NUMBERS = re.compile(r"\{([0-9]+)\.\.([0-9]+)\}")
# Maximum number of archives that such a name stands for.
_MAX_NUMBERS = 10_000_000
# What messages call the folder of unpacked problems.
_SCRATCH = "to the folder for temporary files"


class Scratch:
    """Folders for the files of problems that are being solved.

    Parameters
    ----------
    folder : Path
        The folder that contains them.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._free: list[Path] = []  # Folders of finished problems; a new one takes longer than a file

    def take(self) -> Path:
        """Return an empty folder; OutputError if it cannot be made."""
        try:
            return self._free.pop()
        except IndexError:
            with writing(_SCRATCH):
                return Path(tempfile.mkdtemp(dir=self._folder))

    def free(self, folder: Path) -> None:
        """Keep an empty folder for another problem."""
        self._free.append(folder)


class FolderReader(NamedTuple):
    """Problems in folders, as `find_problems` finds them, or those of a shard."""

    source: str | os.PathLike[str]
    shard: Shard
    name: str = ""  # As for archives: the names of the problems begin with it

    def problems(self, orders: Orders, _scratch: Scratch | None = None) -> Iterator[ProblemFiles]:
        """Yield the problems, in the order of their names."""
        found = find_problems(self.source, plain=orders.settings.plain)
        return (files for files in found if self.shard.contains(files.name))

    def count(self, orders: Orders) -> int:
        """Return the number of problems; ValueError if the data set has none, or one lies in the output folder.

        The problems are enumerated several times, so that memory does not grow with their number.
        """
        folder, plain = orders.output, orders.settings.plain
        none, number, inside = True, 0, folder.is_relative_to(os.path.abspath(self.source))
        for files in find_problems(self.source, plain=plain):
            if inside and files.mesh.is_relative_to(folder):
                raise ValueError(f"{folder} contains a problem, {files.mesh}: choose another folder for the results")
            none = False
            number += self.shard.contains(files.name)
        if none:
            other = "" if plain else "; for plain meshes, give an outline, or flatten or unwrap them"
            raise ValueError(
                f"no problems in {self.source}: a problem is a folder with input.obj (or .ply) and handles.txt{other}"
            )
        return number


class ArchiveReader(NamedTuple):
    """Archive of a data set."""

    name: str  # Path in the data set, parts separated by "/": unique, and equal in every run
    location: str  # Absolute path or URL

    def problems(self, orders: Orders, scratch: Scratch) -> Iterator[ProblemFiles]:
        """Yield the problems; their files are written to folders of ``scratch`` when they are asked for.

        OutputError if they cannot be written, OSError if the archive cannot be read.
        """
        copy = scratch.take()
        try:
            for sample in read_samples(places.fetch(self.location, copy), orders.memory_limit):
                yield self._extract(sample, scratch, orders)
        finally:
            shutil.rmtree(copy, ignore_errors=True)

    def names(self, key: str) -> dict[str, str]:
        """Return the columns of a record that name a problem of the archive."""
        return {"problem": f"{self.name}/{key}", "source": f"{self.location}/{key}"}

    def _extract(self, sample: Sample, scratch: Scratch, orders: Orders) -> ProblemFiles:
        folder, mesh, fixed = scratch.take(), sample.mesh, None if orders.settings.plain else sample.fixed
        # The name of the member may be unsuitable for this system.
        mesh_path = folder / f"mesh.{(mesh or '').rpartition('.')[2]}"
        fixed_path = None if fixed is None else folder / "fixed.txt"
        with writing(_SCRATCH):
            if mesh is not None and sample.error is None:
                mesh_path.write_bytes(sample.files[mesh])
            if fixed is not None and fixed_path is not None:
                fixed_path.write_bytes(sample.files[fixed])
        names = self.names(sample.key)
        return ProblemFiles(
            names["problem"], mesh_path, fixed_path, results=folder, source=names["source"], error=sample.error
        )


def find_archives(source: str | os.PathLike[str], *, plain: bool) -> list[ArchiveReader]:
    """Return the archives of a data set, in the order of their names; none if its problems are files in folders.

    ``source`` is an archive, a folder, a URL of one of these, a name with numbers such as ``data-{0000..0015}.tar``, or
    a text file with one archive per line. Archives in a folder that has problems, too, are not counted, nor is the
    output of runs. ``plain`` is as for `find_problems`. ValueError if names are not unique, or an archive does not
    exist.
    """
    location = _absolute(os.fspath(source), "")
    numbered = _NUMBERS.search(location)
    if numbered is not None:
        base = location[: location.rfind("/", 0, numbered.start()) + 1]
        found = [ArchiveReader(one.removeprefix(base), one) for one in _expand(location)]
    elif is_archive(location):
        found = [ArchiveReader(re.split(r"[/\\]", location)[-1], location)]
    elif places.is_url(location) or (
        os.path.isdir(location) and next(find_problems(location, plain=plain), None) is None
    ):
        found = [ArchiveReader(name, places.join(location, name)) for name in _archives_of(places.find(location))]
        if places.is_url(location) and not found:
            raise ValueError(f"there are no archives below {source}: problems by URL must be in .tar or .parquet files")
    else:
        found = _read_list(Path(location)) if os.path.isfile(location) else []
    _check_archives(found)
    return found


def _absolute(location: str, folder: str | Path) -> str:
    """Return a URL as it is, and a path relative to a folder as an absolute one."""
    return location if places.is_url(location) else os.path.abspath(os.path.join(folder, location))


def _expand(location: str) -> list[str]:
    """Return the locations that a name with numbers stands for."""
    match = _NUMBERS.search(location)
    if match is None:
        return [location]
    first, last = int(match[1]), int(match[2])
    if first > last:
        raise ValueError(f"{match[0]}: the first number must not be greater than the second")
    if last - first >= _MAX_NUMBERS:
        raise ValueError(f"{match[0]} stands for {last - first + 1} archives; at most {_MAX_NUMBERS} are possible")
    width = len(match[1]) if match[1].startswith("0") else 0
    start, end = location[: match.start()], location[match.end() :]
    return [one for k in range(first, last + 1) for one in _expand(f"{start}{k:0{width}d}{end}")]


def _archives_of(names: list[str]) -> list[str]:
    """Return the names of archives outside the output of runs."""
    outputs = tuple(posixpath.join(posixpath.dirname(name), "") for name in names if posixpath.basename(name) == MARKER)
    shown = [name for name in names if not posixpath.basename(name).startswith(".")]
    return [name for name in shown if is_archive(name) and "" not in outputs and not name.startswith(outputs)]


def _read_list(path: Path) -> list[ArchiveReader]:
    """Return the archives in a list; none if its first line is not an archive."""
    found: list[ArchiveReader] = []
    for number, text in list_lines(path):
        if is_archive(text):
            locations = _expand(_absolute(text, path.parent))
            found += [ArchiveReader(_name_in_list(one, path.parent), one) for one in locations]
        elif found:
            raise ValueError(f"{path}: line {number}: {text[:100]!r} is not an archive, unlike the lines before it")
        else:
            break
    return found


def _name_in_list(location: str, folder: Path) -> str:
    if places.is_url(location):
        return location.partition("://")[2].lstrip("/")
    place = Path(location)
    return place.relative_to(folder if place.is_relative_to(folder) else place.anchor).as_posix()


def _check_archives(found: list[ArchiveReader]) -> None:
    names = set()
    for archive in found:
        name = results_name(archive.name)
        if name in names:
            raise ValueError(f"two archives have results of the same name, {name}: rename one of them")
        if ".." in archive.name.split("/"):
            raise ValueError(f"{archive.location}: the name of an archive must not have the part '..'")
        if not places.is_url(archive.location) and not os.path.isfile(archive.location):
            raise ValueError(f"there is no archive {archive.location}")
        names.add(name)
