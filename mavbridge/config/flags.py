"""Groups, hidden settings and ranges of flags."""

import math
from typing import get_type_hints

from cyclopts import Group, Parameter

from mavbridge.core.errors import UserError
from policy.fields import Between


def check_range(name: str, value: float | None, low: float, high: float, unit: str) -> None:
    """Raise UserError, naming the flag or setting, if a given number is not within [low, high]."""
    if value is not None and not (math.isfinite(value) and low <= value <= high):
        limits = f"{low:g} and {high:g} {unit}".rstrip()
        flag = name if "." in name else f"--{name}"
        raise UserError(f"{flag} must be between {limits}, got {value:g}")


class Ranged:
    """Base of dataclasses of flags: refuses numbers out of the ranges of their fields."""

    def __post_init__(self) -> None:
        """Raise UserError, naming the flag or setting, for a number out of its range."""
        for field, (name, limits) in _ranges(type(self)).items():
            check_range(name, getattr(self, field), limits.low, limits.high, limits.unit)


def _ranges(config: type) -> dict[str, tuple[str, Between]]:
    """Return the flag or ``section.key``, and the range, of each field that has one."""
    shared = config.__cyclopts__.parameters[-1]  # type: ignore[attr-defined]
    found = {}
    for field, hint in get_type_hints(config, include_extras=True).items():
        metadata = getattr(hint, "__metadata__", ())
        limits = next((each for each in metadata if isinstance(each, Between)), None)
        if limits is None:
            continue
        named = [
            name for each in metadata if isinstance(each, Parameter) for name in each.name or ()
        ]
        if named:
            name = named[0].removeprefix("--").replace("-", "_")
        elif shared.name[0] != "*":  # a section
            name = f"{shared.name[0]}.{shared.name_transform(field)}".replace("-", "_")
        else:
            name = field.replace("_", "-")
        found[field] = name, limits
    return found


VEHICLE = Group("Vehicle", sort_key=1)
ENGAGING = Group("Engaging and releasing", sort_key=1.5)
POLICY = Group("Policy", sort_key=2)
CAMERA = Group("Camera", sort_key=3)
OUTPUT = Group("Output", sort_key=4)
RATES = Group("Rates", sort_key=5)
RARE = Group("Rarely needed", sort_key=9)


def section(name: str) -> Parameter:
    """Make a dataclass a section of ``--config``: its fields do not appear in the help."""

    def key(field: str) -> str:
        return field.removeprefix("max_").removeprefix("setpoint_").replace("_", "-")

    return Parameter(name=name, show=False, name_transform=key)


def hidden(key: str) -> Parameter:
    """Make a field a key in a section of ``--config``; it does not appear in the help."""
    return Parameter(name=f"--{key}", negative="", show=False)
