"""Files of a data set: links in tar archives, FreeSurfer's surfaces, and messages about unsupported files."""

from __future__ import annotations

import gzip
import io as streams
import struct
import tarfile

import pytest

from quasiharmonic import batch
from quasiharmonic.ui.batch.readers import find_archives
from quasiharmonic.ui.batch.samples import read_samples

FORMS = [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT]


def write_tar(path, files, form=tarfile.PAX_FORMAT):
    """Write a tar file of names and the types of their members; the links refer to the first."""
    with tarfile.open(path, "w", format=form) as tar:
        for name, kind in files:
            info = tarfile.TarInfo(name)
            info.type = kind
            data = b"v 0 0 0\n" if kind == tarfile.REGTYPE else b""
            info.size, info.linkname = len(data), "" if data else files[0][0]
            tar.addfile(info, streams.BytesIO(data))
    return path


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("first", ["h/a.obj", "h/" + "x" * 200 + ".obj"])
def test_links_in_tar_archives_are_reported(tmp_path, form, first):
    """GNU tar stores hard-linked files as links. They were lost without a message."""
    files = [
        (first, tarfile.REGTYPE), ("h/b.obj", tarfile.LNKTYPE), ("h/c.obj", tarfile.SYMTYPE),
        ("h/c.jpg", tarfile.SYMTYPE), ("h/d.obj", tarfile.REGTYPE), ("h/d.txt", tarfile.SYMTYPE),
        ("h/e.obj", tarfile.REGTYPE), ("h/e.jpg", tarfile.LNKTYPE), ("h/b.txt", tarfile.SYMTYPE),
    ]  # fmt: skip
    found = {one.key: one.error for one in read_samples(write_tar(tmp_path / "h.tar", files, form))}
    link = f"is a link to {first}, which a stream cannot follow: repack with tar --hard-dereference -h"
    assert found == {
        first.removesuffix(".obj"): None,
        "h/b": f"h/b.obj {link}",
        "h/c": f"h/c.obj {link}",
        "h/d": f"h/d.txt {link}",
        "h/e": None,
        "h/b (2)": "the name h/b is used twice in the archive",
    }


def test_hidden_files_are_no_problems(tmp_path):
    """Archives made on macOS have a file ``._a.obj`` before ``a.obj``."""
    files = [(f"h/{name}", tarfile.REGTYPE) for name in ("._a.obj", "a.obj", "._a.txt", "a.txt")]
    (found,) = read_samples(write_tar(tmp_path / "h.tar", files))
    assert (found.key, found.mesh, found.fixed, found.error) == ("h/a", "obj", "txt", None)
    write_tar(tmp_path / "._h.tar", files)
    assert [one.name for one in find_archives(tmp_path, plain=True)] == ["h.tar"]


def test_surfaces_of_freesurfer_are_found(tmp_path):
    """Files beside the surfaces, such as data per vertex, have similar names."""
    folder = tmp_path / "surf"
    folder.mkdir()
    contents = {
        "a.obj": b"",
        "lh.pial": b"\xff\xff\xfecreated by",
        "lh.cortex.patch.3d": struct.pack(">ii", -1, 1),
        "lh.ascii": b"#!ascii version of lh.pial",
        "rh.x.surf.gii.gz": gzip.compress(b""),
        "lh.thickness": b"\xff\xff\xff\0\0\1\0",
        "lh.aparc.annot": b"\xff\xff\xfe",
        "lh.curv.csv": b"",
        "change.patch": b"--- a/x",
        "notes": b"",
    }
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    surfaces = ["a.obj", "lh.ascii", "lh.cortex.patch.3d", "lh.pial", "rh.x.surf.gii.gz"]
    assert [one.name for one in batch.find_problems(folder, plain=True)] == surfaces
    (tmp_path / "list.txt").write_text("".join(f"surf/{name}\n" for name in surfaces))
    assert [one.name for one in batch.find_problems(tmp_path / "list.txt")] == [f"surf/{name}" for name in surfaces]
    assert [one.name for one in batch.find_problems(folder / "lh.pial")] == ["lh.pial"]


@pytest.mark.parametrize("name", ["m.zip", "m.tar.bz2", "m.tar.xz", "m.obj.gz"])
def test_archives_that_are_not_supported_are_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\3\4")
    (tmp_path / "list.txt").write_text(f"{name}\n")
    for source in (name, "list.txt"):
        with pytest.raises(ValueError, match=r"\.\w+ files are not supported: pack the data set as .tar, "):
            batch.run(tmp_path / source, tmp_path / "out")


def test_rows_with_several_meshes(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table({"name": ["a.b"], "obj": [b"1"], "stl": [b"2"]}), tmp_path / "a.parquet")
    (sample,) = read_samples(tmp_path / "a.parquet")
    assert sample.error == "it has several meshes: obj, stl (remove all of these columns but one)"
