"""The live preview of overlays: a window of OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import BackendError

__all__ = ["Window", "WindowClosed"]


class WindowClosed(Exception):  # noqa: N818 - a request, not an error
    """The user closed the preview."""


class Window:
    """The live preview; q or Escape ends the run."""

    _TITLE = "trilitenet"

    def __init__(self) -> None:
        try:
            cv2.namedWindow(self._TITLE, cv2.WINDOW_NORMAL)
        except cv2.error as error:
            raise BackendError(
                "this OpenCV has no windows; for --preview: pip uninstall opencv-python-headless, then "
                "pip install opencv-python"
            ) from error

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show (height, width, 3) uint8 RGB.

        Raises:
            WindowClosed: If a key has asked for it.
        """
        cv2.imshow(self._TITLE, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        if cv2.waitKey(1) & 0xFF in (ord("q"), 27):
            raise WindowClosed

    def close(self) -> None:
        """Take it off the screen."""
        cv2.destroyWindow(self._TITLE)
