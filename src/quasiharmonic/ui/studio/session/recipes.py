"""Commands and Python scripts that reproduce the map of a page from the file, or from a start that the page saves."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

from quasiharmonic.energies.polishing import SMOOTHING_STEPS
from quasiharmonic.io import MeshData

#: Names of the files that the page saves: the map, the map from which the last step started, the fixed vertices, the
#: seams that the user drew.
MAP, START, FIXED, SEAMS = "map.obj", "start.obj", "fixed.txt", "seams.txt"
#: Number of steps of `polish` as a step of its own.
POLISHING_STEPS = 200


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


def write_command(words: Sequence[str], output: str, source: Source) -> str:
    """Return a command line that writes ``output``, or another name if the input has this one."""
    return shlex.join(["qhm", *words, "-o", output if source.name != output else f"new_{output}"])


def option_words(**options: object) -> list[str]:
    """Return the words of options; None and False are left out."""
    words = []
    for name, value in options.items():
        if value is None or value is False:
            continue
        words.append(f"--{name.replace('_', '-')}")
        words += [] if value is True else [str(value)]
    return words


def island_words(only: Sequence[int] | None) -> list[str]:
    """Return the option that chooses islands."""
    return [] if only is None else ["--islands", ",".join(map(str, only))]


def arguments(**options: object) -> str:
    """Return further arguments of a Python call; None and False are left out."""
    return "".join(
        f", {name}={value if isinstance(value, Code) else repr(value)}"
        for name, value in options.items()
        if value is not None and value is not False
    )


class Code(str):
    """Python code, as opposed to a text."""

    __slots__ = ()


def write_script(lines: Sequence[str], *, names: Sequence[str] = (), modules: Sequence[str] = ()) -> str:
    """Return a script with its imports: ``names`` of the library, and further ``modules`` lines."""
    text = "\n".join(lines)
    head = ["import numpy as np", ""] if "np." in text else []
    head += [f"from quasiharmonic import {', '.join(sorted(set(names)))}"]
    return "\n".join([*head, *modules, "", text, ""])


def map_script(source: Source, only: Sequence[int] | None, smoothed: Sequence[int] | None, fixed: str | None) -> str:
    """Return a script that maps the islands ``only`` again and keeps their fixed vertices; None means all islands.

    The script then smooths the islands ``smoothed``; None means all.
    """
    read = read_indices(fixed)
    lines = [f"result = atlas.injective_map({source.name!r}{arguments(fixed=read, islands=only)})"]
    if smoothed is None or len(smoothed):
        more = arguments(fixed=read, islands=smoothed, energy="blend", max_iterations=SMOOTHING_STEPS)
        lines.append(f"result = atlas.polish(result.mesh{more})")
    return write_script([*lines, "mesh = result.mesh"], names=["atlas"])


def outline_script(
    source: Source, to: str, filled: bool, corners: object, islands: Sequence[int], smoothed: bool, checked: bool
) -> str:
    """Return a script that maps islands to an outline; several of them to copies side by side.

    ``smoothed`` if it smooths the maps, and ``checked`` if only those without inverted triangles.
    """
    contours = f"outline({to!r})"
    lines = [
        f"mesh = atlas.as_seamed_mesh({source.name!r})",
        f"contours = {f'filled({contours})' if filled else contours}",
        "places = [island.uv for island in mesh.islands]",
    ]
    if len(islands) > 1:
        lines += [
            "width = (1 + 0.05) * np.ptp(np.concatenate(contours)[:, 0])",
            f"for i, k in enumerate({list(islands)}):",
            "    island = mesh.islands[k]",
            "    copy = [contour + np.array([i * width, 0.0]) for contour in contours]",
        ]
    else:
        lines += [f"for k in {list(islands)}:", "    island = mesh.islands[k]", "    copy = contours"]
    lines += [
        f"    fixed, target = boundary_to(island.V, island.F, copy{arguments(corners=corners or None)})",
        "    result = injective_map(island.V, island.F, fixed, target)",
    ]
    if smoothed:
        more = arguments(fixed=Code("fixed"), energy="blend", max_iterations=SMOOTHING_STEPS)
        lines += ["    if result.injective:"] if checked else []
        indent = "        " if checked else "    "
        lines.append(f"{indent}result = polish(island.V, island.F, result.uv{more})")
    lines += ["    places[k] = result.uv", "mesh = mesh.with_places(places)"]
    used = [name for name in ("boundary_to", "filled", "outline") if any(f"{name}(" in line for line in lines)]
    names = ["atlas", "injective_map", *(["polish"] if smoothed else [])]
    return write_script(lines, names=names, modules=[f"from quasiharmonic.targets import {', '.join(used)}"])


def read_indices(name: str | None) -> Code | None:
    """Return the code that reads a list of vertices."""
    return None if name is None else Code(f"np.loadtxt({name!r}, dtype=np.int64)")
