"""Addresses of a link, in pymavlink's spelling and in MAVSDK's.

    udp:HOST:PORT    udp://HOST:PORT         listen
    udpin:HOST:PORT  udpin://HOST:PORT       listen
    udpout:HOST:PORT udpout://HOST:PORT      send there
    tcp:HOST:PORT    tcp://, tcpout://       connect
    /dev/ttyX,BAUD   serial:///dev/ttyX:BAUD serial port; 57600 baud where none is given

HOST is a name, 192.168.1.9, or an IPv6 address in brackets: ``[::1]``, ``[fe80::1%eth0]``.
Between the slashes of ``udp://`` and ``udpin://`` an empty host is this computer alone; in MAVSDK
it is every network, which is 0.0.0.0 here.
"""

import re
import socket
from ipaddress import ip_address
from typing import NamedTuple, TypeAlias

from mavbridge.core.errors import UserError

FORMS = (
    "udp:HOST:PORT or udpin:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, /dev/ttyX,BAUD; "
    "or MAVSDK's udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT, serial:///dev/ttyX:BAUD"
)
DEFAULT_BAUD = 57600
LOOPBACK = "127.0.0.1"
_HOST_PORT = r"(?:\[([0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*(?:%[^\]\s/]+)?)\]|([^:/\s\[\]]*)):(\d{1,5})"
_KINDS = ("udp", "udpin", "udpout", "tcp", "tcpout")
_NETWORK = re.compile(rf"(?:({'|'.join(_KINDS)}):)?(//)?{_HOST_PORT}/?", re.ASCII)
_BRACKETS = "an IPv6 address goes into brackets, as in udp:[::1]:14550; "
_SERIAL = re.compile(r"(?:serial:(?://)?)?([^,:/]*/(?!/)[^,]+?|COM\d+)(?:,(.*)|:(\d{4,}))?")
"""Any path with a slash: a device may have links elsewhere. Its name may hold colons
(/dev/serial/by-path/...): only four or more digits are a baud rate."""


SocketAddress: TypeAlias = tuple[str, int, *tuple[int, ...]]
"""Numeric host and port, as the ``socket`` module has them; IPv6 adds flow and scope."""


class UdpAddress(NamedTuple):
    """UDP address to listen on or to send to."""

    host: str
    port: int
    listens: bool
    """True: ``host`` is a local address. False: it is the peer's."""


class TcpAddress(NamedTuple):
    """TCP server to connect to."""

    host: str
    port: int


class SerialAddress(NamedTuple):
    """A serial port."""

    device: str
    baud: int


LinkAddress: TypeAlias = UdpAddress | TcpAddress | SerialAddress


def parse_address(spec: str) -> LinkAddress:
    """Parse the address of ``--connect`` without looking up any name; raise UserError.

    A bare HOST:PORT listens, as in pymavlink.
    """
    if (serial := _serial(spec)) is not None:
        return serial
    found = _network(spec)
    if found is None:
        hint = _BRACKETS if "::" in spec and "[" not in spec else ""
        if spec.startswith("tcpin:"):
            hint = "mavbridge connects, and does not listen on TCP; "
        raise UserError(f"--connect {spec!r} is not understood: {hint}use {FORMS}")
    kind, host, port = found
    if kind in ("tcp", "tcpout"):
        return TcpAddress(host, port)
    return UdpAddress(host, port, listens=kind != "udpout")


def is_reachable(spec: str) -> bool:
    """Return True if the address of ``--connect`` is not confined to this computer."""
    address = parse_address(spec)
    if isinstance(address, SerialAddress):
        return False
    return not is_local(address.host)


def is_local(host: str) -> bool:
    """Return True for ``localhost`` and addresses of the loopback interface."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def host_port(text: str) -> tuple[str, int] | None:
    """Parse HOST:PORT, with an IPv6 address in brackets; return None for anything else."""
    match = re.fullmatch(_HOST_PORT, text, re.ASCII)
    if match is None or not 0 < (port := int(match[3])) < 65536:
        return None
    host: str = match[1] or match[2]
    return (host, port) if host else None


def spelled(host: str, port: int, *scope: int) -> str:
    """Format HOST:PORT as ``host_port`` parses it; takes the items of a ``SocketAddress``, too."""
    zone = f"%{scope[-1]}" if scope and scope[-1] and "%" not in host else ""
    return f"[{host}{zone}]:{port}" if ":" in host else f"{host}:{port}"


def resolve(host: str, port: int) -> SocketAddress:
    """Resolve a host, preferring IPv4, or raise UserError. Call once: a resolver may block."""
    try:
        found = [entry[4] for entry in socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)]
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such name"
        raise UserError(f"cannot find host {host!r}: {reason}") from error
    name, number, *scope = min(found, key=len)
    return (str(name), int(number), *scope)


def family(address: SocketAddress) -> socket.AddressFamily:
    """Return the socket family of this address."""
    return socket.AF_INET if len(address) == 2 else socket.AF_INET6


def serial_baud(spec: str) -> int | None:
    """Return the baud rate of a serial address; None if it is not serial."""
    serial = _serial(spec)
    return None if serial is None else serial.baud


def _serial(spec: str) -> SerialAddress | None:
    match = _SERIAL.fullmatch(spec)
    if match is None:
        return None
    device, after_comma, after_colon = match.groups()
    baud = after_comma if after_comma is not None else after_colon or str(DEFAULT_BAUD)
    if not (baud.isascii() and baud.isdigit() and 0 < int(baud) < 2**31):
        raise UserError(f"--connect {spec}: {baud!r} is not a baud rate; use {FORMS}")
    return SerialAddress(device, int(baud))


def _network(spec: str) -> tuple[str, str, int] | None:
    """Return kind (empty if not given), host and port; None for anything else."""
    match = _NETWORK.fullmatch(spec)
    if match is None or not 0 < (port := int(match[5])) < 65536:
        return None
    kind, is_url, host = match[1] or "", match[2], match[3] or match[4]
    if (is_url and not kind) or host in _KINDS:
        return None
    if not host and is_url and kind in ("udp", "udpin"):
        host = LOOPBACK
    return (kind, host, port) if host else None
