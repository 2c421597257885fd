"""Reads the project's flight folders (docs/formats.md)."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.data.flight_data import GATE_DIM, FlightData, Nanoseconds
from policy.data.flight_files import META, TICKS, read_meta_document, video_of
from policy.data.flight_video import decode_video, read_frames
from policy.data.tables import (
    EXPERT_COLUMN,
    FRAME_COLUMNS,
    TICK_COLUMNS,
    TRUTH_COLUMNS,
    read_table,
    vectors,
)
from policy.errors import ContractError, DatasetError, NothingToLearnError
from policy.motion.stick_loop import StickLoop, rates_contract

_AGE_COLUMNS = ("woke_ns", "chunk_computed_ns", "predict_ns", "feature_captured_ns")
_TICKS = (
    *(*_AGE_COLUMNS, "sent_ns", "state", "attitude_ns", "velocity_ns"),
    *("sent", "rc_sticks", "armed", "phase", "mode"),
)
_FRAMES = pa.schema([FRAME_COLUMNS.field("captured_ns")])


def find_flights(paths: Sequence[Path]) -> list[Path]:
    """Return the paths that are flights, and the flights inside the paths that are folders of
    flights."""
    found: list[Path] = []
    for path in paths:
        try:
            if not path.is_dir():
                raise DatasetError(f"{path}: no such folder")
            inside = sorted(meta.parent for meta in path.glob(f"*/{META}"))
            flights = [path] if (path / META).is_file() else inside
            if not flights:
                raise DatasetError(
                    f"{path}: neither a flight (it has no {META}) nor a folder of flights; it "
                    f"holds {sorted(entry.name for entry in path.iterdir())[:6]}"
                )
        except OSError as error:
            raise DatasetError(f"{error.filename} cannot be read: {error.strerror}") from error
        found += flights
    return list(dict.fromkeys(flight.resolve() for flight in found))


def failure_of(folder: Path) -> str | None:
    """Return how a flight failed; None: it may be imitated.

    ``success`` decides if it is set; else a crash, a fault that ended the flight, or the end of its
    process. A hit of a gate's frame counts as a failure. A policy's flight that an expert labelled
    ("dagger") is used however it ended, and one that a pilot corrected although it missed gates.
    """
    meta = read_meta_document(folder)
    outcome = meta.get("outcome")
    outcome = outcome if isinstance(outcome, dict) else {}
    source, success = meta.get("source"), meta.get("success")
    if source == "dagger" or success is True:
        return None
    if meta.get("crash") or outcome.get("crash"):
        return "crashed"
    if outcome.get("end") == "fault":
        return "ended by a fault"
    if source == "flight" and meta.get("finished") is False:
        return "cut off"
    if success is False and source == "pilot":
        return "marked as bad"
    return "off the course" if success is False and not _is_corrected(folder, meta) else None


def _is_corrected(folder: Path, meta: Mapping[str, object]) -> bool:
    try:
        ticks = _read_ticks(folder, _TICKS, [])
        return bool(_corrections(ticks, _contract(str(folder), meta)).any())
    except DatasetError:
        return False


def leave_out_failed(
    folders: Sequence[Path], *, include_failed: bool
) -> tuple[list[Path], str | None]:
    """Return the flights to learn from, and a line with the exclusions and their reasons."""
    if include_failed:
        return list(folders), None
    failures = {folder: failure_of(folder) for folder in folders}
    counts = Counter(why for why in failures.values() if why)
    if not counts:
        return list(folders), None
    exemplary = [folder for folder in folders if failures[folder] is None]
    failed = counts.total()
    why = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    advice = "--include-failed takes in all but empty ones"
    if not exemplary:
        raise DatasetError(f"all {failed} flights have failed ({why}): {advice}")
    return exemplary, f"left out: {failed} of {len(folders)} flights that failed ({why}): {advice}"


def read_flights(
    folders: Sequence[Path],
    camera: str | None = None,
    progress: Callable[[], None] = lambda: None,
) -> tuple[list[FlightData], list[str]]:
    """Read flights, except empty ones, copies of others and those in which nobody flew.

    A copy could be both trained on and held out. Returns a sentence about each flight left out.
    """
    flights: list[FlightData] = []
    left_out: list[DatasetError] = []
    seen: dict[bytes, Path] = {}
    for folder in folders:
        try:
            if (first := seen.setdefault(_digest(folder), folder)) != folder:
                raise NothingToLearnError(f"{folder}: a copy of {first}")
            flights.append(read_flight(folder, camera))
        except NothingToLearnError as error:
            left_out.append(error)
        progress()
    if left_out and not flights:
        raise left_out[0]
    return flights, [f"left out: {error}" for error in left_out]


def _digest(folder: Path) -> bytes:
    """Return a digest of what a flight is known by; a table may be either of two files."""
    digest = hashlib.sha256()
    for path in (*sorted(folder.glob(f"{TICKS}.*")), folder / META, folder / video_of(None)):
        if path.is_file():
            with suppress(OSError), path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.digest()


def read_flight(folder: Path, camera: str | None = None) -> FlightData:
    """Read one flight folder, complete or left by a crash, with one camera's images.

    The sticks to imitate are the ``expert`` column if there is one; otherwise the pilot's after
    taking over from the policy; otherwise those that the policy flew; in a flight that sent nothing
    (``--readonly``), the pilot's. A pilot's count only in a mode of the contract: in another mode
    the same stick means something else. ``camera`` is one of several, by default the first.
    """
    name, meta = str(folder), read_meta_document(folder)
    damage: list[str] = []
    ticks = _read_ticks(folder, _TICKS, damage)
    contract = _contract(name, meta)
    _require_learnable(name, contract)
    course_seed, count = meta.get("course_seed"), meta.get("frames")
    chosen = _choose_camera(folder, contract.cameras, camera, damage)
    frames = read_frames(
        *(folder, chosen, _FRAMES),
        optional=TRUTH_COLUMNS,
        recorded=count if meta.get("finished") is True and isinstance(count, int) else None,
        damage=damage,
    )
    if not frames.num_rows:
        raise NothingToLearnError(
            f"{folder}: it ended before its first image, or has lost its video"
        )
    tick_ns, sent_ns = _decisions(ticks), ticks["sent_ns"].to_numpy()
    state = vectors(name, ticks, "state")
    sent, target, is_target = _sticks(name, ticks, contract)
    # An action that the link refused does not fly: the one before it does.
    is_refused = (np.array(ticks["phase"]) == "flying") & ~_known(sent)
    flew = np.maximum.accumulate(np.where(is_refused, 0, np.arange(len(sent))))
    # The expert observed at the policy's decision; its stick is for that time.
    target_ns = tick_ns if "expert" in ticks.column_names else sent_ns
    if contract.action == "rates":
        is_target &= _known(state)
        loop = StickLoop(rates_contract(contract))
        gains = loop.thrust_gains(vectors(name, ticks, "sent")[:, 0], state)
        target[is_target] = loop.to_sticks(target[is_target], state[is_target], gains[is_target])
    state[~(is_target | is_target[flew])] = np.nan
    return FlightData(
        name=name,
        tick_ns=tick_ns,
        state=state,
        attitude_ns=_stamps_or(ticks, "attitude_ns", tick_ns, _known(state)),
        velocity_ns=_stamps_or(ticks, "velocity_ns", tick_ns, _known(state)),
        target_ns=target_ns[is_target],
        target=target[is_target],
        sent_ns=sent_ns,
        sent=np.nan_to_num(sent[flew], nan=0.0),
        contract=contract,
        course_seed=course_seed if isinstance(course_seed, int) else None,
        age_ns=_ages(ticks),
        captured_ns=frames["captured_ns"].to_numpy(),
        gate=_gates(name, frames),
        decode=partial(decode_video, folder / video_of(chosen), frames.num_rows),
        damage=tuple(damage),
    )


def _choose_camera(
    folder: Path, cameras: Sequence[str], camera: str | None, damage: list[str]
) -> str | None:
    """Return the camera to read, None for the first; note in ``damage`` what is not read."""
    first, *others = cameras
    if camera is None:
        damage += [
            f"{folder}: camera {each} is left out, only the first is read" for each in others
        ]
    elif not others and camera != first:
        damage.append(f"{folder}: it has no camera {camera}: its only one, {first}, is read")
    elif camera not in cameras:
        raise DatasetError(f"{folder}: no camera {camera}; it has {list(cameras)}")
    return camera if camera in others else None


def _sticks(
    name: str, ticks: pa.Table, contract: Contract
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the sticks that flew, those to imitate, and True for the ticks to imitate."""
    sent = _sent(name, ticks, contract)
    is_expert = "expert" in ticks.column_names
    target = vectors(name, ticks, "expert") if is_expert else sent
    is_target = _known(target) & np.array([armed is True for armed in ticks["armed"].to_pylist()])
    is_correction = _corrections(ticks, contract)
    if not is_expert and is_correction.any():
        sent[is_correction] = vectors(name, ticks, "rc_sticks")[is_correction]
        target, is_target = sent, is_correction
    elif not is_expert:
        is_policys = ticks["sent"].null_count < ticks.num_rows
        is_in_mode = np.isin(ticks["mode"].to_pylist(), contract.modes)
        is_target &= np.array(ticks["phase"]) == "flying" if is_policys else is_in_mode
    if not is_target.any():
        raise NothingToLearnError(
            f"{name}: nobody to learn from: no expert, no sticks that a policy flew, and no sticks "
            f"of a pilot while armed and in {' or '.join(contract.modes)}"
        )
    return sent, target, is_target


def _sent(name: str, ticks: pa.Table, contract: Contract) -> FloatArray:
    """Return the sent sticks, or the pilot's if none were sent; centred in a flight by rates."""
    if contract.action == "sticks":
        sent = vectors(name, ticks, "sent")
        return sent if _known(sent).any() else vectors(name, ticks, "rc_sticks")
    if "expert" not in ticks.column_names:
        raise DatasetError(
            f"{name} was flown by rates without an expert: what was sent in it may also be an "
            "attitude, and the recording does not tell them apart; use mavbridge demonstrate"
        )
    return np.zeros((ticks.num_rows, ACTION_DIM), np.float32)


def _corrections(ticks: pa.Table, contract: Contract) -> NDArray[np.bool_]:
    """Return the ticks in which a pilot flew on after taking over from the policy by the sticks.

    In a takeover alone the sticks are given back straight from "flying".
    """
    names = ("phase", "armed", "mode", "sent", "rc_sticks")
    rows = zip(*(ticks[name].to_pylist() for name in names), strict=True)
    before, is_taken, out = None, False, []
    for phase, armed, mode, sent, sticks in rows:
        is_given_back = phase in ("releasing", "released")
        is_taken = armed and (is_given_back if before == "flying" else is_taken)
        is_pilots = phase == "released" and sent is None and sticks is not None
        out.append(is_taken and is_pilots and mode in contract.modes)
        before = phase
    return np.array(out, bool) & (contract.action == "sticks")


def read_ages(folder: Path) -> Nanoseconds:
    """Return the sorted image ages that were measured at the decisions of a flight."""
    read_meta_document(folder)
    ages = _ages(_read_ticks(folder, _AGE_COLUMNS, []))
    if not (ages > 0).any():
        raise DatasetError(f"{folder}: no image had an age in it: no policy looked at its camera")
    return np.sort(ages[ages > 0])


def _contract(name: str, meta: Mapping[str, object]) -> Contract:
    """Return the contract that a flight was flown by."""
    contract = meta.get("contract")
    if isinstance(contract, dict) and "state_frame" not in contract:
        raise DatasetError(
            f"{name}: its contract names no state_frame: write 'ned_frd' or 'enu_flu' there, the "
            "axes of its states"
        )
    try:
        return Contract.from_json(json.dumps(contract))
    except ContractError as error:
        raise DatasetError(f"{name}: {error}") from error


def _require_learnable(name: str, contract: Contract) -> None:
    """Raise DatasetError for actions that no network of ours learns."""
    if contract.action not in ("sticks", "rates"):
        raise DatasetError(
            f"{name} was flown by {contract.action}: this build learns from sticks and body rates"
        )
    if contract.action == "rates" and contract.state_frame != "ned_frd":
        # Recorded actions are in NED and FRD axes in any state frame; sticks have no axes.
        raise DatasetError(
            f"{name} was flown by rates with its state in {contract.state_frame}: this build "
            "learns body rates in ned_frd alone"
        )


def _read_ticks(folder: Path, names: Sequence[str], damage: list[str]) -> pa.Table:
    schema = pa.schema([TICK_COLUMNS.field(name) for name in names])
    ticks = read_table(folder / TICKS, schema, optional=[EXPERT_COLUMN], damage=damage)
    if ticks.num_rows == 0:  # perhaps killed before its first rows
        raise NothingToLearnError(f"{folder}: no ticks were recorded")
    return ticks


def _stamps_or(
    table: pa.Table, column: str, otherwise: Nanoseconds, use: NDArray[np.bool_]
) -> Nanoseconds:
    """Return the stamps of the rows to ``use``; other rows, never read, get ``otherwise``."""
    own = pc.coalesce(table[column], pa.array(otherwise)).to_numpy()
    return np.where(use, own, otherwise)


def _decisions(ticks: pa.Table) -> Nanoseconds:
    """Return when the solve behind each tick began, by its inputs; the tick's time without one.

    A tick without a solve counts as no later than the decisions after it.
    """
    began_ns = pc.subtract(ticks["chunk_computed_ns"], ticks["predict_ns"])
    at_ns: Nanoseconds = pc.coalesce(began_ns, ticks["woke_ns"]).to_numpy()
    return np.minimum.accumulate(at_ns[::-1])[::-1]


def _ages(ticks: pa.Table) -> Nanoseconds:
    """Return the image's age at the decision behind each tick that had one."""
    at_ns = pa.array(_decisions(ticks))
    ages: Nanoseconds = pc.subtract(at_ns, ticks["feature_captured_ns"]).drop_null().to_numpy()
    return ages


def _known(values: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(~np.isnan(values).any(axis=1))


def _gates(name: str, frames: pa.Table) -> FloatArray:
    out = np.full((frames.num_rows, GATE_DIM), np.nan, dtype=np.float32)
    if "gate_body_m" in frames.column_names:
        out[:, :3] = vectors(name, frames, "gate_body_m")
    if "gate_yaw_rad" in frames.column_names:
        out[:, 3] = frames["gate_yaw_rad"].to_numpy()  # null is NaN
    if "gate_after_body_m" in frames.column_names:
        out[:, 4:] = vectors(name, frames, "gate_after_body_m")
    return out
