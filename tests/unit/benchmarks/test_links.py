import pytest

from benchmarks import links
from benchmarks.link import LinkClient
from benchmarks.results import LinkLatency
from helpers.bench_results import make_link


def test_every_client_has_its_turn_in_each_round(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    timed: list[str] = []

    def time_link(client: LinkClient, attitudes: int) -> LinkLatency:
        timed.append(client.name)
        return make_link(client.name, round_trip_ms=attitudes, chunk_to_wire_ms=None)

    monkeypatch.setattr(links, "time_link", time_link)
    links.main(attitudes=25, rounds=2)
    assert timed[:2] == ["mavbridge", "bare pymavlink loop"]
    assert timed == timed[: len(timed) // 2] * 2
    assert capsys.readouterr().out.count("25.00 / 25.00") == len(timed)
