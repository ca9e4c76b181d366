"""Checkpoints: all that a run needs to go on as if it had never stopped, written atomically."""

from __future__ import annotations

import os
import pickle
import random
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from trilitenet.errors import OutputError, WeightsError, replacing

__all__ = ["CHECKPOINT_SCHEMA", "random_state", "read_checkpoint", "set_random_state", "write_checkpoint"]

CHECKPOINT_SCHEMA: Final = 1
"""Version of the layout; a checkpoint of a newer one is refused."""

_KEYS: Final[dict[str, type | tuple[type, ...]]] = {
    "config": dict,
    "classes": int,
    "data": (dict, type(None)),
    "step": int,
    "network": dict,
    "ema": (dict, type(None)),
    "optimiser": dict,
    "loss": dict,
    "scaler": dict,
    "best": dict,
    "metrics": dict,
    "stale": int,
    "ended": int,
    "random": dict,
}
"""What every checkpoint holds, and its types."""


def write_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write a checkpoint so that the file is at any time either the old or the new one, whole.

    Args:
        path: Where to; a checkpoint that is there is replaced in one step, once the new one is on the disk.
        state: Plain values and tensors; `read_checkpoint` asks for the keys that the trainer writes.

    Raises:
        OutputError: If it cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, part.open("wb") as file:
            torch.save({"schema": CHECKPOINT_SCHEMA, **state}, file)
            file.flush()
            os.fsync(file.fileno())
    except (OSError, RuntimeError) as error:
        # Where the disk is full, PyTorch's own error comes on top of the one that says so.
        reason = error.__context__ if isinstance(error.__context__, OSError) else error
        raise OutputError(f"{path}: cannot write the checkpoint ({reason})") from error


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint; nothing in the file is run.

    Raises:
        WeightsError: If it is missing, broken, foreign or of a newer layout.
    """
    path = Path(path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such checkpoint to resume from")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (
        OSError, RuntimeError, EOFError, ValueError, LookupError, AttributeError, TypeError, pickle.UnpicklingError,
    ) as error:  # fmt: skip
        raise _foreign(path) from error
    if not isinstance(state, dict) or not isinstance(state.get("schema"), int):
        raise _foreign(path)
    if state["schema"] > CHECKPOINT_SCHEMA:
        raise WeightsError(
            f"{path}: checkpoint layout {state['schema']} is newer than this version; upgrade trilitenet"
        )
    for key, kind in _KEYS.items():
        if key not in state or not isinstance(state[key], kind):
            what = "of the wrong type" if key in state else "missing"
            raise _foreign(path, f" ({key!r} is {what})")
    return state


def _foreign(path: Path, why: str = "") -> WeightsError:
    return WeightsError(f"{path}: is not a checkpoint of this package, or is damaged{why}; start anew with --overwrite")


def random_state() -> dict[str, Any]:
    """Return the states of all generators a run may use, as plain values and tensors."""
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)  # noqa: NPY002
    version, numbers, extra = random.getstate()
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "numpy": [name, torch.from_numpy(np.asarray(keys, np.int64)), int(position), int(has_gauss), float(gauss)],
        "python": [version, list(numbers), extra],
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state_all()
    return state


def set_random_state(state: dict[str, Any]) -> None:
    """Set what `random_state` returned."""
    torch.set_rng_state(state["torch"])
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    version, numbers, extra = state["python"]
    random.setstate((version, tuple(numbers), extra))
    if "cuda" in state and torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["cuda"])
