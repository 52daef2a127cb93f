"""Final report of a command, as text or JSON, and checks of output paths.

Messages of the library are put in the words of the command line: options in place of keyword arguments.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from quasiharmonic.ui.cli.process import tell

if TYPE_CHECKING:
    from quasiharmonic.problem import Domain

_options: ContextVar[Mapping[str, str] | None] = ContextVar("options", default=None)

_ASSIGNED: Final = re.compile(r"(?<![\w/.-])([a-z_]+)=('[^']*'|[^\s,;:)]+)")
# A name with an underscore, not in a path or a file name.
_NAME: Final = re.compile(r"(?<![\w/.-])[a-z]+(?:_[a-z]+)+(?![\w/-]|\.\w)")
# Names after a verb or a preposition that is followed by nothing else.
_LISTED: Final = re.compile(r"\b(omit|set|by) ((?:[a-z_]+)(?:(?:, (?:and |or )?| and | or )[a-z_]+)*)\b")
_COUNTING = "(indices count from 0)"
# Matches messages that name elements by their numbers.
_NUMBERED = re.compile(
    r"\b(vertex|vertices|nodes?|triangles?|quadrilaterals?|edges?|corners?|loops?|islands?|rows?|between) [-(]?\d"
)
# A message that gives the range of indices, or that repeats a number of the command line, needs no such note.
_NEEDS_NO_NOTE = re.compile(r"\b0 … \d|\bnamed? .*\bmore than once")


def use_options(parser: argparse.ArgumentParser, command: str) -> None:
    """Use the options of a subcommand in the messages from now on."""
    _options.set(list_options(parser, command))


def list_options(parser: argparse.ArgumentParser, command: str) -> dict[str, str]:
    """Return the options of a subcommand by the names of their values."""
    (subcommands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    actions = subcommands.choices[command]._actions
    long = {one.dest: [option for option in one.option_strings if option.startswith("--")] for one in actions}
    return {name: options[0] for name, options in long.items() if options}


def in_options(text: str) -> str:
    """Return a message with the options of the current subcommand in place of keyword arguments of the same names."""
    options = _options.get()
    if not options:
        return text

    def replace_assigned(found: re.Match[str]) -> str:
        if found[1] not in options:
            return found[0]
        value = found[2].strip("'")
        return options[found[1]] if value in ("True", "False") else f"{options[found[1]]} {value}"

    def replace_listed(found: re.Match[str]) -> str:
        return f"{found[1]} " + re.sub(r"[a-z_]+", lambda name: options.get(name[0], name[0]), found[2])

    text = _LISTED.sub(replace_listed, _ASSIGNED.sub(replace_assigned, text))
    return _NAME.sub(lambda found: options.get(found[0], found[0]), text)


def sizes(domain: Domain) -> dict[str, Any]:
    """Return the numbers of vertices, triangles and fixed vertices."""
    return {"vertices": domain.n, "triangles": len(domain.F), "fixed": len(domain.fixed)}


def emit(facts: dict[str, Any], destination: str | None, text: str) -> None:
    """Print the text and write the JSON; with ``--json -`` standard output contains only the JSON."""
    text = in_options(text)
    if destination == "-":
        if sys.stdout is None:
            raise OSError("standard output is closed")
        print(json.dumps(facts, allow_nan=False), flush=True)
        tell(text)
        return
    if destination is not None:
        from quasiharmonic.io import write_whole

        write_whole(destination, json.dumps(facts, indent=2, allow_nan=False).encode() + b"\n")
    print(text, flush=True)


def check_outputs(options: argparse.Namespace, inputs: Sequence[Path | None]) -> None:
    """Check before any work that outputs can be written and do not replace other files.

    The outputs are the map, and the files of ``--plot``, ``--pattern`` and ``--json``. ValueError or OSError if a path
    cannot be written, two outputs are the same file, or a picture or a report would replace an input. The map may
    replace an input, because it is written after reading.
    """
    from quasiharmonic import io

    io.check_output(options.output)
    outputs = {f"--{name}": getattr(options, name, None) for name in ("plot", "pattern")}
    if outputs["--plot"] is not None:
        check_picture("--plot", outputs["--plot"], inputs)
    check_new(outputs, options.json, inputs, {options.output: "the map (-o)"})


def check_new(
    outputs: Mapping[str, Path | None],
    json_path: str | None,
    inputs: Sequence[Path | None],
    others: Mapping[Path, str] | None = None,
) -> None:
    """Like `check_outputs`, for files that must replace neither an input nor each other.

    ``outputs`` maps descriptions to paths, or to None. ``others`` are outputs that are already checked, with their
    descriptions.
    """
    from quasiharmonic import io

    taken = dict(others or {})
    json_file = None if json_path in (None, "-") else Path(str(json_path))
    for what, path in {**outputs, "--json": json_file}.items():
        if path is None:
            continue
        io.check_writable(path)
        if any(_is_same_file(path, source) for source in inputs if source is not None):
            raise ValueError(f"{what} {path} would replace an input file")
        for other, name in taken.items():
            if _is_same_file(path, other):
                raise ValueError(f"{what} {path} is also the file of {name}")
        taken[path] = what


def check_picture(
    option: str, path: Path, inputs: Sequence[Path | None], endings: Sequence[str] = (".png", ".svg", ".pdf")
) -> None:
    """Like `check_outputs`, for a picture."""
    if path.suffix.lower() not in endings:
        raise ValueError(f"{option} {path}: pictures are written as {', '.join(endings)}")
    check_new({option: path}, None, inputs)


def _is_same_file(path: Path, other: Path) -> bool:
    """Whether two paths are the same file, also through symbolic or hard links."""
    return path.resolve() == other.resolve() or (path.exists() and other.exists() and path.samefile(other))


@contextmanager
def name_source(source: Path | str) -> Iterator[None]:
    """Prefix error messages about a mesh with its file, and state that indices count from 0 where it matters.

    A `MeshFileError` already names its file and is not changed.
    """
    from quasiharmonic.io.errors import MeshFileError

    try:
        yield
    except ValueError as error:
        text = str(error)
        if (
            isinstance(error, MeshFileError)
            or text.startswith((f"{source}:", f"{source} --to "))
            or text.endswith(_COUNTING)
        ):
            # The error names its file, or an inner block has named it.
            raise
        numbered = _NUMBERED.search(text) and not _NEEDS_NO_NOTE.search(text)
        raise ValueError(f"{source}: {text}{f' {_COUNTING}' if numbered else ''}") from error


def describe_error(error: Exception) -> str:
    """Return the message of an error; system errors without their number."""
    from quasiharmonic.io.errors import printable_path

    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    named = isinstance(error.filename, str | bytes)
    return f"{printable_path(error.filename)}: {error.strerror}" if named else error.strerror


def tell_written(path: Path) -> int:
    """Print that a picture is written; return the exit status."""
    with after_writing(path):
        print(f"wrote {path}", flush=True)
    return 0


class ReportError(Exception):
    """The map was written, but the report failed."""


@contextmanager
def after_writing(output: str | Path) -> Iterator[None]:
    """Convert errors after writing to `ReportError`, so that the message says that the output was written."""
    try:
        yield
    except (ValueError, OSError, ArithmeticError, ImportError) as error:
        raise ReportError(f"{output} is written, but the report failed: {describe_error(error)}") from error
    except KeyboardInterrupt:
        raise ReportError(f"{output} is written; interrupted before the report") from None
