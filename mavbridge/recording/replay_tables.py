"""Writes what a replay needs: solves, features, stamps of packets, and all settings."""

from pathlib import Path
from typing import Generic, TypeVar

import pyarrow as pa

from mavbridge.core.observers import BoundedQueue
from mavbridge.core.records import FeatureFrame, Solve, VisionTick
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.recording import replay_rows
from mavbridge.recording.folder import PACKETS, SOLVES, features_of
from mavbridge.recording.replay_rows import (
    FeatureRow,
    SolveRow,
    features_batch,
    packets_batch,
    solves_batch,
)
from mavbridge.recording.tables import TableWriter

PACKET_CAPACITY = 60_000
"""Packets whose stamps may wait: a minute of the busiest link."""
_Row = TypeVar("_Row")


class _Buffered(Generic[_Row]):
    """A table and the rows that are not in it yet."""

    def __init__(self, stem: Path, schema: pa.Schema) -> None:
        self.table = TableWriter(stem, schema)
        self.table.append(pa.RecordBatch.from_pylist([], schema=schema))
        self.rows: list[_Row] = []
        self.serial = -1

    def dropped_before(self, serial: int) -> int:
        """Rows between the last serial number and this one."""
        dropped, self.serial = serial - self.serial - 1, serial
        return dropped

    def take(self) -> list[_Row]:
        """The rows; what cannot be written is not tried again."""
        rows, self.rows = self.rows, []
        return rows


class ReplayTables:
    """Used by the recorder's thread, ``packets.put`` excepted.

    Methods raise OSError where a file cannot be written; what was written before stays readable.
    """

    def __init__(self, folder: Path, cameras: tuple[str, ...], *, has_features: bool) -> None:
        """Create the tables in the folder of a flight.

        Args:
            folder: the flight's.
            cameras: those of the contract, in its order.
            has_features: the policy has features, not just resized images.
        """
        self._solves: _Buffered[SolveRow] = _Buffered(folder / SOLVES, replay_rows.SOLVES)
        self._solves.serial = 0  # that of the first solve is 1
        self._packets = TableWriter(folder / PACKETS, replay_rows.PACKETS)
        self._packets_lost = 0
        names = (None, *cameras[1:]) if has_features else ()
        self._features: list[_Buffered[FeatureRow]] = [
            _Buffered(folder / features_of(name), replay_rows.FEATURES) for name in names
        ]
        self.packets: BoundedQueue[tuple[ForwardedPacket, ...]] = BoundedQueue(PACKET_CAPACITY)
        """Groups of packets, as they came; another thread puts them in."""

    def solve(self, solve: Solve) -> None:
        """Record a solve; serial numbers that were left out count as dropped."""
        dropped = self._solves.dropped_before(solve.serial)
        self._solves.rows.append(SolveRow(solve, dropped))

    def feature(self, vision: VisionTick) -> None:
        """Record a feature of any camera, if the policy has features."""
        if not self._features or vision.feature is None:
            return
        table = self._features[vision.camera]
        frame = FeatureFrame(
            frame_id=vision.frame_id,
            captured_ns=vision.captured_ns,
            ready_ns=vision.ready_ns,
            value=vision.feature,
            fault=vision.fault,
        )
        table.rows.append(FeatureRow(frame, table.dropped_before(vision.serial)))

    def flush(self) -> None:
        """Hand all rows to the kernel."""
        if solves := self._solves.take():
            self._solves.table.append(solves_batch(solves))
        for features in self._features:
            if rows := features.take():
                features.table.append(features_batch(rows))
        if packets := [packet for group in self.packets.take() for packet in group]:
            lost, self._packets_lost = (
                self.packets.dropped - self._packets_lost,
                self.packets.dropped,
            )
            self._packets.append(packets_batch(packets, lost))

    def finish(self) -> None:
        """Write the rest, and make Parquet of the tables."""
        self.flush()
        for table in self._tables:
            table.finish()

    def abandon(self) -> None:
        """Leave the tables as they are, after an error."""
        for table in self._tables:
            table.abandon()

    @property
    def _tables(self) -> list[TableWriter]:
        return [self._packets, self._solves.table, *(each.table for each in self._features)]
