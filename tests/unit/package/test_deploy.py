"""What a package and a companion computer get."""

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from helpers.programs import ended
from helpers.status import asked_flight
from mavbridge.config.settings_files import untrusted_settings
from mavbridge.recording.folder import EXTRA
from policy.files import read_toml

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "examples/deploy"
PR_SET_CHILD_SUBREAPER = 36
DEADLINE_S = 60


def test_the_sample_settings_are_understood() -> None:
    sample = DEPLOY / "mavbridge.toml"
    config = asked_flight("--config", sample, "--set-config", "envelope.height=20")
    assert list(untrusted_settings(read_toml(sample), [])) == []
    assert config.link.connect == "/dev/ttyACM0,921600"
    unit = (DEPLOY / "mavbridge.service").read_text()
    assert "After=network.target dev-ttyACM0.device" in unit
    assert "/dev/video0" in unit
    assert config.engage_channel == 8
    assert not config.arm
    assert config.camera.camera == ("/dev/video0",)
    assert config.envelope.max_height == 20  # the command line wins


def test_messages_name_the_packages_of_the_extras() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    names = {extra: {line.split(">")[0] for line in lines} for extra, lines in extras.items()}
    assert names["record"] == set(EXTRA)
    assert names["screen"] == {"mss", "python-xlib"}


def test_the_simulator_says_what_it_lacks() -> None:
    code = "import sys; sys.modules['mujoco'] = None; from sitl.__main__ import main; "
    code += "sys.exit(main([]))"
    refused = ended(sys.executable, "-c", code, cwd=ROOT)
    assert refused.returncode == 2
    assert refused.stderr == "sitl: error: the simulated vehicle needs mujoco: pip install mujoco\n"


@pytest.mark.parametrize("module", ["flight.app", "commands.check", "commands.convert"])
def test_flights_and_conversions_need_no_extra(module: str) -> None:
    code = "import sys; sys.modules.update(dict.fromkeys(['av', 'pyarrow.parquet', 'mujoco'])); "
    code += f"import mavbridge.{module}"
    imported = ended(sys.executable, "-c", code, cwd=ROOT)
    assert imported.returncode == 0, imported.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd is installed here")
def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / "mavbridge.service"
    text, count = re.subn("ExecStart=.*", "ExecStart=/bin/true", (DEPLOY / unit.name).read_text())
    assert count == 1
    unit.write_text(text)
    verified = ended("systemd-analyze", "verify", "--man=no", str(unit))
    assert (verified.returncode, verified.stderr) == (0, "")


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash is installed here")
def test_bash_completes_commands_and_flags(tmp_path: Path) -> None:
    home = {"HOME": str(tmp_path), "SHELL": "/bin/bash", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "mavbridge", "--install-completion"]
    installed = ended(*command, env=os.environ | home)
    assert installed.returncode == 0, installed.stderr
    (script,) = (
        path for path in tmp_path.rglob("*") if path.is_file() and path.stem == "mavbridge"
    )
    asked = f"""source {script}
        COMP_WORDS=(mavbridge inspect --ht); COMP_CWORD=2
        _mavbridge mavbridge --ht inspect; echo "${{COMPREPLY[@]}}"
        """
    reply = ended("bash", "-c", asked)
    assert reply.stdout.split() == ["--html"]


def build_wheel(folder: Path) -> Path:
    """Copy what a wheel is built of, and build it in ``folder``."""
    tree = folder / "tree"
    for name in ("mavbridge", "policy", "sitl"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE", "docs/dev/package.md"):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    command = "from setuptools.build_meta import build_wheel; print(build_wheel('..'))"
    environment = os.environ | {"SOURCE_DATE_EPOCH": "1800000000"}
    made = ended(sys.executable, "-c", command, cwd=tree, env=environment)
    assert made.returncode == 0, made.stderr
    return folder / made.stdout.split()[-1]


def test_the_wheel_holds_three_packages_alone_and_is_built_again_bit_by_bit(tmp_path: Path) -> None:
    wheel, tree = build_wheel(tmp_path / "one"), tmp_path / "one" / "tree"
    assert wheel.read_bytes() == build_wheel(tmp_path / "another" / "folder").read_bytes()
    assert wheel.name.endswith("-py3-none-any.whl")
    names = zipfile.ZipFile(wheel).namelist()
    info = {name for name in names if ".dist-info/" in name}
    assert {name.split("/")[0] for name in set(names) - info} == {"mavbridge", "policy", "sitl"}
    sources = {str(path.relative_to(tree)) for path in tree.rglob("*.py")}
    assert {name for name in sources if not name.startswith("build/")} <= set(names)
    page = {f"mavbridge/commands/inspect/page.{end}" for end in ("html", "css", "js")}
    assert {"policy/weights/toge.safetensors", *page} <= set(names)
    assert any(name.endswith("licenses/LICENSE") for name in info)


def become_subreaper() -> None:
    """Orphans below become children of this process, as they become those of PID 1."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="containers are Linux")
def test_the_init_of_a_container_outlives_the_flight_process_until_the_guard_has_ended(
    tmp_path: Path,
) -> None:
    """The flight process ends at SIGTERM; its guard goes on until it is told to end."""
    flight = tmp_path / "mavbridge"
    flight.write_text(
        "#!/bin/bash\ntrap 'exit 7' TERM\n"
        f"(trap '' TERM; echo $BASHPID; read < {tmp_path}/end) &\necho $*\n"
        "for ((k = 0; k < 1200; k++)); do sleep 0.05; done\n"
    )
    flight.chmod(0o755)
    os.mkfifo(tmp_path / "end")
    init = subprocess.Popen(
        ["/bin/bash", str(DEPLOY / "init.sh"), "--arm"],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=become_subreaper,
    )
    try:
        lines = {init.stdout.readline().strip() for _ in range(2)}
        assert "--arm" in lines
        (guard,) = (int(line) for line in lines - {"--arm"})
        init.send_signal(signal.SIGTERM)
        with pytest.raises(subprocess.TimeoutExpired):
            init.wait(1.0)
        os.kill(guard, 0)  # it lives
        (tmp_path / "end").write_text("now\n")
        assert init.wait(DEADLINE_S) == 7
    finally:
        init.kill()
        init.wait()
        init.stdout.close()
