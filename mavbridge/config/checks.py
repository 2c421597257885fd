"""The range check of numeric settings."""

import math

from mavbridge.core.errors import UserError


def check_range(name: str, value: float, low: float, high: float, unit: str) -> None:
    """Refuse a number outside [low, high], or none at all, naming its flag."""
    if not (math.isfinite(value) and low <= value <= high):
        limits = f"{low:g} and {high:g} {unit}".rstrip()
        raise UserError(f"--{name} must be between {limits}, got {value:g}")
