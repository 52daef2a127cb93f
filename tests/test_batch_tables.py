"""Tables of records: CSV and Parquet, written and read back."""

from __future__ import annotations

import sys

import pytest

from quasiharmonic import batch, io
from quasiharmonic.ui.batch import driver, records

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]


class TestTables:
    @pytest.mark.parametrize("suffix", [".csv", ".parquet"])
    def test_written_tables_are_read_back(self, tmp_path, suffix):
        if suffix == ".parquet":
            pytest.importorskip("pyarrow")
        row = {"problem": 'caf\u00e9, "x"\n', "certified": True, "mips": 0.1 + 0.2}
        rows = [{**row, "vertices": k, "error": None} for k in range(2500)]
        records.write_table(tmp_path / f"t{suffix}", iter(rows))
        read = list(records.read_table(tmp_path / f"t{suffix}"))
        assert len(read) == 2500
        assert [row["vertices"] for row in read] == list(range(2500))
        assert {k: v for k, v in read[0].items() if v is not None} == {**row, "vertices": 0}

    def test_parquet(self, stars, tmp_path):
        pytest.importorskip("pyarrow")
        batch.run(stars, tmp_path / "out", jobs=1, table="parquet")
        table = list(batch.read_table(tmp_path / "out" / "records.parquet"))
        assert [row["problem"] for row in table] == ["a", "b/c", "b/d/e", "z"]
        assert table[0]["certified"] is True
        batch.run(stars, tmp_path / "out", jobs=1)
        assert [*batch.read_table(tmp_path / "out" / "records.csv")] == table
        assert not (tmp_path / "out" / "records.parquet").exists()

    def test_names_that_are_not_unicode(self, tmp_path):
        records.write_table(tmp_path / "t.csv", [{"problem": "bad\udcff"}])
        assert next(records.read_table(tmp_path / "t.csv"))["problem"] == r"bad\udcff"

    def test_foreign_tables(self, tmp_path):
        path = tmp_path / "tlc.csv"
        path.write_text("problem,seconds,host\na,1.5,x\nb,,y\n")
        assert list(records.read_table(path)) == [
            {"problem": "a", "seconds": 1.5, "host": "x"},
            {"problem": "b", "seconds": None, "host": "y"},
        ]
        for text, words in (
            ("name,seconds\na,1\n", "record 1 has no problem; a column `problem` is needed"),
            ("problem,seconds\na,fast\n", "record 1: 'fast' is not a valid float for seconds"),
            ("problem,certified\na,maybe\n", "'maybe' is not a valid bool"),
        ):
            path.write_text(text)
            with pytest.raises(io.MeshFileError, match=words):
                list(records.read_table(path))
        with pytest.raises(io.MeshFileError, match="cannot be read as a table"):
            list(records.read_table(tmp_path / "none.csv"))
        with pytest.raises(ValueError, match=r"csv or .parquet"):
            list(records.read_table(tmp_path / "t.xls"))

    def test_a_missing_or_damaged_map_is_made_again(self, stars, tmp_path):
        out = tmp_path / "out"
        batch.run(stars / "a", out)
        (record,) = (out / "results").rglob("record.json")
        maps = [path for path in record.parent.iterdir() if path != record]
        assert batch.run(stars / "a", out).resumed == 1
        for spoil in (
            lambda path: path.write_bytes(path.read_bytes()[:-9]),
            lambda path: path.write_bytes(path.read_bytes()[:-9] + bytes(9)),
            lambda path: path.unlink(),
        ):
            whole = [path.read_bytes() for path in maps]
            for path in maps:
                spoil(path)
            assert batch.run(stars / "a", out).resumed == 0
            assert [path.read_bytes() for path in maps] == whole

    def test_invalid_tables(self, tmp_path):
        pytest.importorskip("pyarrow")
        table = tmp_path / "records.parquet"
        for text in (b"", b"PAR1 and nothing else"):
            table.write_bytes(text)
            with pytest.raises(ValueError, match=r"records\.parquet: cannot be read as a table"):
                list(batch.read_table(table))

    def test_a_memory_limit_on_systems_without_support(self, stars, tmp_path, monkeypatch):
        monkeypatch.setattr(driver, "resident", lambda pid: None)
        with pytest.raises(ValueError, match=r"needs psutil on this system: pip install '.*\[batch\]'"):
            batch.run(stars, tmp_path / "out", memory_limit=1 << 30)

    def test_parquet_without_pyarrow(self, stars, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        with pytest.raises(ImportError, match=r"pip install '.*\[batch\]'"):
            batch.run(stars, tmp_path / "out", table="parquet")
        assert not (tmp_path / "out").exists()
