"""The page of statuses states what the code does."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import quasiharmonic as qh
from quasiharmonic import MapResult, Status, atlas
from quasiharmonic.apps.tetrahedra.result import TetrahedraStatus
from quasiharmonic.problem.diagnosis import Kind
from quasiharmonic.results import UnwrapStatus
from quasiharmonic.surfaces import disk, grid
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


# Statuses of complete work.
COMPLETE = {"INJECTIVE", "POLISHED", "NEARBY", "UNWRAPPED", "FIRST_VALID"}
VERBS = (
    "Add|Allow|Change|Clean|Correct|Cut|Fix|Flatten|Follow|Give|Make|Move|Open|Permit|Raise|Remove|Reflect|Reverse|"
    "Smooth|Split|Try|Untwist|Use"
)
# The imperative begins a sentence, or follows a colon, a semicolon, a comma with "or", or a condition.
ACTION = re.compile(rf"(?:^|[.:;] |, |, or )({VERBS}|{VERBS.lower()})\b")


def test_the_check_finds_actions():
    assert ACTION.search("The energy was still falling: allow more iterations.")
    assert ACTION.search("Every triangle is positive. Cut the surface.")
    for text in ("This is the best map so far.", "No move is allowed here.", "The obstructions are listed."):
        assert not ACTION.search(text)


@pytest.mark.parametrize("status", [*Status, *UnwrapStatus, *TetrahedraStatus], ids=str)
def test_a_status_has_an_action_unless_the_work_is_complete(status):
    assert bool(ACTION.search(status.value)) is (status.name not in COMPLETE)


def test_a_status_names_the_function_and_the_command_of_an_option():
    """Most functions and commands that return a status lack the option."""
    for status in [*Status, *TetrahedraStatus]:
        for command, option in re.findall(r"(\S+ \S+:)? (--[a-z]+)", status.value):
            assert command.startswith("qhm "), option
        assert "(refine" not in status.value


@pytest.mark.parametrize("kind", Kind, ids=str)
def test_an_obstruction_has_an_action(kind):
    assert ACTION.search(kind.value)


def fold_voxels():
    field = np.zeros((4, 4, 4, 3))
    field[1, 1, 1] = field[2, 1, 1] = (5, 0, 0)
    return qh.nearest_invertible(field, fixed=np.ones((4, 4, 4), dtype=bool))


def leave_the_frame():
    points, F = grid(4, 4)
    return qh.morph(points, F, [12], [[3.0, 0.5]])


def animate_without_map():
    V, triangles = disk(3)
    (rim,) = qh.boundary_loops(triangles)
    return qh.animate(qh.Problem(V, triangles, rim, V[rim]), [V[rim], V[rim] * [-1, 1]])


def repair_without_boundary():
    V, triangles = grid(3, 3)
    uv = V.copy()
    uv[0] = np.nan
    return qh.repair(V, triangles, uv)


@pytest.mark.parametrize("call", [fold_voxels, leave_the_frame, animate_without_map, repair_without_boundary])
def test_the_message_of_a_failure_has_an_action(call):
    result = call()
    assert not result.success
    assert ACTION.search(result.message)


def test_statuses_with_an_action_link_to_remedies():
    table = PAGE.split("| status | what to do |\n")[1].split("\n\n")[0]
    rows = re.findall(r"^\| (`.+`) \| .+\]\(([^)#]*)(?:#([\w-]+))?\)\. \|$", table, re.MULTILINE)
    assert len(rows) == table.count("\n")
    named = {name for names, *_ in rows for name in re.findall(r"`(\w+)`", names)}
    assert named == {one.name for one in [*Status, *UnwrapStatus, *TetrahedraStatus]} - COMPLETE
    folder = Path(__file__).parent.parent / "docs" / "reference"
    for _, page, anchor in rows:
        text = (folder / (page or "statuses.md")).read_text(encoding="utf-8")
        headings = [
            re.sub(r"[^\w -]", "", line).replace(" ", "-").lower() for line in re.findall("^#+ (.+)$", text, re.M)
        ]
        assert not anchor or anchor in headings
