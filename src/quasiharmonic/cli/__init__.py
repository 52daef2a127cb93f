"""The command ``qhm``.

Exit status 0: what was asked for holds, and a written file is certified injective. 1: a map was written
or judged that is not injective. 2: the input or the call is wrong, and nothing was written.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

from . import check, demo, map

COMMANDS = (map, check, demo)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``qhm`` and return its exit status.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments after the command's name; those of the process by default.
    """
    options = _parser().parse_args(argv)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        return run(options)
    except (ValueError, OSError, ImportError) as error:
        # Wrong input of any kind: the library's messages name the elements and what to do.
        print(f"qhm {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"qhm {options.command}: interrupted, nothing was written", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    from quasiharmonic import __version__

    parser = argparse.ArgumentParser(
        prog="qhm",
        description="Map triangle meshes into the plane with no inverted triangle, certified exactly.",
        epilog="Exit status: 0 certified injective, 1 not injective, 2 wrong input or call (nothing written).",
    )
    parser.add_argument("--version", action="version", version=f"qhm {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(commands)
    return parser
