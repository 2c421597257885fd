import pytest

from mavbridge.commands.bench.link import clients, trial

pytestmark = pytest.mark.system


@pytest.mark.parametrize("name", ["mavbridge, 100 Hz clock", "bare pymavlink loop"])
def test_the_link_is_measured_in_real_processes(name: str) -> None:
    found, _ = clients()
    (client,) = (client for client in found if client.name == name)
    link = trial(client, attitudes=50)
    assert link.client == name
    assert link.output == "rc channels override"
    assert link.sent == 50
    # An attitude may be overtaken by the next one, and a shared host may stall.
    assert link.answered >= 25
    assert 0 < link.round_trip_ms.p50 <= link.round_trip_ms.p99 <= link.round_trip_ms.max
    assert (link.state_to_wire_ms is not None) == client.tells
    assert (link.work_ms is not None) == client.tells
