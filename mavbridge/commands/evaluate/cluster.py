"""Episodes on many processes or machines: Ray schedules them and repeats what a lost worker had."""

import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from mavbridge.commands.evaluate.jobs import Flown, Job, fly_job
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from policy.errors import PolicyError

MAX_RETRIES = 3
"""Workers that one episode may lose before it is taken for the cause."""
CONNECT_TIMEOUT_S = 5.0
_POLL_S = 0.2
"""Between two looks at the stop flag."""

FlyJob = Callable[[Job], Flown]


def fly_on_ray(
    jobs: Sequence[Job],
    *,
    workers: int,
    address: str | None,
    should_stop: Callable[[], bool],
    fly: FlyJob = fly_job,
) -> Iterator[Flown]:
    """Fly ``workers`` jobs at a time; results come as they are ready, until ``should_stop``.

    Args:
        jobs: in this order, as far as workers are free.
        workers: most episodes at a time.
        address: of a running cluster (HOST:PORT, ray://HOST:PORT or auto); None = a local one that
            ends with the run.
        should_stop: asked several times a second.
        fly: what a worker does with a job; must be importable there.

    Raises:
        UserError: ray is missing, or its cluster cannot be reached.
        PeerError: an episode lost one worker after the other.
        MavbridgeError: an episode cannot be flown.
    """
    # Read as ray is imported. Nothing is sent home; a port that is not Ray's is given up in 40 s.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")
    try:
        import ray
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UserError(
            "--workers and --ray need the package ray: pip install 'mavbridge[cluster]', or leave "
            "them out to fly one episode after the other"
        ) from error
    _connect(workers, address)
    try:
        task = ray.remote(max_retries=MAX_RETRIES, num_cpus=1)(_telling(fly))
        waiting = list(reversed(jobs))
        under_way: dict[Any, Job] = {}
        while (waiting or under_way) and not should_stop():
            while waiting and len(under_way) < workers:
                job = waiting.pop()
                under_way[task.remote(job)] = job
            ready, _ = ray.wait(list(under_way), num_returns=1, timeout=_POLL_S)
            for reference in ready:
                yield _result(reference, under_way.pop(reference))
    finally:
        ray.shutdown()


@dataclass(frozen=True, slots=True)
class _Refusal:
    """An expected error on its way home: as an exception it would arrive as a traceback."""

    message: str


def _telling(fly: FlyJob) -> Callable[[Job], Flown | _Refusal]:
    def run(job: Job) -> Flown | _Refusal:
        try:
            return fly(job)
        except (MavbridgeError, PolicyError) as error:
            return _Refusal(str(error))

    return run


def _result(reference: Any, job: Job) -> Flown:
    import ray

    try:
        flown: Flown | _Refusal = ray.get(reference)
    except ray.exceptions.RayTaskError:
        raise  # a bug of ours, or of a person's policy: its traceback is what helps
    except ray.exceptions.RayError as error:
        raise PeerError(
            f"course {job.course_seed} lost {MAX_RETRIES + 1} workers one after the other; the "
            f"last one: {str(error).strip().splitlines()[0]}"
        ) from error
    if isinstance(flown, _Refusal):
        raise UserError(flown.message)
    return flown


def _connect(workers: int, address: str | None) -> None:
    """Start a cluster here, or join the one at ``address``."""
    import ray

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address is None:
        ray.init(num_cpus=workers, include_dashboard=False, **quiet)
        return
    _require_reachable(address)
    try:
        ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise UserError(f"--ray {address}: {str(error).strip().splitlines()[0]}") from error


def _require_reachable(address: str) -> None:
    """Ray itself would try for long where nobody answers at all."""
    if address in ("auto", "local"):
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit() and 0 < int(port) < 65536):
        raise UserError(f"--ray {address!r} is not HOST:PORT, ray://HOST:PORT or auto")
    try:
        socket.create_connection((host, int(port)), CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise UserError(
            f"--ray {address}: nobody answers there ({error.strerror or error}); start a cluster "
            "with ray start --head, or leave the flag out for one on this machine"
        ) from error
