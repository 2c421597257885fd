"""The echo check against a vehicle that is a link with delay and loss, and other overriders."""

import heapq
import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.outputs.echo import CONFIRM_NS, EchoCheck, EchoFault, Shown
from mavbridge.mavlink.outputs.sticks import OVERRIDE_ECHO
from mavbridge.mavlink.profiles.ardupilot import RC_CHANNELS_HZ

S, MS = NS_PER_S, NS_PER_MS
RECEIVER: Shown = (1000, 1500, 1500, 1500)
STICKS: Shown = (1600, 1550, 1500, 1700)
"""Throttle, yaw, pitch, roll in us."""
JOYSTICK: Shown = (1400, 1500, 1480, 1320)


def still(_now_ns: int) -> Shown:
    return STICKS


def moving(now_ns: int) -> Shown:
    wave = math.sin(2 * math.pi * now_ns / S)
    return 1500 + round(200 * wave), 1500, 1500 - round(300 * wave), 1500 + round(150 * wave)


class World:
    """Our sends, the vehicle, and the network between them, in steps of half a millisecond."""

    def __init__(
        self,
        *,
        seed: int = 0,
        send_hz: float = 100.0,
        rc_hz: float = RC_CHANNELS_HZ,
        sticks: Callable[[int], Shown] = still,
        loss: float = 0.0,
        delay_ms: float = 1.0,
        jitter_ms: float = 1.0,
        rc_jitter_ms: float = 3.0,
    ) -> None:
        self.random = random.Random(seed)
        self.echo = EchoCheck(OVERRIDE_ECHO)
        self.send_hz, self.rc_hz = send_hz, rc_hz
        self.loss, self.delay_ms, self.jitter_ms = loss, delay_ms, jitter_ms
        self.rc_jitter_ms = rc_jitter_ms
        self.sticks = sticks
        self.is_sending = False
        self.is_deaf = False
        """The vehicle hears nothing from us."""
        self.joystick_hz = 0.0
        self.joystick: Callable[[int], Shown] = lambda _now_ns: JOYSTICK
        self.receiver: Shown | None = RECEIVER
        self.override: Shown | None = None
        self.shown: Shown = RECEIVER
        self.now_ns = 10 * S
        self._network: list[tuple[int, int, str, Shown | None, int]] = []
        self._count = 0
        phase_ns = self.random.uniform(0, S / rc_hz)
        self._due = {"send": float(self.now_ns), "rc": self.now_ns + phase_ns, "joystick": 0.0}

    def _is_due(self, name: str, rate_hz: float, spread_ms: float) -> bool:
        if rate_hz == 0 or self.now_ns < self._due[name]:
            return False
        late_ns = self.random.uniform(0, spread_ms) * MS
        self._due[name] = max(self._due[name], self.now_ns - S / rate_hz) + S / rate_hz
        self._due[name] += late_ns - spread_ms * MS / 2
        return True

    def _post(self, kind: str, pwm_us: Shown | None, stamp_us: int = 0) -> None:
        if self.random.random() < self.loss:
            return
        delay_ms = self.delay_ms + self.random.expovariate(1) * self.jitter_ms
        self._count += 1
        at_ns = self.now_ns + round(delay_ms * MS)
        heapq.heappush(self._network, (at_ns, self._count, kind, pwm_us, stamp_us))

    def start_joystick(self, rate_hz: float, *, after_ours_ms: float) -> None:
        """Its packets come so long after ours, which stay as long as it takes the next of ours."""
        self.joystick_hz = rate_hz
        self._due["joystick"] = self._due["send"] + (self.delay_ms + after_ours_ms) * MS

    def release(self) -> None:
        """Ten release packets, 50 ms apart, stand for one that arrives."""
        self.is_sending = False
        self.echo.released()
        self._count += 1
        at_ns = self.now_ns + round(self.delay_ms * MS) + 20 * MS
        heapq.heappush(self._network, (at_ns, self._count, "stick", None, 0))

    def _step(self) -> None:
        if self._is_due("send", self.send_hz, 0.2) and self.is_sending:
            pwm_us = self.echo.with_dither(self.sticks(self.now_ns), self.now_ns)
            self.echo.sent(pwm_us, self.now_ns)
            self._post("stick", pwm_us)
        if self._is_due("joystick", self.joystick_hz, 1.0):
            self.override = self.joystick(self.now_ns)
        if self.override is not None:
            self.shown = self.override
        elif self.receiver is not None:
            self.shown = self.receiver
        if self._is_due("rc", self.rc_hz, self.rc_jitter_ms):
            self._post("rc", self.shown, self.now_ns // 1000)
        while self._network and self._network[0][0] <= self.now_ns:
            _, _, kind, packet, stamp_us = heapq.heappop(self._network)
            if kind == "rc" and packet is not None:
                self.echo.received(packet, stamp_us, self.now_ns)
            elif kind == "stick" and not self.is_deaf:
                self.override = packet

    def run(self, duration_s: float) -> EchoFault | None:
        """Returns the first fault; stops there."""
        end_ns = self.now_ns + round(duration_s * S)
        while self.now_ns < end_ns:
            self._step()
            if (fault := self.echo.fault(self.now_ns)) is not None:
                return fault
            self.now_ns += MS // 2
        return None

    def last_fault(self, duration_s: float) -> EchoFault | None:
        """Go on after faults; return that of the end."""
        end_ns, fault = self.now_ns + round(duration_s * S), None
        while self.now_ns < end_ns:
            fault = self.run((end_ns - self.now_ns) / S)
            self.now_ns += MS // 2
        return fault

    def engage(self, *, after_s: float = 0.5) -> None:
        """Send until the echo is confirmed."""
        self.run(after_s)
        self.is_sending = True
        while not self.echo.confirmed:
            assert self.run(0.01) is None
        assert self.run(0.5) is None

    def seconds_to_fault(self, limit_s: float = 5.0) -> tuple[EchoFault | None, float]:
        start_ns = self.now_ns
        return self.run(limit_s), (self.now_ns - start_ns) / S


def engaged(**conditions: Any) -> World:
    world = World(**conditions)
    world.engage()
    return world


# --- no false alarms


def resting(_now_ns: int) -> Shown:
    return RECEIVER


BAD_LINKS = [
    {"delay_ms": 100.0, "jitter_ms": 20.0, "loss": 0.2},
    {"delay_ms": 200.0, "jitter_ms": 10.0, "loss": 0.2, "rc_jitter_ms": 15.0},
    {"rc_hz": 20.0, "loss": 0.2, "rc_jitter_ms": 30.0},
    {"rc_hz": 25.0, "rc_jitter_ms": 0.0, "jitter_ms": 0.0},
    {"rc_hz": 100.0, "rc_jitter_ms": 0.0, "jitter_ms": 0.0},
]


@pytest.mark.parametrize("sticks", [still, moving, resting])
@pytest.mark.parametrize("send_hz", [30.0, 400.0])
@pytest.mark.parametrize("link", BAD_LINKS)
def test_a_bad_link_raises_no_alarm(
    link: dict[str, float], send_hz: float, sticks: Callable[[int], Shown]
) -> None:
    world = engaged(send_hz=send_hz, sticks=sticks, **link)
    assert world.run(20.0) is None


def test_one_stray_release_of_another_station_raises_no_alarm() -> None:
    world = engaged(rc_jitter_ms=0.0)
    for _ in range(10):
        world.override = None
        assert world.run(1.0) is None


# --- another overrider


@pytest.mark.parametrize("sticks", [still, moving])
@pytest.mark.parametrize("send_hz", [30.0, 100.0])
@pytest.mark.parametrize("joystick_hz", [50.0, 200.0])
def test_a_joystick_is_noticed_within_half_a_second(
    joystick_hz: float, send_hz: float, sticks: Callable[[int], Shown]
) -> None:
    """At 50 Hz beside our 100 Hz it has 0 to 50 % of the vehicle's time, by the phase."""
    for seed in range(20):
        world = engaged(seed=seed, send_hz=send_hz, sticks=sticks)
        world.start_joystick(joystick_hz, after_ours_ms=seed / 2)
        fault, after_s = world.seconds_to_fault()
        assert fault == "foreign"
        assert after_s < 0.5


@pytest.mark.parametrize("joystick_hz", [50.0, 200.0])
def test_a_joystick_that_was_there_first_is_noticed(joystick_hz: float) -> None:
    for seed in range(10):
        world = World(seed=seed)
        world.start_joystick(joystick_hz, after_ours_ms=2.0)
        world.run(1.0)
        world.is_sending = True
        fault, after_s = world.seconds_to_fault()
        assert fault in ("returned", "unseen")
        assert after_s < (0.5 if fault == "returned" else CONFIRM_NS / S + 0.01)


def test_a_fault_stays_known_for_three_seconds_and_only_then_is_forgotten() -> None:
    world = engaged()
    world.start_joystick(50.0, after_ours_ms=2.0)
    assert world.run(1.0) == "foreign"
    world.joystick_hz = 0.0
    world.release()
    seen_ns = world.now_ns
    assert world.echo.fault(seen_ns + 2 * S) == "foreign"
    assert world.echo.fault(seen_ns + 3 * S) is None


# --- packets that do not arrive


@pytest.mark.parametrize("sticks", [still, moving])
@pytest.mark.parametrize(
    ("send_hz", "rc_hz"), [(30.0, 20.0), (100.0, RC_CHANNELS_HZ), (400.0, 20.0)]
)
def test_a_vehicle_that_hears_us_no_more_is_noticed_within_half_a_second(
    rc_hz: float, send_hz: float, sticks: Callable[[int], Shown]
) -> None:
    for seed in range(5):
        world = engaged(seed=seed, send_hz=send_hz, rc_hz=rc_hz, sticks=sticks)
        world.is_deaf = True
        fault, after_s = world.seconds_to_fault()
        assert fault == "silent"
        assert 0.3 < after_s < 0.5


def test_an_override_that_expires_is_noticed_as_the_sticks_of_before_us() -> None:
    world = engaged()
    world.is_deaf = True
    world.run(0.2)
    world.override = None
    assert world.seconds_to_fault()[0] == "returned"


@pytest.mark.parametrize(
    ("receiver", "fault"),
    [
        (RECEIVER, "silent"),
        ((1015, 1490, 1500, 1520), "silent"),  # it drifts in minutes, and nobody touches it
        ((1020, 1500, 1500, 1521), "foreign"),
        ((1500, 1500, 1500, 1500), "foreign"),
    ],
)
@pytest.mark.parametrize("downlink_loss", [0.0, 1.0])
@pytest.mark.parametrize("first", ["theirs", "ours", "ours, after an older message"])
def test_after_sticks_that_expire_unheard_only_a_hand_on_the_receiver_counts(
    receiver: Shown, fault: EchoFault, downlink_loss: float, first: str
) -> None:
    """Else the vehicle is given back to an idle receiver, or taken from a pilot who flies it.

    ``first``: sticks that the first message after the choice of the output shows.
    """
    world = World()
    if first == "ours, after an older message":
        world.echo.showed(RECEIVER)
    world.engage(after_s=0.5 if first == "theirs" else 0.0)
    world.is_deaf, world.loss = True, downlink_loss
    assert world.last_fault(3.0) == "silent"
    world.override, world.loss = None, 0.0
    if first == "ours":  # only these tell how the receiver rests
        assert world.last_fault(0.3) == "silent"
    world.receiver = receiver
    assert world.last_fault(4.0) == fault
    world.is_deaf = False
    assert world.last_fault(3.1) is None


@pytest.mark.parametrize("keeps", [True, False], ids=["held", "expired"])
@pytest.mark.parametrize("pause_s", [0.35, 0.5, 0.8, 3.0, 10.0])
def test_a_pause_of_our_own_says_nothing_about_the_vehicle(pause_s: float, keeps: bool) -> None:
    world = engaged()
    world.is_sending = False
    assert world.run(min(pause_s, 0.2)) is None
    if not keeps:
        world.override = None  # the receiver's sticks come back
    assert world.run(pause_s - min(pause_s, 0.2)) is None
    world.is_sending = True
    assert world.run(1.0 if keeps else 0.1) is None
    if keeps:
        world.is_deaf = True
        assert world.seconds_to_fault()[0] == "silent"


@pytest.mark.parametrize(("pause_s", "gap_s"), [(0.35, 0.0), (0.6, 0.0), (0.0, 0.65), (0.3, 0.5)])
def test_sticks_of_ours_that_a_deaf_vehicle_holds_are_never_another_sources(
    pause_s: float, gap_s: float
) -> None:
    """Taken for a takeover, they would be left to the vehicle until its own timeout."""
    world = engaged(sticks=moving)
    world.is_deaf, world.is_sending = True, False
    assert world.run(pause_s) is None
    world.is_sending, world.loss = True, 1.0
    world.run(gap_s)
    world.loss = 0.0
    assert world.seconds_to_fault()[0] == "silent"
    world.release()
    world.run(0.2)
    assert not world.echo.is_released


# --- the first echo


@pytest.mark.parametrize("noise_us", [0, 1, 2])
def test_a_vehicle_that_ignores_us_is_not_taken_for_one_whose_sticks_rest_where_ours_do(
    noise_us: int,
) -> None:
    world = World()
    world.is_deaf, world.receiver = True, STICKS
    world.run(0.5)
    world.is_sending = True
    for _ in range(90):
        roll_us = STICKS[3] + world.random.randint(-noise_us, noise_us)
        world.receiver = (*STICKS[:3], roll_us)
        world.run(0.01)
    assert not world.echo.confirmed
    assert world.run(0.2) == "unseen"


@pytest.mark.parametrize("roll_us", [1100, 1499, 1500, 1501, 1900])
def test_the_dither_walks_towards_the_middle_and_shrinks_once_confirmed(roll_us: int) -> None:
    echo, pwm_us = EchoCheck(OVERRIDE_ECHO), (1500, 1500, 1500, roll_us)
    inwards = 1 if roll_us <= 1500 else -1
    for step_us in (OVERRIDE_ECHO.seek_dither, OVERRIDE_ECHO.dither):
        dithered = [echo.with_dither(pwm_us, k * 10 * MS) for k in range(30)]
        assert {pwm[:3] for pwm in dithered} == {(1500, 1500, 1500)}
        assert {pwm[3] for pwm in dithered} == {roll_us + k * inwards * step_us for k in range(3)}
        echo.received(RECEIVER, 1, 0)
        echo.sent(pwm_us, 1)
        echo.received(pwm_us, 2, 2)
        assert echo.confirmed


# --- release


def test_a_receiver_that_rests_close_to_our_last_sticks_confirms_the_release() -> None:
    world = World(sticks=lambda _now_ns: (1500, 1500, 1500, 1500))
    world.receiver = (1500, 1501, 1500, 1500)
    world.engage()
    assert not world.echo.is_released
    world.release()
    assert world.run(0.2) is None
    assert world.echo.is_released


def test_a_vehicle_that_has_not_heard_our_last_sticks_does_not_show_them() -> None:
    world = engaged()
    world.is_deaf = True
    world.sticks = lambda _now_ns: (1500, 1500, 1500, 1500)
    world.run(0.05)
    world.release()
    world.run(0.2)
    assert not world.echo.is_released
    assert not world.echo.shows_last


def test_a_release_without_a_receiver_is_never_confirmed() -> None:
    world = World()
    world.receiver = None
    world.engage()
    world.release()
    assert world.run(5.0) is None
    assert not world.echo.is_released
    assert world.echo.shows_last
    world.engage()  # the sticks of before are our own: the dither tells them apart
    assert world.run(2.0) is None
