"""Build the zip files that Blender installs: ``python blender/build.py [--platform NAME … | all] [-o FOLDER]``.

A zip contains the extension and wheels of this package, of SciPy, and of the two solvers of the base installation.
NumPy comes with Blender. ``--wheels FOLDER`` names the folder with the wheels of this package that
``.github/workflows/wheels.yml`` builds; their loops are compiled. Without it the package is built here: its loops are
compiled if the zip is for this platform, and otherwise use NumPy.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from platform import machine

HERE = Path(__file__).resolve().parent
EXTENSION = HERE / "extension"
# Blender's platform names, and the newest wheel tags that are accepted. Pip also takes wheels for older systems. SciPy
# has two wheels for macOS, for version 14 and for an older one: the older one is taken.
PLATFORMS = {
    "linux-x64": ["manylinux_2_28_x86_64", "manylinux2014_x86_64"],
    "linux-arm64": ["manylinux_2_28_aarch64", "manylinux2014_aarch64"],
    "windows-x64": ["win_amd64"],
    "windows-arm64": ["win_arm64"],
    "macos-x64": ["macosx_11_0_x86_64"],
    "macos-arm64": ["macosx_12_0_arm64"],
}
# Blender 4.2 to 5.0 come with Python 3.11. Blender 5.1 comes with Python 3.13, so the manifest excludes it.
PYTHON = "3.11"
NEEDED = ["lazy_loader>=0.4", "scipy>=1.14,<1.17", "qdldl>=0.1.7"]
# The solver of large systems. Without it QDLDL solves them, more slowly.
FAST_SOLVER = "rslab>=1.7,<2"
WITHOUT_FAST_SOLVER = {"windows-arm64"}


def main(arguments: list[str] | None = None) -> int:
    """Download the wheels, write the zips and print their paths."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--platform",
        nargs="+",
        choices=[*PLATFORMS, "all"],
        default=[_here()],
        required=_here() is None,
        help="(default: this one)",
    )
    parser.add_argument("--wheels", type=Path, metavar="FOLDER", help="folder with wheels of this package")
    parser.add_argument("-o", "--output", type=Path, default=HERE / "dist", help="folder (default: blender/dist)")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    for platform in PLATFORMS if "all" in options.platform else options.platform:
        with tempfile.TemporaryDirectory() as folder:
            wheels = collect(Path(folder), platform, options.wheels)
            target = options.output / f"quasiharmonic-{version()}-{platform}.zip"
            write(target, wheels, platform)
        print(f"wrote {target}, {target.stat().st_size / 2**20:.0f} MB")
    return 0


def version() -> str:
    """Return the version of the package."""
    text = (HERE.parent / "src" / "quasiharmonic" / "__init__.py").read_text(encoding="utf-8")
    found = re.search(r'__version__ = "([0-9.]+)', text)
    assert found is not None
    return found[1]


def collect(folder: Path, platform: str, own: Path | None) -> list[Path]:
    """Download all wheels for a platform into a folder and return their paths.

    ``own`` is a folder with wheels of this package. Without it, a wheel is built.
    """
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    tags = [option for tag in PLATFORMS[platform] for option in ("--platform", tag)]
    download = [*pip, "download", "--only-binary=:all:", "--no-deps", "--python-version", PYTHON, *tags]
    needed = NEEDED if platform in WITHOUT_FAST_SOLVER else [*NEEDED, FAST_SOLVER]
    try:
        subprocess.run([*download, "-d", str(folder), *needed], check=True)
    except subprocess.CalledProcessError as error:
        sys.exit(f"build.py: pip could not download a wheel (status {error.returncode}); is there a network?")
    if own is not None:
        here = ["--no-index", "--find-links", str(own.resolve())]
        get = [*download, *here, "-d", str(folder), f"quasiharmonic=={version()}"]
        failed = f"{own} has no wheel of quasiharmonic {version()} for {platform}"
    else:
        get = [*pip, "wheel", "--no-deps", "-w", str(folder), str(HERE.parent)]
        failed = "the wheel of quasiharmonic could not be built"
    try:
        subprocess.run(get, check=True, env=os.environ | _build_settings(platform))
    except subprocess.CalledProcessError as error:
        sys.exit(f"build.py: {failed} (pip ended with status {error.returncode})")
    return sorted(folder.glob("*.whl"))


def _build_settings(platform: str) -> dict[str, str]:
    """Return the environment variables for a build of this package."""
    if platform != _here():
        return {"QUASIHARMONIC_PURE": "1"}
    # As in pyproject.toml: without it, a wheel requires the macOS on which it was built.
    return {"MACOSX_DEPLOYMENT_TARGET": "11.0"} if platform.startswith("macos") else {}


def write(target: Path, wheels: list[Path], platform: str) -> None:
    """Write the zip: manifest, modules, licence, wheels."""
    listed = "".join(f'  "./wheels/{wheel.name}",\n' for wheel in wheels)
    manifest = (EXTENSION / "blender_manifest.toml").read_text(encoding="utf-8")
    manifest += f'version = "{version()}"\nplatforms = ["{platform}"]\nwheels = [\n{listed}]\n'
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("blender_manifest.toml", manifest)
        archive.write(HERE.parent / "LICENSE", "LICENSE")
        archive.write(HERE.parent / "THIRD_PARTY.md", "THIRD_PARTY.md")
        for module in sorted(EXTENSION.glob("*.py")):
            archive.write(module, module.name)
        for wheel in wheels:
            archive.write(wheel, f"wheels/{wheel.name}", compress_type=zipfile.ZIP_STORED)


def _here() -> str | None:
    """Return Blender's name of the current platform, or None if Blender does not support it."""
    system = {"win32": "windows", "darwin": "macos"}.get(sys.platform, sys.platform)
    processor = {"amd64": "x64", "x86_64": "x64", "aarch64": "arm64"}.get(machine().lower(), machine().lower())
    name = f"{system}-{processor}"
    return name if name in PLATFORMS else None


if __name__ == "__main__":
    sys.exit(main())
