"""What only a whole flight shows: ways of the sticks, gaps of the link, slow policies, limits."""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_facts import figures
from helpers.guard_flights import CONTRACT, MS, GuardFlight, climbing_first
from helpers.output_flights import HOVERING, OutputFlight
from helpers.wire import WireEnd
from mavbridge.config.flight import EnvelopeConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FloatArray
from mavbridge.flight.settings import TAU_S
from mavbridge.guard.values import Phase
from mavbridge.mavlink.transport.connection import REFUSED_NS
from mavbridge.simulation.world import NOMINAL_VEHICLE
from policy.contract import ActionKind
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import MID_RECEIVER_US, AutopilotName

SLOT_S = 0.01

# --- who has the sticks


def test_another_stations_sticks_release_ours_and_no_mode_command_ever_leaves() -> None:
    """At 10 Hz each of them is shown for a third of a send period only."""
    flight = GuardFlight().fly()
    before_ns = flight.clock.now_ns()
    flight.joystick(10, (1700, 1450, 1600, 1500))
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.5)
    given_ns = flight.clock.now_ns()
    flight.run(1.5)
    assert flight.phases(before_ns - 50 * MS) == [Phase.FLYING, Phase.RELEASING, Phase.RELEASED]
    assert flight.reason == because(
        Code.OVERRULED, quantity="sticks", output="rc-override", fault="foreign"
    )
    assert not flight.modes_asked()
    releases = flight.overrides(given_ns - MS)
    assert {us for _, us in releases} == {(0, 0, 0, 0)}, "after the takeover nothing but releases"


def climbing_then_leaning(t_s: float) -> tuple[float, float, float, float]:
    """For a takeoff of five seconds that ends in a lean."""
    return (0.7, 0.0, 0.0, 0.0) if t_s < 3 else (0.2, 0.0, 0.0, 0.5)


def test_without_a_receiver_no_takeover_leaves_a_lean_behind() -> None:
    """A release alone keeps the last sticks there: for 1 s, or for ever with FS_THR_ENABLE 0."""
    flight = GuardFlight(climbing_then_leaning, receiver_us=None, arm=True).take_off(5)
    assert flight.record()[-1]["lean_deg"] > 10
    before_ns = flight.clock.now_ns()
    flight.pilot_mode(Mode.STABILIZE)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.2)
    given_ns, given_s = flight.clock.now_ns(), flight.record()[-1]["t_s"]
    flight.run(0.9)
    assert flight.modes[-1] == "STABILIZE"
    assert not flight.modes_asked(before_ns)
    overrides = [us for _, us in flight.overrides(given_ns - MS)]
    (roll, pitch, _, yaw), *releases = overrides
    assert (roll, pitch, yaw) == (1500, 1500, 1500)
    assert len(releases) > 10
    assert set(releases) == {(0, 0, 0, 0)}
    sticks = [entry["us"] for entry in flight.record(given_s + 0.02)]
    assert sticks
    assert all(us[0] == us[1] == us[3] == 1500 for us in sticks)


def test_a_second_flight_without_a_receiver_is_held_at_its_end_as_the_first_was() -> None:
    """The end of an earlier flight's overrides is a radio failsafe while disarmed, too."""
    flight = GuardFlight(climbing_first, receiver_us=None, arm=True)
    flight.ap.rc.override((1500,) * 4, flight.ap.now_ns)
    flight.run(0.1)
    flight.ap.rc.override((0,) * 4, flight.ap.now_ns)
    flight.until(lambda: flight.ap.in_failsafe, within_s=1.1)
    flight.take_off(2.5)
    flight.stop()
    flight.run(2.0)
    assert flight.phase is Phase.HOLDING, flight.describe()
    assert flight.ap.mode is Mode.LAND
    assert not flight.ap.in_failsafe


def test_arm_reads_the_pilots_sticks_first_where_a_station_has_set_the_streams_before() -> None:
    """RC_CHANNELS that comes before the calibration shows a receiver, but not its sticks."""
    flight = GuardFlight(climbing_first, arm=True)
    end = WireEnd(system=42, component=190)
    for name in (dialect.MAVLINK_MSG_ID_RC_CHANNELS, dialect.MAVLINK_MSG_ID_SYS_STATUS):
        interval = dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, name, 500_000, 0, 0, 0, 0, 0
        asked = end.pack(end.mav.command_long_encode(1, 1, *interval))
        flight.vehicle.receive(0, asked, flight.clock.now_ns())
    flight.take_off(2.5)
    flight.act("release")
    flight.until(lambda: flight.phase is Phase.RELEASED, within_s=3)
    assert flight.ap.mode is Mode.ALT_HOLD, flight.describe()


@pytest.mark.parametrize(
    ("lost", "gap_s"),
    [("refused", 0.15), ("to the vehicle", 1.0), ("from the vehicle", 4.0)],
)
def test_a_gap_of_the_link_delays_arming_and_never_prevents_it(lost: str, gap_s: float) -> None:
    """Nothing is sent meanwhile: what the echo shows then must not keep us from trying again."""
    flight = GuardFlight(climbing_first, receiver_us=None, arm=True, mode="ALT_HOLD")
    flight.until(lambda: flight.phase is Phase.PREPARING, within_s=12)
    if lost == "refused":
        flight.network.send = lambda data, peer=None: False  # type: ignore[method-assign]
    flight.up.is_silent, flight.down.is_silent = lost == "to the vehicle", lost.startswith("from")
    flight.run(gap_s)
    if lost == "refused":
        del flight.network.send  # type: ignore[attr-defined]
    flight.up.is_silent = flight.down.is_silent = False
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=5)


def test_from_pilot_to_policy_without_a_jump_and_back_without_a_blend() -> None:
    flight = GuardFlight(lambda _: (0.0, 0.0, -0.5, -0.5))
    flight.receiver(ch1=1620, ch2=1450, ch3=1540)
    flight.launch()
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.1)
    flight.run(1)

    channels = [us for _, us in flight.overrides()]
    assert channels[0] == pytest.approx((1620, 1450, 1540, 1500), abs=12)
    jumps_us = [
        max(abs(a - b) for a, b in zip(one, other, strict=True))
        for one, other in pairwise(channels)
    ]
    assert max(jumps_us) <= 52, "8 /s at 100 Hz are 40 us, and the echo's steps are 4 or 8"
    assert channels[-1][:2] == pytest.approx((1250, 1750), abs=10)

    flight.ap.set_mode(Mode.LOITER)
    taken_s = flight.t_s
    flight.run(0.06)
    assert flight.record(taken_s)[-1]["us"] == (1620, 1450, 1540, 1500)
    between = {entry["us"][0] for entry in flight.record(taken_s)}
    assert between <= {*range(1240, 1260), 1620}, "the sticks were given back in one step"


# --- packets that do not pass


def test_a_vehicle_of_an_older_release_is_flown_once_it_listens_to_us() -> None:
    vehicle = replace(NOMINAL_VEHICLE, ardupilot_release="4.6")
    flight = GuardFlight(climbing_first, arm=True, vehicle=vehicle, params={"MAV_GCS_SYSID": 42.0})
    flight.until(lambda: Code.OBSTACLE in flight.codes, within_s=12)
    assert flight.phase is not Phase.FLYING
    assert "--set-config link.source_system=42" in str(flight.reason)

    station = WireEnd(system=42, component=190)
    mended = station.pack(station.mav.param_set_encode(1, 1, b"SYSID_MYGCS", 255.0, 9))
    flight.vehicle.receive(0, mended, flight.clock.now_ns())  # on our link: we hear the answer
    flight.take_off()
    assert flight.phase is Phase.FLYING
    assert "4.6.3" in flight.link.autopilot


def refuse(flight: GuardFlight, *, is_refused: bool = True) -> None:
    network = flight.network
    if is_refused:
        network.send = lambda data, peer=None: False  # type: ignore[method-assign]
    else:
        del network.send  # type: ignore[attr-defined]


def test_nothing_flies_before_the_message_that_shows_our_setpoints_is_granted() -> None:
    """Else the first flight ended after a second for want of it, as the requests were lost."""
    flight = OutputFlight("ardupilot", "velocity", HOVERING)
    end, send, lost = WireEnd(), flight.up.send, []

    def lose_three(data: bytes) -> None:
        wanted = dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED
        asked = [m for m in end.read(data) if getattr(m, "param1", None) == wanted]
        lost.extend(asked)
        if not asked or len(lost) > 3:
            send(data)

    flight.up.send = lose_three  # type: ignore[method-assign]
    flight.fly(2.0)


@pytest.mark.parametrize(("autopilot", "kind"), [("ardupilot", "sticks"), ("px4", "rates")])
def test_in_flight_refused_packets_are_a_fault_of_the_link_after_100_ms(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    refuse(flight)
    took_s = flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.5)
    assert took_s <= REFUSED_NS / 1e9 + 2 * SLOT_S
    assert flight.phase is Phase.LEAVING
    assert flight.guard.guard.engagement.outcome.faults == 1


@pytest.mark.parametrize(("gap_s", "flown_s"), [(0.07, 0.0), (0.06, 1.0)])
def test_the_sticks_go_on_from_where_the_vehicles_are(gap_s: float, flown_s: float) -> None:
    """From the receiver's if it cannot send from the act on, or from our last ones."""
    wanted = [(0.0, 0.1, 0.2, 0.3)]
    flight = GuardFlight(lambda _: wanted[0]).launch()
    if not flown_s:
        refuse(flight)
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.1)
    flight.run(flown_s)
    refuse(flight)
    wanted[0] = (0.0, -0.8, -0.8, -0.8)
    before = [tick.sent for tick in flight.ticks if tick.sent is not None]
    flight.run(gap_s)
    refuse(flight, is_refused=False)
    resumed_ns = flight.clock.now_ns()
    flight.run(0.03)
    assert flight.phase is Phase.FLYING
    first = flight.sticks_sent(resumed_ns)[0][1]
    held = before[-1] if before else (0.0, 0.0, 0.0, 0.0)
    assert first == pytest.approx(held, abs=0.03)
    flight.run(0.5)
    assert flight.last is not None
    assert flight.last.sent is not None
    assert flight.last.sent.roll == pytest.approx(-0.8, abs=0.02)


@pytest.mark.parametrize(
    ("autopilot", "kind", "share"),
    [
        ("ardupilot", "velocity", 0.5),
        ("px4", "rates", 0.25),
    ],
)
def test_sticks_that_wait_in_a_full_queue_end_the_flight(
    autopilot: AutopilotName, kind: ActionKind, share: float
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    sent = [data for _, data in flight.up.sent]
    at_ns = flight.clock.now_ns()
    flight.run(1.0)
    needed = sum(len(data) for _, data in flight.up.sent[len(sent) :])
    flight.up.bytes_per_s = share * needed * 1e9 / (flight.clock.now_ns() - at_ns)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=4.0)


def test_a_release_that_cannot_be_sent_goes_out_first_when_the_connection_is_back() -> None:
    flight = GuardFlight(on_fault="release").fly()
    flight.network.is_down = True
    flight.stop()
    flight.run(1.5)
    flight.network.is_down = False
    back_ns = flight.clock.now_ns()
    flight.until(lambda: flight.guard.is_done, within_s=4)
    flight.run(0.05)

    first = flight.left(back_ns)[0][1]
    assert first.get_type() == "RC_CHANNELS_OVERRIDE"
    assert first.chan1_raw == 0
    assert flight.record()[-1]["us"] == MID_RECEIVER_US[:4]


# --- the policy


class PlayedFlight(GuardFlight):
    """A policy that plans its whole horizon: each action is that of its own time."""

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._policy_clock.ahead_ns += self.solve_ns
        start_s = self.clock.now_ns() / NS_PER_S
        plan = [self.policy(start_s + 0.05 * step) for step in range(self._horizon)]
        return np.array([plan], np.float32)


def flown_ticks(flight: GuardFlight) -> list[Any]:
    return [t for t in flight.sink.ticks if t.trace is not None and t.state is not None]


def test_a_slow_policy_flies_its_plan_at_the_stick_rate() -> None:
    """It makes a chunk a second, in 150 ms, and plays it for two seconds."""
    contract = replace(CONTRACT, play_s=2.0, horizon=64)
    flight = PlayedFlight(weaving, contract=contract, on_fault="release")
    flight.solve_ns = 150 * MS
    flight.launch()
    flight.run(2.5)
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=2.0)
    flight.run(6)

    assert flight.phase is Phase.FLYING, flight.describe()
    ticks = flown_ticks(flight)
    assert len({t.chunk_serial for t in ticks}) == pytest.approx(6, abs=2)
    assert max(b.sent_ns - a.sent_ns for a, b in pairwise(ticks)) < 16 * MS
    assert not any(t.is_coasting for t in ticks)
    ages_s = [(t.sent_ns - t.state.attitude_ns) / NS_PER_S for t in ticks]
    assert max(ages_s) < 1.2
    for tick in ticks:
        wanted = weaving(tick.sent_ns / NS_PER_S + TAU_S["sticks"])
        assert tick.trace.raw == pytest.approx(wanted, abs=0.05)


def weaving(t_s: float) -> tuple[float, float, float, float]:
    """Never at rest, so that its state never stands still."""
    return (0.0, 0.0, 0.0, 0.3 * math.sin(6.0 * t_s))


@pytest.mark.parametrize(("quantity", "limit"), [("tilt", 10), ("speed", 3)])
def test_leaving_the_envelope_ends_the_flight(quantity: str, limit: float) -> None:
    envelope = EnvelopeConfig(**{f"max_{quantity}": limit})  # type: ignore[arg-type]
    flight = GuardFlight(lambda _: (0.0, 0.0, 0.9, 0.0), envelope=envelope, on_fault="hold")
    flight.launch()
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.LEAVING, within_s=8)
    found = figures(flight.reason, Code.BEYOND)
    assert (found["quantity"], found["limit"]) == (quantity, limit)
    assert limit < float(str(found["value"])) < 2 * limit
    flight.run(2)
    assert flight.ap.mode is Mode.BRAKE
