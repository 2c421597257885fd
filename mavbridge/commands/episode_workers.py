"""Episodes one after the other, on processes of this machine, or on a Ray cluster.

The results are the same from all three: an episode depends on its job alone, and one whose worker
was lost is flown again.
"""

import itertools
import logging
import multiprocessing
import os
import signal
import socket
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.synchronize import Event
from typing import Any, Generic, TypeAlias, TypeVar

from mavbridge.config.workers import WorkersConfig
from mavbridge.core.address import host_port
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.simulation.referee import EpisodeInterruptedError

Job = TypeVar("Job")
Result = TypeVar("Result")
ShouldStop: TypeAlias = Callable[[], bool]
FlyJob: TypeAlias = Callable[[Job, ShouldStop], Result]
"""Importable in another process; raises ``EpisodeInterruptedError`` when ``ShouldStop`` says so."""

MAX_RETRIES = 3
"""Lost workers of one episode before it is held to be the cause."""
CONNECT_TIMEOUT_S = 5.0
END_TIMEOUT_S = 10.0
"""Limit for a process to end by itself, and then on SIGTERM, before it is killed."""
_SPAWN = multiprocessing.get_context("spawn")
_POLL_S = 0.1


def fly_jobs(
    fly: FlyJob[Job, Result],
    jobs: Sequence[Job],
    config: WorkersConfig,
    should_stop: ShouldStop,
) -> Iterator[tuple[int, Result]]:
    """Fly every job, and yield its index and result when ready; ends early on ``should_stop``.

    Raises:
        UserError: Ray is missing, or its cluster cannot be reached.
        PeerError: an episode lost one worker after the other.
        MavbridgeError: an episode cannot be flown.
    """
    if config.ray_address is not None:
        yield from _fly_on_ray(fly, jobs, config.workers, config.ray_address, should_stop)
    elif config.workers > 1 and len(jobs) > 1:
        yield from _fly_on_processes(fly, jobs, min(config.workers, len(jobs)), should_stop)
    else:
        with suppress(EpisodeInterruptedError):
            for index, job in enumerate(jobs):
                if should_stop():
                    return
                yield index, fly(job, should_stop)


def _attempt(fly: FlyJob[Job, Result], job: Job, should_stop: ShouldStop) -> Result | Exception:
    """Fly in a worker; an unexpected error takes its traceback along."""
    try:
        return fly(job, should_stop)
    except MavbridgeError as error:
        return error
    except Exception as error:  # noqa: BLE001 - raised again where the results are awaited
        error.add_note(traceback.format_exc())
        return error


def raise_failure(outcome: Result | Exception) -> Result:
    """Return the result, or raise what the worker's job raised."""
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


class WorkerProcess(Generic[Job, Result]):
    """A process that flies the jobs it is sent."""

    def __init__(self, name: str, fly: FlyJob[Job, Result], stop: Event) -> None:
        self.connection, theirs = _SPAWN.Pipe()
        """Readable when an outcome has arrived, or when the process has died."""
        self._process = _SPAWN.Process(target=_serve, args=(theirs, fly, stop), name=name)
        self._process.start()
        theirs.close()

    def send(self, job: Job) -> None:
        """Hand over a job."""
        with suppress(BrokenPipeError):  # it has died, which ``receive`` reports
            self.connection.send(job)

    def receive(self) -> Result | Exception | None:
        """Outcome of the job; None if the process has died, or hangs."""
        with suppress(EOFError, ConnectionResetError):
            if self.connection.poll(END_TIMEOUT_S):
                outcome: Result | Exception = self.connection.recv()
                return outcome
        return None

    def terminate(self) -> None:
        """Send SIGTERM, which ends a flight in order."""
        self._process.terminate()

    def end(self) -> None:
        """Wait for the end of the process, which follows that of its pipe; at worst kill it."""
        self.connection.close()
        for insist in (self._process.terminate, self._process.kill):
            self._process.join(END_TIMEOUT_S)
            if not self._process.is_alive():
                return
            insist()
        self._process.join(END_TIMEOUT_S)


def _serve(connection: Connection, fly: FlyJob[Job, Result], stop: Event) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which sets the event
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            connection.send(_attempt(fly, connection.recv(), stop.is_set))


def _fly_on_processes(
    fly: FlyJob[Job, Result], jobs: Sequence[Job], count: int, should_stop: ShouldStop
) -> Iterator[tuple[int, Result]]:
    waiting = list(reversed(range(len(jobs))))
    losses: Counter[int] = Counter()
    stop, names = _SPAWN.Event(), map("mavbridge-worker-{}".format, itertools.count())
    idle: list[WorkerProcess[Job, Result]] = []
    busy: dict[WorkerProcess[Job, Result], int] = {}
    try:
        while (waiting or busy) and not should_stop():
            while waiting and len(busy) < count:
                worker = idle.pop() if idle else WorkerProcess(next(names), fly, stop)
                busy[worker] = index = waiting.pop()
                worker.send(jobs[index])
            ready = wait([worker.connection for worker in busy], _POLL_S)
            for worker in [worker for worker in busy if worker.connection in ready]:
                index, outcome = busy.pop(worker), worker.receive()
                if outcome is not None:
                    idle.append(worker)
                    yield index, raise_failure(outcome)
                    continue
                worker.end()
                waiting.append(index)
                losses[index] += 1
                if losses[index] > MAX_RETRIES:
                    raise _loss(jobs[index])
    finally:
        stop.set()
        for worker in (*idle, *busy):
            worker.end()


def _loss(job: object) -> PeerError:
    return PeerError(
        f"{job} lost {MAX_RETRIES + 1} workers one after the other (out of memory?): use fewer "
        "--workers, or one to see the cause"
    )


def _fly_on_ray(
    fly: FlyJob[Job, Result],
    jobs: Sequence[Job],
    count: int,
    address: str,
    should_stop: ShouldStop,
) -> Iterator[tuple[int, Result]]:
    _require_reachable(address)
    # Read as ray is imported. No usage statistics; an address that is not Ray's fails in 40 s.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")
    try:
        import ray
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UserError(
            "--ray needs the package ray: pip install ray, or use --workers alone "
            "to fly on processes of this machine"
        ) from error
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise UserError(f"--ray {address}: {str(error).strip().splitlines()[0]}") from error
    try:
        task = ray.remote(max_retries=MAX_RETRIES, num_cpus=1)(_attempt)
        waiting = list(reversed(range(len(jobs))))
        busy: dict[Any, int] = {}
        while (waiting or busy) and not should_stop():
            while waiting and len(busy) < count:
                index = waiting.pop()
                busy[task.remote(fly, jobs[index], _never)] = index
            for reference in ray.wait(list(busy), num_returns=1, timeout=_POLL_S)[0]:
                index = busy.pop(reference)
                try:
                    outcome: Result | Exception = ray.get(reference)
                except ray.exceptions.RayTaskError:
                    raise  # a bug, and not the worker's end: its traceback helps
                except ray.exceptions.RayError as error:
                    raise _loss(jobs[index]) from error
                yield index, raise_failure(outcome)
    finally:
        ray.shutdown()


def _never() -> bool:
    """Ray cancels a task by itself when the connection ends."""
    return False


def _require_reachable(address: str) -> None:
    """Refuse an address where nothing answers: Ray would keep trying for long."""
    if address in ("auto", "local"):
        return
    try:
        if (target := host_port(address.removeprefix("ray://"))) is None:
            raise ValueError
        socket.create_connection(target, CONNECT_TIMEOUT_S).close()
    except (OSError, ValueError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else "no port number"
        raise UserError(
            f"--ray {address}: nothing answers there ({reason}); name the head of a cluster as "
            "HOST:PORT or ray://HOST:PORT (ray start --head starts one), or use --workers alone"
        ) from error
