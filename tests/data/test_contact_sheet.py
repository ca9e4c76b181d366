from __future__ import annotations

import numpy as np

from trilitenet.data.contact_sheet import thumbnail
from trilitenet.data.sample import Sample


def test_ignored_regions_show_on_a_small_picture() -> None:
    sample = Sample("a", np.zeros((720, 1280, 3), np.uint8), ignored=np.array([[320, 160, 960, 480]], np.float32))
    small = thumbnail(sample, ("vehicle",), size=(180, 320))
    assert small[60, 78:83].max() > 100  # the left edge, in grey
    assert small[60, 100:220].max() == 0
