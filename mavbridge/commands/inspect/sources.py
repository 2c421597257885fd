"""What a recorded flight holds besides its ticks and frames; older flights lack most of it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mavbridge.commands.inspect.delays import Arrivals
from mavbridge.config.flight import Limits
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import Solve
from mavbridge.flight.settings import effective_freshness
from mavbridge.gate.chunks import FreshnessLimits
from mavbridge.recording import replay_rows
from mavbridge.recording.folder import PACKETS, SOLVES
from mavbridge.recording.replay_rows import read_solves
from mavbridge.recording.settings import read_settings
from mavbridge.recording.tables import read_table
from policy.contract import Contract

ATTITUDES = (30, 31)
"""Message ids of ATTITUDE and ATTITUDE_QUATERNION (MAVLink, common.xml)."""


def flown_limits(folder: Path, contract: Contract | None) -> FreshnessLimits | None:
    """Ages at which chunks were flown: the flags' where they are recorded, else the contract's."""
    if contract is None:
        return None
    try:
        return effective_freshness(contract, read_settings(folder).config.limits)
    except MavbridgeError:  # no settings, or those of another version
        return effective_freshness(contract, Limits())


def read_arrivals(folder: Path, damage: list[str]) -> Arrivals | None:
    """Attitudes that reached the flight process; None where the recording has no such table.

    A sentence on what is lost is added to ``damage``.

    Raises:
        MavbridgeError: the table is damaged.
    """
    if not _has(folder, PACKETS):
        return None
    table = read_table(folder / PACKETS, replay_rows.PACKETS, damage=damage)
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    rows = np.flatnonzero(np.isin(columns["message_id"], ATTITUDES))
    if not len(rows):
        return None
    rows = rows[np.argsort(columns["happened_ns"][rows], kind="stable")]
    return Arrivals(columns["happened_ns"][rows], columns["arrived_ns"][rows])


def recorded_solves(folder: Path, contract: Contract | None) -> Iterator[Solve]:
    """What the policy computed, in the order of time; nothing where it was not recorded.

    Raises:
        MavbridgeError: the table is damaged.
    """
    if contract is not None and _has(folder, SOLVES):
        table = read_table(folder / SOLVES, replay_rows.SOLVES)
        yield from (row.solve for row in read_solves(table, contract))


def _has(folder: Path, stem: str) -> bool:
    return any((folder / stem).with_suffix(end).exists() for end in (".parquet", ".arrows"))
