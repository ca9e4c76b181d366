"""Where and how a run computes: Lightning Fabric for device, precision and processes; signals; non-finite steps."""

from __future__ import annotations

import contextlib
import ctypes
import datetime
import logging
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any, Final

import torch

from trilitenet.errors import BackendError, ConfigError, import_extra

__all__ = ["StopRequest", "keep_freed_memory", "make_fabric", "pick_precision"]

log = logging.getLogger(__name__)

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4
"""Options of glibc's mallopt."""

_PATIENCE: Final = datetime.timedelta(days=1)
"""Processes wait so long for each other."""


def pick_precision(precision: str, device: str) -> str:
    """Return a precision of Lightning Fabric: for ``"auto"`` bf16-mixed where the device computes it natively."""
    if precision != "auto":
        return precision
    if device == "cuda" or (device == "auto" and torch.cuda.is_available()):
        return "bf16-mixed" if torch.cuda.is_bf16_supported() else "16-mixed"
    if device in {"auto", "cpu"} and torch.cpu._is_avx512_bf16_supported():
        return "bf16-mixed"
    return "32-true"


def keep_freed_memory() -> None:
    """Tell glibc to keep freed memory for the next step, which needs the same again: a CPU step is a tenth faster.

    By default every large tensor is mapped anew and its pages are cleared. Other allocators and systems are left alone.
    """
    if not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, 2**28)):
            mallopt(option, value)


def make_fabric(device: str = "auto", precision: str = "auto", **options: Any) -> Any:
    """Return a launched ``lightning_fabric.Fabric``.

    Args:
        device: ``"auto"``, ``"cpu"``, ``"cuda"`` or ``"mps"``.
        precision: See `pick_precision`.
        **options: Further arguments of Fabric (devices, num_nodes, strategy).

    Raises:
        BackendError: If the device is missing.
        ConfigError: If Fabric refuses the combination.
        MissingExtraError: Without the ``train`` extra.
    """
    lightning = import_extra("lightning_fabric", "train")
    if device == "cuda" and not torch.cuda.is_available():
        raise BackendError("no CUDA device is available; use --device cpu or auto")
    if device == "mps" and not torch.backends.mps.is_available():
        raise BackendError("no MPS device is available; use --device cpu or auto")
    accelerator = device
    if device == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    if accelerator == "cpu":
        keep_freed_memory()
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    settings = {"devices": 1, **options}
    if settings["devices"] != 1 or settings.get("num_nodes", 1) != 1:
        # The other processes wait while the first validates, which on a CPU takes longer than the default half an hour.
        strategies = import_extra("lightning_fabric.strategies", "train")
        settings.setdefault("strategy", strategies.DDPStrategy(timeout=_PATIENCE))
    try:
        fabric = lightning.Fabric(accelerator=accelerator, precision=pick_precision(precision, accelerator), **settings)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"device {device!r} with precision {precision!r}: {error}") from error
    fabric.launch()
    return fabric


class StopRequest:
    """Turns SIGINT and SIGTERM into a wish to stop after the step at hand; a second SIGINT interrupts at once.

    A context manager; outside the main thread it watches nothing.

    Attributes:
        signal: The signal that came; None so far.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __bool__(self) -> bool:
        return self.signal is not None

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number
        log.warning("%s: stopping after this step, with a checkpoint", signal.Signals(number).name)
