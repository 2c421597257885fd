"""Every spelling of an address leads to the same place, and anything else to the forms."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.core.address import (
    FORMS,
    LinkAddress,
    SerialAddress,
    TcpAddress,
    UdpAddress,
    host_port,
    is_reachable,
    parse_address,
    resolve,
    serial_baud,
    spelled,
)
from mavbridge.core.errors import UserError

HOSTS = st.one_of(
    st.ip_addresses(v=4).map(str), st.from_regex(r"[a-z][a-z0-9.-]{0,20}[a-z0-9]", fullmatch=True)
).filter(lambda host: host not in ("udp", "tcp", "udpin", "udpout", "tcpout"))
IPV6_HOSTS = st.builds(
    lambda number, zone: f"{number}{zone}",
    st.ip_addresses(v=6),
    st.sampled_from(["", "%eth0", "%2"]),
)
PORTS = st.integers(1, 65535)
DEVICES = st.from_regex(
    r"/dev/[A-Za-z][A-Za-z0-9._-]{0,12}(/[A-Za-z0-9._:-]{1,12})?", fullmatch=True
)


@given(st.one_of(HOSTS, IPV6_HOSTS), PORTS)
def test_both_spellings_of_a_network_address_are_one(bare: str, port: int) -> None:
    host = f"[{bare}]" if ":" in bare else bare
    assert spelled(bare, port) == f"{host}:{port}"
    assert host_port(f"{host}:{port}") == (bare, port)
    for kind, listens in (("udp", True), ("udpin", True), ("udpout", False)):
        expected = UdpAddress(bare, port, listens)
        for spec in (
            f"{kind}:{host}:{port}",
            f"{kind}://{host}:{port}",
            f"{kind}://{host}:{port}/",
        ):
            assert parse_address(spec) == expected
    for spec in (f"tcp:{host}:{port}", f"tcp://{host}:{port}", f"tcpout://{host}:{port}"):
        assert parse_address(spec) == TcpAddress(bare, port)
    assert parse_address(f"{host}:{port}") == UdpAddress(bare, port, True)


@given(DEVICES.filter(lambda name: not name.rpartition(":")[2].isdigit()), st.integers(1, 10**7))
def test_a_serial_port_keeps_its_name_whatever_colons_it_has(device: str, baud: int) -> None:
    specs = [f"{device},{baud}", f"serial://{device},{baud}", f"serial:{device},{baud}"]
    if baud >= 1000:
        specs += [f"serial://{device}:{baud}", f"{device}:{baud}"]
    for spec in specs:
        assert parse_address(spec) == SerialAddress(device, baud)
        assert serial_baud(spec) == baud
    assert parse_address(device) == SerialAddress(device, 57600)


@given(st.text(max_size=30))
def test_whatever_is_written_is_an_address_or_told_the_forms(text: str) -> None:
    try:
        address: LinkAddress = parse_address(text)
    except UserError as refusal:
        told = str(refusal)
    else:
        told = FORMS
        assert isinstance(address, SerialAddress) or 0 < address.port < 65536
    assert FORMS in told


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("udp://:14540", UdpAddress("127.0.0.1", 14540, True)),
        ("udpin://:14540", UdpAddress("127.0.0.1", 14540, True)),
        ("[::1]:14550", UdpAddress("::1", 14550, True)),
        ("udp:[fe80::1%lo]:14550", UdpAddress("fe80::1%lo", 14550, True)),
        ("udpin://[::]:14540", UdpAddress("::", 14540, True)),
        ("udpout:[::ffff:10.0.0.2]:14550", UdpAddress("::ffff:10.0.0.2", 14550, False)),
        ("tcpout://[2001:db8::1]:5760/", TcpAddress("2001:db8::1", 5760)),
        ("COM3,115200", SerialAddress("COM3", 115200)),
        ("COM3:115200", SerialAddress("COM3", 115200)),
        ("/tmp/ttyV0:115200", SerialAddress("/tmp/ttyV0", 115200)),
        ("./tty,115200", SerialAddress("./tty", 115200)),
        ("serial:///run/fc", SerialAddress("/run/fc", 57600)),
        (
            "/dev/serial/by-path/usb-0:1:1.0",
            SerialAddress("/dev/serial/by-path/usb-0:1:1.0", 57600),
        ),
    ],
)
def test_special_spellings(spec: str, expected: LinkAddress) -> None:
    assert parse_address(spec) == expected


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("tcpin:0.0.0.0:5760", "does not listen on TCP"),
        ("udpout://:14540", "not understood"),
        ("udp:14550", "not understood"),
        ("udp:host:70000", "not understood"),
        ("//host:14550", "not understood"),
        ("udp:::1:14550", r"brackets, as in udp:\[::1\]:14550"),
        ("tcp:2001:db8::1:5760", "brackets"),
        ("udp:[::1]", "not understood"),
        ("udp:[host]:14550", "not understood"),
        ("udp:[::1:14550", "not understood"),
        ("/dev/ttyACM0,fast", "not a baud rate"),
        ("/dev/ttyACM0,0", "not a baud rate"),
        ("/dev/ttyACM0,2147483648", "not a baud rate"),
        ("http://host:80", "not understood"),
    ],
)
def test_what_is_none_of_them_is_refused(spec: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        parse_address(spec)


@pytest.mark.parametrize(
    ("host", "address", "shown"),
    [
        ("127.0.0.1", ("127.0.0.1", 14550), "127.0.0.1:14550"),
        ("::1", ("::1", 14550, 0, 0), "[::1]:14550"),
        ("fe80::1%1", ("fe80::1", 14550, 0, 1), "[fe80::1%1]:14550"),
    ],
)
def test_numbers_of_a_host(host: str, address: tuple[str, int], shown: str) -> None:
    assert resolve(host, 14550) == address
    assert spelled(*address) == shown


def test_a_name_with_both_kinds_of_address_is_the_older_kind() -> None:
    """``localhost`` stays 127.0.0.1, where simulators listen."""
    assert resolve("localhost", 14550) == ("127.0.0.1", 14550)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("udp:[::1]:14550", False),
        ("udpout:127.0.0.2:14550", False),
        ("udp:[::]:14550", True),
        ("udpout:[fe80::1%lo]:14550", True),
        ("tcp:127.0.0.1.example.org:5760", True),
    ],
)
def test_who_else_can_send_to_it(spec: str, expected: bool) -> None:
    assert is_reachable(spec) is expected
