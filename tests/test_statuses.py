"""The page of statuses states what the code does."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import quasiharmonic as qh
from quasiharmonic import MapResult, Status, atlas
from quasiharmonic.results import UnwrapStatus
from quasiharmonic.util.outcome import BaseOutcome

PAGE = (Path(__file__).parent.parent / "docs" / "reference" / "statuses.md").read_text(encoding="utf-8")
ROWS = re.findall(
    r"^\| `(\w+)` \| (yes|no|yes or no) \| (yes|no|yes or no) \| (yes|no) \| (.+) \|$", PAGE, re.MULTILINE
)
F = np.array([[0, 1, 2]])
POSITIVE = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])


def test_every_status_has_a_row_in_the_order_of_the_code():
    assert [name for name, *_ in ROWS] == [status.name for status in Status]


@pytest.mark.parametrize(("name", "injective", "success", "converged", "why"), ROWS)
def test_row_states_success_and_convergence(name, injective, success, converged, why):
    maps = {"yes": [POSITIVE], "no": [POSITIVE[::-1]], "yes or no": [POSITIVE, POSITIVE[::-1]]}[injective]
    results = [MapResult(uv=uv, status=Status[name], certificate=qh.certify(F, uv)) for uv in maps]
    # "yes or no" in both columns: a success if the map is injective.
    expected = [True, False] if success == "yes or no" else len(maps) * [success == "yes"]
    assert [result.success for result in results] == expected
    assert {result.converged for result in results} == {converged == "yes"}


def test_the_message_of_a_status_says_whether_its_maps_are_injective():
    positive = {status.name for status in Status if status.value.startswith("Every triangle is strictly positive")}
    assert positive == {name for name, injective, *_ in ROWS if injective == "yes"}


def test_the_table_of_what_ends_a_search_names_statuses():
    text = (Path(__file__).parent.parent / "docs" / "development" / "extending.md").read_text(encoding="utf-8")
    table = text.split("## When the search stops\n")[1].split("\n## ")[0]
    ends = [line.split(" | ")[-1] for line in table.splitlines() if line.startswith("| ")][1:]
    named = [re.findall(r"`([A-Z_]+)`", end) for end in ends]
    assert all(named)
    # The other statuses are those of descents among injective maps.
    assert {name for names in named for name in names} == set(Status.__members__) - {
        *("POLISHED", "STILL_FALLING", "EXHAUSTED", "COLLAPSED", "NEARBY", "UNIMPROVED"),
    }


def classes(of=BaseOutcome):
    """Return the names of all classes of results."""
    return {of.__name__}.union(*(classes(sub) for sub in of.__subclasses__()))


def functions():
    """Return every public function whose result has `success`, with the name of the result's class."""
    for prefix, module in (("", qh), ("atlas.", atlas)):
        for name in set(module.__all__):
            function = getattr(module, name)
            if inspect.isfunction(function):
                answer = re.findall(r"\w+", str(inspect.signature(function).return_annotation))
                yield from ((prefix + name, one) for one in classes() & set(answer))


def test_every_function_with_an_outcome_is_listed_with_its_class():
    rows = re.findall(r"^\| (`[^|]*) \| (?:iterator of )?`(\w+)` \| .+ \|$", PAGE, re.MULTILINE)
    listed = [(name, kind) for names, kind in rows for name in re.findall(r"`([\w.]+)`", names)]
    assert sorted(listed) == sorted(functions())


def test_the_statuses_of_every_function_with_a_status_are_listed():
    table = PAGE.split("## The functions\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`[^|]*) \| (.+) \|$", table, re.MULTILINE)
    named = {name for names, _ in rows for name in re.findall(r"`([a-z_.]+)`", names)}
    assert named == {
        name
        for name, kind in functions()
        if kind
        not in (
            "RepairResult",
            "InvertibleField",
            "RefinedProblem",
            "UnwrapResult",
            "BakeResult",
            "TetrahedraResult",
            "InvertibleVolume",
        )
    }
    assert {name for _, listed in rows for name in re.findall(r"`([A-Z_]+)`", listed)} == {one.name for one in Status}


def test_the_statuses_of_unwrap_are_listed():
    rows = re.findall(r"^\| `(\w+)` \| (yes|no) \| [^|]+ \|$", PAGE, re.MULTILINE)
    assert [name for name, _ in rows] == [status.name for status in UnwrapStatus]
    said = "Every chart is bijective", "Every new chart is bijective"
    verified = {status.name for status in UnwrapStatus if status.value.startswith(said)}
    assert {name for name, success in rows if success == "yes"} == verified
