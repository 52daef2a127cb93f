"""Commands and Python scripts that reproduce the map of a page from the file, or from a start that the page saves."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
from quasiharmonic.io import MeshData
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.problem.result import Step
from quasiharmonic.util.arrays import IntArray

#: Names of the files that the page saves: the map, the map from which the last step started, the fixed vertices, the
#: seams that the user drew, the edges that must not become seams, the triangles to unwrap.
MAP, START, FIXED, SEAMS, FORBIDDEN, FACES = (
    *("map.obj", "start.obj", "fixed.txt", "seams.txt", "no_seams.txt", "faces.txt"),
)


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
    note: str = ""  # What the call could not do

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


@dataclass(frozen=True, eq=False)
class Code:
    """An expression of a script. Its attributes, indices and calls are expressions, too."""

    _text: str
    _imports: frozenset[tuple[str, str]] = frozenset()  # Modules, and the name that is imported from each

    def __getattr__(self, name: str) -> Code:
        if name.startswith("_"):
            raise AttributeError(name)
        return Code(f"{self._text}.{name}", self._imports)

    def __getitem__(self, key: Any) -> Code:
        index = _expression(key)
        return Code(f"{self._text}[{index._text}]", self._imports | index._imports)

    def __call__(self, *arguments: Any, **options: Any) -> Code:
        """Return a call; options that are None or False are left out."""
        chosen = {name: value for name, value in options.items() if value is not None and value is not False}
        parts = [("", _expression(value)) for value in arguments]
        parts += [(f"{name}=", _expression(value)) for name, value in chosen.items()]
        text = ", ".join(name + one._text for name, one in parts)
        return Code(f"{self._text}({text})", self._imports.union(*(one._imports for _, one in parts)))


def public(thing: Callable[..., Any]) -> Code:
    """Return a function or a class of the library or of NumPy by its public name."""
    name = thing.__name__
    for module in ("quasiharmonic", "quasiharmonic.targets"):
        if getattr(import_module(module), name, None) is thing:
            return Code(name, frozenset({(module, name)}))
    for group in ("atlas", "io"):
        if getattr(import_module(f"quasiharmonic.{group}"), name, None) is thing:
            return Code(f"{group}.{name}", frozenset({("quasiharmonic", group)}))
    if thing.__module__ == "numpy":
        return Code(f"np.{name}", frozenset({("numpy", "np")}))
    return Code(name, frozenset({(thing.__module__, name)}))


def _expression(value: Any) -> Code:
    if isinstance(value, Given):
        value = value.code
    if isinstance(value, Code):
        return value
    return public(value) if callable(value) else Code(repr(value))


class Script:
    """Lines that each assign the result of a call to a variable; ``str`` of it has the imports, too."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._imports: set[tuple[str, str]] = set()

    def let(self, name: str, value: Code) -> Code:
        """Append an assignment and return the variable."""
        self._lines.append(f"{name} = {value._text}")
        self._imports |= value._imports
        return Code(name)

    def __str__(self) -> str:
        """Return the text of the script."""
        modules = sorted({module for module, _ in self._imports} - {"numpy"}, key=lambda one: (one.count("."), one))
        head = ["import numpy as np", ""] if ("numpy", "np") in self._imports else []
        for module in modules:
            names = sorted(name for whose, name in self._imports if whose == module)
            head.append(f"from {module} import {', '.join(names)}")
        return "\n".join([*head, "", *self._lines, ""])


@dataclass(frozen=True, eq=False)
class Given:
    """Value of an argument, and how command and script spell it."""

    value: Any
    code: Any  # An expression or a constant
    words: Mapping[str, object] = field(default_factory=dict)  # Options of the command
    texts: Mapping[str, bytes] = field(default_factory=dict)  # Files that command and script read


def values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments themselves."""
    return {name: value.value if isinstance(value, Given) else value for name, value in options.items()}


def record_call(
    verb: str,
    source: Source,
    output: str,
    options: Mapping[str, Any],
    script: Script,
    only: Sequence[int] | None = None,
    words: Sequence[str] = (),
) -> Recipe:
    """Return the recipe of a call for some islands: a script, and the command ``verb`` with the same options.

    ``words`` are further words of the command.
    """
    given = [value for value in options.values() if isinstance(value, Given)]
    plain = {name: value for name, value in options.items() if not isinstance(value, Given)}
    chosen = {name: value for one in given for name, value in one.words.items()}
    chosen["islands"] = None if only is None else ",".join(map(str, only))
    command = ["qhm", verb, source.command, *words, *option_words(**plain, **chosen)]
    # The file that a step starts from is not overwritten.
    command += ["-o", output if source.name != output else f"new_{output}"]
    texts = {name: content for one in given for name, content in one.texts.items()}
    return Recipe(shlex.join(command), str(script), source.start, texts)


def perform(
    function: Callable[..., MappedAtlas],
    mesh: SeamedMesh,
    source: Source,
    output: str,
    options: Mapping[str, Any],
    only: Sequence[int] | None,
    callback: Callable[[Step], object] | None,
) -> tuple[MappedAtlas, Recipe]:
    """Call a function of `atlas` for some islands; return its result, and the recipe of the call on ``source``."""
    script = Script()
    script.let("mesh", public(function)(source.name, **options, islands=only).mesh)
    recipe = record_call(function.__name__, source, output, options, script, only)
    return function(mesh, islands=only, callback=callback, **values(options)), recipe


def saved_rows(name: str, option: str, rows: IntArray) -> Given:
    """Return whole numbers, (k,) or (k, 2), as the argument ``option``, from a file that the page saves."""
    table = rows if rows.ndim == 2 else rows[:, None]
    content = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    code = public(np.loadtxt)(name, dtype=np.int64)
    return Given(rows, code.reshape(-1, 2) if rows.ndim == 2 else code.reshape(-1), {option: name}, {name: content})
