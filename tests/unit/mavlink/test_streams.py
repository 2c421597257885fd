"""Telemetry that is asked for, kept coming, and slowed down by a link that is too slow for it."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import CommandAck, Endpoint
from mavbridge.mavlink.codec.readers import IDS
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import Profile, StreamGroup
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.session.streams import StreamRequester

S = NS_PER_S


def ack(result: int, command: int = dialect.MAV_CMD_SET_MESSAGE_INTERVAL) -> CommandAck:
    return CommandAck(command=command, result=result, target=Endpoint(0, 0))


def ids(request: object) -> tuple[float, float]:
    return request.params[0], round(request.params[1])


STATE = [(31, 10000), (32, 10000), (105, 10000)]


@pytest.mark.parametrize(
    ("profile", "expected"),
    [
        (
            ARDUPILOT,
            [
                *(*STATE, (65, 17000)),
                *((1, 500_000), (245, 200_000), (193, 200_000), (0, 100_000)),
            ],
        ),
        (
            PX4,
            [
                *(*STATE, (436, 20000), (65, 50000)),
                *((1, 500_000), (245, 200_000), (230, 200_000), (33, 500_000)),
            ],
        ),
    ],
)
def test_streams_are_requested_one_after_the_other_what_is_needed_first(
    profile: Profile, expected: list[tuple[int, int]]
) -> None:
    groups = profile.streams(state_hz=100)
    needed = sum(group.is_needed for group in groups)
    requester = StreamRequester(groups)
    requested = []
    while (request := requester.step(len(requested))) is not None:
        assert requester.is_settled == (len(requested) >= needed)
        requested.append(ids(request))
        assert requester.step(len(requested)) is None  # acks carry no id: one at a time
        requester.receive_ack(ack(0, command=400))  # an ack of another command
        assert requester.step(len(requested)) is None
        requester.receive_ack(ack(0))
    assert requested == expected


@pytest.mark.parametrize("answer", [None, dialect.MAV_RESULT_DENIED, dialect.MAV_RESULT_FAILED])
def test_what_is_only_watched_holds_nothing_up(answer: int | None) -> None:
    requester = StreamRequester(ARDUPILOT.streams(state_hz=100))
    requested = []
    for tick in range(3000):
        now_ns = tick * 10 * NS_PER_MS
        for message in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "HIGHRES_IMU"):
            requester.receive(message, now_ns)
        if tick % 2:
            requester.receive("RC_CHANNELS", now_ns)
        if (request := requester.step(now_ns)) is None:
            continue
        requested.append(request)
        is_needed = ids(request)[0] in (31, 32, 105, 65)
        if is_needed:
            requester.receive_ack(ack(0))
        elif answer is not None:
            requester.receive_ack(ack(answer))
        assert requester.is_settled == (len(requested) >= 4)
    attempts = 4 if answer is None else 1
    asked = [ids(request)[0] for request in requested[4:]]
    once = [number for number in (1, 245, 193, 0) for _ in range(attempts)]
    assert asked[: len(once)] == once
    # silence may be a gap of the link, and a denial that of another request: asked for again
    assert set(asked[len(once) :]) == set(once)
    assert requester.renewals == 0


def test_what_no_answer_comes_to_is_asked_for_ever_more_rarely() -> None:
    groups = PX4.streams(state_hz=100)
    link = Link(groups, capacity_hz=1e4)
    optional = [IDS[group.messages[0]] for group in groups if not group.is_needed]
    link.silent = link.mute = set(optional)
    link.run(60.0)
    before = len(link.asked)
    link.run(60.0)
    assert len(link.asked) - before <= 6 * len(optional)  # each once in 10 s
    link.silent, link.mute = set(), set()
    link.run(11.0)
    assert link.rates_hz.keys() >= set(optional)


DENIED_ONCE = [(number, us) for number in (31, 30) for us in (10000, 20000, 40000)]


@pytest.mark.parametrize(
    ("answer", "comes", "requested", "last_s"),
    [
        # slower, then another message, then from the start, after a pause
        (dialect.MAV_RESULT_DENIED, False, [*DENIED_ONCE, (31, 10000)], 0.55),
        # undecided or unanswered: repeated without haste
        (dialect.MAV_RESULT_TEMPORARILY_REJECTED, False, [(31, 10000)] * 10, 4.5),
        (None, False, [(31, 10000)] * 10, 4.5),
        # it comes without an answer, which was lost
        (None, True, [(31, 10000)] * 4, 1.5),
    ],
)
def test_what_is_not_granted_is_asked_for_otherwise(
    answer: int | None, comes: bool, requested: list[object], last_s: float
) -> None:
    requester, found, found_s = StreamRequester(PX4.streams(state_hz=100)[:1]), [], []
    for tick in range(500):
        if comes:
            requester.receive("ATTITUDE_QUATERNION", tick * 10 * NS_PER_MS)
        if (request := requester.step(tick * 10 * NS_PER_MS)) is not None:
            found.append(ids(request))
            found_s.append(tick / 100)
            if answer is not None:
                requester.receive_ack(ack(answer))
            if len(found) == len(requested) and not comes:
                break
    assert (found, found_s[-1]) == (requested, last_s)
    assert requester.is_settled is comes


@pytest.mark.parametrize(
    ("group", "message", "every", "slower", "renewals"),
    [
        # a ground station sets 4 Hz after three seconds
        (ARDUPILOT.streams(state_hz=100)[0], "ATTITUDE_QUATERNION", 1, 25, 3),
        # one that is only watched stops, and is not lost
        (ARDUPILOT.streams(state_hz=100)[4], "SYS_STATUS", 50, 10_000, 0),
        # an echo, which comes as seldom as sticks are sent
        (PX4.stick_echo, "MANUAL_CONTROL", 100, 10_000, 0),
    ],
)
def test_a_stream_that_slows_down_is_requested_again(
    group: StreamGroup, message: str, every: int, slower: int, renewals: int
) -> None:
    requester = StreamRequester((group,))
    requested_s = []
    for tick in range(1000):
        if tick % (every if tick < 300 else slower) == 0:
            requester.receive(message, tick * 10 * NS_PER_MS)
        if requester.step(tick * 10 * NS_PER_MS) is not None:
            requested_s.append(tick // 100)
            requester.receive_ack(ack(0))
    assert requested_s == [0, 4, 6, 8]
    assert (requester.renewals, requester.is_settled) == (renewals, True)


class Link:
    """A vehicle that grants every interval, behind a link that carries ``capacity`` messages a
    second: it then slows all streams down alike, as PX4 was seen to do, and says nothing."""

    def __init__(self, groups: tuple[StreamGroup, ...], capacity_hz: float) -> None:
        self.texts: list[str] = []
        self.requester = StreamRequester(groups, report=self.texts.append)
        self.capacity_hz = capacity_hz
        self.asked: list[tuple[int, float]] = []
        """Message and rate in Hz."""
        self.rates_hz: dict[int, float] = {}
        self.share = 1.0
        self._due: dict[int, float] = {}
        self._names = {IDS[name]: name for group in groups for name in group.messages}
        self._now_ns = 0
        self.silent: set[int] = set()
        """Messages that the vehicle grants and does not send."""
        self.unanswered: set[int] = set()
        """Requests, counted from 1, whose answers are lost."""
        self.mute: set[int] = set()
        """Messages whose requests the vehicle neither grants nor answers."""
        self.stand_ins = 0

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * 1000)):
            self._now_ns += NS_PER_MS
            if (request := self.requester.step(self._now_ns)) is not None:
                self.asked.append((int(request.params[0]), 1e6 / request.params[1]))
                if request.params[0] in self.mute:
                    continue
                self.rates_hz[int(request.params[0])] = 1e6 / request.params[1]
                if len(self.asked) not in self.unanswered:
                    self.requester.receive_ack(ack(0))
            self.stand_ins += len(list(self.requester.stand_ins(self._now_ns)))
            self.share = min(1.0, self.capacity_hz / max(sum(self.rates_hz.values()), 1.0))
            for number, rate_hz in self.rates_hz.items():
                if number in self.silent:
                    continue
                self._due[number] = self._due.get(number, 0.0) + rate_hz * self.share / 1000
                if self._due[number] >= 1.0:
                    self._due[number] -= 1.0
                    self._deliver(self._names[number])
                    if number == IDS["ATTITUDE_QUATERNION"]:
                        self._deliver("ATTITUDE")  # unasked

    def _deliver(self, name: str) -> None:
        self.requester.receive(name, self._now_ns)


def test_a_link_that_slows_all_streams_down_is_told_of_once_and_left_alone() -> None:
    link = Link(PX4.streams(state_hz=100), capacity_hz=45.0)
    link.run(8.0)
    (text,) = link.texts
    assert text.startswith("the link carries only 1")
    assert "instead of 100 Hz" in text
    count = len(link.asked)
    link.run(30.0)
    assert len(link.asked) == count
    assert len(link.texts) == 1
    slow_clock = Link(PX4.streams(state_hz=100), capacity_hz=45.0)
    slow_clock.requester._has_slow_clock = lambda: True
    slow_clock.run(8.0)
    assert slow_clock.texts == []  # which explains it
    link.capacity_hz = 10_000.0
    link.run(10.0)
    link.rates_hz[31] = 4.0
    link.run(5.0)
    assert link.rates_hz[31] == 100.0  # one that is slow alone is still asked for again


def test_what_stays_away_is_told_once_and_stood_in_for_while_it_does() -> None:
    groups = PX4.streams(state_hz=100)
    (mode,) = [group for group in groups if group.stand_in]
    link = Link(groups, capacity_hz=1e4)
    link.silent = {IDS[mode.messages[0]], IDS["EXTENDED_SYS_STATE"]}
    link.run(8.0)
    assert [text.partition(" does not come")[0] for text in link.texts] == [
        "CURRENT_MODE",
        "EXTENDED_SYS_STATE",
    ]
    assert link.texts[1].endswith(": neither a landing nor a frozen image ends the flight")
    assert link.stand_ins == pytest.approx(8.0 * 20, rel=0.05)
    link.silent, before = set(), link.stand_ins
    link.run(1.0)
    assert link.stand_ins - before <= 20 * 0.3


@pytest.mark.parametrize(("beats_hz", "texts"), [(1.0, 1), (5.0, 0)])
def test_rare_heartbeats_are_told_once(beats_hz: float, texts: int) -> None:
    link = Link(ARDUPILOT.streams(state_hz=100), capacity_hz=1e4)
    link.run(0.5)  # until all are granted
    for _ in range(100):
        link.rates_hz[IDS["HEARTBEAT"]] = beats_hz  # whatever was granted
        link.run(0.1)
    assert [text.partition(":")[0] for text in link.texts] == ["HEARTBEAT comes at 1 Hz"] * texts


def test_a_stream_that_is_granted_late_is_not_missed_before() -> None:
    link = Link(ARDUPILOT.streams(state_hz=100), capacity_hz=1e4)
    link.unanswered = {5, 6, 7, 8}  # for the length of the first counting window
    link.run(10.0)
    assert link.texts == []


def test_a_vehicle_that_was_off_is_asked_as_before() -> None:
    link = Link(ARDUPILOT.streams(state_hz=100), capacity_hz=1e4)
    link.run(5.0)
    wanted = set(link.asked)
    link.silent = link.mute = set(IDS.values())
    link.run(12.0)
    link.silent, link.mute, link.rates_hz = set(), set(), {IDS["HEARTBEAT"]: 1.0}
    link.asked.clear()
    link.run(6.0)
    assert set(link.asked) == wanted


def test_a_silence_of_the_whole_vehicle_is_told_as_no_lack_of_a_message() -> None:
    link = Link(PX4.streams(state_hz=100), capacity_hz=1e4)
    for silent_s in (4.5, 6.0):
        link.run(5.0)
        link.silent = set(IDS.values())
        link.run(silent_s)
        link.silent = set()
    link.run(5.0)
    assert link.texts == []
    link.silent = {IDS["SYS_STATUS"]}
    link.run(8.0)
    assert [text.partition(" does not come")[0] for text in link.texts] == ["SYS_STATUS"]


@pytest.mark.parametrize(
    ("state_hz", "attitude_hz", "position_hz"),
    [(50, 50, 50), (100, 100, 100), (125, 125, 125), (200, 250, 125), (400, 250, 125)],
)
def test_px4_is_asked_for_rates_that_it_keeps(
    state_hz: float, attitude_hz: float, position_hz: float
) -> None:
    """Measured: 200 Hz asked for come as 125; beyond, attitude and IMU come at 205 to 250 Hz, the
    estimator's position at 125."""
    attitude, position, imu = PX4.streams(state_hz=state_hz)[:3]
    for profile in (PX4, ARDUPILOT):  # the radio comes at the rate of a recording
        groups = profile.streams(state_hz=state_hz, pilot_hz=100.0)
        assert [g.rate_hz for g in groups if g.messages == ("RC_CHANNELS",)] == [100.0]
    assert (attitude.rate_hz, position.rate_hz, imu.rate_hz) == (
        *(attitude_hz, position_hz),
        attitude_hz,
    )
