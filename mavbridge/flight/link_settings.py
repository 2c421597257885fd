"""From the flags of a command to the settings of the link."""

from mavbridge.config.flight import LinkConfig
from mavbridge.mavlink.settings import LinkSettings


def link_settings(config: LinkConfig, *, state_hz: float) -> LinkSettings:
    """Settings of a link that asks for telemetry at ``state_hz``."""
    return LinkSettings(
        connect=config.connect,
        source_system=config.source_system,
        target_system=config.target_system,
        connect_timeout_s=config.connect_timeout,
        output=config.output,
        readonly=config.readonly,
        state_hz=state_hz,
    )
