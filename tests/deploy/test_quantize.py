from __future__ import annotations

import errno
import os
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest

from trilitenet.deploy.quantize import quantize_onnx
from trilitenet.errors import ConfigError, OutputError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def test_no_room_for_temporary_files_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(
        OutputError, match=rf"^{re.escape(tempfile.gettempdir())}: cannot be written \(No space left on device\)$"
    ):
        quantize_onnx(onnx.ModelProto(), [np.zeros((1, 32, 32, 3), np.uint8)])


def test_frames_are_needed() -> None:
    with pytest.raises(ConfigError, match="INT8 needs calibration frames"):
        quantize_onnx(onnx.ModelProto(), [])
