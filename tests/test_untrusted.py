"""Files from untrusted sources: sizes have bounds, nested JSON is an error, and no name leads out of the folder."""

from __future__ import annotations

import gzip
import io as memory
import json
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshData, MeshFileError
from quasiharmonic.io.fields import check_header
from quasiharmonic.io.untrusted import check_gifti, parse_json, read_npy, resolve_beside, unpack_gzip, use_bound
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.samples import read_samples

NESTED = b"[" * 100_000


def test_gzip_is_that_of_the_standard_library():
    data = np.random.default_rng(0).bytes(3_000_000) + bytes(3_000_000)
    assert unpack_gzip(gzip.compress(data)) == data
    assert unpack_gzip(gzip.compress(b"a") + gzip.compress(b"b") + bytes(7)) == b"ab"
    for broken in (gzip.compress(data)[:-10], b"no gzip", gzip.compress(b"a") + b"x"):
        with pytest.raises(ValueError, match=r"early|incorrect|invalid"):
            unpack_gzip(broken)


def test_decompressed_sizes_have_a_bound():
    packed = gzip.compress(bytes(20_000_000))
    with use_bound(10_000_000), pytest.raises(ValueError, match="more than the bound of 10,000,000"):
        unpack_gzip(packed)
    # The bound holds within the block only.
    assert len(unpack_gzip(packed)) == 20_000_000


def test_compressed_arrays_of_gifti_have_a_bound():
    import base64
    import zlib

    data = b'<DataArray Encoding="GZipBase64Binary"><Data>%s</Data>' % base64.b64encode(zlib.compress(bytes(9_000_000)))
    check_gifti(data)
    with use_bound(8_000_000), pytest.raises(ValueError, match="decompress to at least"):
        check_gifti(data)


@pytest.mark.parametrize("shape", ["huge", "overflowing", "negative"])
def test_an_array_must_have_the_data_that_its_header_announces(tmp_path, shape):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((3, 2)))
    start = path.read_bytes()
    told = {"huge": (10**9, 2000), "overflowing": (2**62, 2**62), "negative": (-1, 5)}[shape]
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {told}, }}".ljust(117).encode() + b"\n"
    path.write_bytes(start[:8] + len(header).to_bytes(2, "little") + header + bytes(48))
    with pytest.raises(ValueError, match="announces"):
        read_npy(path)
    with pytest.raises(MeshFileError):
        io.read_field(path)


def test_objects_and_other_files_are_no_arrays(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="allow_pickle"):
        read_npy(tmp_path / "a.npy")
    (tmp_path / "b.npy").write_bytes(b"")
    with pytest.raises(ValueError, match="magic"):
        read_npy(tmp_path / "b.npy")
    (tmp_path / "c.npy").write_bytes(b"\x93NUMPY\x01\x00\x16\x00{'descr': '<f8', 'shap\n" + bytes(400))
    with pytest.raises(ValueError, match="EOF in multi-line"):
        read_npy(tmp_path / "c.npy")


@pytest.mark.parametrize("data", [NESTED, b"{", b"\xff"])
def test_records_that_are_not_json_are_incomplete(tmp_path, data):
    with pytest.raises(ValueError, match=r"nested|Expecting|decode"):
        parse_json(data)
    (tmp_path / records.FILE).write_bytes(data)
    assert records.read_record(tmp_path) is None


@pytest.mark.parametrize("name", ["../x.png", "/x.png", "a/../../x.png", "C:\\x.png", "file:///x.png", "%2e%2e/x.png"])
def test_names_that_lead_out_of_a_folder(name):
    with pytest.raises(ValueError, match="not in the folder"):
        resolve_beside(Path("/here"), name)


def test_materials_show_images_of_the_folder_only(tmp_path):
    V, F = disk(2)
    folder = tmp_path / "model"
    (folder / "sub").mkdir(parents=True)
    for place in (tmp_path, folder, folder / "sub"):
        (place / "photo.png").write_bytes(io.checkerboard().data)
    io.write_mapped(folder / "m.obj", MeshData(V, F).with_map(V[:, :2]))
    text = (folder / "m.obj").read_text()
    for name, shown in (
        ("photo.png", True),
        ("sub/photo.png", True),
        ("../photo.png", False),
        (str(tmp_path / "photo.png"), False),
        (str(folder / "photo.png"), False),
    ):
        # The file is its own library of materials.
        (folder / "m.obj").write_text(f"mtllib m.obj\nmap_Kd {name}\n{text}")
        mesh = io.read_mesh(folder / "m.obj")
        assert (io.own_texture(mesh) is not None) == shown
        # A name can be listed without opening the file.
        assert io.texture_names(mesh) == ["photo.png"]
    (tmp_path / "out.mtl").write_text("map_Kd photo.png\n")
    (folder / "m.obj").write_text(f"mtllib ../out.mtl\n{text}")
    assert io.own_texture(io.read_mesh(folder / "m.obj")) is None


MHA = "ObjectType = Image\nNDims = 2\nDimSize = {size}\nElementType = MET_DOUBLE\nElementDataFile = {file}\n"
NRRD = "NRRD0004\ntype: double\nsizes: {size}\n{file}encoding: raw\n\n"


def test_fields_hold_their_own_data():
    check_header(MHA.format(size="4 4", file="LOCAL").encode() + bytes(100), ".mha")
    check_header(NRRD.format(size="4 4", file="").encode() + bytes(100), ".nrrd")
    for header, suffix in (
        (MHA.format(size="4 4", file="../secret"), ".mha"),
        (MHA.format(size="4 4", file="LIST"), ".mha"),
        (NRRD.format(size="4 4", file="data file: /secret\n"), ".nrrd"),
        (NRRD.format(size="4 4", file="datafile: secret\n"), ".nrrd"),
    ):
        with pytest.raises(ValueError, match="save the data in the file itself"):
            check_header(header.encode(), suffix)


@pytest.mark.parametrize(("header", "suffix"), [(MHA, ".mha"), (NRRD, ".nrrd")])
def test_fields_announce_a_bounded_size(header, suffix):
    local = "LOCAL" if suffix == ".mha" else ""
    with pytest.raises(ValueError, match="more than the bound"):
        check_header(header.format(size="1000000 1000000", file=local).encode(), suffix)


def tar_of(path, files):
    """Write a compressed tar file with members (name, data)."""
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, memory.BytesIO(data))
    return path


def test_members_of_archives_have_a_bound(tmp_path):
    path = tar_of(tmp_path / "a.tar.gz", [("a.obj", b"1"), ("b.obj", bytes(3_000_000)), ("c.obj", b"2")])
    a, b, c = read_samples(path, limit=1_000_000)
    assert (a.key, a.error, c.key, c.error) == ("a", None, "c", None)
    assert "b.obj" in b.error
    assert "more than the bound of 1,000,000" in b.error
    assert [one.error for one in read_samples(path)] == [None] * 3


def test_names_of_problems_stay_within_the_results(tmp_path):
    names = ["../../x.obj", "/y.obj", "a/../../z.obj", "b\\..\\w.obj"]
    found = read_samples(tar_of(tmp_path / "a.tar.gz", [(name, b"1") for name in names]))
    assert [(one.key, one.error) for one in found] == [("x", None), ("y", None), ("a/z", None), ("b/w", None)]


@pytest.mark.slow
def test_names_of_parquet_rows_stay_within_the_results(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = pyarrow.table({"__key__": ["../x", "..", "a"], "obj": [b"1", b"2", b"3"]})
    parquet.write_table(table, tmp_path / "a.parquet")
    assert [one.key for one in read_samples(tmp_path / "a.parquet")] == ["x", "000000001", "a"]


def test_nested_json_of_gltf_is_an_error(tmp_path):
    (tmp_path / "a.gltf").write_bytes(b'{"asset": ' + NESTED)
    with pytest.raises(MeshFileError):
        io.read_mesh(tmp_path / "a.gltf")
    assert json.loads("[[1]]") == parse_json("[[1]]")
    assert sys.getrecursionlimit() < len(NESTED)
