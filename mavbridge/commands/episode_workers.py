"""Runs episodes one after the other, in processes of this machine, or on a Ray cluster.

Results are equal in all three cases, because an episode depends only on its job.
"""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import TypeAlias, TypeVar

from mavbridge.config.episodes import WorkersConfig
from mavbridge.core.address import host_port
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.observe.viewer_target import listens
from mavbridge.simulation.referee import EpisodeInterruptedError

Job = TypeVar("Job")
Result = TypeVar("Result")
ShouldStop: TypeAlias = Callable[[], bool]
FlyJob: TypeAlias = Callable[[Job, ShouldStop], Result]
"""Importable in another process; raises ``EpisodeInterruptedError`` if ``ShouldStop`` is True."""

MAX_RETRIES = 3
"""Lost workers of one episode, which Ray flies again, before it counts as the cause."""
CONNECT_TIMEOUT_S = 5.0
END_TIMEOUT_S = 10.0
"""Time for a worker to end its flight in order once it is told to stop."""
_POLL_S = 0.1
_stop = threading.Event()
"""In a worker process: set when the worker has to end."""


def fly_jobs(
    fly: FlyJob[Job, Result],
    jobs: Sequence[Job],
    config: WorkersConfig,
    should_stop: ShouldStop,
) -> Iterator[tuple[int, Result]]:
    """Fly every job, and yield its index and result when ready; end early on ``should_stop``.

    Raises PeerError if a worker died, UserError without Ray or its cluster, and what ``fly``
    raises.
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


def _fly_on_processes(
    fly: FlyJob[Job, Result], jobs: Sequence[Job], count: int, should_stop: ShouldStop
) -> Iterator[tuple[int, Result]]:
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        # The pipe ends for the workers when it is closed here or this process dies.
        theirs, ours = context.Pipe(duplex=False)
        stack.callback(theirs.close)
        # One worker per pool: a pool of many can miss the death of one (CPython 3.11).
        executors = [
            stack.enter_context(ProcessPoolExecutor(1, context, _begin_worker, (theirs,)))
            for _ in range(count)
        ]
        stack.callback(ours.close)
        submit = [partial(one.submit, partial(_fly_in_worker, fly)) for one in executors]
        yield from _collect(submit, jobs, should_stop, (BrokenProcessPool,))


def _begin_worker(parent: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which closes the pipe

    def end_with_parent() -> None:
        parent.poll(None)
        _stop.set()
        threading.Event().wait(END_TIMEOUT_S)
        os._exit(1)  # it hangs, or its parent has died

    threading.Thread(target=end_with_parent, name="mavbridge-worker-end", daemon=True).start()


def _fly_in_worker(fly: FlyJob[Job, Result], job: Job) -> Result:
    return fly(job, _stop.is_set)


def _collect(
    workers: Iterable[Callable[[Job], "Future[Result]"]],
    jobs: Sequence[Job],
    should_stop: ShouldStop,
    lost: tuple[type[Exception], ...],
) -> Iterator[tuple[int, Result]]:
    """Keep one job with each worker until all are flown or ``should_stop``.

    An outcome of the type ``lost`` means that its worker died.
    """
    waiting, idle = list(reversed(range(len(jobs)))), list(workers)
    busy: dict[Future[Result], tuple[int, Callable[[Job], Future[Result]]]] = {}
    while (waiting or busy) and not should_stop():
        while waiting and idle:
            index, submit = waiting.pop(), idle.pop()
            busy[submit(jobs[index])] = index, submit
        for future in wait(busy, _POLL_S, FIRST_COMPLETED).done:
            index, submit = busy.pop(future)
            try:
                result = future.result()
            except lost as error:
                if should_stop():  # Ctrl-C can reach a worker that has only just been started
                    return
                raise PeerError(
                    f"the worker that flew {jobs[index]} died (out of memory?): use fewer "
                    "--workers, or one to see the cause"
                ) from error
            idle.append(submit)
            yield index, result


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
    task = ray.remote(max_retries=MAX_RETRIES, num_cpus=1)(fly)
    errors = ray.exceptions
    lost = (
        *(errors.WorkerCrashedError, errors.NodeDiedError, errors.LocalRayletDiedError),
        *(errors.OutOfMemoryError, errors.ObjectLostError),
    )
    try:
        # Ray cancels a task itself when the connection ends.
        submit = [lambda job: task.remote(job, lambda: False).future()] * count
        yield from _collect(submit, jobs, should_stop, lost)
    except errors.RayTaskError as error:
        if isinstance(error.cause, MavbridgeError):
            raise error.cause from error
        raise  # a bug: keep its traceback
    finally:
        ray.shutdown()


def _require_reachable(address: str) -> None:
    """Raise UserError if nothing answers at the address: Ray would retry for long."""
    target = host_port(address.removeprefix("ray://"))
    is_there = target is not None and listens(*target, timeout_s=CONNECT_TIMEOUT_S)
    if address not in ("auto", "local") and not is_there:
        raise UserError(
            f"--ray {address}: nothing answers there; name the head of a cluster as HOST:PORT or "
            "ray://HOST:PORT (ray start --head starts one), or use --workers alone"
        )
