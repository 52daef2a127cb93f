"""What is published: versions locked for the checks, the conda recipe, licences of what is bundled, a release."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from quasiharmonic import __version__

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCKED = runpy.run_path(str(ROOT / ".ci" / "locked"))
# Packages that .ci/locked.txt leaves to their own index.
ELSEWHERE = {"mkl", "torch", "quasiharmonic"}


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_everything_that_the_checks_install_is_locked():
    scripts = [path.read_text("utf-8") for path in (ROOT / ".ci").iterdir() if path.is_file()]
    lines = [line for script in scripts for line in re.findall(r"^ *install ([^$\n]*)$", script, re.M)]
    calls = [re.sub("['\"]", "", line).split() for line in lines]
    assert len(calls) > 8
    for extras, *packages in calls:
        names = LOCKED["required_names"](extras.split(","))
        lines = LOCKED["choose"](names | {LOCKED["canonical_name"](name) for name in packages})
        assert lines.count("--hash=sha256:") >= len(re.findall("^[a-z].*==", lines, re.M)) > 0


def test_locked_versions_are_allowed():
    versions = re.findall(r"^([\w.-]+)==([^ ;]+)", text(".ci/locked.txt"), re.M)
    found = {}
    for name, version in versions:
        found.setdefault(canonicalize_name(name), []).append(version)
    lines = [*PROJECT["dependencies"], *(line for lines in PROJECT["optional-dependencies"].values() for line in lines)]
    needed = [one for one in map(Requirement, lines) if canonicalize_name(one.name) not in ELSEWHERE]
    assert len(needed) > 30
    for one in needed:
        assert any(one.specifier.contains(version) for version in found[canonicalize_name(one.name)]), str(one)


def test_a_package_that_is_not_locked_is_named():
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "locked"), "-", "nothing-of-the-kind"], capture_output=True, text=True
    )
    assert done.returncode
    assert "does not have nothing-of-the-kind" in done.stderr


def test_the_recipe_has_the_version():
    assert f'version: "{__version__}"' in text("conda/recipe.yaml")


def test_the_page_about_installation_lists_every_extra():
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| [^|]+ \|$", text("docs/install.md"), re.MULTILINE)
    assert sorted(rows) == sorted(PROJECT["optional-dependencies"])


def test_licences_of_all_that_is_bundled_are_listed():
    listed = text("THIRD_PARTY.md")
    build = runpy.run_path(str(ROOT / "blender" / "build.py"))
    for line in (*build["NEEDED"], build["FAST_SOLVER"], *PROJECT["dependencies"]):
        assert re.search(rf"\b{Requirement(line).name}\b", listed), line
    # Whatever is no text of this project has a line.
    own = {".py", ".pyi", ".js", ".css", ".html", ".c", ".h", ".typed"}
    files = [path for path in (ROOT / "src").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    others = [
        path
        for path in files
        if path.suffix not in own and ".egg-info" not in str(path) and "_compiled" not in path.name
    ]
    assert [path.name for path in others] == ["icon.svg"]
    assert all(path.name in listed for path in others)
    static = [path for path in files if path.parent.name == "static"]
    assert len(static) > 10
    # No library is loaded from elsewhere, and none has been copied: these name their licence in a first comment.
    for path in static:
        assert not re.search(
            r"@license|Copyright|\(c\) \d{4}|sourceMappingURL|https?://(?!www\.w3\.org)", path.read_text("utf-8")
        ), path
    records = [path for path in (ROOT / "benchmarks" / "records").iterdir() if path.suffix != ".md"]
    assert records
    assert "benchmarks/records" in listed


def test_a_release_is_one_step(tmp_path):
    prepare = runpy.run_path(str(ROOT / "scripts" / "prepare-release"))["prepare"]
    names = "src/quasiharmonic/__init__.py", "CITATION.cff", "conda/recipe.yaml", "CHANGELOG.md"
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text(name), encoding="utf-8")
    changelog = tmp_path / "CHANGELOG.md"
    first = "## Unreleased\n\n- A change.\n\n## 0.1.0\n"
    changelog.write_text(first, encoding="utf-8")
    for version, date in (("7.8.9", "2031-02-03"), ("7.8.9", "2031-02-04")):
        prepare(tmp_path, version, date)
    assert changelog.read_text("utf-8") == first.replace("Unreleased", "7.8.9 (2031-02-04)")
    changelog.write_text(first + changelog.read_text("utf-8"), encoding="utf-8")
    prepare(tmp_path, "7.8.10", "2031-02-05")
    for name in names:
        assert "7.8.10" in (tmp_path / name).read_text("utf-8"), name
    assert re.findall("^## (.*)$", changelog.read_text("utf-8"), re.M)[0] == "7.8.10 (2031-02-05)"
    assert (tmp_path / "CITATION.cff").read_text("utf-8").count("date-released") == 1
    with pytest.raises(SystemExit, match="no version"):
        prepare(tmp_path, "8", "2031-02-05")


@pytest.mark.slow
def test_the_trial_of_a_built_wheel_runs(capsys):
    """The script that `scripts/release-check` runs in each environment."""
    script = re.findall(r"<<'PYTHON'\n(.*?)\nPYTHON\n", text("scripts/release-check"), re.DOTALL)[-1]
    exec(compile(script, "release-check", "exec"), {})
    assert "iterations" in capsys.readouterr().out
