"""Whether pip finds a wheel for Linux on arm64 of every pinned package that flies."""

import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
EXTRAS = ("record", "sitl")
MACHINE = {"platform_machine": "aarch64", "sys_platform": "linux", "platform_system": "Linux"}
GLIBC = ("manylinux2014", *(f"manylinux_2_{minor}" for minor in range(17, 37)))
"""Tags up to glibc 2.36, that of Debian 12: Raspberry Pi OS and the image of our Dockerfile."""
NO_NETWORK = re.compile(r"[^']*(new connection|resolve|timed out|unreachable)[^']*", re.IGNORECASE)


def pins() -> dict[str, str]:
    """The pinned version of each package, by its canonical name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = (line.split("==") for line in lines if "==" in line)
    return {canonicalize_name(name): version for name, version in pinned}


def needed() -> set[str]:
    """Names of all packages that the core and EXTRAS need on arm64, by what is installed here.

    The CUDA parts of torch have no pin: with the index of CPU builds nobody gets them.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    waiting = [*project["dependencies"], *(each for name in EXTRAS for each in extras[name])]
    pinned, found = pins(), set()
    while waiting:
        requirement = Requirement(waiting.pop())
        name = canonicalize_name(requirement.name)
        if name in found or name not in pinned or not applies(requirement):
            continue
        found.add(name)
        try:
            waiting += requires(name) or []
        except PackageNotFoundError:
            pytest.skip(f"{name} is not installed here, so what it needs is not known")
    return found


def applies(requirement: Requirement) -> bool:
    marker = requirement.marker
    return marker is None or marker.evaluate({**MACHINE, "extra": ""})


def test_every_pinned_package_that_flies_has_a_wheel_for_arm64(tmp_path: Path) -> None:
    pinned, names = pins(), needed()
    assert {"torch", "openvino", "pymavlink", "pyarrow", "mujoco", "numpy"} <= names
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--no-deps"]
    command += ["--ignore-installed", "--only-binary=:all:", "--target", str(tmp_path / "target")]
    command += ["--python-version", "3.11", "--report", str(report), "--retries", "1"]
    command += [word for glibc in GLIBC for word in ("--platform", f"{glibc}_aarch64")]
    command += [f"{name}=={pinned[name]}" for name in sorted(names)]
    asked = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    if asked.returncode and (line := NO_NETWORK.search(asked.stderr)):
        pytest.skip(f"no package index can be reached: {line.group()}")
    assert asked.returncode == 0, asked.stderr
    wheels = [found["download_info"]["url"] for found in json.loads(report.read_text())["install"]]
    assert len(wheels) == len(names)
    tags = {url.rpartition("-")[2].removesuffix(".whl") for url in wheels}
    assert all(tag == "any" or tag.endswith("_aarch64") for tag in tags), tags
    assert any(tag.endswith("_aarch64") for tag in tags)
