"""Many small problems in tar files: `qhm batch` from archives beside folders, with an interruption, and as an array.

    python benchmarks/archives.py FOLDER [-n 100000] [--folders 5000] [--per-archive 1000] [-j 2] [-o TABLE]

1. The first ``--folders`` problems are solved from folders, and from archives.
2. All problems are solved from archives. When 40 % of the archives are finished, the process is killed (SIGKILL) and an
   archive is moved to another folder of the data set; then the same command continues.
3. The first archives, as 16 shards in mixed order, are solved by one process after the other, and merged.

Every record is counted, and the first map of each archive is certified again. Rates are of the finished processes: wall
time, and CPU time with that of the workers. Files and bytes are those in the output folder. A busy machine affects the
wall time only.
"""

from __future__ import annotations

import argparse
import io
import os
import resource
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quasiharmonic import batch, certify
from quasiharmonic.io import cut_at_seams, read_mesh
from quasiharmonic.surfaces import disk
from small_problems import blob
from speed import machine

_RINGS = 4


class Row(NamedTuple):
    """Result of a run."""

    what: str
    problems: int
    wall: float
    cpu: float
    output: Path


def contents(count: int) -> Iterator[tuple[bytes, bytes]]:
    """Yield the contents of mesh and list of fixed vertices of each problem: one disk with different outlines."""
    V, F = disk(_RINGS)
    head = "".join(f"v {x!r} {y!r} 0\n" for x, y in V.tolist())
    faces = "".join("f " + " ".join(f"{i + 1}/{i + 1}" for i in face) + "\n" for face in F.tolist())
    for seed in range(count):
        *_, loop, target = blob(V, F, seed)
        uv = np.zeros((len(V), 2))
        uv[loop] = target
        text = head + "".join(f"vt {u!r} {v!r}\n" for u, v in uv.tolist()) + faces
        yield text.encode(), "".join(f"{i}\n" for i in loop).encode()


def write_archives(folder: Path, count: int, per_archive: int) -> list[Path]:
    """Write the problems as tar files."""
    folder.mkdir(parents=True)
    problems, paths = contents(count), []
    for number in range(-(-count // per_archive)):
        paths.append(folder / f"{number:05d}.tar")
        with tarfile.open(paths[-1], "w") as tar:
            for k, (mesh, fixed) in enumerate(islice(problems, per_archive)):
                for name, data in ((f"{k:05d}.obj", mesh), (f"{k:05d}.txt", fixed)):
                    info = tarfile.TarInfo(name)
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))
    return paths


def write_folders(folder: Path, count: int) -> None:
    """Write the problems as folders."""
    for k, (mesh, fixed) in enumerate(contents(count)):
        place = folder / f"{k // 1000:05d}" / f"{k:05d}"
        place.mkdir(parents=True)
        (place / "input.obj").write_bytes(mesh)
        (place / "handles.txt").write_bytes(fixed)


def command(*arguments: object) -> list[str]:
    """Return the command line of ``qhm batch``."""
    return [sys.executable, "-m", "quasiharmonic", "batch", *map(str, arguments)]


def measured(what: str, problems: int, output: Path, *arguments: object) -> Row:
    """Run ``qhm batch`` and return its times."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command(*arguments, "-o", output), check=True, stderr=subprocess.DEVNULL)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Row(what, problems, wall, cpu, output)


def finished_archives(output: Path) -> int:
    """Return the number of finished archives of results."""
    return len(list((output / "results").rglob("*.tar")))


def interrupted(source: Path, output: Path, archives: list[Path], jobs: int) -> int:
    """Start a run, kill it when 40 % of the archives are finished, and move an archive; return how many were."""
    process = subprocess.Popen(
        command(source, "-o", output, "-j", jobs), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    # Kill it within an archive, whose results so far are in a journal.
    while finished_archives(output) < 0.4 * len(archives) or not any(
        path.stat().st_size for path in output.rglob("*.part")
    ):
        if process.poll() is not None:
            raise RuntimeError("the run ended before it was killed")
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = finished_archives(output)
    print(f"killed with {finished} finished archives and", *(path.name for path in output.rglob("*.part")), flush=True)
    moved = source / "moved" / archives[0].name
    moved.parent.mkdir()
    archives[0].rename(moved)
    return finished


def check(output: Path, count: int) -> None:
    """Check that every problem has one certified record, and certify some maps again."""
    problems = {row["problem"] for row in batch.read_table(output / "records.csv") if row["certified"]}
    if len(problems) != count:
        raise RuntimeError(f"{output}: {len(problems)} certified problems instead of {count}")
    for path in (output / "results").rglob("*.tar"):
        with tarfile.open(path) as tar:
            member = tar.next()
            assert member is not None
            tar.extract(member, output / "check", filter="data")
        _, F, uv = cut_at_seams(read_mesh(output / "check" / member.name))
        if not certify(F, uv).injective:
            raise RuntimeError(f"{path}: {member.name} is not injective")
    shutil.rmtree(output / "check", ignore_errors=True)


def sizes(folder: Path) -> tuple[int, int, int]:
    """Return number, bytes and allocated bytes of the files in a folder."""
    found = [path.stat() for path in folder.rglob("*") if path.is_file()]
    return len(found), sum(one.st_size for one in found), sum(512 * getattr(one, "st_blocks", 0) for one in found)


def table(rows: list[Row]) -> str:
    """Return the results as a table."""
    lines = [
        f"{machine()}; {6 * _RINGS**2} triangles",
        "",
        "| run | problems | per second | CPU ms each | files written | bytes each | bytes each on the disk |",
        "|---|---|---|---|---|---|---|",
    ]
    for what, problems, wall, cpu, output in rows:
        files, size, allocated = sizes(output)
        total = sum(1 for _ in batch.read_table(output / "records.csv"))
        lines.append(
            f"| {what} | {problems:,} | {problems / wall:.0f} | {1e3 * cpu / problems:.2f} | {files:,} "
            f"| {size / total:,.0f} | {allocated / total:,.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="new folder for all files")
    parser.add_argument("-n", "--count", type=int, default=100_000)
    parser.add_argument("--folders", type=int, default=5000)
    parser.add_argument("--per-archive", type=int, default=1000)
    parser.add_argument("-j", "--jobs", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    root, jobs, part = options.folder, options.jobs, options.folders
    os.environ["OMP_NUM_THREADS"] = "1"

    write_folders(root / "folders", part)
    write_archives(root / "same", part, options.per_archive)
    rows = [
        measured("folders", part, root / "out-folders", root / "folders", "-j", jobs),
        measured("archives", part, root / "out-same", root / "same", "-j", jobs),
    ]
    check(root / "out-same", part)
    print(table(rows), flush=True)

    archives = write_archives(root / "all", options.count, options.per_archive)
    done = interrupted(root / "all", root / "out-all", archives, jobs)
    left = options.count - done * options.per_archive
    rows.append(measured("archives, continued", left, root / "out-all", root / "all", "-j", jobs))
    check(root / "out-all", options.count)
    print(table(rows), flush=True)

    shards = [(7 * k) % 16 + 1 for k in range(16)]
    times = [measured("", 0, root / "out-array", root / "folders", "-j", jobs, "--shard", f"{i}/16") for i in shards]
    subprocess.run(command("--merge", "-o", root / "out-array"), check=True)
    check(root / "out-array", part)
    wall, cpu = sum(one.wall for one in times), sum(one.cpu for one in times)
    rows.append(Row("folders, 16 shards one after another", part, wall, cpu, root / "out-array"))
    text = table(rows)
    print(text)
    if options.output is not None:
        options.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
