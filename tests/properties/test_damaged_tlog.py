"""A damaged telemetry log is read on behind the damage, and the loss is counted."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.tlog import read_tlog

Records = list[tuple[int, bytes]]
START_US = 1_700_000_000_000_000
UNKNOWN = 60_001
"""Number of a message that no dialect here has."""
MESSAGES = (
    dialect.MAVLink_attitude_message(1, 0.1, 0, 0, 0, 0, 0),
    dialect.MAVLink_heartbeat_message(2, 3, 0, 2, 4, 3),
    dialect.MAVLink_statustext_message(6, b"\xfd\xfe" * 25),
    dialect.MAVLink_sys_status_message(*[0xFE] * 6, 1, *[0] * 6),
)


def make_records(kinds: Sequence[int], *, v1: bool = False) -> Records:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    mav.seq = 200
    records = []
    for number, kind in enumerate(kinds):
        packet = bytes(MESSAGES[kind].pack(mav, force_mavlink1=v1))
        mav.seq = (mav.seq + 1) % 256
        records.append((START_US + number * 20_000, packet))
    return records


def encoded(record: tuple[int, bytes]) -> bytes:
    return record[0].to_bytes(8, "big") + record[1]


def read(data: bytes) -> tuple[Records, int]:
    with TemporaryDirectory() as folder:
        path = Path(folder, "flight.tlog")
        path.write_bytes(data)
        records, skipped = read_tlog(path)
        return [(us, packet.data) for us, packet in records], skipped


def is_part(some: Records, all_: Records) -> bool:
    rest = iter(all_)
    return all(record in rest for record in some)


@given(
    st.lists(st.integers(0, 3), min_size=4, max_size=60),
    st.data(),
    st.binary(min_size=1, max_size=1500),
    st.sampled_from(["overwritten", "inserted", "cut out"]),
    st.booleans(),
)
def test_what_lies_outside_the_damage_is_read_and_the_loss_is_right(
    kinds: list[int], data: st.DataObject, foreign: bytes, damage: str, v1: bool
) -> None:
    records = make_records(kinds, v1=v1)
    pieces = [encoded(record) for record in records]
    ends = [sum(map(len, pieces[: number + 1])) for number in range(len(pieces))]
    whole = b"".join(pieces)
    first = data.draw(st.integers(0, ends[-1]))
    length = len(foreign) if damage != "inserted" else 0
    last = min(first + length, ends[-1])
    middle = b"" if damage == "cut out" else foreign[: (last - first) or None]

    found, skipped = read(whole[:first] + middle + whole[last:])

    spared = [
        record
        for record, piece, end in zip(records, pieces, ends, strict=True)
        if end <= first or end - len(piece) >= last
    ]
    assert is_part(spared, found)
    size = len(whole) - (last - first) + len(middle)
    assert skipped == size - sum(len(encoded(record)) for record in found)


def test_packets_of_unknown_messages_are_read() -> None:
    records = make_records([0] * 6)
    unknown = bytearray(records[3][1])
    unknown[7:10] = UNKNOWN.to_bytes(3, "little")
    records[3] = (records[3][0], bytes(unknown))
    assert read(b"".join(map(encoded, records))) == (records, 0)
