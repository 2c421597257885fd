"""What the two loops reach on this machine, policy by policy, beside a simulated vehicle.

Runs real flights in real processes: the vehicle in one, the bridge in another. The policies have
untrained weights, so the bridge is read-only: everything runs but the sending.
"""

import json
import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

SECONDS = 15
FLIGHT_TIMEOUT_S = 120


@dataclass(frozen=True, kw_only=True)
class Case:
    """One row of the table."""

    policy: str
    dual_rate: bool


CASES = (
    Case(policy="scripted:hover", dual_rate=True),
    Case(policy="toge:small", dual_rate=True),
    Case(policy="toge:medium", dual_rate=True),
    Case(policy="toge:small", dual_rate=False),
    Case(policy="resnet-unet", dual_rate=False),
)


def main() -> None:
    """Fly every case and print the table."""
    table = Table(title=f"{SECONDS} s a flight, both processes on this machine; ms as p50 / p99")
    for column in ("policy", "mode", "action", "vision", "predict", "encode", "feature age"):
        table.add_column(column, justify="left" if column in ("policy", "mode") else "right")
    for case in CASES:
        table.add_row(*_row(case, _fly(case)))
    Console(width=120).print(table)


def _row(case: Case, report: Any) -> tuple[str, ...]:
    action, vision = report["action"], report["vision"]
    return (
        case.policy,
        report["mode"],
        f"{action['rate_hz']:.1f} of {action['target_hz']:.0f} Hz",
        f"{vision['rate_hz']:.1f} of {vision['target_hz']:.0f} Hz",
        _pair(action["predict_ms"]),
        _pair(vision["encode_ms"]),
        _pair(report["feature_age_ms"]),
    )


def _pair(percentiles: Any) -> str:
    return "-" if percentiles is None else f"{percentiles['p50']:.1f} / {percentiles['p99']:.0f}"


def _fly(case: Case) -> Any:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shm = f"bench-{port}"
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        vehicle = subprocess.Popen(
            [
                *(sys.executable, "-m", "sitl", "--camera", f"shm:{shm}"),
                *("--connect", f"udpout:127.0.0.1:{port}"),
            ],
            stderr=subprocess.DEVNULL,
        )
        try:
            flags = ["--dual-rate"] if case.dual_rate else []
            subprocess.run(
                [
                    *(sys.executable, "-m", "mavbridge", "--camera", f"shm:{shm}"),
                    *("--connect", f"udp:127.0.0.1:{port}", "--readonly", "--allow-untrained"),
                    *("--policy", case.policy, "--duration", str(SECONDS)),
                    *("--report", str(report), "--max-feature-age", "5", *flags),
                ],
                check=True,
                capture_output=True,
                timeout=FLIGHT_TIMEOUT_S,
            )
            return json.loads(report.read_text())
        finally:
            vehicle.terminate()
            vehicle.wait(FLIGHT_TIMEOUT_S)


if __name__ == "__main__":
    main()
