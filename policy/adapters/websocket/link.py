"""Connection to a policy server; its own thread reconnects automatically."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidStatus,
    WebSocketException,
)

from policy.adapters.websocket.messages import (
    CONTRACT_KEY,
    FIELDS_KEY,
    Message,
    MessageError,
    unpack,
)
from policy.errors import NoChunkError, PolicyError

API_KEY_VARIABLE = "MAVBRIDGE_API_KEY"
"""Environment variable with the server's API key: flags show in process lists."""
CONNECT_S = 5.0
"""Timeout for a connection, and again for the server's first message."""
LOST_S = 5.0
"""Time without an answer after which the connection is replaced by a new one."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
"""Pause between reconnection attempts: doubled each time, from the first to the longest."""
CLOSE_S, JOIN_S = 1.0, 3.0
MAX_ANSWER_BYTES = 16 * 2**20
UNAUTHORIZED = (401, 403)


class Answer(NamedTuple):
    """Message of the server, and the time from its request to its arrival."""

    data: bytes | str
    round_trip_s: float


@dataclass(frozen=True, slots=True)
class _Request:
    payload: bytes
    patience_s: float
    answer: Future[Answer]


class ServerLink:
    """Sends requests and matches each answer to its request.

    The protocol allows one request in flight. The server still answers a request that was given up:
    that answer is discarded, then the newest request is sent.
    """

    def __init__(self, url: str, *, api_key: str | None) -> None:
        self._url = url
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._metadata: Future[Message] = Future()
        """Metadata of the first connection."""
        self._problem: str | None = None
        """Reason why there is no connection at present."""
        self._next: _Request | None = None
        self._sent: _Request | None = None
        self._pause_s = FIRST_PAUSE_S
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._hold()), name="mavbridge-server-link", daemon=True
        )

    def connect(self) -> Message:
        """Connect for the first time; return the server's metadata."""
        self._thread.start()
        return self._metadata.result(2 * CONNECT_S + CLOSE_S + JOIN_S)

    def ask(self, payload: bytes, timeout_s: float) -> Answer:
        """Send a request and wait for its answer."""
        if self._problem is not None:
            raise NoChunkError(self._problem)
        request = _Request(payload, max(timeout_s, LOST_S), Future())
        self._next = request
        self._call(self._woken.set)
        try:
            return request.answer.result(timeout_s)
        except TimeoutError:
            raise NoChunkError(
                f"the policy server has not answered within {1e3 * timeout_s:.0f} ms"
            ) from None

    def close(self) -> None:
        """Close the connection and end the thread."""
        if self._thread.is_alive():
            self._call(self._task.cancel)
            self._thread.join(JOIN_S)

    def _call(self, function: Callable[[], object]) -> None:
        """Call a function in the event loop's thread; no-op once that thread has ended."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function)

    async def _hold(self) -> None:
        self._loop, self._woken = asyncio.get_running_loop(), asyncio.Event()
        task = asyncio.current_task()
        assert task is not None
        self._task = task
        try:
            await self._connect_again()
        except asyncio.CancelledError:
            self._fail("the connection to the policy server is closed")

    async def _connect_again(self) -> None:
        """Connect, and reconnect after every loss; end if the first connection fails."""
        while True:
            try:
                await self._converse()
            except (OSError, ValueError, WebSocketException, PolicyError) as error:
                self._fail(self._reason(error))
            if self._metadata.exception() is not None:
                return
            await asyncio.sleep(self._pause_s)
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)

    async def _converse(self) -> None:
        """Run one connection, from its first message to its end."""
        async with connect(
            self._url,
            additional_headers=self._headers,
            compression=None,
            max_size=MAX_ANSWER_BYTES,
            open_timeout=CONNECT_S,
            close_timeout=CLOSE_S,
            # openpi's servers do not answer pings while they compute; LOST_S detects a loss.
            ping_interval=None,
            proxy=None,
            # Zone of a link-local address: %eth0, or %25eth0 when URL-encoded.
            host=(urlsplit(self._url).hostname or "").replace("%25", "%"),
        ) as connection:
            try:
                await self._serve_requests(connection)
            except asyncio.CancelledError:
                await connection.close()  # a normal close, not one after an error on our side
                raise

    async def _serve_requests(self, connection: ClientConnection) -> None:
        async with asyncio.timeout(CONNECT_S):
            metadata = unpack(await connection.recv())
        if not self._metadata.done():
            self._metadata.set_result(metadata)
        first = self._metadata.result()
        if any(metadata.get(key) != first.get(key) for key in (CONTRACT_KEY, FIELDS_KEY)):
            raise PolicyError(f"{self._url} serves another policy now: start the flight again")
        self._problem = None
        closing = asyncio.ensure_future(connection.wait_closed())
        closing.add_done_callback(lambda _: self._woken.set())
        while not closing.done():
            await self._woken.wait()
            self._woken.clear()
            if self._next is not None:
                await self._exchange(connection)
        raise PolicyError(f"{self._url} has closed the connection: {connection.close_reason}")

    async def _exchange(self, connection: ClientConnection) -> None:
        request, self._next = self._next, None
        assert request is not None
        self._sent = request
        await self._require_silence(connection)
        async with asyncio.timeout(request.patience_s):
            sent_s = self._loop.time()
            await connection.send(request.payload)
            data = await connection.recv()
        self._sent = None
        self._pause_s = FIRST_PAUSE_S
        request.answer.set_result(Answer(data, self._loop.time() - sent_s))

    async def _require_silence(self, connection: ClientConnection) -> None:
        """Raise PolicyError if a message arrived before the request: it is not an answer."""
        with suppress(TimeoutError):
            async with asyncio.timeout(0):
                await connection.recv()
                raise PolicyError(
                    f"{self._url} has sent a message that nobody asked for, so its answers cannot "
                    "be told apart; connecting again"
                )

    def _fail(self, reason: str) -> None:
        self._problem = reason
        if not self._metadata.done():
            self._metadata.set_exception(PolicyError(reason))
        for request in (self._sent, self._next):
            if request is not None:
                request.answer.set_exception(NoChunkError(reason))
        self._sent = self._next = None

    def _reason(self, error: Exception) -> str:
        match error:
            case InvalidStatus() if error.response.status_code in UNAUTHORIZED:
                return f"{self._url} wants an API key, or another one: set {API_KEY_VARIABLE} to it"
            case InvalidHandshake():
                return f"{self._url} is no policy server: {error}"
            case TimeoutError() if not self._metadata.done():
                return f"{self._url} has not answered like a policy server within {CONNECT_S:g} s"
            case TimeoutError():
                return f"{self._url} has not answered for {LOST_S:g} s; connecting again"
            case ConnectionClosed():
                return f"the connection to {self._url} is lost: {error}"
            case MessageError():
                return f"{self._url} is no policy server, its first message is {error}"
            case ConnectionRefusedError():
                return f"nobody listens at {self._url}: start the policy server there"
            case OSError():
                return f"{self._url} cannot be reached: {error.strerror or error}"
            case _:
                return str(error)
