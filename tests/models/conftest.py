"""The deterministic checkpoint in the published layout: values depend on a key's name and shape alone."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

GOLDEN = Path(__file__).parent / "golden"


def _values(key: str, shape: list[int], dtype: str) -> NDArray[Any]:
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:4], "little")
    random = np.random.RandomState(seed)
    if dtype == "int64":
        return np.array(100, dtype=np.int64)
    if key.endswith("running_var"):
        return np.asarray(random.uniform(0.6, 1.4, shape), np.float32)
    if key.endswith("running_mean"):
        return np.asarray(random.normal(0, 0.1, shape), np.float32)
    if len(shape) == 1:
        one_dimensional = random.uniform(0.2, 1.0, shape) if key.endswith(".weight") else random.normal(0, 0.1, shape)
        return np.asarray(one_dimensional, np.float32)
    fan = int(np.prod(shape[1:])) or 1
    return np.asarray(random.normal(0, 1, shape) * np.sqrt(1.5 / fan), np.float32)


@pytest.fixture(scope="session")
def golden() -> dict[str, NDArray[Any]]:
    with np.load(GOLDEN / "tiny.npz") as arrays:
        return dict(arrays)


def published_state(variant: str, golden: dict[str, NDArray[Any]]) -> dict[str, Tensor]:
    keys = json.loads((GOLDEN / f"{variant}.keys.json").read_text())
    state = {}
    for key, (shape, dtype) in keys.items():
        name = key.rpartition(".")[2]
        array = golden[name] if name in {"anchors", "anchor_grid"} else _values(key, shape, dtype)
        state[key] = torch.from_numpy(array.copy())
    return state
