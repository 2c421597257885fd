"""Recordings, datasets and settings files of strangers: they run nothing and reach nobody."""

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.golden_flights import FLIGHTS, copied
from helpers.status import asked_flight, told_by
from mavbridge.commands.config import ReplayConfig
from mavbridge.commands.replay import replay
from mavbridge.config.settings_files import untrusted_settings
from mavbridge.core.errors import UserError
from mavbridge.recording.folder import read_meta
from policy.data.flight_files import SETTINGS
from policy.data.flight_video import decode_video
from policy.data.lerobot import read_dataset
from policy.errors import DatasetError
from policy.files import read_toml

ROOT = Path(__file__).parents[3]
EVIL = "from pathlib import Path\nPath(__file__).with_name('ran').touch()\nclass Evil: pass\n"


@pytest.fixture
def lure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, with a program that must not run."""
    (tmp_path / "evil.py").write_text(EVIL)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not (tmp_path / "ran").exists()


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    """A port that nobody may connect to."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        yield server
        with pytest.raises(BlockingIOError):
            server.accept()


# --- recordings


@pytest.mark.parametrize(
    ("policy", "what"),
    [
        ("./evil.py:Evil", "a program in Python"),
        ("{folder}/evil.py:Evil", "a program in Python"),
        ("evil:Evil", "a program in Python"),
        ("os:system", "a program in Python"),
        ("torchscript:evil.pt", "TorchScript"),
        ("wss://evil.example:443", "a policy server"),
        ("ws://127.0.0.1:1", "a policy server"),
        ("", "a program in Python"),
    ],
)
def test_a_recording_chooses_no_program_and_no_server(lure: Path, policy: str, what: str) -> None:
    folder = copied("numpy_px4", lure)
    (folder / "evil.py").write_text(EVIL)
    document = json.loads((folder / SETTINGS).read_text())
    document["config"]["policy"]["policy"] = named = policy.format(folder=folder)
    (folder / SETTINGS).write_text(json.dumps(document))
    with pytest.raises(UserError, match=f"flown by {named}.*{what}.*--policy {named}"):
        replay(folder, ReplayConfig())
    assert not (folder / "ran").exists()


def test_weights_that_are_no_file_are_not_opened(lure: Path) -> None:
    folder, fifo = copied("toge_ardupilot", lure), lure / "weights.safetensors"
    os.mkfifo(fifo)  # a reader would wait for ever
    document = json.loads((folder / SETTINGS).read_text())
    document["config"]["policy"]["checkpoint"] = str(fifo)
    (folder / SETTINGS).write_text(json.dumps(document))
    with pytest.raises(UserError, match="is no file here"):
        replay(folder, ReplayConfig())


def test_the_policy_of_the_flight_named_once_more_is_no_other_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    flight = FLIGHTS / "scripted_velocity_ardupilot"
    flown = json.loads((flight / SETTINGS).read_text())["config"]["policy"]["policy"]
    status = replay(flight, ReplayConfig())
    shown = capsys.readouterr().out
    assert replay(flight, ReplayConfig(policy=flown)) == status
    assert capsys.readouterr().out == shown


def test_a_recording_that_would_block_its_reader_is_refused(tmp_path: Path) -> None:
    folder = copied("numpy_px4", tmp_path)
    os.mkfifo(folder / "flight.rrd")
    with pytest.raises(DatasetError, match=r"flight.rrd is neither a file nor a folder"):
        read_meta(folder)


@pytest.mark.parametrize("kind", ["hls", "concat"])
def test_a_playlist_in_place_of_a_video_is_not_followed(
    tmp_path: Path, listener: socket.socket, kind: str
) -> None:
    url = f"http://127.0.0.1:{listener.getsockname()[1]}/x.ts"
    text = {
        "hls": f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{url}\n#EXT-X-ENDLIST\n",
        "concat": f"ffconcat version 1.0\nfile {url}\n",
    }[kind]
    (tmp_path / "camera.mp4").write_text(text)
    with pytest.raises(DatasetError, match="cannot be read"):
        list(decode_video(tmp_path / "camera.mp4", 3))


@pytest.mark.parametrize(
    "template",
    [
        "../outside.mp4",
        "/etc/hostname",
        "videos/../../outside.mp4",
        "videos/{chunk_index.__class__}",
        "videos/{chunk_index:>9999999999}",
        "videos/{video_key!r:>99999999}",
    ],
)
@pytest.mark.parametrize("key", ["data_path", "video_path"])
def test_a_dataset_names_no_file_outside_and_no_endless_one(
    tmp_path: Path, key: str, template: str
) -> None:
    from unit.policy.data.test_lerobot import write

    (tmp_path / "outside.mp4").write_bytes(b"private")
    folder = write(tmp_path / "dataset")
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps({**info, key: template}))
    with pytest.raises(DatasetError, match=r"lies outside the dataset|where its files are"):
        read_dataset(folder)


# --- settings files

PIPE = "pipe:python evil.py"
REFUSED = [
    ('policy = "./evil.py:Evil"', "--policy"),
    ('policy = "evil:Evil"', "--policy"),
    ('policy = "torchscript:evil.pt"', "--policy"),
    ('policy = "ws://192.0.2.1:8000"', "--policy"),
    ('policy = "ws://127.0.0.1.evil.example:8000"', "--policy"),
    ('policy = "ws://127.0.0.1:80@evil.example:8000"', "--policy"),
    (f'camera = ["{PIPE}"]', "--camera"),
    (f'camera = "front={PIPE}"', "--camera"),
    (f'camera = "été={PIPE}"', "--camera"),
    (f'[fly]\ncamera = "{PIPE}"', "--camera"),
    (f'"--camera" = "{PIPE}"', "--camera"),
    (f'CAMERA = "{PIPE}"', "--camera"),
    ('host = ""', "--host"),
    ('rerun = "connect=rerun+http://192.0.2.1:9876/proxy"', "--rerun"),
    ('host = "0.0.0.0"', "--host"),
    ('ray = "192.0.2.1:6379"', "--ray"),
    ('report = "/etc/passwd"', "--report"),
    ('record = "../../elsewhere"', "--record"),
    ('json = "~/.profile"', "--json"),
    ('report = "~root/x"', "--report"),
    ("host = 0", "--host"),
    ('host = "connect"', "--host"),
    ('ray = "spawn"', "--ray"),
    ("ray = true", "--ray"),
    ('rerun = "connect=spawn"', "--rerun"),
    ('rerun = "/tmp/x.rrd"', "--rerun"),
]
TAKEN = """
connect = "udpin:0.0.0.0:14550"
policy = "toge:small"
checkpoint = "/opt/mavbridge/my.safetensors"
camera = ["front=0", "down=/dev/video2", "side=shm:fpv", "back=rtsp://192.0.2.1/x"]
record = "flights/today"
report = "report.json"
rerun = "flight.rrd"
set = ["RC_OVERRIDE_TIME=0.5"]
"""


@pytest.mark.parametrize("target", ["off", "spawn", "connect", "flights/today.rrd"])
def test_a_settings_file_may_name_a_viewer_on_this_computer(target: str) -> None:
    assert list(untrusted_settings({"rerun": target}, [])) == []


@pytest.mark.parametrize(("text", "flag"), REFUSED)
def test_a_settings_file_reaches_nothing_by_itself(lure: Path, text: str, flag: str) -> None:
    path = lure / "mavbridge.toml"
    path.write_text(text)
    status, shown = told_by("--config", path, "--set-config", "link.timeout=0.1")
    assert status == 2
    assert f"{flag} '" in shown
    assert "--trust-config" in shown
    (found,) = untrusted_settings(read_toml(path), [])
    assert found[0] == flag
    assert list(untrusted_settings(read_toml(path), [flag, "mine"])) == []
    assert list(untrusted_settings(read_toml(path), [f"{flag}=mine"])) == []


def test_a_settings_file_decides_how_to_fly(tmp_path: Path) -> None:
    """Also by keys that are named as commands."""
    path = tmp_path / "mavbridge.toml"
    path.write_text(f'{TAKEN}contract = "mine.toml"\n')
    config = asked_flight("--config", path)
    assert config.record == Path("flights/today")
    assert config.policy.contract == Path("mine.toml")


def test_a_settings_file_that_is_trusted_may_name_a_program(tmp_path: Path) -> None:
    path = tmp_path / "mavbridge.toml"
    path.write_text('policy = "./there_is_none.py:Mine"\ncamera = "none"\n')
    words = ("--config", path, "--trust-config", "--connect", "udp:127.0.0.1:15691")
    status, shown = told_by(*words)
    assert (status, "there is no file there_is_none.py" in shown) == (2, True), shown


# --- the page


def test_every_row_of_the_page_names_the_test_that_tries_to_break_it() -> None:
    text = (ROOT / "SECURITY.md").read_text().partition("## Who can do what")[2]
    table = [line.split("|")[1:4] for line in text.splitlines() if line.startswith("| ")]
    rows = {who.strip(): held for who, _, held in table[1:]}
    unheld = [who for who, held in rows.items() if held.strip() == "-"]
    assert [who.partition("**code**")[1] or who[:40] for who in unheld] == [
        "**code**",
        "the author of a TorchScript archive",
    ]
    for who, held in rows.items():
        paths = [word for word in held.split("`")[1::2] if "/" in word]
        assert paths or who in unheld, who
        for path in paths:
            assert (ROOT / path).exists(), path
