"""Images in and out of the package's one form: (height, width, 3) uint8 RGB."""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from trilitenet.errors import InputError, MissingExtraError, ShapeError, import_extra
from trilitenet.processing.addresses import as_address

__all__ = ["BROKEN", "no_image", "open_image", "read_image", "to_rgb", "upright_size"]


BROKEN: Final = (OSError, SyntaxError, ValueError, EOFError, IndexError, struct.error, Image.DecompressionBombError)
"""What Pillow's decoders raise on broken files."""

_TURNS: Final[dict[int, Callable[[NDArray[np.uint8]], NDArray[np.uint8]]]] = {
    2: lambda upright: upright[:, ::-1],
    3: lambda upright: upright[::-1, ::-1],
    4: lambda upright: upright[::-1],
    5: lambda upright: upright.swapaxes(0, 1),
    6: lambda upright: np.rot90(upright, 1),
    7: lambda upright: upright.swapaxes(0, 1)[::-1, ::-1],
    8: lambda upright: np.rot90(upright, -1),
}
"""The rows and columns of a file as a view of the upright picture, by the file's orientation in EXIF."""

_SIDEWAYS: Final = frozenset({5, 6, 7, 8})
"""Orientations that exchange width and height."""

_BAND: Final = 64
"""Rows that are converted at once: as a whole, each step would hold a copy of the picture, and wait for memory."""

_HEIF: Final = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
"""Brands of HEIC and HEIF files, the photos of many phones."""


def read_image(image: str | Path | bytes | Image.Image | NDArray[Any]) -> NDArray[np.uint8]:
    """Read an image of any common kind into one form.

    The rotation that a camera noted in EXIF is applied. Grey, palette and CMYK images become RGB, alpha is dropped,
    16-bit grey is scaled to 8 bit. HEIC and HEIF, the photos of many phones, take the extra ``heic``.

    Args:
        image: A path, the bytes of an image file, a Pillow image, or an array as `to_rgb` takes.

    Returns:
        (height, width, 3) uint8 RGB, contiguous.

    Raises:
        InputError: If the file is missing, empty, truncated, or no image.
        ShapeError: If an array is of the wrong shape or type.
    """
    if isinstance(image, np.ndarray):
        return to_rgb(image)
    if isinstance(image, Image.Image):
        return _decode(image, "the image")
    if isinstance(image, bytes):
        name, data = "the image", image
    elif isinstance(image, (str, Path)):
        name = str(image)
        try:
            data = Path(image).read_bytes()
        except (FileNotFoundError, ValueError) as error:  # ValueError: a zero byte in it
            if address := as_address(name):
                raise InputError(f"{address}: is a URL; download it first, or use `trilitenet predict`") from error
            raise InputError(f"{name}: no such file") from error
        except OSError as error:
            raise InputError(f"{name}: cannot be read ({error.strerror or error})") from error
    else:
        raise no_image(image)
    if not data:
        raise InputError(f"{name}: is empty")
    try:
        heif = data[4:8] == b"ftyp" and data[8:12] in _HEIF
        opened = _open_heif(data) if heif else open_image(io.BytesIO(data))
    except MissingExtraError as error:
        raise InputError(f"{name}: {error}; or save it as JPEG") from error
    except BROKEN as error:
        raise InputError(f"{name}: is not an image that can be read ({_reason(error)})") from error
    with opened:
        return _decode(opened, name)


def no_image(value: object) -> ShapeError:
    """Return the error of what is no image, with the cure where there is one."""
    cure = "; pass its .read()" if hasattr(value, "read") else ""
    if hasattr(value, "numpy"):
        cure = "; pass its .numpy() as (height, width, 3) uint8 RGB"
    return ShapeError(f"an image is a path, bytes, a PIL image or an array, got {type(value).__name__}{cure}")


def open_image(file: Path | io.BytesIO) -> Image.Image:
    """Open an image, its pixels not yet decoded, without Pillow's warning of large ones; it refuses the huge itself.

    Raises:
        OSError: Or another of `BROKEN`, if it is not an image that can be read.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(file)


def _open_heif(data: bytes) -> Image.Image:
    """Open the bytes of a HEIC or HEIF file; it is turned by its own means, which EXIF but repeats.

    Raises:
        MissingExtraError: If the extra ``heic`` is not installed.
        ValueError: Or another of `BROKEN`, if it cannot be read.
    """
    picture: Image.Image = import_extra("pi_heif", "heic").open_heif(io.BytesIO(data)).to_pillow()
    return picture


def to_rgb(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Bring an array into the package's form.

    Args:
        array: (height, width, 3) uint8 **RGB** (an OpenCV image is BGR: pass ``image[..., ::-1]``), or with a fourth
            channel, which is dropped, or (height, width) grey.

    Returns:
        (height, width, 3) uint8 RGB, contiguous; the same memory if it was so already.

    Raises:
        ShapeError: If it is none of these.
    """
    if array.dtype != np.uint8:
        raise ShapeError(f"an image must be uint8 in 0 .. 255, got {array.dtype}; scale and convert it first")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.size == 0 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise ShapeError(f"an image must be (height, width, 3) RGB, got {array.shape}")
    if array.ndim == 2:
        return np.repeat(array[..., None], 3, axis=2)
    return np.ascontiguousarray(array[..., :3])


def _decode(image: Image.Image, name: str) -> NDArray[np.uint8]:
    try:
        image.load()
        turned = _orientation(image)
        width, height = image.size
        if not width or not height:
            raise InputError(f"{name}: has no pixels")
        array = np.empty((width, height, 3) if turned in _SIDEWAYS else (height, width, 3), np.uint8)
        rows = _TURNS[turned](array) if turned in _TURNS else array
        if image.mode in {"I", "F"}:
            rows[:] = _scale_deep(np.asarray(image), name, deep=False)
            return array
        for top in range(0, height, _BAND):
            band = image.crop((0, top, width, min(top + _BAND, height)))
            if image.mode.startswith("I;16"):
                rows[top : top + _BAND] = _scale_deep(np.asarray(band), name, deep=True)
            else:
                band.info.pop("transparency", None)  # alpha is dropped; Pillow would warn of a palette's
                rows[top : top + _BAND] = np.asarray(band if band.mode == "RGB" else band.convert("RGB"))
        return array
    except InputError:
        raise
    except BROKEN as error:
        raise InputError(f"{name}: is broken or truncated ({_reason(error)})") from error


def upright_size(image: Image.Image) -> tuple[int, int]:
    """Return the (height, width) px that `read_image` gives, turned as EXIF notes, without decoding the picture."""
    width, height = image.size
    return (width, height) if _orientation(image) in _SIDEWAYS else (height, width)


def _orientation(image: Image.Image) -> Any:
    """Return the orientation that EXIF notes; 1, upright, if EXIF cannot be read: the pixels may be whole."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of damaged tags
            return image.getexif().get(ExifTags.Base.Orientation, 1)
    except (*BROKEN, TypeError):
        return 1


def _scale_deep(grey: NDArray[Any], name: str, *, deep: bool) -> NDArray[np.uint8]:
    """Scale (height, width) grey to 8 bit: from 0 .. 65535 if it is ``deep`` (16 bit) or exceeds 255 anywhere."""
    values = grey.astype(np.float32)
    if not np.isfinite(values).all() or (grey.dtype.kind == "f" and values.size and values.max() <= 1.0):
        raise InputError(f"{name}: holds fractions or no numbers; scale it to 0 .. 255 or 0 .. 65535")
    if deep or (values.size and values.max() > 255):
        values /= 257.0
    return to_rgb(np.clip(np.rint(values), 0, 255).astype(np.uint8))


def _reason(error: BaseException) -> str:
    text = str(error).split("\n", maxsplit=1)[0]
    return "unknown format" if text.startswith("cannot identify image file") else text or type(error).__name__
