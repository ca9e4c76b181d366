"""Time and memory of ``trilitenet data check`` on many tiny generated images.

python benchmarks/check.py --count 20000
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from trilitenet.data.checking import check_dataset


def write(root: Path, count: int) -> None:
    """Write 64x36 images with boxes and both masks: four fifths train, one fifth val."""
    rng = np.random.default_rng(0)
    for split, share in (("train", count * 4 // 5), ("val", count - count * 4 // 5)):
        for folder in ("images", "det_annotations", "da_seg_annotations", "ll_seg_annotations"):
            (root / folder / split).mkdir(parents=True)
        for index in range(share):
            name = f"{split}_{index:06}"
            noise = rng.integers(0, 256, (5, 8, 3)).astype(np.uint8)
            cv2.imwrite(str(root / f"images/{split}/{name}.jpg"), cv2.resize(noise, (64, 36)))
            mask = np.zeros((36, 64), np.uint8)
            mask[20:, index % 30 : 40] = 255
            cv2.imwrite(str(root / f"da_seg_annotations/{split}/{name}.png"), mask)
            cv2.imwrite(str(root / f"ll_seg_annotations/{split}/{name}.png"), mask[::-1])
            box = {"x1": 5.0, "y1": 5.0, "x2": 25.0 + index % 9, "y2": 20.0}
            content = {
                "name": name,
                "attributes": {"timeofday": "night" if index % 3 else "daytime"},
                "frames": [{"objects": [{"category": "car", "box2d": box}]}],
            }
            (root / f"det_annotations/{split}/{name}.json").write_text(json.dumps(content))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--root", type=Path, help="keep the images here, and take them from there if they exist")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = options.root or Path(folder) / "tiny"
        if not root.is_dir():
            write(root, options.count)
        start = time.perf_counter()
        report = check_dataset(root, workers=options.workers)
        seconds = time.perf_counter() - start
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # The peak of the largest worker; all of them are counted as large.
    worker = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    total = (own + worker * options.workers) / 1024
    print(f"{sum(report.images.values())} images in {seconds:.1f} s, at most {total:.0f} MiB")
    for finding in report.findings:
        print(f"  {finding.kind} {finding.count}: {finding.examples[0]}")


if __name__ == "__main__":
    main()
