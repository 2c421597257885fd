"""``python -m sitl faults``: flies the catalogue and writes its page."""

import argparse
import os
import platform
import signal
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from sitl import UsageError
from sitl.faults.run import fly_scenario
from sitl.faults.scenario import Scenario, Variant, load_catalogue
from sitl.faults.soak import make_summary, soak
from sitl.faults.stage.processes import StageError
from sitl.faults.table import make_line, make_page
from sitl.faults.verdict import Verdict


def add_faults_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its flags."""
    faults_help = "fly a catalogue of faults against mavbridge, and judge them"
    parser = commands.add_parser("faults", help=faults_help, allow_abbrev=False)
    parser.set_defaults(run=_fly_catalogue)
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="scenarios or groups (default: all)")
    add("--list", action="store_true", help="print the catalogue")
    add("--autopilot", choices=("ardupilot", "px4"), help="only with this firmware")
    add("--receiver", choices=("idle", "mid", "none"), help="only with this receiver")
    add("--jobs", type=int, default=1, metavar="N", help="flights at once (default: 1)")
    add("--out", type=Path, metavar="FILE", help="write the page of results, in Markdown")


def add_soak_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its flags."""
    soak_help = "fly for a long time with a random fault every few seconds, and look for leaks"
    parser = commands.add_parser("soak", help=soak_help, allow_abbrev=False)
    parser.set_defaults(run=_soak)
    parser.add_argument("--minutes", type=float, default=60.0, metavar="N", help="default: 60")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the faults' order")


def _soak(args: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        try:
            result = soak(args.minutes, args.seed, Path(folder), print)
        except StageError as error:
            raise UsageError(f"the soak could not go on: {error}") from error
    print(make_summary(result))
    if result.failures:
        raise UsageError("the soak has failed")


def _fly_catalogue(args: argparse.Namespace) -> None:
    catalogue = load_catalogue()
    chosen = _choose(catalogue, args.names)
    if args.list:
        for scenario in chosen:
            print(f"{scenario.group:8s} {scenario.name:24s} {scenario.what}")
        return
    # An exit by this signal ends the processes of the present flight too.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    flights = [
        (scenario, variant)
        for scenario in chosen
        for variant in scenario.variants
        if _is_wanted(variant, args.autopilot, args.receiver)
    ]
    verdicts: list[Verdict] = []
    with ProcessPoolExecutor(args.jobs) as pool:
        for verdict in pool.map(fly_scenario, *zip(*flights, strict=True)):
            verdicts.append(verdict)
            print(make_line(verdict), flush=True)
            if not verdict.passed:
                print(verdict.output, flush=True)
    failed = sum(not verdict.passed for verdict in verdicts)
    if args.out is not None:
        date = datetime.now(UTC).date().isoformat()
        args.out.write_text(make_page(verdicts, catalogue, date=date, machine=_machine()))
    print(f"{len(verdicts)} flights, {failed} failed")
    if failed:
        raise UsageError(f"{failed} of {len(verdicts)} flights were not as they must be")


def _choose(catalogue: dict[str, Scenario], names: list[str]) -> list[Scenario]:
    known = set(catalogue) | {scenario.group for scenario in catalogue.values()}
    if unknown := [name for name in names if name not in known]:
        raise UsageError(
            f"no fault {', '.join(unknown)}; `python -m sitl faults --list` names them"
        )
    return [
        scenario
        for scenario in catalogue.values()
        if not names or scenario.name in names or scenario.group in names
    ]


def _is_wanted(variant: Variant, autopilot: str | None, receiver: str | None) -> bool:
    return autopilot in (None, variant.autopilot) and receiver in (None, variant.receiver)


def _machine() -> str:
    model = platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    realtime = "root" if os.geteuid() == 0 else "an ordinary user"
    return f"{os.cpu_count()} cores ({model}), as {realtime}"
