"""The steps that commands share: read a mesh, work, write, read back, certify, report.

A command that writes a map is one call of `change_map`. Other commands use the last steps, `finish` after they have
written a file and `conclude` if they write none.

If they read a mesh, it gets the texture that ``--texture`` adds to the written surface.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import report, streams, written_map

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData

# The value of --texture that needs no file.
CHECKERBOARD = "checkerboard"


@dataclass
class Account:
    """What a command reports."""

    facts: dict[str, Any]  # Entries of the JSON report
    lines: list[str]  # Lines of the text report
    good: bool = True  # Whether the exit status is 0, not 1
    closing: list[str] = field(default_factory=list)  # Lines after the one about the textures of the file


@dataclass
class Changed:
    """A mesh with a new map, to be written."""

    mesh: MeshData
    describe: Callable[[MeshData], Account]  # Called with the mesh as a reader gets it from the written file


def read_mesh(options: argparse.Namespace, path: Path) -> MeshData:
    """Read a mesh and attach the texture that the options request.

    ValueError or OSError if the output format has no textures, a companion file cannot be written, or the image is
    missing or invalid.
    """
    from dataclasses import replace

    from quasiharmonic import io

    if options.texture is None:
        return io.read_mesh(path)
    companions = io.find_format(options.output, "write_map", "image").companions
    texture = io.checkerboard() if options.texture == CHECKERBOARD else io.read_texture(options.texture)
    if companions is not None:
        _check_companions(options, companions(options.output, texture))
    return replace(io.read_mesh(path), texture=texture)


def check_image_output(options: argparse.Namespace) -> None:
    """Check that the output can have baked textures, and that their files would replace no other file.

    ValueError or OSError as `read_mesh`.
    """
    from quasiharmonic import io

    companions = io.find_format(options.output, "write_map", "image").companions
    if companions is not None:
        for kind in ("image/png", ".png"), ("image/jpeg", ".jpg"):
            _check_companions(options, companions(options.output, io.Texture(b"", *kind)))


def _check_companions(options: argparse.Namespace, companions: tuple[Path, ...]) -> None:
    """Raise ValueError if a companion file of the output would replace an input or another output."""
    from quasiharmonic import io

    taken = (getattr(options, name, None) for name in ("input", "new", "texture", "plot", "json"))
    named = {Path(str(path)).resolve() for path in taken if path is not None}
    for path in companions:
        io.check_writable(path)
        if path.resolve() in named:
            raise ValueError(f"{path}, which goes with {options.output}, would replace another file: change -o")


@contextmanager
def working(source: Path, words: Callable[[Any], str] = streams.describe_step) -> Iterator[Any]:
    """Show progress during the block, and name the source in its errors; yield a callback, or None."""
    with report.name_source(source), streams.progress_line(words) as show:
        yield show


def change_map(
    options: argparse.Namespace,
    change: Callable[[MeshData], Changed],
    *,
    source: Path | None = None,
    inputs: Sequence[Path | None] = (),
    read: Callable[[argparse.Namespace, Path], MeshData] = read_mesh,
) -> int:
    """Read a mesh, change its map, write it, read it back, report; return the exit status.

    ``source`` is the file of the mesh, by default ``options.input``. ``inputs`` are further files that outputs must not
    replace.
    """
    from quasiharmonic import io

    source = options.input if source is None else source
    report.check_outputs(options, (source, *inputs))
    mesh = read(options, source)
    changed = change(mesh)
    written_map.tell_losses(options.output, changed.mesh)
    io.write_mapped(options.output, changed.mesh)

    def describe() -> Account:
        account = changed.describe(io.read_written(options.output, changed.mesh))
        account.facts |= name_files(options)
        written_map.add_old_textures(account.facts, account.lines, mesh, changed.mesh)
        return account

    return finish(options, describe, options.output)


def name_files(options: argparse.Namespace) -> dict[str, str]:
    """Return input and output as entries of the JSON report."""
    return {"input": str(options.input), "output": str(options.output)}


def finish(options: argparse.Namespace, describe: Callable[[], Account], written: Path) -> int:
    """Report what a command has written, and return the exit status; `ReportError` if the report fails.

    ``written`` is a file that is written.
    """
    with report.after_writing(written):
        account = describe()
        report.emit(account.facts, options.json, "\n".join([*account.lines, *account.closing]))
    return 0 if account.good else 1


def conclude(options: argparse.Namespace, account: Account) -> int:
    """Report what a command that writes no file has found, and return the exit status."""
    report.emit_verdict(account.facts, options.json, "\n".join(account.lines))
    return 0 if account.good else 1
