"""What a record says of the program that made it."""

import subprocess
import sys
from pathlib import Path

import pytest

import mavbridge
from mavbridge.core.provenance import command_line, digests, git_revision, versions, without_secrets


def test_the_command_line_is_kept_without_secretss(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--camera", "front=rtsp://me:se:cret@host:8554/x", "--connect", "udp:1.2.3.4:14550"]
    monkeypatch.setattr(sys, "argv", ["/somewhere/__main__.py", *words])
    kept = ("mavbridge", "--camera", "front=rtsp://me:***@host:8554/x", *words[2:])
    assert command_line() == kept


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://me:it@host/x", "rtsp://me:***@host/x"),
        ("rtsp://me:p@ss/w:rd@host/x", "rtsp://me:***@host/x"),
        ("ws://:it@host:8000", "ws://:***@host:8000"),
        ("front=rtsp://me:it@host/x down=rtsp://me:it@host/y", "front=rtsp://me:***@host/x "
         "down=rtsp://me:***@host/y"),
        ("http://host/video?user=me&password=it&channel=1", "http://host/video?user=me&password=***"
         "&channel=1"),
        ("rtsp://host/user=me_password=it_channel=1_stream=0.sdp",
         "rtsp://host/user=me_password=***_channel=1_stream=0.sdp"),
        ("https://host/x?access_token=it#here", "https://host/x?access_token=***#here"),
        ("udp:127.0.0.1:14550 --set RC_OVERRIDE_TIME=0.5", "udp:127.0.0.1:14550 --set "
         "RC_OVERRIDE_TIME=0.5"),
        ("--signing-key-file key.txt", "--signing-key-file key.txt"),
    ],
)  # fmt: skip
def test_secrets_in_addresses_are_masked(text: str, shown: str) -> None:
    assert without_secrets(text) == shown


def test_versions_are_of_what_is_installed() -> None:
    found = versions()
    assert found["mavbridge"] == mavbridge.__version__
    assert found["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}")
    assert {"torch", "numpy", "pymavlink"} <= set(found)


def test_a_checkout_has_a_revision_and_any_other_folder_none(tmp_path: Path) -> None:
    assert git_revision(tmp_path) is None
    who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    git = ("git", "-C", str(tmp_path))
    try:
        subprocess.run([*git, "init", "--quiet"], check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("git is not installed")
    (tmp_path / "a").write_text("1")
    subprocess.run([*git, "add", "a"], check=True)
    subprocess.run([*git, *who, "commit", "--quiet", "--message", "x"], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    assert git_revision(tmp_path) == head.stdout.strip()
    (tmp_path / "a").write_text("2")
    assert git_revision(tmp_path) == f"{head.stdout.strip()}-dirty"
    (tmp_path / "inside").mkdir()
    assert git_revision(tmp_path / "inside") is None  # a package installed in somebody's project


def test_digests_are_by_path(tmp_path: Path) -> None:
    path = tmp_path / "weights"
    path.write_bytes(b"abc")
    assert digests([path, tmp_path / "missing"]) == {
        str(path): "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    }
