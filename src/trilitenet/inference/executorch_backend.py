"""Exported ``.pte`` artefacts on ExecuTorch, whose Python interface takes tensors of PyTorch."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY
from trilitenet.errors import BackendError, WeightsError, import_extra
from trilitenet.inference.backend import check_process, held
from trilitenet.inference.exported import ArtefactBackend, prepare_input, read_metadata

__all__ = ["ExecuTorchBackend"]

_HASH: Final = re.compile(rb"\n" + re.escape(GRAPH_HASH_KEY.encode()) + rb" ([0-9a-f]{64})\Z")
_SILENCE: Final = threading.Lock()
"""Standard error is one for all threads: two that turn it off and on at once would leave it off."""


class ExecuTorchBackend(ArtefactBackend):
    """An artefact of ``trilitenet export --format executorch`` on ExecuTorch, on the CPU.

    Args:
        path: The ``.pte`` file.
        device: ``"auto"`` or ``"cpu"``.
        threads: Threads, one number for the whole process; ExecuTorch's own choice if left out.

    Raises:
        MissingExtraError: If ExecuTorch is not installed.
        WeightsError: If the file is missing, broken or foreign, or of a newer layout.
        BackendError: If the device is not there.
    """

    def __init__(self, path: str | os.PathLike[str], device: str = "auto", *, threads: int | None = None) -> None:
        if device not in ("auto", "cpu"):
            raise BackendError(f"device {device!r}: ExecuTorch runs on the CPU here; use auto or cpu")
        self._path, self._threads = Path(path), threads
        if not self._path.is_file():
            raise WeightsError(f"{self._path}: no such file")
        self._file = self._path.absolute()  # which stays the same where the process changes its folder
        with _unsaid():
            # Not executorch.runtime, which is the same behind 6 seconds of imports for exporting.
            runtime = import_extra("executorch.extension.pybindings._portable_lib", "executorch")
            if threads is not None:
                runtime._unsafe_reset_threadpool(threads)
            data = self._path.read_bytes()
            hashed = _HASH.search(data)
            damaged = f"{self._path}: not a usable ExecuTorch program (damaged, or another file)"
            if hashed is not None and hashlib.sha256(data[: hashed.start()]).hexdigest() != hashed[1].decode():
                raise WeightsError(damaged)
            try:
                program = runtime._load_program_from_buffer(
                    data, program_verification=runtime.Verification.InternalConsistency
                )
                methods = {program.get_method_name(index) for index in range(program.num_methods())}
                if GRAPH_HASH_KEY in methods and hashed is None:  # older programs have neither
                    raise WeightsError(damaged)
                found = {key: program.load_method(key)([])[0] for key in (CARD_KEY, ARTEFACT_KEY) if key in methods}
                self._card, self.info = read_metadata(found, str(self._path))
                # Kept together, for each borrows memory of the one before without keeping it alive.
                self._session: Any = data, program, program.load_method("forward")
            except (RuntimeError, UnicodeError) as error:
                raise WeightsError(damaged) from error
        self._process = os.getpid()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it as what opens it again: its file, which must be there, and its options."""
        return functools.partial(ExecuTorchBackend, self._file, threads=self._threads), ()

    @property
    def name(self) -> str:
        """The runtime, the device and the precision."""
        return f"executorch cpu {self.info.precision}"

    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        session = held(self._session, self._path)
        check_process(self._process)
        return [self._run(session, image) for image in batch]

    def _run(self, session: Any, image: NDArray[np.uint8]) -> Mapping[str, NDArray[Any]]:
        planes = torch.from_numpy(prepare_input(image, self.info))
        with self._lock:  # a method has one set of buffers
            outputs = session[-1]([planes])
        return {task: output.numpy() for task, output in zip(self._card.tasks, outputs, strict=True)}

    def close(self) -> None:
        """Free the program."""
        self._session = None


@contextlib.contextmanager
def _unsaid() -> Iterator[None]:
    """Inside, nothing reaches standard error: ExecuTorch logs there what it looks up, and what is raised as well.

    Standard streams that are closed are opened to nowhere, and stay so: each run of a program looks up how to write to
    both.
    """
    with _SILENCE, contextlib.ExitStack() as stack:
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:
                setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        sys.stderr.flush()
        sink = stack.enter_context(Path(os.devnull).open("w", encoding="utf-8"))
        stack.enter_context(contextlib.redirect_stderr(sink))
        with contextlib.suppress(OSError):  # its number may still be free
            kept = os.dup(2)
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, 2)
            os.dup2(sink.fileno(), 2)
        yield
