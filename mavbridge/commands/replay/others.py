"""Other people's recordings: a policy beside a telemetry log with a video, or along a dataset.

There is nothing that its actions must be equal with.
"""

from pathlib import Path

import cv2

from mavbridge.commands.output import print_status, table_console
from mavbridge.commands.replay.actions import ActionResult, print_actions, to_json
from mavbridge.commands.replay.config import ReplayConfig
from mavbridge.config.flight import FlyConfig
from mavbridge.core.errors import ExitCode, UserError
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.replay.actions import compare_actions
from mavbridge.simulation.replay.dataset import EpisodeReplay, open_episode
from mavbridge.simulation.replay.log_policy import LogReplay, LogVideo
from mavbridge.simulation.replay.telemetry_log import open_log


def replay_log(path: Path, flight: FlyConfig, config: ReplayConfig) -> int:
    """Compare a policy with the pilot in a telemetry log; returns an ``ExitCode``.

    Raises:
        MavbridgeError: log or video cannot be read, do not overlap, or do not suit the policy.
    """
    config.require_others()
    if config.video is None:
        raise UserError(f"{path} is a telemetry log without images: name a video of it by --video")
    log = open_log(path)
    video = LogVideo(config.video, start_s=config.video_start)
    cv2.setNumThreads(1)
    clock = SteppedClock()
    try:
        with load_configured_policy(flight.policy, clock, starts_in_air=True) as loaded:
            executable = loaded.executable
            replay = LogReplay(log, video, executable, flight, clock)
            print_status(f"{executable.name} beside {log.seconds:.1f} s of {path}")
            actions = compare_actions(list(replay.run()))
    finally:
        video.close()
    refused = [f"refused {count} times: {why}" for why, count in replay.refusals.most_common()]
    if not len(actions.times_s):
        why = refused[0] if refused else "no attitude came while the video ran"
        raise UserError(f"the policy decided nothing beside {path}: {why}")
    result = ActionResult(
        name=path.name,
        recorded_by="the pilot",
        policy=executable.name,
        engine=executable.engine,
        actions=actions,
        notes=(*filter(None, (log.damage, video.damage, replay.note)), *refused),
    )
    return _show(result, config)


def replay_dataset(folder: Path, flight: FlyConfig, config: ReplayConfig) -> int:
    """Compare a policy with the actions in an episode of a dataset; returns an ``ExitCode``.

    Raises:
        MavbridgeError: the dataset cannot be read, or does not suit the policy.
    """
    config.require_others()
    episode = open_episode(folder, config.episode)
    cv2.setNumThreads(1)
    clock = SteppedClock()
    with load_configured_policy(flight.policy, clock, starts_in_air=True) as loaded:
        executable = loaded.executable
        print_status(f"{executable.name} along {len(episode.captured_ns)} rows of {episode.name}")
        actions = compare_actions(list(EpisodeReplay(episode, executable, flight, clock).run()))
    missing = len(episode.captured_ns) - len(actions.times_s)
    result = ActionResult(
        name=episode.name,
        recorded_by="the dataset",
        policy=executable.name,
        engine=executable.engine,
        actions=actions,
        notes=(f"no chunk for {missing} rows",) if missing else (),
    )
    return _show(result, config)


def _show(result: ActionResult, config: ReplayConfig) -> int:
    print_actions(result, table_console())
    if config.json is not None:
        config.json.write_text(to_json(result))
    if config.plot is not None:
        from mavbridge.commands.replay.figure import make_actions_figure

        make_actions_figure(result).savefig(config.plot)
    return ExitCode.DONE
