"""``python -m benchmarks.rollout`` with its real processes and a tiny world model."""

import json
from pathlib import Path

import pytest

from benchmarks import rollout
from helpers.rollouts import TinyWorld
from mavbridge.core.errors import MavbridgeError
from policy.checkpoints.world_model_file import save_world_model

pytestmark = pytest.mark.system


def test_both_ways_are_measured_and_give_the_same_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rollout, "QUICK", ((2,), (), 1))
    world_model, out = tmp_path / "world.safetensors", tmp_path / "a.json"
    save_world_model(world_model, TinyWorld())
    assert rollout.main(quick=True, json=out, world_model=world_model) == 0
    assert "0 of 1 pairs differ" in capsys.readouterr().out
    (pair,) = json.loads(out.read_text())["pairs"]
    assert pair["serial"]["sha256"] == pair["streamed"]["sha256"]
    assert (pair["serial"]["frames_decoded"], pair["streamed"]["frames_decoded"]) == (64, 32)
    for way in ("serial", "streamed"):
        trial = pair[way]
        assert trial["frames"] == 32
        assert 0 < trial["sample_s"] < trial["wall_s"]
        assert trial["peak_rss_mb"] > 50
    assert pair["streamed"]["writer_rss_mb"] > 10
    assert pair["bound"] >= 1


def test_a_foreign_file_is_refused_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "a.safetensors").write_bytes(b"these are no weights")
    with pytest.raises(MavbridgeError, match=r"a\.safetensors"):
        rollout.main(world_model=tmp_path / "a.safetensors")
