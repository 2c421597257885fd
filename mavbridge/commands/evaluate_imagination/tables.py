"""The quality of a world model for a terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mavbridge.commands.evaluate_imagination.drift import OUTSIDE
from mavbridge.commands.evaluate_imagination.results import METHODS, Given, Quality


def print_quality(quality: Quality, console: Console) -> None:
    """What was evaluated, then a table for each part that there is."""
    for line in _notes(quality.given, quality.windows):
        console.print(Text(line), soft_wrap=True)
    if quality.frames:
        console.print(frames_table(quality))
        console.print(obedience_table(quality))
    nearer = quality.own_actions_nearer
    if nearer is not None:
        interval = f" (95 % interval {nearer.low:.1%} to {nearer.high:.1%})"
        console.print(
            Text(
                f"action swap: with its own sticks {nearer.value:.1%} of {nearer.count} windows"
                f"{interval} come nearer to what happened than with another window's; 50 % would "
                "be chance"
            ),
            soft_wrap=True,
        )
    if quality.drift:
        console.print(drift_table(quality))


def _notes(given: Given, windows: int) -> list[str]:
    left_out = [
        f"{count} {what}"
        for count, what in (
            (given.flights_too_short, "too short"),
            (given.demonstrations_failed, "demonstrations that failed"),
        )
        if count
    ]
    lines = [
        f"{given.world_model}, {given.ddim_steps} DDIM steps, seed {given.seed}: {windows} windows "
        f"of {given.flights} flights" + (f"; left out: {', '.join(left_out)}" if left_out else "")
    ]
    if given.flights_with_assumed_lens:
        lines.append(
            f"{given.flights_with_assumed_lens} flights do not tell their field of view and "
            "camera tilt: --fov and --camera-tilt are taken for theirs"
        )
    if given.flights_with_assumed_yaw_rate:
        lines.append(
            f"{given.flights_with_assumed_yaw_rate} flights do not tell the yaw rate of a full "
            "stick: --yaw-rate is taken for theirs"
        )
    return lines


def frames_table(quality: Quality) -> Table:
    """PSNR and SSIM by method and frames ahead."""
    table = Table(title="frames: PSNR in dB / SSIM, by frames ahead")
    table.add_column("")
    for one in quality.of("imagined"):
        seconds = one.step * quality.given.frame_dt_s
        table.add_column(f"{one.step} ({seconds:.1f} s)", justify="right")
    for method in METHODS:
        cells = [f"{one.psnr_db:.2f} / {one.ssim:.3f}" for one in quality.of(method)]
        table.add_row(method, *cells)
    return table


def obedience_table(quality: Quality) -> Table:
    """Body rates against those commanded, and against the real ones."""
    table = Table(title="body rates: does the imagination obey?")
    for heading in ("axis", "of", "against"):
        table.add_column(heading)
    for heading in ("slope", "Spearman", "steps"):
        table.add_column(heading, justify="right")
    for one in quality.obedience:
        against = "stick x yaw rate" if one.reference == "stick" else one.reference
        slope, spearman = _number(one.slope), _number(one.spearman)
        table.add_row(one.axis, one.teller, against, slope, spearman, str(one.pairs))
    return table


def drift_table(quality: Quality) -> Table:
    """PSNR by iteration."""
    given = quality.given
    table = Table(
        title=f"drift: chained iterations of {given.exe_steps} frames, PSNR in dB of the last",
        caption=f"left: more than {OUTSIDE:.0%} of a frame's latents are beyond all real ones; "
        "without recorded sticks a chain goes on with centred ones, and is not scored",
    )
    table.add_column("iteration", justify="right")
    for heading in ("imagined", "autoencoder only", "copy last", "scored", "left", "chains"):
        table.add_column(heading, justify="right")
    for one in quality.drift:
        values = (one.imagined_psnr_db, one.autoencoder_psnr_db, one.copy_last_psnr_db)
        table.add_row(
            f"{one.iteration} ({one.iteration * given.exe_steps * given.frame_dt_s:.1f} s)",
            *map(_number, values),
            str(one.scored),
            f"{one.left_range:.0%}",
            str(one.chains),
        )
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
