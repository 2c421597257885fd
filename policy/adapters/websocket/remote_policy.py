"""Policy on a server, one request per chunk; a thread holds the connection and reconnects."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from ssl import SSLError
from urllib.parse import urlsplit

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidStatus,
    WebSocketException,
)

from policy.adapters.interface import Interface
from policy.adapters.websocket.messages import (
    CONTRACT_KEY,
    FIELDS_KEY,
    RESET_KEY,
    Message,
    MessageError,
    number_array,
    pack,
    to_message,
    unpack,
)
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.runner import level_state, to_numpy
from policy.errors import NoChunkError, PolicyError
from policy.files import last_line

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


@dataclass(frozen=True, slots=True)
class _Request:
    payload: bytes
    patience_s: float
    answer: Future[bytes | str]


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
        self.round_trip_s = 0.0
        """Time from the newest answered request to its answer."""
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._hold()), name="mavbridge-server-link", daemon=True
        )

    def connect(self) -> Message:
        """Connect for the first time; return the server's metadata."""
        self._thread.start()
        return self._metadata.result(2 * CONNECT_S + CLOSE_S + JOIN_S)

    def ask(self, payload: bytes, timeout_s: float) -> bytes | str:
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
        self.round_trip_s = self._loop.time() - sent_s
        request.answer.set_result(data)

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
            case SSLError() | ConnectionResetError() if self._url.startswith("wss:"):
                told = last_line(error)
                return f"{self._url} cannot be reached by TLS ({told}): write ws:// if it has none"
            case OSError():
                return f"{self._url} cannot be reached: {error.strerror or last_line(error)}"
            case _:
                return str(error)


ACTIONS_KEY = "actions"
"""Key of the actions in an answer, unless the contract file names another."""
TRIAL_S = 120.0
"""Timeout of the first answers, before any flight: servers compile on their first request."""
MOST_WAIT_S = 1.5
"""Upper bound of the deadline for any contract, so that a flight still ends promptly."""


def answer_deadline_s(contract: Contract) -> float:
    """Return the time after which the guard would reject the answer [s]."""
    ages_s = (contract.max_state_age_s, contract.max_velocity_age_s, contract.max_feature_age_s)
    chunk_s = contract.horizon * contract.chunk_dt_s
    return min(min(ages_s) + contract.play_s, chunk_s, MOST_WAIT_S)


class RemotePolicy:
    """``policy.protocol.SingleRatePolicy`` whose ``predict`` runs on a server.

    Until the first ``reset`` it waits for the server's compilation; from then on at most
    ``answer_deadline_s``. A later answer is never flown.
    """

    def __init__(self, link: ServerLink, interface: Interface, *, is_ours: bool) -> None:
        """``is_ours``: the server is ``mavbridge serve``, which takes the history and the reset."""
        self.contract = replace(interface.contract, arrays="numpy", feature_dim=0)
        self._link = link
        self._interface = interface
        self._is_ours = is_ours
        self._timeout_s = TRIAL_S
        self._has_begun = False
        """True if a flight has begun and the server has not been told."""

    def predict(
        self,
        image: FloatArray,
        state: FloatArray,
        action_history: FloatArray,
        num_diffusion_steps: int,
    ) -> FloatArray:
        """Ask the server for a chunk; the server sets the number of diffusion steps."""
        sample = self._interface, image[0], state[0], action_history[0]
        message = to_message(*sample, is_ours=self._is_ours, delay_s=self._link.round_trip_s)
        if self._is_ours and self._has_begun:
            message[RESET_KEY] = True
        data = self._link.ask(pack(message), self._timeout_s)
        if isinstance(data, str):
            raise NoChunkError(f"the policy server failed: {last_line(data)}")
        self._has_begun = False  # not before: it may be the reset that failed
        try:
            return self._chunk(unpack(data))
        except PolicyError as error:
            raise NoChunkError(f"the policy server's answer is {error}") from error

    def reset(self) -> None:
        """With the next request, tell the server that a flight has begun."""
        self._has_begun = True
        self._timeout_s = answer_deadline_s(self.contract)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def try_out(self) -> str:
        """Request two chunks of a dummy sample; return a line with the second one's time."""
        contract = self.contract
        image = np.zeros((1, *contract.image_shape), np.float32)
        history = np.zeros((1, *contract.history_shape), np.float32)
        for _ in range(2):  # the first one may compile
            self.predict(image, level_state(contract), history, 1)
        return (
            f"the policy server answers in {1e3 * self._link.round_trip_s:.1f} ms; what takes "
            f"longer than {1e3 * answer_deadline_s(contract):.0f} ms is not flown"
        )

    def _chunk(self, message: Message) -> FloatArray:
        own_key = self._interface.action_key
        actions = number_array(message, own_key if own_key in message else ACTIONS_KEY)
        if actions.ndim == 3 and actions.shape[0] == 1:
            actions = actions[0]
        wanted = (self.contract.horizon, ACTION_DIM)
        if actions.shape != wanted:
            advice = "set [contract] horizon to what the server returns"
            if actions.shape[1:] != wanted[1:]:
                advice = "the server has to cut out the four numbers that fly a multirotor"
            raise MessageError(
                f"actions {list(actions.shape)} where the contract has [horizon, 4] = "
                f"{list(wanted)}: {advice}"
            )
        return self._interface.to_actions(to_numpy(actions))[None]
