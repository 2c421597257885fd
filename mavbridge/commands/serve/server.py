"""The network side of ``mavbridge serve``: openpi's websocket protocol, for a few clients."""

import asyncio
import hmac
import http
import logging
from collections.abc import Callable
from contextlib import suppress

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from mavbridge.commands.serve.answers import AnswerLoop
from mavbridge.core.address import spelled
from mavbridge.core.errors import UserError

SPARE_BYTES = 2**20
"""Most bytes of a request beside its images."""
PING_S = 5.0
"""A client that has not been heard of for two or three of these is gone, and its place is free."""
CLOSE_S = 1.0
UNASKED_S = 5.0
"""After this a client that has asked for nothing gives its place to another one."""
HEALTH_PATH = "/healthz"


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
            image_bytes: images of one request; larger requests are refused.
            api_key: what clients must know; None lets in all that reach this computer.
            report: gets a line for each client that comes or goes.
        """
        self._answers = answers
        self._max_bytes = image_bytes + SPARE_BYTES
        self._api_key = api_key
        self._report = report
        self._clients = 0
        self._unasked: dict[ServerConnection, float] = {}
        """Clients that have asked for nothing yet, with the time at which each came."""

    async def listen(self, host: str, port: int) -> Server:
        """Listen from now on.

        Raises:
            UserError: it cannot listen there.
        """
        # It would print a traceback for every stranger that knocks at the port.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        try:
            return await serve(
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
        """Refuse pages of a browser, which alone name an origin, and clients without the key.

        Whoever only asks whether a server is here gets an answer.
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
                    # One at a time from each client: the queue has room for all.
                    answer = self._answers.submit(request)
                    reply: bytes | str = await asyncio.wrap_future(answer)
                    await connection.send(reply)
        finally:
            self._clients -= 1
            self._unasked.pop(connection, None)
            self._report(f"{_name(connection)} has gone")

    async def _make_room(self) -> None:
        """End the clients that only hold a place."""
        latest = asyncio.get_running_loop().time() - UNASKED_S
        idle = [each for each, came in self._unasked.items() if came < latest]
        for each in idle:
            await each.close(CloseCode.TRY_AGAIN_LATER, "it has asked for nothing, and others wait")
        await asyncio.sleep(0)  # for their own tasks to leave


def _name(connection: ServerConnection) -> str:
    address = connection.remote_address
    return f"client {spelled(*address)}" if address else "a client"
