"""Policy servers on loopback: one scripted by a test, and our own around any policy."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from functools import partial
from typing import TypeVar

import numpy as np
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from mavbridge.commands.serve import PolicyServer
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.stopping import Worker
from policy.adapters.websocket.messages import Message, pack, unpack
from policy.errors import PolicyError
from policy.protocol import PolicyRunner

Reply = bytes | str | tuple[bytes, ...] | None
"""Several: sent one after the other; None: close the connection."""
START_S = 10.0
Connected = TypeVar("Connected")


@contextmanager
def _in_thread(listen: Callable[[], "asyncio.Future[Server]"]) -> Iterator[int]:
    """Context manager: a server on its own event loop; yields its port."""
    port: Future[int] = Future()
    end: list[Callable[[], None]] = []

    async def run() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        end.append(lambda: loop.call_soon_threadsafe(stop.set))
        server = await listen()
        port.set_result(server.sockets[0].getsockname()[1])
        await stop.wait()
        server.close()
        with suppress(TimeoutError):
            await asyncio.wait_for(server.wait_closed(), 1.0)

    worker = Worker("test-policy-server", lambda _stop: asyncio.run(run()))
    worker.start()
    try:
        yield port.result(START_S)
    finally:
        end[0]()
        worker.join(START_S)


@contextmanager
def scripted_server(
    reply: Callable[[Message], Reply],
    *,
    greeting: bytes | str = pack({}),
    port: int = 0,
    on_close: Callable[[int | None], None] = lambda _code: None,
) -> Iterator[int]:
    """Context manager: a server that answers by ``reply``; yields its port.

    ``reply`` runs in a thread and can wait. ``on_close`` gets the code with which a client has
    closed its connection.
    """

    async def talk(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            await connection.send(greeting)
            async for request in connection:
                answer = await asyncio.to_thread(reply, unpack(request))
                if answer is None:
                    return
                for each in answer if isinstance(answer, tuple) else (answer,):
                    await connection.send(each)
        on_close(connection.close_code)

    def listen() -> "asyncio.Future[Server]":
        return asyncio.ensure_future(_listening(talk, port))

    with _in_thread(listen) as bound:
        yield bound


async def _listening(talk: Callable[[ServerConnection], object], port: int) -> Server:
    return await serve(talk, "127.0.0.1", port, compression=None, max_size=None)


@contextmanager
def our_server(runner: PolicyRunner, *, api_key: str | None = None) -> Iterator[int]:
    """Context manager: ``mavbridge serve`` without its command line; yields its port."""
    clock = MonotonicClock()
    server = PolicyServer(runner, clock=clock, api_key=api_key, report=lambda _line: None)
    listen = partial(server.listen, "127.0.0.1", 0)
    with closing(server), _in_thread(lambda: asyncio.ensure_future(listen())) as port:
        yield port


def chunk_of(value: float, horizon: int = 16) -> bytes:
    """Return an answer whose actions all have one value."""
    return pack(
        {
            "actions": np.full((horizon, 4), value, np.float64),
            "server_timing": {"infer_ms": 2.5},
        }
    )


class Guard:
    """Holds the answers of a scripted server while it is shut."""

    def __init__(self) -> None:
        self.is_open = threading.Event()
        self.is_open.set()
        self.requests = 0

    def reply(self, _message: Message) -> bytes:
        """Return the number of the request once the guard is open."""
        self.requests += 1
        number = self.requests
        assert self.is_open.wait(START_S)
        return chunk_of(number)


def when_it_listens(connect: Callable[[], Connected], within_s: int = 30) -> Connected:
    """Connect to a starting server, which refuses connections until it listens."""
    clock = MonotonicClock()
    until_ns = clock.now_ns() + within_s * NS_PER_S
    while clock.now_ns() < until_ns:
        with suppress(PolicyError):
            return connect()
        clock.sleep_until_ns(clock.now_ns() + NS_PER_S // 10)
    return connect()
