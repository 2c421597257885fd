"""Detects the loss of the pilot's sticks or of the ground station; the autopilot acts on it."""

from sitl.ardupilot.params import ArduPilotParams
from sitl.clock import NS_PER_S

LOW_READS_TO_FAIL = 3
GCS_CHECK_PERIOD_NS = NS_PER_S // 3  # ArduCopter looks at the ground station in its 3 Hz loop


class RadioFailsafe:
    """No sticks for RC_FS_TIMEOUT, or a throttle below FS_THR_VALUE."""

    def __init__(self, params: ArduPilotParams, now_ns: int) -> None:
        self._params = params
        self._last_input_ns = now_ns
        self._low_reads = 0
        self.active = False

    def update(self, *, new_input: bool, throttle_us: int, can_fail: bool, now_ns: int) -> bool:
        """Check after one RC update; True if ``active`` has changed."""
        was_active = self.active
        if not self._params["FS_THR_ENABLE"]:
            self._last_input_ns, self._low_reads, self.active = now_ns, 0, False
        elif new_input:
            self._last_input_ns = now_ns
            self._check_throttle(throttle_us, can_fail=can_fail)
        elif can_fail:
            timeout_ns = int(max(0.1, self._params["RC_FS_TIMEOUT"]) * NS_PER_S)
            self.active = self.active or now_ns - self._last_input_ns >= timeout_ns
        return self.active != was_active

    def _check_throttle(self, throttle_us: int, *, can_fail: bool) -> None:
        if throttle_us < self._params["FS_THR_VALUE"]:
            self._low_reads = min(LOW_READS_TO_FAIL, self._low_reads + can_fail)
            self.active = self.active or self._low_reads == LOW_READS_TO_FAIL
        else:
            self._low_reads = max(0, self._low_reads - 1)
            self.active = self.active and self._low_reads > 0


class GcsFailsafe:
    """No heartbeat and no override of the ground station for FS_GCS_TIMEOUT."""

    def __init__(self, params: ArduPilotParams) -> None:
        self._params = params
        self._last_contact_ns: int | None = None
        self._due_ns = 0
        self.active = False

    def on_contact(self, now_ns: int) -> None:
        """Record a heartbeat, override or manual control of the ground station."""
        self._last_contact_ns = now_ns

    def update(self, now_ns: int) -> bool:
        """Check the timer where it is due; True if ``active`` has changed.

        Switched off while it is active it stays so, and arming is refused until the next boot or
        until it is switched on again and hears the ground station.
        """
        if now_ns < self._due_ns or not self._params["FS_GCS_ENABLE"]:
            return False
        self._due_ns = now_ns + GCS_CHECK_PERIOD_NS
        was_active = self.active
        self.active = (
            self._last_contact_ns is not None
            and now_ns - self._last_contact_ns > self._params["FS_GCS_TIMEOUT"] * NS_PER_S
        )
        return self.active != was_active
