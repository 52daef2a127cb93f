"""Settings of a batch run, and the key that identifies a finished problem."""

from __future__ import annotations

import json
import os
import stat
from dataclasses import dataclass, fields
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from quasiharmonic import __version__
from quasiharmonic.geometry.curves.boundary_curves import check_corner_angle
from quasiharmonic.linsolve import available
from quasiharmonic.solver.search.stages import Stages, select_strategy
from quasiharmonic.ui.batch.problems import ProblemFiles
from quasiharmonic.ui.batch.records import map_path
from quasiharmonic.util.arrays import check_choice, describe
from quasiharmonic.util.options import (
    ENERGIES,
    FLATTENED,
    MAP_FORMATS,
    MAX_ITERATIONS,
    REFERENCES,
    STRATEGIES,
    DescentOptions,
    Options,
    UnwrapOptions,
    one_of,
    option,
    positive,
    seconds,
    switch,
)

# The settings of a single descent.
_DESCENT = tuple(one.name for one in fields(DescentOptions))
#: The settings that may name files.
NAMING_FILES = "to", "font", "corners", "pieces"


def search_stages(settings: dict[str, Any]) -> str | Stages:
    """Return the strategy of settings, or the single descent in its place."""
    return select_strategy(settings["strategy"], **{name: settings[name] for name in _DESCENT})


def _text(name: str, value: Any) -> None:
    """Check a text or None."""
    if not isinstance(value, str | None):
        raise ValueError(f"{name} must be a text or None, not {describe(value)}")


def _unwrap_options(name: str, value: Any) -> None:
    """Check the options of `quasiharmonic.unwrap` for models from files, or None."""
    if value is None:
        return
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be a dict of options of unwrap or None, not {describe(value)}")
    for unusable in ("callback", "edge_costs", "uv", "jobs"):
        if unusable in value:
            raise ValueError(f"{name} cannot have the option {unusable}: omit it")
    # Import on demand: other runs need no charts.
    from quasiharmonic.apps.unwrapping.placing import check_placing

    check_placing(UnwrapOptions(**value))


@dataclass(frozen=True)
class Settings(DescentOptions):
    """Settings that determine the result of a problem, together with its files.

    Attributes
    ----------
    to : str or None
        If given, problems are plain meshes, and their boundaries are mapped to this outline, as
        `quasiharmonic.targets.outline` reads it. The outline's holes are filled for a surface without holes. If None,
        the problems contain the target positions of their fixed vertices.
    font : str or None
        Font of letters and words in ``to``: a file or a name.
    corner_angle : float
        Turning angle in degrees from which a point of ``to`` is a corner.
    flatten : bool
        If True, problems are plain meshes with free boundaries. `quasiharmonic.flatten` maps them, and the result must
        be bijective. Of the following settings only ``energy``, ``start``, ``pack``, ``cut``, ``max_iterations``
        and ``linear_solver`` apply.
    energy : str or None
        Energy of a flattening; see `quasiharmonic.flatten` for the names. None means ``"symmetric-dirichlet"``.
    start : bool
        Whether a flattening starts from the map in the texture coordinates of the file.
    pack : bool
        Whether the islands of a plain mesh are packed into the unit square; see `quasiharmonic.atlas.pack`.
    cut : bool
        Whether plain meshes, or the islands between the seams of their files, are cut along further seams so that they
        can be mapped.
    corners : str or None
        The boundary vertices that go to the corners of ``to``: ``"auto"``, ``"near:x,y,z,…"``, or any other form that
        `quasiharmonic.targets.boundary.corner_pins.read_corners` reads.
    refine : bool
        Whether edges may be split if no map is found quickly without; new vertices are appended.
    strategy : {"speed", "paper"}
    functional, parameterisation : str or None
    iterations : int or None
        If one is given, the search is a single descent, `quasiharmonic.methods.VectorAdam` with these.
    polish : str or None
        Energy to lower once a map is injective; see `quasiharmonic.polish` for the names.
    slide : bool
        Whether boundary vertices slide during the polish, with fixed corners. They slide along the curves of ``to``, or
        along the polygon of their target positions if ``to`` is None.
    pieces : str or None
        File that assigns sliding boundary vertices to sides of ``to``, as for ``qhm map --pieces``.
    reference : {"equilateral", "rest", "corrected"} or None
    max_iterations : int
    linear_solver : str
        As for `quasiharmonic.injective_map`, like ``strategy``, ``reference`` and ``max_iterations``.

    unwrap : dict or None
        If given, problems are models of any kind, and `quasiharmonic.unwrap` computes their texture coordinates with
        these options, such as ``{"max_stretch": 1.2}``. Of the other settings only ``map_format`` applies.
    map_format : {"obj", "ply"}
        Format of the maps. Binary PLY files are read and written faster.

    Raises
    ------
    ValueError
        If a setting has an invalid value, or two settings contradict each other.
    """

    to: str | None = option(None, check=_text)
    font: str | None = option(None, check=_text)
    corner_angle: float = option(20.0, check=lambda _, angle: check_corner_angle(angle))
    flatten: bool = option(False, check=switch)
    energy: str | None = option(None, check=one_of(None, *FLATTENED))
    start: bool = option(False, check=switch)
    pack: bool = option(False, check=switch)
    cut: bool = option(False, check=switch)
    corners: str | None = option(None, check=_text)
    refine: bool = option(False, check=switch)
    strategy: str = option("speed", check=one_of(*STRATEGIES))
    polish: str | None = option(None, check=one_of(None, *ENERGIES))
    slide: bool = option(False, check=switch)
    pieces: str | None = option(None, check=_text)
    reference: str | None = option(None, check=one_of(None, *REFERENCES))
    max_iterations: int = option(MAX_ITERATIONS, check=positive)
    linear_solver: str = option("auto", check=lambda name, value: check_choice(name, value, ("auto", *available())))

    unwrap: dict[str, Any] | None = option(None, check=_unwrap_options)
    map_format: str = option(MAP_FORMATS[0], check=one_of(*MAP_FORMATS))

    def __post_init__(self) -> None:
        """Check the values, without reading files."""
        super().__post_init__()
        self._check_combination()

    def _check_combination(self) -> None:
        """Raise ValueError if a setting has no effect with the others."""
        changed = {one.name for one in fields(self) if getattr(self, one.name) != one.default} - {"map_format"}
        if self.unwrap is not None:
            others = [one.name for one in fields(self) if one.name in changed and one.name != "unwrap"]
            if others:
                raise ValueError(f"{others[0]} does not apply to unwrap: omit one of them")
        if self.flatten:
            for name in ("to", "corners", "refine", "strategy", *_DESCENT, "polish", "slide", "reference"):
                if name in changed:
                    raise ValueError(
                        f"{name} needs a given boundary, but flatten leaves the boundary free: omit one of them"
                    )
        elif self.energy is not None:
            raise ValueError("energy applies only to flatten: set flatten, or give an energy by polish")
        if self.start and (not self.flatten or self.cut):
            raise ValueError("start applies only to flatten, and new seams discard the file's map: omit start, or cut")
        search_stages(vars(self))
        if self.slide and self.polish is None:
            raise ValueError("the boundary slides only while distortion is lowered: give an energy as well, by polish")
        if self.to is None:
            for name in ("cut", "pack", "corners", "corner_angle", "font", "pieces"):
                if name in changed and not (name in ("cut", "pack") and self.flatten):
                    raise ValueError(f"{name} applies only to plain meshes with an outline: give the outline by to")
        elif self.pieces is not None and not self.slide:
            raise ValueError("pieces assigns vertices to sides of the outline: set slide as well")

    @property
    def plain(self) -> bool:
        """Whether problems are plain meshes."""
        return self.flatten or self.unwrap is not None or self.to is not None

    @property
    def together(self) -> bool:
        """Whether small problems may be solved in groups by `quasiharmonic.ui.batch.groups`.

        This requires QDLDL, whose result for a mesh does not depend on the other meshes of the group.
        """
        alone = self.flatten or self.pack or self.cut or self.refine or self.slide
        alone = alone or self.unwrap is not None or self.polish is not None
        by_qdldl = self.linear_solver in ("auto", "qdldl") and "qdldl" in available()
        return by_qdldl and not alone and self.reference in (None, "equilateral")

    def key(self, files: ProblemFiles) -> str:
        """Return a digest of a problem's contents, these settings, the version, and the package's sources.

        A record with the same key is still valid. The sources count because they may change without a new version
        during development. Other packages do not count.

        Parameters
        ----------
        files : ProblemFiles

        Returns
        -------
        str
            Hexadecimal.

        Raises
        ------
        OSError
            If a file cannot be read; the message names it.
        """
        return self.key_of(*(b"" if path is None else _contents(path) for path in (files.mesh, files.fixed)))

    def key_of(self, mesh: bytes, fixed: bytes) -> str:
        """Return the `key` of a problem whose files have these contents."""
        digest = blake2b(digest_size=16)
        names = (getattr(self, setting) for setting in NAMING_FILES)
        named = [_contents(Path(name)) if name is not None and os.path.isfile(name) else b"" for name in names]
        for contents in (mesh, fixed, *named):
            digest.update(len(contents).to_bytes(8, "little"))
            digest.update(contents)
        digest.update(json.dumps([__version__, sources_digest(), self.to_dict()], sort_keys=True).encode())
        return digest.hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as a dict for JSON."""
        return dict(vars(self))


def _contents(path: Path) -> bytes:
    """Return the contents of a regular file; pipes are rejected because reading them could block forever."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("it is not a regular file")
        return path.read_bytes()
    except OSError as error:
        raise OSError(f"{path}: cannot be read: {error.strerror or error}") from error


_PRESENTATION = "ui/cli/", "ui/plot/", "ui/report/"


def sources() -> list[tuple[str, Path]]:
    """Return names and paths of the library's source files, without those that only present results."""
    package = Path(__file__).parents[2]
    files = sorted([*package.rglob("*.py"), *package.rglob("*.[ch]")])
    named = [(path.relative_to(package).as_posix(), path) for path in files]
    return [(name, path) for name, path in named if not name.startswith(_PRESENTATION)]


@cache
def sources_digest() -> str:
    """Return a digest of `sources`; computed once per process."""
    digest = blake2b(digest_size=16)
    for name, path in sources():
        contents = path.read_bytes()
        digest.update(f"{name}\0{len(contents)}\0".encode())
        digest.update(contents)
    return digest.hexdigest()


@dataclass(frozen=True)
class Orders(Options):
    """Parameters of a run that all its workers need."""

    output: Path  # Absolute path of the run's folder, the same on all machines
    settings: Settings
    threads: int = option(1, check=positive)  # Threads of the linear solver
    time_limit: float | None = option(None, check=seconds)  # Seconds of wall time per problem
    memory_limit: int | None = option(None, check=seconds)  # Bytes of resident memory of the process for a problem
    retry: bool = option(False, check=switch)  # Whether to retry failures that the input did not cause

    def folder(self, files: ProblemFiles) -> Path:
        """Return the folder of a problem's map and record."""
        return files.results or self.output / "results" / files.name

    def map_path(self, folder: Path) -> Path:
        """Return the path of a problem's map in the folder of its results."""
        return map_path(folder, self.settings.map_format)
