"""The session with one vehicle: its condition, its receiver, its modes."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.fakes import FakeClock
from helpers.wire import ARDUPILOT, CALIBRATION
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import ActionMeaning, Sticks, VehicleStatus
from mavbridge.mavlink.codec.messages import (
    Altitude,
    Attitude,
    AutopilotVersion,
    Body,
    CommandAck,
    CommandRequest,
    CurrentMode,
    Endpoint,
    EstimatorFlags,
    Event,
    Heartbeat,
    LandedState,
    LocalVelocity,
    ParamAbsent,
    ParamRequest,
    ParamValue,
    RcChannels,
    ReceivedMessage,
    StatusText,
    SystemStatus,
)
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.sender import choose_output
from mavbridge.mavlink.session.commands import VehicleCommands
from mavbridge.mavlink.session.discovery import VehicleIdentity
from mavbridge.mavlink.session.vehicle import TextJoiner, VehicleSession

S, MS = NS_PER_S, NS_PER_MS
RECEIVER = (1500, 1500, 1000, 1500, 1500, 1500, 1500, 1500)
"""Channels 1 to 8 in us: roll, pitch, throttle, yaw ..."""
NOTHING = (0,) * 8
RC_BIT, BATTERY_BIT = (
    dialect.MAV_SYS_STATUS_SENSOR_RC_RECEIVER,
    dialect.MAV_SYS_STATUS_SENSOR_BATTERY,
)
NED = LocalVelocity(0, velocity_ned_mps=(1.0, 0.0, 0.0), position_ned_m=(1.0, 2.0, -3.0))
GOOD_FLAGS, PX4_WITHOUT_GPS = 831, 0xE5


AUTOPILOTS = {"ardupilot": 3, "px4": 12}


def identity(autopilot: int, vehicle_type: int = 2) -> VehicleIdentity:
    return VehicleIdentity(
        source=Endpoint(1, 1), address=None, vehicle_type=vehicle_type, autopilot=autopilot
    )


class Session:
    """A session that grants every request; the vehicle's messages are put in by hand."""

    def __init__(self, autopilot: str = "ardupilot", *, is_ready: bool = True, **link: Any) -> None:
        self.texts: list[str] = []
        self.session = VehicleSession(
            identity(AUTOPILOTS[autopilot]),
            LinkSettings(**link),
            old_params={},
            report=self.texts.append,
        )
        self.output = choose_output(
            ActionMeaning(),
            None,
            profile=self.session.profile,
            codec=Codec(source_system=255),
        )
        self.session.use_output(self.output.name)
        self.params: dict[str, float] = dict(CALIBRATION)
        self.now_ns = 10 * S
        self.mode = 2 if autopilot == "ardupilot" else 2 << 16
        self.heartbeat()
        if is_ready:
            self.shake_hands()

    def put(self, body: Body, name: str = "ANY", *, sequence: int = 0) -> None:
        message = ReceivedMessage(Endpoint(1, 1), sequence, name, body, b"", is_unusable=False)
        self.output.receive(body, self.session, self.now_ns)
        self.session.receive(message, self.now_ns)

    def rc(self, channels_us: tuple[int, ...]) -> None:
        self.put(RcChannels(channels_us, self.now_ns // 1000), "RC_CHANNELS")

    def turn_switch(self, us: int) -> None:
        """Channel 7 stays there for longer than the debounce."""
        for _ in range(15):
            self.now_ns += 20 * MS
            self.rc((*RECEIVER[:6], us, 1500))

    def answer_requests(self) -> None:
        for request in self.session.step(self.now_ns):
            if isinstance(request, ParamRequest):
                value = self.params.get(request.name)
                is_known = value is not None
                self.put(ParamValue(request.name, value) if is_known else ParamAbsent(request.name))
            elif isinstance(request, CommandRequest):
                self.put(CommandAck(request.command, 0, Endpoint(0, 0)))

    def shake_hands(self) -> None:
        for _ in range(60):
            self.answer_requests()
            self.now_ns += 100 * MS
            self.heartbeat()

    def heartbeat(self, *, armed: bool = False, mode: int | None = None, state: int = 4) -> None:
        mode = self.mode if mode is None else mode
        self.put(Heartbeat(2, 3, 81 | 128 * armed, mode, state))

    @property
    def problem(self) -> Reason | None:
        session, now_ns = self.session, self.now_ns
        return session.problem(now_ns) or session.output_problem(now_ns)

    def override(self, channels_us: tuple[int, ...]) -> None:
        roll, pitch, throttle, yaw = channels_us[:4]
        self.output.echo.sent((throttle, yaw, pitch, roll), self.now_ns)

    @property
    def status(self) -> VehicleStatus:
        status = self.session.status(self.now_ns)
        assert status is not None
        return status


# --- what its messages tell

BOTH = ("ardupilot", "px4")
ALTCTL, POSCTL, RTL = 2 << 16, 3 << 16, 4 << 16 | 5 << 24
LOITER, LAND = 4 << 16 | 3 << 24, 4 << 16 | 6 << 24
ARMED_BY, DISARMED_BY, FAILSAFE_HOLD = 0x190CAF3, 0x1F46777, 0x1D11DF6
PX4_ON_GROUND = 0x3FF
"""Estimator flags with GPS, CONST_POS_MODE among them; in the air 0x37F."""
CONSTANT = dialect.ESTIMATOR_CONST_POS_MODE
POSITION = (1.0, 2.0, -3.0)


def beat(mode: int, *, armed: bool = True, state: int = 4) -> Heartbeat:
    return Heartbeat(2, 12, 81 | 128 * armed, mode, state)


def battery(present: int, healthy: int, percent: int) -> SystemStatus:
    return SystemStatus(present and BATTERY_BIT, healthy and BATTERY_BIT, percent)


Told = tuple[tuple[str, ...], list[Body], dict[str, Any]]
TOLD: list[Told] = [
    *((BOTH, [beat(2, state=k)], {"is_failsafe": k >= 5}) for k in range(9)),
    (("ardupilot",), [Event(ARMED_BY, 1)], {"armed": False}),
    (("ardupilot",), [Event(FAILSAFE_HOLD, 1)], {"is_failsafe": False}),
    (BOTH, [], {"is_landed": None, "is_position_valid": None, "battery_problem": None}),
    *(
        (BOTH, told, {"is_charge_known": is_known})
        for told, is_known in (
            ([], False),
            ([battery(1, 1, -1)], False),
            ([battery(0, 0, 0)], True),
        )
    ),
    *(
        (BOTH, [LandedState(state)], {"is_landed": is_landed})
        for state, is_landed in enumerate((None, True, False, False, False))
    ),
    *(
        (BOTH, [system], {"battery_problem": problem})
        for system, problem in (
            (battery(1, 1, 80), None),
            (battery(1, 0, 80), because(Code.BATTERY)),
            (battery(0, 0, 80), None),  # no battery monitor
            (battery(0, 0, -1), None),
            (battery(1, 1, 15), None),
            (battery(1, 1, 14), because(Code.BATTERY_BELOW, percent=14, limit=15)),
        )
    ),
    *(
        (
            BOTH,
            [EstimatorFlags(flags), NED],
            {"is_position_valid": is_valid, "position_ned_m": POSITION if is_valid else None},
        )
        for flags, is_valid in (
            (GOOD_FLAGS, True),
            (PX4_WITHOUT_GPS, False),
            (dialect.ESTIMATOR_POS_HORIZ_REL, True),
            (dialect.ESTIMATOR_POS_HORIZ_ABS | CONSTANT, True),
            (CONSTANT, False),
            (PX4_ON_GROUND, True),
            (0, False),
        )
    ),
    (("ardupilot",), [NED], {"position_ned_m": POSITION}),  # which it sends with an estimate alone
    (("px4",), [NED], {"position_ned_m": None}),
]  # fmt: skip


@pytest.mark.parametrize(
    ("autopilot", "told", "expected"),
    [(autopilot, told, expected) for each, told, expected in TOLD for autopilot in each],
)
def test_the_status_is_what_the_vehicle_tells(
    autopilot: str, told: list[Body], expected: dict[str, Any]
) -> None:
    session = Session(autopilot, min_battery_percent=15.0)
    for body in told:
        session.put(body)
    assert {name: getattr(session.status, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("body", "field", "after_ms"),
    [
        (LandedState(1), "is_landed", 2000),
        (battery(1, 0, 80), "battery_problem", 2000),
        (NED, "position_ned_m", 500),
    ],
)
def test_nothing_that_it_tells_holds_for_ever(body: Body, field: str, after_ms: int) -> None:
    session = Session()
    session.put(body)
    session.now_ns += after_ms * MS
    assert getattr(session.status, field) is not None
    session.now_ns += MS
    assert getattr(session.status, field) is None


# --- PX4: CURRENT_MODE and EVENT are faster than HEARTBEAT


@pytest.mark.parametrize(
    "story",
    [
        [
            (0, CurrentMode(POSCTL, POSCTL), "POSCTL"),
            (90, beat(ALTCTL, armed=False), "POSCTL"),  # sent before the change, or overtaken by it
            (1000, beat(LAND), "AUTO.LAND armed"),  # CURRENT_MODE got lost
            (0, CurrentMode(LAND, LAND), "AUTO.LAND armed"),  # no news
            (10, beat(RTL), "AUTO.RTL armed"),
        ],
        [
            (0, Event(ARMED_BY, 65535), "ALTCTL armed"),
            (50, beat(ALTCTL, armed=False), "ALTCTL armed"),
            (1000, beat(ALTCTL), "ALTCTL armed"),
            (0, Event(FAILSAFE_HOLD, 0), "ALTCTL armed failsafe"),
            (0, Event(DISARMED_BY, 1), "ALTCTL failsafe"),
            (0, Event(ARMED_BY, 65535), "ALTCTL failsafe"),  # again, for another station
            (1000, beat(ALTCTL), "ALTCTL armed"),  # the event was another's, or it was armed again
            (0, Event(DISARMED_BY, 1), "ALTCTL armed"),  # doubled
            (0, Event(FAILSAFE_HOLD, 0), "ALTCTL armed"),
        ],
        [
            # Disarmed, it falls back to what could arm; armed, it has left the mode by itself.
            (0, CurrentMode(LOITER, POSCTL), "AUTO.LOITER"),
            (1000, beat(POSCTL), "POSCTL armed"),
            (0, CurrentMode(POSCTL, 0), "POSCTL armed"),  # it does not say
            (0, CurrentMode(LOITER, POSCTL), "AUTO.LOITER armed failsafe"),
            (50, beat(POSCTL), "AUTO.LOITER armed failsafe"),
            (1000, beat(LOITER, state=5), "AUTO.LOITER armed failsafe"),
            (0, CurrentMode(LAND, LAND), "AUTO.LAND armed failsafe"),
            (1000, beat(LAND), "AUTO.LAND armed"),
        ],
    ],
    ids=["mode", "arming", "failsafe"],
)
def test_px4_is_in_the_state_that_the_newest_of_three_messages_tells(
    story: list[tuple[int, Body, str]],
) -> None:
    session = Session("px4")
    for after_ms, body, expected in story:
        session.now_ns += after_ms * MS
        session.put(body)
        status = session.status
        told = (status.mode, status.armed and "armed", status.is_failsafe and "failsafe")
        assert " ".join(filter(None, told)) == expected


@pytest.mark.parametrize("body", [beat(LAND), CurrentMode(LAND, LAND)])
@pytest.mark.parametrize(
    ("sequence", "after_ms", "mode"),
    [
        (2, 99, "POSCTL"),
        (132, 99, "POSCTL"),
        (131, 99, "AUTO.LAND"),  # 128 packets later, most of them lost
        (4, 99, "AUTO.LAND"),
        (3, 99, "AUTO.LAND"),  # a router that does not number
        (2, 100, "AUTO.LAND"),  # rebooted, or on another route
    ],
)
def test_a_report_of_the_mode_that_was_overtaken_is_old(
    body: Body, sequence: int, after_ms: int, mode: str
) -> None:
    session = Session("px4")
    session.put(beat(POSCTL), sequence=3)
    session.now_ns += 60 * MS
    session.put(beat(POSCTL), sequence=3)
    session.now_ns += after_ms * MS
    session.put(body, sequence=sequence)
    assert session.status.mode == mode


@pytest.mark.parametrize(
    ("body", "tells_arming"),
    [
        (beat(ALTCTL), True),
        (Event(ARMED_BY, 1), True),
        (Event(FAILSAFE_HOLD, 1), False),
        (CurrentMode(POSCTL, POSCTL), False),
    ],
)
def test_px4_tells_by_heartbeat_and_event_whether_it_is_armed(
    body: Body, tells_arming: bool
) -> None:
    session = Session("px4")
    session.now_ns += S
    session.put(body)
    assert (session.status.armed_arrived_ns == session.now_ns) is tells_arming


@pytest.mark.parametrize(
    ("version", "code"),
    [
        *((v, Code.OBSTACLE) for v in ("1.14.0", "1.15.4")),
        *((v, None) for v in ("1.13.3", "1.16.0", "1.18.0", "0.0.0")),
    ],
)
def test_sticks_need_a_px4_that_shows_the_throttle_as_it_was_sent(
    version: str, code: Code | None
) -> None:
    session = Session("px4")
    session.put(AutopilotVersion(version))
    assert (session.problem and session.problem.code) == code


def test_the_version_is_asked_for_once_a_second_until_it_comes() -> None:
    session = Session("px4", is_ready=False)

    def asked(seconds: int) -> int:
        count = 0
        for _ in range(10 * seconds):
            session.now_ns += 100 * MS
            for request in session.session.step(session.now_ns):
                is_command = isinstance(request, CommandRequest)
                count += is_command and request.command == dialect.MAV_CMD_REQUEST_MESSAGE
        return count

    assert asked(20) == 20
    session.put(AutopilotVersion("1.17.0"))
    assert asked(8) == 0


def test_px4s_events_without_a_text_are_shown() -> None:
    session = Session("px4")
    session.put(Event(0x155CD44, 1))
    assert session.texts[-1] == "vehicle: manual control lost"


# --- the receiver


@pytest.mark.parametrize(
    ("channels_us", "system", "expected"),
    [
        (RECEIVER, SystemStatus(RC_BIT, RC_BIT, -1), True),
        (RECEIVER, SystemStatus(0, 0, -1), True),  # firmware without that bit
        (RECEIVER, SystemStatus(RC_BIT, 0, -1), False),  # the last sticks of a receiver or of ours
        (NOTHING, SystemStatus(0, 0, -1), False),
        (NOTHING, SystemStatus(RC_BIT, RC_BIT, -1), False),
        ((1500, 1500, 0, 1500, 0, 0, 0, 0), SystemStatus(0, 0, -1), False),
        (RECEIVER, None, True),
        (None, SystemStatus(RC_BIT, 0, -1), False),
        (None, SystemStatus(RC_BIT, RC_BIT, -1), None),
        (None, None, None),
    ],
)
def test_a_receiver_is_learnt_before_the_first_override(
    channels_us: tuple[int, ...] | None, system: SystemStatus | None, expected: bool | None
) -> None:
    session = Session()
    if channels_us is not None:
        session.rc(channels_us)
    if system is not None:
        session.put(system)
    assert session.status.has_receiver is expected
    # From the first override on RC_CHANNELS shows only us, and ArduPilot calls that a receiver.
    session.override(RECEIVER)
    session.now_ns += S
    session.rc(RECEIVER)
    session.put(SystemStatus(RC_BIT, RC_BIT, -1))
    assert session.status.has_receiver is expected


def test_px4_has_a_receiver_once_it_shows_one_that_it_listens_to() -> None:
    session = Session("px4", is_ready=False)
    session.params = {"COM_RC_IN_MODE": 3.0}
    assert session.status.has_receiver is None
    session.shake_hands()
    assert session.status.has_receiver is False
    session.rc(RECEIVER)
    session.put(SystemStatus(RC_BIT, RC_BIT, -1))
    assert session.status.has_receiver is True
    session.put(ParamValue("COM_RC_IN_MODE", 1.0))
    session.now_ns += MS
    assert session.status.has_receiver is False


def test_nothing_is_ready_before_the_receiver_was_looked_for() -> None:
    session = Session(is_ready=False)
    session.now_ns += 5 * S
    looked_s = 0.0
    for tick in range(900):
        session.answer_requests()
        session.now_ns += 10 * MS
        if tick % 50 == 0:
            session.put(Heartbeat(2, 3, 81, 2, 4))
        problem = session.problem
        looked_s += 0.01 * (problem == because(Code.LOOKING_FOR_RECEIVER))
    assert looked_s == pytest.approx(2.0, abs=0.03)
    assert session.problem is None


def test_the_pilots_sticks_are_those_without_ours() -> None:
    session = Session()
    assert session.status.pilot_sticks is None
    session.rc((1500, 1700, 1500, 1500, *RECEIVER[4:]))
    pilot = Sticks(0.0, 0.0, -0.5, 0.0)
    assert session.status.pilot_sticks == session.status.rc_sticks == pilot
    ours = (1900, 1500, 1500, 1500, *RECEIVER[4:])
    for _ in range(5):
        session.now_ns += 20 * MS
        session.override(ours)
        session.rc(ours)
    assert session.status.rc_sticks == ARDUPILOT.to_sticks((1500, 1500, 1500, 1900))
    assert session.status.pilot_sticks == pilot
    session.output.echo.released()
    session.now_ns += 20 * MS
    session.rc(ours)  # still ours
    assert session.status.pilot_sticks == pilot
    assert not session.output.echo.is_released
    session.now_ns += 20 * MS
    session.rc((1500, 1500, 1700, 1500, *RECEIVER[4:]))
    assert session.output.echo.is_released
    assert session.status.pilot_sticks == Sticks(0.5, 0.0, 0.0, 0.0)


# --- modes and switches


def test_a_refused_mode_is_known_until_one_is_asked_for_or_it_is_granted() -> None:
    session, sent = Session(), []
    commands = VehicleCommands(sent.append, session.texts.append, FakeClock())
    commands.adopt(session.session)

    def answer(result: int, command: int = dialect.MAV_CMD_DO_SET_MODE) -> str | None:
        commands.receive(CommandAck(command, result, Endpoint(0, 0)))
        return commands.refused_mode

    assert answer(dialect.MAV_RESULT_FAILED) is None  # nothing was asked for
    commands.set_mode("BRAKE")
    assert answer(dialect.MAV_RESULT_IN_PROGRESS) is None
    assert answer(dialect.MAV_RESULT_FAILED, dialect.MAV_CMD_COMPONENT_ARM_DISARM) is None
    for refusal in (dialect.MAV_RESULT_FAILED, dialect.MAV_RESULT_TEMPORARILY_REJECTED):
        assert answer(refusal) == "BRAKE"
    assert sent == [CommandRequest(176, (1, 17, 0))]
    assert answer(dialect.MAV_RESULT_ACCEPTED) is None
    assert answer(dialect.MAV_RESULT_DENIED) == "BRAKE"
    for mode in ("BRAKE", "LAND"):
        commands.set_mode(mode)
        assert commands.refused_mode is None
        assert answer(dialect.MAV_RESULT_FAILED) == mode
    assert len(sent) == 3


def test_a_takeoff_waits_for_the_height() -> None:
    session, sent, clock = Session("px4"), [], FakeClock()
    commands = VehicleCommands(sent.append, session.texts.append, clock)
    commands.takeoff(5.0)  # of no vehicle
    commands.adopt(session.session)
    for _ in range(2):
        commands.takeoff(5.0)
    told = next(text for text in session.texts if text.startswith("no takeoff yet"))
    assert told.endswith("the vehicle does not tell its height above the sea")
    assert sent == []
    session.now_ns = clock.now_ns()
    session.put(Altitude(489.4, 0.0, 0))
    commands.takeoff(5.0)
    assert [request.params[6] for request in sent] == pytest.approx([494.4])


@pytest.mark.parametrize(
    ("switch_us", "is_off", "may_fly"),
    [
        (1000, True, False),
        (1500, False, False),
        (2000, False, True),
        *((unused_us, False, False) for unused_us in (0, 799, 2201, 32767, 65535)),
    ],
)
def test_the_override_switch_is_told_apart(switch_us: int, is_off: bool, may_fly: bool) -> None:
    session = with_override_switch()
    session.turn_switch(switch_us)
    assert session.session.is_switched_off is is_off
    assert (session.problem is None) is may_fly
    session.rc((*RECEIVER[:6], 2000, 1500))
    assert (session.problem is None) is may_fly  # not before the debounce
    session.turn_switch(2000)
    for us in (1500, 0):  # which change nothing
        session.turn_switch(us)
        assert session.session.switch_problem is None
    session.now_ns += 20 * MS
    session.rc((*RECEIVER[:6], 1000, 1500))
    assert session.session.is_switched_off  # at once


def with_override_switch() -> Session:
    session = Session(is_ready=False)
    session.params["RC7_OPTION"] = 46.0
    for _ in range(2):  # the search for a receiver takes as long again
        session.shake_hands()
    return session


# --- reboots


def stamped(session: Session, *boot_ms: int) -> bool:
    """Attitudes with these stamps arrive; True if the vehicle counts as rebooted."""
    for stamp_ms in boot_ms:
        session.put(Attitude(True, 1000 * (stamp_ms % 2**32), (1, 0, 0, 0), (0, 0, 0)))
    return session.session.has_rebooted


@given(
    last_ms=st.integers(50_000, 2**32 - 1) | st.integers(2**32 - 5_000, 2**32 - 1),
    first_ms=st.integers(1_001, 40_000),
    pace=st.floats(0.1, 10.0),
)
def test_a_reboot_is_found_wherever_the_clock_stood(
    last_ms: int, first_ms: int, pace: float
) -> None:
    """No vehicle sends its attitude within a second of its boot; a simulator may run faster."""
    session = Session()
    stamped(session, last_ms)
    session.now_ns += round(first_ms * NS_PER_MS / pace)
    assert stamped(session, first_ms, first_ms + 10) is (last_ms - first_ms > 1000)


def test_one_late_attitude_ends_nothing_and_a_clock_that_was_set_back_does() -> None:
    session = Session()
    for boot_ms in (60_000, 58_800, 60_010, 55_000, 55_010):
        stamped(session, boot_ms)
        problem = session.session.problem(session.now_ns)
        is_told = problem is not None and problem.code is Code.CLOCK_SET_BACK
        assert is_told is (boot_ms == 55_010)
        session.now_ns += 10 * NS_PER_MS


@given(
    last_ms=st.integers(5_000, 2**32 - 2_000),
    back_ms=st.integers(1_001, 2**32),
    gap_ms=st.integers(0, 100),
)
def test_a_vehicle_that_has_run_for_longer_than_it_was_silent_has_not_rebooted(
    last_ms: int, back_ms: int, gap_ms: int
) -> None:
    """Its clock was set: what it does by its old sticks is still the flight's."""
    session, boot_ms = Session(), last_ms - back_ms % (last_ms - 2_100)
    stamped(session, last_ms)
    session.now_ns += gap_ms * NS_PER_MS
    assert not any(stamped(session, boot_ms + later_ms) for later_ms in range(0, 50, 10))


@given(
    start_ms=st.integers(2**32 - 1000, 2**32 - 1),
    steps_ms=st.lists(st.integers(-15, 900), min_size=5, max_size=50),
)
def test_a_clock_that_wraps_has_not_rebooted(start_ms: int, steps_ms: list[int]) -> None:
    session, clock_ms = Session(), start_ms
    for step_ms in steps_ms:
        clock_ms = max(clock_ms + step_ms, start_ms)
        assert not stamped(session, clock_ms)


def test_pieces_make_a_text_and_a_lost_one_is_waited_for_and_then_shows() -> None:
    joiner = TextJoiner()

    def put(text_id: int, text: str, sequence: int) -> list[str]:
        return joiner.receive(StatusText(text, text_id, sequence, text[-1] == " "), 0)

    for _ in range(2):  # every datagram twice
        assert put(7, "one, ", 0) == put(7, "two, ", 1) == []
    assert put(0, "PreArm: no", 0) == ["PreArm: no"]  # whole, in between
    assert put(7, "three\t", 2) == ["one, two, three"]
    assert put(7, "three\t", 2) == put(7, "one, ", 0) == []
    assert (put(8, "one, ", 0), put(8, "three\t", 2)) == ([], ["one, ...three"])
    assert (put(8, "two, ", 1), joiner.step(2 * S)) == ([], ["...two, ..."])
    assert (put(9, "one, ", 0), put(10, "next", 0)) == ([], ["one, ...", "next"])
    assert put(11, "one, ", 0) == joiner.step(S) == []
    assert joiner.step(S + MS) == ["one, ..."]
    assert joiner.step(10 * S) == put(11, "two, ", 1) == []
    assert put(11, "three\t", 2) == ["...two, three"]
