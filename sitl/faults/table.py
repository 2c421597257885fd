"""The page of results, docs/faults.md: one row a run."""

from collections.abc import Mapping, Sequence

from sitl.faults.scenario import Scenario
from sitl.faults.verdict import MOST_IMPACT_MPS, MOST_LOST_M, Verdict

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
`python -m sitl faults NAME` flies a row again.

Written by `python -m sitl faults --out docs/faults.md` on {date}: {machine}.
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


def make_page(
    verdicts: Sequence[Verdict], catalogue: Mapping[str, Scenario], *, date: str, machine: str
) -> str:
    """Markdown of the page."""
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
    """A line for the terminal."""
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
