"""The whole check without a vehicle, its table and its JSON."""

import io
import json
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from helpers.fakes import FakeClock
from mavbridge.commands.check import check
from mavbridge.commands.check.policy import Pace, check_policy
from mavbridge.commands.check.rows import CheckRow, as_document, print_check
from mavbridge.commands.config import CheckConfig
from mavbridge.config.flight import CameraConfig, FlyConfig, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.errors import ExitCode
from mavbridge.core.processes import free_port

BLIND = CameraConfig(camera=("none",))
REFUSED = CheckRow(
    area="parameters",
    name="RC_OVERRIDE_TIME",
    found="-1",
    expected="0.5",
    no_go="it would hold its last sticks for ever: use --set RC_OVERRIDE_TIME=0.5, or else",
    commands=("--set RC_OVERRIDE_TIME=0.5",),
)
GO = CheckRow(area="link", name="attitude", found="100.0 Hz", expected="100 Hz")


def flight(policy: str) -> FlyConfig:
    link = LinkConfig(connect=f"udp:127.0.0.1:{free_port()}", connect_timeout=0.1)
    return FlyConfig(link=link, policy=PolicyConfig(policy=policy), camera=BLIND)


def test_no_vehicle_is_a_no_go_in_status_table_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "check.json"
    status = check(CheckConfig(timing=0.5, flight=flight("scripted:hover"), json=path))

    document = json.loads(path.read_text())
    assert status == ExitCode.NOT_FLOWN
    assert document["verdict"] == "no-go"
    assert [row["name"] for row in document["rows"] if row["verdict"] == "no-go"] == ["vehicle"]
    assert "NO-GO: " in capsys.readouterr().out


def test_a_net_without_its_camera_is_a_no_go(capsys: pytest.CaptureFixture[str]) -> None:
    check(CheckConfig(timing=0.5, flight=flight("toge:nonsense"), json=Path("-")))
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert "name a camera" in rows["cameras"]["advice"]
    assert rows["policy"]["verdict"] == "no-go", "a policy that cannot be loaded is a row"


def test_a_policy_and_a_computer_are_checked_without_a_vehicle(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = replace(flight("scripted:hover"), link=LinkConfig(connect="none"))
    assert check(CheckConfig(timing=0.5, flight=config, json=Path("-"))) == ExitCode.DONE
    out, err = capsys.readouterr()
    assert {row["area"] for row in json.loads(out)["rows"]} == {"link", "policy", "computer"}
    assert "Nothing was set, armed or flown.\n" in err, "no message rates were requested"


def test_files_that_a_flight_refuses_are_a_no_go_and_folders_are_removed_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new, missing = tmp_path / "new", tmp_path / "missing.json"
    config = replace(flight("none"), link=LinkConfig(connect="none"))
    good = replace(config, record=new, report=tmp_path / "a" / "r.json", rerun=f"{new}.rrd")
    assert check(CheckConfig(flight=good)) == ExitCode.DONE
    capsys.readouterr()
    bad = replace(config, gates=missing, record=Path("/proc"), rerun="foo", report=Path("/proc/x"))
    assert check(CheckConfig(flight=bad, json=Path("-"))) == ExitCode.NOT_FLOWN
    rows = json.loads(capsys.readouterr().out)["rows"]
    no_gos = {row["name"] for row in rows if row["verdict"] == "no-go"}
    assert no_gos == {"report", "gates", "recording", "viewer"}
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("each_ms", "rate_hz", "late", "verdict"),
    [(4, 100.0, 0, "go"), (9, 100.0, 0, "warn"), (20, 50.0, 49, "warn")],
)
def test_a_pace_that_is_not_held_is_a_warning(
    each_ms: int, rate_hz: float, late: int, verdict: str
) -> None:
    clock = FakeClock()
    pace = Pace(name="chunks", asked_hz=100.0)
    pace.run(
        threading.Event(),
        call=lambda: clock.advance_ns(each_ms * NS_PER_MS),
        clock=clock,
        duration_s=1.0,
        settle=lambda: None,
    )
    assert pace.rate_hz == pytest.approx(rate_hz)
    assert (pace.late, pace.row().verdict) == (late, verdict)


@pytest.mark.parametrize(
    ("good", "chunk", "verdict", "told"),
    [
        pytest.param(7, "raise NoChunkError('warming up')", "no-go", "warming up", id="later"),
        pytest.param(0, "raise NoChunkError('it is dark')", "warn", "it is dark", id="never"),
        pytest.param(7, "return chunk * np.nan", "no-go", "NaN", id="NaN"),
        pytest.param(7, "return chunk[:, :2]", "no-go", "[1, 2, 4]", id="shape"),
        pytest.param(
            7, "return chunk if self.calls % 3 else chunk * np.nan", "warn", "NaN", id="some"
        ),
    ],
)
def test_a_policy_without_usable_chunks_is_no_go(
    good: int, chunk: str, verdict: str, told: str, tmp_path: Path
) -> None:
    (file := tmp_path / "later.py").write_text(f"""\
import numpy as np
from policy.contract import Contract
from policy.errors import NoChunkError
class Later:
    contract, calls = Contract(arrays="numpy", image_height=32, image_width=32), 0
    def predict(self, image, state, action_history, num_diffusion_steps):
        self.calls += 1
        chunk = np.zeros((1, 16, 4), np.float32)
        if self.calls <= {good}:
            return chunk
        {chunk}
""")
    rows, _ = check_policy(flight(f"{file}:Later"), MonotonicClock(), timing_s=0.5)
    row = next(row for row in rows if row.name == "chunks")
    assert row.verdict == verdict
    assert told in row.advice


def test_a_policy_that_skips_the_dummy_image_is_not_measured(tmp_path: Path) -> None:
    (file := tmp_path / "skips.py").write_text("""\
from policy.contract import Contract
from policy.errors import NoChunkError
class Skips:
    contract = Contract(arrays="numpy", feature_dim=8, image_height=32, image_width=32)
    def encode_visual(self, image):
        raise NoChunkError("no contrast")
    def predict_fast(self, feature, state, action_history, num_diffusion_steps):
        raise AssertionError
""")
    rows, _ = check_policy(flight(f"{file}:Skips"), MonotonicClock(), timing_s=0.5)
    (row,) = (row for row in rows if row.name == "speed")
    assert (row.verdict, row.advice) == ("warn", "it skips the dummy image: no contrast")


@pytest.mark.parametrize("width", [80, 160])
def test_the_table_fits_its_terminal_and_ends_with_what_to_do(width: int) -> None:
    out = io.StringIO()
    rows = [GO, replace(GO, area="vehicle"), REFUSED]
    print_check(rows, Console(file=out, width=width, force_terminal=True, color_system=None))
    assert "Message rates were requested" in out.getvalue()
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert "NO-GO" in lines[-2]
    assert lines[-1].endswith("--set RC_OVERRIDE_TIME=0.5")


def test_a_row_hides_the_password_of_an_address_in_table_and_json() -> None:
    text = "rtsp://me:it@host/1?token=abc"
    row = CheckRow(area="camera", name="camera", found=text, expected=text, warn=text)
    assert "it@" not in json.dumps(as_document([row]))
    assert row.found == "rtsp://me:***@host/1?token=***"


def test_a_policy_tells_its_engine_speed_and_contract_and_which_flag_contradicts_it() -> None:
    config = flight("scripted:square:velocity")
    rows, plan = check_policy(config, MonotonicClock(), timing_s=0.5)
    assert [row.name for row in rows] == ["engine", "chunks", "images", "contract", "plan"]
    rows, plan = check_policy(replace(config, mode="ALT_HOLD"), MonotonicClock(), timing_s=0.5)
    assert (rows[-1].name, rows[-1].verdict) == ("flags of the flight", "no-go")
    assert "--mode ALT_HOLD" in rows[-1].advice
    assert plan.guard.meaning.kind == "velocity"
