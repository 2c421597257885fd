"""The real-time loop on a fake clock, the camera thread, and the command line."""

import json
import os
import signal
import socket
import subprocess
import sys
from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.__main__ import main
from sitl.app import fly
from sitl.clock import NS_PER_MS, NS_PER_S, StopRequest, stop_on_signal
from sitl.course import LOOP_SEEDS, make_course
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS


class FakeClock:
    """Time that passes only by sleeping, with one stall to order."""

    def __init__(self, stall_at_ns=None, stall_ns=0):
        self.time_ns = 0
        self.sleeps_ns = []
        self._stall_at_ns, self._stall_ns = stall_at_ns, stall_ns

    def now_ns(self):
        return self.time_ns

    def sleep_until_ns(self, deadline_ns):
        self.sleeps_ns.append(deadline_ns)
        self.time_ns = max(self.time_ns, deadline_ns)
        if self._stall_at_ns is not None and self.time_ns >= self._stall_at_ns:
            self.time_ns += self._stall_ns
            self._stall_at_ns = None


class FakeTransport:
    """Receives nothing and notes what is sent."""

    def __init__(self, clock):
        self._clock = clock
        self.sent = []

    def drain(self):
        return ()

    def send(self, data):
        if data:
            self.sent.append((self._clock.now_ns(), data))


def test_the_loop_keeps_an_absolute_grid_and_flies_in_real_time():
    clock = FakeClock()
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    fly(vehicle, [FakeTransport(clock)], clock, StopRequest(), end_ns=NS_PER_S)
    assert clock.sleeps_ns == [STEP_NS * n for n in range(1, 401)]
    assert vehicle.ap.now_ns == NS_PER_S - STEP_NS


def test_after_a_stall_it_catches_up_without_a_burst():
    clock = FakeClock(stall_at_ns=NS_PER_S, stall_ns=300 * NS_PER_MS + 1)
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    vehicle.server.links[0].set_interval(mav.MAVLINK_MSG_ID_ATTITUDE, 10_000)
    transport = FakeTransport(clock)
    fly(vehicle, [transport], clock, StopRequest(), end_ns=2 * NS_PER_S)
    sent_ns = [stamp_ns for stamp_ns, _ in transport.sent]
    after_ns = [stamp_ns for stamp_ns in sent_ns if stamp_ns > NS_PER_S]
    assert min(b - a for a, b in pairwise(sent_ns)) >= STEP_NS
    assert after_ns[0] == pytest.approx(1.3 * NS_PER_S, abs=10)
    assert after_ns[1] - after_ns[0] <= 10 * NS_PER_MS
    assert vehicle.ap.now_ns == 2 * NS_PER_S - STEP_NS


def test_a_terminated_process_flies_on_and_writes_the_report(tmp_path):
    path = tmp_path / "fc.json"
    flags = ["--connect", "udpout:127.0.0.1:9", "--fly-on", "0.5", "--report", str(path)]
    command = [sys.executable, "-m", "sitl", *flags]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr.readline().startswith("sitl: ready")
        process.terminate()
        process.communicate(timeout=60.0)
    assert process.returncode == 0
    report = json.loads(path.read_text())
    assert report["final"]["mode"] == "STABILIZE"
    assert report["duration_s"] >= 0.49


def test_a_second_signal_ends_the_flight_on_and_the_report_is_written(monkeypatch, tmp_path):
    path, signals = tmp_path / "fc.json", []

    def interrupt(*_, **__):
        signals.append(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("sitl.app.fly", interrupt)
    monkeypatch.setattr("sitl.app._Status.print_changes", interrupt)  # once a step of the fly-on
    monkeypatch.setattr("sitl.app.os.nice", lambda _: 0)
    flags = ["--connect", "udpout:127.0.0.1:9", "--fly-on", "1"]
    assert main([*flags, "--report", str(path)]) == 0
    assert len(signals) == 2
    assert path.exists()


def test_a_camera_that_fails_ends_the_flight_with_its_error(monkeypatch):
    def fail(*_):
        raise OSError("the lens is broken")

    monkeypatch.setattr("sitl.app.FramePublisher.publish", fail)
    flags = ["--camera", f"shm:mb-test-app-{os.getpid()}", "--duration", "20"]
    with pytest.raises(OSError, match="the lens is broken"):
        main(["--connect", "udpout:127.0.0.1:9", *flags])


def test_the_camera_of_another_vehicle_films_each_lap(monkeypatch):
    filmed = []
    monkeypatch.setattr("sitl.app.film_vehicle", lambda *arguments: filmed.append(arguments[1]))
    flags = ["--follow", "udp:127.0.0.1:9", "--camera", "shm:x", "--course", str(LOOP_SEEDS)]
    assert main(["camera", *flags, "--laps", "2"]) == 0
    assert filmed == [make_course(LOOP_SEEDS, laps=2)]


def test_ctrl_c_does_not_stop_a_vehicle_that_a_shell_started_in_the_background():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stop_on_signal() as stop:
            signal.raise_signal(signal.SIGINT)
            assert not stop.is_set()
            signal.raise_signal(signal.SIGTERM)
            assert stop.is_set()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    "argv",
    [
        ["--bogus"],
        ["--connect"],
        ["--connect", "udpout:127.0.0.1:9", "--duration", "-1"],
        ["--connect", "udpout:127.0.0.1:9", "--fps", "nan"],
        ["--connect", "udpout:127.0.0.1:9", "--fps", "1e-305"],
        ["--connect", "udpout:127.0.0.1:9", "--fps", "3e9"],
        ["--connect", "udpout:127.0.0.1:9", "--duration", "1e300"],
        ["--connect", "udpout:127.0.0.1:9", "--fly-on", "1e308"],
        ["--connect", "udpout:127.0.0.1:9", "--camera", "fpv"],
        ["--connect", "udpout:127.0.0.1:9", "--course", "x"],
        ["--connect", "udpout:127.0.0.1:9", "--rc-in", "70000"],
        ["--connect", "udpout:127.0.0.1:9", "--receiver", "broken"],
        ["--connect", "udpout:127.0.0.1:9", "--image-size", "5"],
        ["camera"],
        ["teleport"],
    ],
)
def test_bad_flags_exit_with_two(argv, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(argv)
    assert exit_info.value.code == 2
    assert "error" in capsys.readouterr().err


def test_a_flag_before_the_command_counts_as_one_after_it(capsys):
    printed = []
    for argv in (["--course", "7", "course"], ["course", "--course", "7"], ["course"]):
        assert main(argv) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] != printed[2]


def test_bad_requests_exit_with_two_and_one_line(capsys, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        requests = [
            [],
            ["--connect", "foo:1"],
            ["--connect", url],
            ["--connect", "udpout:127.0.0.1:9", "--report", str(tmp_path / "no" / "fc.json")],
            ["--connect", "udpout:127.0.0.1:9", "--report", str(tmp_path), "--duration", "0.01"],
            ["--connect", "udpout:127.0.0.1:9", "--report", "/proc/fc.json", "--duration", "0.01"],
            ["--connect", "udpout:127.0.0.1:9", "--camera", "shm:" + 300 * "x"],
            ["camera", "--follow", "udp:127.0.0.1:9"],
            ["--connect", "udpout:127.0.0.1:9", "--rc-in", url.rpartition(":")[2]],
        ]
        for argv in requests:
            assert main(argv) == 2
            error = capsys.readouterr().err
            assert error.startswith("sitl: error: ")
            assert error.count("\n") == 1


def test_a_disk_that_is_full_at_the_end_is_an_error_in_one_line(capsys):
    url = "udpout:127.0.0.1:9"
    assert main(["--connect", url, "--report", "/dev/full", "--duration", "0.01"]) == 2
    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith("sitl: error: --report /dev/full: No space left on device")
