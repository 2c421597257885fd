"""``mavbridge serve`` from its flags to its end."""

import asyncio
import math
import os
import signal
from contextlib import ExitStack, suppress
from dataclasses import replace
from ipaddress import ip_address

from rich.console import Console
from rich.text import Text

from mavbridge.commands.serve.answers import AnswerLoop
from mavbridge.commands.serve.config import ServeConfig
from mavbridge.commands.serve.server import PolicyServer
from mavbridge.core.address import spelled
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.workers import Worker
from mavbridge.flight.policies import check_configured_policy, load_configured_policy
from policy.contract import Contract
from policy.foreign.websocket.link import API_KEY_VARIABLE

LOOK_S = 0.5
"""Between two looks whether the policy's thread is alive."""
JOIN_S = 2.0


def serve(config: ServeConfig) -> int:
    """Serve a policy until a signal comes.

    Raises:
        MavbridgeError: the policy cannot be loaded, or the address cannot be listened at.
    """
    policy_config = replace(config.policy, dual_rate=False)
    check_configured_policy(policy_config)
    console, clock = Console(highlight=False), MonotonicClock()
    with ExitStack() as stack:
        loaded = stack.enter_context(load_configured_policy(policy_config, clock))
        for note in loaded.notes:
            console.print(Text(note, style="yellow"))
        answers = AnswerLoop(loaded.executable, clock=clock)
        server = PolicyServer(
            answers,
            image_bytes=_image_bytes(loaded.executable.contract),
            api_key=os.environ.get(API_KEY_VARIABLE) or None,
            report=lambda line: console.print(Text(line)),
        )
        policy = Worker("mavbridge-policy", answers.run)
        stack.callback(policy.join, JOIN_S)
        policy.start()
        asyncio.run(_serve(config, server, policy, console))
    return 0


async def _serve(
    config: ServeConfig, server: PolicyServer, policy: Worker, console: Console
) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    listener = await server.listen(config.host, config.port)
    console.print(Text(f"serving {config.policy.policy} at {_url(config)}; Ctrl-C ends it"))
    for line in _warnings(config):
        console.print(Text(line, style="yellow"))
    while not stop.is_set() and policy.is_alive:
        with suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), LOOK_S)
    listener.close()
    with suppress(TimeoutError):  # a solve that hangs is the policy thread's to report
        await asyncio.wait_for(listener.wait_closed(), JOIN_S)


def _warnings(config: ServeConfig) -> list[str]:
    """What the user should know who listens to other computers."""
    try:
        is_local = config.host == "localhost" or ip_address(config.host).is_loopback
    except ValueError:
        is_local = False
    if is_local:
        return []
    has_key = bool(os.environ.get(API_KEY_VARIABLE))
    who = (
        "every computer that reaches it and has the API key"
        if has_key
        else f"every computer that reaches it: set {API_KEY_VARIABLE} on both sides to keep "
        "strangers out"
    )
    return [f"warning: {config.host} is open to {who}; nothing is encrypted"]


def _url(config: ServeConfig) -> str:
    return f"ws://{spelled(config.host, config.port)}"


def _image_bytes(contract: Contract) -> int:
    return math.prod(contract.image_shape)
