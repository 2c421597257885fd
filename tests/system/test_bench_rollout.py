"""``mavbridge bench rollout`` with its real processes and a tiny world model."""

import json
from pathlib import Path

import pytest

from helpers.rollouts import TinyWorld
from mavbridge.__main__ import main
from mavbridge.commands.bench import rollout
from mavbridge.commands.bench.rollout import Effort
from policy.checkpoints.world_model_file import save_world_model

pytestmark = pytest.mark.system

TINY = Effort(iterations=(2,), ddim_steps_long=1, ddim_steps=(2,), iterations_short=1, repeats=1)


def test_both_ways_are_measured_and_give_the_same_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rollout, "QUICK", TINY)
    monkeypatch.setattr(rollout.torch.cuda, "is_available", lambda: False)
    save_world_model(tmp_path / "world.safetensors", TinyWorld())
    files = (
        "--json",
        str(tmp_path / "a.json"),
        "--world-model",
        str(tmp_path / "world.safetensors"),
    )
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "rollout", "--quick", *files])
    captured = capsys.readouterr()
    assert stopped.value.code == 0, captured.err
    assert "all 2 pairs have the same frames" in captured.out
    result = json.loads((tmp_path / "a.json").read_text())
    (pair,) = result["by_iterations"]
    assert pair["is_exact"]
    assert (pair["serial"]["frames_decoded"], pair["streamed"]["frames_decoded"]) == (64, 32)
    for way in ("serial", "streamed"):
        trial = pair[way]
        assert trial["frames"] == 32
        assert 0 < trial["sample_s"] < trial["wall_s"]
        assert trial["peak_rss_mb"] > 50
    assert pair["streamed"]["writer_rss_mb"] > 10
    assert result["by_steps"][0]["bound"] >= 1


def test_a_foreign_file_is_refused_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.safetensors").write_bytes(b"these are no weights")
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "rollout", "--world-model", str(tmp_path / "a.safetensors")])
    assert stopped.value.code == 1
    assert "a.safetensors" in capsys.readouterr().err
