"""Train a policy that ships.

python -m benchmarks.train_shipped toge --out training

It starts from the weights shipped before, taken from this repository's history. In two rounds they
fly with the looks, the loops and the ends of courses of today, the expert corrects them, and they
learn from that. How the weights before were made is on their card of that commit.

Run the same command again to resume after an interruption: recorded flights and written weights are
kept, and an unfinished training is resumed. Seeds determine the flights. Training budgets are
minutes, so another machine makes similar weights, not the same.
"""

import subprocess
import sys
from pathlib import Path
from typing import Literal, NamedTuple

from cyclopts import App

from mavbridge.commands.output import table_console

app = App(help=__doc__)

HERE = Path(__file__).parent

SIZE = "--set-config network.image_size=96"
"""Side of the recorded images."""
NET = "--policy toge:small:resnet8 --image-size 96 --batch-size 64 --include-failed"
LOOP, PX4 = "--courses loop", "--autopilot px4"
RATES = "--speed 9 --action rates"
RACE, RATES_LOOP = f"{RATES} --courses race", f"{RATES} {LOOP}"
STICK_AGES, RATE_AGES = "--ages 10:220", "--ages 10:140"

BEFORE = "438fb84af6f14453cf773d90c24cdd1e15b7b50a"
"""Commit of 2026-11-27 with the weights to start from."""


class Step(NamedTuple):
    """One command, and the file or folder that it makes in ``--out``."""

    makes: str
    command: str


def flights(makes: str, flags: str, student: str) -> Step:
    """Return a step that records flights of a student that the expert corrects."""
    return Step(makes, f"demonstrate {flags} --checkpoint {student}.safetensors")


def training(makes: str, data: str, flags: str, start: str) -> Step:
    """Return a step that trains on these folders, from the weights of an earlier training."""
    return Step(
        f"{makes}.safetensors", f"train {data} {NET} {flags} --start-from {start}.safetensors"
    )


STEPS: dict[str, tuple[Step, ...]] = {
    "toge": (
        flights("easy1", "--episodes 44 --seed 80 --speed 6.7", "before"),
        flights("loop1", f"--episodes 26 --seed 82 --speed 6.5 {LOOP}", "before"),
        flights("px1", f"--episodes 22 --seed 81 --speed 6.5 {PX4}", "before"),
        training("first", "easy1 loop1 px1", f"--minutes 14 {STICK_AGES}", start="before"),
        flights("easy2", "--episodes 36 --seed 83 --speed 6.7", "first"),
        flights("loop2", f"--episodes 16 --seed 84 --speed 6.5 {LOOP}", "first"),
        flights("px2", f"--episodes 16 --seed 85 --speed 6.5 {PX4}", "first"),
        training(
            "toge",
            "easy1 loop1 px1 easy2 loop2 px2",
            f"--minutes 26 {STICK_AGES} --pack",
            start="first",
        ),
    ),
    "toge-rates": (
        flights("race1", f"--episodes 36 --seed 73 {RACE}", "before"),
        flights("loop1", f"--episodes 14 --seed 74 {RATES_LOOP}", "before"),
        flights("px1", f"--episodes 16 --seed 75 {RACE} {PX4}", "before"),
        training("first", "race1 loop1 px1", f"--minutes 14 {RATE_AGES}", start="before"),
        flights("race2", f"--episodes 30 --seed 76 {RACE}", "first"),
        flights("loop2", f"--episodes 12 --seed 77 {RATES_LOOP}", "first"),
        flights("px2", f"--episodes 14 --seed 78 {RACE} {PX4}", "first"),
        training(
            "toge-rates",
            "race1 loop1 px1 race2 loop2 px2",
            f"--minutes 26 {RATE_AGES} --pack",
            start="first",
        ),
    ),
}


@app.default
def main(policy: Literal["toge", "toge-rates"], *, out: Path, workers: int = 2) -> None:
    """Run all steps that are not done yet.

    Args:
        policy: the policy to train.
        out: folder for flights and weights; one per policy is made in it.
        workers: flights at a time.
    """
    folder = out / policy
    folder.mkdir(parents=True, exist_ok=True)
    copy_weights_before(policy, folder / "before.safetensors")
    for step in STEPS[policy]:
        if step.command.startswith("demonstrate"):
            run(folder, f"{step.command} {SIZE} --workers {workers} --out {step.makes}")
        elif not (folder / step.makes).exists():
            unfinished = folder / Path(step.makes).with_suffix(".training")
            resume = " --resume" if unfinished.exists() else ""
            run(folder, f"{step.command} --out {step.makes}{resume}")


def copy_weights_before(policy: str, path: Path) -> None:
    """Write the policy's weights that shipped before; exit with a message if git lacks them."""
    if path.exists():
        return
    name = f"{BEFORE}:policy/weights/{policy}.safetensors"
    partial = path.with_suffix(".part")
    try:
        with partial.open("wb") as file:
            subprocess.run(["git", "show", name], cwd=HERE, stdout=file, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        partial.unlink(missing_ok=True)
        raise SystemExit(f"{error}: a shallow clone needs git fetch --unshallow") from error
    partial.replace(path)


def run(folder: Path, command: str) -> None:
    """Run one mavbridge command in the folder; exit with its status if it fails."""
    table_console().print(f"mavbridge {command}", soft_wrap=True)
    done = subprocess.run([sys.executable, "-m", "mavbridge", *command.split()], cwd=folder)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    app()
