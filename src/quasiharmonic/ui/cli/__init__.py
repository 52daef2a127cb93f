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
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from io import TextIOWrapper
from typing import Any

from quasiharmonic.ui.cli.interrupts import Interrupts
from quasiharmonic.ui.cli.report import ReportError, in_words
from quasiharmonic.ui.cli.streams import NO_READER, output_failed, tell
from quasiharmonic.ui.cli.version import Version

# The subcommands in the order of the help; each is a module of `commands`.
COMMANDS = (
    "map",
    "flatten",
    "morph",
    "animate",
    "repair",
    "field",
    "polish",
    "harmonise",
    "check",
    "measure",
    "plot",
    "view",
    "studio",
    "diagnose",
    "refine",
    "batch",
    "report",
    "demo",
)


_INTERRUPTED = "interrupted, nothing was written"


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``qhm`` and return its exit status.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments after the command's name; by default those of the process.
    """
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
        run: Callable[[argparse.Namespace], int] = options.run
        try:
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


def _fail(command: str, why: str | Exception, status: int) -> int:
    """Print why a command failed, unless standard output has no reader; return the exit status."""
    if isinstance(why, BrokenPipeError):
        return NO_READER
    tell(f"qhm {command}: {why if isinstance(why, str) else in_words(why)}")
    return status


class _Parser(argparse.ArgumentParser):
    """A parser that raises an OSError when the help cannot be printed, which argparse ignores."""

    def print_help(self, file: Any = None) -> None:
        file = file or sys.stdout
        if file is None:
            # On standard error.
            super().print_help()
        else:
            file.write(self.format_help())


def parser_of(names: Iterable[str]) -> argparse.ArgumentParser:
    """Return the parser of the command, with the given subcommands."""
    parser = _Parser(
        prog="qhm",
        description="Map triangle meshes into the plane with no inverted triangle, certified exactly.",
        epilog="Exit status: 0 certified injective, 1 not injective, 2 wrong input or call (nothing written), 3 "
        "written, but the report failed.",
    )
    parser.add_argument("--version", action=Version)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in names:
        import_module(f"{__name__}.commands.{name}").add_parser(commands)
    return parser
