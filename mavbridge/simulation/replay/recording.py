"""Contents of a recorded flight that a replay needs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.records import FeatureFrame, Solve, Tick
from mavbridge.mavlink.codec.frames import RawPacket
from mavbridge.mavlink.codec.tlog import read_tlog
from mavbridge.recording import replay_files
from mavbridge.recording.folder import FlightMeta, read_meta
from mavbridge.recording.replay_files import (
    PacketStamp,
    packet_key,
    read_features,
    read_packets,
    read_settings,
    read_solves,
)
from mavbridge.recording.rows import TickRow, read_ticks
from policy.contract import Contract
from policy.data.flight_files import FEATURES, PACKETS, SOLVES, TICKS, TLOG, of_camera
from policy.data.tables import TICK_COLUMNS, read_table
from policy.files import why_unreadable

STAMP_NS = 10 * NS_PER_MS
"""Largest difference between a packet's two stamps: the log's are rounded to 4 us, and wall clock
and monotonic clock drift apart by less in an hour."""
_PARAM_REQUEST_READ, _PARAM_ID = 20, slice(4, 20)
"""Message id, and position of the parameter's name in its payload."""
_REQUESTS = (_PARAM_REQUEST_READ, 76)
"""Message ids of requests to the vehicle; 76: COMMAND_LONG."""
LOOK_AHEAD = 64
"""Table rows searched for a packet of the log, since the log may have lost some."""


class RecordedPacket(NamedTuple):
    """Packet received from the vehicle's side."""

    arrived_ns: int
    """Exact if the flight process got the packet, else rounded to 4 us."""
    happened_ns: int | None
    """None: the flight process did not get the packet."""
    data: bytes


@dataclass(frozen=True, kw_only=True)
class ReplaySource:
    """One recorded flight."""

    folder: Path
    meta: FlightMeta
    config: FlyConfig
    """Flags of the flight, without those that act outside it, such as ``--set`` and
    ``--record``."""
    ticks: tuple[Tick, ...]
    solves: tuple[Solve, ...]
    features: tuple[tuple[FeatureFrame, ...], ...]
    """Features of each camera of the contract; empty for a single-rate policy."""
    packets: tuple[RecordedPacket, ...]
    """Packets in order of arrival."""
    known_params: frozenset[str]
    """Parameters that the flight had requested; a later version requests more."""
    requested_ns: tuple[int, ...]
    """When the guard's requests to the vehicle left, from the log."""
    gaps: tuple[str, ...]
    """Losses of the recording, in words; the replay may differ there."""

    @property
    def contract(self) -> Contract:
        """Contract of the policy that flew."""
        return self.meta.contract


def open_source(folder: Path) -> ReplaySource:
    """Read a flight, finished or cut off.

    Raises:
        MavbridgeError: not a recorded flight, or one that cannot be replayed.
    """
    meta, settings = read_meta(folder), read_settings(folder)
    flown = settings.config
    damage: list[str] = []
    ticks, solves, solves_lost = _rows(folder, meta, damage)
    stamps = list(read_packets(read_table(folder / PACKETS, replay_files.PACKETS, damage=damage)))
    log, skipped = read_tlog(folder / TLOG)
    offset_ns = settings.wall_offset_ns
    if skipped and not log:
        raise UserError(why_unreadable(folder / TLOG, ValueError("no MAVLink in it")))
    if skipped:
        damage.append(
            f"{folder / TLOG} is damaged, or of another MAVLink dialect: {skipped} bytes were "
            "skipped"
        )
    system = flown.link.source_system
    received = [each for each in log if each[1].source.system != system]
    sent = [each for each in log if each[1].source.system == system]
    packets = tuple(_packets(received, stamps, offset_ns))
    features = _features(folder, meta, damage)
    lost = _lost(
        ticks=sum(row.dropped_before for row in ticks),
        solves=solves_lost,
        packets=len(stamps) - sum(packet.happened_ns is not None for packet in packets),
    )
    return ReplaySource(
        folder=folder,
        meta=meta,
        config=replace(
            flown,
            link=replace(flown.link, set=()),
            policy=replace(flown.policy, dual_rate=meta.mode == "dual"),
            record=None,
        ),
        ticks=tuple(row.tick for row in ticks),
        solves=tuple(solves),
        features=features,
        packets=packets,
        known_params=frozenset(
            packet.payload[_PARAM_ID].rstrip(b"\0").decode("ascii", "replace")
            for _, packet in sent
            if packet.message_id == _PARAM_REQUEST_READ
        ),
        requested_ns=tuple(
            1000 * stamp_us - offset_ns
            for stamp_us, packet in sent
            if packet.message_id in _REQUESTS
        ),
        gaps=(*damage, *lost),
    )


def _rows(
    folder: Path, meta: FlightMeta, damage: list[str]
) -> tuple[list[TickRow], list[Solve], int]:
    """Read ticks, solves and the number of lost solves; raise UserError without ticks or solves."""
    table = read_table(folder / TICKS, TICK_COLUMNS, damage=damage)
    ticks = list(read_ticks(table, meta.contract.action))
    table = read_table(folder / SOLVES, replay_files.SOLVES, damage=damage)
    solves = list(read_solves(table, meta.contract))
    if ticks and solves and (damage or not meta.finished):  # the last of either lack their inputs
        newest, count = solves[-1].serial, len(ticks)
        ticks = list(takewhile(lambda row: (row.tick.chunk_serial or 0) <= newest, ticks))
        if count > len(ticks):
            damage.append(f"the chunks of its last {count - len(ticks)} ticks are not recorded")
        solves = [each for each in solves if ticks and each.started_ns <= ticks[-1].tick.sent_ns]
    if not ticks or not solves:
        raise UserError(
            f"{folder} ended before its policy had computed anything: nothing to replay"
        )
    return ticks, solves, sum(table["dropped_before"].to_pylist())


def _lost(**counts: int) -> Iterator[str]:
    for what, count in counts.items():
        if count:
            yield f"{count} {what} are not in the recording"


def _features(
    folder: Path, meta: FlightMeta, damage: list[str]
) -> tuple[tuple[FeatureFrame, ...], ...]:
    if meta.mode != "dual":
        return ()
    tables = [
        read_table(folder / of_camera(FEATURES, name), replay_files.FEATURES, damage=damage)
        for name in (None, *meta.contract.cameras[1:])
    ]
    return tuple(tuple(read_features(table)) for table in tables)


def _packets(
    log: Sequence[tuple[int, RawPacket]], stamps: Sequence[PacketStamp], offset_ns: int
) -> Iterator[RecordedPacket]:
    """Yield the packets of the log, with exact stamps for those in the table.

    Log and table have the same order, so each packet is searched after the previous match.
    """
    waiting = 0
    latest_ns = 0
    for stamp_us, packet in log:
        rough_ns = 1000 * stamp_us - offset_ns
        key = packet_key(packet.data)
        found = None
        while waiting < len(stamps) and stamps[waiting].arrived_ns < rough_ns - STAMP_NS:
            waiting += 1  # the log has lost this packet
        for place in range(waiting, min(waiting + LOOK_AHEAD, len(stamps))):
            stamp = stamps[place]
            if stamp.arrived_ns - rough_ns >= STAMP_NS:
                break
            if (stamp.message_id, stamp.sequence) == key:
                found, waiting = stamp, place + 1
                break
        arrived_ns = rough_ns if found is None else found.arrived_ns
        latest_ns = max(latest_ns, arrived_ns)
        yield RecordedPacket(latest_ns, found and found.happened_ns, packet.data)
