"""Cost of an installation: seconds, megabytes and the largest packages, for the base and for each named extra.

    python benchmarks/install.py                # the base and [mkl]
    python benchmarks/install.py shapes batch   # the base and these

Each variant is installed from this checkout into a fresh environment, with the README's first command, and makes the
demo's image there. If `uv` is installed, it is measured too. Seconds depend on whether packages come from a cache or
the network. Therefore each installation runs twice; both times are reported, and CPU seconds of the second. Megabytes
(10⁶ bytes) are the growth of the environment: its files, their blocks on this disk, and the part that pip compiles
(`.pyc`; uv leaves compilation to the first use).
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def files(folder: Path) -> list[Path]:
    """Return all files below a folder."""
    return [path for path in folder.rglob("*") if not path.is_dir()]


def megabytes(folder: Path, ending: str = "") -> float:
    """Return the size of all files below a folder, or of those with this ending."""
    return sum(path.lstat().st_size for path in files(folder) if path.name.endswith(ending)) / 1e6


def blocks(folder: Path) -> float:
    """Return the megabytes that these files occupy on the disk, or NaN if the system does not report them."""
    return sum(getattr(path.lstat(), "st_blocks", float("nan")) * 512 for path in files(folder)) / 1e6


def commands() -> dict[str, Callable[[Path], list[str]]]:
    """Return the commands that install into an environment, by name."""
    uv = shutil.which("uv")
    by_pip = {"pip install": lambda environment: [str(python(environment)), "-m", "pip", "install", "--quiet"]}
    by_uv = {"uv pip install": lambda environment: [uv, "pip", "install", "-q", "--python", str(python(environment))]}
    return by_pip | by_uv if uv else by_pip


def installed(environment: Path, command: Callable[[Path], list[str]], requirement: str) -> tuple[float, float]:
    """Install a requirement into a new environment; return wall seconds and CPU seconds."""
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    began, before = time.perf_counter(), os.times()
    subprocess.run([*command(environment), requirement], check=True)
    after = os.times()
    worked = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - began, worked


def python(environment: Path) -> Path:
    """Return the interpreter of an environment."""
    windows = environment / "Scripts" / "python.exe"
    return windows if windows.exists() else environment / "bin" / "python"


def heaviest(environment: Path, count: int) -> str:
    """Describe the largest packages in an environment, except pip."""
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
    columns = "seconds, first", "again", "of the processor", "MB", "on the disk", "of them `.pyc`", "the largest, MB"
    print(f"| | {' | '.join(columns)} |\n" + "|---" * (len(columns) + 1) + "|", flush=True)
    for extra, (name, command) in product(["", *options.extras], commands().items()):
        requirement = f"{ROOT}[{extra}]" if extra else str(ROOT)
        with tempfile.TemporaryDirectory() as work:
            empty, first, again = (Path(work, name) for name in ("empty", "first", "again"))
            subprocess.run([sys.executable, "-m", "venv", empty], check=True)
            (slow, _), (quick, worked) = (installed(each, command, requirement) for each in (first, again))
            # Measure sizes before anything runs, so that compiled files are only those that pip wrote.
            sizes = megabytes(again), blocks(again), megabytes(again, ".pyc")
            before = megabytes(empty), blocks(empty), megabytes(empty, ".pyc")
            demo = [python(again), "-m", "quasiharmonic", "demo", "-o", Path(work, "demo")]
            subprocess.run(demo, check=True, stdout=subprocess.DEVNULL)
            if not list(Path(work, "demo").glob("*.png")):
                raise SystemExit("the demo has drawn nothing")
            said = f"`{name} '.[{extra}]'`" if extra else f"`{name} .`"
            grown = [f"{size - bare:.0f}" for size, bare in zip(sizes, before, strict=True)]
            row = [f"{slow:.0f}", f"{quick:.0f}", f"{worked:.0f}", *grown, heaviest(again, 4)]
            print(f"| {said} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
