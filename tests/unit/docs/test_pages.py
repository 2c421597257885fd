"""The pages against the program: commands parse, links lead somewhere, marks name real tests."""

import re
import subprocess
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import pytest
from cyclopts.exceptions import CycloptsError, MissingArgumentError

from benchmarks import commands_page
from helpers.guides import (
    PAGES,
    ROOT,
    anchors,
    blocks,
    command_lines,
    inline_codes,
    links,
    page_name,
)
from mavbridge.cli import cli
from mavbridge.config.settings_files import with_settings
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.vehicle import Output
from mavbridge.mavlink.profiles.ardupilot import ArduPilot
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.profiles.px4 import Px4
from mavbridge.mavlink.session.vehicle_params import received_bytes_per_s
from sitl.app import _parser as sitl_parser

_GUIDES = ("simulators", "companion_computers", "real_vehicle", "record_and_train", "timing")
MARKED = [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in _GUIDES)]
"""Pages whose blocks say which test runs them."""
OUR_OUTPUT = "text"
"""Language of a block that shows what appears, and holds no command."""
SOME_ADDRESS = "udp:127.0.0.1:14550"
NOT_RUN = "not run by a test"
MOST_WORDS = 20_000


def parse(words: list[str]) -> None:
    """Parse one command line of ours without running it; others, such as pip, pass.

    Raises:
        CycloptsError, MavbridgeError, SystemExit, AssertionError: it would not start.
    """
    program, arguments = Path(words[0]).name, words[1:]
    if program in ("python", "python3") and arguments[:1] == ["-m"]:
        module, arguments = arguments[1], arguments[2:]
        if module == "sitl":
            sitl_parser().parse_args(arguments)
        elif module == "mavbridge":
            parse(["mavbridge", *arguments])
        elif module.startswith("benchmarks."):
            assert (ROOT / (module.replace(".", "/") + ".py")).exists(), module
    elif program in ("python", "python3") and arguments and arguments[0].endswith(".py"):
        assert (ROOT / arguments[0]).exists(), arguments[0]
    elif program == "mavbridge":
        parse_mavbridge(arguments)
    elif program == "make":
        parse_make(arguments)


def parse_mavbridge(arguments: list[str]) -> None:
    """Through both parsers, that of ``--config`` and that of the commands."""
    if {"--help", "--version", "--install-completion"} & set(arguments):
        return
    _, outer, _ = cli.meta.parse_args(arguments, print_error=False, exit_on_error=False)
    words = list(outer.args)
    if words and not words[0].startswith("-"):
        assert words[0] in cli, f"unknown command {words[0]}"
    words = with_settings(words, outer.arguments.get("set_config", ()))
    cli.parse_args(words, print_error=False, exit_on_error=False)


def parse_make(arguments: list[str]) -> None:
    """Targets and variables are those of our Makefile, but for PX4's own."""
    makefile = (ROOT / "Makefile").read_text()
    if arguments[0] == "px4_sitl":
        return
    for word in arguments:
        name, is_variable, _ = word.partition("=")
        found = rf"^{name} *\?=" if is_variable else rf"^{name}:"
        assert re.search(found, makefile, re.M), f"make {word}"


def commands_of(page: Path) -> Iterator[tuple[list[str], bool]]:
    """Yield the words of each command, and True for one of a block: a mention in the text may leave
    out what is required."""
    for block in blocks(page):
        if block.kind in ("", "sh", "bash", "console"):
            yield from ((words, True) for words in command_lines(block.text))
    yield from ((words, False) for words in mentions(page))


def mentions(page: Path) -> Iterator[list[str]]:
    """Our commands in the text; ``... --flag`` goes on as the last one above it in its table."""
    begin: list[str] = []
    codes = ((words, first) for code, first in inline_codes(page) for words in command_lines(code))
    for words, is_first_cell in codes:
        if words[0] == "..." and words[1:2] and words[1].startswith("--"):
            words[:1] = begin
        elif words[:2] == ["python", "-m"] or words[0] == "mavbridge":
            words = [SOME_ADDRESS if word == "..." else word for word in words]
            if is_first_cell:
                begin = [*takewhile(lambda word: word == "-m" or word[0] not in "-<.", words)]
        else:
            continue
        is_about_flag = words[:3] == ["python", "-m", "sitl"] and words[-1].endswith("connect")
        yield [*words, SOME_ADDRESS] if is_about_flag else words


def test_the_pages_hold_commands_of_both_programs() -> None:
    commands = [words for page in PAGES for words, _ in commands_of(page)]
    assert len(commands) > 100
    assert any(words[:3] == ["python", "-m", "sitl"] for words in commands)
    assert any(words[0] == "mavbridge" for words in commands)


@pytest.mark.parametrize("page", [page_name(page) for page in PAGES])
def test_every_command_on_a_page_parses(page: str) -> None:
    for words, is_whole in commands_of(ROOT / page):
        try:
            parse(words)
        except MissingArgumentError:
            assert not is_whole, f"{page}: {' '.join(words)}"
        except (CycloptsError, MavbridgeError, AssertionError, SystemExit) as error:
            pytest.fail(f"{page}: {' '.join(words)}\n{type(error).__name__}: {error}")


def test_an_unknown_flag_or_command_would_be_found() -> None:
    for line in (
        "mavbridge --conect udp:127.0.0.1:14550",
        "mavbridge chekc --connect udp:127.0.0.1:14550",
        "mavbridge --connect udp:127.0.0.1:14550 --arm --set-config envelope.tilt=high",
        "python -m sitl --conect udpout:127.0.0.1:14550",
        "make flyy",
        "make fly COURS=1",
        "python examples/no_such_policy.py",
    ):
        with pytest.raises((CycloptsError, AssertionError, SystemExit)):
            parse(line.split())


@pytest.mark.parametrize("page", [page_name(page) for page in PAGES])
def test_every_link_and_picture_of_a_page_exists(page: str) -> None:
    for target, anchor in links(ROOT / page):
        assert target.exists(), f"{page}: {target} does not exist"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{page}: {target.name} has no heading #{anchor}"


def test_pages_that_the_code_names_exist() -> None:
    tracked = ["git", "ls-files", "*.py", "Makefile", "*.toml"]
    listed = subprocess.run(tracked, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in listed.stdout.split():
        source = ROOT / name
        for page in re.findall(r"\bdocs/[\w/]+\.(?:md|toml|conf)", source.read_text()):
            assert (ROOT / page).exists() or page.startswith("docs/xyz"), f"{name} names {page}"


@pytest.mark.parametrize("page", [page_name(page) for page in MARKED])
def test_every_block_of_a_guide_says_who_runs_it(page: str) -> None:
    for block in blocks(ROOT / page):
        if block.kind == OUR_OUTPUT:
            continue
        start = block.text.splitlines()[0]
        assert block.mark, f"{page}: no mark above the block that begins with {start!r}"
        if NOT_RUN not in block.mark:
            ran = re.fullmatch(r"(?:run|read) by (tests/\S+\.py)(?:: \w+)?", block.mark)
            assert ran, f"{page}: {block.mark!r} names no test"
            test = (ROOT / ran[1]).read_text()
            assert block.page in test, f"{ran[1]} does not read {block.page}"


def test_the_flags_on_the_page_of_commands_are_those_of_the_program() -> None:
    page = commands_page.PAGE.read_text()
    assert commands_page.with_flags(page) == page, "run: python -m benchmarks.commands_page"


def test_the_policy_of_the_quickstart_is_the_example() -> None:
    page = ROOT / "docs/quickstart.md"
    (code,) = (block.text for block in blocks(page) if block.kind == "python")
    assert code in (ROOT / "examples/numpy_policy.py").read_text()


def test_the_pages_for_users_stay_short() -> None:
    pages = [page for page in PAGES if page.parent == ROOT / "docs"]
    words = [word for page in pages for word in page.read_text().split()]
    assert sum(any(map(str.isalnum, word)) for word in words) <= MOST_WORDS


def test_the_way_of_an_attitude_names_functions_that_exist() -> None:
    page = (ROOT / "docs/dev/architecture.md").read_text()
    table = page.split("## From an attitude datagram")[1].split("## ")[0]
    rows = re.findall(r"^\| \d+ \| `(\S+\.py)` \| (.*) \|$", table, re.M)
    assert len(rows) > 15
    for name, text in rows:
        source = (ROOT / "mavbridge" / name).read_text()
        for function in re.findall(r"`(?:\w+\.)?(\w+)`", text):
            assert re.search(rf"\b(?:def|class) {function}\b", source), f"{function} in {name}"


def test_every_page_is_in_the_index() -> None:
    index = ROOT / "docs" / "README.md"
    reached = {target for target, _ in links(index)} | {index}
    pages = {page for page in PAGES if page.is_relative_to(ROOT / "docs")}
    assert not {page_name(page) for page in pages - reached}


@pytest.mark.parametrize(
    ("profile", "output", "name"),
    [(ArduPilot(), "rc-override", "ArduPilot sends"), (Px4(), "manual-control", "PX4")],
)
def test_baud_rates_fit_what_the_program_asks_for(
    profile: Profile, output: Output, name: str
) -> None:
    groups = [*profile.streams(state_hz=100), profile.echo(output)]
    streams = {group.messages[0]: group for group in groups}.values()
    bytes_per_s = received_bytes_per_s(streams)
    page = " ".join((ROOT / "docs/real_vehicle.md").read_text().split())
    assert f"{name} {bytes_per_s / 1000:.1f} kB/s" in page
    assert 0.9 * bytes_per_s < 0.25 * 921600 / 10, "a quarter of 921600 baud, as the page says"
    assert bytes_per_s < 230400 / 10
