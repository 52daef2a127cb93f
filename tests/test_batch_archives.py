"""Data sets in tar and Parquet archives, local and by URL: streams, damage, interruptions, retries."""

from __future__ import annotations

import gzip
import io as streams
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest

from quasiharmonic import batch, io
from quasiharmonic.ui.batch import places, records
from quasiharmonic.ui.batch.readers import find_archives
from quasiharmonic.ui.batch.results import Result, read_about, read_results
from quasiharmonic.ui.batch.samples import read_samples
from quasiharmonic.ui.batch.tar_stream import Damage, read_members
from quasiharmonic.ui.batch.writers import Journal
from quasiharmonic.ui.cli import main
from shared.commands import linux
from shared.datasets import lasting, record_of, write_stars


def write_tar(path, files, **options):
    """Write a tar file by Python's own module."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, options.pop("mode", "w"), **options) as tar:
        for name, data in files:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, streams.BytesIO(data))
    return path


def samples_of(folder, names):
    """The members of problems in folders, with the names of WebDataset."""
    for name in names:
        yield f"{name}.obj", (folder / name / "input.obj").read_bytes()
        yield f"{name}.handles.txt", (folder / name / "handles.txt").read_bytes()


def members(data):
    return list(read_members(streams.BytesIO(data)))


class TestTarStream:
    @pytest.mark.parametrize("form", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT])
    def test_names_and_data_as_python_reads_them(self, tmp_path, form):
        files = [(name, name.encode() * 50) for name in ("a", "x" * 300 + "/ä", "ü.obj", "empty/" + "y" * 99)]
        files.append(("none", b""))
        path = write_tar(tmp_path / "a.tar", files, format=form)
        found = members(path.read_bytes())
        assert [(member.name, member.data) for member in found] == files

    def test_a_damaged_header_costs_one_member(self, tmp_path):
        files = [(f"{k}.obj", bytes([65 + k]) * 1500) for k in range(4)]
        path = write_tar(tmp_path / "a.tar", files)
        data = bytearray(path.read_bytes())
        data[2048 + 7] ^= 1  # in the second header
        first, damage, *rest = members(bytes(data))
        assert first.data == files[0][1]
        assert (type(damage), damage.start) == (Damage, 2048)
        assert [(member.name, member.data) for member in rest] == files[2:]

    def test_a_truncated_file_is_noticed_wherever_it_ends(self, tmp_path):
        files = [(f"{k}.obj", bytes([65 + k]) * 700) for k in range(3)]
        data = write_tar(tmp_path / "a.tar", files).read_bytes()
        content = 3 * 3 * 512
        for end in range(0, content + 1, 256):
            found = members(data[:end])
            whole = end // (3 * 512)
            assert [member.data for member in found[:whole]] == [data for _, data in files[:whole]]
            assert all(isinstance(one, Damage) for one in found[whole:])
            assert len(found) > whole
        assert len(members(data[: content + 512])) == 3

    def test_damaged_compression(self, tmp_path):
        data = write_tar(tmp_path / "a.tar", [("a.obj", os.urandom(5000)), ("b.obj", os.urandom(5000))]).read_bytes()
        (tmp_path / "a.tar.gz").write_bytes(gzip.compress(data)[:8000])
        first, last = read_samples(tmp_path / "a.tar.gz")
        assert first.files["obj"] == data[512:5512]
        assert "damaged" in last.error


class TestSamples:
    def test_layouts(self, tmp_path):
        files = [
            ("./a/1.obj", b"1"), ("./a/1.jpg", b"-"), ("./a/1.txt", b"2"),
            ("b/input.obj", b"3"), ("b/handles.txt", b"4"), ("c/2.ply", b"5"),
        ]  # fmt: skip
        found = list(read_samples(write_tar(tmp_path / "a.tar", files)))
        assert [(one.key, one.mesh, one.fixed) for one in found] == [
            ("a/1", "obj", "txt"), ("b", "obj", "txt"), ("c/2", "ply", None),
        ]  # fmt: skip
        assert [one.files[one.mesh] for one in found] == [b"1", b"3", b"5"]

    def test_obj_counts_before_ply_as_in_folders(self, tmp_path):
        files = [("a/input.ply", b"1"), ("a/input.obj", b"2"), ("b.obj", b"3"), ("b.ply", b"4")]
        found = list(read_samples(write_tar(tmp_path / "a.tar", files)))
        assert [(one.key, one.error, one.mesh, one.files) for one in found] == [
            ("a", None, "obj", {"obj": b"2"}), ("b", None, "obj", {"obj": b"3"}),
        ]  # fmt: skip
        for name in ("input.ply", "input.obj"):
            (tmp_path / name).touch()
        assert io.problem_files(tmp_path)[0].name == "input.obj"

    def test_unusable_problems_have_errors(self, tmp_path):
        files = [("a.obj", b""), ("b.txt", b""), ("a.obj", b""), ("c.v1.obj", b""), ("c.v2.obj", b"")]
        errors = [one.error for one in read_samples(write_tar(tmp_path / "a.tar", files))]
        assert errors[0] is None
        for error, words in zip(errors[1:], ("no mesh", "used twice", "several meshes"), strict=True):
            assert words in error

    @pytest.mark.parametrize(
        ("extensions", "damaged", "errors"),
        [(("obj", "txt"), 3, [False, True, True, False]), (("txt", "obj"), 4, [False, False, True, True])],
    )
    def test_a_list_of_fixed_vertices_that_may_be_lost(self, tmp_path, extensions, damaged, errors):
        """Without its list a problem would be another problem: its whole boundary would be fixed."""
        files = [(f"{k}.{extension}", b"0") for k in range(3) for extension in extensions]
        path = write_tar(tmp_path / "a.tar", files)
        data = bytearray(path.read_bytes())
        data[damaged * 1024 + 3] ^= 1  # the header of a list
        path.write_bytes(data)
        assert [bool(one.error) for one in read_samples(path)] == errors

    def test_parquet(self, tmp_path):
        pyarrow = pytest.importorskip("pyarrow")
        parquet = pytest.importorskip("pyarrow.parquet")
        table = pyarrow.table({
            "name": ["a", "b.c", None], "obj": [b"1", b"2", None], "txt": [[4, 5], None, [6]], "label": [1, 2, 3],
        })  # fmt: skip
        parquet.write_table(table, tmp_path / "a.parquet", row_group_size=1)
        a, b, c = read_samples(tmp_path / "a.parquet")
        assert (a.key, a.files) == ("a", {"obj": b"1", "txt": b"4\n5\n"})
        assert (b.key, b.files) == ("b.c", {"obj": b"2"})
        assert (c.key, c.error) == ("000000002", "it has no mesh")


class TestJournal:
    def result(self, name, data, form="obj"):
        record = {"problem": name, "outcome": "injective", "key": "0", "seconds": 0.1}
        return Result(name, record | ({} if data is None else records.describe_contents(data)), data, form)

    def test_a_damaged_map_counts_as_missing(self, tmp_path):
        journal = Journal(tmp_path / "r.tar")
        for name in "abc":
            journal.add(self.result(name, name.encode() * 30))
        data = journal.part.read_bytes()
        journal.part.write_bytes(data.replace(b"b" * 30, b"b" * 20 + bytes(10)))
        assert list(Journal(tmp_path / "r.tar").entries) == ["a", "c"]
        assert journal.part.stat().st_size == len(data)

    @pytest.mark.slow
    def test_cut_anywhere_it_continues(self, tmp_path):
        names = ["a", "b/ü", "x" * 120]
        journal = Journal(tmp_path / "r.tar")
        ends = [0]
        for name in names:
            journal.add(self.result(name, name.encode() * 30))
            ends.append(journal.part.stat().st_size)
        data = journal.part.read_bytes()
        for end in range(0, len(data) + 1, 128):
            (tmp_path / "s.tar.part").write_bytes(data[:end])
            again = Journal(tmp_path / "s.tar")
            whole = sum(one <= end for one in ends[1:])
            assert list(again.entries) == names[:whole]
            assert again.part.stat().st_size == ends[whole]
            for name in names[whole:]:
                again.add(self.result(name, name.encode() * 30))
            again.finish(names[::-1], "stamp", "settings", "obj")
            with tarfile.open(tmp_path / "s.tar") as tar:
                assert tar.getnames() == [name + suffix for name in names[::-1] for suffix in (".obj", ".json")]
                assert tar.extractfile(names[0] + ".obj").read() == names[0].encode() * 30
            assert read_about(tmp_path / "s.tar")["outcomes"] == [["injective", None, None, 3]]
            (tmp_path / "s.tar").unlink()

    @pytest.mark.slow
    @pytest.mark.parametrize(("name", "form"), [("r.tar", "ply"), ("r.parquet", "obj"), ("r.parquet", "ply")])
    def test_a_finished_archive_is_opened_again(self, tmp_path, name, form):
        pytest.importorskip("pyarrow")
        for step in range(3):
            journal = Journal(tmp_path / name)
            assert len(journal.entries) == step
            journal.add(self.result(str(step), None if step == 1 else b"v 0 0 0\n", form))
            journal.finish([str(k) for k in range(step + 1)], "stamp", "settings", form)
        found = [(key, record["problem"], data) for key, record, data, *_ in read_results(tmp_path / name)]
        assert found == [("0", "0", b"v 0 0 0\n"), ("1", "1", None), ("2", "2", b"v 0 0 0\n")]
        assert os.listdir(tmp_path) == [name]

    def test_a_copy_of_a_parquet_archive_that_was_killed_is_continued(self, tmp_path):
        pytest.importorskip("pyarrow")
        journal = Journal(tmp_path / "r.parquet")
        for name in "abc":
            journal.add(self.result(name, name.encode()))
        data = journal.part.read_bytes()
        journal.finish("abc", "stamp", "settings", "obj")
        journal.part.write_bytes(data[: len(data) // 2])
        assert sorted(Journal(tmp_path / "r.parquet").entries) == ["a", "b", "c"]


class TestFinding:
    def test_archives_are_found_by_folder_and_pattern(self, tmp_path):
        for name in ("d/0.tar", "d/e/1.tar.gz", "d/out/results/2.tar", "8.tar", "9.tar"):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(b"")
        (tmp_path / "d/out/qhm-batch.json").write_text("{}")

        def names(source):
            return [archive.name for archive in find_archives(source, plain=False)]

        assert names(tmp_path / "d") == ["0.tar", "e/1.tar.gz"]
        assert names(tmp_path / "{8..9}.tar") == ["8.tar", "9.tar"]
        assert names(tmp_path / "9.tar") == ["9.tar"]
        (tmp_path / "list.txt").write_text("9.tar\nd/0.tar # comment\nmemory://x/{08..10}.tar\n")
        assert names(tmp_path / "list.txt") == ["9.tar", "d/0.tar", "x/08.tar", "x/09.tar", "x/10.tar"]
        with pytest.raises(ValueError, match="no archive"):
            names(tmp_path / "{8..10}.tar")
        # Where there are problems in folders, archives are something else.
        (tmp_path / "d/p").mkdir()
        (tmp_path / "d/p/input.obj").write_text("")
        assert names(tmp_path / "d") == []


@pytest.fixture(scope="module")
def stars(tmp_path_factory):
    """Six problems in folders, and their results."""
    root = tmp_path_factory.mktemp("stars")
    source = write_stars(root / "set", list("abcdef"), rings=3)
    batch.run(source, root / "out", jobs=1)
    return source, root / "out"


def strip(record):
    kept = lasting(record)
    return {name: value for name, value in kept.items() if name not in ("problem", "source", "versions")}


@pytest.mark.usefixtures("quick_workers")
@pytest.mark.long
class TestRun:
    @pytest.mark.parametrize("form", ["obj", "ply"])
    def test_as_from_folders(self, tmp_path, stars, form):
        source, expected = stars
        if form == "ply":
            expected = tmp_path / "folders"
            batch.run(source, expected, batch.Settings(map_format="ply"), jobs=1)
        parquet = pytest.importorskip("pyarrow.parquet")
        import pyarrow

        write_tar(tmp_path / "set/x/0.tar.gz", samples_of(source, "cab"), mode="w:gz")
        write_tar(tmp_path / "set/1.tar", samples_of(source, "d"))
        rows = [{"name": name, "obj": mesh, "txt": io.read_handles(source / name / "handles.txt", 37).tolist()}
                for name in "ef" for mesh in [(source / name / "input.obj").read_bytes()]]  # fmt: skip
        parquet.write_table(pyarrow.Table.from_pylist(rows), tmp_path / "set/2.parquet")
        out = tmp_path / "out"
        assert main(["batch", str(tmp_path / "set"), "-o", str(out), "-j", "2", "--report", "--map-format", form]) == 0
        assert (out / "report.html").read_text().count("data:image/png") > 6
        rows = list(batch.read_table(out / "records.csv"))
        order = ["1.tar/d", "2.parquet/e", "2.parquet/f", "x/0.tar.gz/c", "x/0.tar.gz/a", "x/0.tar.gz/b"]
        assert [row["problem"] for row in rows] == order
        files = {path.relative_to(out / "results").as_posix() for path in (out / "results").rglob("*.*")}
        assert files == {"1.tar", "2.parquet", "x/0.tar"}
        for name in ("1.tar", "2.parquet", "x/0.tar"):
            for key, record, data, found, _ in read_results(out / "results" / name):
                assert found == form
                assert data == (expected / "results" / key / f"map.{form}").read_bytes()
                assert strip(record) == strip(record_of(expected, key))
        stamps = {path: path.stat().st_mtime_ns for path in out.rglob("results/**/*")}
        assert batch.run(tmp_path / "set", out, batch.Settings(map_format=form), jobs=1).resumed == 6
        assert stamps == {path: path.stat().st_mtime_ns for path in out.rglob("results/**/*")}

    def test_damage_change_and_move(self, tmp_path, stars):
        source, _ = stars
        path, out = write_tar(tmp_path / "set/0.tar", samples_of(source, "abc")), tmp_path / "out"
        data = bytearray(path.read_bytes())
        start = data.find(b"b.obj")
        path.write_bytes(data[: start + 3] + b"?" + data[start + 4 :])
        assert batch.run(tmp_path / "set", out, jobs=1).outcomes == {"injective": 2, "invalid": 2}
        errors = [row["error"] for row in batch.read_table(out / "records.csv")]
        assert [bool(error) for error in errors] == [False, True, True, False]
        assert f"byte {start}" in errors[1]
        # The archive is replaced by a whole one; only what was damaged is solved.
        path.write_bytes(data)
        mended = batch.run(tmp_path / "set", out, jobs=1)
        assert (mended.outcomes, mended.resumed) == ({"injective": 3}, 2)
        # It moves to another folder; its results go with it.
        (tmp_path / "set/moved").mkdir()
        path.rename(tmp_path / "set/moved/0.tar")
        assert batch.run(tmp_path / "set", out, jobs=1).resumed == 3
        assert next(batch.read_table(out / "records.csv"))["problem"] == "moved/0.tar/a"
        assert not (out / "results/0.tar").exists()

    @linux
    @pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
    def test_stopped_and_continued(self, tmp_path, stars, how):
        source, _ = stars
        write_tar(tmp_path / "set.tar", samples_of(source, "abcdef"))
        # One of the problems is slow, so that the others are finished before the run is killed.
        write_stars(tmp_path, ["slow"], rings=90)
        with tarfile.open(tmp_path / "set.tar", "a") as tar:
            tar.add(tmp_path / "slow/input.obj", "slow.obj")
            tar.add(tmp_path / "slow/handles.txt", "slow.txt")
        out = tmp_path / "out"
        command = [sys.executable, "-m", "quasiharmonic", "batch", str(tmp_path / "set.tar"), "-o", str(out), "-j", "1"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        part, end = out / "results/set.tar.part", time.monotonic() + 60
        while not part.exists() or part.stat().st_size < 40_000:
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.01)
        (note,) = out.glob("*.scratch")
        scratch = Path(note.read_text())
        assert scratch.exists()
        process.send_signal(how)
        if how == signal.SIGINT:
            assert process.wait() == 2
            assert not scratch.exists()
            finished = len(list(read_results(part)))
        else:
            assert process.wait() == -how
            assert scratch.exists()
            # As if the system had written the last result in part.
            with open(part, "r+b") as file:
                file.truncate(part.stat().st_size - 700)
            finished = len(list(read_results(part)))
        progress = batch.run(tmp_path / "set.tar", out, jobs=1)
        assert progress.outcomes == {"injective": 7}
        assert progress.resumed == finished > 0
        assert not scratch.exists()
        assert not part.exists()

    def test_an_interrupt_keeps_results_that_are_not_collected(self, tmp_path, stars):
        source, _ = stars
        write_tar(tmp_path / "set.tar", samples_of(source, "abcdef"))

        def interrupt(progress):
            if progress.done:
                scratch = Path(next((tmp_path / "out").glob("*.scratch")).read_text())
                end = time.monotonic() + 60
                while len(list(scratch.rglob("record.json"))) < 6 - progress.done:
                    assert time.monotonic() < end
                    time.sleep(0.01)
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            batch.run(tmp_path / "set.tar", tmp_path / "out", jobs=1, callback=interrupt)
        assert batch.run(tmp_path / "set.tar", tmp_path / "out", jobs=1).resumed == 6

    def test_failures_are_tried_again_if_asked_for(self, tmp_path, failing_worker):
        source = write_stars(tmp_path / "set", ["a", "bug"], rings=3)
        write_tar(tmp_path / "set.tar", samples_of(source, ["a", "bug"]))
        for retry, resumed in ((False, 0), (False, 2), (True, 1)):
            progress = batch.run(tmp_path / "set.tar", tmp_path / "out", jobs=1, retry=retry)
            assert (progress.outcomes, progress.resumed) == ({"injective": 1, "error": 1}, resumed)


class TestPlaces:
    def test_a_failed_read_is_tried_again(self, monkeypatch):
        fsspec = pytest.importorskip("fsspec")
        monkeypatch.setattr(places, "FIRST_PAUSE", 0.001)
        system = fsspec.filesystem("memory")
        system.pipe("/retries/a.tar", b"12345")
        left = [3]
        read = type(system).cat_file

        def fail(self, *arguments, **options):
            left[0] -= 1
            if left[0] >= 0:
                raise ConnectionResetError("lost")
            return read(self, *arguments, **options)

        monkeypatch.setattr(type(system), "cat_file", fail)
        assert places.read_start("memory://retries/a.tar", 3) == b"123"
        assert left == [-1]
        left[0] = 99
        with pytest.raises(OSError, match=r"memory://retries/a.tar: lost \(5 attempts\)"):
            places.read_start("memory://retries/a.tar", 3)
        left[0] = 0
        assert places.read_start("memory://retries/b.tar", 3) is None
        system.rm("/retries", recursive=True)

    def test_results_by_url_need_archives(self, tmp_path):
        pytest.importorskip("fsspec")
        source = write_stars(tmp_path / "set", ["a"], rings=3)
        with pytest.raises(ValueError, match="only if the problems are in archives"):
            batch.run(source, "memory://out")
        with pytest.raises(ValueError, match="no archives below memory://nothing"):
            batch.run("memory://nothing", tmp_path / "out")


@pytest.mark.usefixtures("quick_workers")
@pytest.mark.long
class TestUrls:
    @pytest.mark.parametrize("kind", ["memory", "file", "s3"])
    def test_inputs_and_outputs(self, tmp_path, stars, kind, request):
        fsspec = pytest.importorskip("fsspec")
        pytest.importorskip("pyarrow")
        base = {"memory": "memory://bucket", "file": f"file://{tmp_path}/bucket", "s3": "s3://bucket"}[kind]
        if kind == "s3":
            request.getfixturevalue("s3")
        source, expected = stars
        write_tar(tmp_path / "0.tar", samples_of(source, "ab"))
        write_tar(tmp_path / "1.tar", samples_of(source, "cd"))
        system, root = fsspec.core.url_to_fs(base)
        system.makedirs(f"{root}/set", exist_ok=True)
        for name in ("0.tar", "1.tar"):
            system.put_file(str(tmp_path / name), f"{root}/set/{name}")
        out = f"{base}/out"
        assert main(["batch", f"{base}/set", "-o", out, "-j", "1"]) == 0
        names = [one[len(root) :].lstrip("/") for one in system.find(root)]
        assert sorted(names) == [
            "out/qhm-batch.json", "out/records.csv", "out/results/0.tar", "out/results/1.tar", "set/0.tar", "set/1.tar",
        ]  # fmt: skip
        with tarfile.open(fileobj=streams.BytesIO(system.cat_file(f"{root}/out/results/1.tar"))) as tar:
            assert tar.extractfile("d.obj").read() == (expected / "results/d/map.obj").read_bytes()
            assert json.loads(tar.extractfile("d.json").read())["source"] == f"{base}/set/1.tar/d"
        # One more problem in an archive: the others are continued from the results in the store.
        write_tar(tmp_path / "1.tar", samples_of(source, "cde"))
        system.put_file(str(tmp_path / "1.tar"), f"{root}/set/1.tar")
        progress = batch.run(f"{base}/set/{{0..1}}.tar", out, jobs=1)
        assert (progress.resumed, progress.total) == (4, 5)
        rows = system.cat_file(f"{root}/out/records.csv").decode().splitlines()
        assert [row.split(",")[0] for row in rows[1:]] == ["0.tar/a", "0.tar/b", "1.tar/c", "1.tar/d", "1.tar/e"]
        system.rm(root, recursive=True)


@pytest.fixture
def s3(monkeypatch):
    """An S3 server on this machine, with an empty bucket."""
    server = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    running = server.ThreadedMotoServer(port=0, verbose=False)
    running.start()
    address = "http://{}:{}".format(*running.get_host_and_port())
    for name, value in {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_ENDPOINT_URL": address}.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("bucket")
    yield
    s3fs.S3FileSystem.clear_instance_cache()
    running.stop()
