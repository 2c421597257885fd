"""``mavbridge replay``: read a flight, compute it again, report the differences."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
from rich.console import Console

from mavbridge.commands.config import ReplayConfig, ReplayFrom
from mavbridge.commands.output import (
    BLUE,
    FIGURE_DPI,
    FIGURE_STYLE,
    GREY,
    MUTED,
    make_table,
    print_status,
    require_outputs,
    table_console,
    write_json,
)
from mavbridge.config.flight import FlyConfig, Limits
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.settings_files import foreign_policy
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import ExitCode, UserError
from mavbridge.core.records import FeatureFrame
from mavbridge.core.vehicle import ACTION_CLASSES
from mavbridge.flight.history import ActionFrame
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import is_scripted, is_stateless, load_configured_policy
from mavbridge.flight.policy_loop import chunk_of
from mavbridge.recording.flight_folder import open_cameras, open_flight
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.replay.compare import (
    PAST_INPUTS,
    Deviation,
    GuardComparison,
    PolicyComparison,
    StickTraces,
    compare_guard,
    compare_policy,
    forgotten,
    losses,
    stick_traces,
)
from mavbridge.simulation.replay.guard import (
    recorded_plan,
    replay_guard,
    replay_other,
    unrepeatable,
)
from mavbridge.simulation.replay.policy import SolvePair, replay_policy
from mavbridge.simulation.replay.recording import ReplaySource, open_source
from policy.errors import NoChunkError
from policy.protocol import PolicyRunner

VIDEO_TOLERANCE = 0.15
"""Tolerance of a smoothed stick for the lossy video, in full deflections: twice that measured."""
ENGINE_TOLERANCE = 0.05
"""Tolerance of a smoothed stick on another engine, in full deflections. A single chunk can differ
by ``choose.MAX_ACTION_ERROR``."""
CLOCK_TOLERANCE = 0.01
"""Tolerance for a scripted policy, in full deflections: it reads the clock while it computes, with
differences of some 0.1 ms."""


def replay(folder: Path, config: ReplayConfig) -> int:
    """Compute a recorded flight again; return an ``ExitCode``."""
    require_outputs(config.json, config.plot)
    source = open_source(folder)
    gaps = [*source.gaps, *unrepeatable(source.ticks)]
    require_trusted(source, config)
    wanted = other_config(source.config, config)
    chosen = _source_of(source, config.source, wanted)
    print_status(f"replaying {len(source.ticks)} ticks of {folder} through the guard")
    steps = replay_guard(source)
    flown = replace(source, config=wanted)
    plan, engine = recorded_plan(flown), source.meta.engine or ""
    frame = ActionFrame(source.contract)
    chunks = {solve.serial: chunk_of(solve, frame) for solve in source.solves}
    compared: PolicyComparison | None = None
    if chosen != "chunks":
        clock = SteppedClock(source.solves[0].started_ns - NS_PER_S)
        in_air = wanted.takeoff is not None
        with load_configured_policy(wanted.policy, clock, starts_in_air=in_air) as loaded:
            runner, engine = loaded.runner, loaded.runner.engine
            plan = plan_flight(wanted, runner.contract, is_dual=runner.dual_rate)
            pairs = _replayed(flown, runner, clock, chosen)
        compared = compare_policy(pairs)
        # The new chunks, by the serial numbers of the recorded ones.
        chunks = {
            pair.recorded.serial: chunk_of(
                replace(pair.replayed, serial=pair.recorded.serial), ActionFrame(runner.contract)
            )
            for pair in pairs
            if pair.replayed is not None
        }
    traces = stick_traces(steps, (step.replayed for step in steps))
    is_same = compared is None or compared.equal_chunks == compared.solves
    if wanted.limits != source.config.limits or not is_same:
        traces = stick_traces(steps, replay_other(steps, plan.guard, chunks))
    if chosen == "video":
        gaps += [text for camera in open_cameras(folder) for text in camera.damage]
    result = ReplayResult(
        source=source,
        gaps=tuple(dict.fromkeys(gaps)),
        chosen=chosen,
        engine=engine if compared else None,
        policy=compared,
        guard=compare_guard(steps),
        sticks=traces,
        tolerance=tolerance_of(
            config, source.config, wanted, chosen, is_same_engine=engine == source.meta.engine
        ),
    )
    if compared and result.problems and not is_stateless(wanted.policy):
        told = forgotten(compared, has_reset=runner.has_state)
        result = replace(result, gaps=(*result.gaps, *told))
    print_replay(result, table_console())
    # JSON lacks NaN, as of a chunk that was not finite.
    document = json.loads(json.dumps(as_document(result)), parse_constant=lambda _: None)
    write_json(config.json, document)
    if config.plot is not None:
        draw(result, config.plot)
    return ExitCode.DONE if result.is_equal else ExitCode.DIFFERENT


def require_trusted(source: ReplaySource, asked: ReplayConfig) -> None:
    """Raise UserError if the recording names a policy that contains code, a server, or weights that
    are not a file, and the user names none."""
    if asked.policy is not None or asked.source == "chunks":
        return
    flown = source.config.policy
    files = {"checkpoint": flown.checkpoint, "contract": flown.contract}
    what = foreign_policy(flown.policy)
    if flown.policy.startswith(("ws:", "wss:")):  # also one on this computer: it would get the key
        what = "a policy server"
    if what is not None:
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


def _weights(flight: FlyConfig) -> tuple[str, Path | None, Path | None]:
    """Return what the features of a flight depend on: policy, checkpoint and contract file."""
    return flight.policy.policy, flight.policy.checkpoint, flight.policy.contract


def _source_of(source: ReplaySource, asked: ReplayFrom, wanted: FlyConfig) -> ReplayFrom:
    """Return the source of the policy's images; raise UserError if the recording lacks it."""
    has_features = bool(source.features)
    if asked == "features" and not has_features:
        raise UserError(
            f"{source.folder} is of a single-rate policy, which has no features: use --from video"
        )
    if asked != "auto":
        return asked
    return "features" if has_features and _weights(wanted) == _weights(source.config) else "video"


def other_config(flown: FlyConfig, asked: ReplayConfig) -> FlyConfig:
    """Return the flags of the flight, overridden by those of the replay."""

    def given(config: Limits | PolicyConfig) -> dict[str, Any]:
        found = {field.name: getattr(asked, field.name, None) for field in fields(config)}
        return {name: value for name, value in found.items() if value is not None}

    limits, policy = given(flown.limits), given(flown.policy)
    if asked.policy is not None:  # weights and files of the flight belong to another policy
        own = ("checkpoint", "contract", "by_rates", "image_size", "allow_untrained")
        policy = {name: getattr(PolicyConfig(), name) for name in own} | policy
    limited, other = replace(flown.limits, **limits), replace(flown.policy, **policy)
    return replace(flown, limits=limited, policy=other)


def tolerance_of(
    asked: ReplayConfig,
    flown: FlyConfig,
    wanted: FlyConfig,
    chosen: ReplayFrom,
    *,
    is_same_engine: bool,
) -> float | None:
    """Return the largest stick difference that counts as equal; None: no agreement is expected."""
    if asked.tolerance is not None:
        return asked.tolerance
    is_same_policy = (
        _weights(wanted) == _weights(flown) and wanted.policy.steps == flown.policy.steps
    )
    if not is_same_policy or wanted.limits != flown.limits:
        return None
    if chosen == "video":
        return VIDEO_TOLERANCE
    if chosen == "chunks":
        return 0.0
    if not is_same_engine:
        return ENGINE_TOLERANCE
    return CLOCK_TOLERANCE if is_scripted(wanted.policy) else 0.0


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
    flight = open_flight(source.folder, name)
    faults = {
        each.frame_id: each.fault for each in (source.features[number] if source.features else ())
    }
    for row, rgb in zip(flight.frame_rows(), flight.images(), strict=True):
        try:
            value = runner.encode(rgb, number).copy()
        except NoChunkError:
            continue  # as in flight, where the image has no feature
        yield FeatureFrame(
            frame_id=row.frame_id,
            captured_ns=row.captured_ns,
            ready_ns=row.ready_ns,
            value=value,
            fault=faults.get(row.frame_id),
        )


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """Results of one replay."""

    source: ReplaySource
    gaps: tuple[str, ...]
    """Where the recording lacks something, so that the replay may differ."""
    chosen: ReplayFrom
    engine: str | None
    """Engine of the policy; None: the policy was not used."""
    policy: PolicyComparison | None
    guard: GuardComparison
    """Comparison with the recorded chunks and settings."""
    sticks: StickTraces
    """Sticks from the new chunks and settings."""
    tolerance: float | None
    """None: the policy or the limits were changed, so that no agreement is expected."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons why the replay is not equal, in words."""
        found = []
        if self.guard.first is not None:
            found.append(f"the guard came out differently, first in the {self.guard.first}")
        if self.tolerance is None:
            return tuple(found)
        found += losses(self.policy, self.sticks)
        if (policy := self.policy) is not None:
            for name, count in policy.inputs_differ.items():
                if name not in PAST_INPUTS:
                    found.append(f"{count} solves were given another input: {name}")
            other = policy.solves - policy.equal_chunks
            if other and self.tolerance == 0:
                found.append(f"{other} of {policy.solves} chunks differ")
        if (most := self.sticks.deviation.most) > self.tolerance:
            found.append(f"an action is off by {most:.4g}, more than {self.tolerance:g}")
        return tuple(found)

    @property
    def is_equal(self) -> bool:
        """True if it is equal within the tolerance, or no agreement was expected."""
        return not self.problems


def print_replay(result: ReplayResult, console: Console) -> None:
    """Print tables, and a verdict in words."""
    names = ACTION_CLASSES[result.source.contract.action]._fields
    rows = []
    if (policy := result.policy) is not None:
        equal = f"{policy.equal_chunks} of {policy.solves} chunks"
        rows.append(_row("policy: chunks", equal, policy.deviation))
    guard = result.guard
    same = f"{guard.steps - max(guard.differ.values(), default=0)} of {guard.steps} ticks"
    rows.append(_row("guard: sticks, recorded chunks", same, guard.deviation))
    if result.policy is not None or result.tolerance is None:
        moved = result.sticks.deviation
        rows.append(_row("sticks, these chunks and limits", "", moved))
        rows.append(_row("the same, rms", "", Deviation(largest=moved.rms, rms=moved.rms)))
    title = f"replay of {result.source.folder} from {result.chosen}"
    header = ["largest difference", "equal", *names]
    console.print(make_table(title, header, rows, left_columns=2))
    recorded = f"recorded with {result.source.meta.policy} on {result.source.meta.engine}"
    console.print(recorded + (f", replayed on {result.engine}" if result.engine else ""))
    alone = losses(result.policy, result.sticks) if result.tolerance is None else ()
    for gap in (*result.gaps, *alone):
        console.print(f"note: {gap}", style="yellow")
    past = result.policy.inputs_differ if result.policy and result.tolerance is not None else {}
    for name in filter(past.get, PAST_INPUTS):
        note = f"{name} of {past[name]} solves are the recorded ones: built anew, they differ"
        console.print(f"note: {note}", style="yellow")
    for problem in result.problems:
        console.print(f"different: {problem}", style="red")
    console.print(_verdict(result), style="bold")


def _verdict(result: ReplayResult) -> str:
    if not result.is_equal:
        return "NOT EQUAL, perhaps for the notes above" if result.gaps else "NOT EQUAL"
    if result.tolerance is None:
        return "the difference is what was asked for"
    if result.tolerance == 0:
        return "EQUAL, bit for bit"
    return f"EQUAL within {result.tolerance:g}"


def _row(name: str, equal: str, deviation: Deviation) -> list[str]:
    return [name, equal, *("0" if each == 0 else f"{each:.2g}" for each in deviation.largest)]


def as_document(result: ReplayResult) -> dict[str, object]:
    """Return all figures for ``--json``."""
    return {
        "flight": str(result.source.folder),
        "from": result.chosen,
        "recorded_engine": result.source.meta.engine,
        "engine": result.engine,
        "tolerance": result.tolerance,
        "is_equal": None if result.tolerance is None and result.is_equal else result.is_equal,
        "problems": result.problems,
        "gaps": result.gaps,
        "policy": None if result.policy is None else asdict(result.policy),
        "guard": asdict(result.guard),
        "sticks": asdict(result.sticks.deviation) | {"flown_by_one": result.sticks.flown_by_one},
    }


def draw(result: ReplayResult, path: Path) -> None:
    """Draw the smoothed sticks, recorded and replayed, over time: one row per stick."""
    from matplotlib import style
    from matplotlib.figure import Figure

    names = ACTION_CLASSES[result.source.contract.action]._fields
    sticks = result.sticks
    with style.context(FIGURE_STYLE):
        figure = Figure(figsize=(12.0, 8.0), dpi=FIGURE_DPI, facecolor="white")
        rows = figure.subplots(4, 1, sharex=True)
        for number, (axes, name) in enumerate(zip(rows, names, strict=True)):
            for values, label, color, width in (
                (sticks.recorded, "recorded", GREY, 3.0),
                (sticks.replayed, "replayed", BLUE, 1.2),
            ):
                axes.plot(sticks.times_s, values[:, number], color=color, lw=width, label=label)
            largest = sticks.deviation.largest[number]
            axes.set_title(f"{name}, largest difference {largest:.2g}", fontsize=10)
        rows[0].legend(loc="upper right", ncols=2)
        rows[-1].set_xlabel("s since the first tick")
        name = result.source.folder.name.encode(errors="replace").decode()
        title = f"{name}: smoothed actions, replayed from {result.chosen}"
        figure.suptitle(title, x=0.012, ha="left", color=MUTED, fontsize=10)
        figure.tight_layout(rect=(0, 0, 1, 0.98))
        try:
            figure.savefig(path)
        except OSError as error:
            raise UserError(f"cannot write --plot {path}: {error.strerror or error}") from error
