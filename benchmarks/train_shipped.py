"""Train a policy that ships: flights of the weights that shipped before, corrected by the expert.

python -m benchmarks.train_shipped toge --out training

The weights before come from this repository's history. Run the same command again to go on after an
interruption: flights that are recorded are kept, weights that are written are not trained again,
and an unfinished training is resumed. Seeds decide the flights; budgets of training are minutes, so
that another machine makes similar weights, not the same.
"""

import subprocess
import sys
from pathlib import Path
from typing import Literal, NamedTuple

from cyclopts import App

from mavbridge.commands.output import table_console

app = App(help=__doc__)

HERE = Path(__file__).parent

NET = "--policy toge:small:resnet8 --image-size 96 --batch-size 64"
RACES, PX4 = "--action rates --courses race", "--autopilot px4"
AGES = "--ages 10:220"

BEFORE = "6ec5125d549ce680a1948114cb9b9f5180260677"
"""Commit of 2026-11-24 that holds the weights to start from."""


class Step(NamedTuple):
    """One command, and the file or folder that it makes in ``--out``."""

    makes: str
    command: str


def flights(makes: str, flags: str) -> Step:
    """Flights of the weights before, which the expert corrects."""
    return Step(makes, f"demonstrate {flags} --checkpoint before.safetensors")


def training(makes: str, data: str, flags: str) -> Step:
    """A training of so many minutes on these folders, from the weights before."""
    command = f"train {data} {NET} {flags} --start-from before.safetensors --pack"
    return Step(f"{makes}.safetensors", command)


STEPS: dict[str, tuple[Step, ...]] = {
    "toge": (
        flights("own", "--episodes 54 --seed 50 --speed 6.7"),
        flights("own_px4", f"--episodes 36 --seed 51 --speed 6.5 {PX4}"),
        training("toge", "own own_px4", f"--minutes 24 {AGES}"),
    ),
    "toge-rates": (
        flights("own", f"--episodes 54 --seed 52 --speed 9 {RACES}"),
        flights("own_px4", f"--episodes 20 --seed 53 --speed 9 {RACES} {PX4}"),
        training("toge-rates", "own own_px4", f"--minutes 24 {AGES}"),
    ),
}


@app.default
def main(policy: Literal["toge", "toge-rates"], *, out: Path, workers: int = 2) -> None:
    """Run every step that has not been done yet.

    Args:
        policy: what to train.
        out: folder for flights and weights; one for each policy is made in it.
        workers: flights at a time.
    """
    folder = out / policy
    folder.mkdir(parents=True, exist_ok=True)
    copy_weights_before(policy, folder / "before.safetensors")
    for step in STEPS[policy]:
        if step.command.startswith("demonstrate"):
            run(folder, f"{step.command} --image-size 96 --workers {workers} --out {step.makes}")
        elif not (folder / step.makes).exists():
            unfinished = folder / Path(step.makes).with_suffix(".training")
            resume = " --resume" if unfinished.exists() else ""
            run(folder, f"{step.command} --out {step.makes}{resume}")


def copy_weights_before(policy: str, path: Path) -> None:
    """Write the weights that shipped before; end with a message where git has them no more."""
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
    """Run one mavbridge command in the folder; end with its status if it fails."""
    table_console().print(f"mavbridge {command}", soft_wrap=True)
    done = subprocess.run([sys.executable, "-m", "mavbridge", *command.split()], cwd=folder)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    app()
