"""Rows about the parameters, and the conditions of the flight by which they are judged."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from mavbridge.commands.check.rows import CheckRow, Verdict
from mavbridge.config.flight import FlyConfig
from mavbridge.core.address import serial_baud
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import ActionKind, StickGains, Sticks, VehicleStatus
from mavbridge.flight.plan import FlightPlan
from mavbridge.mavlink.codec.calibration import RcChannel
from mavbridge.mavlink.profiles.profile import ParamContext, ParamNote, Profile, StreamGroup
from mavbridge.mavlink.profiles.sticks import IDENTITY, Half
from mavbridge.mavlink.session.params.checks import Assessment, assess, serial_dangers
from mavbridge.mavlink.session.vehicle import VehicleSession
from policy.contract import Contract

_STICK_OUTPUTS = ("rc-override", "manual-control")
_NOT_SENT = "not sent"
_row = partial(CheckRow, "parameters")


class JudgedNote(NamedTuple):
    """A note, and its verdict on the flight."""

    verdict: Verdict
    note: ParamNote


@dataclass(frozen=True, kw_only=True)
class Terms:
    """Conditions of one vehicle and its planned flight."""

    config: FlyConfig
    settings: LinkSettings
    plan: FlightPlan | None
    """None: no policy."""
    profile: Profile
    read: Mapping[str, float]
    """Parameters read from the vehicle."""
    context: ParamContext

    @classmethod
    def of(
        cls,
        config: FlyConfig,
        settings: LinkSettings,
        plan: FlightPlan | None,
        vehicle: VehicleSession,
        status: VehicleStatus | None,
    ) -> "Terms":
        """Create the terms from the vehicle's answers so far."""
        kind: ActionKind = "sticks" if plan is None else plan.contract.action
        output = config.link.output
        usual = vehicle.profile.outputs[kind]
        return cls(
            config=config,
            settings=settings,
            plan=plan,
            profile=vehicle.profile,
            read=vehicle.known_params,
            context=ParamContext(
                usual if output == "auto" else output,
                config.link.source_system,
                status.has_receiver if status else None,
            ),
        )

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the flight, including those of --set."""
        return dict(self.read) | dict(self.config.link.set_params)

    @property
    def is_sticks(self) -> bool:
        """True if the actions are sticks rather than setpoints."""
        return self.context.output in _STICK_OUTPUTS

    @property
    def contract(self) -> Contract | None:
        """Contract of the policy."""
        return None if self.plan is None else self.plan.contract

    @property
    def gains(self) -> StickGains | None:
        """The policy's meaning of full stick; None if its sticks are not mapped."""
        return None if self.plan is None else self.plan.guard.meaning.stick_gains

    @property
    def mode(self) -> str | None:
        """Mode of the flight; None if it is unknown or the vehicle lacks it."""
        if self.config.mode is not None:
            wanted: tuple[str, ...] = (self.config.mode.upper(),)
        else:
            wanted = () if self.contract is None else self.contract.modes
        names = self.profile.modes.roles.names
        return next((mode for mode in wanted if mode in names), None)

    @property
    def streams(self) -> tuple[StreamGroup, ...]:
        """Telemetry requested by the flight."""
        return self.profile.streams(state_hz=self.settings.state_hz)

    @property
    def assessment(self) -> Assessment:
        """Judgement of the parameters for this flight."""
        return assess(self.profile, self.values, self.context)

    def notes(self) -> Iterator[JudgedNote]:
        """Return the flight's refusals and warnings, and hints that only a check gives."""
        values, context = self.values, self.context
        assessment = self.assessment
        yield from (JudgedNote("no-go", note) for note in assessment.obstacles)
        if assessment.unusable is not None:
            unusable = because(Code.CALIBRATION_UNUSABLE, cause=assessment.unusable)
            yield JudgedNote("no-go", ParamNote((), str(unusable)))
        serial = serial_dangers(
            serial_baud(self.settings.connect),
            streams=self.streams,
            stick_hz=self.settings.stick_hz,
        )
        for danger in (*serial, *assessment.dangers):
            if danger.risk in self.config.link.accept_risk:
                yield JudgedNote("warn", danger.accepted)
            else:
                yield JudgedNote("no-go", danger.refused)
        yield from (JudgedNote("warn", note) for note in self.profile.advice(values, context))
        yield from (JudgedNote("warn", note) for note in self.profile.hints(values, context))


def param_rows(terms: Terms) -> Iterator[CheckRow]:
    """Yield every relevant parameter, then the calibration, then the motion at full stick."""
    left = list(terms.notes())
    for name, should_be in terms.profile.wanted_params(terms.values, terms.context):
        about = [each for each in left if name in each.note.names]
        left = [each for each in left if each not in about]
        verdicts = [each.verdict for each in about]
        yield _row(
            name,
            _found(terms, name),
            should_be,
            "no-go" if "no-go" in verdicts else "warn" if about else "go",
            "; ".join(each.note.text for each in about),
            cures(each.note for each in about),
        )
    for verdict, note in left:
        name = note.names[0] if note.names else "settings"
        yield _row(name, "see below", "", verdict, note.text, cures([note]))
    yield from _calibration_rows(terms)
    yield from _curve_rows(terms)
    yield from _thrust_rows(terms)


def cures(notes: Iterable[ParamNote]) -> tuple[str, ...]:
    """Return the flags that fix the problems in these notes."""
    return tuple(note.cure for note in notes if note.cure)


def _found(terms: Terms, name: str) -> str:
    read, flown = terms.read.get(name), terms.values.get(name)
    if flown is None:
        return _NOT_SENT
    if read == flown:
        return f"{flown:g}"
    return f"{_NOT_SENT if read is None else f'{read:g}'}; --set makes it {flown:g}"


def _calibration_rows(terms: Terms) -> Iterator[CheckRow]:
    """Yield the four override channels; an unusable calibration is already a note."""
    calibration = terms.assessment.calibration
    if terms.context.output != "rc-override" or calibration is None:
        return
    for stick, channel in zip(Sticks._fields, calibration.channels, strict=True):
        yield _row(f"RC{channel.number} {stick}", _channel(channel), "a calibrated radio")


def _channel(channel: RcChannel) -> str:
    turned = ", reversed" if channel.is_reversed else ""
    ends = f"{channel.min_us}, {channel.trim_us}, {channel.max_us} us"
    return f"{ends}, dead zone {channel.dead_zone_us}{turned}"


def _curve_rows(terms: Terms) -> Iterator[CheckRow]:
    """Yield the motion at full stick, beside that of the policy's training."""
    mode, gains = terms.mode, terms.gains
    if terms.plan is None or mode is None or not terms.is_sticks:
        return
    if gains is None:
        text = "link.raw_sticks: full sticks are not what they were in training"
        yield _row("sticks", "sent as they are", "mapped", "warn", text)
        return
    curves = terms.profile.stick_curves(terms.values, mode, gains)
    shortfalls: dict[str, str] = dict(curves.shortfalls)
    # The object that stands for modes in which sticks have another meaning.
    if curves is IDENTITY:
        yield _row("sticks", f"sent as they are in {mode}", "a mode in which they are mapped")
        return
    if curves.unmapped is not None:
        yield _row("sticks", "not mapped", "mapped", "warn", curves.unmapped)
        return
    throttle, yaw, lean = curves.throttle, curves.yaw, curves.lean
    lean_half = (
        None if lean is None else Half(lean.vehicle.full_deg, parameter=lean.vehicle.parameter)
    )
    for noun, unit, trained, half in (
        ("lean", "deg", gains.lean_deg, lean_half),
        ("yaw rate", "deg/s", gains.yaw_rate_degps, yaw and yaw.vehicle.above),
        ("climb", "m/s", gains.climb_mps, throttle and throttle.vehicle.above),
        ("descent", "m/s", gains.descent_mps, throttle and throttle.vehicle.below),
    ):
        note = shortfalls.get(noun, "")
        found = f"{trained:.3g} {unit}, as in training"
        if half is not None:
            mapped = "" if note else ", sticks are mapped"
            found = f"{half.full:.3g} {unit} ({half.parameter}){mapped}"
        yield _row(f"full {noun}", found, f"{trained:.3g} {unit}", "warn" if note else "go", note)


def _thrust_rows(terms: Terms) -> Iterator[CheckRow]:
    if terms.contract is None or terms.contract.action not in ("rates", "attitude"):
        return
    hover = terms.profile.hover_thrust(terms.values)
    yield _row(
        "hover thrust",
        _NOT_SENT if hover is None else f"{hover:.2f}, thrusts are scaled by it",
        f"{terms.contract.hover_thrust:.2f} in training",
        "warn" if hover is None else "go",
        "" if hover is not None else "the vehicle does not tell at which thrust it hovers",
    )
