"""The zip is built and installed, as Blender does it, before any test: into a folder of its own."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

# Read when bpy is imported.
_FOLDER = tempfile.TemporaryDirectory(prefix="qhm-blender-")
os.environ["BLENDER_USER_RESOURCES"] = _FOLDER.name

bpy = pytest.importorskip("bpy")

BUILD = Path(__file__).parents[1] / "build.py"
MODULE = "bl_ext.user_default.quasiharmonic"


def pytest_addoption(parser):
    parser.addoption("--nightly", action="store_true", help="run the long tests, too")


def pytest_collection_modifyitems(config, items):
    if not config.getoption("nightly"):
        left = [item for item in items if item.get_closest_marker("nightly")]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in left]


@pytest.fixture(scope="session")
def archive(tmp_path_factory):
    """The zip, built by the one command."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, BUILD, "-o", folder], check=True)
    (path,) = folder.glob("*.zip")
    return path


@pytest.fixture(scope="session")
def extension(archive):
    """The extension, installed and enabled; its module's name."""
    done = bpy.ops.extensions.package_install_files(repo="user_default", filepath=str(archive), enable_on_install=True)
    assert done == {"FINISHED"}
    return MODULE


@pytest.fixture(autouse=True)
def _empty_scene(extension):
    """Nothing of an earlier test."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for items in (bpy.data.objects, bpy.data.meshes, bpy.data.curves):
        for one in list(items):
            items.remove(one)


@pytest.fixture
def said(capfd):
    """What operators have reported since the last call."""
    return lambda: capfd.readouterr().out
