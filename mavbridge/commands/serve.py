"""``mavbridge serve``: a policy on this computer for flights and robots elsewhere.

Consists of the answering thread, the network side (the websocket protocol of openpi), and the
command.
"""

import asyncio
import hmac
import http
import logging
import math
import os
import queue
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from dataclasses import replace

from rich.console import Console
from rich.text import Text
from websockets.asyncio.server import Server, ServerConnection
from websockets.asyncio.server import serve as serve_websockets
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from mavbridge.commands.config import ServeConfig
from mavbridge.core.address import is_local, spelled
from mavbridge.core.clock import NS_PER_MS, Clock, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.workers import Worker
from mavbridge.flight.policies import check_configured_policy, load_configured_policy
from policy.adapters.interface import Interface
from policy.adapters.websocket.link import API_KEY_VARIABLE
from policy.adapters.websocket.messages import CONTRACT_KEY, RESET_KEY, from_message, pack, unpack
from policy.adapters.websocket.remote_policy import ACTIONS_KEY
from policy.errors import PolicyError
from policy.protocol import PolicyRunner, keep_nothing

MAX_CLIENTS = 4
WAIT_S = 0.1
"""Longest wait for a request before the stop flag is checked."""
SPARE_BYTES = 2**20
"""Size limit of a request without its images [bytes]."""
PING_S = 5.0
"""Ping period. A client that is silent for two or three periods is gone, and its slot is free."""
CLOSE_S = 1.0
UNASKED_S = 5.0
"""A client without a request after this time gives up its slot if another client comes."""
HEALTH_PATH = "/healthz"
LOOK_S = 0.5
"""Interval between two checks that the policy's thread is alive."""
JOIN_S = 2.0


class AnswerLoop:
    """Answers one request after the other. Only its own thread calls the policy."""

    def __init__(self, runner: PolicyRunner, *, clock: Clock) -> None:
        """``runner`` is single-rate."""
        self._runner = runner
        self._interface = Interface(contract=runner.contract)
        self._clock = clock
        self.max_clients = MAX_CLIENTS if runner.reset is keep_nothing else 1
        """One client only if the policy has state: two flights would share it."""
        self._jobs: queue.Queue[tuple[bytes | str, Future[bytes | str]]] = queue.Queue(
            self.max_clients
        )

    @property
    def metadata(self) -> bytes:
        """First message to every client."""
        return pack({CONTRACT_KEY: self._runner.contract.to_json(), "policy": self._runner.name})

    def submit(self, request: bytes | str) -> Future[bytes | str]:
        """Queue a request; raise queue.Full if the queue is full.

        Return a future for the answer: bytes, or the text of an error.
        """
        answer: Future[bytes | str] = Future()
        self._jobs.put_nowait((request, answer))
        return answer

    def run(self, stop: threading.Event) -> None:
        """Answer until told to stop."""
        while not stop.is_set():
            try:
                request, answer = self._jobs.get(timeout=WAIT_S)
            except queue.Empty:
                continue
            if answer.set_running_or_notify_cancel():
                answer.set_result(self.answer(request))

    def answer(self, request: bytes | str) -> bytes | str:
        """Return a chunk as msgpack, or a text that describes the request's or policy's error."""
        begun_ns = self._clock.now_ns()
        try:
            message = unpack(request)
            image, state, history = from_message(self._interface, message)
            if message.get(RESET_KEY):
                self._runner.reset()
            chunk = self._runner.act(image, state, history)
        except PolicyError as error:
            return str(error)
        took_ms = (self._clock.now_ns() - begun_ns) / NS_PER_MS
        return pack({ACTIONS_KEY: chunk[0], "server_timing": {"infer_ms": took_ms}})


class PolicyServer:
    """Greets clients, checks their key, and passes their requests to the policy's thread."""

    def __init__(
        self,
        answers: AnswerLoop,
        *,
        image_bytes: int,
        api_key: str | None,
        report: Callable[[str], None],
    ) -> None:
        """Prepare; nothing listens yet.

        Args:
            answers: its thread runs while clients are served.
            image_bytes: size of the images of one request; larger requests are refused.
            api_key: key required of clients; None admits all that reach this computer.
            report: gets a line for each client that connects or leaves.
        """
        self._answers = answers
        self._max_bytes = image_bytes + SPARE_BYTES
        self._api_key = api_key
        self._report = report
        self._clients = 0
        self._unasked: dict[ServerConnection, float] = {}
        """Clients without a request so far, with the time of their connection."""

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
        given = request.headers.get("Authorization", "")
        if self._api_key is None or hmac.compare_digest(
            given.encode(), f"Api-Key {self._api_key}".encode()
        ):
            return None
        self._report(f"{_name(connection)} was refused: it has not the API key")
        return connection.respond(http.HTTPStatus.UNAUTHORIZED, "the API key is missing or wrong\n")

    async def _talk(self, connection: ServerConnection) -> None:
        if self._clients == self._answers.max_clients:
            await self._make_room()
        if self._clients == self._answers.max_clients:
            reason = f"the most are served already: {self._clients}"
            await connection.close(CloseCode.TRY_AGAIN_LATER, reason)
            return
        self._clients += 1
        self._unasked[connection] = asyncio.get_running_loop().time()
        self._report(f"{_name(connection)} has connected")
        try:
            with suppress(ConnectionClosed):
                await connection.send(self._answers.metadata)
                async for request in connection:
                    self._unasked.pop(connection, None)
                    # One at a time from each client, so that the queue has room for all.
                    answer = self._answers.submit(request)
                    reply: bytes | str = await asyncio.wrap_future(answer)
                    await connection.send(reply)
        finally:
            self._clients -= 1
            self._unasked.pop(connection, None)
            self._report(f"{_name(connection)} has gone")

    async def _make_room(self) -> None:
        """Disconnect clients that hold a slot without requests."""
        latest = asyncio.get_running_loop().time() - UNASKED_S
        idle = [each for each, came in self._unasked.items() if came < latest]
        for each in idle:
            await each.close(CloseCode.TRY_AGAIN_LATER, "it has asked for nothing, and others wait")
        await asyncio.sleep(0)  # let their tasks end


def _name(connection: ServerConnection) -> str:
    address = connection.remote_address
    return f"client {spelled(*address)}" if address else "a client"


def serve(config: ServeConfig) -> int:
    """Serve a policy until a signal comes."""
    policy_config = replace(config.policy, dual_rate=False)
    check_configured_policy(policy_config)
    console, clock = Console(highlight=False), MonotonicClock()
    with ExitStack() as stack:
        loaded = stack.enter_context(load_configured_policy(policy_config, clock))
        for note in loaded.notes:
            console.print(Text(note, style="yellow"))
        answers = AnswerLoop(loaded.runner, clock=clock)
        server = PolicyServer(
            answers,
            image_bytes=math.prod(loaded.runner.contract.image_shape),
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
    url = f"ws://{spelled(config.host, config.port)}"
    console.print(Text(f"serving {config.policy.policy} at {url}; Ctrl-C ends it"))
    if not is_local(config.host):
        who = "every computer that reaches it"
        if os.environ.get(API_KEY_VARIABLE):
            who += " and has the API key"
        else:
            who += f": set {API_KEY_VARIABLE} on both sides to keep strangers out"
        told = f"warning: {config.host} is open to {who}; nothing is encrypted"
        console.print(Text(told, style="yellow"))
    while not stop.is_set() and policy.is_alive:
        with suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), LOOK_S)
    listener.close()
    with suppress(TimeoutError):  # a hung solve is for the policy thread to report
        await asyncio.wait_for(listener.wait_closed(), JOIN_S)
