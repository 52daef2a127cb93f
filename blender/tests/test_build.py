"""The zip files: their manifests, their wheels, and Blender's own validation of them."""

import importlib
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import pytest

BUILD = Path(__file__).parents[1] / "build.py"
PLATFORMS = ["linux-x64", "linux-arm64", "windows-x64", "windows-arm64", "macos-x64", "macos-arm64"]


def validate(path):
    """What ``blender --command extension validate`` returns: 0 for a valid extension."""
    return importlib.import_module("bl_pkg.bl_extension_cli").cli_extension_handler(["validate", str(path)])


def manifest_of(path):
    with zipfile.ZipFile(path) as archive:
        return tomllib.loads(archive.read("blender_manifest.toml").decode())


def assert_fits(path, platform):
    """The wheels of a zip run on its platform, with the Python of the Blender versions that it names."""
    cli = importlib.import_module("bl_pkg.cli.blender_ext")
    manifest = manifest_of(path)
    assert manifest["platforms"] == [platform]
    names = [Path(wheel).name for wheel in manifest["wheels"]]
    assert {name.split("-")[0] for name in names} >= {"scipy", "qdldl", "lazy_loader", "quasiharmonic"}
    assert ("rslab" in {name.split("-")[0] for name in names}) == (platform != "windows-arm64")
    for name in names:
        assert cli.blender_platform_compatible_with_wheel_platform_from_filepath(platform, name)
        # None of them needs a newer macOS than SciPy's older wheels.
        assert not any(f"macosx_{version}_" in name for version in (13, 14, 15))
    with zipfile.ZipFile(path) as archive:
        assert {f"wheels/{name}" for name in names} <= set(archive.namelist())


def test_blender_validates_the_zip(archive):
    assert validate(archive) == 0
    assert_fits(archive, manifest_of(archive)["platforms"][0])


def test_validation_can_fail(archive, tmp_path):
    with zipfile.ZipFile(archive) as whole:
        text = whole.read("blender_manifest.toml").decode()
    (tmp_path / "__init__.py").touch()
    (tmp_path / "blender_manifest.toml").write_text(text.replace('tags = ["UV"]', 'tags = ["Nothing"]'))
    assert validate(tmp_path) != 0


def test_versions_of_blender_have_the_python_of_the_wheels(archive):
    manifest = manifest_of(archive)
    low, high = (tuple(map(int, manifest[f"blender_version_{end}"].split("."))) for end in ("min", "max"))
    assert low <= bpy.app.version < high
    # SciPy's wheel is for one Python; Blender 5.1 has Python 3.13.
    assert high == (5, 1, 0)
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    assert any(f"-{python}-" in wheel for wheel in manifest["wheels"] if "scipy" in wheel)


@pytest.mark.nightly
def test_zips_for_all_systems(tmp_path):
    subprocess.run([sys.executable, BUILD, "--platform", "all", "-o", tmp_path], check=True)
    for platform in PLATFORMS:
        (path,) = tmp_path.glob(f"*-{platform}.zip")
        assert validate(path) == 0
        assert_fits(path, platform)


@pytest.mark.nightly
def test_the_wheel_of_the_package_is_taken_from_a_folder(tmp_path, archive):
    (name,) = (name for name in manifest_of(archive)["wheels"] if "quasiharmonic" in name)
    wheels, out = tmp_path / "wheels", tmp_path / "out"
    wheels.mkdir()
    # The names that cibuildwheel gives them.
    compiled = "-".join([*Path(name).name.split("-")[:2], "cp311-abi3-win_amd64.whl"])
    pure = "-".join([*Path(name).name.split("-")[:2], "py3-none-any.whl"])
    with zipfile.ZipFile(archive) as whole:
        for one in (compiled, pure):
            (wheels / one).write_bytes(whole.read(name.removeprefix("./")))
    call = [sys.executable, BUILD, "--wheels", wheels, "-o", out]
    subprocess.run([*call, "--platform", "windows-x64", "windows-arm64"], check=True)
    for platform, expected in (("windows-x64", compiled), ("windows-arm64", pure)):
        (path,) = out.glob(f"*-{platform}.zip")
        assert f"./wheels/{expected}" in manifest_of(path)["wheels"]
    os.remove(wheels / pure)
    failed = subprocess.run([*call, "--platform", "windows-arm64"], capture_output=True, text=True)
    assert failed.returncode
    assert "has no wheel of quasiharmonic" in failed.stderr
