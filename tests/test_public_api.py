"""The public names are frozen here: a change of this list is a decision, and goes into CHANGELOG.md."""

from __future__ import annotations

import subprocess
import sys

import pytest

import trilitenet
from trilitenet import errors

PUBLIC = {
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
}


def test_public_names_are_frozen() -> None:
    assert set(trilitenet.__all__) == PUBLIC
    assert list(trilitenet.__all__) == sorted(trilitenet.__all__)


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_public_name_loads(name: str) -> None:
    assert getattr(trilitenet, name) is not None
    assert name in dir(trilitenet)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        trilitenet.lode  # type: ignore[attr-defined]  # noqa: B018


def test_every_error_is_a_trilitenet_error() -> None:
    raised = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, Exception)]
    assert len(raised) >= 10
    assert all(issubclass(error, errors.TriLiteNetError) for error in raised)
    assert {error.__name__ for error in raised} <= set(errors.__all__)


def loaded_by(statement: str) -> set[str]:
    """Return the top-level modules in a fresh interpreter after ``statement``."""
    script = f"import sys\n{statement}\nprint(' '.join({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)
    return set(done.stdout.split())


HEAVY = {"torch", "av", "openvino", "onnxruntime", "onnx", "lightning_fabric", "matplotlib", "scipy", "fastapi"}


LIGHT = """
import trilitenet; trilitenet.__version__; dir(trilitenet); trilitenet.Perception; trilitenet.Boxes
import trilitenet.apps.cli
import trilitenet.inference.predictor
import trilitenet.processing.postprocess, trilitenet.processing.drawing, trilitenet.processing.serialise
"""


def test_light_imports_load_nothing_heavy() -> None:
    assert not loaded_by(LIGHT) & HEAVY


def test_the_check_can_fail() -> None:
    assert "torch" in loaded_by("import trilitenet; trilitenet.build_network")
