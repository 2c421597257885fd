"""Rows about the cameras: all are open at the same time, and each is read for two seconds."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from statistics import median

from mavbridge.camera.image_watch import is_blank
from mavbridge.camera.open import NO_CAMERA, open_camera, require_present
from mavbridge.commands.check.rows import NO_VEHICLE, CheckRow
from mavbridge.commands.output import print_status
from mavbridge.config.flight import CameraConfig, FlyConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import CameraError, MavbridgeError
from mavbridge.core.records import Camera, CameraImage
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.policies import NO_IMAGE_ADVICE, looks_at_images, require_images
from policy.contract import Contract
from policy.preprocess import least_source_px

MEASURE_S = 2.0
_READ_NS = NS_PER_S // 2
_ENOUGH = 0.9
"""Least acceptable share of the wanted rate."""
_cameras_row = partial(CheckRow, "camera", "cameras")


@dataclass(frozen=True, kw_only=True)
class CameraNeeds:
    """Requirements of the flight on one camera."""

    name: str
    """Name in the contract; empty for the only camera."""
    source: str
    rate_hz: float
    size_px: tuple[int, int]
    """Least height and width of the image."""
    max_age_s: float
    """Oldest image to act on."""
    is_flown_by: bool = True
    """True if a black image is a fault."""
    is_depth: bool | None = None
    """True for depth, False for RGB; None: no policy tells."""


@dataclass(kw_only=True)
class CameraView:
    """Frames received from one camera in two seconds."""

    captured_ns: list[int] = field(default_factory=list)
    ages_ns: list[int] = field(default_factory=list)
    """Time from the stamp to the read of each frame."""
    image: CameraImage | None = None
    """The newest."""
    is_stamped: bool = False
    """True if the source tells the exposures."""
    dropped: int = 0
    silent_ns: int = 0
    """Time from the newest frame's arrival to the end of the watch."""
    failure: str | None = None

    @property
    def rate_hz(self) -> float:
        """Frame rate from timestamps, unread frames included."""
        if len(self.captured_ns) < 2:
            return 0.0
        span_ns = self.captured_ns[-1] - self.captured_ns[0]
        return (len(self.captured_ns) - 1 + self.dropped) * NS_PER_S / span_ns if span_ns else 0.0


def check_cameras(config: FlyConfig, plan: FlightPlan | None, clock: Clock) -> list[CheckRow]:
    """Return rows on every camera of the flight, or on the flags that do not fit the policy."""
    is_blind = set(config.camera.sources) == {NO_CAMERA}
    if is_blind and config.link.connect == NO_VEHICLE:
        return []  # only this computer is checked
    try:
        require_images(config)
        needs = [] if is_blind else _camera_needs(config, plan)
    except MavbridgeError as error:
        return [_cameras_row(" ".join(config.camera.sources), no_go=str(error))]
    if not needs:
        return [_cameras_row("none", "none for this flight")]
    print_status("watching the camera")
    return camera_rows(needs, config.camera, clock)


def _camera_needs(config: FlyConfig, plan: FlightPlan | None) -> list[CameraNeeds]:
    """Return the flight's needs of each camera; raise UserError if their names do not fit.

    Without a policy only cameras named by flags are checked.
    """
    if plan is None:
        if config.camera == CameraConfig():
            return []
        contract = Contract()
        names, sources = config.camera.sources, config.camera.sources
        rates_hz = (config.rates.visual_rate,) * len(sources)
        max_age_s = contract.max_feature_age_s
    else:
        contract = plan.contract
        names, sources = contract.cameras, config.camera.sources_of(contract.cameras)
        rates_hz = plan.image_rates_hz
        max_age_s = plan.start_limits.feature_ns / NS_PER_S
    return [
        CameraNeeds(
            name=name if len(names) > 1 else "",
            source=source,
            rate_hz=rate_hz,
            size_px=least_source_px(contract),
            max_age_s=max_age_s,
            is_flown_by=looks_at_images(config),
            is_depth=None if plan is None else contract.is_depth,
        )
        for name, source, rate_hz in zip(names, sources, rates_hz, strict=False)
    ]


def camera_rows(needs: Sequence[CameraNeeds], config: CameraConfig, clock: Clock) -> list[CheckRow]:
    """Open all cameras, read one after the other, and close them; a failure becomes a row."""
    rows: list[CheckRow] = []
    with ExitStack() as stack:
        opened: list[tuple[CameraNeeds, Camera]] = []
        for need in needs:
            try:
                require_present(need.source)
                camera = open_camera(
                    need.source,
                    image_size=need.size_px,
                    clock=clock,
                    timeout_s=config.camera_timeout,
                    latency_ms=config.camera_latency,
                    is_depth=need.is_depth,
                )
            except MavbridgeError as error:
                hint = "" if need.is_flown_by else f"; the policy {NO_IMAGE_ADVICE}"
                rows.append(_row(need, "not opened", no_go=f"{error}{hint}"))
                continue
            stack.callback(camera.close)
            opened.append((need, camera))
        for need, camera in opened:
            rows += judge(need, _watch(camera, clock), latency_ms=config.camera_latency)
    return rows


def _watch(camera: Camera, clock: Clock) -> CameraView:
    seen = CameraView()
    heard_ns = clock.now_ns()
    until_ns = heard_ns + round(MEASURE_S * NS_PER_S)
    dropped_before = camera.dropped_frames
    try:
        while clock.now_ns() < until_ns:
            frame = camera.read(_READ_NS)
            if frame is None:
                continue
            if seen.image is None:
                dropped_before = camera.dropped_frames
            heard_ns = clock.now_ns()
            seen.ages_ns.append(heard_ns - frame.captured_ns)
            seen.captured_ns.append(frame.captured_ns)
            seen.image, seen.is_stamped = frame.rgb, frame.is_stamped
    except CameraError as error:
        seen.failure = str(error)
    seen.dropped = camera.dropped_frames - dropped_before
    seen.silent_ns = clock.now_ns() - heard_ns
    return seen


def judge(need: CameraNeeds, seen: CameraView, *, latency_ms: float) -> list[CheckRow]:
    """Return the rows of one camera from its frames; ``latency_ms`` is that of --camera-latency."""
    silent_s = seen.silent_ns / NS_PER_S
    has_stopped = silent_s > max(need.max_age_s, 2 / need.rate_hz)
    if seen.failure is not None or seen.image is None or has_stopped:
        why = seen.failure or f"no frame came in the last {silent_s:.1f} s"
        return [_row(need, "stopped", no_go=why)]
    slow = (
        f"the camera delivers {seen.rate_hz:.1f} images a second of {need.rate_hz:.3g}: more "
        "light, a smaller image or another mode may help; or ask for fewer by rates.visual"
    )
    rate_row = _row(
        need,
        f"{seen.rate_hz:.1f} Hz",
        f"{need.rate_hz:.3g} Hz",
        part="rate",
        warn=slow if seen.rate_hz < _ENOUGH * need.rate_hz else "",
    )
    return [rate_row, _image_row(need, seen.image), _age_row(need, seen, latency_ms)]


def _image_row(need: CameraNeeds, image: CameraImage) -> CheckRow:
    (height_px, width_px), is_depth = image.shape[:2], image.ndim == 2
    least_height_px, least_width_px = need.size_px
    is_small = height_px < least_height_px or width_px < least_width_px
    advice, is_covered = "", is_blank(image)
    if need.is_flown_by and is_small:
        advice = "the image is smaller than what the policy takes, and is enlarged for it"
    if is_covered:
        what = "without any depth" if is_depth else "black or of one colour"
        advice = f"the image is {what}: is the lens covered?"
    return _row(
        need,
        f"{width_px}x{height_px}{' depth' if is_depth else ''}",
        f"{least_width_px}x{least_height_px} or more",
        part="image",
        warn=advice,
        no_go=advice if is_covered and need.is_flown_by else "",
    )


def _age_row(need: CameraNeeds, seen: CameraView, latency_ms: float) -> CheckRow:
    ages_ms = sorted(age_ns / NS_PER_MS for age_ns in seen.ages_ns)
    typical_ms, oldest_ms = median(ages_ms), ages_ms[-1]
    steps_back = sum(after <= before for before, after in pairwise(seen.captured_ns))
    warn = ""
    if steps_back:
        warn = f"{steps_back} stamps do not rise: their source does not count on"
    elif not (seen.is_stamped or latency_ms):
        warn = (
            "frames are stamped as they arrive, so their true age is not known: measure the time "
            "from exposure to arrival, and give it as --camera-latency MS"
        )
    old = f"images are older than the {need.max_age_s:g} s at which they may be acted on"
    return _row(
        need,
        f"{typical_ms:.1f} ms, at most {oldest_ms:.1f}",
        f"exposure stamps, under {need.max_age_s * 1000:.0f} ms",
        part="age when read",
        warn=warn,
        no_go=old if typical_ms / 1000 > need.max_age_s else "",
    )


def _row(
    need: CameraNeeds,
    found: str,
    expected: str = "frames",
    *,
    part: str = "",
    warn: str = "",
    no_go: str = "",
) -> CheckRow:
    name = " ".join(filter(None, (need.name or need.source, part)))
    return CheckRow("camera", name, found, expected, warn, no_go)
