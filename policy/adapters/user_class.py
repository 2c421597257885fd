"""User-defined policies: any class with the members of ``policy.protocol``.

package.module:Class   an importable module, or one in the working directory
package:Class          from the package's ``__init__``
path/to/file.py:Class  a file; its folder joins the search path, for imports of neighbouring files
"""

import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from types import ModuleType

from policy.adapters.description import Description, is_ordered
from policy.adapters.interface import Interface
from policy.contract import Contract
from policy.errors import ContractError, PolicyError, user_code, user_line
from policy.files import stand_in, user_path
from policy.protocol import DualRatePolicy, SingleRatePolicy, predict_by_pair

FORMS = (
    "toge[:SIZE][:BACKBONE], scripted[:PROGRAM][:ACTION][:air], "
    "lerobot:DIR, onnx:DIR_OR_FILE, torchscript:FILE, ws://HOST:PORT, package.module:Class or "
    "./file.py:Class"
)
"""Forms of --policy, for error messages."""
_PREDICT = "predict(image, state, action_history, num_diffusion_steps)"
_FAST_PAIR = ("encode_visual", "predict_fast")
OUR_PACKAGES = ("policy", "sitl", "mavbridge")


def check_user_class(spec: str) -> None:
    """Raise PolicyError if the spec cannot name a class. Runs none of the user's code."""
    where, _ = _split(spec)
    if isinstance(where, Path):
        _require_python_file(spec, where)
        return
    package = where.partition(".")[0]
    if package in OUR_PACKAGES:
        raise PolicyError(
            f"--policy {spec}: {package} is a package of mavbridge; a file of that name flies by "
            f"its path: --policy ./{package}.py:{spec.rpartition(':')[2]}"
        )
    with _working_directory():
        is_known = package in sys.modules or importlib.util.find_spec(package) is not None
    if not is_known:
        raise PolicyError(
            f"--policy {spec}: there is no module {package}; put its folder on PYTHONPATH or "
            f"install it, name its file (./file.py:Class), or write {FORMS}"
        )


def load_user_class(spec: str, checkpoint: Path | None, *, seed: int = 0) -> SingleRatePolicy:
    """Import a class that ``check_user_class`` accepts, and create an instance.

    The class may instead name the torch modules of its policy, see ``adapters.modules``. ``seed``
    draws a denoiser's initial noise.
    """
    where, class_name = _split(spec)
    try:
        with user_code(f"importing {where} failed"):
            if isinstance(where, Path):
                module = _import_file(where)
            else:
                with _working_directory():
                    module = importlib.import_module(where)
    except ContractError as error:
        raise PolicyError(f"--policy {spec}: {error}{user_line(error)}") from error
    except PolicyError as error:
        hint = _import_hint(where, error.__cause__)
        raise PolicyError(f"--policy {spec}: {error}; {hint}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        classes = sorted(
            name
            for name, value in vars(module).items()
            if isinstance(value, type)
            and (value.__module__ == module.__name__ or hasattr(value, "predict"))
        )
        raise PolicyError(f"--policy {spec}: no class {class_name} there; it has {classes}")
    with user_code(f"--policy {spec}: making it failed"):  # its members may be properties
        return _instance(spec, found, checkpoint, seed)


@contextmanager
def _working_directory() -> Iterator[None]:
    """Context manager: append the working directory to the module search path.

    Used only to find and import a module that the user named. At any other time a module beside
    weights could run in place of a missing package.
    """
    here = str(Path.cwd())
    is_added = here not in sys.path
    if is_added:
        sys.path.append(here)
    try:
        yield
    finally:
        if is_added:
            sys.path.remove(here)


def _split(spec: str) -> tuple[Path | str, str]:
    """Return (file or package.module, Class); raise PolicyError if ``spec`` has another form."""
    where, colon, class_name = spec.rpartition(":")
    if not colon:
        where, class_name = spec, ""
    is_file = where.endswith(".py") or os.sep in where
    if is_file and not class_name:
        raise PolicyError(f"--policy {spec} names no class: write {where}:Class")
    is_module = all(name.isidentifier() for name in where.split("."))
    if not class_name.isidentifier() or not (is_file or is_module):
        raise PolicyError(f"policy {spec!r} is unknown; write {FORMS}")
    return user_path(where) if is_file else where, class_name


def _require_python_file(spec: str, path: Path) -> None:
    if path.is_file() and path.suffix == ".py":
        return
    there = sorted(each.name for each in path.parent.glob("*.py"))[:8]
    what = "there is no file" if not path.exists() else "not a Python file:"
    raise PolicyError(f"--policy {spec}: {what} {path}; Python files in its folder: {there}")


def _import_file(path: Path) -> ModuleType:
    """Import a file under a unique module name, once per process."""
    resolved = path.resolve()
    folder = str(resolved.parent)
    if folder not in sys.path:
        sys.path.append(folder)  # last: nothing in it can shadow an installed module
    name = f"_policy_file_{sha256(os.fsencode(resolved)).hexdigest()[:8]}_{resolved.stem}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, resolved)
    if spec is None or spec.loader is None:
        raise PolicyError(f"{path} cannot be imported as Python")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _import_hint(where: Path | str, error: BaseException | None) -> str:
    """Return the remedy for a failed import of ``where`` or one of its neighbours."""
    source = Path(error.filename or where if isinstance(error, SyntaxError) else where)
    if (found := stand_in(source)) is not None:
        return f"{source} is {found[0]}: {found[1]}"
    name = error.name if isinstance(error, ImportError) and error.name else ""
    package = name.partition(".")[0]
    if package in OUR_PACKAGES:
        return f"{package} is a package of mavbridge: one of yours needs another name"
    if isinstance(error, ImportError) and "relative import" in str(error):
        return "import its neighbours by their plain names, or name it as package.module:Class"
    if isinstance(error, ModuleNotFoundError):
        return f"install {name} beside mavbridge, or put its folder on PYTHONPATH"
    return "mend that line"


def _instance(spec: str, found: type, checkpoint: Path | None, seed: int) -> SingleRatePolicy:
    arguments: dict[str, Path] = {} if checkpoint is None else {"checkpoint": checkpoint}
    try:
        inspect.signature(found).bind(**arguments)
    except (TypeError, ValueError) as error:
        call = "Class()" if checkpoint is None else "Class(checkpoint=path)"
        raise PolicyError(
            f"--policy {spec}: cannot be made with {call}: {error}; its only argument is the "
            "checkpoint of --checkpoint, if that is given"
        ) from error
    policy: object = found(**arguments)
    has_pair = all(callable(getattr(policy, name, None)) for name in _FAST_PAIR)
    if has_pair and getattr(policy, "predict", None) is None:
        found.predict = predict_by_pair  # type: ignore[attr-defined]
        getattr(policy, "__dict__", {}).pop("predict", None)  # None of the instance hides it
    contract = getattr(policy, "contract", None)
    if isinstance(contract, Contract) and not hasattr(policy, "predict") and "torch" in sys.modules:
        from policy.adapters.modules import adopt_modules  # imports torch

        described = Description(interface=Interface(contract=contract))
        adopted = adopt_modules(f"--policy {spec}", policy, described, seed)
        if adopted is not None:
            return adopted
    if not isinstance(contract, Contract):
        raise PolicyError(
            f"--policy {spec}: its member contract must be a policy.contract.Contract, "
            f"and it is {contract!r}"
        )
    if not isinstance(policy, SingleRatePolicy):
        raise PolicyError(
            f"--policy {spec}: it has no method {_PREDICT}, and not both encode_visual(image) and "
            "predict_fast(feature, state, action_history, num_diffusion_steps); a class of torch "
            "modules has visual_encoder and action_head, or forward"
        )
    _require_order(spec, policy)
    if isinstance(policy, DualRatePolicy) and contract.feature_dim == 0:
        raise PolicyError(f"--policy {spec}: its contract needs feature_dim, F of encode_visual")
    return policy


def _require_order(spec: str, policy: object) -> None:
    """Raise PolicyError if a method names its arguments in another order than they are passed."""
    for method, seen in (("predict", "image"), ("predict_fast", "feature")):
        roles = (seen, "state", "action_history")
        try:
            parameters = inspect.signature(getattr(policy, method)).parameters.values()
        except (AttributeError, TypeError, ValueError):  # no such method, or none in Python
            continue
        passed = [each.name for each in parameters if each.kind is not each.KEYWORD_ONLY]
        names = passed[: len(roles) + 1]
        is_told = not any(name.startswith("obs") for name in names)  # any input may be one
        if is_told and not is_ordered(names, roles):
            raise PolicyError(
                f"--policy {spec}: {method} is called with {', '.join(roles)}, "
                f"num_diffusion_steps in this order, and has {', '.join(names)}: reorder them"
            )
