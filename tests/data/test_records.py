from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from trilitenet.data.records import CocoRuns, ImageRecord, ListedRecords, RowRuns, image_size, name_apart
from trilitenet.errors import DataError
from trilitenet.processing.serialise import encode_mask

SIZE = (5, 7)


def test_runs_of_every_kind_agree() -> None:
    mask = np.random.default_rng(0).random(SIZE) < 0.4
    mask[0, 0] = False
    edges = [np.flatnonzero(np.diff(flat.astype(int))) + 1 for flat in (mask.T.reshape(-1), mask.reshape(-1))]
    columns, rows = (tuple(np.diff([0, *edge, mask.size]).tolist()) for edge in edges)
    for runs in (
        CocoRuns("direct", SIZE, columns),
        CocoRuns("direct", SIZE, encode_mask(mask)["counts"]),
        RowRuns("direct", 0, 0, 7, 5, rows),
    ):
        np.testing.assert_array_equal(runs.decode(SIZE), mask)


@pytest.mark.parametrize(
    "runs",
    [
        CocoRuns("direct", SIZE, encode_mask(np.ones((5, 3), np.bool_))["counts"]),
        CocoRuns("direct", SIZE, encode_mask(np.ones((50, 70), np.bool_))["counts"]),
        CocoRuns("direct", SIZE, "zz!!zz"),
        CocoRuns("direct", SIZE, "\u00e9"),
        CocoRuns("direct", SIZE, ""),
        CocoRuns("direct", SIZE, (30, 4)),
        CocoRuns("direct", SIZE, (40, -5)),
        CocoRuns("direct", SIZE, (10**15, 1)),
        CocoRuns("direct", (7, 5), (35,)),
        RowRuns("direct", 0, 0, 2, 2, (5, -1)),
        RowRuns("direct", 0, 0, 2, 2, (3,)),
        RowRuns("direct", 4, 4, -2, -2, (4,)),
        RowRuns("direct", 6, 0, 2, 2, (4,)),
    ],
)
def test_runs_that_do_not_fit_are_refused(runs: CocoRuns | RowRuns) -> None:
    with pytest.raises(DataError):
        runs.decode(SIZE)


@pytest.mark.parametrize("exif", [b"no TIFF at all", b"II*\0"])
def test_a_damaged_exif_leaves_the_size_readable(tmp_path: Path, exif: bytes) -> None:
    Image.new("RGB", (60, 40)).save(tmp_path / "a.png", exif=exif)
    assert image_size(tmp_path / "a.png") == (40, 60)


def test_pillow_does_not_warn_of_large_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("L", (60, 40)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 60 * 40 - 1)  # of twice as many it is an error
    assert image_size(tmp_path / "a.png") == (40, 60)


@pytest.mark.parametrize(
    ("images", "names"),
    [
        (["x/1.jpg", "x/2.jpg"], ["1", "2"]),
        (["x/1.jpg", "y/1.png", "y/2.jpg"], ["x-1", "y-1", "2"]),
        (["a/x/1.jpg", "b/x/1.jpg", "b/y/1.jpg"], ["a-x-1", "b-x-1", "y-1"]),
        (["/1.jpg", "/x/1.jpg"], ["1", "x-1"]),
        (["x/1.jpg", "x/1.png", "y/1.jpg"], ["1", "1", "y-1"]),
        (["x/y-1.jpg", "y/1.jpg", "z/1.jpg"], ["x-y-1", "y-1", "z-1"]),
        (["p/x/1.jpg", "p/x/1.jpg"], ["1"]),
        (["x/A.jpg", "y/a.jpg"], ["x-A", "y-a"]),
        (["x/A.jpg", "x/a.png", "x/b.jpg"], ["A", "a", "b"]),
    ],
)
def test_images_of_one_name_get_their_folders(images: list[str], names: list[str]) -> None:
    assert list(name_apart(map(Path, images)).values()) == names


def test_two_images_of_one_name_are_both_named() -> None:
    records = [ImageRecord("a", Path("one/a.png")), ImageRecord("a", Path("two/a.png"))]
    with pytest.raises(DataError, match=r"one/a\.png and two/a\.png; rename"):
        ListedRecords({"train": records})
    with pytest.raises(DataError, match="listed twice"):
        ListedRecords({"train": records[:1] * 2})
