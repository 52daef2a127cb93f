"""The pages of benchmarks state what the data files contain."""

from __future__ import annotations

import csv
from pathlib import Path

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


def test_composites_fail_or_find_a_map_and_mouette_always_finds_one():
    runs = {}
    for record in speed.read_csv(DOCS / "speed" / "speed.csv"):
        runs.setdefault(record.tool, []).append(record)
    assert all(record.injective for tool in ("igl composite", "mouette") for record in runs[tool] if record.seconds)
    assert [len(runs["igl composite"]), sum(not record.seconds for record in runs["igl composite"])] == [19, 6]
    assert [len(runs["mouette"]), sum(not record.seconds for record in runs["mouette"])] == [6, 0]


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


def test_unwraps_beside_those_of_blender():
    text = (DOCS / "speed" / "unwrapping_blender.md").read_text(encoding="utf-8")
    described, _, table = text.partition("\n\n")
    assert "Blender 5.0" in described
    head, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines())
    models = {}
    for line in lines:
        row = dict(zip(head, line, strict=True))
        models.setdefault(row["model"], {})[row["program"]] = row
    assert len(models) == 11
    seams = "Minimum Stretch, seams of "
    slower, fuller, less = [], 0, 0
    for rows in models.values():
        mine, smart = rows["`unwrap`"], rows["Smart UV Project"]
        most, same = rows[seams + "Smart UV Project"], rows[seams + "`unwrap`"]
        assert (mine["certified"], mine["wrong"]) == ("yes", "0")
        assert int(mine["charts"]) <= int(smart["charts"]) / 5
        assert float(mine["seams"]) <= 0.6 * float(smart["seams"])
        assert float(smart["seconds"]) < 0.5
        assert float(most["worst"]) > float(mine["worst"])
        assert float(same["stretch, 99 %"]) > float(mine["stretch, 99 %"])
        assert float(same["used"]) < float(mine["used"])
        less += float(most["stretch, 99 %"]) < float(mine["stretch, 99 %"])
        fuller += float(most["used"]) > float(mine["used"])
        slower.append(float(most["seconds"]) / float(mine["seconds"]))
    assert min(slower) > 5
    assert max(slower) < 36
    assert (less, fuller) == (8, 2)


def test_hard_surface_models_beside_other_programs():
    """What the guide states about its table."""
    text = (DOCS / "speed" / "hard_surface.md").read_text(encoding="utf-8")
    _, _, table = text.partition("\n\n")
    head, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines())
    rows = [dict(zip(head, line, strict=True)) for line in lines]
    medians, rows = rows[:2], rows[2:]
    assert [row["program"] for row in medians] == ["to uvunwrap", "to xatlas"]
    for row in medians:
        assert float(row["charts"]) <= 0.6
        assert float(row["seams"]) <= 0.8
        assert 3.5 <= float(row["CPU s"]) <= 7.5
    mine, peers = ({row["model"]: row for row in rows if row["program"] == way} for way in ("`unwrap`", "uvunwrap"))
    assert len(mine) == 13
    assert all(row["certified"] == "yes" and row["whole"] == row["stretch, 99 %"] == "1.00" for row in mine.values())
    fuller = {name for name in mine if float(peers[name]["used"]) > float(mine[name]["used"])}
    assert fuller == {"gear", "tube with caps"}
