"""Reads the project's flight folders (docs/flight_folder.md) into episodes."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import cast, get_args

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from policy.contract import ACTION_DIM, STATE_DIM, FloatArray, StateFrame
from policy.data.episodes import GATE_DIM, DatasetError, Episode, ImageArray, Nanoseconds

FORMAT, VERSION = "mavbridge-flight", 1
VIDEO = "camera.mp4"

_TICK_COLUMNS = (
    *("woke_ns", "sent_ns", "feature_captured_ns", "state", "attitude_ns", "velocity_ns"),
    *("sent", "rc_sticks", "armed"),
)
_FRAME_COLUMNS = ("captured_ns",)


def find_flights(paths: Sequence[Path]) -> list[Path]:
    """Each path that is a flight, and the flights directly in each that is a folder of flights.

    Raises:
        DatasetError: a path that is neither.
    """
    if not paths:
        raise DatasetError("no flights to learn from: name at least one flight folder")
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            raise DatasetError(f"{path}: no such folder")
        inside = sorted(meta.parent for meta in path.glob("*/meta.json"))
        flights = [path] if (path / "meta.json").is_file() else inside
        if not flights:
            raise DatasetError(
                f"{path}: neither a flight (it has no meta.json) nor a folder of flights; it "
                f"holds {sorted(entry.name for entry in path.iterdir())[:6]}"
            )
        found += flights
    return list(dict.fromkeys(flight.resolve() for flight in found))


def is_exemplary(folder: Path) -> bool:
    """Not a demonstration that failed: what led into a gate's frame is nothing to imitate.

    Raises:
        DatasetError: not a flight of ours.
    """
    meta = _read_meta(folder)
    return meta.get("source") != "demonstration" or meta.get("success") is not False


def read_flight(folder: Path) -> Episode:
    """One flight folder, finished or left behind by a crash.

    What is imitated: ``expert`` where there is such a column; otherwise what was sent; in a flight
    where nothing was sent (``--readonly``), the sticks of the pilot.

    Raises:
        DatasetError: not a flight of ours, or damaged, or nobody flew in it.
    """
    state_frame = _state_frame(folder)
    ticks = _read_table(folder, "ticks", _TICK_COLUMNS)
    frames = _read_table(folder, "frames", _FRAME_COLUMNS)
    video = folder / VIDEO
    if not video.is_file() or frames.num_rows == 0:
        raise DatasetError(f"{folder}: no frames: record the flight with its camera")
    tick_ns, sent_ns = _stamps(folder, ticks, "woke_ns"), _stamps(folder, ticks, "sent_ns")
    armed = np.array(ticks["armed"].to_pylist(), dtype=bool)
    sent = _sent(folder, ticks)
    if "expert" in ticks.column_names:
        # The expert looked when the policy would have; its stick is for that moment.
        target_ns, target = tick_ns, _vectors(folder, ticks, "expert", ACTION_DIM)
    else:
        target_ns, target = sent_ns, sent
    is_target = _known(target) & armed
    if not is_target.any():
        raise DatasetError(
            f"{folder}: nobody to learn from: no expert, and no stick was sent while armed"
        )
    state = _vectors(folder, ticks, "state", STATE_DIM)
    state[~is_target] = np.nan
    # Rows without a state need some stamp; nothing reads it.
    attitude_ns, velocity_ns = (
        np.where(_known(state), _stamps_or(ticks, name, tick_ns), tick_ns)
        for name in ("attitude_ns", "velocity_ns")
    )
    captured = ticks["feature_captured_ns"].to_pylist()
    ages = [t - c for t, c in zip(tick_ns.tolist(), captured, strict=True) if c is not None]
    with video.open("rb") as file:
        fingerprint = hashlib.file_digest(file, "sha256").hexdigest()
    return Episode(
        name=str(folder),
        state_frame=state_frame,
        tick_ns=tick_ns,
        state=state,
        attitude_ns=attitude_ns,
        velocity_ns=velocity_ns,
        target_ns=target_ns[is_target],
        target=target[is_target],
        sent_ns=sent_ns,
        sent=np.nan_to_num(sent, nan=0.0),
        age_ns=np.array(ages, dtype=np.int64),
        captured_ns=_stamps(folder, frames, "captured_ns"),
        gate=_gates(folder, frames),
        fingerprint=fingerprint,
        decode=partial(decode_video, video),
    )


def read_ages(folder: Path) -> Nanoseconds:
    """Measured ages of the image at each tick of a flight, sorted.

    Raises:
        DatasetError: not a flight, or no policy looked in it.
    """
    _state_frame(folder)
    ticks = _read_table(folder, "ticks", ("woke_ns", "feature_captured_ns"))
    tick_ns, captured = ticks["woke_ns"].to_pylist(), ticks["feature_captured_ns"].to_pylist()
    ages = [t - c for t, c in zip(tick_ns, captured, strict=True) if c is not None and t > c]
    if not ages:
        raise DatasetError(f"{folder}: no image had an age in it: no policy looked at its camera")
    return np.sort(np.array(ages, dtype=np.int64))


def decode_video(path: Path) -> Iterator[ImageArray]:
    """Frames [H, W, 3] RGB of a video, as far as it is readable.

    Raises:
        DatasetError: no video at all.
    """
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        raise DatasetError(f"{path}: not a readable video ({error})") from error
    with container:
        if not container.streams.video:
            raise DatasetError(f"{path}: there is no video in it")
        frames = container.decode(video=0)
        while True:
            try:
                frame = next(frames, None)
            except av.FFmpegError:
                return  # cut short by a crash: what came before it counts
            if frame is None:
                return
            yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)


def _read_meta(folder: Path) -> dict[str, object]:
    path = folder / "meta.json"
    try:
        data: object = json.loads(path.read_text())
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}: is it a flight folder?") from error
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON: {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise DatasetError(f"{folder}: not a flight of mavbridge (meta.json has no {FORMAT!r})")
    if data.get("version") != VERSION:
        raise DatasetError(
            f"{folder}: flight format version {data.get('version')}, this build reads {VERSION}"
        )
    return data


def _state_frame(folder: Path) -> StateFrame:
    contract = _read_meta(folder).get("contract")
    frame = contract.get("state_frame") if isinstance(contract, dict) else None
    for known in get_args(StateFrame):
        if frame == known:
            return cast(StateFrame, known)
    raise DatasetError(f"{folder}: its contract names no state frame that we know: {frame!r}")


def _read_table(folder: Path, stem: str, columns: tuple[str, ...]) -> pa.Table:
    parquet, stream = folder / f"{stem}.parquet", folder / f"{stem}.arrows"
    try:
        if parquet.is_file():
            table = pq.read_table(parquet)
        elif stream.is_file():
            table = _read_stream(stream)
        else:
            raise DatasetError(f"{folder}: neither {parquet.name} nor {stream.name} is there")
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{folder}: {stem} cannot be read: {error}") from error
    if missing := [name for name in columns if name not in table.column_names]:
        raise DatasetError(f"{folder}: {stem} lacks {missing}; it has {table.column_names}")
    if table.num_rows == 0 and stem == "ticks":
        raise DatasetError(f"{folder}: no ticks: nothing was flown")
    return table


def _read_stream(path: Path) -> pa.Table:
    """An Arrow stream up to its last whole batch."""
    batches = []
    with pa.OSFile(str(path)) as file, pa.ipc.open_stream(file) as reader:
        while True:
            try:
                batches.append(reader.read_next_batch())
            except (StopIteration, pa.ArrowInvalid, OSError):
                return pa.Table.from_batches(batches, schema=reader.schema)


def _stamps(folder: Path, table: pa.Table, name: str) -> Nanoseconds:
    column = table[name]
    if column.null_count:
        raise DatasetError(f"{folder}: {name} is missing in {column.null_count} rows")
    return np.asarray(column.to_numpy(), dtype=np.int64)


def _stamps_or(table: pa.Table, name: str, otherwise: Nanoseconds) -> Nanoseconds:
    pairs = zip(table[name].to_pylist(), otherwise.tolist(), strict=True)
    return np.array([value if value is not None else other for value, other in pairs], np.int64)


def _vectors(folder: Path, table: pa.Table, name: str, width: int) -> FloatArray:
    """List column -> [rows, width] float32, NaN where null."""
    out = np.full((table.num_rows, width), np.nan, dtype=np.float32)
    column = table[name].combine_chunks()
    valid = column.is_valid().to_numpy(zero_copy_only=False).astype(bool)
    values = column.drop_null().flatten().to_numpy(zero_copy_only=False).astype(np.float32)
    if values.size != valid.sum() * width:
        raise DatasetError(f"{folder}: {name} must hold {width} numbers a row")
    values = values.reshape(-1, width)
    if (bad := np.flatnonzero(~np.isfinite(values).all(axis=1))).size:
        row = int(np.flatnonzero(valid)[bad[0]])
        raise DatasetError(f"{folder}: {name} holds NaN or infinity in row {row}")
    out[valid] = values
    return out


def _known(vectors: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(~np.isnan(vectors).any(axis=1))


def _sent(folder: Path, ticks: pa.Table) -> FloatArray:
    """What flew: what was sent, or in a read-only flight what the pilot held."""
    sent = _vectors(folder, ticks, "sent", ACTION_DIM)
    return sent if _known(sent).any() else _vectors(folder, ticks, "rc_sticks", ACTION_DIM)


def _gates(folder: Path, frames: pa.Table) -> FloatArray:
    out = np.full((frames.num_rows, GATE_DIM), np.nan, dtype=np.float32)
    if "gate_body_m" in frames.column_names:
        out[:, :3] = _vectors(folder, frames, "gate_body_m", 3)
    if "gate_yaw_rad" in frames.column_names:
        yaw = frames["gate_yaw_rad"].to_pylist()
        out[:, 3] = [np.nan if value is None else value for value in yaw]
    if "gate_after_body_m" in frames.column_names:
        out[:, 4:] = _vectors(folder, frames, "gate_after_body_m", 3)
    return out
