import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from policy.errors import PolicyError
from policy.loading.load import check_request, load_policy, read_policy_contract
from policy.loading.request import LoadedPolicy, PolicyRequest

STATE = np.eye(1, 13, 3, dtype=np.float32)
HISTORY = np.zeros((1, 4, 4), np.float32)

FLYING = """
import neighbour
import numpy as np
from policy.contract import Contract


class Flying:
    contract = Contract(arrays="numpy", image_height=32, image_width=32)

    def __init__(self, checkpoint=None):
        self.value = neighbour.VALUE if checkpoint is None else float(checkpoint.read_text())

    def predict(self, image, state, action_history, num_diffusion_steps):
        return np.full((1, 16, 4), self.value, np.float32)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of a user's, which is the working directory."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "neighbour.py").write_text("VALUE = 0.25\n")
    (tmp_path / "flying.py").write_text(FLYING)
    (tmp_path / "weights.txt").write_text("0.5")
    yield tmp_path
    for name in [each for each in sys.modules if each == "neighbour" or "_policy_file_" in each]:
        del sys.modules[name]


def load(spec: str, checkpoint: Path | None = None) -> LoadedPolicy:
    return load_policy(PolicyRequest(spec=spec, checkpoint=checkpoint), now_s=lambda: 0.0)


def throttle(loaded: LoadedPolicy) -> float:
    rgb = np.full((48, 64, 3), 90, np.uint8)
    act, encode = loaded.runner.act, loaded.runner.encode
    return float(act(encode(rgb), STATE, HISTORY)[0, 0, 0])


@pytest.mark.parametrize("form", ["./flying.py:Flying", "{}/flying.py:Flying"])
def test_a_file_of_the_users_flies_and_finds_its_neighbours(folder: Path, form: str) -> None:
    spec = form.format(folder)
    loaded = load(spec)
    assert throttle(loaded) == pytest.approx(0.25)
    assert loaded.runner.name == spec
    assert throttle(load(spec, folder / "weights.txt")) == pytest.approx(0.5)
    assert "flying" not in sys.modules


def test_files_of_one_name_are_two_policies(folder: Path) -> None:
    for name, value in (("first", 0.1), ("second", 0.2)):
        (folder / name).mkdir()
        text = FLYING.replace("import neighbour\n", "").replace("neighbour.VALUE", str(value))
        (folder / name / "mine.py").write_text(text)
    values = [throttle(load(f"{name}/mine.py:Flying")) for name in ("first", "second", "first")]
    assert values == pytest.approx([0.1, 0.2, 0.1])


def test_a_package_offers_what_its_init_names(folder, monkeypatch):
    package = folder / "user_package_of_a_test"
    package.mkdir()
    (package / "__init__.py").write_text("from .inner import Flying as Flying\n")
    (package / "inner.py").write_text(FLYING.replace("import neighbour", "from . import neighbour"))
    (package / "neighbour.py").write_text("VALUE = 0.75\n")
    monkeypatch.syspath_prepend(folder)
    for spec in ("user_package_of_a_test:Flying", "user_package_of_a_test.inner:Flying"):
        assert throttle(load(spec)) == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("./flying.py", r"names no class: write \./flying\.py:Class"),
        ("./absent.py:Flying", r"no file absent\.py.*\['flying\.py', 'neighbour\.py'\]"),
        ("./weights.txt:Flying", r"not a Python file: weights\.txt; .*'flying\.py'"),
        ("./flying.py:Fly-ing", "is unknown; write"),
        ("no_such_module:Flying", r"no module no_such_module.*\./file\.py:Class"),
    ],
)
def test_a_wrong_form_is_refused_before_any_code_of_the_users_runs(folder, spec, message):
    with pytest.raises(PolicyError, match=message):
        check_request(PolicyRequest(spec=spec))


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("def (:", r"SyntaxError.*broken\.py"),
        ("raise ValueError('no camera here')", r"ValueError: no camera here \(.*broken\.py:1\)"),
        ("import no_such_library", "install no_such_library beside mavbridge"),
        ("from .neighbour import VALUE", "import its neighbours by their plain names"),
        ("import policy.of_mine", "policy is a package of mavbridge: one of yours needs another"),
    ],
)
def test_a_file_that_cannot_be_imported_says_why(folder: Path, code: str, message: str) -> None:
    (folder / "broken.py").write_text(code + "\n")
    for _ in range(2):  # nothing half imported is left behind
        with pytest.raises(PolicyError, match=message):
            load("./broken.py:Flying")


LIFE = """
import numpy as np
import torch
from policy.contract import Contract


class Life:
    contract = Contract(arrays="numpy", image_height=32, image_width=32)
    closed = 0

    def predict(self, image, state, action_history, num_diffusion_steps):
        return np.zeros((1, 16, 4), np.float32)

    def close(self):
        type(self).closed += 1


class FailsToClose(Life):
    def close(self):
        super().close()
        raise OSError("no socket")


class FailsTwice(FailsToClose):
    def predict(self, image, state, action_history, num_diffusion_steps):
        raise RuntimeError("no weights")


class ClosesTensors(Life):
    contract = Contract(image_height=32, image_width=32)

    def predict(self, image, state, action_history, num_diffusion_steps):
        self.memory = state + 1
        return torch.zeros(1, 16, 4)

    def close(self):
        super().close()
        self.memory.zero_()
"""


@pytest.fixture
def life(folder: Path) -> str:
    (folder / "life.py").write_text(LIFE)
    return "./life.py"


def closed(loaded_or_failed: str) -> int:
    named = (each for each in sys.modules if each.startswith("_policy_file_"))
    module = next(sys.modules[each] for each in named if each.endswith("_life"))
    times: int = getattr(module, loaded_or_failed).closed
    return times


@pytest.mark.parametrize("name", ["Life", "ClosesTensors"])
def test_a_policy_is_closed_once_at_the_end(life: str, name: str) -> None:
    with load(f"{life}:{name}"):
        assert closed(name) == 0
    assert closed(name) == 1


def test_a_policy_that_fails_its_trial_or_whose_contract_is_read_is_closed(life: str) -> None:
    with pytest.raises(PolicyError, match="no weights"):
        load(f"{life}:FailsTwice")
    assert closed("FailsTwice") == 1
    assert read_policy_contract(PolicyRequest(spec=f"{life}:Life")).image_height == 32
    assert closed("Life") == 1


def test_a_failure_to_close_is_said_and_hides_no_other(life: str) -> None:
    with (
        pytest.raises(PolicyError, match=r"failed to close: OSError: no socket \(.*life\.py"),
        load(f"{life}:FailsToClose"),
    ):
        pass
    with pytest.raises(ZeroDivisionError) as caught, load(f"{life}:FailsToClose"):
        raise ZeroDivisionError
    assert "failed to close" in caught.value.__notes__[0]
