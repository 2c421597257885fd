"""Train a policy that ships, from nothing: flights, training, the student's own flights, training.

python -m benchmarks.train_shipped toge --out training

Run the same command again to go on after an interruption: flights that are recorded are kept,
weights that are written are not trained again, and an unfinished training is resumed. Seeds decide
the flights; budgets of training are minutes, so that another machine makes similar weights, not the
same.
"""

import subprocess
import sys
from pathlib import Path
from typing import Literal, NamedTuple

from cyclopts import App

from mavbridge.commands.output import table_console

app = App(help=__doc__)

NET = "--policy toge:small:resnet8 --image-size 96 --batch-size 64"
OWN = "--num-diffusion-steps 1"
"""A student that flies to be corrected is sampled in one step: it leaves the time to the expert."""

RACES, PX4 = "--action rates --courses race", "--autopilot px4"
AGES = "--ages 10:120"


class Step(NamedTuple):
    """One command, and the file or folder that it makes in ``--out``."""

    makes: str
    command: str


def race_of(makes: str, student: str, flags: str) -> Step:
    """A student's own races, labelled by the expert."""
    own = f"{OWN} --checkpoint {student}.safetensors"
    return Step(makes, f"demonstrate {flags} --speed 9 {RACES} {own}")


STEPS: dict[str, tuple[Step, ...]] = {
    "toge": (
        Step("demos", "demonstrate --episodes 109 --speed 5"),
        Step("demos2", "demonstrate --episodes 32 --seed 2 --speed 5"),
        Step("first.safetensors", f"train demos demos2 {NET} --minutes 20"),
        Step(
            "own1",
            f"demonstrate --episodes 60 --seed 4 --speed 5 {OWN} --checkpoint first.safetensors",
        ),
        Step(
            "own2",
            f"demonstrate --episodes 12 --seed 5 --speed 5 {OWN} --checkpoint first.safetensors",
        ),
        Step(
            "toge.safetensors",
            f"train demos demos2 own1 own2 {NET} --minutes 28 --start-from first.safetensors "
            "--pack",
        ),
    ),
    "toge-rates": (
        Step("races", f"demonstrate --episodes 100 --seed 3 --speed 9.5 {RACES}"),
        Step("races_px4", f"demonstrate --episodes 30 --seed 4 --speed 9 {RACES} {PX4}"),
        Step("first.safetensors", f"train races races_px4 {NET} --minutes 45 {AGES}"),
        race_of("own1", "first", "--episodes 54 --seed 11"),
        race_of("own1_px4", "first", f"--episodes 14 --seed 12 {PX4}"),
        Step(
            "second.safetensors",
            f"train races races_px4 own1 own1_px4 {NET} --minutes 22 {AGES} "
            "--start-from first.safetensors",
        ),
        race_of("own2", "second", "--episodes 44 --seed 13"),
        race_of("own2_px4", "second", f"--episodes 20 --seed 14 {PX4}"),
        Step(
            "toge-rates.safetensors",
            f"train races races_px4 own1 own1_px4 own2 own2_px4 {NET} --minutes 22 {AGES} "
            "--start-from second.safetensors --pack",
        ),
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
    for step in STEPS[policy]:
        if step.command.startswith("demonstrate"):
            run(folder, f"{step.command} --image-size 96 --workers {workers} --out {step.makes}")
        elif not (folder / step.makes).exists():
            unfinished = folder / Path(step.makes).with_suffix(".training")
            resume = " --resume" if unfinished.exists() else ""
            run(folder, f"{step.command} --out {step.makes}{resume}")


def run(folder: Path, command: str) -> None:
    """Run one mavbridge command in the folder; end with its status if it fails."""
    table_console().print(f"mavbridge {command}", soft_wrap=True)
    done = subprocess.run([sys.executable, "-m", "mavbridge", *command.split()], cwd=folder)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    app()
