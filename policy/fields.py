"""Checks of dataclasses by the annotations of their fields; imports nothing heavy."""

from dataclasses import dataclass
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Between:
    """Range of a number, as metadata of a field."""

    low: float
    high: float
    unit: str = ""

    def holds(self, value: object) -> bool:
        """True for a number, not NaN, within the range."""
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and self.low <= value <= self.high  # type: ignore[operator]


def field_kinds(record: type) -> dict[str, tuple[Any, Between | None]]:
    """Return the type of each field of a dataclass, and its range if it has one."""
    kinds: dict[str, tuple[Any, Between | None]] = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        kind, *metadata = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        kinds[name] = kind, next((each for each in metadata if isinstance(each, Between)), None)
    return kinds


def require_fields(record: object, error: type[Exception]) -> None:
    """Raise ``error``, naming the field, if a value does not fit its annotation."""
    for name, (kind, limits) in field_kinds(type(record)).items():
        value = getattr(record, name)
        if (wanted := misfit(value, kind, limits)) is not None:
            raise error(f"{name} must be {wanted}, got {value!r}")


def misfit(value: object, kind: Any, limits: Between | None) -> str | None:
    """Return what a value must be; None if it fits.

    Checks choices, booleans, tuples (not what they hold) and numbers with a range.
    """
    fits, wanted = True, ""
    if get_origin(kind) is Literal:
        fits, wanted = value in get_args(kind), " or ".join(map(repr, get_args(kind)))
    elif kind is bool:
        fits, wanted = isinstance(value, bool), "true or false"
    elif get_origin(kind) is tuple:
        fits, wanted = isinstance(value, tuple), "a list"
    elif limits is not None and kind is int:
        fits = type(value) is int and limits.holds(value)
        wanted = f"an integer in {limits.low}..{limits.high}"
    elif limits is not None:
        fits = limits.holds(value) or (value is None and NoneType in get_args(kind))
        wanted = f"in [{limits.low:g}, {limits.high:g}] {limits.unit}"
    return None if fits else wanted
