"""The loops of the flight process, composed once for a real vehicle and for the simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain

from mavbridge.camera.image_watch import ImageWatch
from mavbridge.config.flight import CameraConfig, FlyConfig
from mavbridge.config.rates import LoopRates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, period_ns
from mavbridge.core.observers import FanOut
from mavbridge.core.ports import Camera, TickSink
from mavbridge.core.records import FloatArray, ImageArray, VehicleState
from mavbridge.flight.action_frames import action_frame
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.history import SentHistory
from mavbridge.flight.observation import ObservationSource, StateHistory, observation_ages_ns
from mavbridge.flight.policy_loop import PolicyLoop, PolicySettings
from mavbridge.flight.settings import effective_freshness
from mavbridge.flight.state import Freshness
from mavbridge.flight.state_reader import StateReader
from mavbridge.flight.vehicle_view import VehicleView
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.flight.vision_rate import AdaptiveRate
from mavbridge.gate.chunks import Chunk
from mavbridge.gate.wire import Absence
from policy.contract import Contract
from policy.protocol import Executable

SPARSE_NS = 50 * NS_PER_MS
"""States of chunks that are farther apart do not tell the motion since an exposure: it takes those
in between as well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bridge:
    """Camera to feature cache, state and feature to chunks, and what the gate says of both."""

    visions: tuple[VisionLoop, ...]
    """One for each camera of the contract, in its order."""
    policy: PolicyLoop
    view: VehicleView


def build_bridge(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    send: Callable[[Chunk | Absence], object],
    cameras: Sequence[Camera],
    sinks: Sequence[TickSink],
    watches_images: bool,
    all_cameras: Sequence[TickSink] = (),
    caches: Sequence[FeatureCache] = (),
    policy_clock: Clock | None = None,
    vision_clocks: Sequence[Clock] = (),
    delay_vision: Callable[[TickSink], TickSink] | None = None,
) -> Bridge:
    """Join a policy, its cameras and the gate.

    Args:
        config: rates and limits; its camera and address are not used.
        executable: the policy on its engine.
        clock: time of everything that has no clock of its own.
        send: hands a chunk to the gate, or the reason why there is none.
        cameras: those of the contract, in its order; each is used by its vision loop alone.
        sinks: see every tick and every encoded frame of the first camera.
        watches_images: a frozen or a black image is a fault; False where nobody looks at it.
        all_cameras: see the encoded frames of the other cameras, each in the thread of its own.
        caches: one for each camera; simulation passes some that publish late.
        policy_clock: time of the policy loop, where simulated solving takes simulated time.
        vision_clocks: time of each vision loop, likewise.
        delay_vision: wraps the sink of the vision loop, for the same reason.
    """
    contract = executable.contract
    loops = config.rates.loops(is_dual=executable.dual_rate, play_s=contract.play_s)
    limits = effective_freshness(contract, config.limits)
    frame = action_frame(contract)
    freshness = Freshness(attitude_ns=limits.state_ns, velocity_ns=limits.velocity_ns)
    reader = StateReader(contract, freshness=freshness, goal_ned_m=config.goal_ned_m)
    settings = PolicySettings(
        action_frame=frame,
        chunk_dt_s=contract.chunk_dt_s,
        max_frozen_ns=round(config.limits.max_frozen_state * NS_PER_S),
        period_ns=period_ns(loops.action_hz),
    )
    past_ns = observation_ages_ns(contract)[0]
    is_sparse = contract.since_exposure and settings.period_ns > SPARSE_NS
    span_ns = past_ns + (limits.feature_ns if is_sparse else 0)
    states = StateHistory(span_ns=span_ns) if span_ns else None
    caches = caches or [FeatureCache(span_ns=past_ns) for _ in cameras]
    rates = _visual_rates(contract, loops)
    adaptive = [[rate] if rate.is_adaptive else [] for rate in rates]
    history = SentHistory(length=contract.history_len, dt_s=contract.history_dt_s, frame=frame)

    def remember() -> None:
        if states is not None:
            _push_state(states, reader, view)

    view = VehicleView(
        history=history,
        sink=FanOut([*chain(*adaptive), *sinks]),
        state_frame=contract.state_frame,
        freshness=freshness,
        on_attitude=remember,
    )
    vision_sinks = [
        FanOut([*own, *(sinks if number == 0 else all_cameras)])
        for number, own in enumerate(adaptive)
    ]
    visions = tuple(
        VisionLoop(
            camera=camera,
            encode=_encoder(executable, number),
            cache=caches[number],
            sink=delay_vision(vision_sinks[number]) if delay_vision else vision_sinks[number],
            clock=vision_clocks[number] if vision_clocks else clock,
            period_ns=rates[number].period_ns,
            image_watch=_image_watch(config.camera) if watches_images else None,
            is_airborne=lambda: view.is_airborne,
            number=number,
        )
        for number, camera in enumerate(cameras)
    )
    policy = PolicyLoop(
        clock=policy_clock or clock,
        view=view,
        reader=reader,
        observations=ObservationSource(
            contract,
            caches=caches,
            join=executable.join,
            states=states,
            max_feature_age_ns=limits.feature_ns,
        ),
        history=history,
        act=executable.act,
        reset=executable.reset,
        send=send,
        settings=settings,
    )
    return Bridge(visions=visions, policy=policy, view=view)


def _visual_rates(contract: Contract, loops: LoopRates) -> list[AdaptiveRate]:
    """Rate of each camera: that of the flight, or of the contract where that is lower."""
    return [
        AdaptiveRate(min_hz=min(loops.min_vision_hz, hz), max_hz=min(loops.max_vision_hz, hz))
        for hz in contract.camera_rates_hz or (loops.max_vision_hz,) * len(contract.cameras)
    ]


def _push_state(states: StateHistory, reader: StateReader, view: VehicleView) -> None:
    """Remember the state at the attitude that has just come in."""
    has_position = view.status.has_position
    state = reader.read(view.telemetry(), view.attitude_ns, has_position=has_position)
    if isinstance(state, VehicleState):
        states.push(state)


def _encoder(executable: Executable, camera: int) -> Callable[[ImageArray], FloatArray]:
    return executable.encode if camera == 0 else lambda rgb: executable.encode(rgb, camera)


def _image_watch(config: CameraConfig) -> ImageWatch:
    return ImageWatch(max_frozen_s=config.max_frozen_image, max_black_s=config.max_black_image)
