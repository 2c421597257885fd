"""A policy whose action is known, beside other people's recordings."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.flight_folders import LEVEL, MS, ticks_table, write_flight, write_video
from mavbridge.__main__ import main
from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export.run import write_dataset
from mavbridge.commands.replay.config import ReplayConfig
from mavbridge.commands.replay.run import replay
from mavbridge.core.errors import MavbridgeError, UserError
from policy.contract import Contract
from policy.data.flight_folders import read_flight

Array = NDArray[np.float32]
LEVELS = (40, 200)
"""Brightness of the first and of the second half of the video."""
POLICY = "test_others:Reading"


class Reading:
    """Throttle: the brightness in 0..1; yaw: the north velocity; pitch: the last sent yaw stick."""

    contract = Contract(arrays="numpy", feature_dim=1, image_height=32, image_width=32)

    def encode_visual(self, image: Array) -> Array:
        mean, std = np.array(self.contract.image_mean_rgb), np.array(self.contract.image_std_rgb)
        grey = image[0].mean(axis=(1, 2)) * std + mean
        return np.full((1, 1), grey.mean(), np.float32)

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        chunk = np.zeros((1, self.contract.horizon, 4), np.float32)
        chunk[..., 0], chunk[..., 1], chunk[..., 2] = feature[0, 0], state[0, 0], history[0, -1, 1]
        return chunk

    def predict(self, image: Array, state: Array, history: Array, steps: int) -> Array:
        return self.predict_fast(self.encode_visual(image), state, history, steps)


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parent)


def write_log(path: Path, *, attitude: bool = True, seconds: float = 2.0) -> Path:
    """50 Hz of a vehicle at 0.25 m/s whose pilot holds a quarter of yaw; another one is slower."""
    vehicle = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    other = dialect.MAVLink(None, srcSystem=2, srcComponent=1)
    with path.open("wb") as file:
        for number in range(round(50 * seconds)):
            ms = 1000 + 20 * number
            packets = [
                vehicle.local_position_ned_encode(ms, 0, 0, -5, 0.25, 0, 0).pack(vehicle),
                vehicle.highres_imu_encode(
                    *(1000 * ms, 0, 0, -9.8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 63)
                ).pack(vehicle),
                vehicle.rc_channels_encode(
                    *(ms, 8, 1500, 1500, 1500, 1600, *[1500] * 4, *[0] * 10, 255)
                ).pack(vehicle),
            ]
            if attitude:
                turn = (0.0, 0.0, 0.001 * number, 0.0, 0.0, 0.05)
                packets.append(vehicle.attitude_encode(ms, *turn).pack(vehicle))
                if number % 5 == 0:
                    packets.append(other.attitude_encode(ms, 1, 1, 1, 0, 0, 0).pack(other))
            for packet in packets:
                file.write((1_700_000_000_000_000 + 20_000 * number).to_bytes(8, "big") + packet)
    return path


def grey(level: int) -> NDArray[np.uint8]:
    return np.full((32, 32, 3), level, np.uint8)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Two seconds at 30 Hz."""
    path = tmp_path / "video.mp4"
    write_video(path, [grey(LEVELS[number >= 30]) for number in range(60)])
    return path


def test_a_log_and_a_video_give_the_policy_state_image_and_the_pilots_sticks(
    tmp_path: Path, video: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    log, written = write_log(tmp_path / "flight.tlog"), tmp_path / "replay.json"
    picture = tmp_path / "sticks.png"

    code = replay(
        log, ReplayConfig(policy=POLICY, video=video, video_start=0.5, json=written, plot=picture)
    )

    assert code == 0
    document = json.loads(written.read_text())
    assert document["compared"] > 50
    most = document["difference"]["largest"]
    # The pilot: a quarter of yaw by 1600 us of 1100..1900, all others centred.
    assert most[0] == pytest.approx(LEVELS[1] / 255, abs=0.02)
    assert most[1] == pytest.approx(0.0, abs=1e-6)
    assert most[2] == pytest.approx(0.25, abs=1e-6)
    assert most[3] == 0.0
    shares = (30 * LEVELS[0] + 15 * LEVELS[1]) / 45 / 255  # the log ends half a second earlier
    assert document["difference"]["mean"][0] == pytest.approx(shares, abs=0.05)
    assert "ArduPilot's defaults" in capsys.readouterr().out.replace("\n", " ")
    assert picture.stat().st_size > 10_000


def test_a_damaged_log_and_a_damaged_video_are_read_and_told(tmp_path: Path, video: Path) -> None:
    log, written = write_log(tmp_path / "flight.tlog"), tmp_path / "replay.json"
    data = bytearray(log.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 300] = b"?" * 300
    log.write_bytes(data)

    assert replay(log, ReplayConfig(policy=POLICY, video=video, json=written)) == 0

    (note, *_) = json.loads(written.read_text())["notes"]
    assert re.search(r"flight.tlog is damaged.*: 3\d\d bytes were skipped, with \d+ packets", note)


def test_a_log_without_attitude_is_refused(tmp_path: Path, video: Path) -> None:
    log = write_log(tmp_path / "flight.tlog", attitude=False)

    with pytest.raises(UserError, match="no ATTITUDE"):
        replay(log, ReplayConfig(policy=POLICY, video=video))


@pytest.mark.parametrize(("start_s", "where"), [(3.0, "begins after"), (-5.0, "ends before")])
def test_a_video_of_another_time_is_refused(
    tmp_path: Path, video: Path, start_s: float, where: str
) -> None:
    log = write_log(tmp_path / "flight.tlog")

    with pytest.raises(UserError, match=f"the video {where} the log of 2.0 s"):
        replay(log, ReplayConfig(policy=POLICY, video=video, video_start=start_s))


def test_a_file_that_is_no_log_and_a_log_without_video_are_refused(
    tmp_path: Path, video: Path
) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no packets in here")

    with pytest.raises(UserError, match="no telemetry log"):
        replay(text, ReplayConfig(policy=POLICY, video=video))
    with pytest.raises(UserError, match="--video"):
        replay(write_log(tmp_path / "flight.tlog"), ReplayConfig(policy=POLICY))


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """An episode at 0.5 m/s whose pilot yaws by 0.2 and climbs by 0.1."""
    start_ns = 10**9
    captured_ns = [start_ns + 33 * MS * number for number in range(30)]
    woke_ns = list(range(start_ns - 50 * MS, captured_ns[-1], 10 * MS))
    sticks = [(0.1, 0.2, 0.0, 0.0)] * len(woke_ns)
    folder = write_flight(
        tmp_path / "flight",
        ticks_table(
            woke_ns=woke_ns,
            expert=sticks,
            sent=sticks,
            state=[(0.5, *LEVEL[1:])] * len(woke_ns),
        ),
        captured_ns=captured_ns,
        images=[grey(LEVELS[0])] * 30,
    )
    out = tmp_path / "dataset"
    out.mkdir()
    write_dataset([read_flight(folder)], out, ExportConfig(out=out, task="fly"))
    return out


def test_an_episode_of_a_dataset_is_compared_row_by_row(dataset: Path, tmp_path: Path) -> None:
    written = tmp_path / "replay.json"

    assert replay(dataset, ReplayConfig(policy=POLICY, json=written)) == 0

    document = json.loads(written.read_text())
    assert document["solves"] == document["compared"] >= 25
    assert document["difference"]["mean, signed"] == pytest.approx(
        [LEVELS[0] / 255 - 0.1, 0.3, 0.2, 0.0], abs=0.02
    )


def test_a_dataset_that_does_not_fit_is_refused(dataset: Path) -> None:
    with pytest.raises(UserError, match=r"--episode 1: .* has the episodes 0 to 0"):
        replay(dataset, ReplayConfig(policy=POLICY, episode=1))
    with pytest.raises(UserError, match="--from, --tolerance"):
        replay(dataset, ReplayConfig(policy=POLICY, tau=0.2))
    info = dataset / "meta" / "info.json"
    info.write_text(info.read_text().replace('"observation.state"', '"observation.other"'))
    with pytest.raises(MavbridgeError, match=r"no feature observation\.state"):
        replay(dataset, ReplayConfig(policy=POLICY))


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _point(path: Path) -> None:
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n")


@pytest.mark.parametrize("command", ["train", "replay", "contract", "export"])
@pytest.mark.parametrize("damage", [_cut, _point, Path.unlink], ids=["cut", "pointer", "missing"])
@pytest.mark.parametrize("name", ["info.json", "file-000.parquet", "file-000.mp4"])
def test_every_reader_of_a_broken_dataset_names_the_file_and_no_library_speaks(
    dataset: Path,
    name: str,
    damage: Callable[[Path], None],
    command: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = next(found for found in sorted(dataset.rglob(name)) if "episodes" not in found.parts)
    damage(path)
    out = str(dataset.parent / "out.safetensors")
    words = {
        "train": ["--policy", "toge:small:resnet8", "--out", out, "--minutes", "0.01"],
        "replay": ["--policy", POLICY],
        "contract": ["--out", str(dataset.parent / "draft.toml")],
        "export": ["--out", str(dataset.parent / "again")],
    }[command]
    with pytest.raises(SystemExit) as ended:
        main([command, str(dataset), *words])
    shown = "".join(capfd.readouterr())
    drafts = command == "contract" and name != "info.json"  # by its meta alone
    assert ended.value.code == (0 if drafts else 2)
    assert "Traceback" not in shown
    if not drafts:
        assert str(dataset) in shown.replace("\n", "")
