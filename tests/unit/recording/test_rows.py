from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.factories import make_state, make_tick, make_trace
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import AttitudeThrust, BodyRates, Sticks
from mavbridge.recording.rows import (
    DEMONSTRATION_FRAMES,
    DEMONSTRATION_TICKS,
    FrameRow,
    FrameTruth,
    TickRow,
    frame_columns,
    read_frame_rows,
    read_ticks,
    tick_columns,
)

floats = st.floats(-1e3, 1e3, width=32)
sticks = st.builds(Sticks, *(st.floats(-1, 1, width=32),) * 4)
stamps = st.integers(0, 2**62)
vectors = st.tuples(floats, floats, floats)


simple = st.sampled_from([because(Code.NO_CHUNK), because(Code.OVERRIDE_SWITCH_OFF)])
reasons = (
    simple
    | st.builds(because, st.just(Code.RISK), risk=st.text(), why=simple)
    | st.builds(because, st.just(Code.NO_CHUNK_SINCE_RESET), why=simple)
)


states = st.builds(
    lambda at_ns, values: make_state(at_ns, values=np.array(values, np.float32)),
    stamps,
    st.lists(floats, min_size=13, max_size=13),
)
numbers = st.integers(0, 10**6)
ticks = st.builds(
    make_tick,
    numbers,
    is_slot=st.booleans(),
    is_coasting=st.booleans(),
    chunk_serial=st.none() | numbers,
    chunk_computed_ns=st.none() | stamps,
    predict_ns=st.none() | stamps,
    feature_frame_id=st.none() | numbers,
    feature_captured_ns=st.none() | stamps,
    state=st.none() | states,
    trace=st.none() | st.builds(make_trace, sticks),
    sent=st.none() | sticks,
    rc_sticks=st.none() | sticks,
    release_reason=st.none() | reasons,
    mode=st.none() | st.text(),
    armed=st.booleans(),
    rc_channels_us=st.lists(st.integers(0, 65535), max_size=18).map(tuple),
    texts=st.lists(st.text(), max_size=3).map(tuple),
)
tick_rows = st.builds(TickRow, ticks, st.integers(0, 9), st.none() | sticks)
truths = st.builds(
    FrameTruth,
    position_ned_m=vectors,
    ned_from_body_wxyz=st.tuples(floats, floats, floats, floats),
    velocity_ned_mps=vectors,
    next_gate=st.none() | st.integers(0, 30),
    gate_body_m=st.none() | vectors,
    gate_yaw_rad=st.none() | floats,
    gate_after_body_m=st.none() | vectors,
)
frame_rows = st.builds(
    FrameRow,
    frame_id=stamps,
    captured_ns=stamps,
    ready_ns=stamps,
    dropped_before=st.integers(0, 9),
    truth=st.none() | truths,
)


def same_state(one: VehicleState | None, other: VehicleState | None) -> bool:
    if one is None or other is None:
        return one is other
    values = np.array_equal(one.values, other.values)
    return values and replace(one, values=None) == replace(other, values=None)


@settings(max_examples=30)
@given(st.lists(tick_rows, max_size=8))
def test_ticks_come_back_as_they_were(rows: list[TickRow]) -> None:
    table = pa.Table.from_pylist([*map(tick_columns, rows)], DEMONSTRATION_TICKS)
    back = list(read_ticks(table))
    assert len(back) == len(rows)
    serial = -1
    readonly = all(row.tick.sent is None for row in rows)
    for before, after in zip(rows, back, strict=True):
        serial += 1 + before.dropped_before
        assert same_state(before.tick.state, after.tick.state)
        expected = replace(before.tick, serial=serial, state=None, readonly=readonly)
        assert replace(after.tick, state=None) == expected
        assert after.dropped_before == before.dropped_before
        assert after.expert == before.expert


@given(st.lists(frame_rows, max_size=8))
def test_frames_come_back_as_they_were(rows: list[FrameRow]) -> None:
    table = pa.Table.from_pylist([*map(frame_columns, rows)], DEMONSTRATION_FRAMES)
    assert list(read_frame_rows(table)) == rows


def test_the_columns_are_those_of_the_document() -> None:
    text = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
    tables = (DEMONSTRATION_TICKS, DEMONSTRATION_FRAMES)
    names = {name for table in tables for name in table.names}
    assert [name for name in names if name not in text] == []


def test_an_attitude_sent_for_body_rates_comes_back_as_one() -> None:
    """It prepares or levels the vehicle; the history of a replay must not take it for rates."""
    flown = BodyRates(0.5, 0.25, -0.5, 1.0)
    sent = [AttitudeThrust(0.0, 0.0, 0.0, 0.0), flown, AttitudeThrust(0.5, 0.0, 0.0, 0.0), None]
    traces = [None, make_trace(flown), None, None]
    rows = [
        tick_columns(TickRow(make_tick(number, sent=action, trace=trace), 0))
        for number, (action, trace) in enumerate(zip(sent, traces, strict=True))
    ]
    table = pa.Table.from_pylist(rows, DEMONSTRATION_TICKS)
    back = [row.tick.sent for row in read_ticks(table, "rates")]
    assert (back, [*map(type, back)]) == (sent, [*map(type, sent)])
