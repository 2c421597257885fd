"""Rows about the vehicle's parameters, by the judgement that a flight itself makes of them."""

import re
from collections.abc import Iterator

from mavbridge.commands.check.rows import Row, Verdict
from mavbridge.commands.check.terms import Terms
from mavbridge.core.vehicle import Sticks
from mavbridge.mavlink.codec.calibration import RcChannel
from mavbridge.mavlink.profiles.sticks import IDENTITY, Half

_NOT_SENT = "not sent"
_PARAMETER = re.compile(r"\b[A-Z][A-Za-z0-9]*_\w+\b")


def param_rows(terms: Terms) -> Iterator[Row]:
    """Every parameter that matters, then the calibration, then what full stick means here."""
    left = list(terms.sentences())
    for name, should_be in terms.profile.wanted_params(terms.values, terms.context):
        about = [each for each in left if re.search(rf"\b{name}\b", each.text)]
        left = [each for each in left if each not in about]
        verdicts = [each.verdict for each in about]
        yield _row(
            name,
            _found(terms, name),
            should_be,
            "no-go" if "no-go" in verdicts else "warn" if about else "go",
            "; ".join(each.text for each in about),
        )
    for verdict, text in left:
        named = _PARAMETER.search(text)
        yield _row(named[0] if named else "settings", "see below", "", verdict, text)
    yield from _calibration_rows(terms)
    yield from _curve_rows(terms)
    yield from _thrust_rows(terms)


def _found(terms: Terms, name: str) -> str:
    read, flown = terms.read.get(name), terms.values.get(name)
    if flown is None:
        return _NOT_SENT
    if read == flown:
        return f"{flown:g}"
    return f"{_NOT_SENT if read is None else f'{read:g}'}; --set makes it {flown:g}"


def _calibration_rows(terms: Terms) -> Iterator[Row]:
    """The four channels of overrides; a calibration that cannot be used is a sentence already."""
    calibration = terms.calibration
    if terms.context.output != "rc-override" or calibration is None:
        return
    for stick, channel in zip(Sticks._fields, calibration.channels, strict=True):
        yield _row(f"RC{channel.number} {stick}", _channel(channel), "a calibrated radio")


def _channel(channel: RcChannel) -> str:
    turned = ", reversed" if channel.is_reversed else ""
    ends = f"{channel.min_us}, {channel.trim_us}, {channel.max_us} us"
    return f"{ends}, dead zone {channel.dead_zone_us}{turned}"


def _curve_rows(terms: Terms) -> Iterator[Row]:
    """Motion at full stick, beside what it was in the policy's training."""
    gains, mode = terms.gains, terms.mode
    if gains is None or mode is None or not terms.is_sticks:
        return
    curves = terms.profile.stick_curves(terms.values, mode, gains)
    if (
        curves is IDENTITY
    ):  # the very object that stands for a mode whose sticks mean something else
        yield _row("sticks", f"sent as they are in {mode}", "a mode in which they are mapped")
        return
    if curves.is_identity and curves.notes:
        yield _row("sticks", "not mapped", "mapped", "warn", "; ".join(curves.notes))
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
        note = next((text for text in curves.notes if text.startswith(f"full {noun} ")), "")
        found = f"{trained:.3g} {unit}, as in training"
        if half is not None:
            found = f"{half.full:.3g} {unit} ({half.parameter})"
            if terms.config.link.raw_sticks:
                note = note or f"--raw-sticks: full {noun} is not what it was in training"
            elif not note:
                found += ", sticks are mapped"
        yield _row(f"full {noun}", found, f"{trained:.3g} {unit}", "warn" if note else "go", note)


def _thrust_rows(terms: Terms) -> Iterator[Row]:
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


def _row(name: str, found: str, expected: str, verdict: Verdict = "go", advice: str = "") -> Row:
    return Row(
        area="parameters",
        name=name,
        found=found,
        expected=expected,
        verdict=verdict,
        advice=advice,
    )
