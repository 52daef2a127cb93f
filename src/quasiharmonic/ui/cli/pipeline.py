"""The steps that commands share: read a mesh, change its map, write it, read it back, report.

A command that changes the map of one mesh and writes this mesh to one file calls `change_map`, which does all steps.
Examples are ``qhm map``, ``unwrap`` and ``repair``. Other commands do the first steps themselves: ``qhm demo`` has no
input, ``animate`` and ``transfer`` may write several files, and ``check`` may write none. Most of these call `conclude`
or `finish` to report: `conclude` when the report is complete, `finish` to complete it after a file is written.

`read_mesh` gives the mesh the texture of ``--texture``, which is then written with the mesh.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import process, report

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData

# The value of --texture that needs no file.
CHECKERBOARD = "checkerboard"


def add_old_textures(facts: dict[str, Any], lines: list[str], before: MeshData, after: MeshData) -> None:
    """Add to a report the names of the file's textures that do not fit because the texture coordinates changed."""
    from quasiharmonic.io.looks import describe_unfitting, unfitting_textures

    if named := unfitting_textures(before, after):
        facts["old_textures"] = named
        lines.append(describe_unfitting(named))


def tell_losses(output: Path, mesh: MeshData) -> None:
    """Report on standard error which data of a mesh the output format cannot store."""
    from quasiharmonic import io

    if lost := io.not_held(output, mesh):
        process.tell(f"{output} will not have: {'; '.join(lost)}")


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
def show_work(source: Path, words: Callable[[Any], str] = process.describe_step) -> Iterator[Any]:
    """Show progress during the block, and name the source in errors of the block; yield a callback, or None."""
    with report.name_source(source), process.progress_line(words) as show:
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
    tell_losses(options.output, changed.mesh)
    io.write_mapped(options.output, changed.mesh)

    def describe() -> Account:
        account = changed.describe(io.read_written(options.output, changed.mesh))
        account.facts |= name_files(options)
        add_old_textures(account.facts, account.lines, mesh, changed.mesh)
        return account

    return finish(options, describe, options.output)


def name_files(options: argparse.Namespace) -> dict[str, str]:
    """Return input and output as entries of the JSON report."""
    return {"input": str(options.input), "output": str(options.output)}


def finish(options: argparse.Namespace, describe: Callable[[], Account], written: Path) -> int:
    """Report what a command has written, and return the exit status; `ReportError` if the report fails.

    ``describe`` returns the report. `ReportError` names ``written``, a file that the command has written.
    """
    with report.after_writing(written):
        account = describe()
        report.emit(account.facts, options.json, "\n".join([*account.lines, *account.closing]))
    return 0 if account.good else 1


def conclude(options: argparse.Namespace, account: Account, written: Path | None = None) -> int:
    """Report what a command has found, and return the exit status; ``written`` is the file that it has written, if any.

    BrokenPipeError when no file is written, standard output is closed and ``--json`` names no file, so that nobody can
    read the report.
    """
    if written is not None:
        return finish(options, lambda: account, written)
    if options.json is None:
        process.require_output()
    report.emit(account.facts, options.json, "\n".join(account.lines))
    return 0 if account.good else 1
