"""A damaged telemetry log is read on behind the damage, and the loss is counted."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.tlog import Skipped, read_tlog

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


def read(data: bytes) -> tuple[Records, Skipped]:
    skipped = Skipped()
    with TemporaryDirectory() as folder:
        path = Path(folder, "flight.tlog")
        path.write_bytes(data)
        return [(us, packet.data) for us, packet in read_tlog(path, skipped)], skipped


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
    first = data.draw(st.integers(ends[0], ends[-2]))
    length = len(foreign) if damage != "inserted" else 0
    last = min(first + length, ends[-2])
    middle = b"" if damage == "cut out" else foreign[: (last - first) or None]

    found, skipped = read(whole[:first] + middle + whole[last:])

    spared = [
        record
        for record, piece, end in zip(records, pieces, ends, strict=True)
        if end <= first or end - len(piece) >= last
    ]
    assert is_part(spared, found)
    size = len(whole) - (last - first) + len(middle)
    assert skipped.bytes == size - sum(len(encoded(record)) for record in found)
    if skipped.bytes:
        assert skipped.packets == len(records) - len(found)


@given(st.integers(0, 150), st.integers(1, 60))
def test_a_log_that_is_cut_at_either_end_says_so(head: int, tail: int) -> None:
    records = make_records([0, 1, 2, 3] * 5)
    found, skipped = read(b"".join(map(encoded, records))[head : -tail or None])
    assert is_part(found, records)
    assert len(found) >= 20 - 5 - 3
    assert skipped.packets >= 1 or not skipped.bytes


def test_packets_of_unknown_messages_are_read() -> None:
    records = make_records([0] * 6)
    unknown = bytearray(records[3][1])
    unknown[7:10] = UNKNOWN.to_bytes(3, "little")
    records[3] = (records[3][0], bytes(unknown))
    assert read(b"".join(map(encoded, records))) == (records, Skipped())


def test_two_senders_are_counted_apart() -> None:
    ours, theirs = make_records([0] * 30), make_records([1] * 30)
    mav = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
    mav.seq = 40
    other = []
    for us, _ in theirs:
        other.append((us + 1, bytes(MESSAGES[1].pack(mav))))
        mav.seq = (mav.seq + 1) % 256
    records = [record for pair in zip(ours, other, strict=True) for record in pair]
    pieces = [encoded(record) for record in records]
    data = b"".join([*pieces[:20], b"?" * 300, *pieces[31:]])
    found, skipped = read(data)
    assert found == records[:20] + records[31:]
    assert skipped == Skipped(bytes=300, packets=11)
