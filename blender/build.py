"""Build the zip file that Blender installs: ``python blender/build.py [--platform NAME] [-o FOLDER]``.

The zip contains the extension and wheels of this package, of SciPy, and of the two solvers of the base installation.
NumPy comes with Blender. The loops are compiled if the zip is for the platform of the build; otherwise they use NumPy.
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
# Blender's platform names, and the wheel tags that run there.
PLATFORMS = {
    "linux-x64": ["manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"],
    "windows-x64": ["win_amd64"],
    "macos-arm64": ["macosx_14_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"],
}
# Blender 4.5 and 5.0 come with Python 3.11 and NumPy 1.26 to 2.
PYTHON = "3.11"
NEEDED = ["lazy_loader>=0.4", "scipy>=1.14,<1.17", "qdldl>=0.1.7", "rslab>=1.7"]


def main(arguments: list[str] | None = None) -> int:
    """Download the wheels, write the zip and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--platform", choices=PLATFORMS, default=_here(), required=_here() is None, help="(default: this one)"
    )
    parser.add_argument("-o", "--output", type=Path, default=HERE / "dist", help="folder (default: blender/dist)")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        wheels = collect(Path(folder), options.platform)
        target = options.output / f"quasiharmonic-{version()}-{options.platform}.zip"
        write(target, wheels, options.platform)
    print(f"wrote {target}, {target.stat().st_size / 2**20:.0f} MB")
    return 0


def version() -> str:
    """Return the version of the package."""
    text = (HERE.parent / "src" / "quasiharmonic" / "__init__.py").read_text(encoding="utf-8")
    found = re.search(r'__version__ = "([0-9.]+)', text)
    assert found is not None
    return found[1]


def collect(folder: Path, platform: str) -> list[Path]:
    """Download all wheels for a platform into a folder and return their paths."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    tags = [option for tag in PLATFORMS[platform] for option in ("--platform", tag)]
    chosen = ["--only-binary=:all:", "--no-deps", "--python-version", PYTHON, *tags]
    surroundings = os.environ | ({} if platform == _here() else {"QUASIHARMONIC_PURE": "1"})
    try:
        subprocess.run([*pip, "download", *chosen, "-d", str(folder), *NEEDED], check=True)
        subprocess.run([*pip, "wheel", "--no-deps", "-w", str(folder), str(HERE.parent)], check=True, env=surroundings)
    except subprocess.CalledProcessError as error:
        sys.exit(f"build.py: a wheel could not be had (pip ended with {error.returncode}); is there a network?")
    return sorted(folder.glob("*.whl"))


def write(target: Path, wheels: list[Path], platform: str) -> None:
    """Write the zip: manifest, modules, licence, wheels."""
    listed = "".join(f'  "./wheels/{wheel.name}",\n' for wheel in wheels)
    manifest = (EXTENSION / "blender_manifest.toml").read_text(encoding="utf-8")
    manifest += f'version = "{version()}"\nplatforms = ["{platform}"]\nwheels = [\n{listed}]\n'
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("blender_manifest.toml", manifest)
        archive.write(HERE.parent / "LICENSE", "LICENSE")
        for module in sorted(EXTENSION.glob("*.py")):
            archive.write(module, module.name)
        for wheel in wheels:
            archive.write(wheel, f"wheels/{wheel.name}", compress_type=zipfile.ZIP_STORED)


def _here() -> str | None:
    """Return Blender's name of the current platform, or None if Blender does not support it."""
    system = {"win32": "windows", "darwin": "macos"}.get(sys.platform, sys.platform)
    processor = {"amd64": "x64", "x86_64": "x64"}.get(machine().lower(), machine().lower())
    name = f"{system}-{processor}"
    return name if name in PLATFORMS else None


if __name__ == "__main__":
    sys.exit(main())
