import os
from pathlib import Path

import pytest

from policy.engines import openvino_compile
from policy.engines.openvino_compile import MAX_ENTRIES, CompileCache, user_cache_folder

BLOB = b"a compiled graph" * 100


def only_file(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_keeps_what_was_stored_by_key(tmp_path: Path) -> None:
    cache = CompileCache(tmp_path / "new" / "folder")
    assert cache.load("a") is None
    cache.store("a", BLOB)
    cache.store("b", b"")
    assert (cache.load("a"), cache.load("b"), cache.load("c")) == (BLOB, b"", None)
    cache.store("a", b"newer")
    assert cache.load("a") == b"newer"


@pytest.mark.parametrize("kept", [0, 1, 31, 32, 33, len(BLOB) + 31])
def test_a_file_cut_short_is_no_entry(tmp_path: Path, kept: int) -> None:
    cache = CompileCache(tmp_path)
    cache.store("a", BLOB)
    path = only_file(tmp_path)
    path.write_bytes(path.read_bytes()[:kept])
    assert cache.load("a") is None
    cache.store("a", BLOB)
    assert cache.load("a") == BLOB


@pytest.mark.parametrize("at", [0, 31, 32, 500, -1])
def test_a_flipped_bit_is_noticed(tmp_path: Path, at: int) -> None:
    cache = CompileCache(tmp_path)
    cache.store("a", BLOB)
    path = only_file(tmp_path)
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)
    assert cache.load("a") is None


def test_files_have_a_size_together_that_they_do_not_exceed(tmp_path, monkeypatch):
    monkeypatch.setattr(openvino_compile, "MAX_BYTES", 3 * len(BLOB))
    cache = CompileCache(tmp_path)
    for index in range(5):
        cache.store(str(index), BLOB)
        newest = max(tmp_path.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        os.utime(newest, (index, index))
    assert [cache.load(str(index)) is not None for index in range(5)] == [False] * 3 + [True] * 2


def test_the_least_recently_used_goes_first(tmp_path: Path) -> None:
    cache = CompileCache(tmp_path)
    for index in range(MAX_ENTRIES):
        cache.store(str(index), BLOB)
        newest = max(tmp_path.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        os.utime(newest, (index, index))
    assert cache.load("0") == BLOB  # used: now the newest
    cache.store("one more", BLOB)
    assert len(list(tmp_path.iterdir())) == MAX_ENTRIES
    assert cache.load("1") is None
    assert cache.load("0") == cache.load("2") == cache.load("one more") == BLOB


def test_a_folder_that_cannot_be_used_means_no_cache(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    cache = CompileCache(tmp_path / "file" / "below")
    cache.store("a", BLOB)
    assert cache.load("a") is None


@pytest.mark.parametrize(
    ("xdg", "expected"),
    [
        ("/somewhere", "/somewhere/mavbridge"),
        ("", "HOME/.cache/mavbridge"),
        ("relative", "HOME/.cache/mavbridge"),
    ],
)
def test_the_folder_is_where_xdg_says(monkeypatch, tmp_path, xdg, expected):
    monkeypatch.setenv("XDG_CACHE_HOME", xdg)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_cache_folder() == Path(expected.replace("HOME", str(tmp_path)))
