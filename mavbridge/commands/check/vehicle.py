"""From the address of a vehicle to its rows: find it, set it up, measure it, run the echo test."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

from mavbridge.commands.check.link_rows import VehicleProbe, echo_row, link_rows
from mavbridge.commands.check.param_rows import Terms, param_rows
from mavbridge.commands.check.rows import CheckRow
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import Clock
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.vehicle import (
    ActionMeaning,
    AdviceText,
    LinkSnapshot,
    VehicleStatus,
    VehicleText,
)
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.settings import guard_settings
from mavbridge.guard.sequences import MIDDLE_STICK
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.transport.signing_files import SigningStore
from mavbridge.mavlink.transport.sockets import Transport, make_transport

_TEXTS_SHOWN = 4
REFUSES_TO_ARM = "PreArm"
"""Prefix of ArduPilot's texts about its pre-arm checks."""
_row = partial(CheckRow, "vehicle")


def vehicle_rows(
    vehicle: VehicleSession, snapshot: LinkSnapshot, terms: Terms, *, texts: Sequence[str]
) -> Iterator[CheckRow]:
    """Return all rows about the vehicle; ``texts`` are those of the vehicle and the link."""
    yield from _mode_rows(terms)
    if (status := snapshot.status) is not None:
        yield _state_row(status)
        yield _receiver_row(status)
        yield _position_row(status)
        if status.battery_problem is not None:
            yield _row("battery", "low", "charged", "no-go", str(status.battery_problem))
    if (is_ready := vehicle.condition.is_ready_to_arm) is not None:
        yield _arming_row(is_ready=is_ready)
    if vehicle.switch_problem is not None:
        yield _row("override switch", "off", "on", "warn", str(vehicle.switch_problem))
    yield from _text_rows(texts)


def _mode_rows(terms: Terms) -> Iterator[CheckRow]:
    names = terms.profile.modes.roles.names
    wanted = () if terms.contract is None else terms.contract.modes
    if not wanted:
        return
    present = [mode for mode in wanted if mode in names]
    is_lacking = terms.mode is None
    yield _row(
        "modes",
        ", ".join(present) or "none of them",
        " or ".join(wanted),
        "no-go" if is_lacking else "go",
        f"the policy cannot fly in any mode of this vehicle: {', '.join(names)}"
        if is_lacking
        else "",
    )


def _state_row(status: VehicleStatus) -> CheckRow:
    found = f"{'armed' if status.armed else 'disarmed'} in {status.mode}"
    if status.is_failsafe:
        text = "a failsafe of the vehicle is active"
        return _row("state", f"{found}, failsafe", "disarmed", "no-go", text)
    if status.armed:
        text = "it is armed: this check sends nothing that moves it"
        return _row("state", found, "disarmed", "warn", text)
    return _row("state", found, "disarmed, no failsafe")


def _receiver_row(status: VehicleStatus) -> CheckRow:
    expected = "a pilot who can take over"
    if status.has_receiver:
        throttle = status.pilot_sticks.throttle if status.pilot_sticks else None
        if throttle is None or abs(throttle) <= MIDDLE_STICK:
            return _row("radio receiver", "there", expected)
        return _row(
            "radio receiver",
            f"throttle at {100 * throttle:+.0f} %",
            f"throttle within {100 * MIDDLE_STICK:.0f} % of the middle in flight",
            "warn",
            "sticks are not released to such a throttle in the air; if this computer died, the "
            "vehicle would get it after RC_OVERRIDE_TIME (ArduPilot; measured over an idle one: on "
            "the ground after 4.7 s with 0.5, 15 m farther and sinking with 3): put the throttle "
            "in the middle before the policy flies",
        )
    return _row(
        "radio receiver",
        "none seen" if status.has_receiver is False else "not known",
        expected,
        "warn",
        "without a receiver nobody takes over by stick, and neutral sticks go on after a flight "
        "until the vehicle is disarmed or its mode is changed; if this computer died, its radio "
        "failsafe would act (ArduPilot: RTL after RC_FS_TIMEOUT, 1 s, whatever RC_OVERRIDE_TIME)",
    )


def _position_row(status: VehicleStatus) -> CheckRow:
    if status.is_position_valid is None:
        return _row("position", "the estimator does not say", "valid")
    if status.is_position_valid:
        return _row("position", "valid", "valid")
    return _row(
        "position",
        "none",
        "valid",
        "warn",
        "without a position, hold is LAND, and the autopilot does not take off by itself",
    )


def _arming_row(*, is_ready: bool) -> CheckRow:
    return _row(
        "checks before arming",
        "passed" if is_ready else "not passed",
        "passed",
        "go" if is_ready else "warn",
        ""
        if is_ready
        else "the autopilot would refuse to arm now; it says why as PreArm texts, "
        "also to a ground station",
    )


def _text_rows(texts: Sequence[str]) -> Iterator[CheckRow]:
    """Yield rows for texts, except advice about parameters and sticks, which has its own rows."""
    for text in [text for text in texts if not isinstance(text, AdviceText)][-_TEXTS_SHOWN:]:
        if not isinstance(text, VehicleText):
            yield _row("link", "see below", "", "warn", text)
        elif text.said.startswith(REFUSES_TO_ARM):
            yield _row("it says", "see below", "", "warn", text.said)
        else:
            yield _row("it says", text.said)


def check_vehicle(
    config: FlyConfig,
    plan: FlightPlan | None,
    clock: Clock,
    *,
    echo_test: bool,
    transport: Transport | None = None,
) -> list[CheckRow]:
    """Return all rows about the link, the vehicle and its parameters; a failure becomes a row.

    ``plan`` is None if no policy flies. ``transport`` replaces that of the address in ``config``.
    """
    rows: list[CheckRow] = []
    settings = checking_settings(config, is_dual=plan is None or plan.is_dual, sends=echo_test)
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
            output = None if config.link.output == "auto" else config.link.output
            link.begin_flight(meaning, output)
            probe = VehicleProbe(link, clock)
            probe.find()
            unfinished = probe.set_up()
            stats = probe.measure()
            vehicle, snapshot, texts = probe.find(), probe.snapshot(), list(probe.texts)
            terms = Terms.of(config, settings, plan, vehicle, snapshot.status)
            rows += link_rows(vehicle, stats, terms, unfinished=unfinished)
            if echo_test:
                rows.append(echo_row(probe, terms))
            rows += vehicle_rows(vehicle, snapshot, terms, texts=texts)
            rows += param_rows(terms)
    except MavbridgeError as error:
        expected = "ArduCopter or a PX4 multicopter"
        rows.append(
            CheckRow("link", "vehicle", "none that can be flown", expected, "no-go", str(error))
        )
    return rows


def checking_settings(config: FlyConfig, *, is_dual: bool, sends: bool) -> LinkSettings:
    """Return the flight's link settings without parameters to set; sticks only if ``sends``."""
    guard = guard_settings(config, is_dual=is_dual, tlog_fd=None, wall_offset_ns=0)
    return replace(guard.link, readonly=not sends, set_params=())
