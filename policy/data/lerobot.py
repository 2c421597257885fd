"""Reads LeRobot v3 datasets that have the contract's features; an episode is a flight."""

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast, get_args

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from av.video.reformatter import VideoReformatter

from policy.contract import (
    ACTION_NAMES,
    NS_PER_S,
    SPECIFIC_FORCE,
    STATE_NAMES,
    STICK_TERMS,
    Contract,
    FloatArray,
    StateFrame,
)
from policy.data import lerobot_format as names
from policy.data.flight_data import GATE_DIM, FlightData, ImageArray, Nanoseconds
from policy.data.flight_video import rgb_pixels
from policy.data.tables import MAX_ROWS, columns, conform, vectors
from policy.errors import ContractError, DatasetError
from policy.files import (
    CONTRACT_FILE,
    UNANSWERED,
    library_name,
    read_object,
    read_toml,
    why_unreadable,
)

_PATH = re.compile(r"(?:[^{}]|\{(?:chunk_index|file_index|video_key)(?::0?\dd)?\})*")
"""Path templates: fields with these names, a few digits wide."""
_UNITS = (("state", "scale"), ("action", "scale"), ("action", "offset"))
_MAX_EPISODES = 100_000
_CONVERT = "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=..."


def read_dataset(folder: Path, camera_key: str | None = None) -> list[FlightData]:
    """Read all episodes of a dataset.

    Stamps are those that ``mavbridge export`` adds. Without them, image, state and action of a row
    all have the row's ``timestamp``. A LeRobot dataset does not record how old an image was when a
    policy acted on it: ``age_ns`` is empty. ``camera_key`` is the feature with the images, by
    default the only one.
    """
    info = _read_info(folder, camera_key)
    rows = _read_episodes(info)
    fields = [
        *(_EPISODE, pa.field("timestamp", pa.float64(), nullable=False)),
        *_vectors(len(STATE_NAMES), names.STATE_KEY),
        *_vectors(len(ACTION_NAMES), names.ACTION_KEY),
        *_integers(*(name for name in names.STAMPS if name in info.features)),
    ]
    if names.SENT in info.features and names.SENT_AT in info.features:
        fields += _vectors(len(ACTION_NAMES), names.SENT)
    files: dict[Path, list[_Row]] = {}
    for row in rows:
        files.setdefault(row.data, []).append(row)
    flights = []
    for path, inside in files.items():
        table = _read_table(path, fields)
        for row in inside:
            part = table.filter(pc.equal(table["episode_index"], row.episode_index))
            if part.num_rows != row.length:
                raise DatasetError(
                    f"{row.name}: {path} holds {part.num_rows} rows of it, meta/episodes says "
                    f"{row.length}: the dataset is incomplete"
                )
            flights.append(_flight(info, row, part))
    return flights


@dataclass(frozen=True, kw_only=True)
class _Info:
    """Used parts of ``meta/info.json``."""

    folder: Path
    fps: float
    features: Mapping[str, Mapping[str, Any]]
    data_path: str
    video_path: str
    camera: str
    is_video: bool
    contract: Contract
    """With ``STICK_TERMS``, and ``told_frame`` if that is not None."""
    told_frame: StateFrame | None
    """State frame by the contract file."""


@dataclass(frozen=True, kw_only=True)
class _Row:
    """Used parts of a row of ``meta/episodes``."""

    name: str
    episode_index: int
    length: int
    data: Path
    video: Path
    """Equal to ``data`` if the images are in the table."""
    from_s: float


def _read_info(folder: Path, camera_key: str | None) -> _Info:
    path = folder / names.INFO
    data = read_object(path, DatasetError, "LeRobot dataset")
    version = data.get("codebase_version")
    if not isinstance(version, str) or not version.startswith("v3."):
        raise DatasetError(
            f"{folder}: a LeRobot dataset of version {version}, this build reads v3: convert one "
            f"of v2.1 with lerobot itself ({_CONVERT})"
        )
    fps, features = data.get("fps"), data.get("features")
    if not isinstance(fps, int | float) or not 0 < fps < math.inf:
        raise DatasetError(f"{path}: fps must be a positive number, got {fps!r}")
    if not isinstance(features, dict) or not all(isinstance(f, dict) for f in features.values()):
        raise DatasetError(f"{path} describes no features")
    _require_vector(folder, features, names.STATE_KEY, STATE_NAMES)
    _require_vector(folder, features, names.ACTION_KEY, ACTION_NAMES)
    camera = _choose_camera(folder, features, camera_key)
    for key in ("data_path", "video_path"):
        if not _PATH.fullmatch(template := str(data.get(key) or "")):
            raise DatasetError(f"{path} does not say where its files are: {key} {template[:99]!r}")
    contract, told_frame = _told_contract(folder / CONTRACT_FILE)
    return _Info(
        folder=folder,
        fps=float(fps),
        features=features,
        data_path=str(data.get("data_path") or names.DATA),
        video_path=str(data.get("video_path") or names.VIDEO),
        camera=camera,
        is_video=features[camera].get("dtype") == "video",
        contract=contract,
        told_frame=told_frame,
    )


def _told_contract(path: Path) -> tuple[Contract, StateFrame | None]:
    """Return the defaults with the ``STICK_TERMS`` of a dataset's contract file, if there is one,
    and the state frame, if the file says it.

    An open question among its other entries does not matter.
    """
    try:
        tables = read_toml(path)
        said = tables.get("contract", {})
        if units := [f"[{t}] {n}" for t, n in _UNITS if n in tables.get(t, {})]:
            raise ContractError(f"{units[0]} is not applied to data: convert the columns instead")
        told = {name: said[name] for name in STICK_TERMS if name in said}
        has_frame = said.get(names.STATE_FRAME, UNANSWERED) != UNANSWERED
        if has_frame:
            told[names.STATE_FRAME] = said[names.STATE_FRAME]
        contract = Contract.from_fields(told)
        return contract, contract.state_frame if has_frame else None
    except FileNotFoundError:
        return Contract(), None
    except (OSError, ValueError, TypeError, AttributeError, ContractError) as error:
        raise DatasetError(f"{path} does not tell what its numbers mean: {error}") from error


def _require_vector(
    folder: Path, features: Mapping[str, Mapping[str, Any]], key: str, wanted: Sequence[str]
) -> None:
    feature = features.get(key)
    if feature is None:
        raise DatasetError(f"{folder}: no feature {key}; it has {sorted(features)}")
    shape = feature.get("shape")
    if shape != [len(wanted)]:
        raise DatasetError(
            f"{folder}: {key} has shape {shape}, the policy takes [{len(wanted)}]: {list(wanted)}"
        )
    if (got := names.feature_names(feature)) != list(wanted):
        raise DatasetError(
            f"{folder}: {key} is named {got}, the policy takes {list(wanted)} in this order: put "
            "the columns so, and say so in meta/info.json"
        )


def _choose_camera(
    folder: Path, features: Mapping[str, Mapping[str, Any]], asked: str | None
) -> str:
    cameras = sorted(k for k, f in features.items() if f.get("dtype") in ("video", "image"))
    if not cameras:
        raise DatasetError(f"{folder}: no camera: no feature is a video or image")
    if asked is None and len(cameras) > 1:
        raise DatasetError(f"{folder}: several cameras {cameras}: name one by --camera-key")
    if asked is not None and asked not in cameras:
        raise DatasetError(f"{folder}: no camera {asked}; it has {cameras}")
    return asked or cameras[0]


def _read_episodes(info: _Info) -> list[_Row]:
    files = sorted((info.folder / "meta" / "episodes").glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"{info.folder}: no meta/episodes/*/*.parquet: it is incomplete")
    fields = [_EPISODE, *_integers("length", "data/chunk_index", "data/file_index")]
    if info.is_video:
        video = f"videos/{info.camera}/"
        fields += _integers(f"{video}chunk_index", f"{video}file_index")
        fields.append(pa.field(f"{video}from_timestamp", pa.float64(), nullable=False))
    table = pa.concat_tables([_read_table(file, fields, _MAX_EPISODES) for file in files])
    if not 0 < table.num_rows <= _MAX_EPISODES:
        raise DatasetError(
            f"{info.folder}: {table.num_rows} episodes in it; must be 1 to {_MAX_EPISODES}"
        )
    episodes = table["episode_index"].to_numpy()
    found, counts = np.unique(episodes, return_counts=True)
    if counts.max() > 1:  # it could be both trained on and held out
        raise DatasetError(
            f"{info.folder}: meta/episodes lists episode {found[counts.argmax()]} {counts.max()} "
            "times: keep one row of it"
        )
    return [_row(info, values) for values in table.to_pylist()]


def _row(info: _Info, values: Mapping[str, Any]) -> _Row:
    number = values["episode_index"]
    name, prefix = f"{info.folder}, episode {number}", f"videos/{info.camera}/"
    try:
        video = data = info.folder / info.data_path.format(
            chunk_index=values["data/chunk_index"], file_index=values["data/file_index"]
        )
        if info.is_video:
            video = info.folder / info.video_path.format(
                video_key=info.camera,
                chunk_index=values[f"{prefix}chunk_index"],
                file_index=values[f"{prefix}file_index"],
            )
    except (KeyError, IndexError, ValueError) as error:
        raise DatasetError(f"{name}: meta does not say where its files are: {error!r}") from error
    from_s = values[f"{prefix}from_timestamp"] if info.is_video else 0.0
    if not math.isfinite(from_s):
        raise DatasetError(f"{name}: its from_timestamp is {from_s}: copy the dataset again")
    if (length := values["length"]) < 1:
        raise DatasetError(f"{name}: meta/episodes says that it has {length} rows: remove it")
    for path in (data, video):
        if not Path(os.path.normpath(path)).is_relative_to(os.path.normpath(info.folder)):
            raise DatasetError(f"{name}: {path} lies outside the dataset")
    if not video.is_file():
        raise DatasetError(f"{name}: {video} is not there: copy the dataset again, whole")
    return _Row(
        name=name, episode_index=number, length=length, data=data, video=video, from_s=from_s
    )


def _integers(*names: str) -> list[pa.Field]:
    return columns(pa.int64(), *names, nullable=False)


def _vectors(width: int, name: str) -> list[pa.Field]:
    return columns(pa.list_(pa.float32(), width), name, nullable=False)


(_EPISODE,) = _integers("episode_index")


def _read_table(path: Path, fields: Sequence[pa.Field], max_rows: int = MAX_ROWS) -> pa.Table:
    return conform(path, _read_columns(path, [field.name for field in fields], max_rows), fields)


def _read_columns(path: Path, columns: list[str], max_rows: int = MAX_ROWS) -> pa.Table:
    try:
        with pq.ParquetFile(library_name(path)) as file:
            has, rows = file.schema_arrow.names, file.metadata.num_rows
            if missing := [name for name in columns if name not in has]:
                raise DatasetError(f"{path} lacks {missing}, which meta/info.json promises")
            if rows > max_rows:
                raise DatasetError(f"{path} has {rows} rows, more than {max_rows}")
            return file.read(columns)
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is not there: copy the dataset again, whole") from error
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(why_unreadable(path, error)) from error


def _flight(info: _Info, row: _Row, table: pa.Table) -> FlightData:
    seconds = table["timestamp"].to_numpy()
    if not np.isfinite(seconds).all():
        raise DatasetError(f"{row.name}: timestamp holds NaN or infinity")
    off_s = np.abs(seconds - seconds[0] - np.arange(row.length) / info.fps)
    if off_s.max() > 0.5 / info.fps:
        raise DatasetError(
            f"{row.name}: the timestamp of row {off_s.argmax()} is {off_s.max():.3g} s off: rows "
            f"are 1 / {info.fps:g} s apart by the fps of meta/info.json: mend one of them"
        )
    timestamp_ns = np.round(seconds * NS_PER_S).astype(np.int64)

    def at(name: str) -> Nanoseconds:
        has_own = name in table.column_names
        return np.asarray(table[name], np.int64) if has_own else timestamp_ns

    has_sent = names.SENT in table.column_names
    state = vectors(row.name, table, names.STATE_KEY)
    action = vectors(row.name, table, names.ACTION_KEY)
    return FlightData(
        name=row.name,
        contract=replace(info.contract, state_frame=_state_frame(info, row, state)),
        tick_ns=at(names.TICK),
        state=state,
        attitude_ns=at(names.ATTITUDE),
        velocity_ns=at(names.VELOCITY),
        target_ns=at(names.ACTED),
        target=action,
        sent_ns=at(names.SENT_AT if has_sent else names.ACTED),
        sent=vectors(row.name, table, names.SENT) if has_sent else action,
        age_ns=np.array([], dtype=np.int64),
        captured_ns=at(names.CAPTURED),
        gate=np.full((row.length, GATE_DIM), np.nan, dtype=np.float32),
        decode=partial(_decode, info, row),
    )


def _state_frame(info: _Info, row: _Row, state: FloatArray) -> StateFrame:
    """Return the noted frame, or that of the contract file; else tell it by gravity."""
    noted = names.noted_frame(info.features[names.STATE_KEY])
    frames = [each for each in (noted, info.told_frame) if each is not None]
    if any(each != frames[0] or each not in get_args(StateFrame) for each in frames):
        raise DatasetError(
            f"{row.name}: its state frame is {noted!r}, in {CONTRACT_FILE} {info.told_frame!r}; "
            f"known are {list(get_args(StateFrame))}"
        )
    if frames:
        return cast(StateFrame, frames[0])
    az_mps2 = float(np.median(state[:, SPECIFIC_FORCE][:, 2]))
    if (frame := names.frame_by_gravity(az_mps2)) is None:
        raise DatasetError(
            f"{row.name}: its az_mps2 is {az_mps2:.1f} in the median; a specific force is -9.8 in "
            "ned_frd and 9.8 in enu_flu: write which one it is as state_frame under [contract] in "
            f"{info.folder / CONTRACT_FILE}"
        )
    return frame


def _decode(info: _Info, row: _Row) -> Iterator[ImageArray]:
    count = 0
    for image in _decode_video(info, row) if info.is_video else _decode_table(info, row):
        yield image
        count += 1
    if count != row.length:
        raise DatasetError(f"{row.name}: {row.video} ends after {count} of {row.length} images")


def _decode_video(info: _Info, row: _Row) -> Iterator[ImageArray]:
    """Yield the frames nearest to ``from_timestamp + k / fps``, as LeRobot's reader does."""
    try:
        with av.open(library_name(row.video), format="mp4") as container:
            stream = container.streams.video[0]
            tick_s = float(stream.time_base or 0)
            container.seek(max(0, round(row.from_s / tick_s) - 1), backward=True, stream=stream)
            wanted, converter = 0, VideoReformatter()
            for frame in container.decode(stream):
                if frame.pts is None:
                    continue
                number = round((frame.pts * tick_s - row.from_s) * info.fps)
                if number > wanted:
                    raise DatasetError(f"{row.name}: {row.video} has no frame for row {wanted}")
                if number < wanted:
                    continue
                yield rgb_pixels(frame, converter)
                wanted += 1
                if wanted == row.length:
                    return
    except (av.FFmpegError, OSError, IndexError, ArithmeticError) as error:
        raise DatasetError(why_unreadable(row.video, error)) from error


def _decode_table(info: _Info, row: _Row) -> Iterator[ImageArray]:
    """Yield the images of a table, PNG or JPEG; LeRobot's cells are ``{"bytes", "path"}``."""
    table = _read_columns(row.data, ["episode_index", info.camera])
    cells = table[info.camera].filter(pc.equal(table["episode_index"], row.episode_index))
    for number, cell in enumerate(cells.to_pylist()):
        encoded: Any = cell.get("bytes") if isinstance(cell, dict) else cell
        bgr = None
        with suppress(cv2.error, TypeError):  # nothing in it, too many pixels, or no bytes
            bgr = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            found = "not a PNG or JPEG in the table that can be decoded"
            if isinstance(cell, dict) and cell.get("path") and encoded is None:
                found = f"not in the table, which has its path alone ({cell['path']})"
            raise DatasetError(
                f"{row.name}: the image of row {number} is {found}: copy the dataset again, or "
                "save it again with LeRobot"
            )
        yield cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
