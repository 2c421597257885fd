"""Rows about the parameters, and the conditions of the flight by which they are judged."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial

from mavbridge.commands.check.rows import CheckRow
from mavbridge.config.flight import FlyConfig
from mavbridge.core.reasons import Code, because
from mavbridge.flight.plan import FlightPlan
from mavbridge.mavlink.profiles.profile import ParamNote, Profile
from mavbridge.mavlink.profiles.sticks import IDENTITY
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.session.vehicle_params import Assessment
from policy.contract import Contract

_STICK_OUTPUTS = ("rc-override", "manual-control")
_NOT_SENT = "not sent"
_REFUSED = ("obstacle", "risk")
"""Kinds of notes for which a flight is refused."""
_row = partial(CheckRow, "parameters")


@dataclass(frozen=True, kw_only=True)
class Terms:
    """Conditions of one vehicle and its planned flight, by which its parameters are judged."""

    config: FlyConfig
    plan: FlightPlan | None
    """None: no policy."""
    vehicle: VehicleSession
    is_deaf: bool
    """True if the vehicle has answered nothing: no parameter, version or TIMESYNC."""

    @property
    def profile(self) -> Profile:
        """Profile of the vehicle's firmware."""
        return self.vehicle.profile

    @cached_property
    def values(self) -> dict[str, float]:
        """Parameters of the flight, including those of --set."""
        return {**self.vehicle.params.values, **dict(self.config.link.set_params)}

    @property
    def is_sticks(self) -> bool:
        """True if the actions are sticks rather than setpoints."""
        return self.assessment.context.output in _STICK_OUTPUTS

    @property
    def contract(self) -> Contract | None:
        """Contract of the policy."""
        return None if self.plan is None else self.plan.contract

    @property
    def mode(self) -> str | None:
        """Mode of the flight; None if it is unknown or the vehicle lacks it."""
        wanted = () if self.contract is None else self.contract.modes
        if self.config.mode is not None:
            wanted = (self.config.mode.upper(),)
        names = self.profile.modes.roles.names
        return next((mode for mode in wanted if mode in names), None)

    @cached_property
    def assessment(self) -> Assessment:
        """Judgement of the parameters for this flight."""
        return self.vehicle.params.assessment_with(self.config.link.set_params)


def param_rows(terms: Terms) -> Iterator[CheckRow]:
    """Yield every relevant parameter, then the motion at full stick."""
    notes = list(terms.assessment.notes)
    if (cause := terms.assessment.unusable) is not None:
        unusable = because(Code.CALIBRATION_UNUSABLE, cause=cause)
        notes.append(ParamNote("obstacle", (), str(unusable)))
    wanted = {note.names[0]: note.said for note in notes if note.kind == "wanted"}
    rows: dict[str, list[ParamNote]] = {name: [] for name in wanted}
    remarks = [note for note in notes if note.kind != "wanted"]
    for note in sorted(remarks, key=lambda note: note.kind not in _REFUSED):
        own = note.names[0] if note.names else "settings"
        rows.setdefault(next((name for name in wanted if name in note.names), own), []).append(note)
    for name, about in rows.items():
        text = "; ".join(note.text for note in about)
        yield _row(
            name,
            _found(terms, name) if name in wanted else "see below",
            wanted.get(name, ""),
            warn=text,
            no_go=text if any(note.kind in _REFUSED for note in about) else "",
            commands=tuple(note.cure for note in about if note.cure),
        )
    yield from _curve_rows(terms)
    if terms.contract is not None and terms.contract.action in ("rates", "attitude"):
        hover = terms.values.get(terms.profile.hover_param)
        yield _row(
            "hover thrust",
            _NOT_SENT if hover is None else f"{hover:.2f}, thrusts are scaled by it",
            f"{terms.contract.hover_thrust:.2f} in training",
            "the vehicle does not tell at which thrust it hovers" if hover is None else "",
        )


def _found(terms: Terms, name: str) -> str:
    read, flown = terms.vehicle.params.values.get(name), terms.values.get(name)
    if flown is None:
        return _NOT_SENT
    if read == flown:
        return f"{flown:g}"
    return f"{_NOT_SENT if read is None else f'{read:g}'}; --set makes it {flown:g}"


def _curve_rows(terms: Terms) -> Iterator[CheckRow]:
    """Yield the motion at full stick, beside that of the policy's training."""
    mode = terms.mode
    if terms.plan is None or mode is None or not terms.is_sticks:
        return
    gains = terms.plan.guard.meaning.stick_gains
    if gains is None:
        text = "link.raw_sticks: full sticks are not what they were in training"
        yield _row("sticks", "sent as they are", "mapped", text)
        return
    curves = terms.profile.stick_curves(terms.values, mode, gains)
    # The object that stands for modes in which sticks have another meaning.
    if curves is IDENTITY:
        yield _row("sticks", f"sent as they are in {mode}", "a mode in which they are mapped")
        return
    if curves.unmapped is not None:
        yield _row("sticks", "not mapped", "mapped", curves.unmapped)
        return
    for each in curves.extents:
        trained = f"{each.policy.full:.3g} {each.unit}"
        found = f"{trained}, as in training"
        if each.is_mapped:
            mapped = "" if each.shortfall else ", sticks are mapped"
            found = f"{each.vehicle.full:.3g} {each.unit} ({each.vehicle.parameter}){mapped}"
        yield _row(f"full {each.noun}", found, trained, each.shortfall or "")
