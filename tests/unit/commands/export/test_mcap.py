"""``mavbridge export --format mcap``, read again by mcap's own reader."""

import json
import re
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shutil import copy
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from helpers.factories import START_NS, TICK_NS, make_released_tick, make_state, make_tick
from helpers.guides import ROOT
from helpers.recordings import make_frame, make_meta, number_of, write_recording
from helpers.status import status_of, told_by
from mavbridge.core.records import Position, Tick
from mavbridge.core.vehicle import Sticks
from mavbridge.recording.flight_folder import open_flight
from policy.contract import STATE_NAMES, Contract
from policy.motion.rotation import rotate

START = ROOT / "examples/start"
SCHEMAS = {
    "/actions": "mavbridge.Actions",
    "/camera/front": "foxglove.CompressedImage",
    "/log": "foxglove.Log",
    "/state": "mavbridge.State",
    "/status": "mavbridge.Status",
    "/tf": "foxglove.FrameTransform",
    "/timing": "mavbridge.Timing",
}
STARTED_NS = 1_767_323_045 * 10**9  # 2026-01-02T03:04:05 UTC, that of make_meta
TEXTS = ("vehicle: Arming motors", "GUID_TIMEOUT is 3")
NAN_TICK, BLIND_TICK, RELEASED_FROM, TICKS, FRAMES = 10, 20, 80, 100, 30


class Entry(NamedTuple):
    topic: str
    at_ns: int
    message: Any


class File(NamedTuple):
    """What a viewer finds in a file."""

    schemas: dict[str, str]
    """By topic, its schema's name."""
    paths: set[str]
    """Every topic, and every field that its schema has."""
    entries: list[Entry]
    """In the order of the file."""
    attachments: dict[str, bytes]

    def of(self, topic: str) -> list[Entry]:
        return [entry for entry in self.entries if entry.topic == topic]


def fields(schema: dict[str, Any], path: str) -> Iterator[str]:
    """Every path in a schema; raises for what Foxglove's parser of JSON schemas does not take."""
    yield path
    if schema["type"] == "object":
        for name, inner in schema["properties"].items():
            yield from fields(inner, f"{path}.{name}")
    else:
        assert schema["type"] in ("string", "number", "integer", "boolean")
        assert schema.get("contentEncoding", "base64") == "base64"


def keys(message: object, path: str) -> Iterator[str]:
    yield path
    if isinstance(message, dict):
        for name, inner in message.items():
            assert inner is not None
            yield from keys(inner, f"{path}.{name}")


def opened(path: Path) -> File:
    schemas, paths, entries = {}, set(), []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert message.log_time == message.publish_time
            if channel.topic not in schemas:
                schemas[channel.topic] = schema.name
                paths |= set(fields(json.loads(schema.data), channel.topic))
            body = json.loads(message.data)
            assert set(keys(body, channel.topic)) <= paths
            if schema.name.startswith("foxglove."):
                stamp = body["timestamp"]
                assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time
            entries.append(Entry(channel.topic, message.log_time, body))
        attachments = {each.name: each.data for each in reader.iter_attachments()}
    return File(schemas, paths, entries, attachments)


def image_of(entry: Entry) -> np.ndarray:
    assert entry.message["format"] == "jpeg"
    data = np.frombuffer(b64decode(entry.message["data"]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def exported(flight: Path, out: Path) -> File:
    assert status_of("export", flight, "--out", out, "--format", "mcap") == 0
    assert [path.name for path in out.iterdir()] == [f"{flight.name}.mcap"]
    return opened(out / f"{flight.name}.mcap")


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> File:
    return exported(START, tmp_path_factory.mktemp("start") / "out")


def flown(index: int) -> Tick:
    """Tick of a climb to the north-east, yawed by 90 degrees to the east."""
    make = make_tick if index < RELEASED_FROM else make_released_tick
    at_ns = START_NS + index * TICK_NS
    values = np.array((1, 2, -3, 0.5**0.5, 0, 0, 0.5**0.5, 0.1, 0.2, 0.3, 0, 0, -9.81), np.float32)
    tick = make(
        index,
        state=make_state(at_ns - 5_000_000, values=values, velocity_ns=at_ns - 8_000_000),
        position_ned_m=Position(0.25 * index, 0.5 * index, -2.0),
        phase="flying" if index < RELEASED_FROM else "released",
        rc_sticks=Sticks(0.1, 0.2, 0.3, 0.4),
        texts=TEXTS if index == 0 else (),
    )
    if index == NAN_TICK and tick.trace is not None:
        return replace(tick, trace=tick.trace._replace(raw=Sticks(float("nan"), 0, 0, 0)))
    if index == BLIND_TICK:
        return replace(tick, state=None, position_ned_m=None, feature_captured_ns=None)
    return tick


def record(folder: Path, *, ticks: int = TICKS, finish: bool = True, **meta: Any) -> Path:
    events = [*map(make_frame, range(FRAMES)), *map(flown, range(ticks))]
    return write_recording(folder, events, meta=make_meta(**meta), finish=finish)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> File:
    root = tmp_path_factory.mktemp("flight")
    return exported(record(root / "a", success=False), root / "out")


def test_a_demonstration_has_all_its_rows_at_their_times(start: File) -> None:
    ticks, frames = (pq.read_table(START / f"{stem}.parquet") for stem in ("ticks", "frames"))
    assert start.schemas == {topic: SCHEMAS[topic] for topic in SCHEMAS if topic != "/log"}
    offset_ns = 1_795_311_854_318_225_000  # 2026-11-22T01:44:14.318225 UTC, at 0 of its clock
    woke_ns = [at + offset_ns for at in ticks["woke_ns"].to_pylist()]
    captured_ns = [at + offset_ns for at in frames["captured_ns"].to_pylist()]
    for topic in ("/state", "/actions", "/timing"):
        assert [entry.at_ns for entry in start.of(topic)] == woke_ns
    for topic in ("/camera/front", "/tf"):
        assert [entry.at_ns for entry in start.of(topic)] == captured_ns
    stamps = [entry.at_ns for entry in start.entries]
    assert stamps == sorted(stamps)
    assert start.attachments == {"meta.json": (START / "meta.json").read_bytes()}
    states = [[entry.message[name] for name in STATE_NAMES] for entry in start.of("/state")]
    np.testing.assert_array_equal(states, ticks["state"].to_pylist())
    for name in ("raw", "smoothed", "sent", "expert", "rc_sticks"):
        found = [[*entry.message[name].values()] for entry in start.of("/actions")]
        np.testing.assert_array_equal(found, ticks[name].to_pylist())


def test_poses_of_a_simulator_are_in_enu_and_flu(start: File) -> None:
    rows = pq.read_table(START / "frames.parquet").to_pylist()
    for entry, row in zip(start.of("/tf"), rows, strict=True):
        north, east, down = row["position_ned_m"]
        assert [*entry.message["translation"].values()] == [east, north, -down]
        turn = tuple(entry.message["rotation"][axis] for axis in "wxyz")
        north, east, down = rotate(tuple(row["ned_from_body_wxyz"]), (0, 1, 0))  # the right side
        assert rotate(turn, (0, -1, 0)) == pytest.approx((east, north, -down), abs=1e-6)


def test_images_are_those_of_the_video(flight: File, start: File) -> None:
    for entry, rgb in zip(start.of("/camera/front"), open_flight(START).images(), strict=True):
        image = image_of(entry)
        assert image.shape == rgb.shape == (96, 96, 3)
        assert np.abs(np.subtract(image, rgb, dtype=float)).mean() < 6.0
    images = [image_of(entry) for entry in flight.of("/camera/front")]
    assert images[0].shape == (48, 64, 3)
    assert [number_of(image) for image in images] == list(range(FRAMES))


@pytest.mark.parametrize("frame", ["ned_frd", "enu_flu"])
def test_a_flight_has_the_poses_of_its_ticks(tmp_path: Path, frame: Any) -> None:
    file = exported(record(tmp_path / "a", contract=Contract(state_frame=frame)), tmp_path / "out")
    assert len(file.of("/tf")) == TICKS - 1
    message = file.of("/tf")[4].message
    assert (message["parent_frame_id"], message["child_frame_id"]) == ("world", "body")
    assert message["translation"] == {"x": 2.0, "y": 1.0, "z": 2.0}
    # Yawed by 90 degrees in the contract's frame: towards the east in NED, the north in ENU.
    turn = tuple(message["rotation"][axis] for axis in "wxyz")
    nose = (1.0, 0.0, 0.0) if frame == "ned_frd" else (0.0, 1.0, 0.0)
    assert rotate(turn, (1.0, 0.0, 0.0)) == pytest.approx(nose, abs=1e-6)


def test_a_flight_tells_times_status_and_texts(flight: File) -> None:
    assert flight.schemas == SCHEMAS
    assert flight.of("/timing")[5] == Entry(
        "/timing",
        STARTED_NS + 5 * TICK_NS,
        {
            "image_age_ms": 40.0,
            "attitude_age_ms": 7.0,
            "velocity_age_ms": 10.0,
            "predict_ms": 2.0,
            "missed_slots": 0,
            "chunk_serial": 5,
        },
    )
    flies, released = flight.of("/status")
    common = {"mode": "ALT_HOLD", "armed": True}
    reason = {"release_code": "no_image", "release_reason": "no image feature yet"}
    nothing = dict.fromkeys(reason, "")
    assert flies.message == {"phase": "flying"} | common | nothing
    assert released.at_ns == STARTED_NS + RELEASED_FROM * TICK_NS
    assert released.message == {"phase": "released"} | common | reason
    logs = [(entry.message["name"], entry.message["message"]) for entry in flight.of("/log")]
    assert logs == [("vehicle", TEXTS[0]), ("mavbridge", TEXTS[1])]


def test_missing_values_have_no_key(flight: File) -> None:
    assert "throttle" not in flight.of("/actions")[NAN_TICK].message["raw"]
    assert flight.of("/actions")[NAN_TICK].message["raw"]["yaw"] == 0.0
    assert len(flight.of("/state")) == TICKS - 1
    blind, last = flight.of("/timing")[BLIND_TICK], flight.of("/timing")[-1]
    assert set(blind.message) == {"predict_ms", "missed_slots", "chunk_serial"}
    assert not {"predict_ms", "chunk_serial"} & set(last.message)
    assert set(flight.of("/actions")[-1].message) == {"rc_sticks"}


def test_every_camera_has_a_topic(tmp_path: Path) -> None:
    folder = record(tmp_path / "a", contract=Contract(cameras=("front", "down")))
    copy(folder / "camera.mp4", folder / "camera_down.mp4")
    copy(folder / "frames.parquet", folder / "frames_down.parquet")
    file = exported(folder, tmp_path / "out")
    assert len(file.of("/camera/front")) == len(file.of("/camera/down")) == FRAMES
    (folder / "camera_down.mp4").write_bytes((folder / "camera.mp4").read_bytes()[:-3000])
    _, text = told_by("export", folder, "--out", tmp_path / "cut", "--format", "mcap")
    assert "warning: " in text
    assert "camera_down.mp4" in text


def test_without_a_wall_time_the_stamps_are_monotonic(tmp_path: Path) -> None:
    file = exported(record(tmp_path / "a", started_at="yesterday"), tmp_path / "out")
    assert file.of("/timing")[0].at_ns == START_NS


def test_flights_of_the_same_name_have_files_of_their_own(tmp_path: Path) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        record(tmp_path / day / "1")
    days, out = (tmp_path / "monday", tmp_path / "tuesday"), tmp_path / "out"
    assert status_of("export", *days, "--out", out, "--format", "mcap") == 0
    assert sorted(path.name for path in out.iterdir()) == ["monday-1.mcap", "tuesday-1.mcap"]


def test_the_layout_names_what_a_file_has(flight: File) -> None:
    text = (ROOT / "examples/foxglove_layout.json").read_text()
    document = json.loads(text)
    panels = document["configById"]
    assert set(re.findall(r'"(\w+!\w+)"', json.dumps(document["layout"]))) == set(panels)
    assert {name.partition("!")[0] for name in panels} == {
        *("Image", "3D", "Plot", "StateTransitions", "RosOut")
    }
    named = set(re.findall(r'"(/[\w./]+)"', text))
    found = {path for entry in flight.entries for path in keys(entry.message, entry.topic)}
    assert named - found == set()
    assert {path.partition(".")[0] for path in named} == set(SCHEMAS)
    frames = {entry.message["child_frame_id"] for entry in flight.of("/tf")}
    assert {config["followTf"] for config in panels.values() if "followTf" in config} == frames
