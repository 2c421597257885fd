"""A replay gives each solve what it was given in flight, whatever the contract asks for."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.fakes import ListSink
from helpers.output_flights import HOVERING, OutputFlight
from helpers.recordings import make_meta
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FeatureFrame, Solve, Tick, TickSink, VisionTick
from mavbridge.core.vehicle import ActionKind, ForwardedPacket
from mavbridge.flight.history import ActionFrame
from mavbridge.flight.policy_loop import chunk_of
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.values import Phase
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.simulation import flight as simulation
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.replay.compare import (
    PAST_INPUTS,
    compare_guard,
    compare_policy,
)
from mavbridge.simulation.replay.guard import recorded_plan, replay_guard, replay_other
from mavbridge.simulation.replay.policy import SolvePair, replay_policy
from mavbridge.simulation.replay.recording import RecordedPacket, ReplaySource
from mavbridge.simulation.world import make_vehicle
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner
from policy.errors import NoChunkError
from policy.protocol import PolicyRunner
from sitl.vehicle.config import AutopilotName

FLIGHT_S = 1.5
BASE = Contract(arrays="numpy", feature_dim=3, image_height=32, image_width=32, horizon=16)


class Attentive:
    """Climbs, and lets every number that it is given, and its own memory, move the action a bit."""

    def __init__(self, contract: Contract) -> None:
        self.contract = contract
        self._solves = 0

    def reset(self) -> None:
        self._solves = 0

    def encode_visual(self, image: np.ndarray, camera: int = 0) -> np.ndarray:
        mean = image.mean(axis=(0, 2, 3)).astype(np.float32)
        return (mean + camera)[None]

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        self._solves += 1
        seen = [float(np.nan_to_num(each).sum()) for each in (feature, state, history)]
        moved = 0.02 * np.sin(np.array([*seen, self._solves], np.float32))
        at_rest = (
            [0.6, 0, 0, 0] if self.contract.action in ("rates", "attitude") else [0.3, 0, 0, 0]
        )
        if self.contract.action == "velocity":
            at_rest = [0, 0, -0.5, 0]
        state[...] = 0.0  # what a policy does with its own arrays is its business
        return np.tile((np.array(at_rest, np.float32) + moved).astype(np.float32), (1, 16, 1))

    predict = predict_fast


class Hesitant(Attentive):
    """Has no chunk now and then: those solves are not in a recording."""

    def predict_fast(self, feature: Any, state: Any, history: Any, steps: int) -> np.ndarray:
        if 0.0 < float(state.sum()) % 1.0 < 0.1:  # not on the dummy sample
            raise NoChunkError("not now")
        return super().predict_fast(feature, state, history, steps)


@dataclass
class Flown:
    """What a recording holds of a flight, kept in memory."""

    sink: ListSink = field(default_factory=ListSink)
    solves: list[Solve] = field(default_factory=list)
    packets: list[ForwardedPacket] = field(default_factory=list)

    def source(self, runner: PolicyRunner, goal: str | None) -> ReplaySource:
        cameras: list[list[FeatureFrame]] = [[] for _ in runner.contract.cameras]
        for event in self.sink.events:
            if isinstance(event, VisionTick) and event.feature is not None:
                frame = FeatureFrame(
                    frame_id=event.frame_id,
                    captured_ns=event.captured_ns,
                    ready_ns=event.ready_ns,
                    value=event.feature,
                    fault=event.fault,
                )
                cameras[event.camera].append(frame)
        mode = "dual" if runner.dual_rate else "single"
        return ReplaySource(
            folder=Path("in memory"),
            meta=make_meta(contract=runner.contract, mode=mode, autopilot="ardupilot"),
            config=FlyConfig(arm=True, goal=goal),
            ticks=tuple(event for event in self.sink.events if isinstance(event, Tick)),
            solves=tuple(self.solves),
            features=tuple(map(tuple, cameras)),
            packets=tuple(
                RecordedPacket(p.arrived_ns, p.happened_ns, p.data) for p in self.packets
            ),
            known_params=frozenset(),
            requested_ns=(),
            gaps=(),
        )


def flown_and_repeated(
    monkeypatch: pytest.MonkeyPatch,
    make: Callable[[], PolicyRunner],
    other: Callable[[], PolicyRunner] | None = None,
    *,
    goal: str | None = None,
    autopilot: AutopilotName = "ardupilot",
) -> list[SolvePair]:
    """A short flight, and every solve of it once more, or by the other policy."""
    flown, loops = Flown(), simulation.vision_loops

    def recorded(*arguments: Any, sinks: list[TickSink], **named: Any) -> Any:
        others = [flown.sink] * len(sinks[1:])
        return loops(*arguments, sinks=[*sinks[:1], *others], **named)

    parts = {
        "vision_loops": recorded,
        "TelemetryCache": partial(TelemetryCache, watch_packets=flown.packets.extend),
    }
    for name, part in parts.items():
        monkeypatch.setattr(simulation, name, part)
    monkeypatch.setattr(simulation, "MavlinkLink", partial(MavlinkLink, keeps_packets=True))
    settings = SimulationSettings(config=FlyConfig(goal=goal), least_camera_px=32)
    vehicle = make_vehicle(autopilot=autopilot)
    one = SimulatedFlight(course_seed=3, seed=1, settings=settings, vehicle=vehicle)
    one.solve_watchers.append(flown.solves.append)
    runner = make()
    one.fly(runner, max_time_s=FLIGHT_S, sinks=(flown.sink,))
    source = flown.source(runner, goal)
    clock = SteppedClock(source.solves[0].started_ns - NS_PER_S)
    return list(replay_policy(source, (other or make)(), clock, source.features))


def attentive(kind: type[Attentive] = Attentive, **changes: Any) -> Callable[[], PolicyRunner]:
    settings = ExecutionSettings(name="attentive", dual_rate=changes.pop("dual_rate", True))
    contract = replace(BASE, modes=(), **changes)
    return lambda: make_numpy_runner(kind(contract), settings)


TWO_EYES = {"cameras": ("front", "down"), "camera_rates_hz": (30.0, 10.0)}
PAST = {"observation_steps": 3, "observation_dt_s": 0.07}


@pytest.mark.parametrize(
    "changes",
    [
        {"dual_rate": False, "state_extras": ("height", "goal", "altitude")},
        {"state_extras": ("height",), "state_frame": "enu_flu", "since_exposure": True, **PAST},
        {"state_time": "execution", "since_exposure": True, "state_extras": ("altitude", "height")},
        {"state_time": "execution", "action": "velocity", "state_frame": "enu_flu", **PAST},
        {"state_extras": ("height",), **TWO_EYES, **PAST},
        {"history_len": 1, "history_dt_s": 0.001},
        {"prefix_len": 4, "history_len": 64, "history_dt_s": 0.003},
        {"action": "attitude", "state_extras": ("height",)},
        {"autopilot": "px4", "state_extras": ("height", "altitude")},
        {"autopilot": "px4", "action": "rates", "state_frame": "enu_flu"},
    ],
    ids=", ".join,
)
def test_every_input_and_kind_of_action_is_repeated_bit_for_bit(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
) -> None:
    contract = {name: value for name, value in changes.items() if name != "autopilot"}
    flown = {"autopilot": changes.get("autopilot", "ardupilot")}
    if "goal" in changes.get("state_extras", ()):
        flown["goal"] = "5,2,-3"
    compared = compare_policy(flown_and_repeated(monkeypatch, attentive(**contract), **flown))
    assert (compared.missing, compared.inputs_differ) == ({}, {})
    assert compared.equal_chunks == compared.solves >= 50


def test_another_policy_is_given_the_past_images_of_its_own_contract(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    newest_only, also_past = attentive(), attentive(observation_steps=2, observation_dt_s=0.3)
    pairs = flown_and_repeated(monkeypatch, newest_only, also_past)
    past, newest = np.array([pair.replayed.frame_ids for pair in pairs if pair.replayed])[-10:].T[0]
    assert (newest - past).tolist() == [9] * 10  # 0.3 s at 30 Hz


def test_what_solves_without_a_chunk_had_seen_does_not_change_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What they saw counts in later past states, and is not recorded: these are taken as given."""
    make = attentive(Hesitant, state_extras=("height",), **PAST)
    compared = compare_policy(flown_and_repeated(monkeypatch, make))
    assert compared.missing == {}
    assert set(compared.inputs_differ) <= set(PAST_INPUTS)
    assert compared.equal_chunks == compared.solves >= 50


def hold_and_quit(flight: OutputFlight) -> None:
    flight.act("release")
    flight.until(lambda: flight.phase is Phase.HOLDING, within_s=8)
    flight.act("release")


def lose_camera(flight: OutputFlight) -> None:
    last = flight.features.latest()
    flight.features.latest = lambda: last  # type: ignore[method-assign]


def have_no_chunk(flight: OutputFlight) -> None:
    def refuse(*_: object) -> None:
        raise NoChunkError("not now")

    flight.scripted.predict_fast = refuse  # type: ignore[assignment]


def lose_connection(flight: OutputFlight) -> None:
    flight.network.is_down = True
    flight.run(0.3)
    flight.network.is_down = False
    flight.run(0.8)


def fall_silent(flight: OutputFlight) -> None:
    """The grace ends between two slots, and is found to by the next word of the flight process."""
    flight.down.is_silent = True
    while flight.phase is Phase.FLYING:
        flight.run(0.0037)
        flight.tell(because(Code.NO_CHUNK))
    flight.down.is_silent = False


@pytest.mark.parametrize(
    ("autopilot", "action", "end"),
    [
        ("ardupilot", "sticks", fall_silent),
        ("px4", "sticks", hold_and_quit),
        ("px4", "sticks", OutputFlight.return_nan),
        ("ardupilot", "velocity", lose_camera),
        ("ardupilot", "velocity", have_no_chunk),
        ("ardupilot", "velocity", lose_connection),
    ],
)
def test_the_guard_is_repeated_to_the_end_of_a_flight(
    autopilot: AutopilotName, action: ActionKind, end: Callable[[OutputFlight], None]
) -> None:
    flight = OutputFlight(autopilot, action)
    flight.fly(0.2)
    end(flight)
    flight.run(0.5)
    source = recorded(flight)
    assert source.ticks[-1].phase != "flying"
    assert compare_guard(replay_guard(source)).differ == {}


@pytest.mark.parametrize("action", ["sticks", "velocity"])
def test_a_mode_that_is_entered_before_the_slot_after_its_request_is_no_takeover(
    action: ActionKind,
) -> None:
    flight = OutputFlight("px4", action, HOVERING, arm=True, takeoff=1.0)
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=30)
    flight.run(0.2)
    source = recorded(flight, arm=True, takeoff=1.0)
    steps = replay_guard(source)
    assert compare_guard(steps).differ == {}
    chunks = {
        solve.serial: chunk_of(solve, ActionFrame(source.contract)) for solve in source.solves
    }
    ticks = replay_other(steps, recorded_plan(source).guard, chunks)
    assert [tick.phase.value for tick in ticks] == [tick.phase for tick in source.ticks]


@pytest.mark.parametrize("seed", [5, 6])
def test_passes_of_the_guard_at_any_times_are_repeated(seed: int) -> None:
    """Parameters that the vehicle lacks are asked for again in the first pass after a timeout."""
    flight, random = OutputFlight("px4", "sticks", arm=True), np.random.default_rng(seed)
    while flight.phase is not Phase.FLYING:
        flight.run(random.uniform(0.0005, 0.01))
        flight.guard.step()
    flight.run(0.2)
    assert compare_guard(replay_guard(recorded(flight, arm=True))).differ == {}


def recorded(flight: OutputFlight, **config: Any) -> ReplaySource:
    requests = [
        (at_ns, m)
        for at_ns, m in flight.left()
        if m.get_type() in ("PARAM_REQUEST_READ", "COMMAND_LONG")
    ]
    return ReplaySource(
        folder=Path("in memory"),
        meta=make_meta(
            contract=flight.scripted.contract, autopilot="px4" if flight.is_px4 else "ardupilot"
        ),
        config=FlyConfig(link=LinkConfig(connect="memory"), **config),
        ticks=tuple(flight.sink.ticks),
        solves=tuple(flight.solves),
        features=((),),
        packets=tuple(RecordedPacket(r.arrived_ns, None, r.data) for r in flight.network.received),
        known_params=frozenset(m.param_id for _, m in requests if hasattr(m, "param_id")),
        requested_ns=tuple(at_ns for at_ns, _ in requests),
        gaps=(),
    )
