"""``mavbridge check`` against both firmwares of the simulated vehicle, on virtual time."""

import math
from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_world import LinkedVehicle
from mavbridge.commands.check.rows import CheckRow, overall
from mavbridge.commands.check.vehicle import check_vehicle
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.flight.plan import plan_flight
from mavbridge.mavlink.codec.messages import Body
from mavbridge.mavlink.codec.readers import READERS, UnusableError
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.simulation.world import NOMINAL_VEHICLE
from policy.contract import ActionKind, Contract
from sitl.vehicle.config import IDLE_RECEIVER_US, MID_RECEIVER_US, AutopilotName

OVERRIDE = 70
"""RC_CHANNELS_OVERRIDE."""
SAFE = {"RC_OVERRIDE_TIME": 0.5, "RC8_OPTION": 46}


class Bench(LinkedVehicle):
    """A vehicle that stands on the ground, and the check's end of its link."""

    def __init__(
        self,
        autopilot: AutopilotName = "ardupilot",
        *,
        receiver_us: tuple[int, ...] | None = MID_RECEIVER_US,
        position: bool = True,
        params: dict[str, float] | None = None,
    ) -> None:
        ready_s = NOMINAL_VEHICLE.position_ready_s if position else math.inf
        changes = {"autopilot": autopilot, "receiver_us": receiver_us, "position_ready_s": ready_s}
        super().__init__(replace(NOMINAL_VEHICLE, **changes), params)

    def check(self, *, contract: Contract | None = None, **link: Any) -> dict[str, CheckRow]:
        """The rows by their names."""
        config = FlyConfig(link=LinkConfig(connect="udp:127.0.0.1:1", **link))
        rows = check_vehicle(
            config,
            None if contract is None else plan_flight(config, contract, is_dual=True),
            self.clock,
            transport=self.network,
        )
        return {row.name: row for row in rows}


def verdicts(rows: dict[str, CheckRow]) -> dict[str, str]:
    """The rows that are not go."""
    return {name: row.verdict for name, row in rows.items() if row.verdict != "go"}


def test_an_ardupilot_that_is_set_up_is_a_go() -> None:
    bench = Bench(params=SAFE)
    rows = bench.check(contract=Contract())

    assert "no-go" not in verdicts(rows).values(), verdicts(rows)
    assert rows["RC_OVERRIDE_TIME"].found == "0.5"
    assert rows["modes"].found == "ALT_HOLD"
    assert rows["radio receiver"].verdict == "go"
    assert rows["clocks (TIMESYNC)"].verdict == "go"
    for name in ("attitude", "velocity", "acceleration"):
        assert float(rows[name].found.split()[0]) == pytest.approx(100, abs=2)


@pytest.mark.parametrize(
    ("message", "name"), [("LOCAL_POSITION_NED", "velocity"), ("HIGHRES_IMU", "acceleration")]
)
def test_values_that_no_flight_would_use_do_not_count_as_telemetry(
    message: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(_fields: object) -> Body:
        raise UnusableError  # as of NaN

    monkeypatch.setitem(READERS, message, read)
    rows = Bench("px4").check(contract=Contract())
    assert (rows[name].found, rows[name].verdict) == ("0.0 Hz", "no-go")


@pytest.mark.parametrize("receiver_us", [MID_RECEIVER_US, None])
def test_a_px4_is_told_what_its_sticks_cannot_do(receiver_us: tuple[int, ...] | None) -> None:
    bench = Bench("px4", receiver_us=receiver_us, params={"COM_RC_IN_MODE": 1})
    rows = bench.check(contract=Contract())

    assert "no-go" not in verdicts(rows).values(), verdicts(rows)
    assert rows["modes"].found == "ALTCTL"
    assert rows["radio receiver"].found.split()[0] == ("ignored" if receiver_us else "none")
    assert "sticks are mapped" in rows["full lean"].found
    assert rows["full yaw rate"].verdict == "warn"
    assert "202 deg/s" in rows["full yaw rate"].advice


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_velocity_without_a_position_does_not_count(autopilot: AutopilotName) -> None:
    """PX4 sends one all the same, which a flight does not use."""
    row = Bench(autopilot, position=False).check(contract=Contract())["velocity"]
    assert (row.verdict, row.found) == ("no-go", "0.0 Hz")
    assert "the estimator has no position yet" in row.advice


@pytest.mark.parametrize(
    ("autopilot", "name", "value", "mended"),
    [
        ("ardupilot", "RC_OVERRIDE_TIME", -1, 0.5),
        ("px4", "COM_RC_IN_MODE", 0, 1),
        ("ardupilot", "RC7_OPTION", 13, 0),
    ],
)
def test_what_a_flight_refuses_is_a_no_go_and_its_flag_mends_it(
    autopilot: AutopilotName, name: str, value: float, mended: float
) -> None:
    params, flag = (SAFE if autopilot == "ardupilot" else {}) | {name: value}, f"{name}={mended}"
    bench = Bench(autopilot, params=params)
    row = bench.check(contract=Contract())[name]
    assert (row.verdict, row.commands) == ("no-go", (f"--set {flag}",))
    rows = Bench(autopilot, params=params).check(contract=Contract(), set=(flag,))
    assert overall(list(rows.values())) != "no-go"
    if name in rows:  # a switch or channel that does no harm has no row
        assert rows[name].found == f"{value:g}; --set makes it {mended:g}"
    assert bench.vehicle.params[name] == value, "nothing was set"
    if name == "RC_OVERRIDE_TIME":
        rows = bench.check(contract=Contract(), accept_risk=("endless-override",))
        assert rows[name].verdict == "warn"


def test_a_receiver_that_is_ignored_has_a_remedy_for_each_firmware() -> None:
    bench = Bench(params=SAFE | {"FS_THR_ENABLE": 0})
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 3 * NS_PER_S)
    assert bench.vehicle.params.set("RC_OPTIONS", 33)  # its channels keep the last values
    row = bench.check(contract=Contract())["radio receiver"]
    assert (row.found, row.verdict) == ("ignored by a parameter", "warn")
    assert "RC_OPTIONS bit 0" in row.advice


@pytest.mark.parametrize("receiver_us", [IDLE_RECEIVER_US, None])
@pytest.mark.parametrize("action", ["sticks", "velocity"])
def test_only_sticks_that_end_give_the_vehicle_to_the_receiver(
    action: ActionKind, receiver_us: tuple[int, ...] | None
) -> None:
    row = Bench(receiver_us=receiver_us, params=SAFE).check(contract=Contract(action=action))[
        "radio receiver"
    ]
    assert row.verdict == "warn"
    assert ("RC_OVERRIDE_TIME" in row.advice) == (action == "sticks")
    assert ("put the throttle in the middle" in row.advice) == (receiver_us is not None)


def test_an_armed_vehicle_is_a_warning() -> None:
    bench = Bench(params=SAFE)
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 3 * NS_PER_S)
    assert bench.vehicle.ap.arm(force=True)  # whatever its own checks say
    assert bench.check()["state"].verdict == "warn"


def test_a_vehicle_that_answers_nothing_is_one_no_go() -> None:
    rows = Bench(params={"MAV_OPTIONS": 1, "MAV_GCS_SYSID": 42}).check()
    assert [name for name, verdict in verdicts(rows).items() if verdict == "no-go"] == ["vehicle"]
    assert "MAV_OPTIONS bit 0" in rows["vehicle"].advice


def test_nothing_is_sent_but_requests() -> None:
    bench = Bench(params=SAFE)
    bench.check(contract=Contract())
    sent = bench.up.sent
    messages = {data[7] | data[8] << 8 for _, data in sent}
    assert not messages & {69, OVERRIDE, 82, 84, 23, 253}, "nothing that moves, sets or announces"
    commands = [int.from_bytes(data[38:40], "little") for _, data in sent if data[7] == 76]
    assert set(commands) <= {511, 512}, "message rates and the version alone"


def test_a_vehicle_that_is_absent_is_one_clear_no_go() -> None:
    bench = Bench()
    bench.down.is_silent = True
    began_ns = bench.clock.now_ns()
    rows = bench.check(connect_timeout=3.0)
    assert list(rows) == ["vehicle"]
    assert rows["vehicle"].verdict == "no-go"
    assert "heard nothing" in rows["vehicle"].advice
    assert bench.clock.now_ns() - began_ns < 4 * NS_PER_S


def test_a_vehicle_that_falls_silent_while_it_is_measured_is_a_no_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench, restart = Bench(), MavlinkLink.restart_counters

    def mute() -> None:
        bench.down.is_silent = True

    def begin(link: MavlinkLink) -> None:
        restart(link)
        bench.clock.schedule(bench.clock.now_ns() + NS_PER_S, mute)

    monkeypatch.setattr(MavlinkLink, "restart_counters", begin)
    row = bench.check()["vehicle"]
    assert row.verdict == "no-go"
    assert "the vehicle's heartbeat is lost" in row.advice


def test_no_policy_leaves_out_what_only_a_policy_knows() -> None:
    rows = Bench(params=SAFE).check()
    assert overall(list(rows.values())) != "no-go"
    assert "modes" not in rows
    assert "full lean" not in rows


def test_an_output_that_the_firmware_has_not_is_a_no_go() -> None:
    rows = Bench().check(contract=Contract(), output="manual-control")
    assert rows["vehicle"].verdict == "no-go"
    assert "rc-override" in rows["vehicle"].advice
