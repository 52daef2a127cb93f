"""``qhm animate``: map a mesh to a sequence of targets, and write the frames or an animation.

Map a surface to a sequence of targets, each frame from the one before it. With --polish every frame has little
distortion, and vertices do not jump between frames.

Exit status: 0 every frame is written and certified injective as written; 1 one is not; 2 wrong input or call, nothing
written; 3 written, but the report failed. Ctrl-C writes the frames so far.

    qhm animate face.obj frames/*.obj -o film.gif
    qhm animate face.obj frames/*.obj --polish symmetric-dirichlet -o frames_out/
"""

from __future__ import annotations

import argparse
import re
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import pipeline, report, written_map
from quasiharmonic.ui.cli.arguments import (
    add_options,
    choice,
    count,
    flag,
    number,
    pick,
    set_default,
)
from quasiharmonic.util.options import ENERGIES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.mesh_motion.animation import Animation, FrameStep
    from quasiharmonic.io import MeshData

PICTURES = ".gif", ".mp4"


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    parser.add_argument("input", type=Path, metavar="INPUT", help=f"{format_names('read')} file: the surface")
    parser.add_argument(
        "targets",
        type=Path,
        nargs="+",
        metavar="FRAMES",
        help="targets of the fixed vertices: meshes with the same vertices and a map (vt), in order; or a folder of "
        "them, by name (2 before 10); or a .npy array (frames, vertices, 2), of all vertices or of those that --fixed "
        "lists",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        action="append",
        help="folder to write the frames to as 0000.obj, 0001.obj, …, or a moving picture, .gif or .mp4; repeatable",
    )
    add_options(
        parser,
        "fixed",
        polish=choice(ENERGIES, "lower this distortion energy in every frame"),
        max_motion_ratio=number(
            float,
            "for --polish: maximum vertex motion, relative to the maximum boundary motion (default: 3)",
            metavar="TIMES",
        ),
        fill_gaps=flag("replace frames without a map by the average of the frames around them"),
        frames_per_second=number(count, "frame rate of a moving picture (default: 24)"),
    )
    add_options(parser, "max_iterations", "linear_solver", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, animate, write, read back, certify, report."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.mesh_motion.frame_sequence import animate
    from quasiharmonic.geometry.mesh.topology import boundary_edges
    from quasiharmonic.problem import Problem
    from quasiharmonic.ui.plot.animation import check_animation, save_animation

    set_default(options, "max_motion_ratio", None, asked=options.polish is not None, belongs="--polish")
    drawn = [path for path in options.output if path.suffix.lower() in PICTURES]
    set_default(options, "frames_per_second", 24, asked=bool(drawn), belongs="a moving picture (-o x.gif)")
    targets = _files(options.targets)
    inputs = (options.input, options.fixed, *targets)
    for path in drawn:
        check_animation(path, options.frames_per_second)
    report.check_new({f"-o {path}": path for path in drawn}, options.json, inputs=inputs)
    folders = [_checked_folder(path, inputs) for path in options.output if path not in drawn]
    if len(set(options.output)) < len(options.output):
        raise ValueError("-o: the same output is given twice")
    mesh = io.read_mesh(options.input)
    fixed = None if options.fixed is None else io.read_handles(options.fixed, len(mesh.V))
    if fixed is None:
        with report.name_source(options.input):
            fixed = np.unique(boundary_edges(mesh.F, len(mesh.V)))
    positions = _targets(targets, mesh, fixed)
    with report.name_source(options.input):
        problem = Problem(mesh.V, mesh.F, fixed, positions[0])
    given = pick(options, "polish", "max_motion_ratio", "fill_gaps", "max_iterations", "linear_solver")
    with pipeline.show_work(options.input, _words) as show:
        animation = animate(problem, positions, callback=show, **given)
    if not animation.frames:
        raise KeyboardInterrupt
    written: dict[Path, tuple[bool, list[str]]] = {}
    for folder in folders:
        with report.after_writing(folders[0]) if written else nullcontext():
            written[folder] = _write_frames(folder, mesh, animation)
    for t, path in enumerate(drawn):
        # Errors are `ReportError` only if another output is already written.
        before = [*folders, *drawn[:t]]
        with report.after_writing(before[0]) if before else nullcontext():
            named = ((f"frame {number}", frame.uv) for number, frame in enumerate(animation.frames))
            rate = options.frames_per_second
            save_animation(path, problem.V, problem.F, named, fixed=problem.fixed, frames_per_second=rate)
    missing = len(positions) - len(animation.frames)

    def describe() -> pipeline.Account:
        outputs = [str(path) for path in options.output]
        facts = {**animation.to_dict(), "asked": len(positions), "input": str(options.input), "outputs": outputs}
        lines = [f"wrote {', '.join(outputs)}", animation.summary()]
        if missing:
            lines.append(f"{missing} further frames were requested")
        for folder, (_, others) in written.items():
            if others:
                names = ", ".join(others[:5]) + (", …" if len(others) > 5 else "")
                lines.append(f"not written by this run, but in {folder}: {names}")
        certified = all(every for every, _ in written.values())
        return pipeline.Account(facts, lines, bool(not missing and certified and animation.found.all()))

    return pipeline.finish(options, describe, options.output[0])


def _files(given: list[Path]) -> list[Path]:
    """Return the given files, or the meshes of the given folder."""
    from quasiharmonic import io
    from quasiharmonic.io.registry import suffixes

    if len(given) == 1 and given[0].is_dir():
        # Formats that are written with a map are read with one.
        accepted = suffixes("write_map")
        shown = (path for path in given[0].iterdir() if not path.name.startswith("."))
        found = sorted((path for path in shown if path.suffix.lower() in accepted), key=_in_order)
        if not found:
            raise ValueError(f"{given[0]}: no mesh in this folder ({', '.join(accepted)})")
        return found
    if len(given) == 1 and not given[0].suffix and not given[0].exists():
        raise io.MeshFileError(given[0], "there is no such file or folder")
    if len(given) > 1 and any(path.suffix.lower() == ".npy" for path in given):
        raise ValueError("an .npy array has all frames: give no other file with it")
    return given


def _in_order(path: Path) -> list[str | int]:
    """Return a key that sorts files by name, with numbers by value: frame_2 comes before frame_10."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split("([0-9]+)", path.name))]


def _checked_folder(path: Path, inputs: tuple[Path | None, ...]) -> Path:
    """Return the path if it can be an output folder: writable or new, and without input files."""
    if path.suffix and not path.is_dir():
        raise ValueError(f"-o {path}: give a moving picture ({', '.join(PICTURES)}) or a folder")
    if any(source is not None and source.resolve().parent == path.resolve() for source in inputs):
        raise ValueError(f"-o {path}: choose a folder without input files")
    if path.exists() and not path.is_dir():
        raise ValueError(f"-o {path}: it is not a folder")
    return path


def _targets(files: list[Path], mesh: MeshData, fixed: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the target positions of the fixed vertices in every frame; (t, k, 2)."""
    import numpy as np

    from quasiharmonic import io

    if files[0].suffix.lower() == ".npy":
        return _array(files[0], len(mesh.V), fixed)
    positions = []
    for path in files:
        frame = io.read_mesh(path)
        if len(frame.V) != len(mesh.V):
            raise ValueError(f"{path}: {len(frame.V)} vertices, but the surface has {len(mesh.V)}")
        with report.name_source(path):
            mapped = io.mapped(frame)
        opened = mapped.opened()
        if opened.uv is None or not mapped.seamless:
            raise ValueError(
                f"{path}: its map has seams, which frames do not support: map it without (qhm map --seams none)"
            )
        positions.append(opened.uv[fixed])
    return np.stack(positions)


def _array(path: Path, n: int, fixed: NDArray[np.int64]) -> NDArray[np.float64]:
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.io.errors import report_damage
    from quasiharmonic.io.untrusted import read_npy
    from quasiharmonic.util.arrays import names_of, real_array

    if not path.is_file():
        raise io.MeshFileError(path, "there is no such file")
    with report_damage(path, "not an array of numbers in NumPy's format: "):
        array = read_npy(path)
    shaped = array.ndim == 3 and len(array) > 0 and array.shape[1] in (n, fixed.size) and array.shape[2] == 2
    if not shaped or array.dtype.kind not in "iuf":
        raise ValueError(
            f"{path}: must be real numbers of shape (frames, {n}, 2), or (frames, {fixed.size}, 2) for fixed vertices "
            f"only, not {array.dtype} {array.shape}"
        )
    rows = np.arange(fixed.size) if array.shape[1] == fixed.size else fixed
    positions = real_array(f"{path}: its array", array[:, rows])
    frames, places = np.nonzero(~np.isfinite(positions).all(axis=2))
    if frames.size:
        where = names_of("row", "rows", rows[places[frames == frames[0]]])
        with report.name_source(path):
            raise ValueError(f"frame {frames[0]} is not finite at {where}: give finite numbers")
    return positions


def _write_frames(folder: Path, mesh: MeshData, animation: Animation) -> tuple[bool, list[str]]:
    """Write every frame that has a map.

    Return whether all written files are certified injective, and the frames in the folder that belong to another run.
    """
    from quasiharmonic import io

    certified = True
    digits = max(4, len(str(len(animation.frames) - 1)))
    written: set[str] = set()
    with io.new_folder(folder):
        for t, frame in enumerate(animation.frames):
            if not frame.injective:
                continue
            path = folder / f"{t:0{digits}}.obj"
            with report.after_writing(folder / min(written)) if written else nullcontext():
                io.write_mapped(path, mesh.with_map(frame.uv))
                written.add(path.name)
                certified &= written_map.certify_map(io.read_mesh(path)).injective
    others = {path.name for path in folder.glob("*.obj") if path.stem.isdecimal()} - written
    return certified, sorted(others)


def _words(step: FrameStep) -> str:
    sweep = f", sweep {step.sweep}" if step.sweep else ""
    return f"frame {step.frame + 1} of {step.frames}{sweep}   largest move {step.move:.3g}"
