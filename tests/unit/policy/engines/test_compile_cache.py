import os
from pathlib import Path

import pytest

from policy.engines import openvino_compile
from policy.engines.openvino_compile import MAX_ENTRIES, CompileCache, user_cache_folder

BLOB = b"a compiled graph" * 100


def fill(cache: CompileCache, folder: Path, count: int) -> None:
    """Store so many entries, each used a second after the one before."""
    for index in range(count):
        cache.store(str(index), BLOB)
        newest = max(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        os.utime(newest, (index, index))


def test_keeps_what_was_stored_by_key_until_it_is_damaged(tmp_path: Path) -> None:
    cache = CompileCache(tmp_path / "new" / "folder")
    assert cache.load("a") is None
    cache.store("a", BLOB)
    (path,) = (tmp_path / "new" / "folder").iterdir()
    cache.store("b", b"")
    assert (cache.load("a"), cache.load("b"), cache.load("c")) == (BLOB, b"", None)
    whole = path.read_bytes()
    flipped = [whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :] for at in (0, 31, 32, 500)]
    for damaged in (*(whole[:kept] for kept in (0, 1, 31, 32, 33, len(whole) - 1)), *flipped):
        path.write_bytes(damaged)
        assert cache.load("a") is None
    cache.store("a", b"newer")
    assert cache.load("a") == b"newer"


def test_files_have_a_size_together_that_they_do_not_exceed(tmp_path, monkeypatch):
    monkeypatch.setattr(openvino_compile, "MAX_BYTES", 3 * len(BLOB))
    cache = CompileCache(tmp_path)
    fill(cache, tmp_path, 5)
    assert [cache.load(str(index)) is not None for index in range(5)] == [False] * 3 + [True] * 2


def test_the_least_recently_used_goes_first(tmp_path: Path) -> None:
    cache = CompileCache(tmp_path)
    fill(cache, tmp_path, MAX_ENTRIES)
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


def test_the_folder_is_where_xdg_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for xdg, root in (("/somewhere", Path("/somewhere")), ("relative", tmp_path / ".cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", xdg)
        assert user_cache_folder() == root / "mavbridge"
