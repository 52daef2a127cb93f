"""Arguments that several commands share."""

from __future__ import annotations

import argparse
import re
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

# Copies of names in energies.polishing, solver.search.harmonising, energies.measures, solver.search.stages and
# linsolve, so that the parser does not import these modules.
ENERGIES = "symmetric-dirichlet", "mips", "blend", "arap-barrier"
FLATTENED = *ENERGIES, "distances"
HARMONISED = "arap", "arap-unsigned", "area", "springs", *ENERGIES
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
LINEAR_SOLVERS = "auto", "mkl", "cholmod", "rslab", "qdldl", "superlu"


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", metavar="FILE", help="write the report as JSON; - for standard output")


def add_linear_solver(parser: argparse._ActionsContainer) -> None:
    """Add ``--linear-solver``."""
    parser.add_argument(
        "--linear-solver", default="auto", choices=LINEAR_SOLVERS, help="(default: the fastest one installed)"
    )


def add_strategy(parser: argparse._ActionsContainer) -> None:
    """Add ``--strategy``."""
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        help="the fastest method, or the paper's pipeline, which starts with si-log (default: speed)",
    )


def add_rings(parser: argparse._ActionsContainer) -> None:
    """Add ``--rings``."""
    parser.add_argument(
        "--rings",
        type=count,
        metavar="N",
        help="for distances: largest number of edges between two vertices (default: 20)",
    )


def set_default(options: argparse.Namespace, name: str, default: object, *, asked: bool, belongs: str) -> None:
    """Set the default of an option that is None; ValueError if the option was given without effect.

    ``asked`` tells whether it has an effect in this call, and ``belongs`` is the option that it requires, as users
    write it.
    """
    if getattr(options, name) is None:
        setattr(options, name, default)
    elif not asked:
        option = "--" + name.replace("_", "-")
        raise ValueError(f"{option} needs {belongs}: add {belongs}, or omit {option}")


def steps(text: str) -> int:
    """Convert text to a nonnegative integer; for argparse."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def count(text: str) -> int:
    """Convert text to a positive integer; for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def byte_count(text: str) -> int:
    """Convert a size such as 800M or 4G to bytes; for argparse."""
    found = re.fullmatch(r"([0-9.]+)\s*([KMGT]?)(?:i?B)?", text.strip(), re.IGNORECASE)
    value = 0.0
    if found is not None and found[1].count(".") < 2 and found[1] != ".":
        value = float(found[1]) * 1024 ** " KMGT".index(found[2].upper() or " ")
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a size such as 800M or 4G")
    return int(value)
