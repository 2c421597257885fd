"""Settings that stand in sections of a file: printed, read back, and given on the command line."""

from dataclasses import replace
from pathlib import Path

import pytest

from helpers.status import asked_flight, status_of, told_by
from mavbridge.cli import cli
from mavbridge.config.flight import FlyConfig
from mavbridge.config.settings_files import untrusted_settings
from policy.files import read_toml

VEHICLE = ("--connect", "udp:127.0.0.1:1")


def test_the_printed_file_holds_the_defaults_of_every_setting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of("fly", "--print-config") == 0
    printed = capsys.readouterr().out
    path = tmp_path / "all.toml"
    path.write_text(printed)
    default = FlyConfig()
    link = replace(default.link, connect=VEHICLE[1])
    assert asked_flight(*VEHICLE, "--config", path) == replace(default, link=link)
    for section in ("link", "network", "rates", "scheduling", "limits", "envelope", "setpoints"):
        assert f"\n[{section}]\n" in printed
    for line in ("slew = 8.0", "# attitude_age =", "realtime = true", "# Largest tilt, in degrees"):
        assert f"\n{line}" in printed


@pytest.mark.parametrize("command", [name for name in cli if not name.startswith("-")])
def test_the_printed_file_may_be_read_by_its_command(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of(command, "--print-config") == 0
    path = tmp_path / "all.toml"
    path.write_text(capsys.readouterr().out)
    assert list(untrusted_settings(read_toml(path), [])) == []


def test_what_the_command_line_asks_for_is_printed_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = (*VEHICLE, "--arm", "--camera=a=none", "--set-config", "envelope.height=20")
    asked += ("--record", "é 🚁 \\ud83d\\ude81 \x7f", "--camera=b=🚁🚁.mp4")
    first, path = tmp_path / "first.toml", tmp_path / "all.toml"
    first.write_text("[limits]\nslew = 3\n")
    assert status_of(*asked, "--config", first, "--print-config") == 0
    path.write_text(capsys.readouterr().out)
    assert asked_flight("--config", path) == asked_flight(*asked, "--config", first)


@pytest.mark.parametrize("words", [(), ("fly",), ("check",), ("inspect", "a"), ("replay", "a")])
def test_a_file_that_asks_for_nothing_is_printed_as_the_defaults(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (path := tmp_path / "own.toml").touch()
    assert status_of(*words, "--config", path, "--print-config") == 0
    printed = capsys.readouterr().out
    assert status_of(*words[:1], "--print-config") == 0
    assert capsys.readouterr().out == printed


def test_a_section_whose_keys_are_all_commented_out_asks_for_nothing(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("[limits]\n# slew = 3\n[network]\n")
    assert asked_flight(*VEHICLE, "--config", path) == asked_flight(*VEHICLE)


def test_a_setting_on_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("[limits]\nattitude-age = 0.09\nslew = 3\n[scheduling]\nrealtime = true\n")
    given = (
        *("limits.attitude_age=0.05", "scheduling.realtime=false", "rates.visual=20"),
        *("link.accept_risk=slow-serial", "link.accept-risk=endless-override"),
        "network.engine=torch",
    )
    words = [word for text in given for word in ("--set-config", text)]
    config = asked_flight(*VEHICLE, "--config", path, *words)
    assert (config.limits.max_attitude_age, config.limits.max_slew) == (0.05, 3.0)
    assert config.rates.realtime is False
    assert config.link.accept_risk == ("slow-serial", "endless-override")
    assert (config.rates.visual_rate, config.policy.engine) == (20.0, "torch")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("no_arm = true", "write arm = false"),
        ("single-rate = true", "write dual-rate = false"),
        ("[fly]\narm = true", "there is no section [fly] here"),
        ("[fly.envelope]\nheight = 5", "there is no section [fly] here"),
        ("envelope = 30", "write [envelope], and its keys"),
        ("verbose = true", "verbose is no key of a file"),
        ("engage_channel = 7.5", "engage_channel"),
        ("[link]\ntarget_system = 1.6", "target_system"),
    ],
)
def test_a_key_that_would_be_ignored_or_do_something_else_is_refused(
    text: str, told: str, tmp_path: Path
) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    status, said = told_by(*VEHICLE, "--config", path)
    assert (status, told in said) == (2, True), said


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("limits", "use SECTION.NAME=VALUE"),
        ("limits.slew=-1", "limits.slew must be between 0 and 1000 1/s"),
        ("replay.tau=1", "replay"),
        ("limits.no_such=1", "limits"),
        ("nothing.attitude_age=1", "nothing"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_by_its_name(text: str, told: str) -> None:
    status, said = told_by(*VEHICLE, "--set-config", text)
    assert (status != 0, told in said) == (True, True), said
