"""Both loops on virtual time: each has its own clock; a feature is seen once it is ready."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock, FakeLink, ListSink, ScriptedCamera, level_telemetry
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, GridPacer
from mavbridge.core.records import FeatureFrame, FloatArray, Frame, ImageArray
from mavbridge.core.vehicle import IDLE, NEUTRAL, Command, Reading, Release, Sticks
from mavbridge.flight.action_loop import NEUTRAL_NS, NEUTRAL_SPACING_NS, ActionLoop, ActionSettings
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.state import Freshness
from mavbridge.flight.vision_loop import VisionLoop
from mavbridge.gate.engagement import Engagement
from mavbridge.gate.smoothing import Smoothing, StickSmoother

MS = NS_PER_MS
FRAME_NS = NS_PER_S // 30
SETTINGS = ActionSettings(
    state_frame="ned_frd",
    since_exposure=False,
    chunk_dt_s=0.05,
    history_len=4,
    history_dt_s=0.05,
    freshness=Freshness(attitude_ns=100 * MS, velocity_ns=250 * MS),
    max_feature_age_ns=300 * MS,
    lead_s=0.0,
    mode=None,
    duration_ns=None,
)

BACK = "inputs are good again: waiting to see that they stay so"
NO_SMOOTHING = Smoothing(max_slew_per_s=0.0, tau_s=0.0, max_dt_s=0.03)


class TimedCache(FeatureCache):
    """Two loops in one thread: the reader sees what was ready by its own time."""

    def __init__(self, reader: FakeClock) -> None:
        super().__init__()
        self._reader = reader
        self.frames: list[FeatureFrame] = []

    def publish(self, frame: FeatureFrame) -> None:
        self.frames.append(frame)

    def latest(self) -> FeatureFrame | None:
        ready = [frame for frame in self.frames if frame.ready_ns <= self._reader.now_ns()]
        return ready[-1] if ready else None


@dataclass
class Rig:
    """A bridge of fakes; the policy's durations and outputs are functions of the tick."""

    settings: ActionSettings = SETTINGS
    period_ns: int = 10 * MS
    frames_ns: list[int] = field(
        default_factory=lambda: [START_NS + k * FRAME_NS for k in range(400)]
    )
    encode_ns: int = 25 * MS
    act_ns: Callable[[int], int] = lambda tick: 3 * MS
    chunk: Callable[[int], FloatArray] = lambda tick: np.full((1, 16, 4), 0.25, np.float32)
    smoothing: Smoothing = NO_SMOOTHING
    engagement: Engagement = field(
        default_factory=lambda: Engagement(wanted_mode=None, arm=False, readonly=False)
    )
    visual_period_ns: int = FRAME_NS
    oversleep_ns: int = 0

    def __post_init__(self) -> None:
        self.clock = FakeClock(oversleep_ns=self.oversleep_ns)
        self.vision_clock = FakeClock()
        self.link = FakeLink(self.clock)
        self.sink = ListSink()
        self.cache = TimedCache(self.clock)
        self.camera = ScriptedCamera(self.vision_clock, self.frames_ns)
        self.pacer = GridPacer(self.clock, period_ns=self.period_ns)
        self.histories: list[FloatArray] = []
        self.elapsed_s: list[float | None] = []
        self.states: list[FloatArray] = []
        self.vision = VisionLoop(
            camera=self.camera,
            encode=self._encode,
            cache=self.cache,
            sink=self.sink,
            clock=self.vision_clock,
            period_ns=lambda: self.visual_period_ns,
        )
        self.action = ActionLoop(
            clock=self.clock,
            link=self.link,
            cache=self.cache,
            act=self._act,
            smoother=StickSmoother(self.smoothing),
            engagement=self.engagement,
            sink=self.sink,
            settings=self.settings,
            pacer=self.pacer,
        )

    def _encode(self, rgb: ImageArray) -> FloatArray:
        self.vision_clock.advance_ns(self.encode_ns)
        return np.zeros((1, 8), dtype=np.float32)

    def _act(
        self,
        feature: FloatArray,
        state: FloatArray,
        history: FloatArray,
        elapsed_s: float | None,
    ) -> FloatArray:
        tick = len(self.histories)
        self.elapsed_s.append(elapsed_s)
        self.states.append(state)
        self.histories.append(history)
        self.clock.advance_ns(self.act_ns(tick))
        return self.chunk(tick)

    def fly(self, duration_s: float) -> "Rig":
        until_ns = self.clock.now_ns() + round(duration_s * NS_PER_S)
        while self.clock.now_ns() < until_ns:
            while self.vision_clock.now_ns() <= self.clock.now_ns() + self.period_ns:
                self.vision.step()
            self.action.step(self.pacer.wait())
        return self

    @property
    def releases(self) -> list[str | None]:
        """Reasons in order, without repeats."""
        reasons = [tick.release_reason for tick in self.sink.ticks]
        return [r for k, r in enumerate(reasons) if k == 0 or r != reasons[k - 1]]


def test_thirty_hertz_vision_feeds_a_hundred_hertz_of_actions() -> None:
    rig = Rig().fly(10.0)
    ticks = rig.sink.ticks
    assert len(ticks) == 1001  # both ends of ten seconds
    assert sum(tick.missed_slots for tick in ticks) == 0
    assert 299 <= len(rig.sink.visions) <= 301
    flown = [tick for tick in ticks if tick.sent is not None]
    assert len(flown) == 1001 - 3  # the first feature is ready after 25 ms
    uses = [sum(t.feature_frame_id == k for t in flown) for k in range(10, 200)]
    assert set(uses) == {3, 4}
    ages_ms = [(t.sent_ns - t.feature_captured_ns) / MS for t in flown if t.feature_captured_ns]
    assert min(ages_ms) >= 25 + 3
    assert max(ages_ms) <= 25 + 33.4 + 10 + 3


def test_a_stall_is_skipped_counted_and_not_made_up_for() -> None:
    rig = Rig(act_ns=lambda tick: 53 * MS if tick == 100 else 3 * MS).fly(3.0)
    sent_ns = np.array([tick.sent_ns for tick in rig.sink.ticks])
    assert sum(tick.missed_slots for tick in rig.sink.ticks) == 5
    assert np.diff(sent_ns).max() >= 53 * MS
    assert np.diff(sent_ns)[5:].min() >= 7.5 * MS
    assert all((tick.due_ns - START_NS) % (10 * MS) == 0 for tick in rig.sink.ticks)


def test_oversleep_delays_ticks_and_loses_none() -> None:
    rig = Rig(oversleep_ns=MS).fly(5.0)
    assert sum(tick.missed_slots for tick in rig.sink.ticks) == 0
    assert len(rig.sink.ticks) == 501


def test_a_camera_that_stops_releases_and_one_that_returns_flies_again() -> None:
    times = [START_NS + k * FRAME_NS for k in range(300)]
    gap = [t for t in times if not 1 * NS_PER_S < t - START_NS < 2 * NS_PER_S]
    rig = Rig(frames_ns=gap).fly(4.0)
    stale = "the image feature is older than 300 ms"
    assert rig.releases == ["no image feature yet", None, stale, BACK, None]
    last = [t for t in rig.sink.ticks if t.release_reason is None and t.sent_ns < 2.02e9 + START_NS]
    assert last[-1].feature_captured_ns is not None
    assert last[-1].woke_ns - last[-1].feature_captured_ns <= 300 * MS
    assert all(t.sent is None for t in rig.sink.ticks if t.release_reason is not None)


def test_stale_and_missing_states_release() -> None:
    rig = Rig()

    def poll(link: FakeLink) -> None:
        elapsed_ns = link.clock.now_ns() - START_NS
        link.telemetry_age_ns = 101 * MS if NS_PER_S <= elapsed_ns < 2 * NS_PER_S else 2 * MS
        good = level_telemetry(link.clock.now_ns())
        without_velocity = replace(good, velocity_ned_mps=None)
        link.telemetry = without_velocity if elapsed_ns >= 3 * NS_PER_S else None

    rig.link.on_poll = poll
    rig.fly(4.0)
    assert rig.releases == [
        "no image feature yet",
        None,
        "attitude is older than 100 ms",
        BACK,
        None,
        "no velocity from the vehicle yet",
    ]


def test_a_policy_that_returns_nan_never_moves_a_stick() -> None:
    def chunk(tick: int) -> FloatArray:
        out = np.full((1, 16, 4), 0.25, np.float32)
        out[0, 9, 1] = np.nan if 50 <= tick < 60 else 0.0
        return out

    rig = Rig(chunk=chunk).fly(2.0)
    reason = "the policy returned a value that is not finite"
    assert rig.releases == ["no image feature yet", None, reason, None]
    assert sum(tick.release_reason == reason for tick in rig.sink.ticks) == 10


def test_inputs_that_flicker_do_not_toss_the_sticks_to_and_fro() -> None:
    rig = Rig()

    def poll(link: FakeLink) -> None:
        tick = (link.clock.now_ns() - START_NS) // (10 * MS)
        link.telemetry_age_ns = 101 * MS if 100 <= tick < 300 and tick % 20 == 0 else 2 * MS

    rig.link.on_poll = poll
    rig.fly(5.0)
    hands = [decision for _, decision in rig.link.decisions]
    changes = sum(isinstance(a, Command) != isinstance(b, Command) for a, b in pairwise(hands))
    assert changes == 3  # takes off, gives back once, takes back once


def test_a_chunk_of_another_shape_never_moves_a_stick() -> None:
    rig = Rig(chunk=lambda tick: np.zeros((16, 4), np.float32)).fly(0.5)
    assert rig.releases[-1] == "the policy returned [16, 4] instead of [1, horizon, 4]"
    assert all(isinstance(decision, Release) for _, decision in rig.link.decisions)


def test_a_frame_from_the_future_is_as_fresh_as_now_and_no_fresher() -> None:
    times = [START_NS + k * FRAME_NS for k in range(300)]
    rig = Rig(frames_ns=times)
    read = rig.camera.read

    def read_ahead(timeout_ns: int) -> Frame | None:
        frame = read(timeout_ns)
        if frame is not None and frame.frame_id == 30:
            return replace(frame, captured_ns=frame.captured_ns + 5 * NS_PER_S)
        return frame

    rig.camera.read = read_ahead  # type: ignore[method-assign]
    rig.fly(3.0)
    assert [v.frame_id for v in rig.sink.visions[28:33]] == [29, 30, 31, 32, 33]
    ages_ns = [t.sent_ns - t.feature_captured_ns for t in rig.sink.ticks if t.feature_captured_ns]
    assert min(ages_ns) > 0


def test_history_is_what_was_sent_not_what_was_wished() -> None:
    rig = Rig()
    rounded = Sticks(0.2, 0.2, 0.2, 0.2)
    send = rig.link.send
    rig.link.send = lambda decision: rounded if send(decision) else None  # type: ignore[method-assign]
    rig.fly(1.0)
    assert rig.histories[0] == pytest.approx(0.0)  # nothing was sent before the first action
    assert rig.histories[-1] == pytest.approx(0.2)
    assert rig.sink.ticks[-1].trace is not None
    assert rig.sink.ticks[-1].trace.smoothed.roll == pytest.approx(0.25)


def test_the_policy_takes_over_from_where_the_sticks_are() -> None:
    slow = Smoothing(max_slew_per_s=1.0, tau_s=0.0, max_dt_s=0.03)
    rig = Rig(smoothing=slow)
    rig.link.rc_sticks = Sticks(0.6, 0.0, -0.3, 0.0)
    rig.fly(0.1)
    first = next(tick for tick in rig.sink.ticks if tick.sent is not None)
    assert first.sent == rig.link.rc_sticks


def test_the_chunk_is_sampled_at_the_time_it_acts() -> None:
    def ramp(tick: int) -> FloatArray:
        return np.arange(16, dtype=np.float32)[None, :, None].repeat(4, axis=2) * 0.05

    rig = Rig(settings=replace(SETTINGS, lead_s=0.05), chunk=ramp).fly(0.2)
    # state 2 ms old at the tick, 3 ms of inference, 50 ms of lead on a ramp of 1/s
    assert rig.sink.ticks[-1].trace is not None
    assert rig.sink.ticks[-1].trace.raw.roll == pytest.approx(0.055, abs=1e-6)


def test_the_policy_is_told_the_time_since_the_state_of_its_last_chunk() -> None:
    rig = Rig(act_ns=lambda tick: 13 * MS if tick == 20 else 3 * MS)

    def poll(link: FakeLink) -> None:
        link.armed = not 500 * MS <= link.clock.now_ns() - START_NS < 700 * MS

    rig.link.on_poll = poll
    rig.fly(1.0)
    assert rig.elapsed_s[0] is None
    assert rig.elapsed_s[1:21] == pytest.approx([0.01] * 20)
    assert rig.elapsed_s[21] == pytest.approx(0.02)  # a slot was missed
    (again,) = (k for k, elapsed_s in enumerate(rig.elapsed_s[1:], 1) if elapsed_s is None)
    assert rig.elapsed_s[again - 1 : again + 2] == pytest.approx([0.01, None, 0.01])


def test_a_policy_that_asks_is_told_the_age_of_its_image_and_the_motion_since() -> None:
    rig = Rig(settings=replace(SETTINGS, since_exposure=True))

    def poll(link: FakeLink) -> None:
        """Turns right at 1 rad/s and accelerates downwards at 2 m/s^2."""
        now_ns = link.clock.now_ns() - link.telemetry_age_ns
        flown_s = (now_ns - START_NS) / NS_PER_S
        attitude = (np.cos(flown_s / 2), 0.0, 0.0, np.sin(flown_s / 2))
        link.telemetry = replace(
            level_telemetry(now_ns),
            ned_from_body_wxyz=Reading(now_ns, attitude),
            velocity_ned_mps=Reading(now_ns, (0.0, 0.0, 2 * flown_s)),
        )

    rig.link.on_poll = poll
    rig.fly(1.0)
    flown = [tick for tick in rig.sink.ticks if tick.trace is not None]
    assert len(flown) == len(rig.states) > 90
    for tick, state in zip(flown, rig.states, strict=True):
        assert tick.state is not None
        assert tick.feature_captured_ns is not None
        age_s = (tick.state.attitude_ns - tick.feature_captured_ns) / NS_PER_S
        assert 0.02 < age_s < 0.07
        assert state.shape == (1, 20)
        np.testing.assert_array_equal(state[0, :13], tick.state.values)
        told = [age_s, 0, 0, age_s, 0, 0, 2 * age_s]
        known_s = (tick.state.attitude_ns - rig.sink.ticks[0].woke_ns) / NS_PER_S
        if age_s <= known_s:
            assert state[0, 13:].tolist() == pytest.approx(told, abs=1e-5)


def test_a_policy_that_does_not_ask_sees_thirteen_numbers() -> None:
    rig = Rig().fly(0.2)
    assert {state.shape for state in rig.states} == {(1, 13)}


def test_a_chunk_that_is_refused_is_not_built_upon() -> None:
    def chunk(tick: int) -> FloatArray:
        return np.full((1, 16, 4), np.nan if tick == 9 else 0.25, np.float32)

    rig = Rig(chunk=chunk).fly(0.3)
    assert rig.elapsed_s[:12] == pytest.approx([None, *[0.01] * 9, None, 0.01])


def test_a_faster_camera_is_thinned_to_the_visual_rate() -> None:
    wobble = [0, 3, -3, 2, -2]
    frames = [START_NS + k * NS_PER_S // 60 + wobble[k % 5] * MS for k in range(600)]
    rig = Rig(frames_ns=frames, encode_ns=5 * MS).fly(9.0)
    assert 268 <= len(rig.sink.visions) <= 272
    assert rig.camera.dropped_frames == 0  # passed over is not dropped


def test_an_encoder_too_slow_for_the_camera_takes_the_newest_frame() -> None:
    rig = Rig(encode_ns=100 * MS).fly(9.0)
    visions = rig.sink.visions
    assert 88 <= len(visions) <= 91
    assert visions[-1].dropped_frames == pytest.approx(2 * len(visions), abs=8)
    waits_ms = [(v.started_ns - v.captured_ns) / MS for v in visions]
    assert max(waits_ms) <= 33.4


# --- how a flight ends


def run(rig: Rig, stop: threading.Event | None = None) -> list[object]:
    """Run the action loop on its own; returns what it decided in its last words."""
    rig.cache.publish(
        FeatureFrame(
            frame_id=1,
            captured_ns=START_NS,
            ready_ns=START_NS,
            value=np.zeros((1, 8), dtype=np.float32),
        )
    )
    rig.action.run(stop or threading.Event())
    return [decision for _, decision in rig.link.decisions]


LAST_WORDS = [Command(sticks=NEUTRAL)] * (NEUTRAL_NS // NEUTRAL_SPACING_NS) + [
    Release("the flight is over")
]


def test_a_flight_ends_after_its_duration_neutral_then_released() -> None:
    rig = Rig(settings=replace(SETTINGS, duration_ns=192 * MS))
    decisions = run(rig)
    assert decisions[-6:] == LAST_WORDS
    assert len(rig.histories) == 20
    assert rig.link.hand_backs == 1


def test_duration_counts_from_the_first_tick_of_flight() -> None:
    rig = Rig(settings=replace(SETTINGS, duration_ns=192 * MS))
    rig.link.armed = False

    def arm_late(link: FakeLink) -> None:
        link.armed = link.clock.now_ns() >= START_NS + 100 * MS

    rig.link.on_poll = arm_late
    run(rig)
    assert len(rig.histories) == 20


def test_an_exception_in_the_policy_gives_the_sticks_back_and_is_not_swallowed() -> None:
    def explode(tick: int) -> FloatArray:
        if tick == 5:
            raise RuntimeError("bad weights")
        return np.zeros((1, 16, 4), dtype=np.float32)

    rig = Rig(chunk=explode)
    with pytest.raises(RuntimeError, match="bad weights"):
        run(rig)
    assert [decision for _, decision in rig.link.decisions][-6:] == LAST_WORDS
    assert rig.link.hand_backs == 1


def test_sticks_that_are_the_pilots_are_not_touched_on_the_way_out() -> None:
    stop = threading.Event()
    rig = Rig()
    rig.link.armed = False
    rig.link.on_poll = lambda link: stop.set() if link.clock.now_ns() > START_NS + 90 * MS else None
    decisions = run(rig, stop)
    assert all(isinstance(decision, Release) for decision in decisions)


def test_arming_goes_through_idle_and_asks_once_a_tick() -> None:
    rig = Rig(
        engagement=Engagement(wanted_mode="ALT_HOLD", arm=True, readonly=False),
        settings=replace(SETTINGS, mode="ALT_HOLD", duration_ns=42 * MS),
    )
    rig.link.armed = False
    rig.link.mode = "STABILIZE"

    def obey(link: FakeLink) -> None:
        if "mode ALT_HOLD" in link.asked:
            link.mode = "ALT_HOLD"
        link.armed = "arm" in link.asked

    rig.link.on_poll = obey
    decisions = run(rig)
    assert decisions[:2] == [Command(sticks=IDLE)] * 2
    assert rig.link.asked == ["mode ALT_HOLD", "arm"]
    assert len(rig.histories) == 5
