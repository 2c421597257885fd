"""Rows about the link and the vehicle: find it, set it up, measure it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

from mavbridge.commands.check.params import Terms, param_rows
from mavbridge.commands.check.rows import NO_VEHICLE, CheckRow
from mavbridge.commands.output import print_status
from mavbridge.config.flight import FlyConfig, Limits
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import (
    ActionMeaning,
    AdviceText,
    LinkStats,
    VehicleStatus,
    VehicleText,
)
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.settings import effective_freshness, link_settings
from mavbridge.guard.sequences import MIDDLE_STICK
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.profiles.profile import StreamGroup
from mavbridge.mavlink.session.vehicle import HEARTBEAT_TIMEOUT_NS, VehicleSession
from mavbridge.mavlink.transport.connection import Transport
from mavbridge.mavlink.transport.signing_files import SigningStore
from mavbridge.mavlink.transport.sockets import make_transport
from mavbridge.observe.terminal import shown_share
from policy.contract import Contract

SET_UP_S = 15.0
"""Longest wait for version, parameters, streams and the receiver. A link without losses takes one
to three seconds."""
SETTLE_S, MEASURE_S, LOST_S = 1.0, 3.0, HEARTBEAT_TIMEOUT_NS / NS_PER_S
"""Time from granted streams to counting, time of counting, longest wait for a heartbeat."""
_POLL_NS = NS_PER_MS
"""Time between two polls of the link; the kernel stamps messages that arrive meanwhile."""
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
_TEXTS_SHOWN = 4
REFUSES_TO_ARM = "PreArm"
"""Prefix of ArduPilot's texts about its pre-arm checks."""
_FLOWN = "ArduCopter or a PX4 multicopter"
_DEAF = (
    "the vehicle answers nothing that we send: our transmit line is dead, or it obeys only another "
    "system id (MAV_OPTIONS bit 0, SYSID_ENFORCE up to 4.6: see link.source_system) or signed "
    "packets (--signing-key-file)"
)
_link_row = partial(CheckRow, "link")
_row = partial(CheckRow, "vehicle")


def _measured(
    link: MavlinkLink, clock: Clock, texts: list[str]
) -> tuple[VehicleSession, LinkStats, Reason | None]:
    """Run a link without a guard: find the vehicle, set it up as far as it gets in time, measure.

    Return the vehicle, the figures of the link, and why the vehicle cannot be flown, or None. Its
    texts, and those of the link, are appended to ``texts``. Raises the link's PeerError if there is
    no vehicle in time.
    """

    def step() -> None:
        link.receive()
        texts.extend([text for text in link.snapshot().texts if text not in texts])
        link.service()
        clock.sleep_until_ns(clock.now_ns() + _POLL_NS)

    def run(limit_s: float, is_over: Callable[[], bool] = lambda: False) -> None:
        deadline_ns = clock.now_ns() + round(limit_s * NS_PER_S)
        while clock.now_ns() < deadline_ns and not is_over():
            step()

    def vehicle() -> VehicleSession:
        while (found := link.vehicle) is None:
            step()
        return found

    vehicle()  # the wait for it is not part of the time to set it up
    run(SET_UP_S, lambda: vehicle().unfinished(clock.now_ns()) is None)
    run(SETTLE_S)
    link.restart_counters()
    run(MEASURE_S)
    stats, begun_ns = link.stats(), clock.now_ns()
    run(LOST_S, lambda: (vehicle().condition.heartbeat or (0,))[0] > begun_ns)
    return vehicle(), stats, vehicle().problem(clock.now_ns())


def check_vehicle(
    config: FlyConfig,
    plan: FlightPlan | None,
    clock: Clock,
    *,
    transport: Transport | None = None,
) -> list[CheckRow]:
    """Return all rows about the link, the vehicle and its parameters; a failure becomes a row.

    ``plan`` is None if no policy flies. ``transport`` replaces that of the address in ``config``.
    """
    if config.link.connect == NO_VEHICLE:
        return [_link_row("vehicle", "none", "none for this check")]
    print_status(f"listening to the vehicle on {config.link.connect}")
    settings = replace(link_settings(config), readonly=True, set_params=())
    rows: list[CheckRow] = []
    try:
        with ExitStack() as stack:
            transport = transport or make_transport(settings.connect, clock)
            signing = None
            if settings.signing is not None:
                signing = stack.enter_context(SigningStore(settings.signing, clock))
            link = MavlinkLink(transport, clock, settings, signing=signing)
            stack.callback(link.close)
            # Without a policy, sticks are sent unchanged.
            meaning = ActionMeaning() if plan is None else plan.guard.meaning
            link.begin_flight(meaning, None if config.link.output == "auto" else config.link.output)
            texts: list[str] = []
            vehicle, stats, problem = _measured(link, clock, texts)
            status = link.snapshot().status
            terms = Terms(
                config=config,
                plan=plan,
                vehicle=vehicle,
                is_deaf=not (vehicle.version or vehicle.params.values or stats.rtt_ms),
            )
            streams = vehicle.profile.streams(state_hz=settings.state_hz)
            rows += _link_rows(stats, streams, terms, problem)
            rows += _vehicle_rows(vehicle, status, terms)
            rows += _text_rows(texts)
            rows += [] if terms.is_deaf else param_rows(terms)
    except MavbridgeError as error:
        rows.append(_link_row("vehicle", "none that can be flown", _FLOWN, no_go=str(error)))
    return rows


def _link_rows(
    stats: LinkStats, streams: Sequence[StreamGroup], terms: Terms, problem: Reason | None
) -> Iterator[CheckRow]:
    vehicle = terms.vehicle
    place = f"system {vehicle.identity.source.system} at {vehicle.identity.place}"
    no_go = "" if problem is None else f"the link is not ready: {problem}"
    no_go = _DEAF if terms.is_deaf else no_go
    found = f"{vehicle.profile.name} {vehicle.version or '(no version)'}, {place}"
    yield _link_row("vehicle", found, _FLOWN, no_go=no_go)
    for group in streams:
        if group.is_needed and not terms.is_deaf:
            yield _rate_row(group, stats.messages_per_s, terms.plan)
    lost, uncounted = stats.lost_fraction, "no message came to count losses by"
    shown = "not measured" if lost is None else f"{shown_share(lost, 1)} of its messages"
    bad = f", {stats.unusable_packets} unusable" if stats.unusable_packets else ""
    advice = (
        "messages of the vehicle get lost: look at cable, baud rate and radio, and at other "
        "programs on its port"
    )
    yield _link_row(
        "loss",
        shown + bad,
        f"under {_LOSSY:.0%}",
        warn=uncounted if lost is None else advice if lost > _LOSSY else "",
        no_go=advice if lost is not None and lost > _TOO_LOSSY else "",
    )
    trip, error_ms = stats.rtt_ms, stats.timesync_error_ms
    slow = "half of it is added to the age of every stick"
    unknown = "the vehicle answers no TIMESYNC: the link's delay is not known"
    yield _link_row(
        "round trip",
        "no answer" if trip is None else f"{trip.p50:.1f} ms, at most {trip.max:.1f}",
        f"under {_SLOW_MS:.0f} ms",
        warn=unknown if trip is None else slow if trip.p50 > _SLOW_MS else "",
    )
    advice = stats.slow_clock or (
        "the vehicle's stamps cannot be trusted: ages count from arrival, which hides delay"
    )
    yield _link_row(
        "clocks (TIMESYNC)",
        f"within {error_ms:.1f} ms" if error_ms is not None else "no answer",
        "good: ages count from the vehicle's own stamps",
        warn="" if stats.is_timesync_good else advice,
    )


def _rate_row(
    group: StreamGroup, rates_hz: Mapping[str, float], plan: FlightPlan | None
) -> CheckRow:
    name = _QUANTITIES.get(group.messages[0], group.messages[0])
    rate_hz = next((rates_hz[message] for message in group.messages if message in rates_hz), 0.0)
    limits = effective_freshness(Contract(), Limits()) if plan is None else plan.start_limits
    oldest_ns = limits.state_ns if name == "attitude" else limits.velocity_ns
    least_hz = max(_ECHO_HZ if name == "sticks (echo)" else 0.0, NS_PER_S / oldest_ns)
    row = partial(_link_row, name, f"{rate_hz:.1f} Hz", f"{group.rate_hz:.3g} Hz")
    if rate_hz == 0.0 and name == "velocity":
        return row(
            no_go="no valid velocity comes: the estimator has no position yet (some 40 s after the "
            "start, and never without GPS or another source of position)"
        )
    if rate_hz < least_hz:
        return row(no_go=f"{name}: below {least_hz:.3g} Hz it is too old to act on between two")
    if rate_hz < _ENOUGH * group.rate_hz:
        return row(
            warn=f"{name} comes at {rate_hz:.1f} Hz of {group.rate_hz:.3g}: a faster link (a "
            "higher baud rate; on PX4 also MAV_n_RATE), another station that asks for other "
            "rates, or a lower rates.action"
        )
    return row()


def _vehicle_rows(
    vehicle: VehicleSession, status: VehicleStatus | None, terms: Terms
) -> Iterator[CheckRow]:
    names = vehicle.profile.modes.roles.names
    if wanted := () if terms.contract is None else terms.contract.modes:
        lacking = f"the policy cannot fly in any mode of this vehicle: {', '.join(names)}"
        yield _row(
            "modes",
            ", ".join(mode for mode in wanted if mode in names) or "none of them",
            " or ".join(wanted),
            no_go=lacking if terms.mode is None else "",
        )
    if status is not None:
        yield from _status_rows(terms, status)
    if (is_ready := vehicle.condition.is_ready_to_arm) is not None:
        refuses = (
            "the autopilot would refuse to arm now; it says why as PreArm texts, also to a ground "
            "station"
        )
        found, advice = ("passed", "") if is_ready else ("not passed", refuses)
        yield _row("checks before arming", found, "passed", warn=advice)
    if vehicle.switch_problem is not None:
        yield _row("override switch", "off", "on", warn=str(vehicle.switch_problem))


def _status_rows(terms: Terms, status: VehicleStatus) -> Iterator[CheckRow]:
    found = f"{'armed' if status.armed else 'disarmed'} in {status.mode}"
    if status.is_failsafe:
        text = "a failsafe of the vehicle is active"
        yield _row("state", f"{found}, failsafe", "disarmed", no_go=text)
    elif status.armed:
        text = "it is armed: this check sends nothing that moves it"
        yield _row("state", found, "disarmed", warn=text)
    else:
        yield _row("state", found, "disarmed, no failsafe")
    yield _receiver_row(terms, status)
    position = {True: "valid", False: "none", None: "the estimator does not say"}
    text = "without a position, hold is LAND, and the autopilot does not take off by itself"
    is_lacking = status.is_position_valid is False
    found = position[status.is_position_valid]
    yield _row("position", found, "valid", warn=text if is_lacking else "")
    if status.battery_problem is not None:
        yield _row("battery", "low", "charged", no_go=str(status.battery_problem))


def _receiver_row(terms: Terms, status: VehicleStatus) -> CheckRow:
    name, expected = "radio receiver", "a pilot who can take over"
    if terms.vehicle.params.traits.ignores_receiver and terms.vehicle.condition.has_receiver:
        remedy = "clear RC_OPTIONS bit 0 (ArduPilot), or set COM_RC_IN_MODE to 6 (PX4 1.17)"
        text = f"neither its sticks nor its switches count: {remedy}"
        return _row(name, "ignored by a parameter", expected, text)
    if not status.has_receiver:
        text = "without a receiver nobody takes over by stick"
        if terms.is_sticks:
            text += (
                ", and neutral sticks go on after a flight until the vehicle is disarmed or its "
                "mode is changed; if this computer died, its radio failsafe would act (ArduPilot: "
                "RTL after RC_FS_TIMEOUT, 1 s, whatever RC_OVERRIDE_TIME)"
            )
        found = "none seen" if status.has_receiver is False else "not known"
        return _row(name, found, expected, text)
    throttle = status.pilot_sticks.throttle if status.pilot_sticks else None
    if throttle is None or abs(throttle) <= MIDDLE_STICK:
        return _row(name, "there", expected)
    text = "a pilot who takes over by changing the mode gets such a throttle at once"
    if terms.is_sticks:
        text = (
            "sticks are not released to such a throttle in the air; if this computer died, the "
            "vehicle would get it after RC_OVERRIDE_TIME (ArduPilot; measured over an idle one: on "
            "the ground after 4.7 s with 0.5, 15 m farther and sinking with 3)"
        )
    found = f"throttle at {100 * throttle:+.0f} %"
    expected = f"throttle within {100 * MIDDLE_STICK:.0f} % of the middle in flight"
    return _row(name, found, expected, f"{text}: put the throttle in the middle first")


def _text_rows(texts: Sequence[str]) -> Iterator[CheckRow]:
    """Yield rows for texts, except advice about parameters and sticks, which has its own rows."""
    for text in [text for text in texts if not isinstance(text, AdviceText)][-_TEXTS_SHOWN:]:
        if not isinstance(text, VehicleText):
            yield _row("link", "see below", warn=text)
        elif text.said.startswith(REFUSES_TO_ARM):
            yield _row("it says", "see below", warn=text.said)
        else:
            yield _row("it says", text.said)
