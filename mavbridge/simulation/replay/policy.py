"""Replay of a flight's policy loop with the recorded bytes, features and sent sticks.

``TelemetryCache``, ``StateReader``, ``ObservationSource``, ``SentHistory`` and ``PolicyLoop`` run
as in the flight. The recording supplies the start and end of each solve, the arrival and
measurement times of packets, and the sent sticks. A solve's state, stamps and newest image show
which messages had reached the flight process. Solves that returned no chunk are not recorded and
not repeated.

A policy with the recorded contract gets the recorded states and history, any other policy those
rebuilt here. Both are compared.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mavbridge.core.observers import FanOut
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FeatureFrame, FloatArray, Solve, VehicleState
from mavbridge.core.vehicle import ForwardedPacket, Sample, Telemetry
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.state import StateReader, observation_ages_ns
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.wire import GuardStatus, Samples
from mavbridge.mavlink.session.telemetry import samples_of
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.replay.guard import recorded_plan
from mavbridge.simulation.replay.recording import ReplaySource
from policy.data.tables import STATE_STAMPS
from policy.protocol import PolicyRunner


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvePair:
    """Recorded solve and its repetition."""

    recorded: Solve
    replayed: Solve | None
    refusal: Reason | None = None
    """Reason why there is no repetition."""


def replay_policy(
    source: ReplaySource,
    runner: PolicyRunner,
    clock: SteppedClock,
    features: Sequence[Iterable[FeatureFrame]],
) -> Iterator[SolvePair]:
    """Repeat every recorded solve.

    Args:
        source: the flight.
        runner: the policy, reset; if it follows a clock, it follows ``clock``.
        clock: at a time before the flight.
        features: of each camera of the contract, in order of exposure.
    """
    loop = _Loop(source, runner, clock)
    news = _News(
        source, loop.view, [_Shelf(f, c) for f, c in zip(features, loop.caches, strict=True)]
    )
    for solve in source.solves:
        missing = news.bring(solve)
        loop.view.starting_ns = solve.reset_ns
        if missing is not None:
            refusal = because(Code.NOT_RECORDED, what=missing)
            yield SolvePair(recorded=solve, replayed=None, refusal=refusal)
            continue
        yield loop.repeat(solve)


class _Loop:
    """Policy loop and its surroundings, stepped for each recorded solve."""

    def __init__(self, source: ReplaySource, runner: PolicyRunner, clock: SteppedClock) -> None:
        contract = source.contract
        self._clock = clock
        self._now: Solve | None = None
        self._solve: Solve | None = None
        self._refusal: Reason | None = None
        self._act = runner.act
        self._takes_recorded = runner.contract == contract
        span_ns = observation_ages_ns(runner.contract)[0]
        self.caches = [FeatureCache(span_ns=span_ns) for _ in contract.cameras]
        plan = plan_flight(source.config, runner.contract, is_dual=runner.dual_rate)
        self.view = TelemetryCache(plan, sink=FanOut(()))
        self._policy = PolicyLoop(
            plan,
            replace(runner, act=self._timed_act),
            clock=clock,
            view=self.view,
            caches=self.caches,
            send=self._sent,
            watches=[self._keep],
        )
        autopilot = source.meta.autopilot or "none"
        self.view.receive(GuardStatus(autopilot, None, True, None, (), None, has_position=True))

    def repeat(self, recorded: Solve) -> SolvePair:
        """Run one step of the loop at the time of a recorded solve."""
        self._now, self._solve, self._refusal = recorded, None, None
        self._clock.sleep_until_ns(recorded.started_ns)
        self._policy.step()
        return SolvePair(recorded=recorded, replayed=self._solve, refusal=self._refusal)

    def _timed_act(
        self, encoded: FloatArray, states: FloatArray, history: FloatArray
    ) -> FloatArray:
        """Compute a chunk, and advance the clock to the recorded end."""
        recorded = self._now
        if recorded is not None and self._takes_recorded:
            states, history = recorded.states.copy(), recorded.history.copy()
        chunk = self._act(encoded, states, history)
        if recorded is not None:
            self._clock.sleep_until_ns(recorded.computed_ns)
        return chunk

    def _sent(self, message: Chunk | Reason) -> None:
        if isinstance(message, Reason):
            self._refusal = message

    def _keep(self, solve: Solve) -> None:
        self._solve = solve


class _Shelf:
    """Features of one camera that enter its cache one by one, on demand."""

    def __init__(self, features: Iterable[FeatureFrame], cache: FeatureCache) -> None:
        self._features, self._cache = iter(features), cache
        self._next = next(self._features, None)
        self._newest_id: int | None = None

    def bring(self, frame_id: int) -> bool:
        """Publish all features up to this frame. Return False if the frame's feature is missing."""
        while self._next is not None and self._next.frame_id <= frame_id:
            self._cache.publish(self._next)
            self._newest_id = self._next.frame_id
            self._next = next(self._features, None)
        return self._newest_id == frame_id


class _News:
    """Input of the flight process: samples, ticks of the guard, and features."""

    def __init__(
        self, source: ReplaySource, view: TelemetryCache, shelves: Sequence[_Shelf]
    ) -> None:
        self._view = view
        self._shelves = shelves
        self._samples: list[tuple[Sample, ...]] = []
        """Samples of each packet that contains any."""
        self._telemetry: list[Telemetry] = []
        """Telemetry after each entry of ``_samples``."""
        flown = (
            ForwardedPacket(arrived_ns, happened_ns, data)
            for arrived_ns, happened_ns, data in source.packets
            if happened_ns is not None
        )
        for samples, telemetry in samples_of(flown):
            self._samples.append(samples)
            self._telemetry.append(telemetry)
        stamps = [[each.happened_ns if each else 0 for each in t.motion] for t in self._telemetry]
        self._stamps = np.array(stamps).reshape(-1, 4)
        self._reader = StateReader(recorded_plan(source))
        self._next = 0
        self._ticks = source.ticks
        self._next_tick = 0

    def bring(self, solve: Solve) -> str | None:
        """Deliver the inputs that this solve had seen. Return a missing one's name, or None."""
        while self._next_tick < len(self._ticks):
            if (tick := self._ticks[self._next_tick]).sent_ns > solve.started_ns:
                break
            self._next_tick += 1
            self._view.receive(tick)
        if not self._bring_samples(solve):
            return "the packets of its state"
        for shelf, frame_id in zip(self._shelves, solve.frame_ids[-1], strict=True):
            if not shelf.bring(frame_id):
                return "its image, or the feature of it"
        return None

    def _has_extras(self, place: int, solve: Solve) -> bool:
        """True if, after this packet, the extra inputs equal the solve's.

        Extra inputs come in separate messages, and only the oldest one's stamp is recorded, so that
        the values must agree as well.
        """
        if not solve.state.extras:
            return True
        now = self._reader.read(self._telemetry[place], solve.started_ns, has_position=True)
        return isinstance(now, VehicleState) and (
            (now.extras, now.extras_ns) == (solve.state.extras, solve.state.extras_ns)
        )

    def _bring_samples(self, solve: Solve) -> bool:
        wanted = [getattr(solve.state, name) for name in STATE_STAMPS]
        first, last = np.searchsorted(self._stamps[:, 0], (wanted[0], wanted[0] + 1))
        places = first + np.flatnonzero((self._stamps[first:last] == wanted).all(axis=1))
        found = next((place for place in places.tolist() if self._has_extras(place, solve)), None)
        if found is None:
            return False
        end = max(self._next, found + 1)
        self._view.receive(Samples(sum(self._samples[self._next : end], ())))
        self._next = end
        return True
