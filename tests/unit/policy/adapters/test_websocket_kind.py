from pathlib import Path
from typing import Any

import pytest

from mavbridge.commands.config import ServeConfig
from mavbridge.config.policy import PolicyConfig
from policy.adapters.websocket import kind
from policy.adapters.websocket.kind import check_server
from policy.errors import MavbridgeError, PolicyError
from policy.loading.load import check_request
from policy.loading.request import PolicyRequest


@pytest.mark.parametrize(
    "url",
    [
        "ws://127.0.0.1:8000",
        "ws://[::1]:8000",
        "ws://[fe80::1%lo]:8000",
        "wss://policies.example",
        "ws://gpu:80/path",
    ],
)
def test_addresses_of_servers(url: str) -> None:
    check_server(url, None, None)


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("ws://127.0.0.1", "write ws://HOST:PORT"),
        ("ws:127.0.0.1:8000", "write ws://HOST:PORT"),
        ("ws://:8000", "write ws://HOST:PORT"),
        ("ws://gpu:port", "write ws://HOST:PORT"),
        ("ws://gpu:99999", "write ws://HOST:PORT"),
        ("ws://me:secret@gpu:8000", "leave the name and password out"),
    ],
)
def test_what_is_no_address_is_refused_at_once(url: str, told: str) -> None:
    with pytest.raises(PolicyError, match=told) as refusal:
        check_request(PolicyRequest(spec=url))
    assert "secret" not in str(refusal.value)


def test_flags_that_a_server_does_not_take(tmp_path: Path) -> None:
    url = "ws://127.0.0.1:8000"
    with pytest.raises(PolicyError, match="the server has the weights"):
        check_server(url, None, Path("my.safetensors"))
    with pytest.raises(PolicyError, match=r"--contract .*none\.toml"):
        check_server(url, tmp_path / "none.toml", None)


def test_a_missing_package_is_told_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kind, "find_spec", lambda name: None if name == "msgpack" else object())
    with pytest.raises(PolicyError, match=r"needs msgpack: pip install msgpack"):
        check_server("ws://127.0.0.1:8000", None, None)


@pytest.mark.parametrize("host", ["::1", "[::1]", "fe80::1%eth0", "[fe80::1%eth0]", "localhost"])
def test_an_ipv6_address_to_serve_at_may_have_brackets(host: str) -> None:
    assert ServeConfig(host=host).host == host.strip("[]")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"port": 0}, "port"),
        ({"port": 70_000}, "port"),
        ({"policy": PolicyConfig(dual_rate=True)}, "leave out --dual-rate"),
    ],
)
def test_what_cannot_be_served_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(MavbridgeError, match=told):
        ServeConfig(**changes)
