from __future__ import annotations

import numpy as np
import pytest

from trilitenet.deploy.quantize import quantize_onnx
from trilitenet.errors import ConfigError, OutputError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def test_no_room_for_temporary_files_is_told(no_room: str) -> None:
    with pytest.raises(OutputError, match=no_room):
        quantize_onnx(onnx.ModelProto(), [np.zeros((1, 32, 32, 3), np.uint8)])


def test_frames_are_needed() -> None:
    with pytest.raises(ConfigError, match="INT8 needs calibration frames"):
        quantize_onnx(onnx.ModelProto(), [])
