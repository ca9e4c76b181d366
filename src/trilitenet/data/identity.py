"""Which data a run was trained on, so that another is not taken for it; where the data lies makes no difference."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from trilitenet.data.prepared import PreparedDataset
from trilitenet.data.reading import DrivingDataset, MixedDataset, SampleSource

__all__ = ["identify", "parts_of", "tell_apart"]

_LOOKED_AT: Final = 64
"""So many samples, spread evenly over a data set, are looked at."""


def identify(dataset: SampleSource) -> dict[str, Any]:
    """Return classes, and of each part number, names and a sample of the content, as plain values."""
    parts = []
    for part in parts_of(dataset):
        chosen = np.unique(np.linspace(0, len(part) - 1, min(_LOOKED_AT, len(part))).astype(int))
        parts.append(
            {
                "images": len(part),
                "names": hashlib.sha256("\0".join(part.names).encode(errors="surrogateescape")).hexdigest()[:16],
                "kind": type(part).__name__,
                "content": [part.fingerprint(int(index)) for index in chosen],
            }
        )
    return {"classes": list(dataset.class_names), "parts": parts}


def tell_apart(before: Mapping[str, Any], now: Mapping[str, Any], *, strict: bool = False) -> str | None:
    """Return in what two identities differ, or None if they are of one data set.

    Args:
        before: Of `identify`.
        now: Likewise.
        strict: Whether a changed sample makes another data set; otherwise images or labels may have been mended, and
            none of those looked at needs to be the same for it to be another.
    """
    if before["classes"] != now["classes"]:
        return f"the classes {', '.join(before['classes'])}, not {', '.join(now['classes'])}"
    if len(before["parts"]) != len(now["parts"]):
        return f"{len(before['parts'])} data sets, not {len(now['parts'])}"
    for old, new in zip(before["parts"], now["parts"], strict=True):
        if old["images"] != new["images"]:
            return f"{old['images']} images, not {new['images']}"
        if old["names"] != new["names"]:
            return "images of other names"
        if old["kind"] != new["kind"]:  # one has been made of the other, as far as names tell
            continue
        same = [first == second for first, second in zip(old["content"], new["content"], strict=True)]
        if not (all(same) if strict else any(same)):
            return "other images or labels of the same names"
    return None


def parts_of(dataset: SampleSource) -> Iterator[DrivingDataset | PreparedDataset]:
    """Yield the data sets on disk that a source of samples is made of."""
    if isinstance(dataset, MixedDataset):
        for part, _ in dataset.parts:
            yield from parts_of(part)
    elif isinstance(dataset, (DrivingDataset, PreparedDataset)):
        yield dataset
