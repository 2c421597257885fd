"""The observers of one flight: timing, terminal, Rerun viewer and recorder."""

from contextlib import ExitStack
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

import mavbridge
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S, Clock, wall_offset_ns
from mavbridge.core.errors import UserError
from mavbridge.core.observers import BoundedQueue, ObserverThread
from mavbridge.core.ports import TickSink
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.observe.rerun_flight import RerunView
from mavbridge.observe.terminal import FlightScreen
from mavbridge.observe.timing import FlightTiming, Mode, ObserverDrops, report_json
from policy.contract import Executable

if TYPE_CHECKING:  # the extra "record" may not be installed
    from mavbridge.recording.recorder import Recorder

RERUN_CAPACITY = 1000
"""Ticks that may wait for the viewer: ten seconds at 100 Hz."""
PACKET_CAPACITY = 16384
"""Packets that may wait for the recorder: ten seconds of a busy link."""
VIEWER_JOIN_S = 2.0
RECORDER_JOIN_S = 60.0
"""The tables of a long flight become Parquet within seconds; the vehicle is released by then."""


class FlightObservers:
    """The observers that the flags ask for. None of them can delay a loop.

    ``packets`` is what the link has to feed for a recording, or None.
    """

    def __init__(
        self, config: FlyConfig, executable: Executable, *, clock: Clock, console: Console
    ) -> None:
        self._config = config
        self._executable = executable
        self._clock = clock
        self._console = console
        self._loops = config.rates.loops(is_dual=executable.dual_rate)
        self._mode: Mode = "dual" if executable.dual_rate else "single"
        action_hz, vision_hz = self._loops.action_hz, self._loops.max_vision_hz
        self._timing = FlightTiming(action_hz=action_hz, vision_hz=vision_hz)
        self._viewer: ObserverThread | None = None
        self._recorder: Recorder | None = None
        self.screen = FlightScreen(
            console, action_hz=action_hz, vision_hz=vision_hz, readonly=config.link.readonly
        )
        self.packets: BoundedQueue[Packet] | None = None
        if config.record is not None:
            self.packets = BoundedQueue(PACKET_CAPACITY)

    @property
    def sinks(self) -> tuple[TickSink, ...]:
        """All observers that are open, for the bridge."""
        optional = (self._recorder, self._viewer)
        return (self._timing, self.screen, *(sink for sink in optional if sink is not None))

    def open_viewer(self, stack: ExitStack) -> None:
        """Start the viewer or its file, if one is wanted; it is closed with ``stack``."""
        if self._config.rerun == "off":
            return
        view = RerunView(
            self._config.rerun,
            action_hz=self._loops.action_hz,
            vision_hz=self._loops.max_vision_hz,
        )
        self._viewer = ObserverThread("mavbridge-rerun", view, capacity=RERUN_CAPACITY)
        stack.callback(self._viewer.close, VIEWER_JOIN_S)

    def open_recorder(self, link: MavlinkLink) -> None:
        """Start the recording, if one is wanted; raises UserError if it cannot be written."""
        if self._config.record is None or self.packets is None:
            return
        from mavbridge.recording.meta import FlightMeta
        from mavbridge.recording.recorder import Recorder

        start_ns, offset_ns = self._clock.now_ns(), wall_offset_ns(self._clock)
        meta = FlightMeta(
            started_at=datetime.fromtimestamp((start_ns + offset_ns) / NS_PER_S, UTC).isoformat(),
            start_ns=start_ns,
            mavbridge_version=mavbridge.__version__,
            source="flight",
            policy=self._executable.name,
            engine=self._executable.engine,
            mode=self._mode,
            action_hz=self._loops.action_hz,
            visual_hz=self._loops.max_vision_hz,
            contract=self._executable.contract,
            seed=self._config.policy.seed,
        )
        try:
            self._recorder = Recorder(
                self._config.record,
                meta,
                packets=self.packets,
                wall_offset_ns=offset_ns,
                autopilot=lambda: link.autopilot,
                report=self.screen.show_message,
            )
        except OSError as error:
            raise UserError(f"--record {self._config.record}: {error}") from error

    def close_recorder(self) -> None:
        """Finish the recording; after the link was closed, so that it holds the release."""
        if self._recorder is not None:
            self._recorder.close(RECORDER_JOIN_S)

    def finish(self, link: MavlinkLink) -> None:
        """Print the report, and write it where --report names a file."""
        viewer, recorder = self._viewer, self._recorder
        report = self._timing.report(
            mode=self._mode,
            engine=self._executable.engine,
            policy=self._executable.name,
            autopilot=link.autopilot,
            link=link.stats(),
            observer_drops=ObserverDrops(
                rerun=viewer.dropped if viewer else None,
                recorder=recorder.dropped if recorder else None,
            ),
        )
        self.screen.show_report(report)
        if recorder is not None:
            self._console.print(Text(recorder.summary()), soft_wrap=True)
        if self._config.report is not None:
            self._config.report.write_text(report_json(report))
