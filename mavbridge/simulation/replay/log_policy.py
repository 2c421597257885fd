"""A policy beside a telemetry log and a video: it sees both, and somebody else has the sticks.

``VisionLoop``, ``TelemetryCache``, ``StateReader``, ``ObservationSource``, ``SentHistory`` and
``PolicyLoop`` run as in flight, composed by ``build_bridge``, on stepped time: a packet arrives at
its stamp in the log, which is also taken for the moment that it tells about, an image at its
exposure, and neither encoding nor solving takes time. The pilot's sticks are the history.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import Frame, Solve
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.bridge import CameraPath, build_bridge
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.observation import observation_ages_ns
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.settings import action_meaning
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.values import Phase
from mavbridge.guard.wire import GuardStatus, GuardTick, NoChunk, Samples
from mavbridge.mavlink.session.telemetry import PacketDecoder
from mavbridge.simulation.clock import START_NS, SteppedClock
from mavbridge.simulation.replay.actions import ActionPair
from mavbridge.simulation.replay.telemetry_log import PilotSticks, TelemetryLog
from policy.files import library_name, why_unreadable
from policy.protocol import Executable

STICKS_FRESH_NS = 500 * NS_PER_MS
"""Older sticks are not the pilot's any more, as in ``mavbridge record``."""


class LogVideo:
    """A video as a ``Camera``, image by image; whoever reads lets time pass to ``next_ns``."""

    dropped_frames = 0

    def __init__(self, path: Path, *, start_s: float) -> None:
        """Open it; ``start_s`` is when its first image was taken, since the log began.

        Raises:
            UserError: it is no video that can be read.
        """
        self._path = path
        self._path = path
        self._start_ns = START_NS + round(start_s * NS_PER_S)
        self.damage: str | None = None
        """Where the video broke off, for the user."""
        try:
            self._container = av.open(library_name(path), options={"protocol_whitelist": "file"})
            self._images = self._decode()
            self._next = next(self._images, None)
        except (av.FFmpegError, OSError, IndexError) as error:
            raise UserError(f"--video {why_unreadable(path, error)}") from error
        if self._next is None:
            raise UserError(f"--video {path} holds no image with a time")

    @property
    def next_ns(self) -> int | None:
        """Exposure of the next image; None behind the last one."""
        return None if self._next is None else self._next.captured_ns

    def read(self, timeout_ns: int) -> Frame | None:
        """The next image."""
        frame, self._next = self._next, next(self._images, None)
        return frame

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def _decode(self) -> Iterator[Frame]:
        """All images; a video that is damaged from some place on ends there, which is noted."""
        first_s: float | None = None
        try:
            for number, image in enumerate(self._container.decode(video=0)):
                if image.pts is None:
                    continue
                first_s = image.time if first_s is None else first_s
                rgb = image.to_ndarray(format="rgb24").astype(np.uint8, copy=False)
                rgb.setflags(write=False)
                at_ns = self._start_ns + round((image.time - first_s) * NS_PER_S)
                yield Frame(frame_id=number, captured_ns=at_ns, rgb=rgb)
        except av.FFmpegError as error:
            if first_s is None:
                raise
            self.damage = f"{why_unreadable(self._path, error)}; {number + 1} images were read"


class LogReplay:
    """One pass over a log."""

    def __init__(
        self,
        log: TelemetryLog,
        video: LogVideo,
        executable: Executable,
        config: FlyConfig,
        clock: SteppedClock,
    ) -> None:
        """Compose the loops; ``clock`` is at ``START_NS``, and stands for the log's beginning.

        Raises:
            UserError: a policy that a pilot's sticks and one video are nothing for.
        """
        contract = executable.contract
        if contract.action != "sticks" or len(contract.cameras) != 1:
            raise UserError(
                "beside a telemetry log flies a policy of sticks with one camera, and this one "
                f"puts out {contract.action} from {len(contract.cameras)} cameras"
            )
        self._log, self._video = log, video
        self._clock = clock
        self._sticks = PilotSticks(log, action_meaning(contract, config.link).stick_gains)
        self.refusals: Counter[str] = Counter()
        """Reasons for which the policy got nothing to decide by, and how often: the first sentence
        of those that differ by their figures."""
        self._sentences: dict[object, str] = {}
        self._solve: Solve | None = None
        self._pilot: tuple[int, Sticks] | None = None
        self._ticks = 0
        self._cache = FeatureCache(span_ns=observation_ages_ns(contract)[0])
        self._bridge = build_bridge(
            plan_flight(config, contract, is_dual=executable.dual_rate),
            executable,
            clock=self._clock,
            send=self._sent,
            cameras=[CameraPath(camera=video, cache=self._cache, clock=self._clock)],
            sinks=(),
            watches_images=False,
            watch_solve=self._keep,
        )
        autopilot = "none" if log.profile is None else log.profile.name
        status = GuardStatus(autopilot, None, True, None, (), None, has_position=True)
        self._bridge.view.receive(status)

    @property
    def note(self) -> str | None:
        """What had to be assumed for the pilot's sticks."""
        return self._sticks.note

    def run(self) -> Iterator[ActionPair]:
        """Each solve of the policy from the first image to the last, beside the pilot's sticks.

        Raises:
            UserError: the video begins after the log, or ends before it.
        """
        self._skip_images_before_log()
        view, policy, decoder = self._bridge.view, self._bridge.policy, PacketDecoder()
        for at_ns, packet in self._log.packets():
            now_ns = START_NS + at_ns
            self._bring_images(now_ns)
            self._clock.sleep_until_ns(now_ns)
            if (sticks := self._sticks.receive(packet)) is not None:
                self._pilot = (now_ns, sticks)
                view.receive(self._tick(sticks, now_ns))
            view.receive(Samples(decoder.decode(packet.data, now_ns, now_ns)))
            if self._video.next_ns is None:
                return
            if policy.has_news and self._cache.latest() is not None:
                policy.step()
                if (pair := self._pair(now_ns)) is not None:
                    yield pair

    def _skip_images_before_log(self) -> None:
        while (next_ns := self._video.next_ns) is not None and next_ns < START_NS:
            self._video.read(0)
        if next_ns is None or next_ns - START_NS > self._log.seconds * NS_PER_S:
            where = "ends before" if next_ns is None else "begins after"
            raise UserError(
                f"the video {where} the log of {self._log.seconds:.1f} s: give by --video-start "
                "how many seconds after the log's first packet its first image was taken"
            )

    def _bring_images(self, until_ns: int) -> None:
        while (next_ns := self._video.next_ns) is not None and next_ns <= until_ns:
            self._clock.sleep_until_ns(next_ns)
            self._bridge.visions[0].step()

    def _pair(self, now_ns: int) -> ActionPair | None:
        solve, self._solve = self._solve, None
        if solve is None:
            return None
        pilot = self._pilot
        is_held = pilot is not None and now_ns - pilot[0] <= STICKS_FRESH_NS
        return ActionPair(
            at_s=(now_ns - START_NS) / NS_PER_S,
            policy=tuple(solve.actions[0, 0].tolist()),
            recorded=tuple(pilot[1]) if pilot is not None and is_held else None,
        )

    def _tick(self, sticks: Sticks, now_ns: int) -> GuardTick:
        """The pilot's sticks, as the guard reports those that it has sent."""
        self._ticks += 1
        return GuardTick(
            index=self._ticks,
            due_ns=now_ns,
            woke_ns=now_ns,
            decided_ns=now_ns,
            sent_ns=now_ns,
            missed_slots=0,
            is_slot=True,
            is_coasting=False,
            chunk_serial=None,
            trace=None,
            sent=sticks,
            phase=Phase.FLYING,
            reason=None,
        )

    def _sent(self, message: Chunk | NoChunk) -> None:
        if isinstance(message, NoChunk):
            reason = message.reason
            self.refusals[self._sentences.setdefault(reason.key, str(reason))] += 1

    def _keep(self, solve: Solve) -> None:
        self._solve = solve
