"""The pages of benchmarks state what the data files contain."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import recorded
import speed

DOCS = Path(__file__).parent.parent / "docs"


def test_the_table_by_size_belongs_to_the_recorded_run():
    records = speed.read_csv(DOCS / "speed" / "speed.csv")
    for name, table in (("summary.md", speed.size_table), ("speed.md", speed.table)):
        described, _, text = (DOCS / "speed" / name).read_text(encoding="utf-8").partition("\n\n")
        assert "2 cores" in described
        assert text == table(records)
    assert not any(record.injective for record in records if record.tool in (speed.YARDSTICK, "scipy splu"))
    assert all(record.injective for record in records if record.tool == speed.OURS)


def test_composites_fail_or_find_a_map():
    runs = [record for record in speed.read_csv(DOCS / "speed" / "speed.csv") if record.tool == "igl composite"]
    assert all(record.injective for record in runs if record.seconds)
    assert [len(runs), sum(not record.seconds for record in runs)] == [6, 1]


def test_the_table_of_other_programs_belongs_to_the_records():
    text = (DOCS / "comparisons" / "tlc_foldover.md").read_text(encoding="utf-8")
    assert text == recorded.table_of_records()


def scenes():
    """Return the rows of each scene of `mesh_motion.csv`, by method and start."""
    found = {}
    with (DOCS / "mesh_motion" / "mesh_motion.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault(row["scene"], {})[row["method"], row["from"]] = row
    return found


@pytest.mark.parametrize("scene", scenes())
def test_order_of_the_methods_of_mesh_motion(scene):
    rows = scenes()[scene]
    steps = {key: int(row["steps"]) for key, row in rows.items()}
    end = int(rows["morph", "first"]["of"])
    assert steps.pop(("morph", "first")) == end
    first, second = sorted(steps, key=steps.get, reverse=True)[:2]
    assert (first, second) == (("MovingMesh", "last"), ("elasticity", "last"))
    assert steps[first] > steps[second]
    assert (steps[first] == end) == (scene not in ("turning disk", "sliding walls"))


def read_rows(path):
    """Return the rows of a table by column, without the machine before it."""
    _, _, table = path.read_text(encoding="utf-8").partition("\n\n")
    head, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines())
    return [dict(zip(head, line, strict=True)) for line in lines]


def test_unwraps_beside_those_of_other_programs():
    """What the landing page and the page of applications state."""
    assert "Blender 5.0" in (DOCS / "speed" / "unwrapping.md").read_text(encoding="utf-8")
    models = {}
    for row in read_rows(DOCS / "speed" / "unwrapping.md"):
        models.setdefault(row["model"], {})[row["program"]] = row
    assert len(models) == 14
    public = {"bull", "camel_atlas", "octopus_mainComp_f6000"}
    certified, less, larger = 0, 0, 0
    for name, rows in models.items():
        mine, smart, xatlas = rows["`unwrap`"], rows["Smart UV Project"], rows["xatlas"]
        assert (mine["certified"], smart["certified"]) == ("yes", "no")
        if name not in public:
            assert int(mine["charts"]) <= 0.15 * int(smart["charts"])
            assert float(mine["seams"]) <= 0.51 * float(smart["seams"])
        assert (float(mine["used"]) > float(xatlas["used"])) == (name != "creature_05")
        assert name == "camel_atlas" or int(mine["charts"]) <= 0.3 * int(xatlas["charts"])
        assert float(mine["seams"]) <= 0.5 * float(xatlas["seams"])
        assert 0.055 <= float(mine["seconds"]) / float(xatlas["seconds"]) <= 5.2
        assert float(smart["seconds"]) < 1
        certified += xatlas["certified"] == "yes"
        less += float(xatlas["stretch, 99 %"]) < float(mine["stretch, 99 %"])
        larger += float(xatlas["worst"].replace("∞", "inf")) > float(mine["worst"])
    assert (certified, less, larger) == (2, 7, 12)


def test_unwraps_beside_those_of_uvunwrap():
    """What the page of applications states."""
    rows = {(row["model"], row["program"]): row for row in read_rows(DOCS / "speed" / "unwrapping.md")}
    pairs = [(rows[name, "`unwrap`"], rows[name, "uvunwrap"]) for name in dict.fromkeys(name for name, _ in rows)]

    def ratios(column):
        return np.array([[float(row[column].replace("∞", "inf")) for row in pair] for pair in pairs]).T

    def median(column):
        return np.median(np.divide(*ratios(column)))

    assert median("charts") == pytest.approx(1 / 7, abs=0.01)
    assert median("seams") == pytest.approx(1 / 3, abs=0.03)
    assert median("seconds") == pytest.approx(2.5, abs=0.05)
    times = np.divide(*ratios("seconds"))
    assert (round(times.min(), 1), round(times.max(), 1)) == (1.1, 6.5)
    assert [int(np.greater(*ratios(column)).sum()) for column in ("used", "stretch, 99 %")] == [8, 12]
    assert int(np.less(*ratios("worst")).sum()) == 10
    assert sum(other["certified"] == "yes" for _, other in pairs) == 4


def test_hard_surface_models_beside_other_programs():
    """What the guide states about its table."""
    rows = read_rows(DOCS / "speed" / "hard_surface.md")
    medians, rows = rows[:2], rows[2:]
    assert [row["program"] for row in medians] == ["to uvunwrap", "to xatlas"]
    for row in medians:
        assert float(row["charts"]) <= 0.6
        assert float(row["seams"]) <= 0.8
    assert [float(row["CPU s"]) for row in medians] == pytest.approx([3.6, 2], abs=0.05)
    mine, peers = ({row["model"]: row for row in rows if row["program"] == way} for way in ("`unwrap`", "uvunwrap"))
    assert len(mine) == 13
    assert all(row["certified"] == "yes" and row["whole"] == row["stretch, 99 %"] == "1.00" for row in mine.values())
    fuller = {name for name in mine if float(peers[name]["used"]) > float(mine[name]["used"])}
    assert fuller == {"gear", "tube with caps"}
