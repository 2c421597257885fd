import subprocess
import sys
from pathlib import Path

import pytest

from mavbridge.core.own_packages import OURS, hidden_package

ROOT = Path(__file__).parents[3]


def test_our_own_packages_are_found() -> None:
    assert hidden_package() is None


def start(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """As a user does who keeps a file of this name in the folder where mavbridge is started."""
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("is_folder", [False, True])
def test_a_file_that_hides_one_of_ours_is_named(tmp_path: Path, name: str, is_folder: bool) -> None:
    hiding = tmp_path / name / "__init__.py" if is_folder else tmp_path / f"{name}.py"
    hiding.parent.mkdir(exist_ok=True)
    hiding.write_text("raise SystemExit('imported')\n")
    ended = start(tmp_path, "-m", "mavbridge", "--version")
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"error: {hiding} hides mavbridge's own package {name}: ")
    assert f"--policy ./{name}.py:Class" in ended.stderr
    assert start(tmp_path, "-P", "-m", "mavbridge", "--version").returncode == 0
