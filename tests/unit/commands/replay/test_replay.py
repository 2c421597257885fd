import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from helpers.golden_flights import FLIGHTS, copied, golden
from mavbridge.commands.config import ReplayConfig, ReplayFrom
from mavbridge.commands.replay import (
    ENGINE_TOLERANCE,
    VIDEO_TOLERANCE,
    other_config,
    replay,
    tolerance_of,
)
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import ExitCode, UserError
from mavbridge.core.reasons import Code, because
from mavbridge.simulation.replay.recording import open_source
from policy.data.flight_files import SETTINGS
from policy.errors import NoChunkError

NUMPY = FLIGHTS / "numpy_px4"
B = Path("b.pt")
FLOWN = FlyConfig(policy=PolicyConfig(checkpoint=B, seed=3))


def test_a_guard_that_smooths_differently_is_found_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied("numpy_px4", tmp_path)
    document = json.loads((folder / SETTINGS).read_text())
    document["config"]["limits"]["tau"] = 0.051
    (folder / SETTINGS).write_text(json.dumps(document))

    assert replay(folder, ReplayConfig(source="chunks")) == ExitCode.DIFFERENT

    shown = capsys.readouterr().out
    assert "the guard came out differently, first in the raw of tick" in shown
    assert "NOT EQUAL" in shown


def test_another_limit_shows_its_effect_and_is_no_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    picture = tmp_path / "sticks.png"

    assert replay(NUMPY, ReplayConfig(source="chunks", tau=0.2, plot=picture)) == 0

    assert "the difference is what was asked for" in capsys.readouterr().out
    assert picture.stat().st_size > 10_000
    config = ReplayConfig(source="chunks", tau=0.2, tolerance=0.001)
    assert replay(NUMPY, config) == ExitCode.DIFFERENT, "a tolerance was asked for"


def test_flags_of_the_replay_replace_those_of_the_flight_and_no_others() -> None:
    changed = other_config(FLOWN, ReplayConfig(tau=0.1, num_diffusion_steps=2))

    assert changed.limits == replace(FLOWN.limits, tau=0.1)
    assert changed.policy == replace(FLOWN.policy, num_diffusion_steps=2)
    flown = replace(FLOWN, policy=replace(FLOWN.policy, by_rates=True, image_size=64))
    other = other_config(flown, ReplayConfig(policy="scripted:hover")).policy
    assert other == PolicyConfig(policy="scripted:hover", seed=3)


@pytest.mark.parametrize(
    ("config", "chosen", "engine", "expected"),
    [
        (ReplayConfig(), "features", "numpy", 0.0),
        (ReplayConfig(), "features", "torch", ENGINE_TOLERANCE),
        (ReplayConfig(), "video", "numpy", VIDEO_TOLERANCE),
        (ReplayConfig(), "chunks", "torch", 0.0),
        (ReplayConfig(checkpoint=Path("c.pt")), "video", "numpy", None),
        (ReplayConfig(tau=0.1), "features", "numpy", None),
        (
            ReplayConfig(num_diffusion_steps=1, policy="toge", checkpoint=B),
            "features",
            "numpy",
            0.0,
        ),
        (ReplayConfig(num_diffusion_steps=2), "features", "numpy", None),
        (ReplayConfig(tau=0.1, tolerance=0.3), "features", "numpy", 0.3),
    ],
)
def test_what_counts_as_equal(
    config: ReplayConfig, chosen: ReplayFrom, engine: str, expected: float | None
) -> None:
    wanted = other_config(FLOWN, config)
    found = tolerance_of(config, FLOWN, wanted, chosen, is_same_engine=engine == "numpy")
    assert found == expected


def test_of_a_flight_that_was_cut_off_the_solves_behind_its_last_tick_are_left_out(
    tmp_path: Path,
) -> None:
    folder = copied("numpy_px4", tmp_path)
    ticks = pq.read_table(folder / "ticks.parquet")
    pq.write_table(ticks.slice(0, ticks.num_rows - 300), folder / "ticks.parquet")
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"finished": False}))

    source = open_source(folder)

    assert 100 < len(source.solves) < len(open_source(NUMPY).solves)
    assert source.solves[-1].started_ns <= source.ticks[-1].sent_ns
    assert replay(folder, ReplayConfig(source="chunks")) == ExitCode.DONE


def test_of_a_flight_that_was_cut_off_the_ticks_of_lost_chunks_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """kill -9 of the flight process: its last solves never reached the writer."""
    folder = copied("numpy_px4", tmp_path)
    flown = [tick for tick in open_source(NUMPY).ticks if tick.chunk_serial is not None]
    solves = pq.read_table(folder / "solves.parquet")
    kept = [serial <= flown[-10].chunk_serial for serial in solves["serial"].to_pylist()]
    pq.write_table(solves.filter(kept), folder / "solves.parquet")
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"finished": False}))

    assert replay(folder, ReplayConfig(source="chunks")) == ExitCode.DONE

    source = open_source(folder)
    assert source.ticks[-1].chunk_serial == flown[-10].chunk_serial
    assert re.search(r"the chunks of its last \d\d+ ticks are not recorded", *source.gaps)
    assert "EQUAL, bit for bit" in capsys.readouterr().out


def test_a_damaged_log_is_told_with_what_was_skipped(tmp_path: Path) -> None:
    folder, written = copied("numpy_px4", tmp_path), tmp_path / "replay.json"
    log = bytearray((folder / "link.tlog").read_bytes())
    place = len(log) // 2
    log[place : place + 500] = b"?" * 500
    (folder / "link.tlog").write_bytes(log)

    replay(folder, ReplayConfig(source="chunks", json=written))

    told = json.loads(written.read_text())["gaps"]
    assert re.search(r"link.tlog is damaged.*: 5\d\d bytes were skipped", told[0])
    assert re.search(r"\d+ packets are not in the recording", told[1])
    (folder / "link.tlog").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(UserError, match=r"link\.tlog is a pointer of Git LFS"):
        replay(folder, ReplayConfig())
    (folder / "link.tlog").unlink()
    with pytest.raises(UserError, match=r"link\.tlog"):
        replay(folder, ReplayConfig())


def test_what_the_replay_cannot_repeat_is_told_with_the_verdict(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = because(Code.MOVED, before="10.0.0.1:14550", now="10.0.0.2:14550")
    source = golden("numpy_px4")
    last = replace(source.ticks[-1], release_reason=moved, phase="flying")
    source = replace(source, ticks=(*source.ticks[:-1], last))
    monkeypatch.setattr("mavbridge.commands.replay.open_source", lambda folder: source)

    assert replay(NUMPY, ReplayConfig(source="chunks")) == ExitCode.DIFFERENT

    shown = " ".join(capsys.readouterr().out.split())
    assert f"senders of packets, so this is not repeated: {moved}" in shown
    assert "NOT EQUAL, perhaps for the notes above" in shown


class Counting:
    """Keeps a count, and has no reset."""

    def __init__(self) -> None:
        self.contract = golden("numpy_px4").contract
        self._calls = 0

    def encode_visual(self, image: np.ndarray) -> np.ndarray:
        return np.zeros((1, 4), np.float32)

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self._calls += 1
        return np.full((1, 8, 4), 0.01 * self._calls % 0.3, np.float32)


class Refusing(Counting):
    """Has no more chunks after some."""

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        if self._calls > 100:
            raise NoChunkError("lost the gate")
        return super().predict_fast(feature, state, history, steps)


def test_solves_and_ticks_without_a_counterpart_are_told_of_another_policy_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, written = f"{__file__}:Refusing", tmp_path / "replay.json"
    asked = ReplayConfig(policy=policy, source="features", json=written)

    assert replay(NUMPY, asked) == ExitCode.DONE

    shown = " ".join(capsys.readouterr().out.split())
    assert re.search(r"note: \d+ solves were not repeated: .*lost the gate", shown)
    assert re.search(r"note: \d+ ticks were flown by one of the two alone", shown)
    document = json.loads(written.read_text())
    assert document["is_equal"] is None, "no agreement was expected"
    assert document["sticks"]["flown_by_one"] > 0
    assert all(isinstance(most, float) for most in document["sticks"]["largest"])


def test_a_scripted_policy_begins_where_the_takeoff_ended(tmp_path: Path) -> None:
    """With --takeoff it need not be said in its name, as it is in this flight's."""
    folder = copied("scripted_velocity_ardupilot", tmp_path)
    text = (folder / SETTINGS).read_text()
    (folder / SETTINGS).write_text(
        text.replace("scripted:square:velocity:air", "scripted:square:velocity")
    )
    assert replay(folder, ReplayConfig()) == ExitCode.DONE


def test_a_memory_that_is_not_repeated_is_told_with_the_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied("numpy_px4", tmp_path)
    flown = f"{__file__}:Counting"
    for name in (SETTINGS, "meta.json"):
        document = json.loads((folder / name).read_text())
        settings = document["config"]["policy"] if name == SETTINGS else document
        settings["policy"] = flown
        (folder / name).write_text(json.dumps(document))

    assert replay(folder, ReplayConfig(policy=flown)) == ExitCode.DIFFERENT

    shown = " ".join(capsys.readouterr().out.split())
    assert "the policy has no reset, so what it kept from earlier calls is not repeated" in shown
    assert "NOT EQUAL, perhaps for the notes above" in shown
