"""The flags of the link, checked and translated."""

from pathlib import Path
from typing import Any

import pytest

from mavbridge.config.flight import LinkConfig
from mavbridge.core.errors import UserError
from mavbridge.core.link_settings import LinkSettings
from mavbridge.flight.settings import link_settings, state_folder


def test_parameters_and_risks_reach_the_link(tmp_path: Path) -> None:
    config = LinkConfig(
        set=("rc_override_time=0.5", "FS_THR_ENABLE=1"),
        restore_params=True,
        accept_risk=("slow-serial",),
    )
    settings = link_settings(
        config, state_hz=100.0, stick_hz=200.0, min_battery_percent=15.0, folder=tmp_path
    )
    assert settings.set_params == (("RC_OVERRIDE_TIME", 0.5), ("FS_THR_ENABLE", 1.0))
    assert settings.restore_params
    assert settings.accepted_risks == ("slow-serial",)
    assert settings.min_battery_percent == 15.0
    assert (settings.stick_hz, settings.state_folder) == (200.0, tmp_path)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"set": ("RC_OVERRIDE_TIME",)}, "NAME=VALUE"),
        ({"set": ("RC_OVERRIDE_TIME=",)}, "NAME=VALUE"),
        ({"set": ("RC_OVERRIDE_TIME=fast",)}, "NAME=VALUE"),
        ({"set": ("RC_OVERRIDE_TIME=nan",)}, "NAME=VALUE"),
        ({"set": ("RC_OVERRIDE_TIME=1e39",)}, "NAME=VALUE"),
        ({"set": ("A_NAME_THAT_IS_TOO_LONG=1",)}, "NAME=VALUE"),
        ({"set": ("../../A=1",)}, "NAME=VALUE"),
        ({"set": ("A=1", "a=2")}, "names A twice"),
        ({"set": ("A=1",), "readonly": True}, "--readonly sets no parameter"),
        ({"restore_params": True, "readonly": True}, "--readonly sets no parameter"),
    ],
)
def test_what_cannot_be_set_is_refused_at_the_door(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        LinkConfig(**flags)


def test_nothing_is_set_that_would_be_remembered_nowhere() -> None:
    with pytest.raises(ValueError, match="state_folder"):
        LinkSettings(set_params=(("A", 1.0),))


def test_the_state_folder_follows_the_users_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_folder() == tmp_path / "mavbridge"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for value in ("", "not/absolute"):
        monkeypatch.setenv("XDG_STATE_HOME", value)
        assert state_folder() == tmp_path / "home" / ".local" / "state" / "mavbridge"
