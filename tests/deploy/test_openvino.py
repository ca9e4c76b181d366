from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trilitenet.config import ArtefactInfo, ModelCard
from trilitenet.deploy.openvino import save_openvino
from trilitenet.errors import OutputError

openvino = pytest.importorskip("openvino")


def test_what_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.bin").mkdir()
    image = openvino.opset13.parameter([1, 3], np.float32)
    model = openvino.Model([openvino.opset13.relu(image)], [image], "a")
    with pytest.raises(OutputError, match=r"a\.xml: cannot be written .*is there room\?$"):
        save_openvino(model, tmp_path / "a.xml", ModelCard("tiny"), ArtefactInfo("openvino"))
