"""Loops of a flight and its guard on virtual time, with a fake vehicle and policy."""

from collections.abc import Callable
from itertools import repeat
from typing import Any

import numpy as np

from helpers.fakes import START_NS, FakeLink, ListSink
from helpers.guard_facts import codes
from mavbridge.config.flight import FlyConfig, Limits, LinkConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FloatArray, Frame, ImageArray, Tick
from mavbridge.core.vehicle import Command, Sticks
from mavbridge.flight.bridge import CameraPath, build_bridge
from mavbridge.flight.plan import plan_flight
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.values import EndRequest, Phase
from mavbridge.simulation.clock import AheadClock, SteppedClock, Stepper
from mavbridge.simulation.guard import GuardStepper, MemoryPort, flight_process, sender
from mavbridge.simulation.network import DelayedChannel
from mavbridge.simulation.world import DelayedFeatureCache, DelayedSink
from policy.contract import Contract
from policy.protocol import PolicyRunner

MS = NS_PER_MS
FRAME_NS = NS_PER_S // 30
HOP_NS = MS // 10
"""Latency of a message between the processes."""
SIGNAL = because(Code.SIGNAL)
STEADY = np.full((1, 16, 4), 0.25, np.float32)
SHARP = Limits(tau=0.0, max_slew=0.0)
"""No smoothing."""


def nan_chunk() -> FloatArray:
    """Return a chunk with one action that is not finite."""
    chunk = STEADY.copy()
    chunk[0, 9, 1] = np.nan
    return chunk


class EventCamera:
    """Camera with frames at given times; the newest wins, and skipped ones are counted."""

    def __init__(self, world: SteppedClock, captured_ns: list[int]) -> None:
        self._arrived: Frame | None = None
        self.dropped_frames = 0
        self.arrival_watchers: list[Callable[[], None]] = []
        for frame_id, at_ns in enumerate(captured_ns, start=1):
            rgb = np.zeros((4, 4, 3), dtype=np.uint8)
            frame = Frame(frame_id=frame_id, captured_ns=at_ns, rgb=rgb)
            world.schedule(at_ns, lambda frame=frame: self._arrive(frame))
        self.change: Callable[[Frame], Frame] = lambda frame: frame

    def has_frame(self) -> bool:
        return self._arrived is not None

    def _arrive(self, frame: Frame) -> None:
        self.dropped_frames += self.has_frame()
        self._arrived = frame
        for watch in self.arrival_watchers:
            watch()

    def read(self, timeout_ns: int) -> Frame | None:
        frame, self._arrived = self._arrived, None
        return None if frame is None else self.change(frame)

    def close(self) -> None:
        pass


class VirtualFlight:
    """A bridge that engages as soon as everything is ready; ``fly`` lets time pass.

    Durations and outputs of the policy are functions of the number of the solve. Attitudes arrive
    every ``state_period_ns``, the first one ``state_phase_ns`` after the start.
    """

    def __init__(
        self,
        *,
        contract: Contract | None = None,
        rates: Rates | None = None,
        limits: Limits = SHARP,
        frames_ns: list[int] | None = None,
        encode_ns: int = 25 * MS,
        act_ns: Callable[[int], int] = lambda solve: 3 * MS,
        chunk: Callable[[int], FloatArray] = lambda solve: STEADY,
        state_period_ns: int = 10 * MS,
        state_phase_ns: int = 3 * MS,
        status: dict[str, Any] | None = None,
        **config: Any,
    ) -> None:
        self.world = SteppedClock(START_NS)
        self.config = FlyConfig(
            link=LinkConfig(connect="memory"),
            rates=rates or Rates(),
            limits=limits,
            **({"arm": True} | config),
        )
        self._encode_ns, self._act_ns, self._chunk = encode_ns, act_ns, chunk
        self._state_period_ns = state_period_ns
        self.link = FakeLink(self.world, **(status or {}))
        self.measure: Callable[[], None] = lambda: self.link.measure(age_ns=2 * MS)
        """Called when an attitude is due."""
        self.sink = ListSink()
        self.histories: list[FloatArray] = []
        self.states: list[FloatArray] = []
        self.resets = 0
        if frames_ns is None:
            frames_ns = [START_NS + k * FRAME_NS for k in range(400)]
        self.camera = EventCamera(self.world, frames_ns)
        self._policy_clock, self._vision_clock = AheadClock(self.world), AheadClock(self.world)
        self.guard = self._compose(contract or Contract(feature_dim=8, arrays="numpy"))
        self.world.schedule(START_NS + state_phase_ns, self._measure)

    def _compose(self, contract: Contract) -> GuardLoop:
        world = self.world
        runner = PolicyRunner(
            contract=contract,
            name="test",
            engine="numpy",
            dual_rate=True,
            encode=self._encode,
            act=self._act,
            reset=self._reset,
        )
        to_guard, to_flight = (DelayedChannel(world, repeat(HOP_NS)) for _ in range(2))
        port = MemoryPort(outgoing=to_guard, incoming=to_flight)
        self._send = sender(world, self._policy_clock, port)
        guard = GuardLoop(world, self.link, MemoryPort(outgoing=to_flight, incoming=to_guard))
        plan = plan_flight(self.config, runner.contract, is_dual=runner.dual_rate)
        self._send(plan.guard)
        bridge = build_bridge(
            plan,
            runner,
            clock=self._policy_clock,
            send=self._send,
            cameras=[
                CameraPath(
                    camera=self.camera, cache=DelayedFeatureCache(world), clock=self._vision_clock
                )
            ],
            sinks=(self.sink,),
            watches_images=False,
            delay_vision=lambda sink: DelayedSink(world, sink),
        )
        self.view = bridge.view
        stepper = Stepper(world, self._vision_clock, self.camera.has_frame, bridge.visions[0].step)
        self.camera.arrival_watchers.append(stepper.run)
        receive = flight_process(world, self._policy_clock, port, bridge.policy, bridge.view)
        self._guard_stepper = GuardStepper(world, guard)
        to_flight.on_arrival, to_guard.on_arrival = receive, self._guard_stepper.step
        return guard

    def _encode(self, rgb: ImageArray) -> FloatArray:
        self._vision_clock.ahead_ns += self._encode_ns
        return np.zeros((1, 8), dtype=np.float32)

    def _act(self, feature: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        solve = len(self.histories)
        self.states.append(state)
        self.histories.append(history)
        self._policy_clock.ahead_ns += self._act_ns(solve)
        return self._chunk(solve)

    def _reset(self) -> None:
        self.resets += 1

    def _measure(self) -> None:
        self.measure()
        self._guard_stepper.step()
        self.world.schedule(self.world.now_ns() + self._state_period_ns, self._measure)

    # --- events

    def at(self, seconds: float, event: Callable[[], object]) -> "VirtualFlight":
        """Call a function after this time."""
        self.world.schedule(START_NS + round(seconds * NS_PER_S), event)
        return self

    def tell(self, message: Any) -> None:
        """Send the guard a message."""
        self._send(message)

    def stop(self, reason: Reason = SIGNAL) -> None:
        self.tell(EndRequest(reason=reason))

    def fly(self, seconds: float) -> "VirtualFlight":
        """Let time pass."""
        self.world.sleep_until_ns(self.world.now_ns() + round(seconds * NS_PER_S))
        return self

    # --- what happened

    @property
    def flown(self) -> list[Tick]:
        """Ticks in which the policy moved the sticks."""
        return [tick for tick in self.sink.ticks if tick.trace is not None]

    @property
    def phase(self) -> Phase:
        return self.view.phase

    @property
    def reason(self) -> Reason | None:
        return self.view.reason

    @property
    def codes(self) -> tuple[Code, ...]:
        return codes(self.reason)

    @property
    def sent(self) -> list[tuple[float, Sticks | None]]:
        """Seconds since the start and sticks of every send; None: a release."""
        return [
            (
                (at_ns - START_NS) / NS_PER_S,
                decision.action if isinstance(decision, Command) else None,
            )
            for at_ns, decision in self.link.decisions
        ]
