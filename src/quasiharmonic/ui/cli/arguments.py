"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

# Those of quasiharmonic.energies.polishing, .harmonising, .measures, .strategy and .linsolve, which are not imported to
# say them.
ENERGIES = "symmetric-dirichlet", "mips", "blend", "arap-barrier"
FLATTENED = *ENERGIES, "distances"
HARMONISED = "arap", "arap-unsigned", "area", "springs", "mips", "symmetric-dirichlet"
MEASURES = (
    "sigma1",
    "sigma2",
    "mips",
    "conformal",
    "isometric",
    "symmetric_dirichlet",
    "arap",
    "area_ratio",
    "shear",
)
STRATEGIES = "speed", "paper"
LINEAR_SOLVERS = "auto", "pardiso", "cholmod", "rslab", "qdldl", "superlu"


def add_report(parser: argparse.ArgumentParser) -> None:
    """``--json``."""
    parser.add_argument("--json", metavar="FILE", help="write the report as JSON; - for standard output")


def add_linear_solver(parser: argparse._ActionsContainer) -> None:
    """``--linear-solver``."""
    parser.add_argument(
        "--linear-solver", default="auto", choices=LINEAR_SOLVERS, help="(default: the fastest one installed)"
    )


def add_strategy(parser: argparse._ActionsContainer) -> None:
    """``--strategy``."""
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        help="the fastest method, or the paper's pipeline, which starts with si-log (default: speed)",
    )


def add_rings(parser: argparse._ActionsContainer) -> None:
    """``--rings``."""
    parser.add_argument(
        "--rings",
        type=count,
        metavar="N",
        help="for distances: largest number of edges between two vertices (default: 20)",
    )


def settle(options: argparse.Namespace, name: str, default: object, *, asked: bool, belongs: str) -> None:
    """Put in what an option is that was not given; refuse one that was, where nothing asks for it.

    Parameters
    ----------
    options : argparse.Namespace
        Has None for what was not given. Changed.
    name : str
        Of its value among the options.
    default : object
        What it is where it was not given.
    asked : bool
        Whether it has any effect in this call.
    belongs : str
        What it belongs to, as one would write it.

    Raises
    ------
    ValueError
        When it was given without effect.
    """
    if getattr(options, name) is None:
        setattr(options, name, default)
    elif not asked:
        option = "--" + name.replace("_", "-")
        raise ValueError(f"{option} needs {belongs}: add {belongs}, or omit {option}")


def steps(text: str) -> int:
    """Read a whole number, 0 included; for argparse."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def count(text: str) -> int:
    """Read a whole number of at least 1; for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value
