"""Run the command on malicious files; each must give a one-line message within ten seconds and a gigabyte.

    python benchmarks/malicious_files.py
    python benchmarks/malicious_files.py --case vtu-zlib-bomb

The files contain huge counts, deep nesting, entities and compressed data that expand without limit, invalid numbers,
references out of the folder or to themselves, pickles, wrong encodings, and missing ends. A *failure* is any of: an
exit status other than 2 (or 0 and 1 if the file may be accepted); a message of more than one line or without the
program's name; a traceback or a warning; files left behind. `damaged_files.py` tests randomly damaged files. Time is
CPU time. Requires a system with fork.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import lzma
import os
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from damaged_files import valid_files

SECONDS, GIGABYTES, LETTERS = 10.0, 1.0, 600
# Limits beyond which a process is killed and counts as failed.
_MOST_SECONDS, _MOST_BYTES = 60, 6 << 30
_HUGE = 10**15


class Evil(NamedTuple):
    """A file, the command that reads it ({} stands for the file's name), and whether the file may be accepted."""

    name: str
    call: str
    ending: str
    data: bytes
    may: bool = False


def files() -> Iterator[Evil]:
    """Yield all files, one at a time."""
    good = valid_files()
    yield from _surfaces(good)
    yield from _binary(good)
    yield from _fem(good)
    yield from _lists()
    yield from _pictures()


def _surfaces(good: dict[str, bytes]) -> Iterator[Evil]:
    flat = "flatten {} -o out.obj"
    triangle = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    for name, data in {
        "far": triangle + b"f 1 2 %d\n" % _HUGE,
        "before": triangle + b"f 1 2 -%d\n" % _HUGE,
        "digits": triangle + b"f 1 2 " + b"9" * 10**7 + b"\n",
        "nan": triangle.replace(b"v 1 0", b"v nan 0") + b"f 1 2 3\n",
        "infinite": triangle.replace(b"v 1 0", b"v 1e999 0") + b"f 1 2 3\n",
        "polygon": triangle + b"f" + b" 1 2 3" * 10**6 + b"\n",
        "line": b"v 0 0 " + b"0" * 5 * 10**7,
        "continued": triangle + b"f 1 2 \\\n" * 10**6,
        "zeros": bytes(5 * 10**7),
        "utf16": (triangle + b"f 1 2 3\n").decode().encode("utf-16"),
        "half": good["mesh.obj"][: len(good["mesh.obj"]) // 2],
        "same": triangle + b"f 1 2 3\n" * 10**5,
    }.items():
        yield Evil(f"obj-{name}", flat, ".obj", data)
    for name, head in {
        "counts": b"%d %d 0" % (_HUGE, _HUGE),
        "negative": b"-1 -1 -1",
        "faces": b"3 4294967295 0",
    }.items():
        yield Evil(f"off-{name}", flat, ".off", b"OFF\n" + head + b"\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    yield Evil("off-corners", flat, ".off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n%d 0 1 2\n" % _HUGE)
    ply = b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
    faces = b"element face %d\nproperty list %s int vertex_indices\nend_header\n"
    for form in b"ascii", b"binary_little_endian":
        yield Evil(
            f"ply-{form.decode()}-counts", flat, ".ply", ply % (form, _HUGE) + faces % (_HUGE, b"uchar") + bytes(99)
        )
    binary = ply % (b"binary_little_endian", 3) + faces % (1, b"uint") + bytes(36)
    yield Evil("ply-list", flat, ".ply", binary + b"\xff\xff\xff\xff" + bytes(12))
    yield Evil("ply-header", flat, ".ply", b"ply\nformat ascii 1.0\n" + b"comment no end\n" * 3 * 10**6)
    many = b"".join(b"property double p%d\n" % k for k in range(10**5))
    yield Evil(
        "ply-properties", flat, ".ply", ply % (b"binary_little_endian", 10**9) + many + b"end_header\n" + bytes(9)
    )
    yield Evil("stl-count", flat, ".stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50))
    yield Evil("stl-nan", flat, ".stl", bytes(80) + struct.pack("<I12fH", 1, *[float("nan")] * 12, 0))
    yield Evil("stl-text", flat, ".stl", b"solid a\n" + b"facet normal 0 0 1\nouter loop\n" * 10**6)


def _binary(good: dict[str, bytes]) -> Iterator[Evil]:
    flat = "flatten {} -o out.obj"
    scene = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}]}
    scene |= {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(points).decode()
    scene |= {"buffers": [{"byteLength": 48, "uri": uri}]}
    scene |= {"bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}]}
    corner = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    scene |= {"accessors": [corner, {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}]}
    sparse = {"count": _HUGE, "indices": {"bufferView": 1, "componentType": 5125}, "values": {"bufferView": 0}}
    for name, change in {
        "count": {"accessors": [corner | {"count": _HUGE}, scene["accessors"][1]]},
        "zeros": {"accessors": [{"componentType": 5126, "count": _HUGE, "type": "VEC3"}, scene["accessors"][1]]},
        "sparse": {"accessors": [corner | {"sparse": sparse}, scene["accessors"][1]]},
        "stride": {"bufferViews": [scene["bufferViews"][0] | {"byteStride": -12}, scene["bufferViews"][1]]},
        "self": {"nodes": [{"mesh": 0, "children": [0]}]},
        "chain": {"nodes": [{"children": [k + 1]} for k in range(10**5)] + [{"mesh": 0}]},
        "tree": {"nodes": [{"children": [k + 1, k + 1]} for k in range(60)] + [{"mesh": 0}]},
        "device": {"buffers": [{"byteLength": 48, "uri": "/dev/zero"}]},
        "outside": {"buffers": [{"byteLength": 48, "uri": "../../../../etc/passwd"}]},
        "fetched": {"buffers": [{"byteLength": 48, "uri": "http://127.0.0.1:1/points.bin"}]},
        "length": {"buffers": [{"byteLength": _HUGE, "uri": uri}]},
        "scale": {"nodes": [{"mesh": 0, "scale": [1e308, 1e308, 1e308], "translation": [1e308] * 3}]},
    }.items():
        # A reader of the mesh need not resolve which nodes lead to it.
        yield Evil(f"gltf-{name}", flat, ".gltf", json.dumps(scene | change).encode(), may="nodes" in change)
    yield Evil("gltf-deep", flat, ".gltf", b'{"asset":' + b"[" * 10**6)
    yield Evil("gltf-digits", flat, ".gltf", b'{"asset":{"version":"2.0"},"scene":' + b"9" * 10**7 + b"}")
    yield Evil("gltf-utf16", flat, ".gltf", json.dumps(scene).encode("utf-16"), may=True)
    yield Evil("glb-length", flat, ".glb", struct.pack("<4sII I4s", b"glTF", 2, 2**32 - 1, 2**32 - 1, b"JSON") + b"{}")
    yield Evil("glb-half", flat, ".glb", good["mesh.glb"][: len(good["mesh.glb"]) // 2])


def _fem(good: dict[str, bytes]) -> Iterator[Evil]:
    moved = "morph {} --positions moved.csv -o out.vtu"
    head = '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64"{}>'
    piece = '<UnstructuredGrid><Piece NumberOfPoints="{0}" NumberOfCells="{1}"><Points><DataArray type="Float64" '
    piece += 'NumberOfComponents="3" format="{2}">{3}</DataArray></Points></Piece></UnstructuredGrid></VTKFile>'

    def packed(data: bytes, told: int) -> str:
        sizes = struct.pack("<4Q", 1, told, 0, len(data))
        return (base64.b64encode(sizes) + base64.b64encode(data)).decode()

    bombs = {"zlib": ("vtkZLibDataCompressor", _deflated(2 << 30)), "lzma": ("vtkLZMADataCompressor", _lzma(1 << 30))}
    for name, (compressor, data) in bombs.items():
        for told, size in {"bomb": 72, "told": 2 << 30}.items():
            text = head.format(f' compressor="{compressor}"') + piece.format(3, 1, "binary", packed(data, size))
            yield Evil(f"vtu-{name}-{told}", moved, ".vtu", text.encode())
    plain = head.format("")
    yield Evil("vtu-counts", moved, ".vtu", (plain + piece.format(_HUGE, _HUGE, "ascii", "0 0 0")).encode())
    yield Evil("vtu-negative", moved, ".vtu", (plain + piece.format(-3, -1, "ascii", "0 0 0")).encode())
    yield Evil("vtu-deep", moved, ".vtu", (plain + "<a>" * 10**6).encode())
    yield Evil(
        "vtu-entities", moved, ".vtu", (_laughs("VTKFile") + plain + piece.format(3, 1, "ascii", "&j;")).encode()
    )
    outside = '<!DOCTYPE VTKFile [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    yield Evil("vtu-outside", moved, ".vtu", (outside + plain + piece.format(3, 1, "ascii", "&x;")).encode())
    yield Evil("vtu-utf16", moved, ".vtu", good["text.vtu"].decode().encode("utf-16"), may=True)
    legacy = b"# vtk DataFile Version 3.0\nm\n%s\nDATASET UNSTRUCTURED_GRID\nPOINTS %d double\n0 0 0\n"
    for form in b"ASCII", b"BINARY":
        yield Evil(f"vtk-{form.decode().lower()}-counts", moved, ".vtk", legacy % (form, _HUGE))
    cells = b"1 0 0\n0 1 0\nCELLS %d %d\n3 0 1 2\nCELL_TYPES 1\n5\n" % (_HUGE, 4 * _HUGE)
    yield Evil("vtk-cells", moved, ".vtk", legacy % (b"ASCII", 3) + cells)
    msh = b"$MeshFormat\n%s\n$EndMeshFormat\n$Nodes\n%s\n"
    yield Evil("msh-counts", moved, ".msh", msh % (b"2.2 0 8", b"%d" % _HUGE))
    yield Evil("msh-blocks", moved, ".msh", msh % (b"4.1 0 8", b"%d %d 1 %d" % (_HUGE, _HUGE, _HUGE)))
    yield Evil("msh-binary", moved, ".msh", msh % (b"4.1 1 8\n\1\0\0\0", struct.pack("<4Q", *[2**63] * 4)))
    yield Evil("msh-no-end", moved, ".msh", msh % (b"2.2 0 8", b"1") + b"1 0 0 0\n" * 10**6)


def _lists() -> Iterator[Evil]:
    yield Evil("csv-wide", "morph plane.vtu --positions {} -o out.vtu", ".csv", b"1," * 10**7)
    yield Evil("csv-utf16", "morph plane.vtu --positions {} -o out.vtu", ".csv", "1,2,3\n".encode("utf-16"))
    yield Evil("csv-nan", "morph plane.vtu --positions {} -o out.vtu", ".csv", b"0,nan,inf\n")
    handles = "map mesh.obj --fixed {} -o out.obj"
    yield Evil("handles-far", handles, ".txt", b"0\n1\n%d\n" % _HUGE)
    yield Evil("handles-digits", handles, ".txt", b"9" * 10**7)
    yield Evil("handles-zeros", handles, ".txt", bytes(5 * 10**7))
    outline = "map mesh.obj --to {} -o out.obj"
    yield Evil("outline-infinite", outline, ".txt", b"0 0\n1e999 0\n0 1\n")
    yield Evil("outline-long", outline, ".txt", b"0 0\n1 0\n1 1\n" * 10**6)
    svg = '<svg xmlns="http://www.w3.org/2000/svg">{}</svg>'
    for name, inner in {
        "deep": "<g>" * 10**6,
        "numbers": '<path d="M0 0' + "l1 1" * 3 * 10**6 + 'z"/>',
        "arcs": '<path d="M0 0' + "a1 1e300 0 1 1 1e-300 1" * 10**5 + 'z"/>',
        "transforms": '<g transform="' + "scale(1e9) " * 10**5 + '"><path d="M0 0h1v1z"/></g>',
        "digits": '<path d="M0 0h' + "9" * 10**7 + 'v1z"/>',
        "nan": '<path d="M0 0hnanv1z"/>',
    }.items():
        yield Evil(f"svg-{name}", outline, ".svg", svg.format(inner).encode())
    yield Evil("svg-entities", outline, ".svg", (_laughs("svg") + svg.format('<path d="&j;"/>')).encode())
    frames = "animate mesh.obj {} -o out"
    array = io.BytesIO()
    np.save(array, np.array([_Harm()], dtype=object), allow_pickle=True)
    yield Evil("npy-pickle", frames, ".npy", array.getvalue())
    for name, shape in {
        "huge": f"({_HUGE}, 3, 2)",
        "deep": "(" * 10**4 + ")" * 10**4,
        "negative": "(-1, 3, 2)",
    }.items():
        text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        yield Evil(f"npy-{name}", frames, ".npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + bytes(48))
    yield Evil("list-device", "batch {} -o out -j 1", ".txt", b"/dev/zero\n", may=True)
    yield Evil("list-zeros", "batch {} -o out -j 1", ".txt", bytes(10**7))


def _pictures() -> Iterator[Evil]:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    call = "map mesh.obj --to disk --texture {} -o out.glb"
    for name, size, data in ("huge", 2**31 - 1, b"x"), ("bomb", 60000, _deflated(2 << 30)):
        head = chunk(b"IHDR", struct.pack(">2I5B", size, size, 8, 6, 0, 0, 0))
        picture = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")
        yield Evil(f"png-{name}", call, ".png", picture, may=True)
    yield Evil("png-text", call, ".png", b"not a picture")
    yield Evil("jpg-cut", call, ".jpg", b"\xff\xd8\xff\xe0\xff\xff", may=True)


class _Harm:
    """A class whose unpickling calls a function."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch harm",)


def _deflated(size: int) -> bytes:
    """Return compressed zeros, this many before compression."""
    packer, block = zlib.compressobj(9), bytes(1 << 20)
    return b"".join(packer.compress(block) for _ in range(size >> 20)) + packer.flush()


def _lzma(size: int) -> bytes:
    packer, block = lzma.LZMACompressor(preset=0), bytes(1 << 20)
    return b"".join(packer.compress(block) for _ in range(size >> 20)) + packer.flush()


def _laughs(root: str) -> str:
    """Return nested entities, each ten times the previous one, ten levels deep."""
    names = "abcdefghij"
    more = "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in pairwise(names))
    return f'<!DOCTYPE {root} [<!ENTITY a "0 0 0 ">{more}]>'


def attempt(evil: Evil, good: dict[str, bytes]) -> tuple[str, int, float, float, str]:
    """Return the fault, exit status, seconds, gigabytes and message."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for other, data in good.items():
            (folder / other).write_bytes(data)
        (folder / f"evil{evil.ending}").write_bytes(evil.data)
        before = set(os.listdir(folder))
        call = evil.call.format(f"evil{evil.ending}").split()
        with (folder / "said").open("wb") as said:
            child = subprocess.Popen(
                [sys.executable, "-m", "quasiharmonic", *call],
                cwd=folder,
                stdout=said,
                stderr=said,
                preexec_fn=_limited,
            )
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        text = (folder / "said").read_text("utf-8", "backslashreplace")
        left = set(os.listdir(folder)) - before - {"said"}
        if "harm" in left:
            return "it was executed", child.returncode, 0.0, 0.0, text
        shutil.rmtree(folder / "out", ignore_errors=True)
    seconds, gigabytes = usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**20
    return _fault(evil, child.returncode, seconds, gigabytes, text, left), child.returncode, seconds, gigabytes, text


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (_MOST_SECONDS, _MOST_SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, _MOST_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _fault(evil: Evil, status: int, seconds: float, gigabytes: float, said: str, left: set[str]) -> str:
    if "Traceback" in said or "Warning" in said:
        return "a traceback or a warning"
    if status not in ((0, 1, 2) if evil.may else (2,)):
        return f"exit status {status}"
    if seconds > SECONDS or gigabytes > GIGABYTES:
        return f"{seconds:.1f} s and {gigabytes:.2f} GB"
    if status != 2:
        return ""
    if f"qhm {evil.call.split()[0]}: " not in said or len(said) > LETTERS or said.count("\n") > 1:
        return f"{len(said)} letters in {said.count(chr(10))} lines"
    return f"left behind: {', '.join(sorted(left))}" if left - {"out"} else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all files and list the failures; return 1 if there is any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", metavar="NAME", help="try just this file, e.g. vtu-zlib-bomb")
    options = parser.parse_args(arguments)
    good = valid_files()
    count = failures = 0
    worst = [0.0, 0.0]
    for evil in files():
        if options.case and evil.name not in options.case:
            continue
        fault, status, seconds, gigabytes, said = attempt(evil, good)
        worst = [max(worst[0], seconds), max(worst[1], gigabytes)]
        count, failures = count + 1, failures + bool(fault)
        print(f"{evil.name}: {fault or 'right'} ({status}, {seconds:.1f} s, {gigabytes:.2f} GB)", flush=True)
        if fault or options.case:
            print(f"    {said.strip()[-600:]}", flush=True)
    print(f"at most {worst[0]:.1f} s and {worst[1]:.2f} GB; {failures} failures among {count} files")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
