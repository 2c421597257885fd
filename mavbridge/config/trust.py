"""What a settings file may ask for by itself: it may be a stranger's.

It decides how the vehicle is flown, with the addresses of the vehicle and its cameras. It starts no
program, sends no image to another computer, opens no port to one, and writes nothing outside the
working directory: that has to be on the command line, where somebody has read it.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

_DATA_KINDS = ("toge", "toge-rates", "resnet-unet", "scripted", "lerobot", "onnx")
_ADDRESS_KEYS = ("serve", "rerun", "host", "ray")
_OUTPUT_KEYS = ("record", "report", "json", "plot", "html", "out", "rerun")
_LOCAL = re.compile(
    r"(?:$|off$|spawn$|/|serial:|udp://:|[\w./-]+\.rrd$"
    r"|(?:connect=)?(?:[\w+]+:)?(?://)?(?:127\.0\.0\.1|localhost|\[?::1\]?)(?::\d+)?(?:[/?]|$))"
)
"""Addresses on this computer."""


def foreign_policy(spec: str) -> str | None:
    """What a policy is beside data that we read; None if it is nothing more."""
    kind = spec.partition(":")[0]
    if kind in ("ws", "wss"):
        return None if _LOCAL.match(spec) else "a server, which would get the images"
    if kind == "torchscript":
        return "a program in TorchScript"
    return None if kind in _DATA_KINDS else "a program in Python"


def untrusted_settings(
    document: Mapping[str, Any], given: Sequence[str]
) -> Iterator[tuple[str, str, str]]:
    """Flag, value and what it names, of all that a file may not ask for.

    ``given``: words of the command line, whose flags stand in place of the file's.
    """
    flags = {word.partition("=")[0] for word in given}
    for keys, value in _leaves(document, ()):
        for key in {key.lstrip("-").replace("_", "-").lower() for key in keys}:
            if f"--{key}" not in flags and (what := _foreign(key, value)) is not None:
                yield f"--{key}", value, what


def _leaves(value: Any, keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from _leaves(each, (*keys, key))
    elif isinstance(value, list):
        for each in value:
            yield from _leaves(each, keys)
    elif isinstance(value, str | int | float):
        yield keys, str(value)


def _foreign(key: str, value: str) -> str | None:
    if key == "policy":
        return foreign_policy(value)
    if key == "camera":
        source = re.sub(r"^[A-Za-z_]\w*=", "", value)
        return "a program" if source.startswith("pipe:") else None
    if key in _ADDRESS_KEYS and not _LOCAL.match(value):
        return "another computer, or a port that is open to others"
    if key in _OUTPUT_KEYS and (value.startswith(("/", "~")) or ".." in Path(value).parts):
        return "a place outside the working directory to write to"
    return None
