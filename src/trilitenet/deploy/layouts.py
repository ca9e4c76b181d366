"""Which layout suits which runtime and processor, as measured (docs/speed.md)."""

from __future__ import annotations

from typing import Final, Literal

from trilitenet.deploy.layers import Columns, Layout
from trilitenet.errors import ConfigError, did_you_mean

__all__ = ["LAYOUTS", "Unit", "pick_layout"]

Unit = Literal["amx", "avx512", "other"]
"""What a processor multiplies with: matrix tiles, vectors of 16 numbers, or narrower ones."""

LAYOUTS: Final[dict[str, Layout]] = {
    "tiles-tiny": Layout(
        columns=Columns(stem=4, front=4, level2=4, quarter=2, half=4, out=8), split=True, shared_image=True
    ),
    "tiles-small": Layout(columns=Columns(stem=4, level2=2, half=4, out=8), split=True),
    "tiles-base": Layout(columns=Columns(stem=4, half=2, out=8), split=True),
    "vectors-tiny": Layout(columns=Columns(quarter=2, half=4, out=8), split=True),
    "vectors-small": Layout(columns=Columns(half=2, out=2), split=True),
    "vectors-base": Layout(columns=Columns(out=2), split=True),
    "pixels": Layout(pointwise=True),
    "planar": Layout(channels_last=False),
    "planar-maximum": Layout(channels_last=False, maximum=True),
    "planar-maximum-heads": Layout(channels_last=False, maximum=True, half=2, split=True),
    "planar-maximum-split": Layout(channels_last=False, maximum=True, split=True),
}
"""Layouts by name: cells of columns for matrix tiles, for vectors, none; and (B, C, H, W) throughout."""


_OPENVINO: Final[dict[Unit, dict[str, str]]] = {
    "amx": {"tiny": "tiles-tiny", "small": "tiles-small", "base": "tiles-base"},
    "avx512": {"tiny": "vectors-tiny", "small": "vectors-small", "base": "vectors-base"},
    "other": {"tiny": "vectors-small", "small": "vectors-base", "base": "vectors-base"},
}
"""OpenVINO's layout for a processor, a variant."""


def pick_layout(name: str, variant: str, runtime: str, *, unit: Unit = "other") -> Layout:
    """Return a layout.

    Args:
        name: A key of `LAYOUTS`, or ``"auto"``.
        variant: ``"tiny"``, ``"small"`` or ``"base"``.
        runtime: ``"openvino"``, ``"onnxruntime"``, ``"torch-cpu"``, ``"torch-cuda"``, or another, which gets the planar
            one.
        unit: The processor's, by which OpenVINO's layout goes: the wider, the cheaper the further arithmetic of wide
            cells.

    Raises:
        ConfigError: If the name is unknown.
    """
    if name != "auto":
        if name not in LAYOUTS:
            raise ConfigError(f"unknown layout {name!r}{did_you_mean(name, [*LAYOUTS, 'auto'])}")
        return LAYOUTS[name]
    if runtime == "onnxruntime":
        return LAYOUTS["planar-maximum-split" if variant == "base" else "planar-maximum-heads"]
    if runtime == "torch-cuda":
        return LAYOUTS["pixels"]
    if runtime == "torch-cpu":
        return LAYOUTS[f"vectors-{variant}"]
    if runtime != "openvino":
        return LAYOUTS["planar"]
    return LAYOUTS[_OPENVINO[unit][variant]]
