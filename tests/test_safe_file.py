"""Files are written whole or not at all; links, modes and devices stay what they are."""

import errno
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from thermoctl.files import safe_file
from thermoctl.files.safe_file import (
    WriteError,
    make_folder,
    move,
    part_file,
    whole_file,
    whole_files,
    write_text,
)


def test_a_link_stays_a_link_and_the_mode_stays(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    write_text(link, "new")
    assert link.is_symlink() and target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640 and len(os.listdir(tmp_path)) == 2


def test_an_error_on_the_way_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), whole_file(path) as part:
        Path(part).write_text("half")
        raise ZeroDivisionError
    with (
        pytest.raises(WriteError, match=r"a\.txt: cannot be written: .*; it is as it was before"),
        whole_file(path),
    ):
        raise OSError(5, "no matter")
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize(
    "name, why",
    [("none/a.txt", "No such file"), ("file/a.txt", "Not a directory"), ("dir", "Is a directory")],
)
def test_a_place_that_cannot_be_written_is_named(tmp_path, name, why):
    (tmp_path / "file").write_text("")
    (tmp_path / "dir").mkdir()
    with pytest.raises(WriteError, match=f"{name}: cannot be written: {why}.*try another"):
        write_text(tmp_path / name, "x", "try another")
    with pytest.raises(WriteError, match="Not a directory"):
        make_folder(tmp_path / "file" / "below")


@pytest.mark.parametrize(
    "number, advice",
    [
        (errno.ENOSPC, "No space left on device; free some space and run this again"),
        (errno.EDQUOT, "free some space of the user's quota and run this again"),
        (errno.EROFS, "Read-only file system; .*mount it for writing"),
        (errno.EACCES, "Permission denied; give the user the right to write there"),
        (errno.EIO, "Input/output error; .*the disk may be failing"),
    ],
)
def test_each_error_of_a_disk_has_a_remedy_of_its_own(tmp_path, number, advice):
    with pytest.raises(WriteError, match=advice), whole_file(tmp_path / "a.txt"):
        raise OSError(number, "")


def test_a_file_in_the_way_and_a_long_name_have_remedies(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(WriteError, match="a file stands where a folder belongs: move it"):
            make_folder(place)
    with pytest.raises(WriteError, match="File name too long; give a shorter path"):
        make_folder(tmp_path / ("x" * 300))


def test_a_device_or_a_pipe_is_written_directly():
    code = "from thermoctl.files.safe_file import write_text; write_text('/dev/stdout', 'hello'); write_text('/dev/null', 'x')"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "hello"
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_the_temporary_file_of_a_killed_writer_goes_with_the_next_one(tmp_path, monkeypatch):
    fd, dead = part_file(tmp_path / "a.txt")
    os.close(fd)
    old = time.time() - 2 * safe_file.STALE_S
    os.utime(dead, (old, old))
    held, alive = part_file(tmp_path / "b.txt")
    os.utime(alive, (old, old))
    write_text(tmp_path / "a.txt", "x")
    write_text(tmp_path / "b.txt", "x")
    assert not dead.exists() and alive.exists(), "one is locked: its writer lives"
    os.close(held)


def result(folder, names, remove=()):
    with whole_files(folder, remove) as part:
        for name in names:
            write_text(part / name, "new")


def test_a_result_of_several_files_appears_whole(tmp_path):
    folder = tmp_path / "out"
    result(folder, "ab")
    (folder / "mine").write_text("mine")
    (folder / "stale").write_text("old")
    result(folder, "ac", remove=["stale", "c"])
    assert sorted(os.listdir(folder)) == ["a", "b", "c", "mine"] and os.listdir(tmp_path) == ["out"]


def test_a_rename_that_fails_in_the_middle_is_undone(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    result(folder, "abc")
    for name in "abc":
        (folder / name).write_text("old")
    real = os.rename

    def refuse(source, target):
        if Path(target) == folder / "c":
            raise PermissionError(13, "refused")
        real(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(safe_file.os, "rename", refuse)
        with pytest.raises(WriteError, match="out: cannot be written: Permission denied"):
            result(folder, "abcd", remove=["b"])
    assert {n: (folder / n).read_text() for n in os.listdir(folder)} == {n: "old" for n in "abc"}


def test_a_file_is_moved_whole(tmp_path):
    (tmp_path / "a").write_text("x")
    move(tmp_path / "a", tmp_path / "b")
    assert os.listdir(tmp_path) == ["b"]
