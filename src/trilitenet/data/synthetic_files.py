"""Synthetic scenes as files in the published layout, which training and evaluation read like any other data set."""

from __future__ import annotations

import contextlib
import functools
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.config import Task
from trilitenet.data.description import (
    DESCRIPTION_FILE,
    DatasetDescription,
    class_table,
    is_folder_name,
    read_description,
    write_description,
)
from trilitenet.data.reading import FOLDERS, IMAGE_FOLDER, label_file, split_folders
from trilitenet.data.sample import Sample
from trilitenet.data.synthetic import LaneLabels, Scene, SyntheticScenes
from trilitenet.errors import Claim, ConfigError, OutputError, replacing, writing
from trilitenet.processing.cores import ProcessPool

__all__ = ["CATEGORIES", "annotation", "write_dataset", "write_sample"]

_LOGGER: Final = logging.getLogger(__name__)

CATEGORIES: Final = ("car", "truck", "bus")
"""Categories of the vehicles that are written."""
_HEAVY: Final = {"truck": "truck", "lorry": "truck", "bus": "bus"}
"""Kind of a vehicle to its category; the others are cars, as BDD100K has it for vans and pick-ups."""


def write_dataset(
    root: str | Path,
    split: str = "train",
    count: int = 100,
    seed: int = 0,
    *,
    size: tuple[int, int] = (384, 640),
    labels: LaneLabels = "lines",
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write scenes in the published layout.

    ``images/{split}/NAME.jpg``, ``det_annotations/{split}/NAME.json`` (BDD100K's form an image, of the categories
    `CATEGORIES`; uncertain vehicles have ``attributes.crowd: true``), ``da_seg_annotations/{split}/NAME.png`` and
    ``ll_seg_annotations/{split}/NAME.png`` (255 = drivable or lane line), and ``dataset.yaml``. The same call goes on
    where one was interrupted; until the split is whole, ``.synthesis-{split}.json`` says of what call it is. A warning
    tells where another split has the scenes of this seed, for then both have the same pictures.

    Args:
        root: Folder to write into.
        split: Name of the split.
        count: How many scenes.
        seed: Their seed; use another one for another split.
        size: (height, width) in pixels.
        labels: How lanes are marked (see `SyntheticScenes`).
        workers: Processes to share the work.
        progress: Called with how many scenes are done, and of how many.

    Raises:
        ConfigError: If ``count`` or ``workers`` is under 1, the seed negative, the size too small, or ``split`` no name
            of one folder.
        DataError: If the folder has a ``dataset.yaml`` that cannot be read.
        OutputError: If the split exists already, whole or of another call, a ``dataset.yaml`` that is there leaves
            vehicles out, a file cannot be written, or the same call is being made elsewhere.
    """
    if count < 1 or workers < 1:
        raise ConfigError(f"count and workers must be at least 1, got {count} and {workers}")
    made = SyntheticScenes(seed, size, count, labels=labels)  # refuses what is wrong before there is a folder
    root = Path(root)
    if not is_folder_name(split):
        raise ConfigError(f"split must be the name of one folder, got {split!r}")
    state = root / f".synthesis-{split}.json"
    call = json.dumps({"seed": seed, "count": count, "size": size, "labels": labels, "categories": CATEGORIES}).encode()
    images = root / IMAGE_FOLDER / split
    if any(images.glob("*")) and not (state.is_file() and state.read_bytes() == call):
        raise OutputError(
            f"{images} is not empty, and not what the same command left when it was interrupted; "
            "choose another folder or split, or remove it"
        )
    present = read_description(root)
    known = {*class_table(present.class_names, present.classes, root), *present.ignore}
    if left_out := [category for category in CATEGORIES if category not in known]:
        raise OutputError(
            f"{root / DESCRIPTION_FILE} leaves out {', '.join(left_out)}: add each to a class or to `ignore` there, "
            "or choose another folder"
        )
    for other in split_folders(root):
        if other.name != split and (other / f"{made.name(0)}.jpg").exists():
            _LOGGER.warning("%s has the scenes of seed %d, too; another seed gives other scenes", other, seed)
    with contextlib.ExitStack() as stack:
        stack.enter_context(writing(root))
        root.mkdir(parents=True, exist_ok=True)
        stack.enter_context(contextlib.closing(Claim(state)))
        with replacing(state) as part:
            part.write_bytes(call)
        for folder in FOLDERS:
            (root / folder / split).mkdir(parents=True, exist_ok=True)
            for part in (root / folder / split).glob(".*.part"):  # of a process that was killed
                part.unlink()
        if not (root / DESCRIPTION_FILE).exists():
            write_description(
                root,
                DatasetDescription(
                    name="synthetic road scenes",
                    classes={"vehicle": CATEGORIES},
                    attributes=("timeofday", "weather", "scene", "source"),
                    licence="MIT, as the generator",
                    source="trilitenet data synthesize; the names of the images hold the seed",  # one a split
                ),
            )
        job = functools.partial(_write_scene, root, split, seed, size, labels, count)
        if workers == 1:
            scenes: Iterator[None] = map(job, range(count))
        else:
            scenes = stack.enter_context(ProcessPool(workers)).map(job, range(count), chunksize=4)
        for done, _ in enumerate(scenes, start=1):
            if progress:
                progress(done, count)
        state.unlink()


def _write_scene(
    root: Path, split: str, seed: int, size: tuple[int, int], labels: LaneLabels, count: int, index: int
) -> None:
    scenes = SyntheticScenes(seed, size, count, labels=labels)
    if not (root / IMAGE_FOLDER / split / f"{scenes.name(index)}.jpg").exists():
        scene = scenes.scene(index)
        write_sample(root, split, scene.sample, _categories(scene))


def _categories(scene: Scene) -> list[str]:
    """Return the category of each box of a scene's sample, then of each ignored one."""
    objects = sorted(scene.truth.objects, key=lambda thing: thing.ignored)
    return [_HEAVY.get(thing.kind, "car") for thing in objects]


def write_sample(root: Path, split: str, sample: Sample, categories: Sequence[str] = ()) -> None:
    """Write one sample; a task that is not labelled has no file.

    The image comes last: should the writing end, by a full disk for example, each image that is there has its labels.

    Args:
        root: Folder of the data set.
        split: Name of the split.
        sample: What to write.
        categories: See `annotation`.
    """
    if sample.boxes is not None:
        with replacing(root / label_file("detection", split, sample.name)) as part:
            part.write_text(json.dumps(annotation(sample, categories), separators=(",", ":")), encoding="utf-8")
    masks: dict[Task, NDArray[np.uint8] | None] = {"drivable": sample.drivable, "lane": sample.lane}
    for task, mask in masks.items():
        if mask is not None:
            with replacing(root / label_file(task, split, sample.name)) as part:
                Image.fromarray((mask > 0).astype(np.uint8) * 255).save(part, format="PNG")
    with replacing(root / IMAGE_FOLDER / split / f"{sample.name}.jpg") as part:
        Image.fromarray(sample.image).save(part, format="JPEG", quality=92)


def annotation(sample: Sample, categories: Sequence[str] = ()) -> dict[str, object]:
    """Return the sample's boxes as BDD100K's per-image JSON.

    Args:
        sample: The boxes.
        categories: The category of each box, then of each ignored one; if left out, all are cars.
    """
    boxes = np.zeros((0, 4), np.float32) if sample.boxes is None else sample.boxes
    every = [(box, False) for box in boxes] + [(box, True) for box in sample.ignored]
    objects = [
        {
            "category": category,
            "id": number,
            "attributes": {"crowd": crowd},
            "box2d": {key: round(float(v), 2) for key, v in zip(("x1", "y1", "x2", "y2"), box, strict=True)},
        }
        for number, ((box, crowd), category) in enumerate(zip(every, categories or ["car"] * len(every), strict=True))
    ]
    return {
        "name": sample.name,
        "attributes": dict(sample.attributes),
        "frames": [{"timestamp": 0, "objects": objects}],
    }
