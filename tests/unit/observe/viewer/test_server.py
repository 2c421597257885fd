import socket

import pytest

from helpers.network import needs_ipv6
from mavbridge.core.errors import UserError
from mavbridge.core.processes import free_port
from mavbridge.observe.viewer.server import ServeAddress, serve_address


@pytest.mark.parametrize(
    "text", ["9090", "127.0.0.1", "127.0.0.1:", ":9090", "h:0", "h:65535", "h:x", "::1:9090"]
)
def test_what_is_no_address_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UserError, match=r"HOST:PORT, such as 127\.0\.0\.1:9090"):
        serve_address(text)


@pytest.mark.parametrize("distance", [0, 1])
def test_a_port_that_is_taken_is_refused(distance: int) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = server.getsockname()[1]
        with pytest.raises(UserError, match=f"cannot listen on 127.0.0.1 port {taken} "):
            serve_address(f"127.0.0.1:{taken - distance}")


@needs_ipv6
def test_an_ipv6_address() -> None:
    port = free_port(socket.SOCK_STREAM)
    address = serve_address(f"[::1]:{port}")
    assert address == ServeAddress("::1", port)
    assert address.page_url.startswith(f"http://[::1]:{port}/?url=rerun%2Bhttp://")


def test_on_all_interfaces_the_page_names_this_computer_and_we_use_the_loopback() -> None:
    address = ServeAddress("0.0.0.0", 9090)
    assert socket.gethostname() in address.page_url
    assert address.data_url == "rerun+http://127.0.0.1:9091/proxy"
