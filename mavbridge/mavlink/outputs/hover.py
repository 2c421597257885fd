"""The collective thrust at which a vehicle hovers, from what it does before we fly it."""

from mavbridge.core.clock import NS_PER_MS, NS_PER_S

GRAVITY_MPS2 = 9.80665
_TAU_S = 0.5
_ENOUGH_NS = NS_PER_S
_GAP_NS = 200 * NS_PER_MS
_CALM_MPS2 = (7.0, 13.0)
"""Specific force along the body's up axis in calm flight."""
PLAUSIBLE_THRUST = (0.05, 0.9)
"""Thrust at which a multirotor may hover."""


class HoverThrust:
    """Thrust that the vehicle asks of itself, by the specific force that comes of it.

    So it may climb or sink meanwhile. Parameters tell it too (MOT_THST_HOVER, MPC_THR_HOVER) but
    less well: ArduPilot's SITL hovers at 0.364 with 0.39 in the parameter, which is a climb of
    0.9 m/s after a second.
    """

    def __init__(self) -> None:
        self.value: float | None = None
        """None before a second of calm flight."""
        self._thrust = self._force_mps2 = 0.0
        self._since_ns = self._last_ns = 0
        self._force: tuple[int, float] | None = None

    def receive_force(self, up_mps2: float, now_ns: int) -> None:
        """Take the specific force along the body's up axis."""
        self._force = (now_ns, up_mps2)

    def receive_thrust(self, thrust: float, now_ns: int) -> None:
        """Take the thrust that the vehicle's own controller asks for, in the air, nearly level."""
        if self._force is None or now_ns - self._force[0] > _GAP_NS:
            return
        force_mps2 = self._force[1]
        if now_ns - self._last_ns > _GAP_NS:
            self._since_ns, self._thrust, self._force_mps2 = now_ns, thrust, force_mps2
        weight = min((now_ns - self._last_ns) / NS_PER_S / _TAU_S, 1.0)
        self._thrust += weight * (thrust - self._thrust)
        self._force_mps2 += weight * (force_mps2 - self._force_mps2)
        self._last_ns = now_ns
        is_calm = _CALM_MPS2[0] < self._force_mps2 < _CALM_MPS2[1]
        hover = self._thrust * GRAVITY_MPS2 / self._force_mps2 if is_calm else 0.0
        is_plausible = PLAUSIBLE_THRUST[0] < hover < PLAUSIBLE_THRUST[1]
        if is_plausible and now_ns - self._since_ns >= _ENOUGH_NS:
            self.value = hover
