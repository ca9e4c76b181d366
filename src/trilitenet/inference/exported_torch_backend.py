"""Exported ``.pt2`` artefacts: the deploy graph as a PyTorch program, without the package's own modules."""

from __future__ import annotations

import logging
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, DYNAMIC_SIDES
from trilitenet.errors import ShapeError, WeightsError
from trilitenet.inference.backend import held
from trilitenet.inference.exported import ArtefactBackend, prepare_input, read_metadata
from trilitenet.inference.torch_backend import check_threads, pick_device

__all__ = ["ExportedTorchBackend"]


class ExportedTorchBackend(ArtefactBackend):
    """An artefact of ``trilitenet export --format torch``; one of any size takes sides of 64 to 4096.

    Args:
        path: The ``.pt2`` file.
        device: As `trilitenet.inference.torch_backend.pick_device` takes it; auto is the CPU, for which it was
            exported. On another it is tested for shapes alone.

    Raises:
        WeightsError: If the file is missing, broken or foreign, or of a newer layout.
        BackendError: If the device cannot be used, or the process lacks PyTorch's threads (see `check_threads`).
    """

    def __init__(self, path: str | os.PathLike[str], device: str = "auto") -> None:
        check_threads()
        path = Path(path)
        if not path.is_file():
            raise WeightsError(f"{path}: no such file")
        metadata: dict[str, Any] = {CARD_KEY: "", ARTEFACT_KEY: ""}
        talker = logging.getLogger("torch.export")
        level = talker.level
        talker.setLevel(logging.ERROR)  # of a broken archive it logs a traceback
        try:
            with zipfile.ZipFile(path) as archive:  # PyTorch does not look at its check sums
                wrong = archive.testzip()
            if wrong is not None:
                raise zipfile.BadZipFile(f"{wrong} is damaged")
            program = torch.export.load(path, extra_files=metadata)
        except Exception as error:  # a broken archive fails in many ways
            raise WeightsError(
                f"{path}: not a usable PyTorch program (damaged, of another version of PyTorch, or another file)"
            ) from error
        finally:
            talker.setLevel(level)
        found = {key: value.decode() if isinstance(value, bytes) else value for key, value in metadata.items() if value}
        self._card, self.info = read_metadata(found, str(path))
        self.device = pick_device("cpu" if device == "auto" else device)
        self._path, self._file = path, path.absolute()  # which stays the same where the process changes its folder
        if self.device.type != "cpu":  # the program makes tensors of its own, and checks where its inputs are
            from torch.export.passes import move_to_device_pass  # which few need

            program = move_to_device_pass(program, str(torch.empty(0, device=self.device).device))  # with its number
        self._module: torch.nn.Module | None = program.module()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it as what opens it again: its file, which must be there, and its device."""
        return ExportedTorchBackend, (self._file, str(self.device))

    @property
    def name(self) -> str:
        """The runtime and the device."""
        return f"torch program {self.device}"

    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        module = held(self._module, self._path)
        check_threads()
        height, width = batch.shape[1:3]
        least, most = DYNAMIC_SIDES
        if self.info.size is None and not (least <= min(height, width) and max(height, width) <= most):
            raise ShapeError(
                f"a dynamic .pt2 takes sides from {least} pixels to {most}, got {width}x{height}: use the "
                "weights, or export it with a fixed --size"
            )
        with torch.no_grad():
            return [
                {
                    name: value.cpu().numpy()
                    for name, value in zip(
                        self._card.tasks,
                        module(torch.from_numpy(prepare_input(image, self.info)).to(self.device)),
                        strict=True,
                    )
                }
                for image in batch
            ]

    def close(self) -> None:
        """Free the program."""
        self._module = None
