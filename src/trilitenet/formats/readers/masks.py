"""Plain mask pictures: an image, and beside it one picture a task whose values or colours a YAML file explains."""

from __future__ import annotations

from pathlib import Path

from trilitenet.config import TASKS
from trilitenet.data.reading import check_root, is_image_file
from trilitenet.data.records import ImageRecord, ListedRecords, MaskFile
from trilitenet.errors import DataError
from trilitenet.formats.readers.mapping import LabelMapping, MaskRule

__all__ = ["read_masks"]


def read_masks(root: str | Path, mapping: LabelMapping | None = None) -> ListedRecords:
    """Read a data set of images and mask pictures.

    Args:
        root: The data set's folder.
        mapping: Where images and masks are, and what the values mean; see `MaskRule`.

    Raises:
        DataError: If there are no images, or no mask of any.
        ConfigError: If the values are wrong.
    """
    mapping = mapping or LabelMapping()
    root = Path(root)
    check_root(root)
    records: dict[str, list[ImageRecord]] = {}
    found = []
    tasks = mapping.tasks or TASKS
    split_free = "{split}" not in mapping.images
    for split in (mapping.split,) if split_free else mapping.splits:
        folder = root / mapping.images.format(split=split)
        if not folder.is_dir():
            continue
        items = [
            ImageRecord(
                name=path.stem,
                image=path,
                drivable=_mask(root, mapping.drivable_mask, split, path.stem) if "drivable" in tasks else None,
                lane=_mask(root, mapping.lane_mask, split, path.stem) if "lane" in tasks else None,
            )
            for path in sorted(folder.iterdir())
            if is_image_file(path.name)
        ]
        if items:
            records[split] = items
            drivable = sum(item.drivable is not None for item in items)
            lane = sum(item.lane is not None for item in items)
            found.append(f"{split}: {len(items)} images, {drivable} drivable masks, {lane} lane masks")
    if not records:
        raise DataError(f"{root}: no images in {mapping.images!r} for the splits {', '.join(mapping.splits)}")
    if all(item.drivable is None and item.lane is None for items in records.values() for item in items):
        places = [getattr(mapping, f"{task}_mask").path for task in ("drivable", "lane") if task in tasks]
        raise DataError(
            f"{root}: no mask of any image at {' or '.join(places)}; say where they are with --classes FILE"
        )
    return ListedRecords(records, tuple(found), mapping.origin("masks", root))


def _mask(root: Path, rule: MaskRule, split: str, name: str) -> MaskFile | None:
    path = root / rule.path.format(split=split, name=name)
    return MaskFile(path, rule.meanings()) if path.is_file() else None
