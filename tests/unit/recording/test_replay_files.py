import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.factories import START_NS, make_solve, make_state
from helpers.recordings import make_frame, make_meta, without_writer_process
from mavbridge.config.flight import CameraConfig, FlyConfig, Limits, LinkConfig
from mavbridge.config.policy import PolicyConfig, Rates
from mavbridge.core.reasons import Code, because, reason_to_json
from mavbridge.core.records import Solve
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.recording import flight_writer, replay_files
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.replay_files import (
    ReplaySettings,
    packet_key,
    read_features,
    read_packets,
    read_settings,
    read_solves,
    write_settings,
)
from policy.contract import Contract
from policy.data.flight_files import SETTINGS
from policy.data.tables import read_table
from policy.errors import DatasetError

CONTRACT = Contract()
FROZEN = because(Code.IMAGE_FROZEN, age_s=0.6)
HEARTBEAT = bytes.fromhex("fd09000007010100000000000000020c51040300000000")


ARRAYS = ("states", "history", "actions")


def random_solve(serial: int) -> Solve:
    random = np.random.default_rng(serial)
    state = replace(
        make_state(START_NS + serial),
        values=random.random(13, np.float32),
        extras=(0.1, 2.0),
        extras_ns=START_NS - 5,
    )
    return make_solve(
        serial,
        reset_ns=serial // 2,
        state=state,
        states=random.random((1, *CONTRACT.state_shape), np.float32),
        history=random.random((1, 4, 4), np.float32),
        frame_ids=((serial,), (serial + 1,)),
        actions=random.random((1, 16, 4), np.float32),
    )


def comparable(solve: Solve) -> tuple[object, ...]:
    arrays = [*(getattr(solve, name) for name in ARRAYS), solve.state.values]
    plain = replace(solve, **dict.fromkeys(ARRAYS), state=replace(solve.state, values=None))
    return plain, *((array.shape, array.tobytes()) for array in arrays)


def record(folder: Path, **changes: Any) -> FlightWriter:
    with without_writer_process():
        settings = ReplaySettings(config=FlyConfig(), wall_offset_ns=1)
        return FlightWriter(folder, make_meta(**changes), pressure="offline", settings=settings)


@pytest.mark.parametrize("is_finished", [True, False])
def test_solves_come_back_bit_for_bit_also_from_a_flight_that_was_cut_off(
    tmp_path: Path, is_finished: bool
) -> None:
    writer = record(tmp_path)
    solves = [random_solve(serial) for serial in (1, 2, 5)]
    for solve in solves:
        writer.solve(solve)
    writer.flush()
    if is_finished:
        writer.finish(writer.meta)

    table = read_table(tmp_path / "solves", replay_files.SOLVES)

    assert table["dropped_before"].to_pylist() == [0, 0, 2]
    assert [*map(comparable, read_solves(table, CONTRACT))] == [*map(comparable, solves)]


def test_features_of_each_camera_have_a_table_of_their_own(tmp_path: Path) -> None:
    writer = record(tmp_path, contract=Contract(cameras=("front", "down")))
    value = np.array([[0.1, -1e-30, 3.0]], np.float32)
    vision = make_frame(2, serial=0, feature=value)
    writer.frame(vision)
    writer.frame(replace(vision, camera=1, serial=2, fault=FROZEN, feature=-value))
    writer.finish(writer.meta)

    (front,) = read_features(read_table(tmp_path / "features", replay_files.FEATURES))
    down = read_table(tmp_path / "features_down", replay_files.FEATURES)

    assert front.value.tobytes() == value.tobytes()
    assert front.value.shape == (1, 3)
    assert (front.frame_id, front.captured_ns) == (vision.frame_id, vision.captured_ns)
    assert [json.loads(text) for text in down["fault"].to_pylist()] == [reason_to_json(FROZEN)]
    assert [each.fault for each in read_features(down)] == [FROZEN]
    assert down["dropped_before"].to_pylist() == [2]


def test_a_single_rate_flight_keeps_packets_and_no_images_as_features(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flight_writer, "PACKET_CAPACITY", 2)
    writer = record(tmp_path, mode="single")
    for stamps_ns in ((7, 5), (9, 9), (11, 11), (12, 12)):  # the last two find the queue full
        writer.packets.put(ForwardedPacket(*stamps_ns, HEARTBEAT))
    writer.flush()
    writer.packets.put(ForwardedPacket(13, 13, HEARTBEAT))
    writer.frame(make_frame(0, feature=np.zeros((1, 3, 8, 8), np.float32)))
    writer.finish(writer.meta)

    table = read_table(tmp_path / "packets", replay_files.PACKETS)

    assert list(read_packets(table)) == [(7, 5, 0, 7), (9, 9, 0, 7), (13, 13, 0, 7)]
    assert table["dropped_before"].to_pylist() == [0, 0, 2]
    assert packet_key(HEARTBEAT) == (0, 7)
    assert not [*tmp_path.glob("features*")]


def test_every_setting_of_a_flight_comes_back(tmp_path: Path) -> None:
    config = FlyConfig(
        link=LinkConfig(connect="udp:1.2.3.4:5", set=("A=1",)),
        policy=PolicyConfig(policy="toge:small", checkpoint=Path("my.safetensors"), seed=2),
        camera=CameraConfig(camera=("front=0", "down=1")),
        rates=Rates(visual_rate=20.0),
        limits=Limits(tau=0.1),
        record=tmp_path,
    )
    write_settings(tmp_path, ReplaySettings(config=config, wall_offset_ns=10**18))

    assert read_settings(tmp_path) == ReplaySettings(config=config, wall_offset_ns=10**18)


def test_a_flag_of_a_later_version_is_left_out_and_damage_is_named(tmp_path: Path) -> None:
    settings = ReplaySettings(config=FlyConfig(), wall_offset_ns=1)
    write_settings(tmp_path, settings)
    document = json.loads((tmp_path / SETTINGS).read_text())
    document["config"]["warp_speed"] = 9
    (tmp_path / SETTINGS).write_text(json.dumps(document))
    assert read_settings(tmp_path) == settings

    for damaged in (
        "{",
        '{"wall_offset_ns": "1", "config": {}}',
        '{"wall_offset_ns": 1, "config": {"policy": {"policy": 3}}}',
        '{"wall_offset_ns": 1, "config": {"link": {"set": "A=1"}}}',
        '{"wall_offset_ns": 1, "config": {"link": {"output": "flags"}}}',
    ):
        (tmp_path / SETTINGS).write_text(damaged)
        with pytest.raises(DatasetError, match="damaged"):
            read_settings(tmp_path)
    (tmp_path / SETTINGS).unlink()
    with pytest.raises(DatasetError, match="older mavbridge"):
        read_settings(tmp_path)
