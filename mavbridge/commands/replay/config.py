"""Settings of ``mavbridge replay``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.groups import LIMITS, OUTPUT, POLICY
from mavbridge.config.policy import Engine
from mavbridge.core.errors import UserError

ReplayFrom = Literal["auto", "chunks", "features", "video"]


@Parameter(name="*", group=OUTPUT)
@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """What is computed once more, and what is different from the flight; nothing by default."""

    source: Annotated[ReplayFrom, Parameter(name="--from", group=POLICY)] = "auto"
    """chunks: the guard alone, with the recorded chunks and without a policy; features: the policy
    from the recorded features; video: the encoder as well, from the recorded video, which is lossy.
    auto: features, where there are any and the encoder is the same."""
    policy: Annotated[str | None, Parameter(group=POLICY)] = None
    """Another policy, as --policy of a flight."""
    checkpoint: Annotated[Path | None, Parameter(group=POLICY)] = None
    """Other weights."""
    contract: Annotated[Path | None, Parameter(group=POLICY)] = None
    """Contract file of another policy."""
    num_diffusion_steps: Annotated[int | None, Parameter(group=POLICY)] = None
    """Another number of steps of the action head."""
    engine: Annotated[Engine | None, Parameter(group=POLICY)] = None
    """Another engine, such as torch."""
    device: Annotated[str | None, Parameter(group=POLICY)] = None
    """Another torch device."""
    tau: Annotated[float | None, Parameter(group=LIMITS)] = None
    """Another time constant of the low-pass, in seconds."""
    max_slew: Annotated[float | None, Parameter(group=LIMITS)] = None
    """Another limit of stick movement, in full deflections a second."""
    max_feature_age: Annotated[float | None, Parameter(group=LIMITS)] = None
    """Another age of the oldest image to act on, in seconds."""
    max_chunk_age: Annotated[float | None, Parameter(group=LIMITS)] = None
    """Another time for which one chunk may be flown, in seconds."""
    tolerance: float | None = None
    """Largest difference of a stick that still counts as equal; by default 0 for the same engine,
    and more for another one and for the video. Where something else was asked for there is none."""
    plot: Path | None = None
    """Draw the sticks, recorded and replayed, into this PNG."""
    json: Path | None = None
    """Write all figures here as JSON."""

    def __post_init__(self) -> None:
        """Refuse what cannot be combined."""
        if self.tolerance is not None:
            check_range("tolerance", self.tolerance, 0, 10, "")
        if self.source == "chunks" and self.changes_policy:
            raise UserError(
                "--from chunks takes the recorded chunks and asks no policy: leave out the flags "
                "of the policy, or use --from features or video"
            )

    @property
    def changes_encoder(self) -> bool:
        """The recorded features may be of another network."""
        given = (self.policy, self.checkpoint, self.contract)
        return any(value is not None for value in given)

    @property
    def changes_policy(self) -> bool:
        """Something of the policy is not as it was."""
        return self.is_other_policy or self.engine is not None or self.device is not None

    @property
    def is_other_policy(self) -> bool:
        """It is to decide differently; another engine is to decide the same."""
        return self.changes_encoder or self.num_diffusion_steps is not None

    @property
    def changes_limits(self) -> bool:
        """The guard is to do something else with the chunks."""
        given = (self.tau, self.max_slew, self.max_feature_age, self.max_chunk_age)
        return any(value is not None for value in given)
