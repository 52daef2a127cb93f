"""Messages on missing packages name an extra of the package as it was installed."""

from __future__ import annotations

import importlib
import importlib.metadata
import json

import pytest

from quasiharmonic.util.hints import explain_missing, with_extra


class Installed:
    def __init__(self, origin):
        self.origin = origin

    def read_text(self, name):
        assert name == "direct_url.json"
        return None if self.origin is None else json.dumps(self.origin)


def folder(path):
    return {"url": path.as_uri(), "dir_info": {}}


@pytest.mark.parametrize(
    ("origin", "words"),
    [
        (lambda here: None, "'quasiharmonic[pandas]'"),
        (folder, "'{here}[pandas]'"),
        (lambda here: folder(here / "gone"), "'.[pandas]' in the folder of the source"),
        (
            lambda here: {"url": "https://host/q.git", "vcs_info": {"vcs": "git"}},
            "'quasiharmonic[pandas] @ git+https://host/q.git'",
        ),
    ],
    ids=["an index", "a folder", "a folder that is gone", "a repository"],
)
def test_an_extra_comes_from_where_the_package_came(monkeypatch, tmp_path, origin, words):
    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: Installed(origin(tmp_path)))
    assert with_extra("pandas") == words.format(here=tmp_path)


def test_an_extra_of_a_package_that_is_not_installed(monkeypatch):
    def find(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", find)
    assert with_extra("pandas") == "'.[pandas]' in the folder of the source"


def test_a_missing_package_is_named_with_the_command():
    with (
        pytest.raises(ImportError, match=r"tables need nothing: pip install nothing \(No module"),
        explain_missing("tables need nothing", "nothing"),
    ):
        importlib.import_module("nothing_of_this_name")
