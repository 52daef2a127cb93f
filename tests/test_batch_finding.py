"""The problems of a data set are found in folders, lists and mesh files."""

from __future__ import annotations

import errno
import os
import re

import pytest

from quasiharmonic import batch
from shared.datasets import record_of, write_stars

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]


def names(source, **options):
    return [problem.name for problem in batch.find_problems(source, **options)]


class TestFinding:
    def test_any_depth_in_order(self, stars):
        (stars / "b" / "notes.txt").write_text("no problem")
        (stars / "b" / "other.obj").write_text("no problem by itself")
        found = list(batch.find_problems(stars))
        assert [problem.name for problem in found] == ["a", "b/c", "b/d/e", "z"]
        assert found[1].mesh == stars / "b/c/input.obj"
        assert found[1].fixed == stars / "b/c/handles.txt"

    @pytest.mark.skipif(os.name != "posix", reason="makes links and pipes")
    def test_unreadable_files_are_invalid_and_delay_nothing(self, stars, tmp_path):
        (stars / "a" / "handles.txt").unlink()
        (stars / "a" / "handles.txt").symlink_to("nowhere")
        (stars / "z" / "input.obj").unlink()
        os.mkfifo(stars / "z" / "input.obj")
        assert batch.run(stars, tmp_path / "out", jobs=1).outcomes == {"injective": 2, "invalid": 2}
        a, z = (record_of(tmp_path / "out", name)["error"] for name in "az")
        assert re.fullmatch(r"\S+/a/handles.txt: cannot be read: No such file or directory", a)
        assert re.fullmatch(r"\S+/z/input.obj: cannot be read: it is not a regular file", z)

    def test_an_unreadable_folder_is_reported(self, stars, tmp_path, monkeypatch):
        def refuse(folder):
            if folder == stars / "b" / "d":
                raise PermissionError(errno.EACCES, "Permission denied", str(folder))
            return scandir(folder)

        scandir = os.scandir
        monkeypatch.setattr(os, "scandir", refuse)
        with pytest.raises(OSError, match=r"\S+/b/d: the folder cannot be read: Permission denied"):
            batch.run(stars, tmp_path / "out")

    def test_a_problem_folder_may_contain_others(self, stars):
        write_stars(stars, ["b"])
        assert names(stars) == ["a", "b", "b/c", "b/d/e", "z"]
        assert names(stars / "a") == ["a"]
        assert names(stars / "b") == ["b", "b/c", "b/d/e"]
        (stars / "a" / "handles.txt").unlink()
        assert next(batch.find_problems(stars)).fixed is None

    def test_plain_meshes(self, stars):
        (stars / "b" / "other.OFF").write_text("")
        (stars / "b" / "._other.OFF").write_text("")
        assert names(stars, plain=True) == [
            "a/input.obj", "b/c/input.obj", "b/d/e/input.obj", "b/other.OFF", "z/input.obj",
        ]  # fmt: skip
        assert names(stars / "a" / "input.obj") == ["input.obj"]

    def test_every_entry_of_a_list_is_a_folder(self, stars):
        (stars / "empty").mkdir()
        (stars / "notes").mkdir()
        (stars / "notes" / "other.obj").write_text("no problem by itself")
        for name in ("empty", "notes"):
            (stars / "list.txt").write_text(f"a\n{name}\nz\n")
            with pytest.raises(ValueError, match=rf"list.txt: line 2: there is no problem in the folder '{name}'"):
                names(stars / "list.txt")
        assert names(stars / "list.txt", plain=True)[1] == "notes/other.obj"
        # A problem listed twice is found once.
        (stars / "list.txt").write_text("b/c\nb\nb\n")
        assert names(stars / "list.txt") == ["b/c", "b/d/e"]

    @pytest.mark.skipif(os.name != "posix", reason="makes links")
    def test_cyclic_links_delay_nothing(self, stars):
        (stars / "one").symlink_to("two")
        (stars / "two").symlink_to("one")
        (stars / "b" / "self").symlink_to("self")
        (stars / "b" / "nowhere").symlink_to("missing")
        (stars / "b" / "up").symlink_to("..")
        assert names(stars) == ["a", "b/c", "b/d/e", "z"]

    def test_lists_name_folders_and_meshes(self, stars, tmp_path):
        elsewhere = write_stars(tmp_path / "elsewhere", ["y"])
        text = f"# a list\n\nz # the last\nb\n{elsewhere}/y\nb/c\na/input.obj\n"
        (stars / "list.txt").write_text(text)
        assert names(stars / "list.txt") == ["z", "b/c", "b/d/e", f"{elsewhere}/y".lstrip("/"), "a/input.obj"]
        write_stars(stars, ["no#1"])
        (stars / "list.txt").write_bytes(b"\xef\xbb\xbfno#1\r\n\t# from another system\r\n")
        assert names(stars / "list.txt") == ["no#1"]
        (stars / "list.txt").write_text("a\nnowhere\n")
        with pytest.raises(ValueError, match=r"list.txt: line 2: .*nowhere"):
            names(stars / "list.txt")
        (stars / "list.txt").write_bytes(b"\x89PNG\r\n\x1a\0")
        with pytest.raises(ValueError, match=r"line 1: there is no folder and no mesh file '\\udc89PNG'"):
            names(stars / "list.txt")
        with pytest.raises(ValueError, match="there is no folder, list or mesh"):
            names(stars / "none")

    def test_output_is_not_used_as_input(self, stars):
        batch.run(stars, stars / "out", jobs=1)
        assert names(stars) == ["a", "b/c", "b/d/e", "z"]
        assert len(names(stars, plain=True)) == 4

    @pytest.mark.skipif(os.name != "posix", reason="makes links")
    def test_links_are_followed_except_cycles(self, stars):
        (stars / "linked").symlink_to(stars / "b")
        (stars / "b" / "back").symlink_to(stars)
        assert names(stars) == ["a", "b/c", "b/d/e", "linked/c", "linked/d/e", "z"]
