"""How the problems of a data set are solved, and the key by which a finished one is known again."""

from __future__ import annotations

import json
import os
import stat
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from quasiharmonic import __version__
from quasiharmonic.linsolve import available
from quasiharmonic.ui.batch.problems import ProblemFiles


@dataclass(frozen=True)
class Settings:
    """What decides the result of a problem, beside its files.

    Attributes
    ----------
    to : str or None
        Problems are plain meshes, and their boundaries go to this outline, as `quasiharmonic.targets.outline` reads
        it; its holes are filled for a surface that has none. None where problems say themselves where fixed vertices
        go.
    flatten : bool
        Problems are plain meshes whose boundaries are free: `quasiharmonic.flatten` lays them flat, and what it makes
        must be bijective. Then of what follows only ``cut``, ``max_iterations`` and ``linear_solver`` are read.
    energy : str or None
        What a flattening lowers; see `quasiharmonic.flatten` for the names. ``"symmetric-dirichlet"`` where None.
    cut : bool
        Whether plain meshes, or what of them lies between the seams of their files, are cut along further seams until
        they lie flat.
    corners : str or None
        Which boundary vertices go to the corners of ``to``: ``"auto"``, ``"near:x,y,z,…"``, or whatever else
        `quasiharmonic.targets.boundary.corner_spec.read_corners` reads.
    refine : bool
        Whether edges that leave the target no room are split, which adds vertices at the end.
    strategy : {"speed", "paper"}
    polish : str or None
        Energy to lower once a map is injective; see `quasiharmonic.polish` for the names.
    slide : bool
        Whether boundary vertices glide along the outline meanwhile, its corners held: along the curves of ``to``, or,
        where problems say themselves where the boundary goes, along the polygon that it is.
    reference : {"equilateral", "rest", "corrected"} or None
    max_iterations : int
    linear_solver : str
        All as `quasiharmonic.injective_map` takes them.
    """

    to: str | None = None
    flatten: bool = False
    energy: str | None = None
    cut: bool = False
    corners: str | None = None
    refine: bool = False
    strategy: str = "speed"
    polish: str | None = None
    slide: bool = False
    reference: str | None = None
    max_iterations: int = 2000
    linear_solver: str = "auto"

    @property
    def plain(self) -> bool:
        """Whether problems are plain meshes."""
        return self.flatten or self.to is not None

    @property
    def together(self) -> bool:
        """Whether small problems may be solved several at a time, as `quasiharmonic.ui.batch.batched` does.

        By QDLDL only: what it computes for a mesh does not depend on what lies beside it.
        """
        alone = self.flatten or self.cut or self.refine or self.slide or self.polish is not None
        by_qdldl = self.linear_solver in ("auto", "qdldl") and "qdldl" in available()
        return by_qdldl and not alone and self.reference in (None, "equilateral")

    def key(self, files: ProblemFiles) -> str:
        """Digest of a problem's contents and of how it is solved: a record with the same key need not be made again.

        How it is solved are these settings, the version, and the package's sources, which change without a new version
        while somebody works on them. Other packages do not count.

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
            When a file cannot be read; the message names it.
        """
        digest = blake2b(digest_size=16)
        named = [Path(name) if name is not None and os.path.isfile(name) else None for name in (self.to, self.corners)]
        for path in (files.mesh, files.fixed, *named):
            contents = b"" if path is None else _contents(path)
            digest.update(len(contents).to_bytes(8, "little"))
            digest.update(contents)
        digest.update(json.dumps([__version__, sources_digest(), self.to_dict()], sort_keys=True).encode())
        return digest.hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(vars(self))


def _contents(path: Path) -> bytes:
    """All of a file; a pipe, at which one might wait for ever, is none."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("it is not a regular file")
        return path.read_bytes()
    except OSError as error:
        raise OSError(f"{path}: cannot be read: {error.strerror or error}") from error


@cache
def sources_digest() -> str:
    """Digest of the package's sources, as they were when first asked, but for those that only show what came out."""
    package = Path(__file__).parent.parent
    digest = blake2b(digest_size=16)
    for path in sorted([*package.rglob("*.py"), *package.rglob("*.[ch]")]):
        place = path.relative_to(package).as_posix()
        if not place.startswith(("cli/", "plot/", "report/")):
            contents = path.read_bytes()
            digest.update(f"{place}\0{len(contents)}\0".encode())
            digest.update(contents)
    return digest.hexdigest()


@dataclass(frozen=True)
class Orders:
    """What everyone who works on a run has to know.

    Attributes
    ----------
    output : Path
        Absolute path of the run's folder, the same wherever the work is done.
    settings : Settings
    threads : int
        Threads of the linear solver.
    time_limit : float or None
        Seconds for one problem.
    memory_limit : int or None
        Bytes of resident memory for the process that solves a problem.
    retry : bool
        Whether to try again what failed for other reasons than the input.
    """

    output: Path
    settings: Settings
    threads: int = 1
    time_limit: float | None = None
    memory_limit: int | None = None
    retry: bool = False

    def folder(self, name: str) -> Path:
        """Where the map and the record of a problem are."""
        return self.output / "results" / name
