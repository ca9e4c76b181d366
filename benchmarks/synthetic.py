"""Contact sheet of synthetic scenes, and how quick they are drawn.

python benchmarks/synthetic.py docs/images/synthetic_scenes.jpg
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from trilitenet.data.contact_sheet import as_perception
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.processing.drawing import draw

COLUMNS, ROWS, TILE = 4, 6, (192, 320)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--frames", type=int, default=100, help="scenes to time")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    scenes = SyntheticScenes(options.seed)
    tiles = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            sample = scenes[row // 2 * COLUMNS + column]
            picture = draw(as_perception(sample, ("vehicle",)), hide=["labels"]) if row % 2 else sample.image
            tiles.append(cv2.resize(picture, TILE[::-1], interpolation=cv2.INTER_AREA))
    sheet = np.vstack([np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)])
    Image.fromarray(sheet).save(options.output, quality=82, optimize=True)
    print(f"{options.output}: {options.output.stat().st_size / 1024:.0f} KiB")
    begin = time.perf_counter()
    for index in range(options.frames):
        scenes[100 + index]
    seconds = time.perf_counter() - begin
    print(f"{options.frames / seconds:.1f} scenes a second at 640x384 on one core")


if __name__ == "__main__":
    main()
