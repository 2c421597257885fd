"""A vehicle that has only parameters, in front of the code that reads and writes them."""

import random
from collections.abc import Callable, Iterator
from typing import Any

from helpers.wire import CALIBRATION
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import Output, VehicleStatus
from mavbridge.mavlink.codec.messages import CommandRequest, ParamRequest, ParamValue, ParamWrite
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.session.vehicle_params import VehicleParams

STEP_NS = 10 * NS_PER_MS

SAFE: dict[str, float] = {
    **CALIBRATION,
    "MAV_GCS_SYSID": 255.0,
    "RC_OVERRIDE_TIME": 1.0,
    "RC_OPTIONS": 0.0,
    "RC_FS_TIMEOUT": 1.0,
    "FS_THR_ENABLE": 1.0,
    "FS_OPTIONS": 16.0,
    "GUID_OPTIONS": 0.0,
    "ATC_ANGLE_BOOST": 1.0,
    "MOT_THST_HOVER": 0.39,
    "GUID_TIMEOUT": 3.0,
    **{f"RC{number}_OPTION": 0.0 for number in range(1, 17)},
    "SIMPLE": 0.0,
    "SUPER_SIMPLE": 0.0,
}
"""Parameters with which a flight can begin."""


def lossy(share: float, seed: int) -> Callable[[int], bool]:
    """Lose this share of the packets at random."""
    draw = random.Random(seed)
    return lambda _: draw.random() < share


def status(armed: bool, has_receiver: bool | None) -> VehicleStatus:
    return VehicleStatus(mode="ALT_HOLD", armed=armed, has_receiver=has_receiver)


class ParamVehicle:
    """Answers one step later; a request or answer for which ``loses(number)`` is True is lost.

    ``changes`` are made to ``SAFE``; None removes a parameter.
    """

    def __init__(
        self,
        changes: dict[str, float | None] | None = None,
        *,
        profile: Profile = ARDUPILOT,
        output: Output | None = "rc-override",
        loses: Callable[[int], bool] = lambda _: False,
        values: dict[str, float] | None = None,
        old_params: dict[str, float] | None = None,
        **settings: Any,
    ) -> None:
        found: dict[str, float | None] = {**SAFE, **(changes or {})}
        self.values = {k: v for k, v in found.items() if v is not None}
        if values is not None:
            self.values = values
        self.texts: list[str] = []
        self.params = VehicleParams(
            profile,
            LinkSettings(**settings),
            streams=profile.streams(state_hz=100.0),
            old_params={} if old_params is None else old_params,
            report=self.texts.append,
        )
        if output is not None:
            self.params.use_output(output)
        self.now_ns = 0
        self.armed = False
        self.has_receiver: bool | None = None
        self.requests: list[ParamRequest | ParamWrite | CommandRequest] = []
        self.integers: set[str] = set()
        """Parameters whose bytes are those of an integer in the float."""
        self.refuses: set[str] = set()
        """Parameters that keep their value when set."""
        self.rounds: set[str] = set()
        """Parameters that hold whole numbers only."""
        self._loses = loses
        self._packets = 0
        self._answers: list[ParamValue] = []

    @property
    def writes(self) -> list[tuple[str, float]]:
        return [(r.name, r.value) for r in self.requests if isinstance(r, ParamWrite)]

    def problem(self) -> Reason | None:
        report = status(self.armed, self.has_receiver)
        return self.params.changes.problem() or self.params.output_problem(report)

    def set_by_pilot(self, name: str, value: float) -> None:
        """Set a parameter as a ground station; the vehicle announces it to all."""
        self.values[name] = value
        self.params.receive(ParamValue(name, value), status(self.armed, self.has_receiver))

    def fall_silent(self) -> None:
        self.values.clear()
        self._answers.clear()

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * NS_PER_S / STEP_NS)):
            self.step()

    def step(self) -> None:
        report = status(self.armed, self.has_receiver)
        answers, self._answers = self._answers, []
        for answer in answers:
            if self._arrives():
                self.params.receive(answer, report)
        for request in self.params.step(self.now_ns, report):
            self.requests.append(request)
            if self._arrives() and not isinstance(request, CommandRequest):
                self._answers += self._answer(request)
        self.now_ns += STEP_NS

    def _arrives(self) -> bool:
        self._packets += 1
        return not self._loses(self._packets)

    def _answer(self, request: ParamRequest | ParamWrite) -> Iterator[ParamValue]:
        name = request.name
        if name not in self.values:
            return
        kind = 6 if name in self.integers else 9
        if isinstance(request, ParamWrite) and name not in self.refuses:
            if request.kind != kind:
                return
            read = ParamValue(name, request.value, kind)
            value = read.from_bytes().value
            self.values[name] = round(value) if name in self.rounds else value
        yield ParamValue(name, ParamWrite(name, self.values[name], kind).as_bytes().value, kind)
