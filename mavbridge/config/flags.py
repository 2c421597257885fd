"""Groups, hidden settings and range checks of flags."""

import math

from cyclopts import Group, Parameter

from mavbridge.core.errors import UserError


def check_range(name: str, value: float | None, low: float, high: float, unit: str) -> None:
    """Raise UserError, naming the flag or setting, if a given number is not within [low, high]."""
    if value is not None and not (math.isfinite(value) and low <= value <= high):
        limits = f"{low:g} and {high:g} {unit}".rstrip()
        flag = name if "." in name else f"--{name}"
        raise UserError(f"{flag} must be between {limits}, got {value:g}")


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
