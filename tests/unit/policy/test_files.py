import errno
import os
import re
from pathlib import Path

import pytest

from mavbridge.__main__ import main
from mavbridge.config.settings_files import with_home
from policy.adapters.interface import read_interface
from policy.errors import ContractError
from policy.files import MAX_TOML_BYTES, open_regular, parse_json, read_toml, why_unreadable


def test_a_pipe_is_no_file_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    for path in (tmp_path / "pipe.toml", Path("/dev/null"), tmp_path):
        with pytest.raises(OSError, match="not a file"):
            open_regular(path)


def test_a_forbidden_file_is_neither_damaged_nor_missing(tmp_path, monkeypatch) -> None:
    def forbid(path: Path) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("policy.files.open_regular", forbid)
    said = why_unreadable(tmp_path / "a", FileNotFoundError(errno.ENOENT, "No such file"))
    assert said == f"{tmp_path / 'a'}: permission denied"


@pytest.mark.parametrize("text", ["[" * 200_000, "[" * 2_000 + "1,", f"{10**400}", "\n"])
def test_json_that_is_empty_too_deep_or_has_huge_numbers_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match=r"nested too deeply|Expecting value|308 digits|is empty"):
        parse_json(text)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"a = " + b"[\n" * 20_000, "nested too deeply"),
        (b"a." * 30_000 + b"a = 1", "a line of it has 60005 characters"),
        ('"\u2028".'.encode() * 5_000 + b"a = 1", "a line of it has 20005 characters"),
        (b"#" * (MAX_TOML_BYTES + 1), "larger than 64 KiB"),
        (b"\xff\xfe", "UTF-16 or UTF-32"),
        (b"a = 1\nb = '\xe4'", "not UTF-8 text .line 2"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"a = \0", "zero bytes"),
        ("a = 1".encode("utf-16-le"), "UTF-16"),
        (b"\na = 1_0" + b"0" * 400, "more than 308 digits .line 2"),
    ],
)
def test_settings_that_are_no_text_or_fill_the_memory_are_refused(content, told, tmp_path, capsys):
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=told):
        read_toml(path)
    with pytest.raises(ContractError, match=f"is not TOML: .*{told}"):
        read_interface(path)
    with pytest.raises(SystemExit) as ended:
        main(["--config", str(path), "--connect", "udp:127.0.0.1:1"])
    assert ended.value.code == 2
    assert re.search(told, capsys.readouterr().err.replace("\n", " "))


def test_text_of_windows_editors_is_read(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_bytes(b'\xef\xbb\xbfa = 1\r\nb = "x"\r\n')
    assert read_toml(path) == {"a": 1, "b": "x"}


@pytest.mark.parametrize(
    "words",
    [
        ["--policy", "lerobot:~/act"],
        ["--policy=lerobot:~/act", "--log-file=~/run.log"],
        ["--config", "~/fly.toml"],
    ],
)
def test_the_command_line_expands_what_shells_leave(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert with_home(["front=~/v.mp4"]) == [f"front={tmp_path}/v.mp4"]
    (tmp_path / "fly.toml").write_text('policy = "lerobot:~/act"')
    with pytest.raises(SystemExit) as ended:
        main([*words, "--connect", "udp:127.0.0.1:1", "--camera", "none"])
    assert ended.value.code == 2
    assert f"{tmp_path}/act" in capsys.readouterr().err.replace("\n", "")
    assert not Path("~").exists()
