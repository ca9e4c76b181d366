from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps

from trilitenet.errors import InputError, ShapeError
from trilitenet.processing.images import read_image, to_rgb


def gradient(height: int = 40, width: int = 60) -> np.ndarray:
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, width, dtype=np.uint8)
    image[..., 1] = np.linspace(0, 255, height, dtype=np.uint8)[:, None]
    return image


def encoded(image: Image.Image, format: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format, **options)
    return buffer.getvalue()


def test_colours_are_rgb(tmp_path: Path) -> None:
    Image.new("RGB", (32, 16), (250, 10, 20)).save(tmp_path / "red.png")
    Image.new("RGB", (32, 16), (250, 10, 20)).save(tmp_path / "red.jpg", quality=95)
    for name in ("red.png", "red.jpg"):
        image = read_image(tmp_path / name)
        assert image.shape == (16, 32, 3)
        assert image[..., 0].min() > 240
        assert image[..., 2].max() < 40


def test_kinds_of_png_agree() -> None:
    rgb = gradient()
    alpha = np.dstack([rgb, np.full(rgb.shape[:2], 128, np.uint8)])
    np.testing.assert_array_equal(read_image(encoded(Image.fromarray(rgb), "PNG")), rgb)
    np.testing.assert_array_equal(read_image(encoded(Image.fromarray(alpha), "PNG")), rgb)
    np.testing.assert_array_equal(read_image(Image.fromarray(rgb)), rgb)
    grey = rgb[..., 0]
    np.testing.assert_array_equal(read_image(encoded(Image.fromarray(grey), "PNG")), np.dstack([grey] * 3))
    deep = grey.astype(np.uint16) * 257
    np.testing.assert_array_equal(read_image(encoded(Image.fromarray(deep), "PNG")), np.dstack([grey] * 3))
    palette = Image.fromarray(np.full((8, 8, 3), (0, 200, 0), np.uint8)).convert("P")
    assert read_image(encoded(palette, "PNG"))[0, 0, 1] > 180


@pytest.mark.parametrize(("orientation", "turns"), [(3, 2), (6, 3), (8, 1)])
def test_the_rotation_in_exif_is_applied(orientation: int, turns: int) -> None:
    upright = gradient(48, 64)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = Image.fromarray(np.ascontiguousarray(np.rot90(upright, -turns)))
    data = encoded(stored, "JPEG", exif=exif, quality=100, subsampling=0)
    image = read_image(data)
    assert image.shape == upright.shape
    assert np.abs(image.astype(int) - upright).max() <= 8


@pytest.mark.parametrize("orientation", range(1, 9))
def test_all_orientations_agree_with_pillow(orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encoded(Image.fromarray(gradient()), "PNG", exif=exif)
    upright = ImageOps.exif_transpose(Image.open(io.BytesIO(data)))
    np.testing.assert_array_equal(read_image(data), np.asarray(upright))


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="the most memory cannot be measured here")
@pytest.mark.parametrize(
    ("mode", "format", "most"), [("RGB", "JPEG", 11), ("RGBA", "PNG", 11), ("I;16", "PNG", 11), ("RGBA", "WEBP", 18)]
)
def test_reading_takes_few_copies(tmp_path: Path, mode: str, format: str, most: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / "large"
    Image.new(mode, (3000, 2000)).save(path, format, exif=exif)
    script = """
import sys
from pathlib import Path
from trilitenet.processing.images import read_image

def memory(name):
    return next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if name in line)

data = Path(sys.argv[1]).read_bytes()
Path("/proc/self/clear_refs").write_text("5")
before = memory("VmRSS")
assert read_image(data).shape == (3000, 2000, 3)
print(1024 * (memory("VmHWM") - before) / 6_000_000)
"""
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    assert 3 < float(done.stdout) <= most


def test_other_tags_in_exif_do_not_matter() -> None:
    tags = struct.pack("<HHII", 0x0112, 3, 1, 6)  # to be turned
    tags += struct.pack("<HHI4s", 0x011A, 2, 3, b"72\0")  # XResolution as text, which is not allowed
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 2) + tags + struct.pack("<I", 0)
    assert read_image(encoded(Image.fromarray(gradient(40, 60)), "JPEG", exif=exif)).shape == (60, 40, 3)
    damaged = b"Exif\0\0" + b"no TIFF at all"
    assert read_image(encoded(Image.fromarray(gradient(40, 60)), "JPEG", exif=damaged)).shape == (40, 60, 3)


def test_broken_files_are_named(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    jpeg, png = encoded(Image.fromarray(noise), "JPEG"), encoded(Image.fromarray(noise), "PNG")
    broken = {
        "truncated.jpg": jpeg[: len(jpeg) // 2],
        "header.jpg": jpeg[:20],
        "truncated.png": png[: len(png) // 2],
        "damaged.png": png[:60] + bytes(40) + png[100:],
        "text.jpg": b"not an image\n",
        "empty.png": b"",
    }
    for name, data in broken.items():
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(InputError, match=name):
            read_image(path)
    with pytest.raises(InputError, match="no such file"):
        read_image(tmp_path / "absent.jpg")
    with pytest.raises(InputError, match=r"cannot be read \(Is a directory\)"):
        read_image(tmp_path)


def test_arrays() -> None:
    rgb = gradient()
    assert np.shares_memory(to_rgb(rgb), rgb)
    assert to_rgb(rgb[..., ::-1]).flags.c_contiguous
    np.testing.assert_array_equal(to_rgb(rgb[..., :1]), to_rgb(rgb[..., 0]))
    for wrong in (np.zeros((4, 4, 5), np.uint8), np.zeros((0, 4, 3), np.uint8), np.zeros(4, np.uint8)):
        with pytest.raises(ShapeError, match="height, width, 3"):
            read_image(wrong)
    with pytest.raises(ShapeError, match="uint8"):
        read_image(np.zeros((4, 4, 3), np.float32))


@pytest.mark.parametrize("values", [[0.0, 0.5, 1.0], [0.0, np.nan, 200.0], [0.0, np.inf, 1.0]])
def test_fractions_are_refused_not_taken_for_black(values: list[float]) -> None:
    with pytest.raises(InputError, match=r"^the image: holds fractions .* scale it to 0 \.\. 255"):
        read_image(encoded(Image.fromarray(np.array([values], np.float32)), "TIFF"))


def test_photos_of_phones_are_read_and_turned_once() -> None:
    pytest.importorskip("pi_heif")
    path = Path(__file__).with_name("photo.heic")  # 64 wide and 48 high, upright, though its EXIF says turned
    image = read_image(path)
    assert image.shape == (48, 64, 3)
    for row, column, colour in ((5, 5, (220, 30, 30)), (5, 58, (30, 200, 30)), (42, 5, (30, 30, 220))):
        np.testing.assert_allclose(image[row, column], colour, atol=12)
    np.testing.assert_array_equal(read_image(path.read_bytes()), image)
    for broken in (path.read_bytes()[:-100], b"\0\0\0\x18ftypheic" + bytes(100)):
        with pytest.raises(InputError, match="the image: is not an image that can be read"):
            read_image(broken)


def test_photos_of_phones_are_named_with_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    path = Path(__file__).with_name("photo.heic")
    with pytest.raises(InputError, match=r"photo\.heic: this needs 'pi_heif' .*\[heic\]'; or save it as JPEG$"):
        read_image(path)


def test_an_image_without_pixels_is_refused() -> None:
    with pytest.raises(InputError, match="the image: has no pixels"):
        read_image(Image.new("RGB", (0, 4)))


@pytest.mark.parametrize("image", [None, 3, bytearray(b"x"), object()])
def test_what_is_no_image_is_refused(image: Any) -> None:
    with pytest.raises(ShapeError, match="an image is a path, bytes, a PIL image or an array"):
        read_image(image)


def test_a_path_that_cannot_be_is_no_file() -> None:
    with pytest.raises(InputError, match="no such file"):
        read_image("a\0b")


def test_dark_16_bit_grey_stays_dark() -> None:
    dark = np.full((4, 6), 200, np.uint16)
    dark[0, 0] = 255
    np.testing.assert_array_equal(read_image(encoded(Image.fromarray(dark), "PNG"))[1:], 1)


def test_a_palette_with_transparency_is_read_without_a_word(recwarn: pytest.WarningsRecorder) -> None:
    picture = Image.new("P", (4, 3), 1)
    picture.putpalette([9, 8, 7, 30, 60, 90])
    picture.info["transparency"] = b"\x00\x80"
    file = io.BytesIO()
    picture.save(file, "PNG")
    for given in (file.getvalue(), picture):
        assert (read_image(given) == (30, 60, 90)).all()
    assert picture.info["transparency"] == b"\x00\x80"
    assert not recwarn.list
