from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.tlog import read_tlog


def test_a_log_of_several_blocks_is_read_whole_up_to_where_it_is_cut_off(tmp_path: Path) -> None:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    packets = [mav.statustext_encode(6, b"x" * 50).pack(mav) for _ in range(20_000)]
    data = b"".join(us.to_bytes(8, "big") + packet for us, packet in enumerate(packets))
    assert len(data) > 1_200_000  # more than one block
    path = tmp_path / "flight.tlog"
    path.write_bytes(data[:-5])

    found = list(read_tlog(path))

    assert [(us, packet.data) for us, packet in found] == list(enumerate(packets))[:-1]


def test_a_log_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        list(read_tlog(tmp_path / "none.tlog"))
