"""Durable writes of files."""

import errno
import os
import stat
import threading
from pathlib import Path

import pytest

from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable, write_durably, write_output


@pytest.mark.parametrize("fault", [errno.EINVAL, errno.EIO])
def test_a_file_system_that_writes_no_folders_to_the_disk_will_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: int
) -> None:
    """So do those of virtual machines' shared folders; a fault of the disk is told."""
    real = os.fsync

    def fsync(fd: int) -> None:
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            raise OSError(fault, os.strerror(fault))
        real(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    if fault == errno.EIO:
        with pytest.raises(OSError, match=os.strerror(fault)):
            write_durably(tmp_path / "meta.json", "{}")
    else:
        write_durably(tmp_path / "meta.json", "{}")
    assert [path.name for path in tmp_path.iterdir()] == ["meta.json"]
    assert (tmp_path / "meta.json").read_text() == "{}"


def test_two_threads_may_write_one_file_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, path = os.fsync, tmp_path / "meta.json"
    others = [threading.Thread(target=write_durably, args=(path, "2"))]

    def fsync(fd: int) -> None:
        if others:
            (other := others.pop()).start()
            other.join(10)
        real(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    write_durably(path, "1")
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == {"meta.json": "1"}


def test_a_folder_that_was_removed_is_not_made_again(tmp_path: Path) -> None:
    """It would look like a flight, of which nothing but its meta is there."""
    with pytest.raises(FileNotFoundError):
        write_durably(tmp_path / "flight" / "meta.json", "{}")
    assert not (tmp_path / "flight").exists()
    write_output(tmp_path / "new" / "out.json", "{}", "--out")
    assert (tmp_path / "new" / "out.json").read_text() == "{}"


def test_the_check_of_an_output_leaves_links_and_waits_for_no_reader(tmp_path: Path) -> None:
    link, pipe = tmp_path / "latest.json", tmp_path / "pipe"
    link.symlink_to("flight.json")
    require_writable(link, "--json")
    os.mkfifo(pipe)
    with pytest.raises(UserError, match=r"cannot write --json .*pipe"):
        require_writable(pipe, "--json")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["latest.json", "pipe"]
