"""Settings that stand in sections of a file: printed, read back, and given on the command line."""

from dataclasses import replace
from pathlib import Path

import pytest

from mavbridge.cli import cli
from mavbridge.config.flight import FlyConfig
from mavbridge.core.errors import UserError

VEHICLE = ("--connect", "udp:127.0.0.1:1")


def flown(monkeypatch: pytest.MonkeyPatch, *words: str) -> FlyConfig:
    """The configuration of the flight that these words ask for."""
    seen: list[FlyConfig] = []
    monkeypatch.setattr(cli, "config", cli.config)  # set by the words, for all who parse later
    monkeypatch.setattr("mavbridge.flight.app.fly", lambda config: seen.append(config) or 0)
    with pytest.raises(SystemExit) as ended:
        cli.meta([*VEHICLE, *words])
    assert ended.value.code == 0
    return seen[0]


def test_the_printed_file_holds_the_defaults_of_every_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.meta(["fly", "--print-config"])
    printed = capsys.readouterr().out
    path = tmp_path / "all.toml"
    path.write_text(printed)
    default = FlyConfig()
    link = replace(default.link, connect=VEHICLE[1])
    assert flown(monkeypatch, "--config", str(path)) == replace(default, link=link)
    for section in ("link", "network", "rates", "scheduling", "limits", "envelope", "setpoints"):
        assert f"\n[{section}]\n" in printed
    for line in ("slew = 8.0", "# attitude_age =", "realtime = true", "# Largest tilt, in degrees"):
        assert f"\n{line}" in printed


def test_a_setting_on_the_command_line_wins_over_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "own.toml"
    path.write_text("[limits]\nattitude-age = 0.09\nslew = 3\n[scheduling]\nrealtime = true\n")
    given = (
        "limits.attitude_age=0.05",
        "scheduling.realtime=false",
        "link.accept_risk=slow-serial",
    )
    more = ("link.accept-risk=endless-override", "rates.visual=20", "network.engine=torch")
    words = [word for text in (*given, *more) for word in ("--set-config", text)]
    config = flown(monkeypatch, "--config", str(path), *words)
    assert (config.limits.max_attitude_age, config.limits.max_slew) == (0.05, 3.0)
    assert config.rates.realtime is False
    assert config.link.accept_risk == ("slow-serial", "endless-override")
    assert (config.rates.visual_rate, config.policy.engine) == (20.0, "torch")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("limits", "use SECTION.KEY=VALUE"),
        ("limits.slew=-1", "limits.slew must be between 0 and 1000 1/s"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_by_its_name(text: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        cli.meta([*VEHICLE, "--set-config", text])


@pytest.mark.parametrize("text", ["replay.tau=1", "limits.no_such=1", "nothing.attitude_age=1"])
def test_a_setting_that_no_section_has_is_refused(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "config", cli.config)
    with pytest.raises(SystemExit) as ended:
        cli.meta([*VEHICLE, "--set-config", text])
    assert ended.value.code != 0
    printed = capsys.readouterr()
    assert text.partition(".")[0] in printed.out + printed.err
