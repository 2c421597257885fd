"""The vehicle as a recording sees it: packets for the log, and the pilot's sticks in the ticks."""

import threading
from dataclasses import replace

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.ports import TickSink
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Event, Tick
from mavbridge.core.vehicle import Packet
from mavbridge.flight.history import SentHistory
from mavbridge.flight.state import Freshness, StateFrame
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.wire import FromGuard, Packets
from mavbridge.mavlink.codec.frames import split_frames
from mavbridge.mavlink.session.streams import message_id
from mavbridge.mavlink.transport.packet_pipe import PacketPipe

STICK_IDS = {"ardupilot": message_id("RC_CHANNELS"), "px4": message_id("MANUAL_CONTROL")}
"""Message that carries the pilot's sticks, by the first word of the autopilot's name."""
STICKS_FRESH_NS = 500 * NS_PER_MS
"""Older sticks are not the pilot's any more: PX4 goes silent where its receiver does."""
PILOTS = because(Code.PILOT_FLIES)


class PilotView(TelemetryCache):
    """Adds to a ``TelemetryCache`` a log of the vehicle's packets, and counts those with sticks."""

    def __init__(
        self,
        *,
        history: SentHistory,
        sink: TickSink,
        state_frame: StateFrame,
        freshness: Freshness,
    ) -> None:
        super().__init__(
            history=history,
            sink=PilotTicks(self, sink),
            state_frame=state_frame,
            freshness=freshness,
        )
        self._log: PacketPipe | None = None
        self._log_lock = threading.Lock()
        self.sticks_ns = 0
        """Arrival of the newest sticks."""
        self.stick_packets = 0

    def log_to(self, log: PacketPipe | None) -> None:
        """Write every packet of the vehicle there from now on; the one before is free then."""
        with self._log_lock:
            self._log = log

    def receive(self, message: FromGuard) -> None:
        """Take one message of the guard."""
        super().receive(message)
        if not isinstance(message, Packets):
            return
        stick_id = STICK_IDS.get(self.status.autopilot.partition(" ")[0])
        with self._log_lock:
            for packet in message.packets:
                if self._log is not None:
                    self._log.put(Packet(packet.arrived_ns, packet.data))
                frames, _ = split_frames(packet.data)
                if frames and frames[0].message_id == stick_id:
                    self.sticks_ns = packet.arrived_ns
                    self.stick_packets += 1


class PilotTicks:
    """A ``TickSink`` that tells the pilot's flight from that of a policy which is not there."""

    def __init__(self, view: PilotView, sink: TickSink) -> None:
        self._view = view
        self._sink = sink

    def emit(self, event: Event) -> None:
        """Pass it on; sticks that are old are none."""
        if isinstance(event, Tick):
            is_fresh = event.woke_ns - self._view.sticks_ns <= STICKS_FRESH_NS
            event = replace(
                event,
                rc_sticks=event.rc_sticks if is_fresh else None,
                release_reason=PILOTS,
                phase="released",
            )
        self._sink.emit(event)
