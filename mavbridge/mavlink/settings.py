"""Settings of the link, without the command line that they come from."""

from dataclasses import dataclass

from mavbridge.core.vehicle import Output


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """The vehicle and how to reach it."""

    connect: str = ""
    """udp:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, /dev/ttyX,BAUD."""
    source_system: int = 255
    """Our MAVLink system id."""
    target_system: int = 0
    """System id of the vehicle to fly; 0 = the only one on the link."""
    connect_timeout_s: float = 30.0
    """Longest wait for the vehicle's first heartbeat."""
    output: Output = "rc-override"
    readonly: bool = False
    """Receive and set up streams; send no stick, mode or arm command."""
    state_hz: float = 100.0
    """Rate of attitude, velocity and acceleration to ask the vehicle for."""
