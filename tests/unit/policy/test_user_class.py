import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from helpers.loaded_policies import act, load
from mavbridge.core.stopping import Worker
from policy.errors import PolicyError, user_code
from policy.loading.load import check_request, read_policy_contract
from policy.loading.request import LoadedPolicy, PolicyRequest

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


def throttle(loaded: LoadedPolicy) -> float:
    return float(act(loaded.runner)[0, 0])


@pytest.mark.parametrize("form", ["./flying.py:Flying", "{}/flying.py:Flying"])
def test_a_file_of_the_users_flies_and_finds_its_neighbours(folder: Path, form: str) -> None:
    spec = form.format(folder)
    loaded = load(spec)
    assert throttle(loaded) == pytest.approx(0.25)
    assert loaded.runner.name == spec
    assert throttle(load(spec, checkpoint=folder / "weights.txt")) == pytest.approx(0.5)
    assert "flying" not in sys.modules


@pytest.mark.parametrize("arrays", ["numpy", "torch"])
def test_a_policy_without_a_chunk_for_the_first_states_is_loaded(folder, arrays):
    code = FLYING.replace("return", "raise NoChunkError('too early') #")
    code = code.replace("self.value =", "self.net, self.value = torch.nn.Linear(1, 1),")
    code = "import torch\nfrom policy.errors import NoChunkError\n" + code
    code = code.replace('"numpy"', f'"{arrays}"')
    (folder / "flying.py").write_text(code)
    loaded = load("./flying.py:Flying")
    assert (loaded.runner.engine, loaded.times) == (arrays, None)


SKIPPING = """
from numpy import zeros
from policy.contract import Contract
from policy.errors import NoChunkError
class Skipping:
    contract = Contract(arrays="numpy", feature_dim=8, image_height=32, image_width=32)
    def encode_visual(self, image):
        raise NoChunkError("no contrast in this image")
    def predict_fast(self, feature, state, history, steps):
        return zeros((1, 16, 4), "f4")
    def predict(self, image, state, history, steps):
        return self.predict_fast(self.encode_visual(image), state, history, steps)
"""


@pytest.mark.parametrize("dual_rate", [True, False])
def test_a_policy_that_skips_the_dummy_image_is_loaded(folder: Path, dual_rate: bool) -> None:
    (folder / "skipping.py").write_text(SKIPPING)
    loaded = load("./skipping.py:Skipping", dual_rate=dual_rate)
    assert (loaded.runner.dual_rate, loaded.times) == (dual_rate, None)


def test_a_policy_that_sets_how_numpy_fails_leaves_it_as_it_was(folder: Path) -> None:
    code = FLYING.replace("self.value =", "np.seterr(all='raise'); self.value =")
    (folder / "flying.py").write_text(code)
    load("./flying.py:Flying")
    assert np.exp(np.float32(-1000.0)) == 0.0


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
        ("version https://git-lfs.github.com/spec/v1", r"broken\.py is a pointer of Git LFS"),
        ("\udcff\udcfed\0", r"broken\.py is text in UTF-16"),
        ("raise ValueError('no camera here')", r"ValueError: no camera here \(.*broken\.py:1\)"),
        ("raise SystemExit('no')", r"SystemExit: no \(.*broken\.py:1\)"),
        ("import asyncio; raise asyncio.CancelledError('no')", r"CancelledError: no \("),
        ("raise GeneratorExit('no')", r"GeneratorExit: no \("),
        ("class E(Exception):\n  __str__ = None\nraise E", r"E: .*str\(\) failed.*broken\.py:3\)"),
        ("import no_such_library", "install no_such_library beside mavbridge"),
        ("from .neighbour import VALUE", "import its neighbours by their plain names"),
        (
            "from policy.contract import Contract\nContract(horizon=-3)",
            r"horizon must be .*got -3 \(.*broken\.py:2\)$",
        ),
        ("import policy.of_mine", "policy is a package of mavbridge: one of yours needs another"),
    ],
)
def test_a_file_that_cannot_be_imported_says_why(folder: Path, code: str, message: str) -> None:
    (folder / "broken.py").write_text(code + "\n", errors="surrogateescape")
    for _ in range(2):  # nothing half imported is left behind
        with pytest.raises(PolicyError, match=message):
            load("./broken.py:Flying")


def test_an_interrupt_is_a_failure_but_for_ctrl_c_on_the_main_thread() -> None:
    def fly(_stop: threading.Event) -> None:
        with user_code("mine failed"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fly(threading.Event())
    worker = Worker("mavbridge-policy", fly)
    worker.start()
    with pytest.raises(PolicyError, match="mine failed: KeyboardInterrupt"):
        worker.join(10.0)


MINE = """
import numpy as np
import torch
from policy.contract import Contract


class Single:
    contract = Contract(arrays="numpy", image_height=32, image_width=32)
    closed = chunks = 0

    def predict(self, image, state, action_history, num_diffusion_steps):
        self.chunks += 1
        return np.full((1, 16, 4), self.chunks / 100, np.float32)

    def reset(self):
        self.chunks = 0

    def close(self):
        type(self).closed += 1


class TorchRemembers:
    contract = Contract(image_height=32, image_width=32)
    memory = None
    closed = 0

    def predict(self, image, state, action_history, num_diffusion_steps):
        self.memory = state[:, :1] + (0 if self.memory is None else self.memory) + 0.25
        return self.memory[:, None].repeat(1, 16, 4).bfloat16()

    def reset(self):
        self.memory.zero_()

    def close(self):
        type(self).closed += 1
        self.memory.zero_()


class FailsToClose(Single):
    def close(self):
        super().close()
        raise OSError("no socket")


class FailsTwice(FailsToClose):
    def predict(self, image, state, action_history, num_diffusion_steps):
        raise RuntimeError("no weights")


class FastPair:
    __slots__ = ()  # no instance takes another attribute
    contract = Contract(arrays="numpy", image_height=32, image_width=32, feature_dim=1)

    def encode_visual(self, image):
        return image.mean(axis=(2, 3))[:, :1]

    def predict_fast(self, feature, state, action_history, num_diffusion_steps):
        return np.full((1, 16, 4), feature[0, 0], np.float32)


class RegisteredPair(FastPair):
    def __init__(self):
        self.predict = None  # hides a method of the class

    def __init_subclass__(cls, *, name):
        pass
"""


@pytest.fixture
def mine(folder: Path) -> str:
    (folder / "mine.py").write_text(MINE)
    return "./mine.py"


@pytest.fixture
def odd(folder: Path) -> Callable[[str], str]:
    """Write a class Odd behind those of ``MINE``; returns its ``--policy``."""

    def write(text: str) -> str:
        (folder / "mine.py").write_text(f"{MINE}\n\n{text}\n")
        return "./mine.py:Odd"

    return write


def returning(chunk: str, arguments: str = "image, state, history, steps") -> str:
    """Return the text of a class Odd that answers with a chunk."""
    return f"class Odd(Single): predict = lambda self, {arguments}: {chunk}"


def closed(name: str) -> int:
    module = next(sys.modules[each] for each in sys.modules if each.endswith("_mine"))
    times: int = getattr(module, name).closed
    return times


@pytest.mark.parametrize(("name", "step"), [("Single", 0.01), ("TorchRemembers", 0.25)])
def test_a_policy_is_reset_after_loading_and_closed_once(mine: str, name: str, step: float) -> None:
    with load(f"{mine}:{name}") as loaded:
        assert [throttle(loaded) for _ in range(2)] == pytest.approx([step, 2 * step])
        loaded.runner.reset()
        assert throttle(loaded) == pytest.approx(step)
        assert closed(name) == 0
    assert closed(name) == 1


def test_a_policy_that_fails_its_trial_or_whose_contract_is_read_is_closed(mine: str) -> None:
    with pytest.raises(PolicyError, match="no weights"):
        load(f"{mine}:FailsTwice")
    assert closed("FailsTwice") == 1
    assert read_policy_contract(PolicyRequest(spec=f"{mine}:Single")).image_height == 32
    assert closed("Single") == 1


def test_a_failure_to_close_is_said_and_hides_no_other(mine: str) -> None:
    with (
        pytest.raises(PolicyError, match=r"failed to close: OSError: no socket \(.*mine\.py"),
        load(f"{mine}:FailsToClose"),
    ):
        pass
    with pytest.raises(ZeroDivisionError) as caught, load(f"{mine}:FailsToClose"):
        raise ZeroDivisionError
    assert "failed to close" in caught.value.__notes__[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("class Odd: predict = Single.predict", "member contract must be.*it is None"),
        ("class Odd: contract = Contract()", "no method predict"),
        ("class Odd(Single): predict = None", "no method predict"),
        ("class Odd(Single): encode_visual = predict_fast = Single.predict", "needs feature_dim"),
        (
            "class Odd(Single): predict = lambda self, state, image, action_history, steps: 0",
            "predict is called with image, state, .* and has state, image, action_h",
        ),
        (
            "class Odd(FastPair): predict_fast = lambda self, state, feature, history, steps: 0",
            "predict_fast is called with feature, .* has state, feature, history",
        ),
        ("class Odd(Single): reset = lambda self, seed: 0", "failed to reset: TypeError"),
        (
            "class Odd(Single): reset = lambda self: [][0]",
            r"failed to reset: IndexError: .*mine.py:",
        ),
        (
            "class Odd(Single): contract = property(lambda self: 1 / 0)",
            r"making it failed: .*mine.py:",
        ),
        ("class Odd(Single): predict = property(lambda self: 1 / 0)", "making it failed"),
        ("class Odd(Single): close = property(lambda self: 1 / 0)", "failed to close"),
        ("class Odd(Single):\n    async def reset(self): pass", "reset is async or a generator"),
        ("class Odd(Single):\n    def close(self): yield", "close is async or a generator"),
        ("class Odd:\n    def __init__(self, weights): pass", r"cannot be made with Class\(\)"),
        (
            returning("torch.nn.Linear(2, 2)(torch.zeros(3))"),
            r"failed on a state: RuntimeError: .*mine.py:",
        ),
        # Which numpy would convert in silence.
        (returning("np.zeros((1, 16, 4), int)"), "an array of int64, and the contract"),
        (returning("np.zeros((1, 16, 4), bool)"), "an array of bool"),
        (returning("np.zeros((1, 16, 4), complex)"), "an array of complex"),
        (returning("np.zeros((1, 16, 4), str)"), "an array of <U"),
        (returning("np.ma.masked_all((1, 16, 4), 'f4')"), "a masked array of float32"),
    ],
)
def test_an_unusable_class_is_refused(odd, text, message):
    with pytest.raises(PolicyError, match=message):
        load(odd(text))


@pytest.mark.parametrize(
    ("name", "flags", "message"),
    [
        ("Single", {"checkpoint": Path("a.pt")}, r"Class\(checkpoint=path\)"),
        ("Single", {"image_size": 64}, "takes 32x32"),
        ("TorchRemembers", {"engine": "openvino"}, r"takes a torch\.nn\.Module"),
        ("Other", {}, "'Single'"),
    ],
)
def test_flags_that_do_not_go_with_a_class_are_refused(mine, name, flags, message):
    with pytest.raises(PolicyError, match=message):
        load(f"{mine}:{name}", **flags)


@pytest.mark.parametrize(
    "arguments",
    [
        "observation, state, history, steps",
        "frame, vehicle, past, steps, rgb=None, *, state=None",
    ],
)
def test_only_inputs_that_are_passed_need_an_order_and_any_may_be_an_observation(odd, arguments):
    spec = odd(returning("np.full((1, 16, 4), 0.5, np.float32)", arguments))
    assert throttle(load(spec)) == 0.5


@pytest.mark.parametrize("name", ["FastPair", "RegisteredPair"])
def test_a_class_of_the_fast_pair_alone_flies_at_both_rates(mine: str, name: str) -> None:
    dual, single = (load(f"{mine}:{name}", dual_rate=is_dual) for is_dual in (True, False))
    assert (dual.runner.dual_rate, single.runner.dual_rate) == (True, False)
    assert throttle(dual) == throttle(single) != 0.0
