"""The whole check without a vehicle, its table and its JSON."""

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from mavbridge import cli
from mavbridge.commands.check.config import CheckConfig
from mavbridge.commands.check.policy import check_policy
from mavbridge.commands.check.rows import Row, as_document, overall
from mavbridge.commands.check.run import check
from mavbridge.commands.check.table import print_check
from mavbridge.config.flight import CameraConfig, FlyConfig, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import ExitCode, UserError
from mavbridge.core.processes import free_port

BLIND = CameraConfig(camera=("none",))
REFUSED = Row(
    area="parameters",
    name="RC_OVERRIDE_TIME",
    found="-1",
    expected="0.5",
    verdict="no-go",
    advice="it would hold its last sticks for ever: use --set RC_OVERRIDE_TIME=0.5, or else",
)
GO = Row(area="link", name="attitude", found="100.0 Hz", expected="100 Hz")


def flight(policy: str, camera: CameraConfig = BLIND) -> FlyConfig:
    link = LinkConfig(connect=f"udp:127.0.0.1:{free_port()}", connect_timeout=0.1)
    return FlyConfig(link=link, policy=PolicyConfig(policy=policy), camera=camera)


def test_no_vehicle_is_a_no_go_in_status_table_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "check.json"
    status = check(CheckConfig(flight=flight("scripted:hover"), json=path))

    document = json.loads(path.read_text())
    assert status == ExitCode.NOT_FLOWN
    assert document["verdict"] == "no-go"
    assert [row["name"] for row in document["rows"] if row["verdict"] == "no-go"] == ["vehicle"]
    assert "NO-GO: " in capsys.readouterr().out


def test_json_on_standard_output_is_nothing_but_json(capsys: pytest.CaptureFixture[str]) -> None:
    check(CheckConfig(flight=flight("none"), json=Path("-")))
    out, err = capsys.readouterr()
    assert json.loads(out)["verdict"] == "no-go"
    assert "heard nothing" in err


def test_the_vehicle_must_be_named() -> None:
    with pytest.raises(UserError, match="--connect"):
        cli.check()


def test_a_net_without_its_camera_is_a_no_go(capsys: pytest.CaptureFixture[str]) -> None:
    check(CheckConfig(flight=flight("resnet-unet:nonsense"), json=Path("-")))
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert "name its camera" in rows["cameras"]["advice"]
    assert rows["policy"]["verdict"] == "no-go", "a policy that cannot be loaded is a row"


def test_a_policy_tells_its_engine_speed_and_contract() -> None:
    findings = check_policy(flight("scripted:square:velocity"), MonotonicClock())
    names = [row.name for row in findings.rows]
    assert names == ["engine", "time for a chunk", "time for an image", "contract", "plan"]
    assert findings.contract is not None
    assert findings.contract.action == "velocity"


def test_a_flag_that_contradicts_the_policy_is_a_no_go() -> None:
    config = FlyConfig(policy=PolicyConfig(policy="scripted:hover"), mode="LOITER", camera=BLIND)
    (row,) = [
        row
        for row in check_policy(config, MonotonicClock()).rows
        if row.name == "flags of the flight"
    ]
    assert row.verdict == "no-go"
    assert "--mode LOITER" in row.advice


def test_the_worst_row_is_the_verdict() -> None:
    assert overall([GO]) == "go"
    assert overall([GO, Row(area="link", name="loss", found="3%", verdict="warn")]) == "warn"
    assert overall([GO, REFUSED]) == "no-go"
    assert as_document([REFUSED])["rows"][0]["commands"] == ["--set RC_OVERRIDE_TIME=0.5"]


@pytest.mark.parametrize("width", [80, 160])
def test_the_table_fits_its_terminal_and_ends_with_what_to_do(width: int) -> None:
    out = io.StringIO()
    print_check(
        [GO, REFUSED], Console(file=out, width=width, force_terminal=True, color_system=None)
    )
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert "NO-GO" in lines[-2]
    assert lines[-1].endswith("--set RC_OVERRIDE_TIME=0.5")


def test_a_row_hides_the_password_of_an_address_in_table_and_json() -> None:
    text = "rtsp://me:it@host/1?token=abc"
    row = Row(area="camera", name="camera", found=text, expected=text, advice=text)
    assert "it@" not in json.dumps(as_document([row]))
    assert row.found == "rtsp://me:***@host/1?token=***"
