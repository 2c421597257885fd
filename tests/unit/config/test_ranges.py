"""Every number of a flag or setting has a range, and is refused outside it by its name."""

import inspect
import math
from dataclasses import is_dataclass
from pathlib import Path

import pytest

from mavbridge.commands import config as commands
from mavbridge.config import episodes, flags, flight, policy, rates
from mavbridge.config.flags import Ranged
from mavbridge.core.errors import UserError

CONFIGS = dict.fromkeys(  # each once, in one order for all test processes
    each
    for module in (commands, episodes, flight, policy, rates)
    for _, each in inspect.getmembers(module, is_dataclass)
    if isinstance(each, type) and issubclass(each, Ranged)
)
RANGES = {
    (config, field): (name, limits)
    for config in CONFIGS
    for field, (name, limits) in flags._ranges(config).items()
}
NEEDED = {"out": Path("out"), "start": Path("flight")}


@pytest.mark.parametrize(
    ("config", "field"),
    [pytest.param(*key, id=".".join((key[0].__name__, key[1]))) for key in RANGES],
)
def test_a_number_out_of_range_is_refused_by_its_name(config: type[Ranged], field: str) -> None:
    name, limits = RANGES[config, field]
    needed = {key: NEEDED[key] for key in NEEDED if key in inspect.signature(config).parameters}
    flag = name if "." in name else f"--{name}"
    for value in (limits.low - 1, limits.high + 1, math.nan, math.inf):
        with pytest.raises(UserError, match=f"^{flag} must be between {limits.low:g} and"):
            config(**needed | {field: value})


def test_settings_have_the_names_of_the_file() -> None:
    names = {name for name, _ in RANGES.values()}
    for name in ("limits.stall", "envelope.tilt", "setpoints.yaw_rate", "link.timeout", "gusts"):
        assert name in names
