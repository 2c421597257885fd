"""From a request to its answer: the policy of a server, in a thread of its own."""

import queue
import threading
from concurrent.futures import Future
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, Clock
from policy.errors import PolicyError
from policy.foreign.interface import Interface
from policy.foreign.websocket.messages import CONTRACT_KEY, pack, unpack
from policy.foreign.websocket.observation import RESET_KEY, from_message
from policy.foreign.websocket.remote_policy import ACTIONS_KEY
from policy.protocol import Executable, keep_nothing

MAX_CLIENTS = 4
WAIT_S = 0.1
"""Longest wait for a request before the stop flag is checked."""


@dataclass(frozen=True, slots=True)
class Job:
    """A request, and where its answer goes: bytes, or the text of an error."""

    request: bytes | str
    answer: Future[bytes | str]


class AnswerLoop:
    """Answers one request after the other; only its own thread calls the policy."""

    def __init__(self, executable: Executable, *, clock: Clock) -> None:
        """``executable`` is single-rate."""
        self._executable = executable
        self._interface = Interface(contract=executable.contract)
        self._clock = clock
        self.max_clients = MAX_CLIENTS if executable.reset is keep_nothing else 1
        """One alone where the policy remembers: two flights would share what it keeps."""
        self._jobs: queue.Queue[Job] = queue.Queue(self.max_clients)

    @property
    def metadata(self) -> bytes:
        """The first message to every client."""
        return pack(
            {
                CONTRACT_KEY: self._executable.contract.to_json(),
                "policy": self._executable.name,
            }
        )

    def submit(self, request: bytes | str) -> Future[bytes | str]:
        """Queue a request; raises queue.Full."""
        job = Job(request, Future())
        self._jobs.put_nowait(job)
        return job.answer

    def run(self, stop: threading.Event) -> None:
        """Answer until told to stop."""
        while not stop.is_set():
            try:
                job = self._jobs.get(timeout=WAIT_S)
            except queue.Empty:
                continue
            if job.answer.set_running_or_notify_cancel():
                job.answer.set_result(self.answer(job.request))

    def answer(self, request: bytes | str) -> bytes | str:
        """A chunk as msgpack, or a text that says what is wrong with the request or the policy."""
        begun_ns = self._clock.now_ns()
        try:
            message = unpack(request)
            image, state, history = from_message(self._interface, message)
            if message.get(RESET_KEY):
                self._executable.reset()
            chunk = self._executable.act(image, state, history)
        except PolicyError as error:
            return str(error)
        took_ms = (self._clock.now_ns() - begun_ns) / NS_PER_MS
        return pack({ACTIONS_KEY: chunk[0], "server_timing": {"infer_ms": took_ms}})
