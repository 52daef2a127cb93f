"""Run the command on thousands of damaged files; each must be rejected properly or give a correct result.

    python benchmarks/damaged_files.py -n 2000
    python benchmarks/damaged_files.py --case mesh.ply:41 --keep FOLDER

Files of every kind that the command reads are truncated, spliced, repeated, and have numbers and bytes replaced. A
*failure* is any of: an exit status other than 0, 1 or 2; excessive time or memory; a traceback, a warning or a crash; a
rejection that does not name the program or leaves files behind; status 0 with a map that is not injective when read
again, verified in rational arithmetic. Each file is tried in its own process. Requires a system with fork.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from functools import cache
from io import FileIO, TextIOWrapper
from pathlib import Path
from typing import NamedTuple

import numpy as np

import quasiharmonic
from quasiharmonic.geometry.mesh.elements import covering_triangles
from quasiharmonic.io import MeshData, read_mesh, write_map
from quasiharmonic.io.fem.files import read_fem
from quasiharmonic.linsolve import make_solver
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main as qhm
from quasiharmonic.util.arrays import FloatArray, IntArray

SECONDS, GIGABYTES = 150.0, 1.5

# Calls for each kind of file: {} stands for its name, and the output is named "out".
CALLS: dict[str, list[str]] = {
    "mesh.obj": ["check {}", "map {} -o out.obj", "map {} --to star:5 --refine -o out.ply", "flatten {} -o out.obj"],
    "mesh.off": ["check {}", "flatten {} -o out.off"],
    "mesh.ply": ["check {}", "map {} --to disk -o out.ply", "flatten {} -o out.glb"],
    "text.ply": ["flatten {} -o out.ply"],
    "mesh.glb": ["check {}", "flatten {} -o out.glb"],
    "mesh.gltf": ["check {}", "flatten {} -o out.gltf"],
    "mesh.stl": ["check --boundary {}", "flatten {} -o out.obj"],
    "text.stl": ["map {} --to disk -o out.obj"],
    "plane.vtu": ["morph {} --positions moved.csv -o out.vtu"],
    "text.vtu": ["morph {} --positions moved.csv -o out.vtu"],
    "plane.vtk": ["morph {} --positions moved.csv -o out.vtk"],
    "plane.msh": ["morph {} --positions moved.csv -o out.msh"],
    "moved.csv": ["morph plane.vtu --positions {} -o out.vtu"],
    "outline.svg": ["map mesh.obj --to {} -o out.obj"],
    "outline.txt": ["map mesh.obj --to {} -o out.obj"],
    "handles.txt": ["map mesh.obj --fixed {} -o out.obj", "flatten mesh.obj --fixed {} -o out.obj"],
    "corners.txt": ["map mesh.obj --to rect:2x1 --corners {} -o out.obj"],
    "edges.txt": ["flatten mesh.obj --seams {} -o out.obj"],
    "weights.txt": ["flatten mesh.obj --weights {} -o out.obj"],
    "list.txt": ["batch {} -o out -j 1"],
}

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")
_NUMBERS = (
    b"-1",
    b"0",
    b"1e999",
    b"nan",
    b"-inf",
    b"2147483648",
    b"9" * 20,
    b"9" * 4000,
    b"9" * 5000,
    b"1e-320",
    b"1e300",
    b"",
    b"x",
    b"1",
    b"2",
    b"3.5",
)
_BYTES = (b"\0", b"\n", b"\r", b"/", b"\\\n", b"#", b"\xff\xff\xff\x7f", b"\xff" * 8, b"\xef\xbb\xbf", b"<", b">", b'"')


@cache
def valid_files() -> dict[str, bytes]:
    """Return a valid file of every kind in `CALLS`."""
    flat, F = disk(4)
    z = flat @ (1, 1j)
    mesh = MeshData(np.column_stack([flat, 0.3 * (flat**2).sum(axis=1)]), F)
    rim = np.flatnonzero(abs(z) > 1 - 1e-9)
    files = {"moved.csv": "".join(f"{i},{0.9 * z[i].real},{z[i].imag}\n" for i in rim[:9]).encode()}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("mesh.obj", "mesh.off", "mesh.ply", "mesh.glb", "mesh.gltf"):
            path = Path(folder) / name
            write_map(path, mesh, flat)
            files[name] = path.read_bytes()
    corners = mesh.V[F]
    single = np.zeros(len(F), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    single["corners"] = corners
    files["mesh.stl"] = bytes(80) + len(F).to_bytes(4, "little") + single.tobytes()
    facets = ["".join(f"vertex {x} {y} {h}\n" for x, y, h in single_corners.tolist()) for single_corners in corners]
    facet = "facet normal 0 0 1\nouter loop\n{}endloop\nendfacet\n"
    files["text.stl"] = f"solid a\n{''.join(map(facet.format, facets))}endsolid a\n".encode()
    head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
    files["text.ply"] = (head.format(len(flat), len(F)) + _table(mesh.V) + _table(F, "3 ")).encode()
    files |= _planar(np.column_stack([flat, 0 * flat[:, 0]]), F)
    path = "M0 0h4v1c1 2 3 4 0 3a2 1 0 0 1-4 0z"
    files["outline.svg"] = f'<svg viewBox="0 0 4 4"><g transform="scale(2)"><path d="{path}"/></g></svg>'.encode()
    files["outline.txt"] = _table(np.array([[0, 0], [2, 0], [2, 2], [1.0, 0.5], [0, 2]])).encode()
    files["handles.txt"] = "".join(f"{i}\n" for i in rim).encode()
    files["corners.txt"] = "".join(f"{i}\n" for i in rim[:: len(rim) // 4]).encode()
    files["edges.txt"] = _table(np.stack([F[:2, 0], F[:2, 1]], axis=1)).encode()
    files["weights.txt"] = "".join(f"{1 + i % 3}\n" for i in range(len(F))).encode()
    files["list.txt"] = b"# all\nmesh.obj\n\nproblem  # one\n"
    return files


def _table(rows: FloatArray | IntArray, before: str = "") -> str:
    return "".join(before + " ".join(map(repr, row)) + "\n" for row in rows.tolist())


def _planar(V: FloatArray, F: IntArray) -> dict[str, bytes]:
    """Return a planar mesh as compressed VTU, text VTU, legacy VTK and MSH."""
    n, f = len(V), len(F)
    arrays = {
        "Points": (V, "Float64", 3),
        "connectivity": (F, "Int64", 1),
        "offsets": (3 * np.arange(1, f + 1), "Int64", 1),
        "types": (np.full(f, 5, dtype=np.uint8), "UInt8", 1),
    }
    made = {}
    for name, packed in ("plane.vtu", True), ("text.vtu", False):
        written, appended = {}, b""
        for key, (values, kind, wide) in arrays.items():
            tag = f'<DataArray type="{kind}" Name="{key}" NumberOfComponents="{wide}" format='
            written[key] = f'{tag}"ascii">{" ".join(map(repr, values.ravel().tolist()))}</DataArray>'
            if packed:
                written[key] = f'{tag}"appended" offset="{len(appended)}"/>'
                block = zlib.compress(np.ascontiguousarray(values).tobytes())
                appended += np.array([1, values.nbytes, 0, len(block)], dtype="<u4").tobytes() + block
        text = '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt32"'
        text += ' compressor="vtkZLibDataCompressor">' if packed else ">"
        text += (
            f'<UnstructuredGrid><Piece NumberOfPoints="{n}" NumberOfCells="{f}"><Points>{written["Points"]}</Points>'
        )
        text += f"<Cells>{written['connectivity']}{written['offsets']}{written['types']}</Cells></Piece>"
        text += "</UnstructuredGrid>" + ('<AppendedData encoding="raw">_' if packed else "")
        made[name] = text.encode() + appended + (b"</AppendedData>" if packed else b"") + b"</VTKFile>"
    text = f"# vtk DataFile Version 3.0\nmesh\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {n} double\n{_table(V)}"
    text += f"CELLS {f} {4 * f}\n{_table(F, '3 ')}CELL_TYPES {f}\n" + "5\n" * f
    made["plane.vtk"] = text.encode()
    nodes = "".join(f"{i} {x!r} {y!r} 0\n" for i, (x, y, _) in enumerate(V.tolist(), 1))
    elements = "".join(f"{i} 2 2 1 1 {a + 1} {b + 1} {c + 1}\n" for i, (a, b, c) in enumerate(F.tolist(), 1))
    text = (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{n}\n{nodes}$EndNodes\n$Elements\n{f}\n{elements}$EndElements\n"
    )
    made["plane.msh"] = text.encode()
    return made


def damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """Return a file's bytes truncated, cut out, repeated, swapped or replaced; numbers are replaced by unusual ones."""
    for _ in range(int(rng.integers(1, 4))):
        low, high = np.sort(rng.integers(len(data) + 1, size=2)).tolist()
        near = min(len(data), low + int(rng.integers(9)))
        match int(rng.integers(12)):
            case 0:
                data = data[:low]
            case 1:
                data = data[:low] + data[near:]
            case 2:
                data = data[:low] + data[low:high] * int(rng.integers(2, 4)) + data[high:]
            case 3:
                data = data[:low] + bytes(rng.integers(256, size=near - low, dtype=np.uint8)) + data[near:]
            case 4:
                data = data[:low] + _BYTES[rng.integers(len(_BYTES))] + data[near:]
            case 5:
                lines = data.splitlines(keepends=True)
                data = b"".join(lines[k] for k in rng.permutation(len(lines))) if rng.random() < 0.1 else data
            case _:
                numbers = list(_NUMBER.finditer(data))
                if numbers:
                    first, last = numbers[rng.integers(len(numbers))].span()
                    data = data[:first] + _NUMBERS[rng.integers(len(_NUMBERS))] + data[last:]
    return data


class Trial(NamedTuple):
    """The result for a damaged file; ``fault`` describes the failure and is empty if there is none."""

    name: str
    call: str
    status: int
    seconds: float
    gigabytes: float
    fault: str
    said: str


def attempt(name: str, files: dict[str, bytes], folder: Path) -> Trial:
    """Damage a file, named ``kind:seed``, and run the command on it in an empty folder."""
    kind, seed = name.split(":")
    rng = np.random.default_rng([zlib.crc32(kind.encode()), int(seed)])
    calls = CALLS[kind]
    call = calls[rng.integers(len(calls))].format(kind)
    for other, data in files.items():
        (folder / other).write_bytes(damaged(rng, data) if other == kind else data)
    (folder / "problem").mkdir()
    (folder / "problem" / "input.obj").write_bytes(files["mesh.obj"])
    before = set(os.listdir(folder))
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _command(call.split(), folder)
    status, used = _waited(child, began + SECONDS)
    seconds = time.monotonic() - began
    said = (folder / "said").read_text("utf-8", "backslashreplace")
    left = set(os.listdir(folder)) - before - {"said"}
    fault = _fault(call, status, said, left, folder)
    if not fault and used > GIGABYTES:
        fault = f"{used:.1f} GB"
    return Trial(name, call, status, seconds, used, fault, said)


def _command(arguments: list[str], folder: Path) -> None:
    """Run the command in this process and end the process."""
    status = 70
    try:
        os.chdir(folder)
        sys.stdout = sys.stderr = TextIOWrapper(FileIO("said", "w"), encoding="utf-8", line_buffering=True)
        os.dup2(sys.stdout.fileno(), 1)
        os.dup2(sys.stdout.fileno(), 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            status = qhm(arguments)
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else 71
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
    finally:
        os._exit(status)


def _waited(child: int, deadline: float) -> tuple[int, float]:
    """Return a process's exit status, negative for a signal, and its memory in gigabytes; kill it at the deadline."""
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss / 2**20
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            deadline = np.inf
        time.sleep(0.005)


def _fault(call: str, status: int, said: str, left: set[str], folder: Path) -> str:
    command = call.split()[0]
    if status not in (0, 1, 2):
        return f"exit status {status}"
    if "Traceback" in said or "Warning" in said:
        return "a traceback or a warning"
    if status == 2:
        if f"qhm {command}: " not in said:
            return "a refusal that does not say who refuses"
        if len(said) > 2000:
            return f"a refusal of {len(said)} characters"
        return f"left behind: {', '.join(left)}" if left else ""
    if any(name.endswith(".tmp") for name in left):
        return f"left behind: {', '.join(left)}"
    if "-o" not in call or command == "batch":
        return ""
    written = folder / call.split("-o ")[1].split()[0]
    if not written.is_file():
        return "nothing written"
    try:
        F, uv = _map(written, planar=command == "morph")
    except (ValueError, OSError) as error:
        return f"written, and cannot be read: {error}"
    return "" if status == 1 or _positive(F, uv) else "certified, and not injective"


def _map(written: Path, planar: bool) -> tuple[IntArray, FloatArray]:
    """Return the triangles and positions of a map in a file."""
    if planar:
        moved = read_fem(written)
        return covering_triangles(moved.F)[0], moved.points
    mesh = read_mesh(written)
    return (mesh.F, mesh.V[:, :2]) if mesh.FT is None or mesh.vt is None else (mesh.FT, mesh.vt)


def _positive(F: IntArray, uv: FloatArray) -> bool:
    """Whether all triangles are positive, in rational arithmetic."""
    points = [(Fraction(x), Fraction(y)) for x, y in uv.tolist()]
    corners = ((points[i], points[j], points[k]) for i, j, k in F.tolist())
    return all((b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0]) for a, b, c in corners)


@cache
def _import_all() -> None:
    """Import the command's modules once, before the processes are forked."""
    for module in pkgutil.walk_packages(quasiharmonic.__path__, "quasiharmonic."):
        # Modules that need an extra raise on import; the command does not import them by default.
        if not module.name.endswith("__main__"):
            with suppress(ImportError):
                importlib.import_module(module.name)
    for name in ("scipy.sparse.csgraph", "scipy.sparse.linalg", "scipy.spatial", "scipy.optimize", "matplotlib.path"):
        importlib.import_module(name)
    # The first solver imports its library.
    make_solver([0, 1], [0]).close()


def trials(names: Sequence[str], keep: Path | None = None) -> Iterator[Trial]:
    """Try damaged files one by one, each in its own subfolder of ``keep`` or in a temporary folder."""
    _import_all()
    files = valid_files()
    for name in names:
        folder = Path(tempfile.mkdtemp()) if keep is None else keep / name.replace(":", "-")
        folder.mkdir(parents=True, exist_ok=True)
        try:
            yield attempt(name, files, folder)
        finally:
            if keep is None:
                shutil.rmtree(folder)


def read_trials(
    arguments: Sequence[str] | None, about: str, what: str, count: int, kinds: Collection[str]
) -> tuple[argparse.Namespace, list[str]]:
    """Parse the command line of a script that tries ``count`` random cases; return it and the cases' names."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=count, help=f"{what} (%(default)s)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="begin with this seed (%(default)s)")
    parser.add_argument("--kinds", default=",".join(kinds), help="separated by commas (all)")
    parser.add_argument("--case", action="append", metavar="KIND:SEED", help="try only this case")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave the files there")
    options = parser.parse_args(arguments)
    chosen = options.kinds.split(",")
    numbers = range(options.count)
    names = options.case or [f"{chosen[i % len(chosen)]}:{options.first + i // len(chosen)}" for i in numbers]
    if unknown := {name.split(":")[0] for name in names} - set(kinds):
        parser.error(f"no kind {', '.join(sorted(unknown))}; there are {', '.join(kinds)}")
    return options, names


def main(arguments: Sequence[str] | None = None) -> int:
    """Try files and list the failures; return 1 if there is any."""
    options, names = read_trials(arguments, str(__doc__), "files", 1000, CALLS)
    ends: Counter[int] = Counter()
    worst = [0.0, 0.0]
    failures = 0
    for trial in trials(names, options.keep):
        ends[trial.status] += 1
        worst = [max(worst[0], trial.seconds), max(worst[1], trial.gigabytes)]
        failures += bool(trial.fault)
        if trial.fault or options.case:
            print(
                f"{trial.name}: {trial.fault or 'right'}: qhm {trial.call}\n    {trial.said.strip()[-1000:]}",
                flush=True,
            )
    print(", ".join(f"status {status}: {count}" for status, count in sorted(ends.items())))
    print(f"at most {worst[0]:.1f} s and {worst[1]:.2f} GB; {failures} failures among {len(names)} files")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
