import shutil
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from helpers.programs import ended
from mavbridge import OUR_SAFE_PATH, SAFE_PATH
from mavbridge.__main__ import PACKAGES
from mavbridge.core.processes import child_environment, user_environment
from policy.adapters.user_class import load_user_class
from policy.errors import PolicyError

ROOT = Path(__file__).parents[3]


def start(folder: Path, *arguments: str) -> CompletedProcess[str]:
    """As a user does who keeps a file of this name in the folder where mavbridge is started."""
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    return ended(sys.executable, *arguments, cwd=folder, env=environment)


@pytest.mark.parametrize(("name", "is_folder"), [*zip(PACKAGES, (False, True), strict=True)])
def test_a_file_that_hides_one_of_ours_is_named(tmp_path: Path, name: str, is_folder: bool) -> None:
    hiding = tmp_path / name / "__init__.py" if is_folder else tmp_path / f"{name}.py"
    hiding.parent.mkdir(exist_ok=True)
    hiding.write_text("raise SystemExit('imported')\n")
    done = start(tmp_path, "-m", "mavbridge", "--version")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {hiding} hides mavbridge's own package {name}: ")
    assert f"--policy ./{name}.py:Class" in done.stderr
    assert start(tmp_path, "-P", "-m", "mavbridge", "--version").returncode == 0


WEIGHTS = ROOT / "policy" / "weights" / "toge.safetensors"
STOLEN = ("opt_einsum", "tqdm", "signal", "ctypes", "importlib_metadata", "multiprocessing", "ray")
"""Modules that somebody or other imports if it can: torch, einops, ours, those of the standard
library."""
LOOKING = """
import sys; from pathlib import Path
Path('ran.txt').open('a').write(__name__ + chr(10))
"""


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A folder of weights with modules beside them, which tell when they run."""
    for name in STOLEN:
        (tmp_path / f"{name}.py").write_text(LOOKING)
    shutil.copy(WEIGHTS, tmp_path)
    return tmp_path


def require_unsprung(trap: Path) -> None:
    ran = trap / "ran.txt"
    assert not ran.exists(), ran.read_text()


def test_modules_of_the_working_directory_are_not_run(trap: Path) -> None:
    assert start(trap, "-m", "mavbridge", "--version").returncode == 0
    require_unsprung(trap)


@pytest.mark.system  # loads the network, and starts workers and writers of videos
def test_modules_beside_weights_are_not_run(trap: Path) -> None:
    flights = ("--episodes", "2", "--workers", "2", "--max-time", "1", "--out", "out")
    done = start(trap, "-m", "mavbridge", "demonstrate", *flights, "--checkpoint", WEIGHTS.name)
    assert done.returncode == 0, done.stderr
    require_unsprung(trap)


def test_a_class_of_the_working_directory_leaves_no_trace_on_the_path(
    trap: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (trap / "beside_weights.py").write_text("class Mine:\n    contract = None\n")
    monkeypatch.chdir(trap)
    before = list(sys.path)
    with pytest.raises(PolicyError, match="member contract must be"):
        load_user_class("beside_weights:Mine", None)
    assert sys.path == before


def test_a_program_of_the_users_has_the_users_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, expected in ((OUR_SAFE_PATH, None), ("1", "1")):
        monkeypatch.setenv(SAFE_PATH, value)
        assert user_environment().get(SAFE_PATH) == expected
        assert child_environment()[SAFE_PATH]
