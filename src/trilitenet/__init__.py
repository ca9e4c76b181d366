"""Light driving perception: vehicles, drivable area and lane lines from one tiny network.

    import trilitenet

    predictor = trilitenet.load("tiny")
    perception = predictor("photo.jpg")
    perception.boxes.xyxy, perception.drivable, perception.lane

Public names are loaded when first used (PEP 562), so that a predictor on ONNX Runtime or OpenVINO never loads PyTorch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from trilitenet.errors import needing_torch

__version__ = "0.1.0"

if TYPE_CHECKING:
    from trilitenet.commands.benchmark import benchmark as benchmark
    from trilitenet.commands.evaluate import evaluate as evaluate
    from trilitenet.commands.export import export as export
    from trilitenet.commands.load import load as load
    from trilitenet.commands.predict import predict as predict
    from trilitenet.commands.train import train as train
    from trilitenet.inference.predictor import Predictor as Predictor
    from trilitenet.models.trilitenet import build_network as build_network
    from trilitenet.models.weights import load_network as load_network
    from trilitenet.structures import Boxes as Boxes
    from trilitenet.structures import Perception as Perception

_PUBLIC = {
    "Boxes": "trilitenet.structures",
    "Perception": "trilitenet.structures",
    "Predictor": "trilitenet.inference.predictor",
    "benchmark": "trilitenet.commands.benchmark",
    "build_network": "trilitenet.models.trilitenet",
    "evaluate": "trilitenet.commands.evaluate",
    "export": "trilitenet.commands.export",
    "load": "trilitenet.commands.load",
    "load_network": "trilitenet.models.weights",
    "predict": "trilitenet.commands.predict",
    "train": "trilitenet.commands.train",
}

__all__ = [
    "Boxes",
    "Perception",
    "Predictor",
    "__version__",
    "benchmark",
    "build_network",
    "evaluate",
    "export",
    "load",
    "load_network",
    "predict",
    "train",
]


if not TYPE_CHECKING:  # or a misspelt name would be Any to type checkers

    def __getattr__(name: str) -> Any:
        if name in _PUBLIC:
            with needing_torch():
                value = getattr(importlib.import_module(_PUBLIC[name]), name)
            globals()[name] = value
            return value
        raise AttributeError(f"module 'trilitenet' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
