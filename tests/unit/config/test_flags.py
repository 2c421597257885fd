"""Ranges and defaults of flags, sources of cameras, and rates."""

import inspect
import math
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import pytest

from mavbridge.commands import config as commands
from mavbridge.config import episodes, flags, flight, policy
from mavbridge.config.flags import Ranged
from mavbridge.config.flight import CameraConfig
from mavbridge.config.policy import PolicyConfig, Rates
from mavbridge.core.errors import UserError

CONFIGS = dict.fromkeys(  # each once, in one order for all test processes
    each
    for module in (commands, episodes, flight, policy)
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


@pytest.mark.parametrize(
    ("changes", "steps"),
    [
        ({}, 1),
        ({"policy": "toge:medium"}, 1),
        ({"policy": "toge-rates"}, 1),
        ({"policy": "toge-rates", "num_diffusion_steps": 4}, 4),
        ({"policy": "./mine.py:Mine"}, 10),
    ],
)
def test_default_steps(changes: dict[str, Any], steps: int) -> None:
    assert PolicyConfig(**changes).steps == steps


@pytest.mark.parametrize(
    ("play_s", "is_dual", "asked_hz", "action_hz"),
    [
        (0.0, True, None, 100.0),
        (0.0, False, None, 30.0),
        (0.4, True, None, 5.0),
        (2.0, False, None, 1.0),
        (60.0, False, None, 0.5),
        (0.01, False, None, 30.0),
        (0.4, True, 50.0, 50.0),
        (0.0, True, 0.5, 0.5),
    ],
)
def test_a_policy_that_plays_its_chunks_is_solved_twice_for_each(
    play_s: float, is_dual: bool, asked_hz: float | None, action_hz: float
) -> None:
    rates = Rates(rate=asked_hz, action_rate=asked_hz)
    loops = rates.loops(is_dual=is_dual, play_s=play_s)
    assert (loops.action_hz, loops.state_hz) == (action_hz, max(action_hz, 50.0))


def test_a_slow_single_rate_policy_finds_an_image_that_has_just_come() -> None:
    assert Rates(rate=1.0).loops(is_dual=False).vision_hz == 30.0
    assert Rates(rate=100.0).loops(is_dual=False).vision_hz == 100.0


@pytest.mark.parametrize(
    ("given", "cameras", "sources"),
    [
        (("0",), ("front",), ("0",)),
        (("0",), ("anything",), ("0",)),
        (("front=0",), ("front",), ("0",)),
        (("down=/dev/video2", "front=0"), ("front", "down"), ("0", "/dev/video2")),
        (("rtsp://host/live?user=a",), ("front",), ("rtsp://host/live?user=a",)),
        (("front=http://host/?a=b",), ("front",), ("http://host/?a=b",)),
        (("./a=b.mp4",), ("front",), ("./a=b.mp4",)),
        (("screen:A=B",), ("front",), ("screen:A=B",)),
        (("pipe:sh -c 'a\nb=c'",), ("front",), ("pipe:sh -c 'a\nb=c'",)),
        (("down=pipe:a\nb", "front=0"), ("front", "down"), ("0", "pipe:a\nb")),
    ],
)
def test_each_camera_of_the_policy_gets_its_source(
    given: tuple[str, ...], cameras: tuple[str, ...], sources: tuple[str, ...]
) -> None:
    assert CameraConfig(camera=given).sources_of(cameras) == sources


@pytest.mark.parametrize(
    ("given", "cameras"),
    [
        (("0",), ("front", "down")),
        (("front=0",), ("front", "down")),
        (("front=0", "up=1"), ("front", "down")),
        (("front=0", "down=1"), ("front",)),
        (("down=1",), ("front",)),
    ],
)
def test_names_that_the_policy_does_not_have_are_refused(
    given: tuple[str, ...], cameras: tuple[str, ...]
) -> None:
    wanted = " ".join(f"--camera {name}=SOURCE" for name in cameras)
    with pytest.raises(UserError, match=f"--camera {' '.join(given)}: .*give {wanted}$"):
        CameraConfig(camera=given).sources_of(cameras)


@pytest.mark.parametrize("given", [("0", "1"), ("0", "down=1"), ("a=0", "a=1")])
def test_several_cameras_have_different_names(given: tuple[str, ...]) -> None:
    with pytest.raises(UserError, match="each has a name of its own"):
        CameraConfig(camera=given)


def test_an_empty_list_of_cameras_is_refused() -> None:
    with pytest.raises(UserError, match="an empty list: name a camera"):
        CameraConfig(camera=())
