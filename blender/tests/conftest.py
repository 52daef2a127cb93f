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


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: seconds")


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
    return "bl_ext.user_default.quasiharmonic"


@pytest.fixture(autouse=True)
def _scene(extension):
    """An empty file for each test."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    for meshes in (bpy.data.meshes, bpy.data.curves):
        for one in list(meshes):
            meshes.remove(one)
    bpy.ops.ed.undo_push(message="empty")
