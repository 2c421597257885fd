"""Rows about the link: vehicle, received rates, losses, round trips and clocks."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Literal, TypeAlias

from mavbridge.commands.check.param_rows import Terms, cures
from mavbridge.commands.check.rows import CheckRow, Verdict
from mavbridge.config.flight import Limits
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import NEUTRAL, Command, LinkSnapshot, LinkStats, Release
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.settings import effective_freshness
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.profiles.profile import StreamGroup
from mavbridge.mavlink.session.vehicle import VehicleSession
from policy.contract import Contract

SET_UP_S = 15.0
"""Longest wait for version, parameters, streams and the receiver. A link without losses takes one
to three seconds."""
SETTLE_S = 1.0
"""Time from the grant of the streams until their rates are counted."""
MEASURE_S = 3.0
ECHO_S = 3.0
RELEASE_S = 4.0
"""Longest time over which the releases of an override are spread."""
_POLL_NS = NS_PER_MS
"""Time between two polls of the link; the kernel stamps messages that arrive meanwhile."""
_STICK_NS = 20 * NS_PER_MS

EchoResult: TypeAlias = Literal["taken", "not taken", "armed"]
"""``armed``: the vehicle is or became armed, so that sticks were not sent, or no longer."""
_ENOUGH = 0.9
"""Least acceptable share of the requested rate."""
_ECHO_HZ = 20.0
"""Rate of RC_CHANNELS that the echo check needs."""
_LOSSY, _TOO_LOSSY = 0.01, 0.1
_SLOW_MS = 50.0
"""Round trip above which the sticks are noticeably late."""
_QUANTITIES = {
    "ATTITUDE_QUATERNION": "attitude",
    "LOCAL_POSITION_NED": "velocity",
    "HIGHRES_IMU": "acceleration",
    "RC_CHANNELS": "sticks (echo)",
}
_row = partial(CheckRow, "link")


class VehicleProbe:
    """Runs a ``MavlinkLink`` without a guard. Call its methods in the order of their definition."""

    def __init__(self, link: MavlinkLink, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._snapshot: LinkSnapshot | None = None
        self.texts: list[str] = []
        """Texts of the vehicle and the link."""
        self.echo_problem: Reason | None = None
        """The link's reason why the sticks of the echo test were not taken."""

    def find(self) -> VehicleSession:
        """Wait for the vehicle; raise the link's PeerError if there is none in time."""
        while (vehicle := self._link.vehicle) is None:
            self._pass()
        return vehicle

    def set_up(self) -> Reason | None:
        """Read parameters and request streams; return the step that did not finish in time."""
        self._until(SET_UP_S, lambda: self._unfinished is None)
        return self._unfinished

    @property
    def _unfinished(self) -> Reason | None:
        return self.find().unfinished(self._clock.now_ns())

    def measure(self) -> LinkStats:
        """Count messages, losses and round trips."""
        self._until(SETTLE_S)
        self._link.restart_counters()
        self._until(MEASURE_S)
        return self._link.stats()

    def snapshot(self) -> LinkSnapshot:
        """Return everything that the link knows now."""
        return self._snapshot or self._pass()

    def echo(self) -> EchoResult:
        """Send neutral sticks while the vehicle is disarmed, watch their echo, and release them."""
        result: EchoResult = "not taken"
        due_ns = 0

        def is_over() -> bool:
            nonlocal result, due_ns
            snapshot = self.snapshot()
            if snapshot.status is None or snapshot.status.armed:
                result = "armed"
            elif snapshot.echo_confirmed:
                result = "taken"
            elif (now_ns := self._clock.now_ns()) >= due_ns:
                due_ns = now_ns + _STICK_NS
                self.echo_problem = snapshot.problem or self.echo_problem
                self._link.send(Command(action=NEUTRAL))
            return result != "not taken"

        self._link.is_engaged = True
        try:
            self._until(ECHO_S, is_over)
        finally:
            if result != "armed" or due_ns:
                self._until(RELEASE_S, self._release)
            self._link.is_engaged = False
        return result

    def _release(self) -> bool:
        """Release the sticks; return True once the vehicle confirms it."""
        self._link.send(Release(because(Code.FINISHED, what="echo test")))
        return self.snapshot().is_released and not self._link.is_release_owed

    def _until(self, limit_s: float, is_over: Callable[[], bool] = lambda: False) -> None:
        deadline_ns = self._clock.now_ns() + round(limit_s * NS_PER_S)
        while self._clock.now_ns() < deadline_ns and not is_over():
            self._pass()

    def _pass(self) -> LinkSnapshot:
        self._link.receive()
        self._snapshot = self._link.snapshot()
        self.texts += [text for text in self._snapshot.texts if text not in self.texts]
        self._link.service()
        self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS)
        return self._snapshot


def link_rows(
    vehicle: VehicleSession, stats: LinkStats, terms: Terms, *, unfinished: Reason | None
) -> Iterator[CheckRow]:
    """Return all rows about the link except for the echo test."""
    yield _vehicle_row(vehicle, unfinished)
    rates_hz = dict(stats.messages_per_s)
    for group in terms.streams:
        if not group.is_optional:
            yield _rate_row(group, rates_hz, terms.plan)
    yield _optional_row(terms, rates_hz)
    yield _loss_row(stats)
    yield from _time_rows(stats)


def _vehicle_row(vehicle: VehicleSession, unfinished: Reason | None) -> CheckRow:
    place = f"system {vehicle.identity.source.system} at {vehicle.identity.place}"
    return _row(
        "vehicle",
        f"{vehicle.profile.name} {vehicle.version or '(no version)'}, {place}",
        "ArduCopter or a PX4 multicopter",
        "go" if unfinished is None else "no-go",
        "" if unfinished is None else f"the set-up of the link did not finish: {unfinished}",
    )


def _rate_row(
    group: StreamGroup, rates_hz: Mapping[str, float], plan: FlightPlan | None
) -> CheckRow:
    name = _QUANTITIES.get(group.messages[0], group.messages[0])
    rate_hz = next((rates_hz[message] for message in group.messages if message in rates_hz), 0.0)
    least_hz = _ECHO_HZ if name == "sticks (echo)" else 0.0
    limits = effective_freshness(Contract(), Limits()) if plan is None else plan.start_limits
    oldest_ns = limits.state_ns if name == "attitude" else limits.velocity_ns
    least_hz = max(least_hz, NS_PER_S / oldest_ns)
    verdict, advice = _rate_verdict(name, rate_hz, least_hz, group.rate_hz)
    return _row(name, f"{rate_hz:.1f} Hz", f"{group.rate_hz:.3g} Hz", verdict, advice)


def _rate_verdict(
    name: str, rate_hz: float, least_hz: float, asked_hz: float
) -> tuple[Verdict, str]:
    if rate_hz == 0.0 and name == "velocity":
        return "no-go", (
            "no velocity comes: the estimator has no position yet (some 40 s after the start, and "
            "never without GPS or another source of position)"
        )
    if rate_hz < least_hz:
        return "no-go", f"{name}: below {least_hz:.3g} Hz it is too old to act on between two"
    if rate_hz < _ENOUGH * asked_hz:
        return "warn", (
            f"{name} comes at {rate_hz:.1f} Hz of {asked_hz:.3g}: a faster link (a higher baud "
            "rate; on PX4 also MAV_n_RATE), another station that asks for other rates, or a lower "
            "rates.action"
        )
    return "go", ""


def _optional_row(terms: Terms, rates_hz: Mapping[str, float]) -> CheckRow:
    watched = [group for group in terms.streams if group.is_optional and group.least_hz != 0.0]
    silent = [group.messages[0] for group in watched if group.messages[0] not in rates_hz]
    return _row(
        "also watched",
        f"{len(watched) - len(silent)} of {len(watched)} messages",
        ", ".join(group.messages[0] for group in watched),
        "warn" if silent else "go",
        f"not sent: {', '.join(silent)}; the flight does without" if silent else "",
    )


def _loss_row(stats: LinkStats) -> CheckRow:
    lost = stats.lost_fraction or 0.0
    verdict: Verdict = "no-go" if lost > _TOO_LOSSY else "warn" if lost > _LOSSY else "go"
    bad = f", {stats.unusable_packets} unusable" if stats.unusable_packets else ""
    return _row(
        "loss",
        f"{lost:.1%} of its messages{bad}",
        f"under {_LOSSY:.0%}",
        verdict,
        ""
        if verdict == "go"
        else "messages of the vehicle get lost: look at cable, baud rate and "
        "radio, and at other programs on its port",
    )


def _time_rows(stats: LinkStats) -> Iterator[CheckRow]:
    trip = stats.rtt_ms
    is_slow = trip is None or trip.p50 > _SLOW_MS
    yield _row(
        "round trip",
        "no answer" if trip is None else f"{trip.p50:.1f} ms, at most {trip.max:.1f}",
        f"under {_SLOW_MS:.0f} ms",
        "warn" if is_slow else "go",
        "half of it is added to the age of every stick" if is_slow else "",
    )
    error_ms = stats.timesync_error_ms
    yield _row(
        "clocks (TIMESYNC)",
        f"within {error_ms:.1f} ms" if error_ms is not None else "no answer",
        "good: ages count from the vehicle's own stamps",
        "go" if stats.is_timesync_good else "warn",
        ""
        if stats.is_timesync_good
        else stats.slow_clock
        or "the vehicle's stamps cannot be trusted: ages count from arrival, which hides delay",
    )


def echo_row(probe: VehicleProbe, terms: Terms) -> CheckRow:
    """Send neutral sticks unless the vehicle is armed; return a row with the vehicle's response."""
    name, expected = "echo test", f"our sticks from system {terms.context.source_system}"
    if not terms.is_sticks:
        text = "not sent: the vehicle shows setpoints only in their mode"
        return _row(name, text, "actions that are sticks")
    match probe.echo():
        case "armed":
            return _row(
                name, "refused", expected, "no-go", "the vehicle is armed: disarm it for the test"
            )
        case "taken":
            return _row(name, "taken, and released", expected)
    problem = probe.echo_problem
    is_obstacle = problem is not None and problem.code is Code.OBSTACLE
    mend = cures(terms.assessment.obstacles) if is_obstacle else ()
    advice = (
        "the vehicle does not show our sticks: another station may be overriding them, or it "
        "obeys another system id"
    )
    if problem is not None:
        advice = str(problem)
    return _row(name, f"not seen in {ECHO_S:g} s", expected, "no-go", advice, mend)
