"""The options that several commands share, and how options are declared and checked."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import Field, fields
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from quasiharmonic.util import options
from quasiharmonic.util.options import Options

T = TypeVar("T")
Option: TypeAlias = dict[str, Any]  # Keywords of `add_argument`

# Copies of names in energies.measures, so that the parser does not import this module.
MEASURES = ("sigma1", "sigma2", "mips", "conformal", "isometric", "symmetric_dirichlet", "arap", "area_ratio", "shear")
# Defaults for packing, in texels.
RESOLUTION, PADDING = 1024, 4


def flag(words: str) -> Option:
    """Return an option without a value; ``words`` are its help, as for the other kinds."""
    return {"action": "store_true", "help": words}


def file(words: str, **rest: Any) -> Option:
    """Return an option that names a file."""
    return {"type": Path, "metavar": "FILE", "help": words} | rest


def text(metavar: str, words: str, **rest: Any) -> Option:
    """Return an option with any text."""
    return {"metavar": metavar, "help": words, **rest}


def choice(choices: Sequence[str], words: str, **rest: Any) -> Option:
    """Return an option with one of several words."""
    return {"choices": choices, "help": words, **rest}


def number(kind: Callable[[str], Any], words: str, *, metavar: str | tuple[str, ...] = "N", **rest: Any) -> Option:
    """Return an option with a number that ``kind`` converts."""
    return {"type": kind, "metavar": metavar, "help": words, **rest}


def declare_options(operation: type[Options]) -> dict[str, Option]:
    """Return the options of an operation: the fields that its class itself declares with a help text, in their order.

    Options of base classes are shared, and commands list these last.
    """
    every = {one.name: one for one in fields(operation)}
    own = (every[name] for name in operation.__annotations__ if name in every)
    return {one.name: _declare(one) for one in own if one.metadata["help"]}


def _declare(one: Field[Any]) -> Option:
    words, choices, check = (one.metadata[name] for name in ("help", "choices", "check"))
    if one.default is False:
        return flag(words)
    if choices:
        return choice(choices, words, default=one.default)
    integer = {options.positive: count, options.positive_or_none: count, options.count: steps}.get(check, int)
    # Types are strings in modules with postponed annotations.
    kind = one.type if isinstance(one.type, str) else getattr(one.type, "__name__", str(one.type))
    if kind in ("int", "int | None"):
        return number(integer, words, default=one.default)
    if kind not in ("float", "float | None"):
        raise TypeError(f"the command line has no option of type {kind}: {one.name}")
    return number(float, words, metavar="SECONDS" if check is options.seconds else "X", default=one.default)


def texture_size(text: str) -> tuple[int, int]:
    """Convert N or WIDTHxHEIGHT; for argparse."""
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(side.isascii() and side.isdigit() and int(side) for side in sides):
        raise argparse.ArgumentTypeError(f"{text} is neither N nor WIDTHxHEIGHT, such as 2048 or 2048x1024")
    return int(sides[0]), int(sides[-1])


def add_options(parser: argparse._ActionsContainer, *shared: str, **own: Option) -> None:
    """Add options of `SHARED`, then options with these names and keywords; underscores stand for hyphens."""
    for name, option in [*((name, SHARED[name]) for name in shared), *own.items()]:
        parser.add_argument("--" + name.replace("_", "-"), **option)


def add_files(
    parser: argparse.ArgumentParser,
    source: str,
    output: str | None = None,
    *,
    metavar: tuple[str, ...] = ("INPUT", "OUTPUT"),
) -> None:
    """Add the input, and ``--output`` if it is given, with these help texts and names."""
    parser.add_argument("input", type=Path, metavar=metavar[0], help=source)
    if output is not None:
        parser.add_argument("-o", "--output", type=Path, required=True, metavar=metavar[1], help=output)


def pick(given: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of options as keyword arguments of the same names."""
    return {name: getattr(given, name) for name in names}


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


def convert(text: str, kind: Callable[[str], T], is_valid: Callable[[T], bool], wanted: str) -> T:
    """Convert text to a valid number; for argparse, whose own messages would name our functions."""
    with suppress(ValueError):
        value = kind(text)
        if is_valid(value):
            return value
    raise argparse.ArgumentTypeError(f"{text} is not {wanted}")


def steps(text: str) -> int:
    """Convert text to a nonnegative integer; for argparse."""
    return convert(text, int, lambda value: value >= 0, "an integer of at least 0")


def count(text: str) -> int:
    """Convert text to a positive integer; for argparse."""
    return convert(text, int, lambda value: value > 0, "an integer of at least 1")


def byte_count(text: str) -> int:
    """Convert a size such as 800M or 4G to bytes; for argparse."""
    found = re.fullmatch(r"([0-9]+\.?[0-9]*|\.[0-9]+)\s*([KMGT]?)(?:i?B)?", text.strip(), re.IGNORECASE)
    value = 0.0 if found is None else float(found[1]) * 1024 ** " KMGT".index(found[2].upper() or " ")
    if not 1 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a size such as 800M or 4G")
    return int(value)


def convert_welding(text: str) -> bool | float:
    """Convert yes, no or a distance; for argparse."""
    if text in ("yes", "no"):
        return text == "yes"
    try:
        distance = float(text)
    except ValueError:
        distance = -1.0
    if not 0 <= distance < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is neither yes, no, nor a finite distance of at least 0")
    # Distance 0 is equality.
    return distance or True


def weld(default: str) -> Option:
    """Return the option of welding with this default."""
    words = (
        "weld vertices: yes, at equal positions; no; or a distance relative to the diagonal of the bounding box, such "
        "as 1e-6 (default: %(default)s)"
    )
    return number(convert_welding, words, metavar="WHICH", default=default)


def degrees(text: str) -> float:
    """Convert text to an angle in degrees, 0 to 180; for argparse."""
    return convert(text, float, lambda angle: 0 <= angle <= 180, "an angle from 0 to 180 degrees")


def _island_list(text: str) -> list[int]:
    """Convert a list of indices separated by commas; for argparse."""
    words = text.split(",")
    if not all(word.isascii() and word.isdigit() and len(word) < 10 for word in words):
        raise argparse.ArgumentTypeError(f"{text} is not a list of islands such as 0,2")
    return sorted({int(word) for word in words})


#: The options that several commands take with the same meaning.
SHARED: dict[str, Option] = {
    **declare_options(options.SolverOptions),
    **declare_options(options.MapOptions),
    "fixed": file("file of fixed vertices, 0-based, one per line (default: the boundary)"),
    "font": text("FONT", "for letters and words: a font file or the name of a font"),
    "corners": text(
        "V,V,…",
        "boundary vertices for the outline's corners, in the order of the corners: 0-based numbers, which qhm check "
        "--boundary lists, or near:x,y,z for the vertex nearest to a point; V:K is for corner K (from 0), V:X:Y for "
        "the outline's point (X, Y); or a file with one of these on each line; or auto, by angle",
    ),
    "corner_angle": number(
        degrees,
        "minimum turn of the outline at a corner, in degrees; with 0 all its points are corners, and its sides are "
        "matched edge by edge (default: %(default)g)",
        metavar="DEG",
        default=20.0,
    ),
    "slide": flag("let boundary vertices slide along the outline while distortion is lowered; corners stay fixed"),
    "pieces": file(
        "file that assigns boundary vertices to sides of --to's outline, 'vertex side' on each line, 0-based; "
        "a side ends at the next corner, and sides count along one contour after another"
    ),
    "cut": flag("cut surfaces that cannot be flattened, along seams; vertices and faces of the model are unchanged"),
    "seams": text(
        "WHICH",
        "seams to use: file, those of the input's vt (default); none; or a file of edges, two vertices, 0-based, on "
        "each line",
        default="file",
    ),
    "islands": number(
        _island_list,
        "change only these islands, from 0 in the order of their first triangles; the others keep their positions "
        "(--pack moves all islands)",
        metavar="K,K,…",
    ),
    "pack": flag("pack the islands into the unit square by their shapes, all at one texel density"),
    "resolution": number(
        int, f"for --pack: texels along a side of the texture (default: {RESOLUTION})", metavar="TEXELS"
    ),
    "padding": number(
        float, f"for --pack: minimum distance between islands in texels (default: {PADDING})", metavar="TEXELS"
    ),
    "texture": text(
        "IMAGE", "texture to add: a PNG or JPEG file, or checkerboard; beside an OBJ as .mtl and image, within a GLB"
    ),
    "reference": choice(
        options.REFERENCES, "shape of the triangles in which gradients are taken (default: that of the strategy)"
    ),
    "rings": number(count, "for --energy distances: largest number of edges between two vertices (default: 20)"),
    "surface": file(
        "the surface with the triangles of a FreeSurfer patch (default: beside the patch, such as "
        "lh.inflated for lh.cortex.patch.3d)",
        dest="parent_surface",
    ),
    "json": text("FILE", "write the report as JSON; - for standard output"),
}
