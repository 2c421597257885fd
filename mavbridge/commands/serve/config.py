"""Settings of ``mavbridge serve``."""

from dataclasses import dataclass, field

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ServeConfig:
    """One policy, and where it is served."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    host: str = "127.0.0.1"
    """Address to listen at; by default this computer's own clients only. 0.0.0.0 is every network
    that it is in: set MAVBRIDGE_API_KEY then, on both sides."""
    port: int = 8000
    """Port to listen at."""

    def __post_init__(self) -> None:
        """Refuse what cannot be served."""
        object.__setattr__(self, "host", self.host.removeprefix("[").removesuffix("]"))
        check_range("port", self.port, 1, 65535, "")
        if self.policy.dual_rate:
            raise UserError("each request is answered from its own image: leave out --dual-rate")
