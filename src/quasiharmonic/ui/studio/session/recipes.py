"""Commands and Python scripts that reproduce the map of a page from the file, or from a start that the page saves."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from quasiharmonic.energies.polishing import SMOOTHING_STEPS
from quasiharmonic.io import MeshData
from quasiharmonic.util.arrays import IntArray

#: Names of the files that the page saves: the map, the map from which the last step started, the fixed vertices, the
#: seams that the user drew, the edges that must not become seams, the triangles to unwrap.
MAP, START, FIXED, SEAMS, FORBIDDEN, FACES = (
    *("map.obj", "start.obj", "fixed.txt", "seams.txt", "no_seams.txt", "faces.txt"),
)
# Names that scripts use, by the modules that they import them from.
_IMPORTS = {
    "quasiharmonic": ("BoundaryCurves", "atlas", "find_cuts", "injective_map", "io", "polish", "repair", "unwrap"),
    "quasiharmonic.targets": ("boundary_to", "filled", "outline", "outline_curves"),
    "quasiharmonic.apps.unwrapping.model_files": ("polygon_costs", "statement_labels"),
}


@dataclass(frozen=True, eq=False)
class Recipe:
    """How a map was computed: one call of the library, on the file as opened or on a start that the page saves."""

    command: str = ""  # The command line; empty if the map is that of the file
    python: str = ""  # A script with the same result, as ``mesh``
    start: MeshData | None = None  # Contents of `START`, if they read it
    texts: dict[str, bytes] = field(default_factory=dict)  # Contents of further files that they read
    outline: str | None = None  # The outline of the boundary
    anew: bool = True  # Whether the map was solved from scratch
    dragged: bool = False  # Whether the map ended a drag

    @property
    def of_file(self) -> bool:
        """Whether the map is that of the file."""
        return not self.command and self.start is None

    def files(self) -> list[str]:
        """Return the names of the saved files that command and script read."""
        return [*([START] if self.start is not None else []), *self.texts]


@dataclass(frozen=True, eq=False)
class Source:
    """The file from which a step starts."""

    name: str
    start: MeshData | None  # Contents, if the page saves the file

    @property
    def command(self) -> str:
        """The name as a word of a command line."""
        return self.name if not self.name.startswith("-") else f"./{self.name}"


def option_words(**options: object) -> list[str]:
    """Return the words of options; None and False are left out."""
    words = []
    for name, value in options.items():
        if value is None or value is False:
            continue
        words.append(f"--{name.replace('_', '-')}")
        words += [] if value is True else [str(value)]
    return words


class Code(str):
    """Python code, as opposed to a text."""

    __slots__ = ()


@dataclass(frozen=True, eq=False)
class Given:
    """Value of an argument, and how command and script spell it."""

    value: Any
    code: Code
    words: Mapping[str, object] = field(default_factory=dict)  # Options of the command
    texts: Mapping[str, bytes] = field(default_factory=dict)  # Files that command and script read


def arguments(**options: object) -> str:
    """Return further arguments of a Python call; None and False are left out."""
    codes = {name: value.code if isinstance(value, Given) else value for name, value in options.items()}
    return "".join(
        f", {name}={value if isinstance(value, Code) else repr(value)}"
        for name, value in codes.items()
        if value is not None and value is not False
    )


def values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments themselves."""
    return {name: value.value if isinstance(value, Given) else value for name, value in options.items()}


def record_call(
    verb: str,
    source: Source,
    output: str,
    options: Mapping[str, Any],
    only: Sequence[int] | None = None,
    *,
    words: Sequence[str] = (),
    lines: Sequence[str] = (),
) -> Recipe:
    """Return the recipe of a call for some islands: its command ``verb``, and a script with the function of `atlas`.

    ``words`` are further words of the command, and ``lines`` those of another script.
    """
    given = [value for value in options.values() if isinstance(value, Given)]
    plain = {name: value for name, value in options.items() if not isinstance(value, Given)}
    chosen = {name: value for one in given for name, value in one.words.items()}
    chosen["islands"] = None if only is None else ",".join(map(str, only))
    command = ["qhm", verb, source.command, *words, *option_words(**plain, **chosen)]
    # The file that a step starts from is not overwritten.
    command += ["-o", output if source.name != output else f"new_{output}"]
    script = write_script(lines or call_lines(verb, repr(source.name), options, only))
    texts = {name: content for one in given for name, content in one.texts.items()}
    return Recipe(shlex.join(command), script, source.start, texts)


def call_lines(verb: str, mesh: str, options: Mapping[str, Any], only: Sequence[int] | None) -> list[str]:
    """Return the lines that call a function of `atlas` for some islands of ``mesh``, which is Python code."""
    return [f"result = atlas.{verb}({mesh}{arguments(**options, islands=only)})", "mesh = result.mesh"]


def saved_rows(name: str, option: str, rows: IntArray) -> Given:
    """Return whole numbers, (k,) or (k, 2), as the argument ``option``, from a file that the page saves."""
    table = rows if rows.ndim == 2 else rows[:, None]
    content = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    shape = ".reshape(-1, 2)" if rows.ndim == 2 else ""
    return Given(rows, Code(f"np.loadtxt({name!r}, dtype=np.int64){shape}"), {option: name}, {name: content})


def write_script(lines: Sequence[str]) -> str:
    """Return a script with its imports."""
    text = "\n".join(lines)
    head = ["import numpy as np", ""] if "np." in text else []
    for module, names in _IMPORTS.items():
        used = [name for name in names if re.search(rf"(?<![\w.]){name}[.(]", text)]
        head += [f"from {module} import {', '.join(used)}"] if used else []
    return "\n".join([*head, "", text, ""])


def map_lines(
    source: Source, only: Sequence[int] | None, smoothed: Sequence[int] | None, fixed: Given | None
) -> list[str]:
    """Return a script that maps the islands ``only`` again and keeps their fixed vertices; None means all islands.

    The script then smooths the islands ``smoothed``; None means all.
    """
    lines = call_lines("injective_map", repr(source.name), {"fixed": fixed}, only)
    smoothing = {"fixed": fixed, "energy": "blend", "max_iterations": SMOOTHING_STEPS}
    return lines if smoothed == [] else [*lines, *call_lines("polish", "mesh", smoothing, smoothed)]


def outline_lines(
    source: Source, to: str, filled: bool, corners: object, islands: Sequence[int], smoothed: bool
) -> list[str]:
    """Return a script that maps islands to copies of an outline, side by side; it smooths them if ``smoothed``."""
    contours = f"outline({to!r})"
    more = arguments(fixed=Code("fixed"), energy="blend", max_iterations=SMOOTHING_STEPS)
    smoothing = ["    if result.injective:", f"        result = polish(island.V, island.F, result.uv{more})"]
    return [
        f"mesh = atlas.as_seamed_mesh({source.name!r})",
        f"contours = {f'filled({contours})' if filled else contours}",
        "width = np.ptp(np.concatenate(contours)[:, 0])",
        "places = [island.uv for island in mesh.islands]",
        f"for i, k in enumerate({list(islands)}):",
        "    island = mesh.islands[k]",
        "    copy = [contour + np.array([i * 1.05 * width, 0.0]) for contour in contours]",
        f"    fixed, target = boundary_to(island.V, island.F, copy{arguments(corners=corners or None)})",
        "    result = injective_map(island.V, island.F, fixed, target)",
        *(smoothing if smoothed else []),
        "    places[k] = result.uv",
        "mesh = mesh.with_places(places)",
    ]
