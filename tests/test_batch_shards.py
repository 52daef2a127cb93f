"""Data sets in shards, whose tables are merged, and the number of processes where memory runs out."""

from __future__ import annotations

import threading
import time

import pytest

from quasiharmonic import batch
from quasiharmonic.ui.batch.pool import Slots
from quasiharmonic.ui.batch.shards import Shard, lock_folder, lock_name, read_shard
from quasiharmonic.ui.cli import main
from shared.commands import linux
from shared.datasets import record_of, write_stars


class TestShards:
    def test_the_hash_is_the_same_in_every_version(self):
        """A run that continues after an update must find the same problems in each shard."""
        names = [f"a/{k}" for k in range(12)]
        assert [sum(i * Shard(i, 5).contains(name) for i in range(1, 6)) for name in names] == [
            2,
            2,
            1,
            1,
            5,
            4,
            4,
            2,
            1,
            4,
            4,
            1,
        ]

    @pytest.mark.parametrize("text", ["0/4", "5/4", "4", "-1/4", "1/0", "a/b", 3])
    def test_invalid(self, text):
        with pytest.raises(ValueError, match="shard"):
            read_shard(text)

    def test_each_shard_has_its_lock(self, tmp_path):
        locks = [lock_name(read_shard(text)) for text in (None, "1/2", "2/2")]
        with lock_folder(tmp_path, locks[0]), lock_folder(tmp_path, locks[1]), lock_folder(tmp_path, locks[2]):
            assert {file.name for file in tmp_path.iterdir()} == set(locks)
        assert len(set(locks)) == 3


@pytest.mark.usefixtures("quick_workers")
@pytest.mark.long
class TestArray:
    def test_out_of_order_and_merged(self, tmp_path, capsys):
        names = [f"{k // 4}/{k:02d}" for k in range(12)]
        source, out = write_stars(tmp_path / "set", names, rings=3), tmp_path / "out"
        found = [batch.run(source, out, jobs=1, shard=shard).total for shard in ("3/3", "1/3")]
        assert main(["batch", "-o", str(out), "--merge"]) == 1
        assert "no table of the shards 2/3" in capsys.readouterr().err
        assert main(["batch", str(source), "-o", str(out), "-j", "1", "--shard", "2/3"]) == 0
        found.append(int(capsys.readouterr().out.split()[0]))
        assert sum(found) == 12
        assert all(found)
        assert main(["batch", "-o", str(out), "--merge", "--report"]) == 0
        assert "12 of 12 problems" in capsys.readouterr().out
        assert sorted(row["problem"] for row in batch.read_table(out / "records.csv")) == names
        assert (out / "report.html").exists()
        # The shards are part of one run: the whole run finds all its problems solved.
        assert batch.run(source, out, jobs=1).resumed == 12
        assert not list(out.glob("records-*"))

    def test_shards_in_several_folders(self, tmp_path):
        source = write_stars(tmp_path / "set", list("abcdef"), rings=3)
        for i in (1, 2):
            batch.run(source, tmp_path / f"out{i}", jobs=1, shard=f"{i}/2", table="parquet")
        folders = [tmp_path / "out2", tmp_path / "out1"]
        assert batch.merge(folders, tmp_path / "all") == (6, 6, ())
        with pytest.raises(ValueError, match="belong to the same shard"):
            batch.merge([*folders, tmp_path / "out1"], tmp_path / "all")
        batch.run(source, tmp_path / "out3", batch.Settings(max_iterations=3), jobs=1)
        with pytest.raises(ValueError, match="different settings"):
            batch.merge([tmp_path / "out1", tmp_path / "out3"], tmp_path / "all")
        with pytest.raises(ValueError, match="out3 has one table, which the new one would replace"):
            batch.merge([tmp_path / "out3"], tmp_path / "out3")
        with pytest.raises(ValueError, match="no folder with tables"):
            batch.merge([], tmp_path / "all")
        with pytest.raises(ValueError, match="no table of records"):
            batch.merge([source], tmp_path / "all")

    def test_shards_with_different_settings_are_not_merged(self, tmp_path, capsys):
        source, out = write_stars(tmp_path / "set", list("abcdef"), rings=3), tmp_path / "out"
        batch.run(source, out, batch.Settings(max_iterations=90), jobs=1, shard="1/2")
        batch.run(source, out, jobs=1, shard="2/2")
        assert main(["batch", "-o", str(out), "--merge"]) == 2
        said = capsys.readouterr().err
        assert "records-1-of-2.csv and " in said
        assert "records-2-of-2.csv have different settings, --max-iterations (90 and 2000): " in said
        assert not (out / "records.csv").exists()
        batch.run(source, out, jobs=1, shard="1/2")
        assert batch.merge([out], out) == (6, 6, ())
        # A run of all problems replaces the shards.
        batch.run(source, out, batch.Settings(max_iterations=90), jobs=1)
        assert [path.name for path in out.glob("*.json")] == ["qhm-batch.json"]


class TestSlots:
    def test_the_limit_falls_and_rises(self):
        slots = Slots(4)
        slots.record(starved=True)
        assert slots.limit == 2
        for _ in range(3):
            slots.record(starved=True)
        assert slots.limit == 1
        limits = []
        for _ in range(100):
            slots.record(starved=False)
            limits.append(slots.limit)
        assert limits == sorted(limits)
        assert limits[-1] == 4
        assert limits[10] == 1

    def test_a_problem_alone_waits_for_the_others(self):
        slots, log = Slots(3), []
        began, go_on = threading.Barrier(3), threading.Event()

        def solve(name):
            with slots.one(lambda: None):
                began.wait()
                go_on.wait()
                log.append(name)

        def solve_alone():
            with slots.alone():
                log.append("alone")
                time.sleep(0.05)
                log.append("alone")

        def solve_later():
            with slots.one(lambda: log.append("rest")):
                log.append("later")

        threads = [threading.Thread(target=solve, args=(name,)) for name in "ab"]
        for thread in threads:
            thread.start()
        began.wait()
        threads += [threading.Thread(target=solve_alone)]
        threads[-1].start()
        while not slots.reserved:
            time.sleep(0.001)
        threads += [threading.Thread(target=solve_later)]
        threads[-1].start()
        while "rest" not in log:
            time.sleep(0.001)
        go_on.set()
        for thread in threads:
            thread.join()
        assert [name for name in log if name in ("alone", "later")] == ["alone", "alone", "later"]
        assert set(log[1:3]) == {"a", "b"}


@pytest.mark.long
@linux
def test_a_problem_that_was_killed_is_solved_again_alone(tmp_path, failing_worker, quick_workers):
    """As when other processes took the memory that it needs."""
    source = write_stars(tmp_path / "set", ["a", "revived", "x_killed", "z"], rings=4)
    progress = batch.run(source, tmp_path / "out", jobs=2)
    assert progress.outcomes == {"injective": 3, "crash": 1}
    assert "error" not in record_of(tmp_path / "out", "revived")
    assert (source / "revived" / "deaths.txt").read_text() == "xx"
    assert "SIGKILL" in record_of(tmp_path / "out", "x_killed")["error"]
