"""A ground station shares the gate's link while a policy flies: real processes on loopback."""

import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.faults.stage.relay import COPTER_MODES
from sitl.faults.stage.stage import ORDERLY, TIMEOUT_S, Stage, faulty_policy, staged

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--policy", faulty_policy("Leaning"))


class Station:
    """A ground station that listens on a port of its own."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.02)
        self._gate: tuple[str, int] | None = None
        self._mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self._mav.robust_parsing = True

    @property
    def flag(self) -> str:
        return f"udp:127.0.0.1:{self._socket.getsockname()[1]}"

    def receive(self, seconds: float) -> Iterator[Any]:
        end = time.monotonic_ns() + round(seconds * 1e9)
        while time.monotonic_ns() < end:
            try:
                data, self._gate = self._socket.recvfrom(65536)
            except TimeoutError:
                continue
            yield from self._mav.parse_buffer(data) or ()

    def send(self, message: Any) -> None:
        assert self._gate is not None
        self._socket.sendto(message.pack(self._mav), self._gate)

    def ask(self, message: Any, is_answer: Callable[[Any], bool]) -> Any:
        """The answer; the question is put again once a second."""
        for _ in range(round(TIMEOUT_S)):
            if self._gate is not None:
                self.send(message)
            for heard in self.receive(1.0):
                if is_answer(heard):
                    return heard
        raise AssertionError(f"no answer to {message}")

    def command(self, number: int, *params: float) -> int:
        """The result in the acknowledgement."""
        padded = (*params, *[0.0] * (7 - len(params)))
        message = self._mav.command_long_encode(1, 1, number, 0, *padded)

        def is_answer(heard: Any) -> bool:
            """The gate's own commands are acknowledged to component 191."""
            is_ack = heard.get_type() == "COMMAND_ACK"
            return is_ack and (heard.command, heard.target_component) == (number, 190)

        return int(self.ask(message, is_answer).result)

    def param(self, name: str) -> float:
        message = self._mav.param_request_read_encode(1, 1, name.encode(), -1)
        answer = self.ask(message, lambda m: getattr(m, "param_id", None) == name)
        return float(answer.param_value)

    def sticks(self, *, y: int) -> None:
        self.send(self._mav.manual_control_encode(1, 0, y, 500, 0, 0))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def station() -> Iterator[Station]:
    with closing(Station()) as station:
        yield station


def end_in_order(flying: Stage) -> str:
    flying.kill_group(signal.SIGINT)
    status, output = flying.end()
    assert status in ORDERLY, output
    return output


def test_it_reads_parameters_slows_nothing_down_and_changes_the_mode(
    station: Station, tmp_path: Path
) -> None:
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY, "--forward", station.flag)
        flying.wait_for_lean()
        assert station.param("RC_OVERRIDE_TIME") == 3.0
        denied = station.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 1_000_000)
        assert denied == dialect.MAV_RESULT_DENIED
        states = [heard.get_type() for heard in station.receive(2.0)]
        for _ in range(25):
            station.sticks(y=1000)
            flying.observe(0.04)
        rolls = {row.roll for row in flying.relay.overrides[-20:]}
        loiter = station.command(dialect.MAV_CMD_DO_SET_MODE, 1, COPTER_MODES["LOITER"])
        assert loiter == dialect.MAV_RESULT_ACCEPTED
        assert flying.wait_for("LOITER")
        flying.relay.disarm()
        output = end_in_order(flying)
    assert min(rolls) > 1500
    assert "--gcs-sticks-win" in output
    assert "packets of the ground station were not passed on" in output
    assert not flying.relay.sent_since(0, "MANUAL_CONTROL")
    assert states.count("ATTITUDE_QUATERNION") > 150


def test_its_sticks_win_once_they_are_moved_and_for_good(station: Station, tmp_path: Path) -> None:
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY, "--forward", station.flag, "--gcs-sticks-win")
        flying.wait_for_lean()
        assert station.param("RC_OVERRIDE_TIME") == 3.0
        for _ in range(25):
            station.sticks(y=0)
            flying.observe(0.04)
        assert not flying.relay.sent_since(0, "MANUAL_CONTROL")
        at_ns = time.monotonic_ns()
        for _ in range(50):
            station.sticks(y=-400)
            flying.observe(0.04)
        passed = flying.relay.sent_since(at_ns, "MANUAL_CONTROL")
        ours = flying.relay.sent_since(passed[0].at_ns, "RC_CHANNELS_OVERRIDE")
        assert flying.wait_for("the ground station's sticks have taken over")
        flying.relay.disarm()
        end_in_order(flying)
    assert len(passed) > 40
    assert not [sent for sent in ours if sent.is_command]
