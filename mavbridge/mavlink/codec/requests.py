"""What the edge asks of the vehicle, before it is bytes."""

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class AskCommand:
    """COMMAND_LONG."""

    command: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class AskParam:
    """PARAM_REQUEST_READ."""

    name: str


@dataclass(frozen=True, slots=True)
class AskStream:
    """REQUEST_DATA_STREAM."""

    stream: int
    rate_hz: int


Request: TypeAlias = AskCommand | AskParam | AskStream
