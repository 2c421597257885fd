"""Flights are written to a file and read back with Rerun's own reader."""

import math
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from helpers.factories import make_released_tick, make_tick, make_trace, make_vision_tick
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.records import Event
from mavbridge.core.vehicle import ActionKind, ActionTrace, Sticks
from mavbridge.observe.rerun_flight import (
    MAX_IMAGE_WIDTH,
    PLOTS,
    RerunView,
    action_plots,
    flight_blueprint,
)


class Recording:
    """What a .rrd file holds, by entity."""

    def __init__(self, path: Path) -> None:
        self.reader = RrdReader(path)
        self.columns: dict[str, dict[str, list[Any]]] = {}
        self.static: dict[str, dict[str, list[Any]]] = {}
        for chunk in self.reader.stream():
            batch = chunk.to_record_batch()
            kept = self.static if chunk.is_static else self.columns
            entity = kept.setdefault(chunk.entity_path, {})
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                values = column.cast("int64").to_pylist() if name == "time" else column.to_pylist()
                entity.setdefault(name, []).extend(values)

    def values(self, path: str, series: int = 0) -> list[float]:
        return [row[series] for row in self.columns[f"/{path}"]["Scalars:scalars"]]

    def times_ms(self, path: str) -> list[float]:
        return [stamp_ns / NS_PER_MS for stamp_ns in self.columns[f"/{path}"]["time"]]

    def events(self) -> list[str]:
        return [row[0] for row in self.columns["/events"]["TextLog:text"]]


def show(path: Path, *batches: list[Event]) -> Recording:
    view = RerunView(str(path), vision_hz=30)
    for batch in batches:
        view.consume(batch)
    view.close()
    return Recording(path)


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    return tmp_path / "flight.rrd"


def test_ages_and_durations_are_milliseconds_on_both_timelines(rrd: Path) -> None:
    seen = show(rrd, [make_tick(0), make_tick(1)], [make_tick(2)])
    assert seen.times_ms("age") == [0.0, 10.0, 20.0]
    assert seen.columns["/age"]["tick"] == [0, 1, 2]
    assert seen.values("age", 0) == [40.0] * 3
    assert seen.values("age", 1) == [3.0] * 3
    assert seen.values("compute/action") == [2.0] * 3


def test_what_was_not_measured_is_a_gap_never_a_zero(rrd: Path) -> None:
    blind = make_released_tick(
        0, feature_captured_ns=None, state=None, rc_channels_us=(), rc_sticks=None
    )
    seen = show(rrd, [blind])
    for path, series in (("age", 0), ("age", 1), ("compute/action", 0), ("period/action", 0)):
        assert math.isnan(seen.values(path, series)[0]), path
    for axis in Sticks._fields:
        assert all(math.isnan(seen.values(f"sticks/{axis}", series)[0]) for series in range(6))
    assert all(math.isnan(seen.values("rc", channel)[0]) for channel in range(4))


def test_periods_go_on_across_batches_and_only_slots_are_late(rrd: Path) -> None:
    between = make_tick(5, is_slot=False)
    seen = show(rrd, [make_tick(0), make_tick(1)], [make_tick(4, missed_slots=2)], [between])
    assert math.isnan(seen.values("period/action")[0])
    assert seen.values("period/action")[1:] == [10.0, 30.0, 10.0]
    assert seen.values("lateness/sticks")[:3] == [2.0, 2.0, 2.0]
    assert math.isnan(seen.values("lateness/sticks")[3])
    assert seen.values("missed/action") == [0, 0, 2, 2]


def test_dropped_frames_start_from_zero(rrd: Path) -> None:
    first = make_vision_tick(1, dropped_frames=40)
    second, third = (make_vision_tick(k, dropped_frames=40 + k) for k in (2, 3))
    seen = show(rrd, [make_tick(0), first, second], [third])
    assert seen.values("missed/vision") == [0, 2, 3]


def test_every_stage_of_every_stick_has_its_series(rrd: Path) -> None:
    stages = [
        Sticks(throttle=k + 0.125, yaw=k + 0.25, pitch=k + 0.5, roll=k + 0.75) for k in range(6)
    ]
    echo, raw, clipped, slewed, smoothed, sent = stages
    trace = ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)
    seen = show(rrd, [make_tick(0, trace=trace, sent=sent, rc_sticks=echo)])
    for axis, name in enumerate(Sticks._fields):
        shown = [seen.values(f"sticks/{name}", series)[0] for series in range(6)]
        assert shown == [stage[axis] for stage in stages]
    names = seen.static["/sticks/roll"]["SeriesLines:names"][0]
    assert names == ["vehicle's echo", "raw", "clipped", "slewed", "smoothed", "sent"]


def test_centred_sticks_are_zeros_not_gaps(rrd: Path) -> None:
    centred = Sticks(0.0, 0.0, 0.0, 0.0)
    seen = show(rrd, [make_tick(0, trace=make_trace(centred), sent=centred, rc_sticks=centred)])
    assert [seen.values("sticks/yaw", series)[0] for series in range(6)] == [0.0] * 6


def test_rc_echo_shows_four_channels(rrd: Path) -> None:
    seen = show(rrd, [make_tick(0, rc_channels_us=(1100, 1200, 1300, 1400, 1500, 1600))])
    assert seen.columns["/rc"]["Scalars:scalars"] == [[1100, 1200, 1300, 1400]]


def test_events_are_transitions_across_batches(rrd: Path) -> None:
    seen = show(
        rrd,
        [make_released_tick(0, "no feature yet", armed=False), make_released_tick(1, armed=False)],
        [make_tick(2), make_tick(3)],
        [make_released_tick(4, "feature too old", mode="LAND")],
    )
    assert [text.split(maxsplit=2)[2] for text in seen.events()] == [
        "RELEASED: no feature yet",
        "mode ALT_HOLD",
        "disarmed",
        "FLYING: the policy has control",
        "armed",
        "RELEASED: feature too old",
        "mode LAND",
    ]
    assert seen.columns["/events"]["tick"] == [0, 0, 0, 2, 2, 4, 4]


def test_an_uneventful_batch_logs_no_event(rrd: Path) -> None:
    seen = show(rrd, [make_tick(0)], [make_tick(1), make_tick(2)])
    assert set(seen.columns["/events"]["tick"]) == {0}


def test_images_are_stamped_with_their_exposure_and_keep_their_colours(rrd: Path) -> None:
    rgb = np.zeros((48, 64, 3), dtype=np.uint8)
    rgb[:, :, 0] = 200  # red
    frames = [make_vision_tick(number, rgb=rgb) for number in (1, 2, 3)]
    seen = show(rrd, [make_tick(0), *frames])
    assert seen.times_ms("camera") == pytest.approx([0, 33.333, 66.667], abs=0.001)
    assert seen.times_ms("compute/vision") == pytest.approx([22, 55.333, 88.667], abs=0.001)
    assert seen.values("compute/vision") == [20.0] * 3
    encoded = np.array(seen.columns["/camera"]["EncodedImage:blob"][0][0], dtype=np.uint8)
    bgr = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert bgr is not None
    assert bgr.shape == (48, 64, 3)
    assert bgr[24, 32] == pytest.approx([0, 0, 200], abs=6)


def test_large_images_are_scaled_down_in_proportion(rrd: Path) -> None:
    frame = make_vision_tick(1, rgb=np.zeros((720, 1280, 3), dtype=np.uint8))
    seen = show(rrd, [frame])
    encoded = np.array(seen.columns["/camera"]["EncodedImage:blob"][0][0], dtype=np.uint8)
    bgr = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert bgr is not None
    assert bgr.shape == (360, MAX_IMAGE_WIDTH, 3)


def test_frames_carry_the_index_of_the_tick_that_was_running(rrd: Path) -> None:
    frames = [make_vision_tick(1), make_vision_tick(2)]  # ready 22 and 55 ms after tick 0 woke
    seen = show(rrd, [*(make_tick(index) for index in range(6)), *frames])
    assert seen.columns["/compute/vision"]["tick"] == [2, 5]


def test_frames_before_the_first_tick_are_shown(rrd: Path) -> None:
    seen = show(rrd, [make_vision_tick(1)], [make_tick(0)])
    assert seen.columns["/camera"]["tick"] == [0]
    assert seen.times_ms("camera") == [0.0]


def test_every_plot_names_and_colours_its_series(rrd: Path) -> None:
    seen = show(rrd, [make_tick(0)])
    for plot in (*PLOTS, *action_plots("sticks")):
        style = seen.static[f"/{plot.path}"]
        assert len(style["SeriesLines:names"][0]) == len(plot.series)
        assert len(style["SeriesLines:colors"][0]) == len(plot.series)


def test_the_file_opens_on_the_blueprint_and_no_recording_is_global(rrd: Path) -> None:
    seen = show(rrd, [make_tick(0)])
    assert len(seen.reader.blueprints()) == 1
    assert len(seen.reader.recordings()) == 1
    assert rr.get_global_data_recording() is None


@pytest.mark.parametrize("action", get_args(ActionKind))
def test_every_plot_is_in_the_blueprint(action: ActionKind) -> None:
    shown = {
        str(expression).strip("/")
        for column in flight_blueprint(action).root_container.contents
        for view in column.contents
        for expression in (view.contents if isinstance(view.contents, list) else [])
    }
    assert shown == {plot.path for plot in (*PLOTS, *action_plots(action))}


def test_an_unwritable_path_is_refused_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(UserError, match="cannot write --rerun"):
        RerunView(str(tmp_path / "taken" / "f.rrd"), vision_hz=30)


def test_two_flights_in_one_process_do_not_mix(tmp_path: Path) -> None:
    first = show(tmp_path / "a.rrd", [make_tick(0)])
    second = show(tmp_path / "b.rrd", [make_tick(5)], [make_tick(6)])
    assert first.columns["/age"]["tick"] == [0]
    assert second.columns["/age"]["tick"] == [5, 6]
    assert second.times_ms("age") == [0.0, 10.0]


FLIES_INTO_A_STALLED_VIEWER = """
import sys
from helpers.factories import make_tick, make_vision_tick
from mavbridge.core.observers import ObserverThread
from mavbridge.observe.rerun_flight import RerunView

view = RerunView(sys.argv[1], vision_hz=30)
observer = ObserverThread("viewer", view, capacity=100)
observer.emit(make_tick())
observer.emit(make_vision_tick())
observer.close(0.2)
print(observer.failure)
"""


def test_a_viewer_that_stalls_cannot_keep_the_process_alive() -> None:
    with socket.create_server(("127.0.0.1", 0)) as never_answers:
        url = f"rerun+http://127.0.0.1:{never_answers.getsockname()[1]}/proxy"
        flight = subprocess.run(
            [sys.executable, "-c", FLIES_INTO_A_STALLED_VIEWER, f"connect={url}"],
            env={"PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            timeout=60,  # far beyond what it takes; the SDK's own exit hook would wait for ever
            check=True,
        )
    assert flight.stdout == "did not finish within 0.2 s\n"


def test_a_flight_without_an_event_is_still_a_readable_file(rrd: Path) -> None:
    seen = show(rrd)
    assert set(seen.columns) == set()
    assert len(seen.reader.blueprints()) == 1
