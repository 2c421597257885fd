"""Goes on with an evaluation: the flights that its JSON file holds are not flown again."""

import hashlib
from dataclasses import replace
from pathlib import Path

from mavbridge.commands.evaluate.config import EvaluateConfig
from mavbridge.config.courses import MAX_EPISODES
from mavbridge.config.workers import WorkersConfig
from mavbridge.core.errors import UserError
from mavbridge.simulation.referee import EpisodeResult
from policy.loading.builtin import shipped_weights
from policy.text_files import parse_json


def identity(config: EvaluateConfig) -> str:
    """Digest of all that decides how a flight of the evaluation goes: the flags, and the weights.

    How many are flown, where, and what is written does not matter.
    """
    flown = replace(
        config,
        policy=replace(config.policy, checkpoint=None),
        episodes=1,
        workers=WorkersConfig(),
        resume=False,
        json=None,
        plot=None,
    )
    digest = hashlib.sha256(repr(flown).encode())
    weights = config.policy.checkpoint or shipped_weights(config.policy.policy)
    if weights is not None and weights.is_file():
        digest.update(weights.read_bytes())
    return digest.hexdigest()


def flown_before(config: EvaluateConfig) -> dict[int, tuple[str, EpisodeResult]]:
    """Engine and result of the flights that ``config.json`` holds, by index; none if it is missing.

    Raises:
        UserError: it holds something else, or flights by other flags or weights.
    """
    path = config.json
    if path is None or not path.exists():
        return {}
    try:
        document = parse_json(path.read_text())
        flown_by, engine = document["flown_by"], str(document["engine"])
        results = [
            EpisodeResult(**one | {"gate_times_s": tuple(one["gate_times_s"])})
            for one in document["episodes"]
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"--resume: {path} is no evaluation that can go on ({error!r}): name another --json"
        ) from error
    if flown_by != identity(config):
        raise UserError(
            f"--resume: {path} holds flights by other flags or other weights: give those, or name "
            "another --json"
        )
    first = config.policy.seed * MAX_EPISODES
    by_index = {result.seed - first: (engine, result) for result in results}
    return {index: one for index, one in by_index.items() if 0 <= index < config.episodes}


def write_whole(path: Path, text: str) -> None:
    """Replace a file as a whole, so that one that is interrupted leaves the old one."""
    draft = path.with_name(f".{path.name}.part")
    draft.write_text(text)
    draft.replace(path)
