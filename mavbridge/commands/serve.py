"""``mavbridge serve``: a policy on this computer for flights and robots elsewhere.

The websocket protocol of openpi, on an event loop; one thread calls the policy.
"""

import asyncio
import hmac
import http
import logging
import math
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace

from websockets.asyncio.server import Server, ServerConnection
from websockets.asyncio.server import serve as serve_websockets
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from mavbridge.commands.config import ServeConfig
from mavbridge.core.address import is_local, spelled
from mavbridge.core.clock import NS_PER_MS, Clock, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import stop_signals
from mavbridge.flight.policies import load_configured_policy, policy_request
from mavbridge.observe.output import patient_console
from mavbridge.observe.terminal import MessageScreen
from policy.adapters.interface import Interface
from policy.adapters.websocket.messages import (
    CONTRACT_KEY,
    RESET_KEY,
    MessageError,
    from_message,
    pack,
    unpack,
)
from policy.adapters.websocket.remote_policy import ACTIONS_KEY, API_KEY_VARIABLE
from policy.errors import PolicyError
from policy.loading.load import check_request
from policy.protocol import PolicyRunner

MAX_CLIENTS = 4
SPARE_BYTES = 2**20
"""Size limit of a request without its images [bytes]."""
PING_S = 5.0
"""Ping period. A client that is silent for two or three periods is gone, and its slot is free."""
CLOSE_S = 1.0
HEALTH_PATH = "/healthz"
JOIN_S = 2.0


class PolicyServer:
    """Greets clients, checks their key, and answers their requests one after the other."""

    def __init__(
        self,
        runner: PolicyRunner,
        *,
        clock: Clock,
        api_key: str | None,
        report: Callable[[str], None],
    ) -> None:
        """``api_key`` None admits all that reach this computer. ``report`` must not block."""
        self._runner = runner
        self._clock = clock
        self._interface = Interface(contract=runner.contract)
        pixel_bytes = 4 if runner.contract.is_depth else 1
        self._max_bytes = pixel_bytes * math.prod(runner.contract.image_shape) + SPARE_BYTES
        self._api_key = api_key
        self._report = report
        self._clients = 0
        # One only if the policy has state: two flights would share it.
        self._max_clients = 1 if runner.has_state else MAX_CLIENTS
        self._policy = ThreadPoolExecutor(1, "mavbridge-policy")
        self.ended: Future[None] = Future()
        """Done once ``end`` was called; holds an error of the policy that is a bug."""

    def end(self) -> None:
        """Tell those who wait for ``ended`` to stop serving."""
        if not self.ended.done():
            self.ended.set_result(None)

    def close(self) -> None:
        """Wait for the last call of the policy."""
        self._policy.shutdown(cancel_futures=True)

    def _answer(self, request: bytes | str) -> bytes | str:
        """Return a chunk as msgpack, or a text that describes the request's or policy's error."""
        begun_ns = self._clock.now_ns()
        try:
            message = unpack(request)
            image, state, history = from_message(self._interface, message)
            begins = message.get(RESET_KEY, False)
            if not isinstance(begins, bool):
                raise MessageError(f"{RESET_KEY!r} must be true or false, got {begins!r:.60}")
            if begins:
                self._runner.reset()
            chunk = self._runner.act(image, state, history)
        except PolicyError as error:
            return str(error)
        took_ms = (self._clock.now_ns() - begun_ns) / NS_PER_MS
        return pack({ACTIONS_KEY: chunk[0], "server_timing": {"infer_ms": took_ms}})

    async def listen(self, host: str, port: int) -> Server:
        """Start listening."""
        # It would print a traceback for every unknown client that probes the port.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        try:
            return await serve_websockets(
                self._talk,
                host,
                port,
                compression=None,
                max_size=self._max_bytes,
                process_request=self._admit,
                ping_interval=PING_S,
                ping_timeout=2 * PING_S,
                close_timeout=CLOSE_S,
            )
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(
                f"--host {host} --port {port}: cannot listen there: {reason}"
            ) from error

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse clients without the key, and web pages, the only clients that send an origin.

        A request that only asks for the health of the server is answered.
        """
        if origins := request.headers.get_all("Origin"):
            self._report(f"{_name(connection)} was refused: a web page of {origins[0][:60]!r}")
            return connection.respond(http.HTTPStatus.FORBIDDEN, "this serves no web pages\n")
        if request.path == HEALTH_PATH:
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        given, key = request.headers.get_all("Authorization"), f"Api-Key {self._api_key}".encode()
        is_single = len(given) == 1
        if self._api_key is None or (is_single and hmac.compare_digest(given[0].encode(), key)):
            return None
        self._report(f"{_name(connection)} was refused: it has not the API key")
        return connection.respond(http.HTTPStatus.UNAUTHORIZED, "the API key is missing or wrong\n")

    async def _talk(self, connection: ServerConnection) -> None:
        if self._clients == self._max_clients:
            reason = f"all {self._clients} connections are in use"
            await connection.close(CloseCode.TRY_AGAIN_LATER, reason)
            return
        self._clients += 1
        self._report(f"{_name(connection)} has connected")
        loop, contract = asyncio.get_running_loop(), self._runner.contract.to_json()
        try:
            await connection.send(pack({CONTRACT_KEY: contract, "policy": self._runner.name}))
            async for request in connection:
                await connection.send(
                    await loop.run_in_executor(self._policy, self._answer, request)
                )
        except ConnectionClosed:
            pass
        except Exception as error:
            if not self.ended.done():
                self.ended.set_exception(error)
            raise
        finally:
            self._clients -= 1
            self._report(f"{_name(connection)} has gone")


def _name(connection: ServerConnection) -> str:
    address = connection.remote_address
    return f"client {spelled(*address)}" if address else "a client"


def serve(config: ServeConfig) -> int:
    """Serve a policy until a signal comes."""
    policy_config = replace(config.policy, dual_rate=False)
    check_request(policy_request(policy_config))
    screen, clock = MessageScreen(patient_console(stderr=False)), MonotonicClock()
    with ExitStack() as stack:
        loaded = stack.enter_context(load_configured_policy(policy_config, clock))
        stack.callback(screen.close, JOIN_S)
        screen.start()
        for note in loaded.notes:
            screen.show_message(note, "yellow")
        server = PolicyServer(
            loaded.runner,
            clock=clock,
            api_key=os.environ.get(API_KEY_VARIABLE) or None,
            report=screen.show_message,
        )
        stack.callback(server.close)
        asyncio.run(_serve(config, server, screen))
    return 0


async def _serve(config: ServeConfig, server: PolicyServer, screen: MessageScreen) -> None:
    for number in stop_signals():
        asyncio.get_running_loop().add_signal_handler(number, server.end)
    listener = await server.listen(config.host, config.port)
    url = f"ws://{spelled(config.host, config.port)}"
    screen.show_message(f"serving {config.policy.policy} at {url}; Ctrl-C ends it")
    if not is_local(config.host):
        who = "every computer that reaches it"
        if os.environ.get(API_KEY_VARIABLE):
            who += " and has the API key"
        else:
            who += f": set {API_KEY_VARIABLE} on both sides to keep strangers out"
        told = f"warning: {config.host} is open to {who}; nothing is encrypted"
        screen.show_message(told, "yellow")
    try:
        await asyncio.wrap_future(server.ended)
    finally:
        listener.close()
        with suppress(TimeoutError):  # of a client whose solve goes on
            await asyncio.wait_for(listener.wait_closed(), JOIN_S)
