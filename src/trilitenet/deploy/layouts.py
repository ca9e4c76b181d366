"""Which layout suits which runtime and processor, as measured (docs/speed.md)."""

from __future__ import annotations

from typing import Final

from trilitenet.deploy.layers import Columns, Layout
from trilitenet.errors import ConfigError, did_you_mean

__all__ = ["LAYOUTS", "pick_layout"]

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


def pick_layout(name: str, variant: str, runtime: str, *, amx: bool) -> Layout:
    """Return a layout.

    Args:
        name: A key of `LAYOUTS`, or ``"auto"``.
        variant: ``"tiny"``, ``"small"`` or ``"base"``.
        runtime: ``"openvino"``, ``"onnxruntime"``, ``"cuda"`` (PyTorch), or another, which gets the planar one.
        amx: Whether the processor has matrix tiles, which make the further arithmetic of wide cells nearly free.

    Raises:
        ConfigError: If the name is unknown.
    """
    if name != "auto":
        if name not in LAYOUTS:
            raise ConfigError(f"unknown layout {name!r}{did_you_mean(name, [*LAYOUTS, 'auto'])}")
        return LAYOUTS[name]
    if runtime == "onnxruntime":
        return LAYOUTS["planar-maximum-split" if variant == "base" else "planar-maximum-heads"]
    if runtime == "cuda":
        return LAYOUTS["pixels"]
    if runtime != "openvino":
        return LAYOUTS["planar"]
    return LAYOUTS[f"{'tiles' if amx else 'vectors'}-{variant}"]
