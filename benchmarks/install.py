"""What an installation takes: seconds, megabytes and the largest packages, for the base and for each extra named.

    python benchmarks/install.py              # the base and [mkl]
    python benchmarks/install.py cut shapes   # the base and these

Each goes into a fresh environment, from this checkout, as the README's first command has it, and makes the demo's
picture there. Packages come from pip's cache or the network, which decides the seconds: it is done twice, both times
are reported, and of the second the processor's share. Megabytes are of the files, over those of the empty environment.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def megabytes(folder: Path) -> float:
    """Of all files below a folder."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir()) / 1e6


def installed(environment: Path, requirement: str) -> tuple[float, float]:
    """Seconds that pip takes to install something into a new environment, by the clock and of the processor."""
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    began, before = time.perf_counter(), os.times()
    subprocess.run([python(environment), "-m", "pip", "install", "--quiet", requirement], check=True)
    after = os.times()
    worked = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - began, worked


def python(environment: Path) -> Path:
    """The interpreter of an environment."""
    windows = environment / "Scripts" / "python.exe"
    return windows if windows.exists() else environment / "bin" / "python"


def heaviest(environment: Path, count: int) -> str:
    """The largest of what lies in an environment, but for pip."""
    folders = [path for parent in environment.rglob("site-packages") for path in parent.iterdir() if path.is_dir()]
    folders += [path for path in (environment / "lib", environment / "Library") if any(path.glob("*mkl*"))]
    sizes = {}
    for path in folders:
        if path.name != "pip":
            own = [path] if path.parent.name == "site-packages" else [p for p in path.iterdir() if p.is_file()]
            name = path.name if path.parent.name == "site-packages" else "MKL's libraries"
            sizes[name] = sum(megabytes(p) if p.is_dir() else p.lstat().st_size / 1e6 for p in own)
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:count]
    return ", ".join(f"{name} {size:.0f}" for name, size in largest)


def main(arguments: list[str] | None = None) -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("extras", nargs="*", default=["mkl"])
    options = parser.parse_args(arguments)
    print(f"{platform.platform()}, Python {platform.python_version()}\n")
    print(
        "| | seconds, first | again | of the processor | MB | the largest, MB |\n|---|---|---|---|---|---|", flush=True
    )
    for extra in ["", *options.extras]:
        requirement = f"{ROOT}[{extra}]" if extra else str(ROOT)
        with tempfile.TemporaryDirectory() as work:
            empty, first, again = (Path(work, name) for name in ("empty", "first", "again"))
            subprocess.run([sys.executable, "-m", "venv", empty], check=True)
            (slow, _), (quick, worked) = (installed(environment, requirement) for environment in (first, again))
            demo = [python(again), "-m", "quasiharmonic", "demo", "-o", Path(work, "demo")]
            # Sizes before anything has run: what Python compiles on first use is pip's doing already.
            taken = megabytes(again) - megabytes(empty)
            subprocess.run(demo, check=True, stdout=subprocess.DEVNULL)
            pictures = list(Path(work, "demo").glob("*.png"))
            if not pictures:
                raise SystemExit("the demo has drawn nothing")
            command = f"`pip install '.[{extra}]'`" if extra else "`pip install .`"
            row = f"{slow:.0f} | {quick:.0f} | {worked:.0f} | {taken:.0f} | {heaviest(again, 4)}"
            print(f"| {command} | {row} |", flush=True)


if __name__ == "__main__":
    main()
