"""``python -m faults``: fly the catalogue and write its page."""

import argparse
import os
import platform
import signal
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from faults.processes import StageError
from faults.run import fly_scenario
from faults.scenario import Scenario, load_catalogue
from faults.verdict import MOST_IMPACT_MPS, MOST_LOST_M, Verdict
from sitl import UsageError

TITLES = {
    "link": "Link",
    "vehicle": "Vehicle and pilot",
    "host": "Process and computer",
    "images": "Images",
    "policy": "Policy",
}
HEAD = """# Faults

Each row is a flight in real time by real processes: guard, flight process, sockets and the bundled
flight controller, which is judged by its own record. The policy leans, climbs and turns when the
fault begins. "Safe" means neutral sticks, the receiver's, or out of the mode of the flight. Limits
are in brackets: a fault that can be known only after a while has that while in its limit. The
vehicle flies on for ten seconds after the end: unless it lands, it loses {lost:.0f} m of height at
most from where the policy lost the sticks, and it touches the ground at {impact:.0f} m/s at most.
After a takeover this is up to the pilot, and not judged.
`make faults FAULTS=NAME` flies a row again, and writes no page.

Written by `make faults` on {date}: {machine}.
"""
COLUMNS = (
    "| fault | vehicle | must | safe, ms | last stick, ms | then "
    "| 10 s later | height lost, m | touchdown, m/s | exit |\n" + "|---" * 10 + "|\n"
)
SHOWN_STALL_MS = 10.0
MUST = {
    "loses": "lose the sticks",
    "keeps": "fly on",
    "either": "fly on, or lose the sticks",
    "refused": "not fly",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Fly the catalogue. Exit status 0: all passed, 1: failures, 2: a usage error."""
    parser = argparse.ArgumentParser(prog="python -m faults", description=__doc__)
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="scenarios or groups (default: all)")
    add("--jobs", type=int, default=1, metavar="N", help="flights at once (default: 1)")
    add("--out", type=Path, metavar="FILE", help="write the page of results, in Markdown")
    args = parser.parse_args(argv)
    # An exit by this signal also ends the processes of the current flight.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    # A shell starts programs in the background without Ctrl-C, and the bridge would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return _fly_catalogue(args)
    except (UsageError, StageError) as error:
        print(f"faults: error: {error}", file=sys.stderr)
        return 2


def _fly_catalogue(args: argparse.Namespace) -> int:
    catalogue = load_catalogue()
    known = set(catalogue) | {scenario.group for scenario in catalogue.values()}
    if unknown := sorted(set(args.names) - known):
        raise UsageError(f"no fault {', '.join(unknown)}; there are {', '.join(catalogue)}")
    flights = [
        (scenario, variant)
        for scenario in catalogue.values()
        if not args.names or {scenario.name, scenario.group} & set(args.names)
        for variant in scenario.variants
    ]
    verdicts: list[Verdict] = []
    with ProcessPoolExecutor(args.jobs) as pool:
        futures = [pool.submit(_fly, scenario.name, variant) for scenario, variant in flights]
        for future in futures:
            verdicts.append(verdict := future.result())
            print(make_line(verdict), flush=True)
            if not verdict.passed:
                print(verdict.output, flush=True)
    failed = sum(not verdict.passed for verdict in verdicts)
    if args.out is not None:
        date = datetime.now(UTC).date().isoformat()
        args.out.write_text(make_page(verdicts, catalogue, date=date, machine=_machine()))
    print(f"{len(verdicts)} flights, {failed} failed")
    return 1 if failed else 0


def _fly(name: str, variant) -> Verdict:
    return fly_scenario(load_catalogue()[name], variant)


def _machine() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    user = "root" if os.geteuid() == 0 else "an ordinary user"
    return f"{os.cpu_count()} cores ({(models or [platform.machine()])[0]}), as {user}"


def make_page(
    verdicts: Sequence[Verdict], catalogue: Mapping[str, Scenario], *, date: str, machine: str
) -> str:
    """Return the page in Markdown: one row per run."""
    limits = {"lost": MOST_LOST_M, "impact": MOST_IMPACT_MPS}
    parts = [HEAD.format(date=date, machine=machine, **limits)]
    for group, title in TITLES.items():
        rows = [verdict for verdict in verdicts if catalogue[verdict.scenario].group == group]
        if rows:
            lines = [_row(verdict, catalogue[verdict.scenario]) for verdict in rows]
            parts.append(f"\n## {title}\n\n{COLUMNS}" + "".join(f"{line}\n" for line in lines))
    failed = sum(not verdict.passed for verdict in verdicts)
    parts.append(f"\n{len(verdicts)} flights, {failed} failed.\n")
    return "".join(parts)


def make_line(verdict: Verdict) -> str:
    """Return a line for the terminal."""
    measured = verdict.aftermath
    parts = [f"{verdict.scenario:24s}", f"{verdict.variant.text:24s}"]
    if measured is not None:
        parts += [f"safe {measured.safe_ms:7.1f} ms", f"last stick {verdict.last_stick_ms:7.1f} ms"]
        parts.append(f"{measured.mode or '-'}, {measured.most_lean_deg:.0f} deg")
    if (end := verdict.ending) is not None:
        parts.append(f"then {end.mode}, -{end.lost_m:.1f} m, touchdown {end.impact_mps:.1f} m/s")
    parts.append(f"exit {verdict.exit}")
    if not verdict.passed and verdict.stall_ms > SHOWN_STALL_MS:
        parts.append(f"the computer stood still for {verdict.stall_ms:.0f} ms")
    if verdict.runs > 1:
        parts.append(f"run {verdict.runs}")
    parts.append("ok" if verdict.passed else "FAILED: " + "; ".join(verdict.failures))
    return "  ".join(parts)


def _row(verdict: Verdict, scenario: Scenario) -> str:
    measured, last_ms = verdict.aftermath, verdict.last_stick_ms
    safe = last = then = later = lost = impact = ""
    if measured is not None and last_ms is not None:
        safe = f"{measured.safe_ms:.0f} ({scenario.limit_ms:.0f})"
        last = f"{last_ms:.0f} ({scenario.last_stick_limit_ms:.0f})"
        then = measured.mode or "same mode"
    if (end := verdict.ending) is not None:
        later, lost = end.mode, f"{end.lost_m:.1f}"
        impact = f"{end.impact_mps:.1f}" if end.impact_mps else "none"
    must = MUST[scenario.outcome]
    if not verdict.passed:
        must = f"**{must}: {'; '.join(verdict.failures)}**"
    how = (safe, last, then, later, lost, impact)
    cells = (scenario.what, verdict.variant.text, must, *how, str(verdict.exit))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
