"""The steps that commands share: read a mesh, work, write, read back, certify, report.

A command that writes a map is one call of `change_map`. Other commands use the last steps, `finish` after they have
written a file and `conclude` if they write none. `certify_map` certifies a map as a reader gets it from a file.

If they read a mesh, it gets the texture that ``--texture`` adds to the written surface.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import process, report
from quasiharmonic.util.outcome import as_plain

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict
    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.apps.unwrapping.chart_verdict import SetApart
    from quasiharmonic.geometry.exact.certificate import Certificate
    from quasiharmonic.io import MeshData

# The value of --texture that needs no file.
CHECKERBOARD = "checkerboard"


@dataclass(frozen=True, eq=False)
class WrittenMap:
    """Exact certificate of a file's map."""

    V: NDArray[np.float64]  # (m, 3)
    F: NDArray[np.int64]  # (f, 3)
    uv: NDArray[np.float64]  # (m, 2): the mesh and its map, cut at seams: one vertex per texture coordinate of a vertex
    certificate: Certificate  # Certificate of the whole map in the plane
    verdict: AtlasVerdict | None  # Certificates of the islands; None for a single island
    faces: int  # Number of faces in the file
    bent: NDArray[np.int64]  # Faces with inverted triangles for a reader that splits faces at their first corner
    set_apart: SetApart | None = None  # Triangles that the verdict reverses or leaves out; None if there are none

    @property
    def injective(self) -> bool:
        """Whether every island is injective, possibly mirrored."""
        return self.certificate.injective if self.verdict is None else self.verdict.injective

    @property
    def bijective(self) -> bool:
        """Whether every island is bijective."""
        return bool(self.certificate.bijective) if self.verdict is None else self.verdict.bijective

    @property
    def apart(self) -> bool:
        """Whether every island is bijective, and no two islands overlap."""
        return self.bijective and (self.verdict is None or not len(self.verdict.overlapping))

    @property
    def mirrored(self) -> bool:
        """Whether an island is mirrored."""
        return self.verdict is not None and bool(self.verdict.mirrored.size)

    @property
    def inverted(self) -> NDArray[np.int64]:
        """Triangles whose orientation differs from that of their island, and degenerate triangles."""
        import numpy as np

        if self.verdict is not None:
            return self.verdict.inverted
        return np.concatenate([self.certificate.inverted, self.certificate.degenerate])

    def summary(self) -> str:
        """Return the verdict in sentences."""
        text = self.certificate.summary() if self.verdict is None else self.verdict.summary()
        if self.faces < len(self.F):
            text += f"\nThe verdict is on the {len(self.F)} triangles that stand for its {self.faces} faces."
        if self.bent.size:
            text += f"\n{describe_bent(self.bent)}"
        return text if self.set_apart is None else f"{text}\n{self.set_apart.summary()}"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as the first entries of the JSON report."""
        apart = {} if self.verdict is None else {k: self.verdict.to_dict()[k] for k in ("islands", "overlapping")}
        return {
            **as_plain(self, "injective", "bijective"),
            **as_plain(self.certificate, "inverted", "degenerate"),
            **as_plain(self, "faces", "certificate"),
            **({"verdict": apart} if apart else {}),
            "bent_faces": self.bent.tolist(),
            **({} if self.set_apart is None else self.set_apart.to_dict()),
        }


def certify_map(mesh: MeshData, *, precision: str = "float64", weld: bool | float = False) -> WrittenMap:
    """Certify the map of a file, optionally rounded to ``precision`` "float32".

    ``weld`` is as in `SeamedMesh.weld`: vertices are welded where they are at one position in the plane.
    """
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.atlas.atlas_verdict import certify as certify_islands
    from quasiharmonic.geometry.exact.certificate import certify
    from quasiharmonic.geometry.mesh.topology import components
    from quasiharmonic.io.seamed_mesh import SeamedMesh

    joined = io.mapped(mesh).weld(weld)
    opened = joined.opened()
    V, F, uv = opened.V, opened.F, opened.uv
    assert uv is not None
    if precision == "float32":
        with np.errstate(over="ignore"):
            uv = uv.astype(np.float32).astype(np.float64)
    # The components of the mesh cut at its seams are the islands.
    part = components(F, len(V))[F[:, 0]]
    alone = bool((part == part[:1]).all())
    verdict = None if alone else certify_islands(SeamedMesh(V, F, F, uv))
    found = WrittenMap(V, F, uv, certify(F, uv), verdict, mesh.faces, find_bent(mesh, F, uv))
    if found.certificate.injective or mesh.vt is None:
        return found
    from quasiharmonic.apps.unwrapping.chart_verdict import certify_defective

    charts = certify_defective(mesh.V, joined.F, uv[F])
    return found if charts is None else replace(found, verdict=charts[0], set_apart=charts[1])


def find_bent(mesh: MeshData, F: NDArray[np.int64], uv: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the faces that get inverted triangles if a reader splits them at their first corner."""
    import numpy as np

    from quasiharmonic.geometry.exact.triangles import find_inverted_fans

    return np.empty(0, dtype=np.int64) if mesh.polygons is None else find_inverted_fans(mesh.polygons, F, uv)


def describe_bent(bent: NDArray[np.int64]) -> str:
    """Return a sentence on the faces of `find_bent`."""
    from quasiharmonic.util.arrays import names_of

    where = names_of("face", "faces", bent)
    return (
        f"A reader that splits faces at their first corner gets inverted triangles in {where}. "
        "qhm check --any-triangulation lists all faces that are not convex."
    )


def add_bent(facts: dict[str, Any], lines: list[str], mesh: MeshData) -> None:
    """Add the faces of `find_bent` of a mesh with texture coordinates to a report."""
    assert mesh.FT is not None
    assert mesh.vt is not None
    bent = find_bent(mesh, mesh.FT, mesh.vt)
    facts["bent_faces"] = bent.tolist()
    if bent.size:
        lines.append(describe_bent(bent))


def add_old_textures(facts: dict[str, Any], lines: list[str], before: MeshData, after: MeshData) -> None:
    """Add the names of the file's textures to a report if the texture coordinates changed, so that these do not fit."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.io.errors import printable_path

    if after.texture is not None or after.lower_maps or not (named := io.texture_names(before)):
        return
    if np.array_equal(before.corner_uv, after.corner_uv, equal_nan=True):
        return
    facts["old_textures"] = named
    names = ", ".join(map(printable_path, named))
    lines.append(f"the new coordinates do not fit the textures of the file: {names}")


def tell_losses(output: Path, mesh: MeshData) -> None:
    """Report on standard error which data of a mesh the output format cannot store."""
    from quasiharmonic import io

    if lost := io.not_held(output, mesh):
        process.tell(f"{output} will not have: {'; '.join(lost)}")


def describe_maps(mapped: MappedAtlas, written: WrittenMap, output: Path) -> str:
    """Return the text report of a map that was computed and written."""
    from quasiharmonic.problem.result import Status
    from quasiharmonic.util.arrays import count_of

    lines = [f"wrote {output}: {written.summary()}"]
    results = [island.result for island in mapped.islands]
    if not written.injective:
        lines.append(mapped.message)
    # Each surface may be injective although pins make an overlap between surfaces unavoidable.
    if not written.injective or mapped.status is Status.IMPOSSIBLE:
        lines += [r.diagnosis.summary() for r in results if r.diagnosis is not None and r.diagnosis.obstructions][:3]
    iterations = sum(result.n_iterations for result in results)
    seconds = sum(result.seconds for result in results)
    lines.append(f"{count_of('iteration', 'iterations', iterations)}, {seconds:.3g} s, {results[0].linear_solver}")
    return "\n".join(lines)


def describe_end(mapped: MappedAtlas, written: WrittenMap) -> list[str]:
    """Return the message of an injective map for the text report, where `describe_maps` does not imply it."""
    from quasiharmonic.problem.result import Status

    ended_early = mapped.status in (Status.INTERRUPTED, Status.TIME_LIMIT)
    # The other messages say that every triangle is positive, which is not true of mirrored islands.
    if not written.injective or mapped.status is Status.INJECTIVE or (written.mirrored and not ended_early):
        return []
    return [mapped.message]


@dataclass
class Account:
    """What a command reports."""

    facts: dict[str, Any]  # Entries of the JSON report
    lines: list[str]  # Lines of the text report
    good: bool = True  # Whether the exit status is 0, not 1
    closing: list[str] = field(default_factory=list)  # Lines after the one about the textures of the file


@dataclass
class Changed:
    """A mesh with a new map, to be written."""

    mesh: MeshData
    describe: Callable[[MeshData], Account]  # Called with the mesh as a reader gets it from the written file


def read_mesh(options: argparse.Namespace, path: Path) -> MeshData:
    """Read a mesh and attach the texture that the options request.

    ValueError or OSError if the output format has no textures, a companion file cannot be written, or the image is
    missing or invalid.
    """
    from dataclasses import replace

    from quasiharmonic import io

    if options.texture is None:
        return io.read_mesh(path)
    companions = io.find_format(options.output, "write_map", "image").companions
    texture = io.checkerboard() if options.texture == CHECKERBOARD else io.read_texture(options.texture)
    if companions is not None:
        _check_companions(options, companions(options.output, texture))
    return replace(io.read_mesh(path), texture=texture)


def check_image_output(options: argparse.Namespace) -> None:
    """Check that the output can have baked textures, and that their files would replace no other file.

    ValueError or OSError as `read_mesh`.
    """
    from quasiharmonic import io

    companions = io.find_format(options.output, "write_map", "image").companions
    if companions is not None:
        for kind in ("image/png", ".png"), ("image/jpeg", ".jpg"):
            _check_companions(options, companions(options.output, io.Texture(b"", *kind)))


def _check_companions(options: argparse.Namespace, companions: tuple[Path, ...]) -> None:
    """Raise ValueError if a companion file of the output would replace an input or another output."""
    from quasiharmonic import io

    taken = (getattr(options, name, None) for name in ("input", "new", "texture", "plot", "json"))
    named = {Path(str(path)).resolve() for path in taken if path is not None}
    for path in companions:
        io.check_writable(path)
        if path.resolve() in named:
            raise ValueError(f"{path}, which goes with {options.output}, would replace another file: change -o")


@contextmanager
def show_work(source: Path, words: Callable[[Any], str] = process.describe_step) -> Iterator[Any]:
    """Show progress during the block, and name the source in its errors; yield a callback, or None."""
    with report.name_source(source), process.progress_line(words) as show:
        yield show


def change_map(
    options: argparse.Namespace,
    change: Callable[[MeshData], Changed],
    *,
    source: Path | None = None,
    inputs: Sequence[Path | None] = (),
    read: Callable[[argparse.Namespace, Path], MeshData] = read_mesh,
) -> int:
    """Read a mesh, change its map, write it, read it back, report; return the exit status.

    ``source`` is the file of the mesh, by default ``options.input``. ``inputs`` are further files that outputs must not
    replace.
    """
    from quasiharmonic import io

    source = options.input if source is None else source
    report.check_outputs(options, (source, *inputs))
    mesh = read(options, source)
    changed = change(mesh)
    tell_losses(options.output, changed.mesh)
    io.write_mapped(options.output, changed.mesh)

    def describe() -> Account:
        account = changed.describe(io.read_written(options.output, changed.mesh))
        account.facts |= name_files(options)
        add_old_textures(account.facts, account.lines, mesh, changed.mesh)
        return account

    return finish(options, describe, options.output)


def name_files(options: argparse.Namespace) -> dict[str, str]:
    """Return input and output as entries of the JSON report."""
    return {"input": str(options.input), "output": str(options.output)}


def finish(options: argparse.Namespace, describe: Callable[[], Account], written: Path) -> int:
    """Report what a command has written, and return the exit status; `ReportError` if the report fails.

    ``written`` is a file that is written.
    """
    with report.after_writing(written):
        account = describe()
        report.emit(account.facts, options.json, "\n".join([*account.lines, *account.closing]))
    return 0 if account.good else 1


def conclude(options: argparse.Namespace, account: Account, written: Path | None = None) -> int:
    """Report what a command has found, and return the exit status; ``written`` is the file that it has written, if any.

    BrokenPipeError when no file is written, standard output is closed and ``--json`` names no file, so that nobody can
    read the report.
    """
    if written is not None:
        return finish(options, lambda: account, written)
    if options.json is None:
        process.require_output()
    report.emit(account.facts, options.json, "\n".join(account.lines))
    return 0 if account.good else 1
