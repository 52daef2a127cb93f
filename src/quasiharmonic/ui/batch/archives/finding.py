"""Find the archives of a data set."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from quasiharmonic.ui.batch.archives import places
from quasiharmonic.ui.batch.archives.results import results_name
from quasiharmonic.ui.batch.archives.samples import is_archive
from quasiharmonic.ui.batch.problems import MARKER, find_problems, list_lines

# Numbered archives in the notation of WebDataset: data-{0000..0015}.tar.
_NUMBERS = re.compile(r"\{([0-9]+)\.\.([0-9]+)\}")
_MANY = 10_000_000


class Archive(NamedTuple):
    """Archive of a data set."""

    name: str  # Path in the data set, parts separated by "/": unique, and equal in every run
    location: str  # Absolute path or URL


def find_archives(source: str | os.PathLike[str], *, plain: bool) -> list[Archive]:
    """Return the archives of a data set, in the order of their names; none if its problems are files in folders.

    ``source`` is an archive, a folder, a URL of one of these, a name with numbers such as ``data-{0000..0015}.tar``, or
    a text file with one archive per line. Archives in a folder that has problems, too, are not counted, nor is the
    output of runs. ``plain`` is as for `find_problems`. ValueError if names are not unique, or an archive does not
    exist.
    """
    text = os.fspath(source)
    location = text if places.is_url(text) else os.path.abspath(text)
    numbered = _NUMBERS.search(location)
    if numbered is not None:
        base = location[: location.rfind("/", 0, numbered.start()) + 1] if "/" in location else ""
        found = [Archive(one[len(base) :], one) for one in _expand(location)]
    elif is_archive(location):
        found = [Archive(re.split(r"[/\\]", location)[-1], location)]
    elif places.is_url(location) or (
        os.path.isdir(location) and next(find_problems(location, plain=plain), None) is None
    ):
        found = [Archive(name, places.join(location, name)) for name in _archives_of(places.find(location))]
        if places.is_url(location) and not found:
            raise ValueError(f"there are no archives below {source}: problems by URL must be in .tar or .parquet files")
    else:
        found = _read_list(Path(location)) if os.path.isfile(location) else []
    _check(found)
    return found


def _expand(location: str) -> list[str]:
    """Return the locations that a name with numbers stands for."""
    match = _NUMBERS.search(location)
    if match is None:
        return [location]
    first, last = int(match[1]), int(match[2])
    if not first <= last < first + _MANY:
        raise ValueError(f"{match[0]}: the first number must not be greater than the second")
    width = len(match[1]) if match[1].startswith("0") else 0
    start, end = location[: match.start()], location[match.end() :]
    return [one for k in range(first, last + 1) for one in _expand(f"{start}{k:0{width}d}{end}")]


def _archives_of(names: list[str]) -> list[str]:
    """Return the names of archives outside the output of runs."""
    outputs = {posixpath.dirname(name) for name in names if posixpath.basename(name) == MARKER}

    def is_output(name: str) -> bool:
        return any(folder == "" or name.startswith(folder + "/") for folder in outputs)

    return [name for name in names if is_archive(name) and not is_output(name)]


def _read_list(path: Path) -> list[Archive]:
    """Return the archives in a list; none if its first line is not an archive."""
    found: list[Archive] = []
    for number, text in list_lines(path):
        if not is_archive(text):
            if found:
                raise ValueError(f"{path}: line {number}: {text[:100]!r} is not an archive, unlike the lines before it")
            return []
        location = text if places.is_url(text) else os.path.abspath(path.parent / text)
        for one in _expand(location):
            found.append(Archive(_name_in_list(one, path.parent), one))
    return found


def _name_in_list(location: str, folder: Path) -> str:
    if places.is_url(location):
        return location.partition("://")[2].lstrip("/")
    place = Path(location)
    return place.relative_to(folder if place.is_relative_to(folder) else place.anchor).as_posix()


def _check(found: Iterable[Archive]) -> None:
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
