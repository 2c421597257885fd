"""The policy gets the sticks, the pilot or the autopilot takes them, on the vehicle."""

from collections.abc import Callable
from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_flights import GuardFlight, climbing_first
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.guard.values import Phase
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import MID_RECEIVER_US

MS = NS_PER_MS
OVERRIDE_SWITCH = {"RC8_OPTION": 46.0}
MID = (*MID_RECEIVER_US[:7], 2000)


def by_mode(flight: GuardFlight) -> None:
    flight.pilot_mode(Mode.LOITER)


def by_switch(flight: GuardFlight) -> None:
    flight.receiver(ch8=1000)


def by_joystick(rate_hz: float) -> Callable[[GuardFlight], None]:
    """At 10 Hz within three packets: each is shown for a third of a send period only."""
    return lambda flight: flight.joystick(rate_hz, (1700, 1450, 1600, 1500))


OVERRULED = because(Code.OVERRULED, quantity="sticks", output="rc-override", fault="foreign")


@pytest.mark.parametrize(
    ("take", "reason", "within_s"),
    [
        (by_switch, because(Code.OVERRIDE_SWITCH_OFF), 0.12),
        *((by_joystick(rate_hz), OVERRULED, 0.5) for rate_hz in (10, 50, 200)),
    ],
)
def test_a_takeover_releases_and_no_mode_command_ever_leaves(
    take: Callable[[GuardFlight], None], reason: Reason, within_s: float
) -> None:
    """By a mode, of the pilot's radio or of a ground station, in test_output_releases.py."""
    flight = GuardFlight(receiver_us=MID, params=OVERRIDE_SWITCH).fly()
    before_ns = flight.clock.now_ns()
    take(flight)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=within_s)
    given_ns = flight.clock.now_ns()
    flight.run(3)

    assert flight.phases(before_ns - 50 * MS) == [Phase.FLYING, Phase.RELEASING, Phase.RELEASED]
    assert flight.reason == reason
    assert not flight.modes_asked()
    releases = flight.overrides(given_ns - MS)
    assert releases
    assert {us for _, us in releases} == {(0, 0, 0, 0)}, "after the takeover nothing but releases"


def by_parameter(flight: GuardFlight) -> None:
    flight.station(lambda mav: mav.param_set_encode(1, 1, b"FS_THR_ENABLE", 0.0, 9), system=42)
    index = flight.vehicle.params.names.index("FS_THR_ENABLE")
    flight.vehicle.server.links[0].send_param(index)  # ArduPilot tells every link


@pytest.mark.parametrize(
    ("take", "mode"),
    [
        (by_mode, "LOITER"),
        (lambda flight: flight.pilot_mode(Mode.STABILIZE), "STABILIZE"),
        (by_parameter, "ALT_HOLD"),
    ],
)
def test_without_a_receiver_no_takeover_leaves_a_lean_behind(
    take: Callable[[GuardFlight], None], mode: str
) -> None:
    """A release alone keeps the last sticks there: for 1 s, or for ever with FS_THR_ENABLE 0."""
    flight = GuardFlight(climbing_then_leaning, receiver_us=None, arm=True).take_off(5)
    assert flight.record()[-1]["lean_deg"] > 10
    before_ns = flight.clock.now_ns()
    take(flight)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.2)
    given_ns, given_s = flight.clock.now_ns(), flight.record()[-1]["t_s"]
    flight.run(0.9)

    assert flight.modes[-1] == mode
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


def climbing_then_leaning(t_s: float) -> tuple[float, float, float, float]:
    """For a takeoff of five seconds that ends in a lean."""
    return (0.7, 0.0, 0.0, 0.0) if t_s < 3 else (0.2, 0.0, 0.0, 0.5)


# --- who gets the sticks, and how


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


@pytest.mark.parametrize("gap_s", [0.15, 1.0, 4.0])
@pytest.mark.parametrize("lost", ["refused", "to the vehicle", "from the vehicle"])
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
