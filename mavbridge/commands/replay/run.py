"""Replay command: read the flight, compute it again, report the differences."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2

from mavbridge.commands.config import ReplayConfig, ReplayFrom
from mavbridge.commands.output import print_status, require_outputs, table_console
from mavbridge.commands.replay.results import ReplayResult, draw, print_replay, to_json
from mavbridge.config.flight import FlyConfig
from mavbridge.config.settings_files import foreign_policy
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import ExitCode, UserError
from mavbridge.core.records import FeatureFrame
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import is_scripted, load_configured_policy
from mavbridge.guard.chunks import Chunk
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.folder import require_extra
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.replay.compare import (
    PolicyComparison,
    compare_guard,
    compare_policy,
    guard_traces,
    other_traces,
)
from mavbridge.simulation.replay.guard import (
    chunk_of,
    recorded_plan,
    replay_guard,
    replay_other,
)
from mavbridge.simulation.replay.policy import SolvePair, replay_policy
from mavbridge.simulation.replay.recording import ReplaySource, open_source
from policy.protocol import PolicyRunner

VIDEO_TOLERANCE = 0.15
"""Tolerance of a smoothed stick for the lossy video, in full deflections: twice the measured
difference, see docs/commands.md."""
ENGINE_TOLERANCE = 0.05
"""Tolerance of a smoothed stick on another engine, in full deflections. A single chunk can differ
by ``parity.MAX_ACTION_ERROR``."""
CLOCK_TOLERANCE = 0.01
"""Tolerance for a scripted policy, in full deflections: it reads the clock while it computes, with
differences of some 0.1 ms."""


def replay(folder: Path, config: ReplayConfig) -> int:
    """Compute a recorded flight again; return an ``ExitCode``.

    Raises:
        MavbridgeError: the flight cannot be read or replayed, or the policy cannot be loaded.
    """
    require_extra("replay")
    require_outputs(config.json, config.plot)
    source = open_source(folder)
    config = _trusted(source, config)
    chosen = _source_of(source, config)
    print_status(f"replaying {len(source.ticks)} ticks of {folder} through the guard")
    steps = replay_guard(source)
    flown = replace(source, config=other_config(source.config, config))
    plan, engine = recorded_plan(flown), source.meta.engine or ""
    chunks = {solve.serial: chunk_of(solve, source.contract) for solve in source.solves}
    compared: PolicyComparison | None = None
    if chosen != "chunks":
        clock = SteppedClock(source.solves[0].started_ns - NS_PER_S)
        with load_configured_policy(flown.config.policy, clock) as loaded:
            runner = loaded.runner
            engine = runner.engine
            plan = plan_flight(flown.config, runner.contract, is_dual=runner.dual_rate)
            pairs = _replayed(flown, runner, clock, chosen)
        compared = compare_policy(pairs)
        chunks = _other_chunks(runner, pairs)
    is_same = compared is None or compared.equal_chunks == compared.solves
    if is_same and not config.changes_limits:
        traces = guard_traces(steps)
    else:
        traces = other_traces(steps, replay_other(steps, plan.guard, chunks))
    if chosen == "video":
        names = (None, *source.contract.cameras[1:])
        damage = [text for name in names for text in open_flight(folder, name).damage]
        source = replace(source, gaps=tuple(dict.fromkeys((*source.gaps, *damage))))
    result = ReplayResult(
        source=source,
        chosen=chosen,
        engine=engine if compared else None,
        policy=compared,
        guard=compare_guard(steps),
        sticks=traces,
        tolerance=tolerance_of(
            config,
            chosen,
            recorded_engine=source.meta.engine,
            engine=engine,
            is_scripted=is_scripted(flown.config.policy),
        ),
    )
    print_replay(result, table_console())
    if config.json is not None:
        config.json.write_text(to_json(result))
    if config.plot is not None:
        draw(result, config.plot)
    return ExitCode.DONE if result.is_equal else ExitCode.DIFFERENT


def _trusted(source: ReplaySource, asked: ReplayConfig) -> ReplayConfig:
    """Return the request, without the flight's own policy if that was named again.

    Raises:
        UserError: the recording names a policy that contains code, or weights that are not a file.
    """
    flown = source.config.policy
    if (asked.policy, asked.checkpoint, asked.contract) == (
        *(flown.policy, flown.checkpoint, flown.contract),
    ):
        return replace(asked, policy=None, checkpoint=None, contract=None)
    if asked.policy is not None or asked.source == "chunks":
        return asked
    files = {"checkpoint": flown.checkpoint, "contract": flown.contract}
    if (what := foreign_policy(flown.policy)) is not None:
        given = [f"--{name} {path}" for name, path in files.items() if path is not None]
        raise UserError(
            f"{source.folder} says that it was flown by {flown.policy}, {what}, which a recording "
            "may not choose: if you know it, name it too: "
            f"{' '.join([f'--policy {flown.policy}', *given])}; or use --from chunks, which asks "
            "no policy"
        )
    for name, path in files.items():
        if path is not None and getattr(asked, name) is None and not path.is_file():
            raise UserError(
                f"{source.folder} was flown with --{name} {path}, which is no file here: name it"
            )
    return asked


def _source_of(source: ReplaySource, config: ReplayConfig) -> ReplayFrom:
    """Return the source of the policy's images; raise UserError if the recording lacks it."""
    has_features = bool(source.features)
    if config.source == "features" and not has_features:
        raise UserError(
            f"{source.folder} is of a single-rate policy, which has no features: use --from video"
        )
    if config.source != "auto":
        return config.source
    return "features" if has_features and not config.changes_encoder else "video"


def other_config(flown: FlyConfig, asked: ReplayConfig) -> FlyConfig:
    """Return the flags of the flight, overridden by those of the replay."""
    limits = {
        field.name: getattr(asked, field.name)
        for field in fields(flown.limits)
        if getattr(asked, field.name, None) is not None
    }
    names = ("policy", "checkpoint", "contract", "num_diffusion_steps")
    policy: dict[str, Any] = {
        name: getattr(asked, name)
        for name in (*names, "engine", "device")
        if getattr(asked, name) is not None
    }
    if asked.policy is not None:  # weights and files of the flight belong to another policy
        policy = {"checkpoint": None, "contract": None} | policy
    return replace(
        flown,
        limits=replace(flown.limits, **limits),
        policy=replace(flown.policy, **policy),
    )


def tolerance_of(
    config: ReplayConfig,
    chosen: ReplayFrom,
    *,
    recorded_engine: str | None,
    engine: str,
    is_scripted: bool,
) -> float | None:
    """Return the largest stick difference that counts as equal; None: no agreement is expected."""
    if config.tolerance is not None:
        return config.tolerance
    if config.is_other_policy or config.changes_limits:
        return None
    if chosen == "video":
        return VIDEO_TOLERANCE
    if chosen == "chunks":
        return 0.0
    if engine != recorded_engine:
        return ENGINE_TOLERANCE
    return CLOCK_TOLERANCE if is_scripted else 0.0


def _replayed(
    source: ReplaySource, runner: PolicyRunner, clock: SteppedClock, chosen: ReplayFrom
) -> list[SolvePair]:
    contract = runner.contract
    if contract.history_len != source.contract.history_len or (
        contract.cameras != source.contract.cameras or contract.action != source.contract.action
    ):
        raise UserError(
            "the policy has another contract than that of the flight: its cameras, its kind of "
            "action and the length of its history must be the same"
        )
    if chosen == "features":
        if contract.feature_dim != source.contract.feature_dim:
            raise UserError(
                f"the policy takes features of {contract.feature_dim} numbers, and the recorded "
                f"ones have {source.contract.feature_dim}: use --from video"
            )
        features: Sequence[Iterable[FeatureFrame]] = source.features
    else:
        features = [
            _encoded(source, runner, number, name)
            for number, name in enumerate(source.contract.cameras)
        ]
    kind = "features" if chosen == "features" else "images of the video"
    print_status(f"repeating {len(source.solves)} solves from {kind} on {runner.engine}")
    return list(replay_policy(source, runner, clock, features))


def _encoded(
    source: ReplaySource, runner: PolicyRunner, number: int, name: str
) -> Iterator[FeatureFrame]:
    """Yield the frames of one camera's video, encoded one by one, because images are large."""
    cv2.setNumThreads(1)
    flight = open_flight(source.folder, name if number else None)
    faults = {
        each.frame_id: each.fault for each in (source.features[number] if source.features else ())
    }
    for row, rgb in zip(flight.frame_rows(), flight.images(), strict=True):
        yield FeatureFrame(
            frame_id=row.frame_id,
            captured_ns=row.captured_ns,
            ready_ns=row.ready_ns,
            value=runner.encode(rgb, number).copy(),
            fault=faults.get(row.frame_id),
        )


def _other_chunks(runner: PolicyRunner, pairs: Sequence[SolvePair]) -> dict[int, Chunk]:
    """Return the new chunks by the serial numbers of the recorded ones."""
    return {
        pair.recorded.serial: chunk_of(
            replace(pair.replayed, serial=pair.recorded.serial), runner.contract
        )
        for pair in pairs
        if pair.replayed is not None
    }
