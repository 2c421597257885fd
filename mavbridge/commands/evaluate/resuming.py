"""Goes on with an evaluation: the flights that its JSON file holds are not flown again."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from mavbridge.commands.evaluate.config import EvaluateConfig
from mavbridge.commands.evaluate.episodes import FlownEpisode
from mavbridge.config.courses import MAX_EPISODES
from mavbridge.config.workers import WorkersConfig
from mavbridge.core.errors import UserError
from mavbridge.core.provenance import digests, git_revision, versions
from mavbridge.flight.policies import policy_files
from mavbridge.simulation.referee import EpisodeResult
from policy.files import read_json


def identity(config: EvaluateConfig) -> str:
    """Digest of what decides how a flight goes: flags, contents of the policy's files, versions.

    How many are flown, where, and what is written does not matter. What a server flies by, and what
    a user's code reads besides, is not known.
    """
    flags = replace(
        config,
        policy=replace(config.policy, checkpoint=None, contract=None),
        episodes=1,
        workers=WorkersConfig(),
        resume=False,
        json=None,
        plot=None,
    )
    files = policy_files(config.policy)
    known = digests(files)
    contents = [known.get(str(path.resolve()), str(path)) for path in files]
    parts = (flags, contents, git_revision(), sorted(versions().items()))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def flown_before(config: EvaluateConfig, flown_by: str) -> dict[int, FlownEpisode]:
    """The flights that ``config.json`` holds, by index; none if it is missing.

    Raises:
        UserError: it holds something else, more than is asked for, or other flights than those
            of the identity ``flown_by``.
    """
    path = config.json
    if path is None or not path.exists():
        return {}
    try:
        document = read_json(path)
        held_by, engine = document["flown_by"], str(document["engine"])
        episodes = [
            FlownEpisode(
                engine=engine,
                result=EpisodeResult(**one | {"gate_times_s": tuple(one["gate_times_s"])}),
            )
            for one in document["episodes"]
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"--resume: {path} is no evaluation that can go on ({error!r}): name another --json"
        ) from error
    if held_by != flown_by:
        raise UserError(
            f"--resume: {path} holds flights by other flags, weights or versions: give those, or "
            "name another --json"
        )
    first = config.policy.seed * MAX_EPISODES
    by_index = {episode.result.seed - first: episode for episode in episodes}
    if by_index and max(by_index) >= config.episodes:
        raise UserError(
            f"--resume: {path} holds {len(by_index)} flights: ask for as many --episodes or more"
        )
    return by_index


def require_same_engine(flown: Mapping[int, FlownEpisode], engine: str) -> None:
    """Refuse a flight by another engine than those before.

    Raises:
        UserError: it is another one, as on another computer.
    """
    if others := {episode.engine for episode in flown.values()} - {engine}:
        raise UserError(
            f"--resume: the flights before were flown by the engine {', '.join(others)}, here it "
            f"is {engine}: go on where they were flown, or name another --json"
        )


def write_whole(path: Path, text: str) -> None:
    """Replace a file as a whole, so that one that is interrupted leaves the old one."""
    draft = path.with_name(f".{path.name}.part")
    try:
        draft.write_text(text)
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise UserError(f"cannot write --json {path}: {error.strerror or error}") from error
