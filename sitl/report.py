"""Measurement of a flight on the vehicle's side of the wire; format: docs/formats.md."""

import json
import math
from collections import deque
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, TypeAlias

from sitl.clock import NS_PER_S
from sitl.course import Course, Crash, GateCounter, GatePass, struck_gate
from sitl.vehicle.firmware import Autopilot
from sitl.vehicle.rotation import Vec3, cos_tilt

CRASH_SPEED_MPS = 3.5  # ALT_HOLD descends at up to 2.5 m/s, a hard landing but no crash
CRASH_TILT_COS = math.cos(math.radians(45.0))
MAX_TEXTS = 200
END_AFTER_NS = NS_PER_S
"""Time from the last gate to the end of the course: a crash just behind the gate counts."""
PATH_PERIOD_NS = NS_PER_S // 20
"""Path length is summed at 20 Hz: fine enough for turns, coarse enough to leave out vibration."""

MAX_STICK_ENTRIES = 20_000
STICK_PERIOD_NS = NS_PER_S // 20
"""Longest time between two entries while armed, so that the motion under held sticks shows."""

LogEntry: TypeAlias = dict[str, float | str]  # a time ``t_s`` and an event


class FlightLog:
    """Collects the measurements of one run. Times count from ``start_ns``, the first boot."""

    def __init__(self, start_ns: int, course: Course | None) -> None:
        self.refused_messages = 0
        self.texts: list[LogEntry] = []
        self.crash: Crash | None = None
        self.distance_m = 0.0
        self._start_ns = start_ns
        self._course = course or Course(seed=0, gates=())
        self._gates = GateCounter(self._course)
        self.overrides = 0  # RC_CHANNELS_OVERRIDE that drives at least one stick
        self.manual_controls = 0
        self.setpoints = 0  # accepted attitudes, rates and velocities
        self.releases = 0  # RC_CHANNELS_OVERRIDE that only releases sticks
        self._sticks = _StickRecord()
        self._arrived_ns = start_ns
        self._modes: list[LogEntry] = []
        self._armed_ns = 0
        self._last_ns = self._path_due_ns = start_ns
        self._max_altitude_m = self._speed_mps = self._impact_mps = 0.0
        self._path_point_ned_m: Vec3 | None = None
        self._was_touching = True

    @property
    def crashed(self) -> bool:
        return self.crash is not None

    @property
    def next_gate(self) -> int | None:
        """Index of the next gate to pass; None after the last gate or without a course."""
        return self._gates.next_gate

    @property
    def gates_total(self) -> int:
        return self._course.passages

    @property
    def gates_passed(self) -> tuple[GatePass, ...]:
        return tuple(self._gates.passed)

    def start_over(self, next_gate: int) -> None:
        """Restart the count at ``next_gate`` after the vehicle was placed elsewhere in the air."""
        self._gates = GateCounter(self._course, first=next_gate)
        self._path_point_ned_m = None
        self._was_touching = False
        self.crash = None

    def on_reboot(self) -> None:
        """Start a new trajectory at the origin, which the vehicle did not fly to."""
        self._gates.interrupt()
        self._path_point_ned_m = None
        self._was_touching = True

    def verdict(
        self, now_ns: int, run_out_ns: int = END_AFTER_NS
    ) -> Literal["crashed", "finished"] | None:
        """Return the end of the course: a crash, or the run-out after the last gate; None before
        that."""
        if self.crashed:
            return "crashed"
        if not self._gates.passed or self.next_gate is not None:
            return None
        over_ns = now_ns - self._start_ns - run_out_ns
        return "finished" if self._gates.passed[-1].t_s * NS_PER_S <= over_ns else None

    def on_received(self, arrived_ns: int) -> None:
        """Note the arrival of bytes.

        After a stall the vehicle acts on them in steps dated before their arrival. Stick changes of
        such steps are stamped with the arrival instead.
        """
        self._arrived_ns = max(self._arrived_ns, arrived_ns)

    def on_text(self, now_ns: int, text: str) -> None:
        if len(self.texts) < MAX_TEXTS:
            self.texts.append({"t_s": self._t_s(now_ns), "text": text})

    def on_step(self, ap: Autopilot) -> None:
        if not self._modes or self._modes[-1]["mode"] != ap.mode_name:
            self._modes.append({"t_s": self._t_s(ap.now_ns), "mode": ap.mode_name})
        self._sticks.update(ap, self._t_s(max(ap.now_ns, self._arrived_ns)))
        if ap.armed:
            self._armed_ns += ap.now_ns - self._last_ns
        self._last_ns = ap.now_ns
        body = ap.truth
        self._max_altitude_m = max(self._max_altitude_m, -body.position_ned_m[2])
        if ap.now_ns >= self._path_due_ns:
            self._path_due_ns = ap.now_ns + PATH_PERIOD_NS
            before_ned_m = self._path_point_ned_m or body.position_ned_m
            self.distance_m += math.dist(body.position_ned_m, before_ned_m)
            self._path_point_ned_m = body.position_ned_m
        self._check_gates(body.position_ned_m, ap.now_ns)
        if body.touching and not self._was_touching:
            self._impact_mps = max(self._impact_mps, self._speed_mps)
            is_tilted = cos_tilt(body.ned_from_body_wxyz) < CRASH_TILT_COS
            if is_tilted or self._speed_mps > CRASH_SPEED_MPS:
                self._on_crash("ground", ap.now_ns)
        self._was_touching = body.touching
        self._speed_mps = math.hypot(*body.velocity_ned_mps)

    def _check_gates(self, position_ned_m: Vec3, now_ns: int) -> None:
        before_ned_m = self._gates.position_ned_m
        if self.crashed:
            return
        self._gates.update(position_ned_m, self._t_s(now_ns))
        if before_ned_m is not None:
            struck = struck_gate(self._course, before_ned_m, position_ned_m)
            if struck is not None:
                self._on_crash(f"gate {struck}", now_ns)

    def _on_crash(self, hit: str, now_ns: int) -> None:
        if self.crash is None:
            self.crash = Crash(t_s=self._t_s(now_ns), hit=hit, speed_mps=self._speed_mps)

    def summary(self, ap: Autopilot) -> dict[str, Any]:
        passed = [asdict(gate) for gate in self._gates.passed]
        return {
            "start_ns": self._start_ns,
            "duration_s": self._t_s(ap.now_ns),
            "overrides": self.overrides,
            "releases": self.releases,
            "manual_control": self.manual_controls,
            "setpoints": self.setpoints,
            "refused_messages": self.refused_messages,
            "armed_s": self._armed_ns / NS_PER_S,
            "max_altitude_m": self._max_altitude_m,
            "distance_m": self.distance_m,
            "crashed": self.crashed,
            "crash": asdict(self.crash) if self.crash else None,
            "impact_speed_mps": self._impact_mps,
            "gates": {"total": self.gates_total, "passed": passed} if self._course.gates else None,
            "conditions": ap.config.conditions.numbers(),
            "modes": self._modes,
            "final": {
                "mode": ap.mode_name,
                "armed": ap.armed,
                "landed": ap.landed,
                "position_ned_m": ap.truth.position_ned_m,
            },
            "sticks": list(self._sticks.rows),
        }

    def _t_s(self, now_ns: int) -> float:
        return (now_ns - self._start_ns) / NS_PER_S


class _StickRecord:
    """Sticks that the vehicle acted on and its motion, at changes and periodically while armed."""

    def __init__(self) -> None:
        self.rows: deque[dict[str, Any]] = deque(maxlen=MAX_STICK_ENTRIES)
        self._last: tuple[Any, ...] = ()
        self._due_ns = 0

    def update(self, ap: Autopilot, t_s: float) -> None:
        """Add a row, stamped ``t_s``, if one is due after this control step."""
        state = (ap.sticks_us, ap.mode_name, ap.armed, ap.in_failsafe)
        if state == self._last and not (ap.armed and ap.now_ns >= self._due_ns):
            return
        self._last = state
        self._due_ns = ap.now_ns + STICK_PERIOD_NS
        body = ap.truth
        lean_rad = math.acos(max(-1.0, min(1.0, cos_tilt(body.ned_from_body_wxyz))))
        row = {"t_s": t_s, **dict(zip(("us", "mode", "armed", "failsafe"), state, strict=True))}
        row["lean_deg"] = round(math.degrees(lean_rad), 2)
        row["climb_mps"] = round(-body.velocity_ned_mps[2], 3)
        row["height_m"] = round(-body.position_ned_m[2], 3)
        self.rows.append(row)


def write_report(path: Path, summary: dict[str, Any]) -> None:
    """Write the report as JSON, with one line per entry of ``sticks``."""
    sticks = ",\n    ".join(json.dumps(entry) for entry in summary["sticks"])
    rest = {key: value for key, value in summary.items() if key != "sticks"}
    head = json.dumps(rest, indent=2).removesuffix("\n}")
    path.write_text(f'{head},\n  "sticks": [\n    {sticks}\n  ]\n}}\n', encoding="utf-8")
