"""Camera, encoder, policy and guard together on virtual time; see helpers.virtual_flights."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.fakes import START_NS
from helpers.virtual_flights import HOP_NS, MS, SHARP, VirtualFlight
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Frame
from mavbridge.core.vehicle import Sticks
from mavbridge.guard.values import Phase
from policy.contract import Contract

PERIOD_NS = 10 * MS
GRID_NS = START_NS + HOP_NS
"""First slot: when the guard has got its settings."""
CONTRACT = Contract(feature_dim=8, arrays="numpy")


# --- rates and ages


def test_thirty_hertz_vision_feeds_a_hundred_chunks_a_second() -> None:
    flight = VirtualFlight().fly(10.0)
    assert 299 <= len(flight.sink.visions) <= 301
    assert sum(tick.missed_slots for tick in flight.sink.ticks) == 0
    assert [tick.serial for tick in flight.sink.ticks] == list(range(len(flight.sink.ticks)))
    flown = flight.flown
    serials = [tick.chunk_serial or 0 for tick in flown]
    assert serials == list(range(serials[0], serials[-1] + 1))
    # The first feature is ready after 25 ms, three chunks in time must have come, and then the
    # first one after the reset.
    assert serials[0] == 4
    assert len(flown) == pytest.approx(1000 - 4 - 2, abs=1)
    uses = [sum(t.feature_frame_id == k for t in flown) for k in range(10, 200)]
    assert set(uses) == {3, 4}


def test_ages_at_the_send_are_those_of_the_newest_inputs() -> None:
    flown = VirtualFlight().fly(2.0).flown
    for tick in flown:
        assert tick.state is not None
        # 2 ms on its way to us, two hops, 3 ms of inference
        assert tick.sent_ns - tick.state.attitude_ns == 5 * MS + 2 * HOP_NS
        assert tick.chunk_computed_ns == tick.sent_ns - HOP_NS
        assert tick.predict_ns == 3 * MS
    ages_ms = [(t.sent_ns - t.feature_captured_ns) / MS for t in flown if t.feature_captured_ns]
    assert len(ages_ms) == len(flown)
    assert min(ages_ms) >= 25 + 3
    assert max(ages_ms) <= 25 + 33.4 + 10 + 3.2


@pytest.mark.parametrize(
    ("phase_ms", "sends_a_period"),
    [
        (0, 2),  # the chunk comes 3.1 ms after a slot, 6.9 ms before the next one
        (3, 1),  # 3.9 ms before a slot, which is left out
        (6.8, 1),
    ],
)
def test_a_new_chunk_is_sent_at_once_and_does_not_move_the_grid(
    phase_ms: float, sends_a_period: int
) -> None:
    flight = VirtualFlight(state_phase_ns=round(phase_ms * MS)).fly(2.0)
    flown = [tick for tick in flight.flown if tick.sent_ns >= START_NS + NS_PER_S]
    assert len(flown) == pytest.approx(100 * sends_a_period, abs=1)
    assert sum(tick.missed_slots for tick in flight.sink.ticks) == 0
    slots = [tick for tick in flight.sink.ticks if tick.is_slot]
    assert {(tick.due_ns - GRID_NS) % PERIOD_NS for tick in slots} == {0}
    first = {tick.chunk_serial: tick for tick in reversed(flown)}
    whole = [t for t in first.values() if t.chunk_serial != flown[0].chunk_serial]
    assert {t.sent_ns - (t.chunk_computed_ns or 0) for t in whole} == {HOP_NS}
    gaps_ns = np.diff([tick.sent_ns for tick in flown])
    assert gaps_ns.min() < PERIOD_NS // 2 or sends_a_period == 1
    assert gaps_ns.max() <= PERIOD_NS


@pytest.mark.parametrize("stick_hz", [50, 100, 250, 400])
@pytest.mark.parametrize("action_hz", [5.0, 30.0, 100.0])
def test_the_sticks_keep_their_rate_whatever_the_rate_of_the_policy(
    stick_hz: float, action_hz: float
) -> None:
    rates = Rates(stick_rate=stick_hz, action_rate=action_hz)
    contract = Contract(feature_dim=8, arrays="numpy", play_s=0.2)
    flown = VirtualFlight(contract=contract, rates=rates).fly(2.0).flown
    gaps_ns = np.diff([tick.sent_ns for tick in flown])
    assert gaps_ns.max() <= 1.5 * NS_PER_S / stick_hz
    assert sum(tick.missed_slots for tick in flown) == 0
    solves = len({tick.chunk_serial for tick in flown})
    assert solves == pytest.approx(action_hz * (flown[-1].sent_ns - flown[0].sent_ns) / 1e9, abs=2)


@pytest.mark.parametrize("attitude_hz", [100, 125, 200, 400])
def test_faster_attitudes_do_not_make_more_solves_than_asked_for(attitude_hz: int) -> None:
    flight = VirtualFlight(state_period_ns=NS_PER_S // attitude_hz).fly(2.0)
    assert len(flight.histories) == pytest.approx(200, abs=7)


def test_a_late_solve_costs_freshness_and_not_a_stick() -> None:
    flight = VirtualFlight(act_ns=lambda solve: 53 * MS if solve == 100 else 3 * MS).fly(3.0)
    assert flight.phase is Phase.FLYING
    assert sum(tick.missed_slots for tick in flight.sink.ticks) == 0
    assert np.diff([tick.sent_ns for tick in flight.flown]).max() <= 1.5 * PERIOD_NS
    (late,) = {t.chunk_serial for t in flight.flown if t.is_coasting}
    same = [tick for tick in flight.flown if tick.chunk_serial == late]
    assert late == 100
    assert len(same) == 6
    assert [t.is_coasting for t in same] == [t.sent_ns - same[0].sent_ns > 20 * MS for t in same]
    ages_ms = [(t.sent_ns - t.state.attitude_ns) / MS for t in flight.flown if t.state is not None]
    assert 50 < max(ages_ms) <= 5.2 + 50 + 10


def test_a_coasting_chunk_is_flown_on_along_its_own_plan() -> None:
    ramp = np.arange(16, dtype=np.float32)[None, :, None].repeat(4, axis=2) * 0.05
    flight = VirtualFlight(
        act_ns=lambda solve: 53 * MS if solve == 50 else 3 * MS, chunk=lambda solve: ramp
    ).fly(1.0)
    for tick in flight.flown:
        assert tick.state is not None
        assert tick.trace is not None
        age_s = (tick.sent_ns - tick.state.attitude_ns) / NS_PER_S
        assert tick.trace.raw.roll == pytest.approx(age_s, abs=1e-6)


def test_a_chunk_is_sampled_where_the_low_pass_will_bring_it() -> None:
    ramp = np.arange(16, dtype=np.float32)[None, :, None].repeat(4, axis=2) * 0.05
    tick = (
        VirtualFlight(limits=replace(SHARP, tau=0.05), chunk=lambda solve: ramp).fly(0.2).flown[-1]
    )
    # attitude 5.2 ms old, 50 ms of lead on a ramp of 1/s
    assert tick.trace is not None
    assert tick.trace.raw.roll == pytest.approx(0.0552, abs=1e-6)


def test_a_frame_from_the_future_is_as_fresh_as_now_and_no_fresher() -> None:
    flight = VirtualFlight()

    def ahead(frame: Frame) -> Frame:
        if frame.frame_id != 30:
            return frame
        return replace(frame, captured_ns=frame.captured_ns + 5 * NS_PER_S)

    flight.camera.change = ahead
    flight.fly(3.0)
    assert [v.frame_id for v in flight.sink.visions[28:33]] == [29, 30, 31, 32, 33]
    flown = flight.flown
    ages_ns = [t.sent_ns - t.feature_captured_ns for t in flown if t.feature_captured_ns]
    assert min(ages_ns) > 0


# --- what the policy is told


def test_history_is_what_was_sent_not_what_was_wished() -> None:
    flight = VirtualFlight()
    rounded, send = Sticks(0.2, 0.2, 0.2, 0.2), flight.link.send
    flight.link.send = lambda one, at_ns: rounded if send(one, at_ns) else None  # type: ignore[method-assign]
    flight.fly(1.0)
    assert flight.histories[0] == pytest.approx(0.0)  # nothing was sent before the first action
    assert flight.histories[-1] == pytest.approx(0.2)
    assert flight.flown[-1].sent == rounded
    assert flight.flown[-1].trace is not None
    assert flight.flown[-1].trace.smoothed.roll == pytest.approx(0.25)


def test_history_is_neutral_again_after_the_sticks_were_given_back() -> None:
    flight = VirtualFlight()
    flight.at(0.5, lambda: flight.link.change(mode="LOITER")).fly(1.0)
    assert max(history.max() for history in flight.histories) == pytest.approx(0.25)
    assert flight.histories[-1] == pytest.approx(0.0)


def test_a_policy_that_asks_is_told_the_age_of_its_image_and_the_motion_since() -> None:
    flight = VirtualFlight(contract=replace(CONTRACT, since_exposure=True))

    def measure() -> None:
        """Turns right at 1 rad/s and accelerates downwards at 2 m/s^2."""
        flown_s = (flight.world.now_ns() - START_NS) / NS_PER_S
        flight.link.measure(yaw_rad=flown_s, down_mps=2 * flown_s)

    flight.measure = measure
    flight.fly(1.0)
    assert len(flight.flown) > 90
    for tick in flight.flown:
        assert tick.state is not None
        assert tick.chunk_serial is not None
        assert tick.feature_captured_ns is not None
        state = flight.states[tick.chunk_serial - 1]
        age_s = (tick.state.attitude_ns - tick.feature_captured_ns) / NS_PER_S
        assert 0.02 < age_s < 0.07
        assert state.shape == (1, 20)
        np.testing.assert_array_equal(state[0, :13], tick.state.values)
        known_s = (tick.state.attitude_ns - START_NS) / NS_PER_S - 0.003
        if age_s <= known_s:
            told = [age_s, 0, 0, age_s, 0, 0, 2 * age_s]
            assert state[0, 13:].tolist() == pytest.approx(told, abs=1e-5)


def test_a_policy_that_does_not_ask_sees_thirteen_numbers() -> None:
    assert {state.shape for state in VirtualFlight().fly(0.2).states} == {(1, 13)}


# --- the camera's rate


def test_a_faster_camera_is_thinned_to_the_visual_rate() -> None:
    wobble = [0, 3, -3, 2, -2]
    frames = [START_NS + 5 * MS + k * NS_PER_S // 60 + wobble[k % 5] * MS for k in range(600)]
    flight = VirtualFlight(frames_ns=frames, encode_ns=5 * MS).fly(9.0)
    assert 268 <= len(flight.sink.visions) <= 272
    assert flight.camera.dropped_frames == 0  # passed over is not dropped


def test_an_encoder_too_slow_for_the_camera_takes_the_newest_frame() -> None:
    flight = VirtualFlight(encode_ns=100 * MS).fly(9.0)
    visions = flight.sink.visions
    assert 88 <= len(visions) <= 91
    assert visions[-1].dropped_frames == pytest.approx(2 * len(visions), abs=8)
    waits_ms = [(v.started_ns - v.captured_ns) / MS for v in visions]
    assert max(waits_ms) <= 33.4
