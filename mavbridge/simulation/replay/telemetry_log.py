"""A vehicle in the telemetry log of any ground station: its packets, and its pilot's sticks."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import StickGains, Sticks
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.frames import RawPacket
from mavbridge.mavlink.codec.messages import (
    Body,
    Endpoint,
    Heartbeat,
    ManualControl,
    ParamValue,
    RcChannels,
)
from mavbridge.mavlink.codec.packets import Codec, manual_control_sticks
from mavbridge.mavlink.codec.tlog import Skipped, read_tlog
from mavbridge.mavlink.profiles.ardupilot_params import calibration
from mavbridge.mavlink.profiles.choice import profile_of
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.session.streams import message_id

_ATTITUDES = (message_id("ATTITUDE"), message_id("ATTITUDE_QUATERNION"))
_ABOUT = (message_id("HEARTBEAT"), message_id("PARAM_VALUE"))
_DEFAULTS: Mapping[str, float] = {
    "RCMAP_ROLL": 1,
    "RCMAP_PITCH": 2,
    "RCMAP_THROTTLE": 3,
    "RCMAP_YAW": 4,
    **{f"RC{number}_MIN": 1100 for number in range(1, 5)},
    **{f"RC{number}_TRIM": 1500 for number in range(1, 5)},
    **{f"RC{number}_MAX": 1900 for number in range(1, 5)},
    **{f"RC{number}_REVERSED": 0 for number in range(1, 5)},
}
"""Radio of an ArduPilot as it is delivered."""
_DEFAULT_NOTE = (
    "the log lacks the radio's calibration (RCMAP_*, RCn_*): RC_CHANNELS is read by ArduPilot's "
    "defaults, channels 1 to 4 as roll, pitch, throttle, yaw in 1100 to 1900 us"
)


@dataclass(frozen=True, kw_only=True)
class TelemetryLog:
    """The vehicle of a log."""

    path: Path
    source: Endpoint
    """The one with the most attitudes."""
    start_us: int
    """Unix time of the first packet of the log, whoever sent it."""
    end_us: int
    profile: Profile | None
    """None: no heartbeat, or a firmware that is not known."""
    params: Mapping[str, float]
    """As far as the log holds them, which it does where the ground station has loaded them."""
    damage: str | None
    """What of the log was skipped, for the user."""

    @property
    def seconds(self) -> float:
        """Length of the log."""
        return (self.end_us - self.start_us) * 1000 / NS_PER_S

    def packets(self) -> Iterator[tuple[int, RawPacket]]:
        """Packets of the vehicle and their time in ns since the log began, which never falls."""
        latest_ns = 0
        for stamp_us, packet in read_tlog(self.path):
            latest_ns = max(latest_ns, (stamp_us - self.start_us) * 1000)
            if packet.source == self.source:
                yield latest_ns, packet


def open_log(path: Path) -> TelemetryLog:
    """Look through a log for its vehicle.

    Raises:
        UserError: it cannot be read, or nobody in it tells an attitude.
    """
    codec = Codec(source_system=0, source_component=0)
    attitudes: Counter[Endpoint] = Counter()
    autopilots: dict[Endpoint, int] = {}
    params: dict[Endpoint, dict[str, float]] = {}
    first_us: int | None = None
    end_us = 0
    skipped = Skipped()
    for stamp_us, packet in read_tlog(path, skipped):
        first_us = stamp_us if first_us is None else first_us
        end_us = max(end_us, stamp_us)
        attitudes[packet.source] += packet.message_id in _ATTITUDES
        for body in _bodies(codec, packet) if packet.message_id in _ABOUT else ():
            if isinstance(body, Heartbeat):
                autopilots[packet.source] = body.autopilot
            elif isinstance(body, ParamValue):
                params.setdefault(packet.source, {})[body.name] = body.value
    if first_us is None:
        raise UserError(
            f"{path} is no telemetry log (8 bytes of Unix time before each MAVLink packet), nor a "
            "flight folder or LeRobot dataset"
        )
    source, count = attitudes.most_common(1)[0]
    if not count:
        raise UserError(
            f"{path} holds no ATTITUDE or ATTITUDE_QUATERNION of any vehicle, so that there is no "
            "state to give a policy: let the ground station ask for them when it records"
        )
    return TelemetryLog(
        path=path,
        source=source,
        start_us=first_us,
        end_us=end_us,
        profile=profile_of(autopilots.get(source, -1)),
        params=params.get(source, {}),
        damage=skipped.describe(path),
    )


def _bodies(codec: Codec, packet: RawPacket) -> Iterator[Body]:
    for message in codec.decode_datagram(packet.data):
        if message.body is not None:
            yield message.body


class PilotSticks:
    """The pilot's sticks in the policy's terms, as ``mavbridge record`` has them.

    By MANUAL_CONTROL where the vehicle shows it (PX4), else by RC_CHANNELS and the calibration in
    the log's parameters, else by the calibration that ArduPilot is delivered with. What the vehicle
    makes of a stick (RC curves, leans, rates) is taken into account as far as the log's parameters
    tell it; the last of them count for all of the log.
    """

    def __init__(self, log: TelemetryLog, gains: StickGains | None) -> None:
        self._log = log
        self._gains = gains
        self._codec = Codec(source_system=0, source_component=0)
        self._calibration, self._is_own = _calibration(log)
        self.note: str | None = None
        """What had to be assumed for the sticks so far."""
        self._mode = ""
        self._curves = log.profile and log.profile.stick_curves(log.params, self._mode, gains)
        self._has_manual_control = False

    def receive(self, packet: RawPacket) -> Sticks | None:
        """Take a packet of the vehicle; the sticks that it tells, if it does."""
        sticks: Sticks | None = None
        for body in _bodies(self._codec, packet):
            if isinstance(body, Heartbeat):
                self._receive_mode(body)
            elif isinstance(body, ManualControl):
                self._has_manual_control, self.note = True, None
                sticks = manual_control_sticks(body)
            elif isinstance(body, RcChannels) and not self._has_manual_control:
                self.note = None if self._is_own else _DEFAULT_NOTE
                pwm_us = self._calibration.stick_channels_us(body.channels_us)
                sticks = self._calibration.to_sticks(pwm_us) if pwm_us and all(pwm_us) else None
        return sticks if sticks is None or not self._curves else self._curves.to_policy(sticks)

    def _receive_mode(self, heartbeat: Heartbeat) -> None:
        if (profile := self._log.profile) is None:
            return
        if (mode := profile.modes.name(heartbeat.custom_mode)) != self._mode:
            self._mode = mode
            self._curves = profile.stick_curves(self._log.params, mode, self._gains)


def _calibration(log: TelemetryLog) -> tuple[RcCalibration, bool]:
    """The vehicle's own and True, or the default one and False."""
    try:
        ours = None if log.profile is None else log.profile.calibration(log.params)
    except ValueError:
        ours = None
    return (calibration(_DEFAULTS), False) if ours is None else (ours, True)
