"""The command ``qhm``.

Exit status:

- 0: the request succeeded, and a written file is certified injective.
- 1: a written or checked map is not injective.
- 2: the input or the call is wrong, and nothing was written.
- 3: a map was written, but the report failed, possibly before the verdict.
- 141: standard output was closed by its reader, and no file was to be written.

The subcommands are in `commands`. The package builds on all packages below it. Start reading here, then
`commands.check`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from inspect import cleandoc
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn

from quasiharmonic.ui.cli.process import NO_READER, Interrupts, output_failed, require_output, tell
from quasiharmonic.ui.cli.report import ReportError, describe_error, in_options, use_options
from quasiharmonic.util.hints import suggest

# The subcommands by group, in the order of the help. Each is a module of `commands`.
GROUPS = {
    "commands that make or change a map or a mesh": {
        "map": "map a mesh into the plane without inverted triangles",
        "flatten": "flatten a surface with a free boundary, without overlap",
        "unwrap": "compute texture coordinates for any model, packed into a texture",
        "bake": "bake the look of a model into textures for new texture coordinates",
        "polish": "lower the distortion of an injective map, and keep it injective",
        "harmonise": "lower an energy without a barrier, and keep the map injective",
        "repair": "untangle the inverted triangles of a UV map, with a fixed boundary",
        "refine": "split the edges that prevent a map",
        "animate": "map a surface to a sequence of targets, each frame certified, without jumps",
        "morph": "move the boundary of a planar or tetrahedral mesh, and keep all elements valid",
        "transfer": "transfer positions, values and landmarks between two mapped surfaces",
        "field": "make a displacement field of an image invertible",
    },
    "commands that verify, measure and show, and others": {
        "check": "report what a mesh is, verify its map, and find obstructions to a map",
        "measure": "measure a map's distortion, and export it for each triangle",
        "plot": "draw a map: inverted triangles, distortion, or a texture on the surface",
        "view": "show a surface and its map in a window",
        "studio": "edit a map in the browser",
        "batch": "map all problems of a data set, on all cores or a cluster",
        "demo": "map a built-in surface onto a letter, and draw the map",
    },
}
COMMANDS = tuple(name for group in GROUPS.values() for name in group)

_INTERRUPTED = "interrupted, nothing was written"


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``qhm`` with the given arguments, by default those of the process, and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        # Escape characters that the terminal cannot encode, so that a report does not fail.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with Interrupts() as interrupts:
        words = sys.argv[1:] if argv is None else list(argv)
        # Import and declare only the requested command, to save time.
        parser = parser_of([words[0]] if words and words[0] in COMMANDS else COMMANDS)
        try:
            options = parser.parse_args(words)
        except OSError as error:
            # The parser prints the version and the help.
            return output_failed(error)
        use_options(parser, options.command)
        run: Callable[[argparse.Namespace], int] = options.run
        try:
            with _parent_surface(options):
                return run(options)
        except ReportError as error:
            return _fail(options.command, error, 3)
        except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
            # Wrong input: the library's messages name the elements and the remedy.
            return _fail(options.command, error, 2)
        except KeyboardInterrupt:
            return _fail(options.command, _INTERRUPTED, 2)
        except Exception as error:
            if interrupts.happened:
                return _fail(options.command, _INTERRUPTED, 2)
            if isinstance(error, ImportError):
                return _fail(options.command, error, 2)
            raise


@contextmanager
def _parent_surface(options: argparse.Namespace) -> Iterator[None]:
    """Take the triangles of FreeSurfer's patches from the surface of ``--surface``."""
    path: Path | None = getattr(options, "parent_surface", None)
    if path is None:
        yield
        return
    from quasiharmonic.io.formats.neuro import use_parent_surface
    from quasiharmonic.io.registry import format_of

    given = [value if isinstance(value, list) else [value] for value in vars(options).values() if value is not path]
    formats = [format_of(one) for several in given for one in several if isinstance(one, Path)]
    if not any(form is not None and form.suffix == ".patch.3d" for form in formats):
        raise ValueError("--surface gives the triangles of FreeSurfer's patches, but no file is a patch: omit it")
    if not path.is_file():
        raise ValueError(f"--surface {path}: there is no such file")
    with use_parent_surface(path):
        yield


def _fail(command: str, why: str | Exception, status: int) -> int:
    """Print why a command failed, unless standard output has no reader; return the exit status."""
    if isinstance(why, BrokenPipeError):
        return NO_READER
    tell(f"qhm {command}: {why if isinstance(why, str) else in_options(describe_error(why))}")
    return status


class CommandParser(argparse.ArgumentParser):
    """A parser whose help also lists groups of commands, and examples.

    It raises an OSError when the help cannot be printed, which argparse ignores.
    """

    def __init__(
        self,
        *args: Any,
        examples: Sequence[str] = (),
        groups: Mapping[str, Mapping[str, str]] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._examples, self._groups = tuple(examples), groups or {}

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse all arguments; a subcommand reports unknown ones with its own usage and the nearest name."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            known = re.findall(r"--[a-z-]+", self.format_usage())
            self.error(f"unrecognized arguments: {' '.join(unknown)}{suggest(unknown[0].partition('=')[0], known)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """Report a wrong call; for a wrong value, suggest the nearest one."""
        wrong = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        super().error(message + (suggest(wrong[1], re.findall(r"[\w:-]+", wrong[2])) if wrong else ""))

    def format_help(self) -> str:
        parts = [super().format_help()]
        for title, commands in self._groups.items():
            parts.append(f"{title}:\n" + "".join(f"  {name:<10} {text}\n" for name, text in commands.items()))
        if self._examples:
            parts.append("examples:\n" + "".join(f"  {line}\n" for line in self._examples))
        return "\n".join(parts)

    def print_help(self, file: Any = None) -> None:
        file = file or sys.stdout
        if file is None:
            # On standard error.
            super().print_help()
        else:
            file.write(self.format_help())


class Version(argparse.Action):
    """Print the text of `describe_environment` and exit."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: Any) -> None:
        super().__init__(
            option_strings, argparse.SUPPRESS, nargs=0, help="show the version and the environment, and exit"
        )

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        require_output()
        print(describe_environment())
        parser.exit()


def describe_environment() -> str:
    """Return version, Python, system, packages, whether loops are compiled, and linear solvers; one line each."""
    import os
    import platform
    from importlib.metadata import version

    from quasiharmonic import __version__
    from quasiharmonic.linsolve import available
    from quasiharmonic.util import kernels

    if kernels.extension is not None:
        loops = "compiled"
    elif os.environ.get("QUASIHARMONIC_PURE"):
        loops = "in NumPy, because QUASIHARMONIC_PURE is set"
    else:
        loops = "in NumPy, because the extension is not built or does not load"
    return "\n".join(
        [
            f"qhm {__version__}",
            f"Python {platform.python_version()}, {platform.system()} {platform.machine()}",
            ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "matplotlib")),
            f"loops: {loops}",
            f"linear solvers: {', '.join(available())}",
        ]
    )


def parser_of(names: Iterable[str]) -> argparse.ArgumentParser:
    """Return the parser of the command, with the given subcommands."""
    parser = CommandParser(
        prog="qhm",
        description="Map triangle meshes into the plane with no inverted triangle, certified exactly.",
        epilog="Exit status: 0 certified injective, 1 not injective, 2 wrong input or call (nothing written), 3 "
        "written, but the report failed. `qhm COMMAND --help` explains a command.",
        usage="qhm [-h] [--version] COMMAND ...",
        groups=GROUPS,
        examples=("qhm demo", "qhm map model.obj --to letter:R -o map.obj", "qhm check map.obj"),
    )
    parser.add_argument("--version", action=Version)
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, help=argparse.SUPPRESS, prog="qhm"
    )
    for name in names:
        module = import_module(f"{__name__}.commands.{name}")
        # A title, which the help leaves out, what the command does, the exit status, and examples.
        _, description, epilog, examples = [*cleandoc(module.__doc__ or "").split("\n\n"), *[""] * 4][:4]
        lines = [line.strip() for line in examples.splitlines()]
        command = commands.add_parser(name, description=description, epilog=epilog, examples=lines)
        command.set_defaults(run=module.run)
        module.declare_arguments(command)
    return parser
