"""A class of the user's in a real flight: who calls what, when, and who takes off."""

import json
from pathlib import Path

import pytest

from faults.stage import staged

pytestmark = pytest.mark.system

POLICY = """
import json
import os
import threading
from pathlib import Path

import numpy as np
from policy.contract import Contract

CALLS = Path(__file__).with_name(f"calls.{os.getpid()}.jsonl")


NOTED = set()


def note(method):
    call = (method, threading.current_thread().name)
    if call not in NOTED or method in ("reset", "close"):
        NOTED.add(call)
        with CALLS.open("a") as file:
            file.write(json.dumps(call) + "\\n")


class Turning:
    contract = Contract(arrays="numpy", feature_dim=1, image_height=32, image_width=32)

    def __init__(self):
        note("__init__")

    def reset(self):
        note("reset")

    def close(self):
        note("close")

    def encode_visual(self, image):
        note("encode_visual")
        return np.zeros((1, 1), np.float32)

    def predict_fast(self, feature, state, action_history, num_diffusion_steps):
        note("predict_fast")
        return np.tile(np.array([0.0, 0.3, 0.0, 0.0], np.float32), (1, 16, 1))

    def predict(self, image, state, action_history, num_diffusion_steps):
        raise NotImplementedError
"""
MAIN, VISION, ACTION = "MainThread", "mavbridge-vision", "mavbridge-policy"


def test_a_file_of_the_users_flies_after_a_takeoff_and_lives_by_the_guide(tmp_path: Path) -> None:
    (tmp_path / "turning.py").write_text(POLICY)
    with staged(tmp_path) as flying:
        flags = ("--mode", "ALT_HOLD", "--arm", "--takeoff", "4", "--duration", "12")
        status, output = flying.fly(
            "--dual-rate", *flags, "--policy", f"{tmp_path}/turning.py:Turning"
        )
    assert status == 0, output
    assert flying.vehicle_report()["max_altitude_m"] > 3.0
    # A start that a busy machine spoiled left its own file: the last process is the one that flew.
    newest = max(tmp_path.glob("calls.*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
    lines = newest.read_text().splitlines()
    calls = [tuple(json.loads(line)) for line in lines]
    assert calls[0] == ("__init__", MAIN)
    assert calls[-1] == ("close", MAIN)
    in_flight = calls[calls.index(("reset", MAIN)) + 1 : -1]
    assert set(in_flight) == {
        ("encode_visual", VISION),
        ("predict_fast", ACTION),
        ("reset", ACTION),
    }
    assert [name for name, _ in calls].count("reset") == 2  # after loading, and for the one flight
