"""The study evaluates each setting once, with the right checkpoint."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks import study
from benchmarks.study import DELAYED_WITHOUT_AGE, SETTINGS, Setting, SettingScore


def make_score(
    setting: Setting, checkpoint: Path, episodes: int, success: float = 0.5
) -> SettingScore:
    return SettingScore(
        group=setting.group,
        name=setting.name,
        command=f"mavbridge evaluate {setting.flags}",
        checkpoint_sha256=study.sha256(checkpoint),
        episodes=episodes,
        success=success,
        success_low=success - 0.1,
        success_high=success + 0.1,
        gates=4.0,
        speed_mps=5.0,
        stick_rate_per_s=0.4,
    )


class Evaluations:
    """Stands in for the evaluations: remembers them, and may be interrupted."""

    def __init__(self) -> None:
        self.flown: list[tuple[str, str]] = []
        self.most = 100

    def evaluate(
        self, setting: Setting, checkpoint: Path, episodes: int, _workers: int
    ) -> SettingScore:
        if len(self.flown) == self.most:
            raise KeyboardInterrupt
        self.flown.append((checkpoint.stem, setting.name))
        return make_score(setting, checkpoint, episodes)

    def names(self) -> Sequence[str]:
        return [name for _, name in self.flown]


@pytest.fixture
def evaluations(monkeypatch: pytest.MonkeyPatch) -> Evaluations:
    evaluations = Evaluations()
    monkeypatch.setattr(study, "evaluate", evaluations.evaluate)
    return evaluations


@pytest.fixture
def checkpoints(tmp_path: Path) -> dict[str, Path]:
    paths = {name: tmp_path / f"{name}.safetensors" for name in ("checkpoint", "without_age")}
    for name, path in paths.items():
        path.write_text(name)
    return paths


def test_an_interrupted_study_resumes_and_other_weights_begin_anew(
    tmp_path: Path, checkpoints: dict[str, Path], evaluations: Evaluations
) -> None:
    out, checkpoint = tmp_path / "study.json", checkpoints["checkpoint"]
    names = [one.name for one in SETTINGS if one.group != DELAYED_WITHOUT_AGE]
    evaluations.most = 3
    with pytest.raises(KeyboardInterrupt):
        study.main(json=out, checkpoint=checkpoint)
    evaluations.most = 100
    study.main(json=out, checkpoint=checkpoint)
    assert evaluations.names() == names
    checkpoint.write_text("other weights")
    study.main(json=out, checkpoint=checkpoint)
    assert evaluations.names() == 2 * names
