"""One solve after the other, without a guard; tests/loops has the rest."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from helpers.factories import make_guard_tick, make_plan
from helpers.fakes import START_NS, FakeClock, ListSink, level_telemetry, samples_of
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_MS, Clock
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FeatureFrame, FloatArray
from mavbridge.core.vehicle import ACTION_CLASSES, Reading, Sample, Sticks, Telemetry
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.policy_loop import RETRY_NS, PolicyLoop
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.values import Phase
from mavbridge.guard.wire import Samples
from policy.contract import Contract
from policy.protocol import PolicyRunner

MS = NS_PER_MS
NO_ATTITUDE = because(Code.NO_READING, quantity="attitude")
FROZEN = because(Code.IMAGE_FROZEN, age_s=0.6)


class Rig:
    """A policy loop whose policy takes 3 ms, and the messages that it sends."""

    def __init__(
        self,
        chunk: Callable[[], FloatArray] | None = None,
        period_ms: int = 10,
        **contract: Any,
    ) -> None:
        meaning = Contract(**{"horizon": 3, "chunk_dt_s": 0.05, "history_len": 2} | contract)
        plan = make_plan(meaning, rates=Rates(action_rate=1000 / period_ms))
        self.clock, self.cache = FakeClock(), FeatureCache()
        self.view = TelemetryCache(plan, sink=ListSink())
        self.sent: list[Chunk | Reason] = []
        self.solves = self.resets = 0
        self.north_mps, self.solve_ns, self.given = 0.0, 3 * MS, (np.zeros(0, np.float32),) * 3
        self._chunk = chunk or (lambda: np.zeros((1, 3, 4), np.float32))
        runner = PolicyRunner(
            contract=meaning,
            name="",
            engine="",
            dual_rate=True,
            encode=lambda rgb, camera=0: np.zeros((1, 8), np.float32),
            act=self._act,
            reset=self._reset,
        )
        self.loop = PolicyLoop(
            plan,
            runner,
            clock=self.clock,
            view=self.view,
            caches=[self.cache],
            send=self.sent.append,
        )

    def _act(self, *inputs: Any) -> FloatArray:
        self.solves, self.given = self.solves + 1, inputs
        self.clock.advance_ns(self.solve_ns)
        return self._chunk()

    def _reset(self) -> None:
        self.resets += 1

    def measure(
        self, *, attitude_age_ns: int = 0, velocity_age_ns: int = 0, force_age_ns: int = MS
    ) -> "Rig":
        ages_ns = {"velocity_ned_mps": velocity_age_ns, "specific_force_body_mps2": force_age_ns}
        samples = (
            Sample(name, reading._replace(delay_ns=ages_ns.get(name, attitude_age_ns)))
            for name, reading in samples_of(self._telemetry())
        )
        self.view.receive(Samples(tuple(samples)))
        return self

    def _telemetry(self) -> Telemetry:
        level = level_telemetry(self.clock.now_ns())
        moving = Reading(self.clock.now_ns(), (self.north_mps, 0.0, 0.0))
        return level._replace(velocity_ned_mps=moving)

    def see(self, *, age_ns: int = 30 * MS, fault: Reason | None = None) -> "Rig":
        captured_ns = self.clock.now_ns() - age_ns
        value = np.zeros((1, 8), np.float32)
        self.cache.publish(
            FeatureFrame(
                frame_id=9, captured_ns=captured_ns, ready_ns=captured_ns, value=value, fault=fault
            )
        )
        return self

    def begin_flight(self) -> None:
        now_ns = self.clock.now_ns()
        tick = make_guard_tick(now_ns, phase=Phase.PREPARING, starting_ns=now_ns)
        self.view.receive(tick)


@pytest.mark.parametrize(("velocity_ms", "force_ms"), [(20, 1), (1, 20)])
def test_a_chunk_carries_the_moments_that_it_came_from(velocity_ms: int, force_ms: int) -> None:
    rig = Rig().see()
    rig.measure(
        attitude_age_ns=4 * MS, velocity_age_ns=velocity_ms * MS, force_age_ns=force_ms * MS
    )
    rig.loop.step()
    (chunk,) = rig.sent
    assert isinstance(chunk, Chunk)
    assert chunk._replace(actions=()) == Chunk(
        serial=1,
        attitude_ns=START_NS - 4 * MS,
        velocity_ns=START_NS - 20 * MS,  # the older of velocity and acceleration
        image_ns=START_NS - 30 * MS,
        computed_ns=START_NS + 3 * MS,
        first_ns=START_NS - 4 * MS,
        step_ns=50 * MS,
        actions=(),
    )
    assert chunk.actions == ((0.0,) * 4,) * 3


@pytest.mark.parametrize("north_mps", [0.0, 2.0])
def test_the_state_of_a_vehicle_that_moves_is_predicted_to_when_the_chunk_acts(
    north_mps: float,
) -> None:
    pitch = np.tile(np.array([0.0, 0.0, 0.8, 0.0], np.float32), (1, 16, 1))
    rig = Rig(lambda: pitch, 200, horizon=16, state_time="execution").measure().see()
    rig.north_mps, rig.solve_ns = north_mps, 200 * MS
    rig.loop.step()  # not flying yet: as measured
    sent = Sticks(0.0, 0.0, 0.8, 0.0)
    rig.view.receive(make_guard_tick(START_NS + 190 * MS, phase=Phase.FLYING, sent=sent))
    run_on(rig, 7)
    _, chunk = rig.sent
    assert isinstance(chunk, Chunk)
    started_ns = START_NS + 207 * MS
    assert chunk.attitude_ns == started_ns  # ages count from the measurement
    _, states, history = rig.given
    if north_mps == 0.0:  # it may stand on the ground
        assert (chunk.first_ns, states[0, 0]) == (started_ns, 0.0)
        return
    assert chunk.first_ns == started_ns + 200 * MS
    assert states[0, 0] > north_mps + 0.2  # the plan, stick forward, has gathered speed
    assert history[0, -1].tolist() == [0.0, 0.0, pytest.approx(0.8), 0.0]


def test_past_states_are_predicted_too_where_none_is_measured_yet() -> None:
    pitch = np.tile(np.array([0.0, 0.0, 0.8, 0.0], np.float32), (1, 16, 1))
    steps = {"observation_steps": 4, "observation_dt_s": 0.08}
    rig = Rig(lambda: pitch, 200, horizon=16, state_time="execution", **steps).measure().see()
    rig.north_mps, rig.solve_ns = 2.0, 200 * MS
    rig.loop.step()
    rig.view.receive(make_guard_tick(rig.clock.now_ns(), phase=Phase.FLYING))
    run_on(rig, 7)
    _, states, _ = rig.given
    # 40 ms before now, where the measured state is the nearest, and 40, 120 and 200 ms after it.
    assert 2.0 == states[0, 0, 0] < states[0, 1, 0] < states[0, 2, 0] < states[0, 3, 0]


def test_the_prefix_holds_what_flies_until_the_chunk_takes_over() -> None:
    rising = np.zeros((1, 16, 4), np.float32)
    rising[0, :, 0] = np.arange(16) / 100
    rig = Rig(lambda: rising, 100, horizon=16, prefix_len=6).measure().see()
    rig.solve_ns = 200 * MS
    rig.loop.step()
    _, _, history = rig.given
    assert (history.shape, np.isnan(history[0, 2:]).all()) == ((1, 8, 4), True)  # nothing planned
    run_on(rig, 93)
    assert np.isnan(rig.given[2][0, 2:]).all()  # planned, and not flown
    rig.view.receive(make_guard_tick(rig.clock.now_ns(), phase=Phase.FLYING))
    run_on(rig, 7)
    _, _, history = rig.given
    assert not np.isnan(history[0, :2]).any()
    assert history[0, 2:6, 0] == pytest.approx((207 + 50 * np.arange(4)) / 50 / 100)
    assert np.isnan(history[0, 6:]).all()  # 200 ms later the next chunk flies


@pytest.mark.parametrize("kind", ["sticks", "attitude", "rates", "velocity"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_chunk_that_the_guard_must_refuse_is_not_what_is_foreseen(kind: str, bad: float) -> None:
    def chunk() -> FloatArray:
        actions = np.full((1, 3, 4), 0.1, np.float32)
        actions[0, 1, 0] = bad if rig.solves == 3 else 0.1
        return actions

    contract = {"action": kind, "state_time": "execution", "horizon": 3, "chunk_dt_s": 0.1}
    rig = Rig(chunk, period_ms=100, **contract)
    rig.solve_ns, rig.north_mps = 60 * MS, 3.0
    rig.begin_flight()
    for _ in range(6):
        rig.see(age_ns=5 * MS).measure()
        rig.loop.step()
        assert all(np.isfinite(each).all() for each in rig.given)
        sent = ACTION_CLASSES[contract["action"]](0.1, 0.0, 0.0, 0.0)
        rig.view.receive(make_guard_tick(rig.clock.now_ns(), phase=Phase.FLYING, sent=sent))
        rig.clock.advance_ns(40 * MS)


def too_old(quantity: str, age_ms: float, limit_ms: float) -> Reason:
    return because(Code.TOO_OLD, quantity=quantity, age_ms=age_ms, limit_ms=limit_ms)


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (lambda rig: rig.see(), NO_ATTITUDE),
        (lambda rig: rig.measure(), because(Code.NO_IMAGE)),
        (lambda rig: rig.measure().see(age_ns=301 * MS), too_old("image", 301, 300)),
        (lambda rig: rig.measure(attitude_age_ns=101 * MS).see(), too_old("attitude", 101, 100)),
        (lambda rig: rig.measure(velocity_age_ns=251 * MS).see(), too_old("velocity", 251, 250)),
        (lambda rig: rig.measure().see(fault=FROZEN), FROZEN),
    ],
)
def test_without_usable_inputs_the_policy_is_not_asked(
    prepare: Callable[[Rig], Rig], reason: Reason
) -> None:
    rig = prepare(Rig())
    rig.loop.step()
    assert rig.sent == [reason]
    assert rig.solves == 0


@pytest.mark.parametrize(
    "shape", [(3, 4), (2, 3, 4), (1, 0, 4), (1, 3, 3), (1, 3, 4, 1), (1, 2, 4), (1, 4, 4)]
)
def test_a_chunk_of_another_shape_is_not_passed_on(shape: tuple[int, ...]) -> None:
    rig = Rig(lambda: np.zeros(shape, np.float32)).measure().see()
    rig.loop.step()
    (refused,) = rig.sent
    assert isinstance(refused, Reason)
    assert refused == because(Code.WRONG_SHAPE, shape=str(list(shape)), most=3)


def run_on(rig: Rig, milliseconds: int) -> Rig:
    """Good inputs so much later."""
    rig.clock.advance_ns(milliseconds * MS)
    rig.measure().see()
    rig.loop.step()
    return rig


def test_a_flight_that_begins_resets_the_policy_once() -> None:
    rig = Rig().measure().see()
    rig.loop.step()
    assert rig.resets == 0
    rig.begin_flight()
    run_on(rig, 7)
    run_on(rig, 7)
    assert rig.resets == 1
    resets_ns = [chunk.reset_ns for chunk in rig.sent if isinstance(chunk, Chunk)]
    assert resets_ns[0] == 0
    assert START_NS < resets_ns[1] == resets_ns[2] <= rig.clock.now_ns()


def test_an_attitude_starts_a_solve_from_a_quarter_of_a_period_before_it_is_due() -> None:
    rig = Rig().measure().see()
    rig.loop.step()
    for at_ms, is_wanted in ((7, False), (7.3, False), (7.5, True)):
        rig.clock = FakeClock(START_NS + round(at_ms * MS))
        assert rig.measure().loop.has_news is is_wanted, at_ms


def test_a_slow_policy_tries_again_soon_after_a_solve_without_inputs() -> None:
    rig = Rig(period_ms=1000, chunk_dt_s=0.5)
    rig.measure().loop.step()  # no image yet
    assert rig.loop.start_ns <= START_NS + RETRY_NS
    run_on(rig, 120)
    assert rig.loop.start_ns > rig.clock.now_ns() + 500 * MS


def test_it_solves_until_it_is_told_to_stop_and_says_when_no_attitude_comes() -> None:
    rig, stop = Rig().see(), threading.Event()
    waits = iter([True, False, True])

    def wait(_clock: Clock, *, newer_than_ns: int, timeout_ns: int) -> bool:
        has_come = next(waits, None)
        if has_come is None:
            stop.set()
            return False
        rig.clock.advance_ns(8 * MS)
        if has_come:
            rig.measure()
            assert rig.view.telemetry.attitude_arrived_ns > newer_than_ns
        return has_come

    rig.view.wait_for_attitude = wait  # type: ignore[method-assign]
    before_ns = rig.loop.alive_ns
    rig.loop.run(stop)
    told = [one if isinstance(one, Reason) else one.serial for one in rig.sent]
    assert told == [1, NO_ATTITUDE, 2, NO_ATTITUDE]
    assert rig.loop.alive_ns > before_ns


@pytest.mark.parametrize("failure", [RuntimeError, SystemExit, MemoryError])
def test_a_policy_that_fails_is_told_to_the_guard_at_once(failure: type[BaseException]) -> None:
    def fail() -> FloatArray:
        raise failure

    rig = Rig(fail).see().measure()
    rig.view.wait_for_attitude = lambda *_, **__: True  # type: ignore[method-assign]
    with pytest.raises(failure):
        rig.loop.run(threading.Event())
    assert rig.sent == [because(Code.POLICY_FAILED)]
