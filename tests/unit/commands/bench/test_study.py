"""The study asks each question once, of the right checkpoint, and draws what it was told."""

import sys
from pathlib import Path

import pytest

from benchmarks import study


def answer(question: study.Question, checkpoint: Path, episodes: int, workers: int) -> study.Answer:
    return study.Answer(
        group=question.group,
        name=question.name,
        command=f"mavbridge evaluate {checkpoint.stem}",
        checkpoint_sha256=study._sha256(checkpoint),
        episodes=episodes,
        success=0.5,
        success_low=0.2,
        success_high=0.8,
        gates=4.0,
        speed_mps=5.0,
        stick_rate_per_s=0.4,
    )


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command line, with two checkpoints."""
    for name in ("told", "untold"):
        (tmp_path / f"{name}.safetensors").write_text(name)
    monkeypatch.setattr(study, "print_answers", lambda answers: None)
    words = ["study", "--checkpoint", str(tmp_path / "told.safetensors"), "--episodes", "2"]
    return [*words, "--json", str(tmp_path / "study.json")]


def test_late_images_are_asked_of_both_checkpoints_and_all_else_of_one(
    tmp_path: Path, command: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, str]] = []

    def ask(question: study.Question, checkpoint: Path, *sizes: int) -> study.Answer:
        asked.append((checkpoint.stem, question.group))
        return answer(question, checkpoint, *sizes)

    monkeypatch.setattr(study, "ask", ask)
    words = [*command, "--untold", str(tmp_path / "untold.safetensors")]
    plot = tmp_path / "study.png"
    monkeypatch.setattr(sys, "argv", [*words, "--plot", str(plot)])
    study.main()
    assert [group for name, group in asked if name == "untold"] == [study.LATE_UNTOLD] * 5
    assert len(asked) == len(set(study.questions(with_untold=True)))
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_study_goes_on_and_other_weights_begin_anew(
    tmp_path: Path, command: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def ask(question: study.Question, checkpoint: Path, *sizes: int) -> study.Answer:
        if len(asked) == 3:
            raise KeyboardInterrupt
        asked.append(question.name)
        return answer(question, checkpoint, *sizes)

    monkeypatch.setattr(sys, "argv", command)
    monkeypatch.setattr(study, "ask", ask)
    with pytest.raises(KeyboardInterrupt):
        study.main()
    monkeypatch.setattr(study, "ask", lambda q, *rest: asked.append(q.name) or answer(q, *rest))
    study.main()
    names = [question.name for question in study.questions(with_untold=False)]
    assert asked == names
    (tmp_path / "told.safetensors").write_text("others")
    study.main()
    assert asked == 2 * names
