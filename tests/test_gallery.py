"""The scripts on the pages of the gallery run without the modules that the examples share."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def scripts(tmp_path_factory):
    """Return the sources of the gallery, by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "_ext"))
        from standalone import write_gallery

        folder = tmp_path_factory.mktemp("gallery") / "source"
        write_gallery(ROOT / "examples", folder)
    return {path.stem: path.read_text(encoding="utf-8") for path in folder.rglob("*.py")}


@pytest.mark.long
@pytest.mark.parametrize("name", ["repair", "morph", "transfer"])
def test_script_runs_when_pasted(name, scripts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "common", raising=False)
    names = {}
    exec(compile(scripts[name].replace("print(main(", "(lambda *_: None)(("), name, "exec"), names)
    assert names["main"](tmp_path, size=12)
    assert (tmp_path / f"{name}.png").stat().st_size > 0


@pytest.mark.slow
def test_scripts_without_records_import_no_shared_module(scripts):
    shared = [name for name, text in scripts.items() if "from common import" in text]
    assert sorted(shared) == ["figure_10", "figure_13", "figure_14"]


@pytest.mark.slow
def test_captions_have_at_most_two_lines(scripts):
    for name, text in scripts.items():
        title, underline, empty, *caption = text.partition('"""')[2].partition('"""')[0].rstrip().split("\n")
        assert len(underline) >= len(title), name
        assert empty == ""
        assert len(caption) <= 2, name
