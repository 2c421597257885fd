"""Checks and loading of ``--policy ws://HOST:PORT``.

msgpack and websockets are an extra; only loading such a policy imports them.
"""

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from policy.adapters.interface import Interface, read_interface, read_tables
from policy.contract import LIMIT_TERMS, Contract
from policy.errors import ContractError, PolicyError, require_packages
from policy.files import parse_object

if TYPE_CHECKING:
    from policy.adapters.websocket.messages import Message
    from policy.adapters.websocket.remote_policy import RemotePolicy

SCHEMES = ("ws", "wss")
PACKAGES = ("msgpack", "websockets")
"""Packages of the extra ``remote``."""

TERMS = {"play_s", "modes", *LIMIT_TERMS}
"""Contract fields of mavbridge's own server that a contract file may replace: flight terms."""


def check_server(url: str, contract_file: Path | None, checkpoint: Path | None) -> None:
    """Raise PolicyError for an unusable address, contract file or flag; takes milliseconds."""
    require_packages(f"--policy {url}", *PACKAGES)
    try:
        parts = urlsplit(url)
        is_good = bool(parts.hostname) and (parts.port is not None or parts.scheme == "wss")
    except ValueError:
        is_good = False
    if not is_good:
        raise PolicyError(f"--policy {url}: write ws://HOST:PORT, as in ws://127.0.0.1:8000")
    if parts.username is not None or parts.password is not None:
        raise PolicyError("--policy: leave the name and password out of the address")
    if checkpoint is not None:
        raise PolicyError(
            f"--policy {url}: the server has the weights; leave out --checkpoint {checkpoint}"
        )
    if contract_file is not None:
        read_tables(contract_file)  # only the server knows which values are right


def load_server_policy(url: str, contract_file: Path | None) -> tuple["RemotePolicy", list[str]]:
    """Connect to a policy server, find its contract and try it; return lines for the user too."""
    from policy.adapters.websocket.messages import CONTRACT_KEY
    from policy.adapters.websocket.remote_policy import API_KEY_VARIABLE, RemotePolicy, ServerLink

    link = ServerLink(url, api_key=os.environ.get(API_KEY_VARIABLE))
    try:
        metadata = link.connect()
        interface = _interface(contract_file, metadata)
        keys = [*interface.camera_keys, interface.state_key, *["prompt"] * bool(interface.prompt)]
        if len(set(keys)) < len(keys):
            raise ContractError(f"several inputs would have one key: {', '.join(keys)}")
        policy = RemotePolicy(link, interface, is_ours=CONTRACT_KEY in metadata)
        return policy, [policy.try_out()]
    except PolicyError as error:
        link.close()
        told = str(error)
        raise PolicyError(told if url in told else f"--policy {url}: {told}") from error
    except BaseException:
        link.close()
        raise


def _interface(contract_file: Path | None, metadata: "Message") -> Interface:
    """Return the contract of ``mavbridge serve`` under the file's terms, or the file's own with
    the fields that the server knows."""
    from policy.adapters.websocket.messages import CONTRACT_KEY, FIELDS_KEY

    served = _json_text(metadata, CONTRACT_KEY)
    if served is None:
        if contract_file is not None:
            text = _json_text(metadata, FIELDS_KEY) or "{}"
            return read_interface(contract_file, parse_object(text, ContractError, FIELDS_KEY))
        raise PolicyError(
            "the server does not say its rate nor what its state and actions mean: write that in a "
            "file, and give --contract FILE; docs/policy_server.md has an example"
        )
    try:
        contract = replace(Contract.from_json(served), arrays="numpy", feature_dim=0)
    except ContractError as error:
        raise ContractError(f"the server's contract cannot be used: {error}") from error
    if contract_file is None:
        return Interface(contract=contract)
    file = read_tables(contract_file)
    said = file.pop("contract", {})
    if file:
        raise ContractError(
            f"--contract {contract_file}: leave out [{'], ['.join(file)}]: the server announces "
            "its contract, and converts state, actions and images itself"
        )
    freed = said.keys() & TERMS
    names = [field.name for field in fields(Contract) if field.init and field.name not in freed]
    return read_interface(contract_file, {name: getattr(contract, name) for name in names})


def _json_text(metadata: "Message", key: str) -> str | None:
    """Return a JSON text of the server's metadata; None if it is not there."""
    if isinstance(text := metadata.get(key), str | None):
        return text
    raise ContractError(f"the server's {key} must be JSON as text, got a {type(text).__name__}")
