"""``qhm --version``: print the version and the environment, for error reports."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from quasiharmonic.ui.cli.streams import require_output


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
