"""Rows about the policy: its loading, its engine, its rates on this computer, and its contract."""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial

from mavbridge.commands.check.rows import CheckRow
from mavbridge.commands.config import NO_POLICY
from mavbridge.commands.output import print_status
from mavbridge.config.flight import FlyConfig, Limits
from mavbridge.core.clock import NS_PER_S, Clock, period_ns
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.histogram import Histogram
from mavbridge.core.realtime import settle_thread
from mavbridge.core.stopping import Worker
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.flight.policies import load_configured_policy
from mavbridge.flight.speed import require_speed
from policy.engines.runner import dummy_sample, encode_all, require_chunk
from policy.errors import Agreed, NoChunkError, PolicyError, Warned
from policy.loading.request import LoadedPolicy
from policy.protocol import PolicyRunner

_BUSY = 0.8
"""Share of a slot above which other work on this computer makes chunks late."""
HELD = 0.98
"""Share of the requested rate that counts as held."""
_LATE_PERIODS = 1.5
"""A chunk is late if it comes more than this many periods after the last, as in a report."""
_JOIN_S = 60.0
"""Longest wait for the last call of a slow policy."""
_row = partial(CheckRow, "policy")


def check_policy(
    config: FlyConfig, clock: Clock, *, timing_s: float
) -> tuple[list[CheckRow], FlightPlan | None]:
    """Load the policy as a flight does, and run it for ``timing_s``; a failure becomes a row.

    Return its rows, and its plan for the other checks, without flags that contradict it; None: no
    policy was named, or it cannot be loaded.
    """
    if config.policy.policy == NO_POLICY:
        return [], None
    print_status(f"loading the policy, then running it for {timing_s:g} s")
    try:
        in_air = config.takeoff is not None
        with load_configured_policy(config.policy, clock, starts_in_air=in_air) as loaded:
            runner = loaded.runner
            agrees = any(isinstance(note, Agreed) for note in loaded.notes)
            found = f"{runner.name} on {runner.engine}{', agrees with torch' if agrees else ''}"
            expected = "the fastest that agrees with torch"
            rows = [_row("engine", found, expected, warn=_warnings(loaded.notes))]
            contract = runner.contract
            size = f"{contract.image_width}x{contract.image_height}"
            images = f"{size} of {', '.join(contract.cameras)}"
            takes = f"{contract.action}, {contract.state_frame}, {images}"
            try:
                plan = plan_flight(config, contract, is_dual=runner.dual_rate)
            except UserError as error:
                rows.append(_row("flags of the flight", takes, no_go=str(error)))
                # Flags that may contradict the contract are left out, for the other rows.
                goal = "0,0,0" if "goal" in contract.state_extras else None
                kept = replace(config, limits=Limits(), mode=None, goal=goal)
                return rows, plan_flight(kept, contract, is_dual=runner.dual_rate)
            rows += _speed_rows(plan, loaded, clock, timing_s)
            figures = ", ".join(f"{name} {value:.4g}" for name, value in plan.figures().items())
            rows.append(_row("contract", takes, "no flag that contradicts it"))
            rows.append(_row("plan", figures))
            return rows, plan
    except MavbridgeError as error:
        return [_row("policy", config.policy.policy, no_go=str(error))], None


def _warnings(notes: Iterable[str]) -> str:
    return "; ".join(note.text for note in notes if isinstance(note, Warned))


def _speed_rows(
    plan: FlightPlan, loaded: LoadedPolicy, clock: Clock, timing_s: float
) -> Iterator[CheckRow]:
    """Yield rows on the held rates, and the flight's warnings about the policy's speed."""
    try:
        for pace in _run_at_rates(plan, loaded.runner, clock, timing_s):
            yield pace.row(had_chunks=loaded.times is not None)
    except NoChunkError as error:
        yield _row("speed", "not measured", warn=f"it skips the dummy image: {error}")
    expected = "within the ages of its contract"
    try:
        notes = require_speed(plan, loaded.runner.name, loaded.times)
    except MavbridgeError as error:
        yield _row("speed", "too slow", expected, no_go=str(error))
        return
    if warnings := _warnings(notes):
        yield _row("speed", "slower than asked", expected, warn=warnings)


@dataclass(kw_only=True)
class Pace:
    """One half of the policy, called on a grid like that of a flight's loops."""

    name: str
    asked_hz: float
    took: Histogram = field(default_factory=Histogram)
    late: int = 0
    rate_hz: float = 0.0
    failed: int = 0
    why: str = ""
    """Reason of the last call that failed."""

    def run(
        self,
        stop: threading.Event,
        *,
        call: Callable[[], object],
        clock: Clock,
        duration_s: float,
        settle: Callable[[], object],
    ) -> None:
        """Call and count for ``duration_s``. A late call delays the following ones."""
        settle()
        begun_ns = ended_ns = due_ns = clock.now_ns()
        every_ns = period_ns(self.asked_hz)
        while due_ns < begun_ns + duration_s * NS_PER_S and not stop.is_set():
            clock.sleep_until_ns(due_ns)
            called_ns = clock.now_ns()
            try:
                call()
            except NoChunkError as error:  # a flight continues along the last chunk
                self.failed, self.why = self.failed + 1, str(error)
            now_ns = clock.now_ns()
            self.late += self.took.count > 0 and now_ns - ended_ns > _LATE_PERIODS * every_ns
            self.took.add(now_ns - called_ns)
            ended_ns, due_ns = now_ns, max(due_ns + every_ns, now_ns)
        self.rate_hz = self.took.count * NS_PER_S / max(due_ns - begun_ns, 1)

    def row(self, *, had_chunks: bool = True) -> CheckRow:
        """Return a row with rate and times; a warning if the rate was not held, or only just.

        ``had_chunks``: the policy had a chunk for the dummy sample, so it must have them here.
        """
        took_ms = self.took.percentiles_ms()
        if took_ms is None:
            return _row(self.name, "not one in time", warn="far too slow for this computer")
        calls, expected = self.took.count, f"{self.asked_hz:.3g} Hz, under {_BUSY:.0%} of a slot"
        share, advice = took_ms.p50 * self.asked_hz / 1000, ""
        if self.failed:
            advice = f"{self.failed} of {calls} calls gave none that can be flown: {self.why}"
        elif self.rate_hz < HELD * self.asked_hz:
            advice = f"this computer makes {self.rate_hz:.1f} {self.name} a second here"
        elif share > _BUSY:
            advice = f"{self.name} leave little of their slots: other programs will make them late"
        times = f"{took_ms.p50:.1f} / {took_ms.p99:.1f} / {took_ms.max:.1f} ms"
        return _row(
            self.name,
            f"{self.rate_hz:.1f} Hz, {self.late} of {calls} late; {times} (p50 / p99 / max), "
            f"{share:.0%} of a slot",
            expected,
            warn=advice,
            no_go=advice if had_chunks and 2 * self.failed > calls else "",
        )


def _run_at_rates(
    plan: FlightPlan, runner: PolicyRunner, clock: Clock, timing_s: float
) -> list[Pace]:
    """Compute chunks and images of a dummy sample, each in a thread, at the rates of the flight."""
    contract, loops = runner.contract, plan.loops
    images, state, history = dummy_sample(contract)
    sample = encode_all(runner, images), state, history
    one_of_each = images.reshape(-1, len(contract.cameras), *contract.picture_shape)[0]

    def solve() -> None:
        chunk = runner.act(*sample)
        try:
            require_chunk(runner, chunk)
        except PolicyError as error:  # a flight refuses it
            raise NoChunkError(str(error)) from None

    def encode() -> None:
        for camera, image in enumerate(one_of_each):
            runner.encode(image, camera)

    chunks = Pace(name="chunks", asked_hz=loops.action_hz)
    pictures = Pace(name="images", asked_hz=min(plan.image_rates_hz))
    workers = []
    for pace, call, is_realtime in (
        (chunks, solve, plan.config.rates.realtime),
        (pictures, encode, False),
    ):
        settle: Callable[[], object] = settle_thread if is_realtime else lambda: None
        run = partial(pace.run, call=call, clock=clock, duration_s=timing_s, settle=settle)
        workers.append(Worker(f"mavbridge-check-{pace.name}", run))
    for worker in workers:
        worker.start()
    with ExitStack() as stack:  # also on Ctrl-C: the policy is closed only when nothing calls it
        for worker in workers:
            stack.callback(worker.join, _JOIN_S)
        for worker in workers:
            worker.ends_within(timing_s + _JOIN_S)
    return [chunks, pictures]
