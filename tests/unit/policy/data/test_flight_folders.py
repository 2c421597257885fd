import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.flight_folders import LEVEL, MS, spot, ticks_table, write_flight, write_meta
from policy.contract import Contract
from policy.data.flight_data import hold_out
from policy.data.flight_folders import (
    failure_of,
    find_flights,
    leave_out_failed,
    read_ages,
    read_flight,
    read_flights,
)
from policy.errors import DatasetError

WOKE = [0, 10 * MS, 20 * MS]
STICK = (0.1, 0.2, 0.3, 0.4)


def flight(folder: Path, meta: dict[str, Any] | None = None, **ticks: Any) -> Path:
    """Write three ticks, by default of an expert who flew himself, and two images."""
    table = ticks_table(
        **{"woke_ns": WOKE, "expert": [STICK] * 3, "sent": [STICK] * 3, **ticks},
    )
    images = [spot(32, 0.0)] * 2
    return write_flight(folder, table, captured_ns=[0, 33 * MS], images=images, **(meta or {}))


def test_expert_is_imitated_where_there_is_one(tmp_path: Path) -> None:
    folder = flight(
        tmp_path / "a",
        expert=[STICK, None, STICK],
        sent=[None, (0.5, 0, 0, 0), (0.6, 0, 0, 0)],
        captured_ns=[None, 2 * MS, 5 * MS],
        attitude_lag_ns=3 * MS,
        sent_lag_ns=1 * MS,
    )
    episode = read_flight(folder)
    assert episode.target_ns.tolist() == [0, 20 * MS]
    np.testing.assert_allclose(episode.target, [STICK, STICK])
    assert episode.sent_ns.tolist() == [1 * MS, 11 * MS, 21 * MS]
    np.testing.assert_allclose(episode.sent[:, 0], [0.0, 0.5, 0.6])  # released is neutral
    assert np.isnan(episode.state).all(axis=1).tolist() == [False, True, False]
    assert episode.attitude_ns[[0, 2]].tolist() == [-3 * MS, 17 * MS]
    assert episode.age_ns.tolist() == read_ages(folder).tolist() == [8 * MS, 15 * MS]
    assert np.isnan(episode.gate).all()
    assert [image.shape for image in episode.decode()] == [(32, 32, 3)] * 2
    with pytest.raises(DatasetError, match="no policy looked"):
        read_ages(flight(tmp_path / "b"))


def test_cameras_that_are_not_read_are_named(tmp_path: Path) -> None:
    folder = flight(tmp_path / "a", contract(cameras=["front", "down"]))
    assert read_flight(folder).damage == (
        f"{folder}: camera down is left out, only the first is read",
    )


def test_one_of_several_cameras_is_read(tmp_path: Path) -> None:
    meta = contract(cameras=["down", "front"])
    folder, other = (flight(tmp_path / name, meta) for name in "ab")
    frames = pa.table({"captured_ns": [5 * MS, 38 * MS]})
    pq.write_table(frames, folder / "frames_front.parquet")
    (other / "camera.mp4").rename(folder / "camera_front.mp4")
    for camera, first_ns in ((None, 0), ("down", 0), ("front", 5 * MS)):
        episode = read_flight(folder, camera)
        assert episode.captured_ns[0] == first_ns
        assert len(list(episode.decode())) == 2
    (damage,) = read_flight(flight(tmp_path / "c"), "down").damage
    assert damage.endswith("it has no camera down: its only one, front, is read")


def test_a_tick_counts_as_the_decision_behind_it_and_as_no_later_than_the_next(
    tmp_path: Path,
) -> None:
    """Otherwise a history would hold the labels: the state is that of the decision.

    An expert's stick is for the state it was computed at, not for the later send.
    """
    ticks = {
        "woke_ns": [100 * MS, 200 * MS, 210 * MS, 220 * MS],
        "sent": [STICK] * 4,
        "captured_ns": [None, 40 * MS, None, 140 * MS],
        "solved_ns": [(None, None), (90 * MS, 40 * MS), (90 * MS, 40 * MS), (215 * MS, 45 * MS)],
    }
    folder = flight(tmp_path / "a", **ticks, expert=None)
    read = read_flight(folder)
    assert read.tick_ns.tolist() == [50 * MS, 50 * MS, 50 * MS, 170 * MS]
    assert read.age_ns.tolist() == read_ages(folder).tolist() == [10 * MS, 30 * MS]
    assert read.target_ns.tolist() == [100 * MS, 200 * MS, 210 * MS, 220 * MS]
    labelled = read_flight(flight(tmp_path / "b", **ticks, expert=[STICK] * 4))
    assert labelled.target_ns.tolist() == read.tick_ns.tolist()


def test_without_an_expert_what_was_sent_while_armed_is_imitated(tmp_path: Path) -> None:
    armed = [False, True, True]
    episode = read_flight(flight(tmp_path / "a", expert=None, armed=armed, sent_lag_ns=MS))
    assert episode.target_ns.tolist() == [11 * MS, 21 * MS]
    pilot = flight(tmp_path / "b", expert=None, sent=[None] * 3, rc_sticks=[STICK] * 3)
    episode = read_flight(pilot)
    np.testing.assert_allclose(episode.target, [STICK] * 3)
    np.testing.assert_allclose(episode.sent, [STICK] * 3)


def test_only_what_the_policy_flew_is_imitated_not_the_guards_neutral_sticks(
    tmp_path: Path,
) -> None:
    neutral, phases = (0.0,) * 4, ["preparing", "flying", "flying", "holding", "released"]
    sent = [neutral, STICK, None, neutral, None]  # the third was refused, so the second flies on
    woke_ns = [*WOKE, 30 * MS, 40 * MS]
    folder = flight(tmp_path / "a", expert=None, woke_ns=woke_ns, sent=sent, phase=phases)
    episode = read_flight(folder)
    assert episode.target_ns.tolist() == WOKE[1:2]
    np.testing.assert_allclose(episode.sent, [neutral, STICK, STICK, neutral, neutral])
    assert np.isfinite(episode.state).all(axis=1).tolist() == [False, True, True, False, False]


def test_a_pilots_sticks_are_imitated_in_modes_of_the_contract(tmp_path: Path) -> None:
    pilot = {"expert": None, "sent": [None] * 3, "rc_sticks": [STICK] * 3}
    modes = ["STABILIZE", "ALT_HOLD", "LAND"]
    assert read_flight(flight(tmp_path / "a", **pilot, mode=modes)).target_ns.tolist() == WOKE[1:2]
    with pytest.raises(DatasetError, match="a pilot while armed and in ALT_HOLD or ALTCTL"):
        read_flight(flight(tmp_path / "b", **pilot, mode=["LOITER"] * 3))


TAKEN = ["flying", "releasing", "released"]


@pytest.mark.parametrize(
    ("phases", "modes", "corrected"),
    [
        (TAKEN, [], [2]),
        ([*TAKEN, "preparing", "flying", "leaving", "released"], [], [2]),
        ([*TAKEN, "released", *TAKEN], ["LOITER", *["ALT_HOLD"] * 3], [2, 6]),
        (["flying", "leaving", "released", *TAKEN], [], [5]),
        (["flying", "leaving", "released"], [], []),
        (TAKEN, ["LOITER"], []),
    ],
)
def test_after_a_takeover_the_pilots_sticks_alone_are_imitated(
    tmp_path: Path, phases: list[str], modes: list[str], corrected: list[int]
) -> None:
    pilots, neutral = (0.0, 0.0, 0.5, 0.0), (0.0,) * 4
    flown = {"flying": STICK, "leaving": neutral}
    folder = flight(
        tmp_path / "a",
        {"source": "flight", "success": False, "outcome": {"end": "signal"}},
        woke_ns=[at * 10 * MS for at in range(len(phases))],
        expert=None,
        sent=[flown.get(phase) for phase in phases],
        rc_sticks=[pilots] * len(phases),
        phase=phases,
        mode=[*["ALT_HOLD"] * (len(phases) - len(modes)), *modes],
    )
    assert failure_of(folder) == (None if corrected else "off the course")
    episode = read_flight(folder)
    target = corrected or [at for at, phase in enumerate(phases) if phase == "flying"]
    assert episode.target_ns.tolist() == [at * 10 * MS for at in target]
    np.testing.assert_allclose(episode.target, [pilots if corrected else STICK] * len(target))
    np.testing.assert_allclose([episode.sent[at] for at in corrected], [pilots] * len(corrected))


def test_failed_flights_are_left_out_and_counted_unless_they_are_asked_for(tmp_path: Path) -> None:
    for name, success in (("a", True), ("b", False), ("c", None)):
        write_meta(tmp_path / name, source="pilot", success=success)
    for name in "de":
        write_meta(tmp_path / name, source="flight", outcome={"end": "fault"})
    folders = [tmp_path / name for name in "abcde"]
    kept, note = leave_out_failed(folders, include_failed=False)
    assert kept == [tmp_path / "a", tmp_path / "c"]
    assert "3 of 5 flights that failed (2 ended by a fault, 1 marked as bad)" in note
    assert "--include-failed" in note
    assert leave_out_failed(folders, include_failed=True) == (folders, None)
    assert leave_out_failed([], include_failed=False) == ([], None)
    with pytest.raises(DatasetError, match="all 1 flights have failed"):
        leave_out_failed([tmp_path / "b"], include_failed=False)


@pytest.mark.parametrize("frames", [0, None])
def test_a_flight_without_an_image_is_left_out(tmp_path: Path, frames: int | None) -> None:
    blind, seen = flight(tmp_path / "a", {"frames": frames}), flight(tmp_path / "b", {"seed": 1})
    for name in ("camera.mp4", "frames.parquet"):
        (blind / name).unlink()
    flights, notes = read_flights([blind, seen])
    assert [each.name for each in flights] == [str(seen)]
    assert notes == [f"left out: {blind}: it ended before its first image, or has lost its video"]
    flight(tmp_path / "c", {"frames": 2, "finished": True})
    (tmp_path / "c" / "camera.mp4").unlink()
    (tmp_path / "c" / "frames.parquet").unlink()
    with pytest.raises(DatasetError, match=r"lacks frames\.parquet, though 2 frames were recorded"):
        read_flights([tmp_path / "c", seen])


def test_no_flights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="x cannot be read: File name too long"):
        find_flights([tmp_path / ("x" * 300)])
    with pytest.raises(DatasetError, match="no such folder"):
        find_flights([tmp_path / "missing"])
    with pytest.raises(DatasetError, match="neither a flight"):
        find_flights([tmp_path])
    write_meta(tmp_path)
    with pytest.raises(DatasetError, match=r"neither ticks\.parquet nor"):
        read_flight(tmp_path)
    folder = flight(tmp_path / "a")
    assert find_flights([tmp_path, folder]) == [tmp_path.resolve(), folder.resolve()]
    (folder / "camera.mp4").unlink()
    with pytest.raises(DatasetError, match="has lost its video"):
        read_flight(folder)


def contract(**terms: object) -> dict[str, object]:
    return {"contract": {"state_frame": "ned_frd", **terms}}


def test_by_rates_the_thrust_of_a_heavy_vehicle_is_not_imitated(tmp_path: Path) -> None:
    """A policy's thrusts are scaled by the same factor in flight."""
    count, moving = 600, (3.0, *LEVEL[1:])
    thrust = (1.2 * Contract().hover_thrust, 0.0, 0.0, 0.0)
    folder = flight(
        tmp_path / "a",
        contract(action="rates"),
        woke_ns=[10 * MS * tick for tick in range(count)],
        state=[None, *[moving] * (count - 1)],
        expert=[thrust] * count,
        sent=[None, *[thrust] * (count - 1)],
    )
    climb = read_flight(folder).target[:, 0]
    assert climb[0] == pytest.approx(0.2 * 9.80665 / 4.0 / 6.0, rel=1e-3)
    assert abs(climb[-1]) < 0.01


@pytest.mark.parametrize(
    ("meta", "ticks", "says"),
    [
        ("{", {}, "not JSON"),
        ("[]", {}, "not of a recorded flight"),
        ({"format": "other"}, {}, "not of a recorded flight"),
        ({"version": 2}, {}, "version 2"),
        ({"contract": None}, {}, "a: the contract is not a JSON object"),
        ({"contract": {}}, {}, "a: its contract names no state_frame: write"),
        ({"contract": {"state_frame": "body"}}, {}, "state_frame must be 'ned_frd' or 'enu_flu'"),
        ({}, {"expert": [STICK, (0, math.nan, 0, 0), STICK]}, "expert holds NaN .* in row 1"),
        ({}, {"state": [(900.0, *LEVEL[1:])] * 3}, "vx_mps reaches 900"),
        ({}, {"expert": [(2.0, 0, 0, 0)] * 3}, "target must be sticks"),
        ({}, {"woke_ns": [0, 20 * MS, 10 * MS]}, "runs backwards at row 2"),
        ({}, {"expert": [None] * 3}, "nobody to learn from"),
        (contract(action="velocity"), {}, "was flown by velocity: .* from sticks and body"),
        (contract(action="rates", state_frame="enu_flu"), {}, "learns body rates in ned_frd alone"),
        (contract(action="rates", hover_thrust=0.0), {}, "hover_thrust must be in .*, got 0.0"),
        (contract(action="rates"), {"expert": None}, "without an expert"),
    ],
)
def test_a_flight_that_nothing_can_be_learned_from_is_refused(
    tmp_path: Path, meta: Any, ticks: dict[str, Any], says: str
) -> None:
    folder = flight(tmp_path / "a", meta if isinstance(meta, dict) else {}, **ticks)
    if isinstance(meta, str):
        (folder / "meta.json").write_text(meta)
    with pytest.raises(DatasetError, match=says):
        read_flight(folder)


def test_flights_with_nothing_to_learn_are_left_out(tmp_path: Path) -> None:
    """One of them must not keep the others from being learned from."""
    first, idle = flight(tmp_path / "a"), flight(tmp_path / "b", expert=[None] * 3)
    copy = Path(shutil.copytree(first, tmp_path / "copy"))
    bare = tmp_path / "bare"
    write_meta(bare, source="pilot", finished=False, ticks=None)
    for name in ("ticks", "frames"):  # killed before its first rows
        (bare / f"{name}.arrows").touch()
    flights, left_out = read_flights([first, idle, copy, bare])
    assert [each.name for each in flights] == [str(first)]
    assert [text.partition(": ")[2] for text in left_out] == [
        f"{idle}: nobody to learn from: no expert, no sticks that a policy flew, and no sticks of "
        "a pilot while armed and in ALT_HOLD or ALTCTL",
        f"{copy}: a copy of {first}",
        f"{bare}: no ticks were recorded",
    ]
    with pytest.raises(DatasetError, match="nobody to learn from"):
        read_flights([idle])


@pytest.mark.parametrize(
    ("column", "values"),
    [
        *((name, ["x"] * 3) for name in ("attitude_ns", "velocity_ns", "feature_captured_ns")),
        *((name, ["x"] * 3) for name in ("chunk_computed_ns", "predict_ns")),
        *(("armed", [["yes"]] * 3), ("mode", [[1], [2, 3], []]), ("phase", [[1.0, 2.0]] * 3)),
        *(("woke_ns", [0.0, math.nan, 2.0]), ("sent_ns", [1.0, 2.0, 1e30])),
        ("gate_yaw_rad", ["x"] * 2),
    ],
)
def test_values_that_do_not_fit_a_column_are_named(
    tmp_path: Path, column: str, values: list[Any]
) -> None:
    folder, table = flight(tmp_path / "a"), "frames" if column == "gate_yaw_rad" else "ticks"
    retype(folder, column, values, table)
    with pytest.raises(DatasetError, match=f"{column} must hold "):
        read_flight(folder)


def test_empty_columns_and_those_in_another_encoding_are_read(tmp_path: Path) -> None:
    folder = flight(tmp_path / "a", solved_ns=[(5 * MS, MS)] * 3)
    retype(folder, "armed", [1, 0, 1])
    retype(folder, "mode", pa.array(["ALT_HOLD"] * 3, pa.string_view()))
    for name in ("attitude_ns", "velocity_ns", "feature_captured_ns", "predict_ns"):
        retype(folder, name, pa.nulls(3))
    retype(folder, "gate_yaw_rad", pa.nulls(2), "frames")
    assert read_flight(folder).target_ns.tolist() == [0, 20 * MS]


def retype(folder: Path, column: str, values: Any, table: str = "ticks") -> None:
    path = folder / f"{table}.parquet"
    rows = pq.read_table(path)
    others = rows.drop_columns({column} & {*rows.column_names})
    pq.write_table(others.append_column(column, [values]), path)


def test_some_flights_are_held_out_and_some_are_kept(tmp_path: Path) -> None:
    episode = read_flight(flight(tmp_path / "a"))
    kept, held = hold_out([episode] * 10, 0.2, seed=3)
    assert sorted(kept + held) == list(range(10))
    assert len(held) == 2
    assert hold_out([episode] * 10, 0.2, seed=3) == (kept, held)
    for count, fraction, held_out in ((2, 0.01, 1), (1, 0.5, 0), (3, 0.0, 0)):
        assert len(hold_out([episode] * count, fraction, seed=0)[1]) == held_out


def test_flights_of_one_course_are_held_out_together(tmp_path: Path) -> None:
    """An expert's and a student's flights of one seed share their course and conditions."""
    seen = [read_flight(flight(tmp_path / str(n), {"course_seed": n})) for n in range(10)]
    plain = [replace(each, course_seed=None) for each in seen]
    kept, held = hold_out([*seen, *seen, *plain], 0.2, seed=3)
    assert sorted(kept + held) == list(range(30))
    assert [n for n in held if n < 10] == [n - 10 for n in held if 10 <= n < 20] != []
    assert hold_out(seen, 0.2, seed=3) == hold_out(plain, 0.2, seed=3)
    assert hold_out([seen[0]] * 2, 0.5, seed=0) == ([0, 1], [])


@pytest.mark.parametrize(
    ("meta", "failure"),
    [
        ({"source": "demonstration", "success": False}, "off the course"),
        ({"source": "dagger", "success": False}, None),
        ({"source": "flight", "success": None, "finished": False}, "cut off"),
        ({"source": "flight", "success": None, "outcome": {"end": "duration"}}, None),
        ({"source": "flight", "success": None, "outcome": {"end": "fault"}}, "ended by a fault"),
        ({"source": "flight", "success": True, "outcome": {"end": "fault"}}, None),
        ({"source": "flight", "outcome": {"end": "course", "crash": "hit gate 7"}}, "crashed"),
        ({"source": "pilot", "success": None, "finished": False}, None),
        ({"source": "pilot", "success": True, "crash": "a hard landing"}, None),
        ({"source": "pilot", "success": False}, "marked as bad"),
    ],
)
def test_a_failed_flight_is_nothing_to_imitate(tmp_path, meta, failure):
    write_meta(tmp_path / "flight", **meta)
    assert failure_of(tmp_path / "flight") == failure
