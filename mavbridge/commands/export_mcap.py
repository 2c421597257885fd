"""``mavbridge export --format mcap``: each flight as a file for Foxglove and PlotJuggler.

Messages are JSON. The ``foxglove.X`` schemas, which viewers know by name, are those of foxglove-sdk
(``schemas/jsonschema``). A missing value has no key.
"""

import json
import math
import os
from base64 import b64encode
from collections.abc import Iterator, Sequence
from datetime import datetime
from heapq import merge
from itertools import chain
from pathlib import Path
from typing import NamedTuple, TypeAlias

from mcap.writer import Writer

from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export import whole_or_nothing
from mavbridge.commands.output import print_warnings, text_console
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Tick
from mavbridge.core.vehicle import ACTION_CLASSES, ActionKind, Sticks
from mavbridge.observe.images import as_rgb, jpeg
from mavbridge.recording.flight_folder import RecordedFlight, open_cameras
from mavbridge.recording.folder import FlightMeta
from mavbridge.recording.rows import TickRow
from policy.contract import QUATERNION, STATE_NAMES, StateFrame
from policy.data.flight_files import META
from policy.data.flight_folders import find_flights
from policy.motion.rotation import other_frame

JsonObject: TypeAlias = dict[str, object]
_INFO = 2  # level in a foxglove.Log, for recorded texts have none
_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}


class Message(NamedTuple):
    """Message of a file."""

    stamp_ns: int
    """On the flight's clock."""
    topic: str
    schema: str
    """Name in ``schemas``."""
    body: JsonObject


def schemas(kind: ActionKind) -> dict[str, JsonObject]:
    """Return the JSON schemas by name, for a flight by actions of this kind."""
    stamp = {"timestamp": _object(sec=_INTEGER, nsec=_INTEGER) | {"title": "time"}}
    image = _TEXT | {"contentEncoding": "base64"}
    action = _numbers(*ACTION_CLASSES[kind]._fields)
    times_ms = ("attitude_age_ms", "velocity_age_ms", "image_age_ms", "predict_ms")
    words = ("phase", "mode", "release_code", "release_reason")
    transform = {"translation": _numbers(*"xyz"), "rotation": _numbers(*"xyzw")}
    frames = {"parent_frame_id": _TEXT, "child_frame_id": _TEXT}
    return {
        "foxglove.CompressedImage": _object(**stamp, frame_id=_TEXT, data=image, format=_TEXT),
        "foxglove.FrameTransform": _object(**stamp, **frames, **transform),
        "foxglove.Log": _object(
            **stamp, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER
        ),
        "mavbridge.State": _object(frame=_TEXT, **dict.fromkeys(STATE_NAMES, _NUMBER)),
        "mavbridge.Actions": _object(
            **dict.fromkeys(("raw", "smoothed", "sent", "expert"), action),
            rc_sticks=_numbers(*Sticks._fields),
        ),
        "mavbridge.Timing": _object(
            **dict.fromkeys(times_ms, _NUMBER), missed_slots=_INTEGER, chunk_serial=_INTEGER
        ),
        "mavbridge.Status": _object(**dict.fromkeys(words, _TEXT), armed={"type": "boolean"}),
    }


def _object(**properties: object) -> JsonObject:
    return {"type": "object", "properties": properties}


def _numbers(*names: str) -> JsonObject:
    return _object(**dict.fromkeys(names, _NUMBER))


def export(flights: Sequence[Path], config: ExportConfig) -> int:
    """Export each flight to a file named after its folder."""
    console = text_console(stderr=True)
    folders = find_flights(flights)
    above, count = Path(os.path.commonpath([folder.parent for folder in folders])), 0
    with whole_or_nothing(config.out) as out:
        for folder in folders:
            cameras, name = open_cameras(folder), "-".join(folder.relative_to(above).parts)
            print_warnings(console, dict.fromkeys(chain(*(each.damage for each in cameras))))
            count += write_flight(cameras, out / f"{name}.mcap")
    text = f"{config.out}: {len(folders)} flights, {count} messages"
    text_console().print(text, soft_wrap=True)
    return 0


def write_flight(cameras: Sequence[RecordedFlight], path: Path) -> int:
    """Write a flight to a new file, a row and an image at a time; return the number of messages.

    ``cameras``: the flight with each of its cameras.

    Raises:
        MavbridgeError: a video is damaged.
        OSError: the file cannot be written.
    """
    flight = cameras[0]
    contract = flight.meta.contract
    offset_ns, known = unix_offset_ns(flight.meta), schemas(contract.action)
    videos = zip(contract.cameras, cameras, strict=True)
    streams = [_ticks(flight, contract.state_frame), *(_images(*each) for each in videos)]
    channels: dict[str, int] = {}
    count = 0
    with path.open("xb") as file:
        writer = Writer(file)
        writer.start()
        start_ns, meta = flight.meta.start_ns + offset_ns, (flight.folder / META).read_bytes()
        writer.add_attachment(start_ns, start_ns, META, "application/json", meta)
        writer.add_metadata("mavbridge", {"wall_offset_ns": str(offset_ns)})
        for stamp_ns, topic, name, body in merge(*streams, key=lambda each: each.stamp_ns):
            if topic not in channels:
                text = json.dumps(known[name])
                schema = writer.register_schema(name, "jsonschema", text.encode())
                channels[topic] = writer.register_channel(topic, "json", schema)
            at_ns = stamp_ns + offset_ns
            if name.startswith("foxglove."):
                body["timestamp"] = dict(zip(("sec", "nsec"), divmod(at_ns, NS_PER_S), strict=True))
            text = json.dumps(_finite(body), allow_nan=False)
            writer.add_message(channels[topic], at_ns, text.encode(), at_ns)
            count += 1
        writer.finish()
    return count


def unix_offset_ns(meta: FlightMeta) -> int:
    """Return Unix time minus the flight's clock; 0 if the start's wall time is unknown."""
    try:
        started_s = datetime.fromisoformat(meta.started_at).timestamp()
    except (TypeError, ValueError):
        return 0
    return round(started_s * 1e6) * 1000 - meta.start_ns


def _finite(body: JsonObject) -> JsonObject:
    """Drop missing values, and NaN and infinity, which JSON cannot hold."""
    kept = {key: _finite(each) if isinstance(each, dict) else each for key, each in body.items()}
    return {
        key: each
        for key, each in kept.items()
        if (math.isfinite(each) if isinstance(each, float) else each is not None)
    }


def _images(camera: str, flight: RecordedFlight) -> Iterator[Message]:
    """Yield the images of one camera at their exposures, and the true poses of a simulator."""
    for row, image in zip(flight.frame_rows(), flight.images(), strict=False):
        data = b64encode(jpeg(as_rgb(image))).decode()
        body: JsonObject = {"frame_id": camera, "data": data, "format": "jpeg"}
        yield Message(row.captured_ns, f"/camera/{camera}", "foxglove.CompressedImage", body)
        if row.truth is not None:
            pose_ned = (*row.truth.position_ned_m, *row.truth.ned_from_body_wxyz)
            yield _transform(row.captured_ns, pose_ned)


def _ticks(flight: RecordedFlight, frame: StateFrame) -> Iterator[Message]:
    """Yield the messages of all ticks; the status only when it changes."""
    first = next(flight.frame_rows(), None)
    has_truth = first is not None and first.truth is not None
    shown: JsonObject = {}
    for row in flight.tick_rows():
        tick, at_ns = row.tick, row.tick.woke_ns
        if tick.state is not None:
            state = tuple(tick.state.values.tolist())
            values = dict(zip(STATE_NAMES, state, strict=True))
            yield Message(at_ns, "/state", "mavbridge.State", {"frame": frame, **values})
            if tick.position_ned_m is not None and not has_truth:
                ned = state if frame == "ned_frd" else other_frame(state)
                yield _transform(at_ns, (*tick.position_ned_m, *ned[QUATERNION]))
        yield Message(at_ns, "/actions", "mavbridge.Actions", _actions(row))
        yield Message(at_ns, "/timing", "mavbridge.Timing", _timing(tick))
        status = _status(tick)
        if status != shown:
            yield Message(at_ns, "/status", "mavbridge.Status", status)
            shown = status
        for text in tick.texts:
            name = "vehicle" if text.startswith("vehicle: ") else "mavbridge"
            log = {"level": _INFO, "name": name, "message": text, "file": "", "line": 0}
            yield Message(at_ns, "/log", "foxglove.Log", log)


def _actions(row: TickRow) -> JsonObject:
    """Return the actions of a tick, each by the names of its numbers."""
    tick, trace = row.tick, row.tick.trace
    found = {"sent": tick.sent, "expert": row.expert, "rc_sticks": tick.rc_sticks}
    if trace is not None:
        found |= {"raw": trace.raw, "smoothed": trace.smoothed}
    return {name: action and action._asdict() for name, action in found.items()}


def _timing(tick: Tick) -> JsonObject:
    """Return the ages of a tick's inputs at its send, and the cost of its chunk."""
    state, sent_ns = tick.state, tick.sent_ns
    since_ns = {"image_age_ms": tick.feature_captured_ns}
    if state is not None:
        since_ns |= {"attitude_age_ms": state.attitude_ns, "velocity_age_ms": state.velocity_ns}
    return {
        **{key: None if at is None else (sent_ns - at) / NS_PER_MS for key, at in since_ns.items()},
        "predict_ms": None if tick.predict_ns is None else tick.predict_ns / NS_PER_MS,
        "missed_slots": tick.missed_slots,
        "chunk_serial": tick.chunk_serial,
    }


def _status(tick: Tick) -> JsonObject:
    """Return what a tick says about control; the reason is empty while the policy flies."""
    reason = tick.release_reason
    code, text = ("", "") if reason is None else (reason.code.value, str(reason))
    words = {"phase": tick.phase, "mode": tick.mode, "armed": tick.armed}
    return {**words, "release_code": code, "release_reason": text}


def _transform(stamp_ns: int, pose_ned: tuple[float, ...]) -> Message:
    """Return the pose of the body (FLU) in the world (ENU) from position and ned_from_body wxyz."""
    x, y, z, qw, qx, qy, qz = other_frame(pose_ned)
    body: JsonObject = {
        "parent_frame_id": "world",
        "child_frame_id": "body",
        "translation": {"x": x, "y": y, "z": z},
        "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
    }
    return Message(stamp_ns, "/tf", "foxglove.FrameTransform", body)
