"""Where a report's figures come from: files by hash, versions, hardware."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import cv2
import numpy as np

import trilitenet
from trilitenet.processing.cores import processor, usable_cores

__all__ = ["describe_hardware", "describe_versions", "gpu_index", "hash_files", "peak_memory"]

_RUNTIMES: Final = ("torch", "onnxruntime", "openvino", "ncnn", "executorch", "tensorrt")
_NVIDIA: Final = Path("/proc/driver/nvidia/gpus")
"""Where NVIDIA's driver tells of GPUs, on Linux."""


def hash_files(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of files' names and contents, in order of name; files that are not there are left out."""
    digest = hashlib.sha256()
    for path in sorted(paths, key=lambda path: path.name):
        if path.is_file():
            line = f"{path.name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n"
            digest.update(line.encode(errors="surrogateescape"))  # a name need not be text
    return digest.hexdigest()


def describe_versions() -> dict[str, str]:
    """Return versions by name; a runtime appears when it is loaded."""
    versions = {
        "trilitenet": trilitenet.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }
    for name in _RUNTIMES:
        if name in sys.modules:
            try:
                versions[name] = importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                versions[name] = "unknown"
    return versions


def describe_hardware(runtime: str) -> str:
    """Return processor, cores that may be used, system, and the GPU of a runtime on one, in a line.

    Args:
        runtime: The runtime and its device, such as ``"torch cuda:1"``.
    """
    index = gpu_index(runtime)
    gpu = None if index is None else _gpu(index)
    return f"{processor()[0]}, {usable_cores()} cores, {platform.system()}" + (f", {gpu}" if gpu else "")


def gpu_index(runtime: str) -> int | None:
    """Return which GPU a runtime is on, as CUDA counts them; None if on none.

    Args:
        runtime: The runtime and its device, such as ``"torch cuda:1"``.
    """
    found = re.search(r"cuda:?(\d*)", runtime)
    return None if found is None else int(found[1] or 0)


def _gpu(index: int) -> str | None:
    """Return the model of a GPU; of all there are where these differ and CUDA's order is not known; None if unknown."""
    torch = sys.modules.get("torch")
    if torch is not None and index < torch.cuda.device_count():
        return str(torch.cuda.get_device_name(index))
    models = []
    for path in sorted(_NVIDIA.glob("*/information")):
        found = re.search(r"^Model:\s*(.+?)\s*$", path.read_text(encoding="utf-8", errors="replace"), re.M)
        models += [found[1]] if found else []
    return " or ".join(dict.fromkeys(models)) or None


def peak_memory() -> float:
    """Return the most memory this process has held, in MiB; NaN where the system does not tell."""
    try:
        import resource
    except ImportError:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
