"""The link in flight: identity, parameters, and packets that do not pass, on the vehicle."""

from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_facts import codes
from helpers.guard_flights import GuardFlight, climbing_first, hovering
from helpers.output_flights import HOVERING, OutputFlight
from helpers.wire import WireEnd
from mavbridge.core.reasons import Code
from mavbridge.guard.values import Phase
from mavbridge.mavlink.transport.connection import REFUSED_NS
from mavbridge.simulation.world import NOMINAL_VEHICLE
from policy.contract import ActionKind
from sitl.vehicle.config import (
    MID_RECEIVER_US,
    ArduPilotRelease,
    AutopilotName,
)

ELSEWHERE = ("sitl", 2)
SLOT_S = 0.01
EACH = pytest.mark.parametrize(
    ("autopilot", "kind"),
    [("ardupilot", "sticks"), ("ardupilot", "velocity"), ("px4", "sticks"), ("px4", "rates")],
)


def test_a_vehicle_that_moves_in_flight_is_latched_until_the_next_act() -> None:
    flight = GuardFlight(on_fault="release").fly()
    flight.network.address = ELSEWHERE
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=1)
    flight.run(6)
    assert flight.phase is Phase.RELEASED
    assert not flight.modes_asked()

    flight.run(3)
    assert flight.phase is Phase.RELEASED, "the same packets come again, from elsewhere"
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.2)


def test_a_second_way_to_the_vehicle_is_not_followed_where_the_first_one_pauses() -> None:
    flight = GuardFlight(policy=hovering).fly()
    flight.inject(WireEnd(system=1).heartbeat(mode=2, armed=True), ELSEWHERE)
    flight.run(0.5)
    flight.network.address = ELSEWHERE
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=1)
    flight.run(1)
    assert not any(Code.MOVED in codes(tick.reason) for tick in flight.ticks)


def test_a_parameter_is_set_for_the_flight_and_put_back_before_the_guard_ends() -> None:
    flight = GuardFlight(
        climbing_first,
        receiver_us=None,
        params={"RC_OVERRIDE_TIME": -1.0},
        link={"set": ("RC_OVERRIDE_TIME=0.5",)},
        arm=True,
    ).take_off()
    assert flight.vehicle.params["RC_OVERRIDE_TIME"] == 0.5
    flight.stop()
    flight.until(lambda: flight.guard.is_done, within_s=25)

    assert flight.vehicle.params["RC_OVERRIDE_TIME"] == -1.0
    assert any("RC_OVERRIDE_TIME" in text and "0.5" in text for text in flight.messages)


@pytest.mark.parametrize("release", ["4.6", "4.7-dev", "4.7"])
def test_a_vehicle_of_any_release_is_flown_once_it_listens_to_us(
    release: ArduPilotRelease,
) -> None:
    vehicle = replace(NOMINAL_VEHICLE, ardupilot_release=release)
    flight = GuardFlight(climbing_first, arm=True, vehicle=vehicle, params={"MAV_GCS_SYSID": 42.0})
    flight.run(12)
    assert flight.phase is not Phase.FLYING
    assert Code.OBSTACLE in flight.codes
    assert "--set-config link.source_system=42" in str(flight.reason)

    name = b"SYSID_MYGCS" if release == "4.6" else b"MAV_GCS_SYSID"
    station = WireEnd(system=42, component=190)
    mended = station.pack(station.mav.param_set_encode(1, 1, name, 255.0, 9))
    flight.vehicle.receive(0, mended, flight.clock.now_ns())  # on our link: we hear the answer
    flight.take_off()
    assert flight.phase is Phase.FLYING
    assert ("4.6.3" if release == "4.6" else "4.7.0") in flight.link.autopilot


# --- packets that do not pass


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


def refuse(flight: GuardFlight, *, is_refused: bool = True) -> None:
    network = flight.network
    if is_refused:
        network.send = lambda data, peer=None: False  # type: ignore[method-assign]
    else:
        del network.send  # type: ignore[attr-defined]


@EACH
def test_in_flight_refused_packets_are_a_fault_of_the_link_after_100_ms(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    refuse(flight)
    took_s = flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.5)
    assert took_s <= REFUSED_NS / 1e9 + 2 * SLOT_S
    assert flight.phase is Phase.LEAVING
    assert flight.guard.outcome.faults == 1


@pytest.mark.parametrize("gap_s", [0.03, 0.06, 0.07])
@pytest.mark.parametrize("flown_s", [0.0, 1.0], ids=["from the act on", "in flight"])
def test_the_sticks_go_on_from_where_the_vehicles_are(gap_s: float, flown_s: float) -> None:
    """From the receiver's, or from our last ones, and no faster than ever."""
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


@pytest.mark.parametrize("share", [0.25, 0.5])
@EACH
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
