"""Fixtures every test may use: fixed seeds, a generator, and the driving frames where they are at hand."""

from __future__ import annotations

import os
import random
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from tests.artefacts import Artefacts

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def _seeds() -> None:
    """Seed every global generator, so that a test's outcome never hangs on the order of the tests."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - libraries under test still draw from it
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def driving() -> Path:
    """Root of the driving frames in the published layout; skips where they are absent.

    ``TRILITENET_DATA`` names another place than ``../shared/driving``.
    """
    root = Path(os.environ.get("TRILITENET_DATA", ROOT.parent / "shared" / "driving"))
    if not (root / "images").is_dir():
        pytest.skip("the driving frames are not here; TRILITENET_DATA names their folder")
    return root


@pytest.fixture(scope="session")
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> Artefacts:
    """Exported files of a small network; skips where the runtimes are absent."""
    from tests.artefacts import shared_artefacts

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # which the processes share
    return shared_artefacts(folder / "artefacts")


@pytest.fixture(scope="session", autouse=True)
def _large_signal_stack() -> None:
    """Load OpenVINO's CPU plugin before anything else does, and keep it.

    pytest's faulthandler gives the process a stack for signals that is too small once matrix tiles (AMX) are in use.
    A core of OpenVINO brings a larger one, allows the tiles and, when it goes, gives back the small one: the next
    signal that Python handles would end the process. The first core of a process stays here, see `openvino_core`.
    """
    try:
        import openvino
    except ImportError:
        return
    from trilitenet.inference.openvino_backend import openvino_core

    openvino_core(openvino).get_property("CPU", "FULL_DEVICE_NAME")
