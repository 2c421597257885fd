"""Runs the commands of docs/record_and_train.md."""

from pathlib import Path

import pytest

from helpers.guides import ROOT, blocks, command_lines
from mavbridge.__main__ import main

PAGE = ROOT / "docs/record_and_train.md"


def test_its_commands_make_a_dataset(tmp_path: Path) -> None:
    (block,) = (block for block in blocks(PAGE) if block.mark.startswith("run by"))
    (words,) = command_lines(block.text)
    assert words[0] == "mavbridge"
    in_folder = {"dataset": str(tmp_path / "dataset"), "examples/start": str(ROOT / words[2])}
    with pytest.raises(SystemExit) as ended:
        main([in_folder.get(word, word) for word in words[1:]])
    assert not ended.value.code
    assert (tmp_path / "dataset" / "meta" / "info.json").exists()
