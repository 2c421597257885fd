from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from benchmarks.flight import (
    CLIMB_STICK,
    FlightJob,
    FlightMeter,
    ReleaseWatch,
    level_climb,
    to_flags,
)
from helpers.factories import make_released_tick, make_state, make_tick, make_vision_tick
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.reasons import Code, Reason, because
from policy.contract import Contract
from policy.protocol import PolicyRunner


@pytest.mark.parametrize(
    ("policy", "rates"),
    [
        (PolicyConfig(), Rates()),
        (
            PolicyConfig(
                policy="toge:small",
                checkpoint=Path("a b.safetensors"),
                dual_rate=True,
                num_diffusion_steps=2,
                allow_untrained=True,
            ),
            Rates(visual_rate="auto:10:60", action_rate=250.0, stick_rate=400.0, realtime=False),
        ),
    ],
)
def test_a_job_survives_the_way_over_the_command_line(policy: PolicyConfig, rates: Rates) -> None:
    job = FlightJob(
        port=1, camera="shm:a", duration=2.5, out=Path("a.json"), policy=policy, rates=rates
    )
    app = App(result_action="return_value")
    app.default(lambda job: job)
    received: list[FlightJob] = []

    @app.command
    def fly(job: FlightJob) -> None:
        received.append(job)

    app(("fly", *to_flags(job)))
    assert received == [job]


def test_a_level_climb_does_the_work_and_returns_other_sticks() -> None:
    called: list[int] = []

    def act(*arguments: object) -> np.ndarray:
        called.append(len(arguments))
        return np.ones((1, 16, 4), np.float32)

    runner = PolicyRunner(
        contract=Contract(), name="a", engine="b", dual_rate=True, encode=lambda rgb: rgb, act=act
    )
    history = np.zeros((1, 4, 4), np.float32)
    climb = level_climb(runner)
    assert climb.contract.max_state_age_s == climb.contract.max_chunk_age_s == 5.0
    chunk = climb.act(history, make_state().values[None], history)
    assert called == [3]
    assert (chunk == np.float32([CLIMB_STICK, 0, 0, 0])).all()


def test_a_flight_ends_once_the_policy_has_lost_the_sticks() -> None:
    ended: list[Reason] = []
    watch = ReleaseWatch(ended.append)
    for event in (make_released_tick(0), make_tick(1), make_vision_tick()):
        watch.emit(event)
    assert not ended
    first = because(Code.NO_CHUNK)
    both = because(Code.THEN, first=first, then=because(Code.DISARMED))
    for index, reason in enumerate((first, both)):
        watch.emit(make_released_tick(2 + index, reason))
    assert ended == [watch.reason] == [first]


def test_a_flight_is_measured_from_its_first_action_on() -> None:
    meter = FlightMeter(stick_hz=100, action_hz=100, vision_hz=30)
    for index in range(50):
        meter.emit(make_released_tick(index))
        meter.emit(make_vision_tick(index))
    for index in range(100, 112):
        meter.emit(make_tick(index, missed_slots=50 if index == 100 else 0))
    report = meter.report()
    assert report.sticks.sends == 12
    assert report.sticks.missed_slots == 0
    assert report.action.rate_hz == pytest.approx(100)
    assert report.vision.frames == 0
    for index in range(112, 115):
        meter.emit(make_tick(index, missed_slots=2 if index == 113 else 0))
        meter.emit(make_vision_tick(index))
    report = meter.report()
    assert (report.sticks.missed_slots, report.vision.frames) == (2, 3)
    assert meter.cpu_ns > 0
