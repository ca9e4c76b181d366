"""Where a report's figures come from: files by hash, versions, hardware."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import cv2
import numpy as np

import trilitenet
from trilitenet.processing.cores import processor, usable_cores

__all__ = ["describe_hardware", "describe_versions", "hash_files", "peak_memory"]

_RUNTIMES: Final = ("torch", "onnxruntime", "openvino", "ncnn", "executorch", "tensorrt")


def hash_files(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of files' names and contents, in order of name; files that are not there are left out."""
    digest = hashlib.sha256()
    for path in sorted(paths, key=lambda path: path.name):
        if path.is_file():
            digest.update(f"{path.name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
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


def describe_hardware() -> str:
    """Return processor, cores that may be used, and system in a line."""
    return f"{processor()[0]}, {usable_cores()} cores, {platform.system()}"


def peak_memory() -> float:
    """Return the most memory this process has held, in MiB; NaN where the system does not tell."""
    try:
        import resource
    except ImportError:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
