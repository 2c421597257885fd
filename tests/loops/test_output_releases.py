"""Every way out of a flight, for each kind of action on each firmware, by the vehicle's record.

Limits are those of docs/safety.md; the vehicle leans 15 degrees or flies 2 m/s when it happens.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from helpers.output_flights import COMBINATIONS, HOVERING, OutputFlight
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code
from mavbridge.core.vehicle import Action, OnFault
from mavbridge.guard.values import Phase
from mavbridge.mavlink.codec.packets import CommandRefusedError
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.simulation.world import NOMINAL_VEHICLE
from policy.contract import ActionKind
from policy.motion.controllers import Motion, Program, Push
from sitl.ardupilot.flight_modes import Mode as ArduMode
from sitl.px4.modes import Phase as LostPhase
from sitl.px4.sticks import RC_SOURCE
from sitl.vehicle.config import AutopilotName, Px4Release

IDLE_US = (1500, 1500, 1000, 1500)
FULL_YAW = Program(motion=lambda _: Motion(push=Push("yaw", 1.0)))
ALL_STICKS = Program(motion=lambda _: Motion(forward_mps=6, right_mps=6, push=Push("yaw", 0.6)))
GRACE_MS = 120
"""Three chunk periods or 100 ms, and 20 ms."""
STALL_MS = 270
"""``max_stall_s`` of a new contract, and 20 ms."""
DEATH_MS = 60
CUT_MS = 1660
"""A cut of 1.5 s, and the next request of the mode."""
PX4_STREAM_LOST_MS = 1050
"""COM_OF_LOSS_T, and a step; sticks are lost after 0.6 s."""
UNLIKE: tuple[tuple[AutopilotName, ActionKind], ...] = (
    ("ardupilot", "attitude"),
    ("ardupilot", "velocity"),
    ("px4", "sticks"),
    ("px4", "rates"),
)
OTHERS = tuple(each for each in COMBINATIONS if each not in UNLIKE)
"""Where the guard alone decides, either four stand for all: each firmware twice, each kind once."""
MESSAGES: tuple[tuple[AutopilotName, ActionKind], ...] = (
    ("ardupilot", "sticks"),
    ("ardupilot", "rates"),
    ("px4", "sticks"),
    ("px4", "velocity"),
)
"""Each message that a command may be."""


def later(flight: OutputFlight, seconds: float, act: Callable[[], object]) -> None:
    """Call ``act`` after this time."""
    flight.clock.schedule(flight.clock.now_ns() + round(seconds * NS_PER_S), act)


def hang(flight: OutputFlight) -> None:
    """Stop the flight process for a second, and let it continue."""
    flight.is_flight_process_stopped = True
    later(flight, 1.0, lambda: setattr(flight, "is_flight_process_stopped", False))


def silence(flight: OutputFlight, *, up_s: float = 0.0, down_s: float = 0.0) -> None:
    """Lose all messages to and from the vehicle for this long."""
    for direction, seconds in ((flight.up, up_s), (flight.down, down_s)):
        direction.is_silent = seconds > 0
        later(flight, seconds, lambda one=direction: setattr(one, "is_silent", False))  # type: ignore[misc]


def die_without_position(flight: OutputFlight) -> None:
    """Kill the flight process while modes that hold a position are refused."""
    flight.lose_position()
    later(flight, 0.05, flight.die)


def refuse_commands(flight: OutputFlight) -> None:
    """Let the codec refuse each command, the first neutral one among them."""
    output = flight.link._sender.output
    assert output is not None
    encode = output.encode

    def encode_or_refuse(action: Action, vehicle: VehicleSession, now_ns: int) -> Any:
        if flight.phase is Phase.FLYING:  # as last told
            raise CommandRefusedError("1.0000000000000002 is not in [-1, 1]")
        return encode(action, vehicle, now_ns)

    output.encode = encode_or_refuse  # type: ignore[method-assign]


def hold(flight: OutputFlight) -> str:
    """Mode after a fault of ours: ArduPilot's receiver gets its sticks back instead."""
    if flight.is_px4:
        return "AUTO.LOITER"
    return "ALT_HOLD" if flight.kind == "sticks" else "BRAKE"


def land_px4(flight: OutputFlight) -> str:
    return "AUTO.LAND" if flight.is_px4 else hold(flight)


def land(flight: OutputFlight) -> str:
    return "AUTO.LAND" if flight.is_px4 else "LAND"


def after_a_cut(flight: OutputFlight) -> str:
    """Setpoints of ours would bring PX4 back into OFFBOARD: its own failsafe is left alone."""
    return "AUTO.RTL" if flight.is_px4 and flight.kind != "sticks" else hold(flight)


class Way(NamedTuple):
    """A way in which a flight ends by our doing."""

    act: Callable[[OutputFlight], object]
    neutral_ms: float
    on: tuple[tuple[AutopilotName, ActionKind], ...]
    mode: Callable[[OutputFlight], str] = hold
    code: Code | None = None
    lasts_s: float = 0.0


WAYS = {
    "death": Way(OutputFlight.die, DEATH_MS, COMBINATIONS),
    # OFFBOARD, too, is over for good: PX4 would go back to it if the stream came again.
    "hang": Way(hang, STALL_MS, UNLIKE, lasts_s=1.0),
    "NaN": Way(OutputFlight.return_nan, GRACE_MS, UNLIKE[3:], code=Code.UNUSABLE_CHUNKS),
    "refused": Way(refuse_commands, DEATH_MS, UNLIKE[:1], code=Code.COMMAND_FAILED),
    "not heard": Way(lambda flight: silence(flight, down_s=2.0), GRACE_MS, OTHERS, lasts_s=2.0),
    "cut": Way(
        lambda flight: silence(flight, up_s=1.5, down_s=1.5),
        *(CUT_MS, UNLIKE, after_a_cut),
        lasts_s=1.5,
    ),
    "end": Way(OutputFlight.stop, DEATH_MS, OTHERS, land_px4),
    "no position": Way(die_without_position, 50 + DEATH_MS + 100, UNLIKE, land),
    "guard killed": Way(OutputFlight.kill_guard, 20, MESSAGES),
}


@pytest.mark.parametrize(
    ("name", "autopilot", "kind"), [(name, *each) for name, way in WAYS.items() for each in way.on]
)
def test_neutral_in_time_then_a_safe_mode_and_never_back(
    name: str, autopilot: AutopilotName, kind: ActionKind
) -> None:
    way, flight = WAYS[name], OutputFlight(autopilot, kind).fly(1.2)
    at_s = flight.t_s
    way.act(flight)
    flight.run(way.lasts_s + 1.5)
    found = flight.aftermath(at_s)
    assert found.neutral_ms is not None, found
    assert found.neutral_ms <= way.neutral_ms, found
    assert not found.flew_again, found
    assert found.final_mode == way.mode(flight), (found, flight.describe())
    assert found.lean_held_ms <= way.neutral_ms + 250, found
    assert way.code is None or way.code in flight.codes
    if name != "guard killed":
        assert flight.phase is not Phase.FLYING
    if name == "death":  # PX4 would take the end of its only sticks for a failsafe
        is_held = flight.is_px4 and kind == "sticks"
        assert flight.phase is (Phase.HOLDING if is_held else Phase.ENDED)


@pytest.mark.parametrize("program", [FULL_YAW, ALL_STICKS])
@pytest.mark.parametrize(
    ("release", "end"), [("1.17", OutputFlight.die), ("1.18", OutputFlight.stop)]
)
def test_no_px4_takes_our_jump_to_neutral_for_a_hand(
    release: Px4Release, end: Callable[[OutputFlight], None], program: Program
) -> None:
    """0.57 of the policy's yaw is 0.88 of the vehicle's; PX4 looks at several sticks in turn."""
    flight = OutputFlight(
        "px4", "sticks", program, vehicle=replace(NOMINAL_VEHICLE, px4_release=release)
    )
    flight.fly(1.2)
    sticks = flight.px4.stick_input.sticks
    assert sticks.yaw > 0.85 if program is FULL_YAW else min(sticks.forward, sticks.right) > 0.3
    at_s = flight.t_s
    end(flight)
    flight.run(2.0)
    after = {sample.mode for sample in flight.samples if sample.t_s > at_s}
    assert "POSCTL" not in after, flight.describe()
    is_dead = end is OutputFlight.die
    assert flight.px4.mode_name == ("AUTO.LOITER" if is_dead else "AUTO.LAND")


def fall_back(flight: OutputFlight, *receiver_us: int) -> None:
    """Let PX4 follow this receiver whenever we send no sticks."""
    axes = enumerate(("ROLL", "PITCH", "THROTTLE", "YAW"), 1)
    for name, value in {"COM_RC_IN_MODE": 6, **{f"RC_MAP_{axis}": k for k, axis in axes}}.items():
        assert flight.vehicle.params.set(name, value)
    flight.vehicle.set_receiver(receiver_us)


@pytest.mark.parametrize("end", [OutputFlight.die, OutputFlight.kill_guard])
def test_arm_looks_at_the_pilots_sticks_before_ours_hide_them(
    end: Callable[[OutputFlight], None],
) -> None:
    flight = OutputFlight("px4", "sticks", HOVERING, in_air=False, arm=True)
    fall_back(flight, 1500, 1500, 1500, 1500)
    flight.until(lambda: flight.px4.armed and not flight.px4.landed, within_s=10)
    flight.run(0.5)  # it reports its takeoff
    end(flight)
    flight.run(1.5)
    assert flight.px4.mode_name == "ALTCTL", flight.describe()
    assert flight.px4.stick_input.source == RC_SOURCE


@pytest.mark.parametrize(
    ("end", "throttle_us", "mode"),
    [
        (None, 1000, "ALTCTL"),
        (OutputFlight.die, 1500, "ALTCTL"),
        (OutputFlight.kill_guard, 1500, "ALTCTL"),
        (OutputFlight.die, 1000, "AUTO.LOITER"),  # to whose throttle it is not released unasked
        (OutputFlight.stop, 1000, "AUTO.LAND"),
    ],
)
def test_a_px4_that_falls_back_to_its_receiver_is_flown_by_it_after_an_end_or_the_switch(
    monkeypatch: pytest.MonkeyPatch,
    end: Callable[[OutputFlight], None] | None,
    throttle_us: int,
    mode: str,
) -> None:
    """Until then it ignores the transmitter's switches too, but for our engage switch."""
    said: list[str] = []
    monkeypatch.setattr(MavlinkLink, "announce", lambda link, text: said.append(text))
    flight = OutputFlight("px4", "sticks", engage_channel=5)
    sticks_us = (1500, 1500, throttle_us, 1500)
    fall_back(flight, *sticks_us, 1000)
    flight.launch().run(0.3)
    flight.vehicle.set_receiver((*sticks_us, 2000))
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=1.0)
    flight.begin_program()
    flight.run(1.2)
    assert flight.px4.stick_input.source != RC_SOURCE
    if end is not None:
        end(flight)
        flight.run(1.2)
        assert flight.px4.mode_name == mode, flight.describe()
        assert (flight.phase is Phase.HOLDING) is (throttle_us == 1000)
        ways = "disarm or change the mode by a ground station, or put the engage switch low"
        assert any(text.endswith(ways) for text in said) is (throttle_us == 1000)
    flight.vehicle.set_receiver((*sticks_us, 1000))
    flight.run(0.8)
    assert flight.px4.stick_input.source == RC_SOURCE, flight.describe()
    flight.run(1.2)
    assert flight.px4.mode_name == mode, flight.describe()
    assert not flight.samples[-1].failsafe


def put_switch_low(flight: OutputFlight) -> None:
    flight.vehicle.set_receiver((1500, 1500, 1500, 1500, 1000))


@pytest.mark.parametrize("end", [OutputFlight.die, OutputFlight.stop, put_switch_low])
def test_a_px4_whose_receiver_rests_gets_its_mode_back_after_its_failsafe(
    end: Callable[[OutputFlight], None],
) -> None:
    """It reads a resting receiver every 0.3 s: after three ends of eight it saw no sticks."""
    modes, failsafes = set(), 0
    for wait_s in (0.0, 0.08, 0.16, 0.24):
        flight = OutputFlight("px4", "sticks", engage_channel=5)
        fall_back(flight, 1500, 1500, 1500, 1500, 1000)
        flight.launch().run(0.3)
        flight.vehicle.set_receiver((1500, 1500, 1500, 1500, 2000))
        flight.until(lambda: flight.phase is Phase.FLYING, within_s=1.0)  # noqa: B023
        flight.begin_program()
        flight.run(1.2 + wait_s)
        end(flight)
        flight.run(2.0)
        modes.add((flight.px4.mode_name, flight.px4.stick_input.source))
        failsafes += any(sample.failsafe for sample in flight.samples)
        assert flight.codes[-1] is not Code.ENTERED_LATE
    assert modes == {("ALTCTL", RC_SOURCE)}
    assert failsafes, "else nothing is shown"


def test_a_pilot_who_chooses_hold_in_that_failsafe_keeps_it() -> None:
    flight = OutputFlight("px4", "sticks")
    fall_back(flight, 1500, 1500, 1500, 1500)
    flight.fly(1.28)
    flight.act("release")
    flight.until(lambda: flight.samples[-1].failsafe, within_s=1.2)
    flight.run(0.03)
    flight.pilot_changes_mode()
    flight.run(2.0)
    assert flight.px4.mode_name == "AUTO.LOITER", flight.describe()


def over_an_idle_receiver(autopilot: AutopilotName, flown_s: float = 1.2) -> OutputFlight:
    """A flight whose vehicle follows a receiver with its throttle down, should it miss us."""
    flight = OutputFlight(autopilot, "sticks")
    if flight.is_px4:
        fall_back(flight, *IDLE_US)
    flight.vehicle.set_receiver(IDLE_US)
    return flight.fly(flown_s)


@pytest.mark.parametrize(
    ("autopilot", "flown_s", "is_moved"),
    [("px4", 1.2, False), ("px4", 1.225, False), ("px4", 1.2, True), ("ardupilot", 1.2, True)],
)
def test_unheard_sticks_are_followed_by_a_hold_and_only_by_a_pilot_whose_hand_is_seen(
    autopilot: AutopilotName, flown_s: float, is_moved: bool
) -> None:
    """A PX4 was released to the throttle and sank; a pilot of an ArduPilot was braked.

    At 1.225 s PX4 showed the throttle before our sticks had been constant for too long.
    """
    flight = over_an_idle_receiver(autopilot, flown_s)
    silence(flight, up_s=4.0)
    if is_moved:
        later(flight, 3.5, lambda: flight.vehicle.set_receiver((1700, 1500, 1500, 1500)))
    flight.run(5.5)
    mode = flight.mode if is_moved else "AUTO.LOITER" if flight.is_px4 else "BRAKE"
    assert flight.samples[-1].mode == mode, flight.describe()
    is_held = flight.is_px4 and not is_moved
    assert flight.phase is (Phase.HOLDING if is_held else Phase.RELEASED)
    assert (Code.OVERRULED in flight.codes) is is_moved


@pytest.mark.parametrize(
    ("autopilot", "is_moved", "end", "mode"),
    [
        ("ardupilot", True, OutputFlight.stop, "LAND"),
        ("ardupilot", True, OutputFlight.die, "BRAKE"),
        ("ardupilot", False, OutputFlight.die, "BRAKE"),
        ("px4", True, OutputFlight.die, "AUTO.LOITER"),
    ],
)
def test_a_release_to_a_throttle_that_has_left_the_middle_is_followed_by_a_safe_mode(
    autopilot: AutopilotName, is_moved: bool, end: Callable[[OutputFlight], None], mode: str
) -> None:
    """It was moved in flight, or overrides of another station had been taken for it: the vehicle
    met the ground at 2.5 m/s."""
    flight = OutputFlight(autopilot, "sticks", params={} if is_moved else {"RC_OVERRIDE_TIME": 10})
    if flight.is_px4:
        fall_back(flight, 1500, 1500, 1500, 1500)
    elif not is_moved:
        flight.vehicle.set_receiver(IDLE_US)
        flight.station(lambda m: m.rc_channels_override_encode(1, 1, *[1503] * 4, *[0] * 4))
    flight.fly(1.2)
    flight.vehicle.set_receiver(IDLE_US)
    end(flight)
    flight.run(3.0)
    assert flight.samples[-1].mode == mode, flight.describe()
    said = [report for report in flight.guard_port.reports if isinstance(report, str)]
    assert f"{mode} instead of release: the receiver's throttle rests at -100 %" in said[-1]


@pytest.mark.parametrize("down_s", [0.0, 0.9])
def test_px4_is_held_again_after_it_has_left_our_sticks_for_an_idle_receiver(down_s: float) -> None:
    """The jump to its throttle counts as a hand, which ends the mode that holds."""
    flight = over_an_idle_receiver("px4")
    flight.die()
    flight.run(2.2)
    silence(flight, up_s=0.9, down_s=down_s)
    flight.until(lambda: flight.px4.mode_name == "POSCTL", within_s=0.8)
    flight.run(1.5)
    assert flight.px4.mode_name == "AUTO.LOITER", flight.describe()
    assert flight.phase is Phase.HOLDING


@pytest.mark.parametrize(("autopilot", "kind"), MESSAGES)
def test_a_vehicle_that_does_not_hear_us_for_a_moment_flies_on_and_for_longer_never_again(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = OutputFlight(autopilot, kind).fly(1.2)
    silence(flight, up_s=0.3)
    flight.run(1.0)
    assert flight.phase is Phase.FLYING, flight.describe()
    assert not any(s.failsafe for s in flight.samples)
    at_s = flight.t_s
    silence(flight, up_s=1.5)
    flight.run(3)

    found = flight.aftermath(at_s)
    assert flight.phase is Phase.RELEASED, flight.describe()
    assert not found.flew_again, found
    assert found.neutral_ms is not None, found
    if flight.is_px4:
        assert found.neutral_ms < PX4_STREAM_LOST_MS, "its own failsafe"
        assert found.final_mode == ("AUTO.LOITER" if kind == "sticks" else "AUTO.RTL")
    else:
        # It hears neutral sticks at once, and for setpoints the next request of the mode.
        assert found.neutral_ms < 1500 + (60 if kind == "sticks" else 160)
        assert found.final_mode == hold(flight)


@pytest.mark.parametrize(
    ("kind", "on_fault", "up_s", "down_s"),
    [
        ("sticks", "hold", 2.5, 1.2),
        ("rates", "hold", 4.0, 0.0),
        ("sticks", "release", 4.6, 0.0),
        ("sticks", "release", 4.6, 4.6),
    ],
)
def test_a_vehicle_that_holds_our_last_command_without_hearing_us_is_never_left_to_it(
    kind: ActionKind, on_fault: OnFault, up_s: float, down_s: float
) -> None:
    """It leaned on until RC_OVERRIDE_TIME, or drifted for ever in GUIDED_NOGPS."""
    params = {"RC_OVERRIDE_TIME": 8.0} if on_fault == "release" else {}
    flight = OutputFlight("ardupilot", kind, params=params, on_fault=on_fault).fly(1.2)
    at_s = flight.t_s
    silence(flight, up_s=up_s, down_s=down_s)
    flight.run(up_s + 1.2)
    found = flight.aftermath(at_s)
    assert found.final_mode == ("BRAKE" if on_fault == "hold" else "ALT_HOLD"), flight.describe()
    assert found.lean_held_ms < 1000 * up_s + 160, found


@pytest.mark.parametrize(("autopilot", "kind"), UNLIKE)
def test_a_failsafe_of_the_vehicle_is_left_alone(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = OutputFlight(autopilot, kind).fly(1.2)
    at_ns = flight.clock.now_ns()
    if flight.is_px4:
        flight.px4.lost_sticks.phase = LostPhase.ACTING
    else:
        failsafe = flight.ardupilot.radio_failsafe
        failsafe.active, failsafe.update = True, lambda **_: False  # type: ignore[method-assign]
        flight.ardupilot.set_mode(ArduMode.RTL)
    flight.run(1.5)
    assert flight.samples[-1].mode == ("AUTO.RTL" if flight.is_px4 else "RTL")
    assert Code.FAILSAFE in flight.codes
    assert not flight.modes_asked(at_ns)
    assert flight.phase is Phase.RELEASED


@pytest.mark.parametrize(
    ("gap_s", "is_held"), [(0.3, False), (0.6, True), (0.9, False), (1.5, True)]
)
def test_px4s_sticks_shown_again_after_a_gap_are_no_takeover(gap_s: float, is_held: bool) -> None:
    """Whoever takes them for one falls silent, which is a failsafe of PX4 that ends in RTL."""
    flight = OutputFlight("px4", "sticks").fly(1.2)
    if is_held:
        flight.die()
        flight.run(1)
    flight.down.is_silent = True
    flight.run(gap_s)
    flight.down.is_silent = False
    flight.run(2)
    assert flight.phase is Phase.HOLDING, flight.describe()
    assert flight.samples[-1].mode == "AUTO.LOITER"
    assert not any(s.failsafe for s in flight.samples)
