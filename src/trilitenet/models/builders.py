"""Networks with blocks of one's own: the function that builds one, found by its name, run and checked.

The function takes what `trilitenet.build_network` takes and returns a `TriLiteNet`, mostly one that `build_network` has
made, with layers replaced. It is named as ``FILE.py:FUNCTION`` or ``MODULE:FUNCTION``, and run only where it is asked
for: weights tell its name, never the code.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TypeAlias

import torch

from trilitenet.config import STRIDES, check_tasks
from trilitenet.errors import ConfigError, TriLiteNetError, did_you_mean, gist
from trilitenet.models.trilitenet import NetworkOutputs, TriLiteNet, build_network

__all__ = ["Builder", "build_by", "name_of", "telling"]

Builder: TypeAlias = "str | Callable[..., TriLiteNet]"
"""A function that builds a network, or its name: ``"FILE.py:FUNCTION"`` or ``"MODULE:FUNCTION"``."""
_OTHERS: Final = (
    str(Path(__file__).parents[1]),
    str(Path(torch.__file__).parent),
    str(Path(torch.__file__).parents[1] / "nncf"),  # which wraps PyTorch's functions once it is imported
    "<frozen importlib",
)
"""Where code lies that is not the user's: what its path begins with."""


def name_of(builder: Builder) -> str:
    """Return the name of a function that builds a network, by which its weights tell of it."""
    if isinstance(builder, str):
        return builder
    return f"{builder.__module__}:{getattr(builder, '__qualname__', type(builder).__qualname__)}"


def build_by(
    builder: Builder | None,
    variant: str,
    classes: int,
    tasks: Sequence[str],
    *,
    size: tuple[int, int] | None = None,
    **options: Any,
) -> TriLiteNet:
    """Build a network by a function of one's own, and check that it is one.

    Args:
        builder: The function, or its name; None for `build_network`.
        variant: As `build_network` takes it, and so the rest.
        classes: Number of detection classes.
        tasks: The tasks.
        size: (height, width) in pixels of the image that it is tried with; that of the network's card if left out.
        **options: ``pcaa``, ``litepan``, ``spp`` and ``anchors``.

    Returns:
        The network, with the function's name as its ``built_by``.

    Raises:
        ConfigError: If there is no such function, if it or the file raises, or if what it returns is no `TriLiteNet`
            for these classes and tasks, or gives other outputs.
    """
    if builder is None:
        return build_network(variant, classes, tasks, **options)
    name = name_of(builder)
    function = _find(builder) if isinstance(builder, str) else builder
    with telling(name):
        network = function(variant, classes, tasks, **options)
    if not isinstance(network, TriLiteNet):
        raise ConfigError(f"{name}: returned {type(network).__name__}, not a TriLiteNet; begin with build_network")
    tasks = check_tasks(tuple(tasks))
    if (network.classes, network.tasks) != (classes, tasks):
        raise ConfigError(
            f"{name}: built {network.classes} classes and {', '.join(network.tasks)}, asked for were {classes} and "
            f"{', '.join(tasks)}; hand on what it is called with"
        )
    network.built_by = name
    with telling(name):
        _try(network, name, *(size or network.card.input_size))
    return network


@torch.no_grad()
def _try(network: TriLiteNet, name: str, height: int, width: int) -> None:
    """Run a network once, so that what does not fit together is told before there is any work to lose."""
    training = network.training
    with torch.random.fork_rng(devices=()):
        outputs = network.eval()(torch.zeros(1, 3, height, width))
    network.train(training)
    levels = tuple((1, 3, height // stride, width // stride, 5 + network.classes) for stride in STRIDES)
    wanted = {
        "detection": levels if "detection" in network.tasks else None,
        **{task: (1, 2, height, width) if task in network.tasks else None for task in ("drivable", "lane")},
    }
    if not isinstance(outputs, NetworkOutputs):
        raise ConfigError(f"{name}: the network returns {type(outputs).__name__}, not NetworkOutputs")
    for task, shape in wanted.items():
        found = getattr(outputs, task)
        if found is not None:
            found = tuple(tuple(level.shape) for level in found) if task == "detection" else tuple(found.shape)
        if found != shape:
            raise ConfigError(f"{name}: {task} of a {width}x{height} image has the shape {found}, must be {shape}")


def _find(name: str) -> Callable[..., TriLiteNet]:
    place, _, function = name.rpartition(":")
    if not place or not function:
        raise ConfigError(f"network must be FILE.py:FUNCTION or MODULE:FUNCTION, got {name!r}")
    module = _run(Path(place), name) if place.endswith(".py") else _import(place, name)
    found = getattr(module, function, None)
    if not callable(found):
        known = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise ConfigError(f"{name}: there is no function {function!r} in it{did_you_mean(function, known)}")
    return found  # type: ignore[no-any-return]


def _import(place: str, name: str) -> ModuleType:
    with telling(name):
        try:
            return importlib.import_module(place)
        except ModuleNotFoundError as error:
            if not f"{place}.".startswith(f"{error.name}."):
                raise
            raise ConfigError(
                f"{name}: there is no module {error.name!r}; a file is named as FILE.py:FUNCTION"
            ) from error


def _run(path: Path, name: str) -> ModuleType:
    """Run a file as a module, which may import what lies beside it."""
    if not path.is_file():
        raise ConfigError(f"{name}: {path} {'is a folder' if path.is_dir() else 'does not exist'}")
    spec = importlib.util.spec_from_file_location(f"trilitenet_network_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickles look for it there
    beside = str(path.parent.resolve())
    sys.path.insert(0, beside)
    try:
        with telling(name):
            spec.loader.exec_module(module)
    finally:
        sys.path.remove(beside)
    return module


@contextlib.contextmanager
def telling(name: str, *, running: bool = False) -> Iterator[None]:
    """Tell what somebody's code raises in one line: where, in which part of the network, and what.

    Args:
        name: Of the function that builds the network.
        running: Whether other code runs as well, as in training: only errors that come out of the network, or out of
            its backward pass, are told so.

    Raises:
        ConfigError: For any error but those of this package.
    """
    try:
        yield
    except TriLiteNetError:
        raise
    except Exception as error:
        place, part = _origin(error, name)
        if running and part is None:
            raise
        within = f" in {part}:" if part else ""
        raise ConfigError(f"{place}:{within} {type(error).__name__}: {gist(error)}") from error


def _origin(error: Exception, name: str) -> tuple[str, str | None]:
    """Return the last line of somebody's code that led to an error, and in which part of a network of theirs it came.

    Returns:
        ``FILE:LINE``, or ``name`` if no such line led there; and the part's name, ``""`` for the network itself, None
        if the error came from elsewhere.
    """
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}", None
    place, part = name, None
    parts: dict[int, str] = {}
    for frame, line in traceback.walk_tb(error.__traceback__):
        this, code = frame.f_locals.get("self"), frame.f_code
        if not parts and isinstance(this, TriLiteNet) and this.built_by is not None:
            place, parts = name, {id(module): path for path, module in this.named_modules()}
        elif code is torch.autograd.backward.__code__:
            place, part = name, "the backward pass"
        part = parts.get(id(this), part)
        if not code.co_filename.startswith(_OTHERS):
            place = f"{code.co_filename}:{line}"
    return place, part
