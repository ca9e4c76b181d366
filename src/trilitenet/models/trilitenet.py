"""TriLiteNet: one encoder, three decoders.

Che and Lam, TriLiteNet: Lightweight Model for Multi-Task Visual Perception (Section III); the arithmetic that the
paper leaves out follows the authors' public code, https://github.com/chequanghuy/TriLiteNet.
"""

from __future__ import annotations

import functools
import numbers
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trilitenet.config import (
    DEFAULT_ANCHORS,
    IMAGE_MEAN,
    IMAGE_STD,
    MAX_STRIDE,
    STRIDES,
    TASKS,
    ModelCard,
    Task,
    check_anchors,
    check_tasks,
    get_variant,
)
from trilitenet.errors import ConfigError, ShapeError, shown
from trilitenet.models.attention import PCAA
from trilitenet.models.blocks import ConvBNPReLU, DepthwiseConv
from trilitenet.models.detection import SPP, DetectionHead, LitePAN, decode_level
from trilitenet.models.encoder import Encoder
from trilitenet.models.segmentation import SegmentationHead

__all__ = ["NetworkOutputs", "TriLiteNet", "build_network", "foreign_layers", "normalise_images"]

AnchorsLike: TypeAlias = Sequence[Sequence[Sequence[float]]] | NDArray[Any] | Tensor
"""(width, height) in input pixels, three a level, as lists or tuples, array or tensor."""


class NetworkOutputs(NamedTuple):
    """Logits of the three tasks; None for a task that the network was not built with.

    Attributes:
        detection: Levels 1/8, 1/16, 1/32: (B, 3, h, w, 5 + classes) each: x, y, w, h, objectness, classes.
        drivable: (B, 2, H, W): background, drivable.
        lane: (B, 2, H, W): background, lane marking.
    """

    detection: tuple[Tensor, Tensor, Tensor] | None
    drivable: Tensor | None
    lane: Tensor | None


class TriLiteNet(nn.Module):
    """The network; build it with `build_network`.

    Attributes:
        variant: ``"tiny"``, ``"small"`` or ``"base"``.
        classes: Number of detection classes.
        tasks: The tasks it was built with.
        blocks: Which of ``"pcaa"``, ``"litepan"`` and ``"spp"`` it has.
        anchors: (3, 3, 2) float32 buffer: width, height in input pixels, a level and anchor.
        card: What is known of its weights.
        built_by: Name of the function that built it; None for `build_network`.
    """

    anchors: Tensor
    card: ModelCard
    built_by: str | None = None

    def __init__(
        self,
        variant: str,
        classes: int,
        tasks: tuple[Task, ...],
        blocks: tuple[str, ...],
        anchors: AnchorsLike,
    ) -> None:
        super().__init__()
        anchors = check_anchors(anchors)
        config = get_variant(variant)
        c0, c1, c2, c3, c4 = config.channels
        self.variant = variant
        self.classes = classes
        self.tasks = tasks
        detects = "detection" in tasks
        segments = "drivable" in tasks or "lane" in tasks
        self.blocks = tuple(name for name in blocks if (segments if name == "pcaa" else detects))

        self.encoder = Encoder(config, deep=detects)
        self.spp = SPP(c4) if detects and "spp" in blocks else None
        self.litepan = LitePAN(c4, c3, paths="litepan" in blocks) if detects else None
        self.detection = DetectionHead(c3, classes) if detects else None
        self.pcaa = PCAA(c4) if segments and "pcaa" in blocks else None
        self.reduce = ConvBNPReLU(c4, c2) if segments else None
        self.drivable = SegmentationHead(c0, c1, c2) if "drivable" in tasks else None
        self.lane = SegmentationHead(c0, c1, c2) if "lane" in tasks else None
        self.register_buffer("anchors", torch.tensor(anchors, dtype=torch.float32))
        self.card = ModelCard(
            variant=variant,
            class_names=("vehicle",) if classes == 1 else tuple(f"class_{i}" for i in range(classes)),
            tasks=tasks,
            blocks=self.blocks,
            anchors=anchors,
        )

    if TYPE_CHECKING:  # that of nn.Module returns Any

        def __call__(self, image: Tensor) -> NetworkOutputs:
            """Return the logits of every task; see `forward`."""

    def forward(self, image: Tensor) -> NetworkOutputs:
        """Return the logits of every task.

        Args:
            image: (B, 3, H, W) RGB, floats normalised by `normalise_images`; H and W multiples of 32.

        Raises:
            ShapeError: If it is another shape, of whole numbers, or no tensor.
        """
        if not isinstance(image, Tensor):
            raise ShapeError(f"the network takes a tensor of (B, 3, H, W), got a {type(image).__name__}")
        if not image.is_floating_point():
            raise ShapeError(
                f"the network takes normalised RGB as floats, got {str(image.dtype).removeprefix('torch.')}; "
                "use trilitenet.models.trilitenet.normalise_images"
            )
        fits = image.ndim == 4 and image.shape[1] == 3 and 0 not in image.shape
        if not fits or image.shape[2] % MAX_STRIDE or image.shape[3] % MAX_STRIDE:
            raise ShapeError(
                f"the network takes (B, 3, H, W) with H and W multiples of {MAX_STRIDE}, got {tuple(image.shape)}; "
                "letterbox the image first"
            )
        features = self.encoder(image)

        detection = None
        if self.detection is not None:
            assert self.litepan is not None
            c5 = self.spp(features.c5) if self.spp is not None else features.c5
            detection = self.detection(self.litepan(features.c3, features.c4, c5))

        drivable = lane = None
        if self.reduce is not None:
            attended = self.pcaa(features.c3) if self.pcaa is not None else features.c3
            f_pcaa = self.reduce(attended)
            if self.drivable is not None:
                drivable = self.drivable(f_pcaa, features.i1, features.i2)
            if self.lane is not None:
                lane = self.lane(f_pcaa, features.i1, features.i2)
        return NetworkOutputs(detection, drivable, lane)

    def decode(self, outputs: NetworkOutputs) -> Tensor:
        """Turn detection logits into boxes.

        Args:
            outputs: What the network returned.

        Returns:
            (B, N, 5 + classes): centre x, centre y, width, height in input pixels, objectness, class probabilities;
            levels 1/8, 1/16, 1/32 in turn, within a level by anchor, row, column.

        Raises:
            ConfigError: If the network was built without detection.
            ShapeError: If it is something else.
        """
        if not isinstance(outputs, NetworkOutputs):
            raise ShapeError(f"decode takes what the network returned (NetworkOutputs), got a {type(outputs).__name__}")
        if outputs.detection is None:
            raise ConfigError("there is nothing to decode: this network was built without the detection task")
        levels = zip(outputs.detection, self.anchors, STRIDES, strict=True)
        return torch.cat([decode_level(logits, anchors, stride) for logits, anchors, stride in levels], 1)


def build_network(
    variant: str,
    classes: int = 1,
    tasks: Sequence[str] = TASKS,
    *,
    pcaa: bool = True,
    litepan: bool = True,
    spp: bool = True,
    anchors: AnchorsLike | None = None,
) -> TriLiteNet:
    """Build the network with fresh random weights.

    Args:
        variant: ``"tiny"``, ``"small"`` or ``"base"`` (Section III-B).
        classes: Number of detection classes.
        tasks: Any of ``"detection"``, ``"drivable"``, ``"lane"``; layers of the others do not exist.
        pcaa: With partial class activation attention (off: the paper's ablation).
        litepan: With LitePAN's two paths (off: only its lateral convolutions).
        spp: With spatial pyramid pooling.
        anchors: (width, height) in input pixels, three a level, as lists, array or tensor; defaults to
            `DEFAULT_ANCHORS`.

    Raises:
        ConfigError: On an unknown variant or task, a class count that is none, or unusable anchors.
    """
    if not isinstance(classes, numbers.Integral) or classes < 1:
        raise ConfigError(f"classes must be how many there are, at least 1, got {shown(classes)}")
    if isinstance(tasks, str) or not isinstance(tasks, Iterable):
        tasks = (tasks,)
    blocks = tuple(name for name, on in (("pcaa", pcaa), ("litepan", litepan), ("spp", spp)) if on)
    return TriLiteNet(
        variant, int(classes), check_tasks(tuple(tasks)), blocks, DEFAULT_ANCHORS if anchors is None else anchors
    )


_KIND: Final = (
    "kernel_size", "stride", "padding", "output_padding", "dilation", "padding_mode", "ceil_mode", "count_include_pad",
    "divisor_override", "eps", "affine", "track_running_stats",
)  # fmt: skip
"""What a layer computes beside its tensors' shapes: attributes that its type alone does not fix."""


def foreign_layers(network: nn.Module) -> list[str]:
    """Name the layers that are not of the kind that `build_network` makes in their place; none if all are.

    Widths and the number of Depth-wise ESP blocks are free: tensors tell them. All else that a layer computes is known
    from `build_network` alone, to a file of weights and to the deploy graph.

    Returns:
        For each such layer its name and what it is, as ``"encoder.pool (MaxPool2d)"``; layers inside one are left out.
    """
    known = _own_layers()
    found: dict[str, str] = {}
    for name, layer in network.named_modules():
        place = re.sub(r"^(encoder\.level[23]\.)\d+", r"\g<1>0", name)
        if "forward" in vars(layer) or _kind(layer) != known.get(place):
            inside = any(name.startswith(f"{outer}." if outer else "") for outer in found)
            if not inside:
                found[name] = f"{name or 'the network'} ({type(layer).__name__})"
    return list(found.values())


@functools.cache
def _own_layers() -> dict[str, tuple[Any, ...]]:
    with torch.device("meta"):
        return {name: _kind(layer) for name, layer in build_network("tiny").named_modules()}


def _kind(layer: nn.Module) -> tuple[Any, ...]:
    grouped = getattr(layer, "groups", 1) > 1 and not isinstance(layer, DepthwiseConv)
    return (
        type(layer),
        grouped,
        getattr(layer, "bias", None) is None,
        *(getattr(layer, name, None) for name in _KIND),
    )


def normalise_images(
    images: Tensor,
    mean: Sequence[float] = IMAGE_MEAN,
    std: Sequence[float] = IMAGE_STD,
) -> Tensor:
    """Normalise RGB pixels: (x / 255 - mean) / std.

    Args:
        images: (B, 3, H, W) uint8 RGB.
        mean: Of RGB / 255, a channel.
        std: Of RGB / 255, a channel.

    Returns:
        (B, 3, H, W) float32, in the memory format of the input.
    """
    scale = torch.tensor([1 / (255 * s) for s in std], device=images.device).view(3, 1, 1)
    shift = torch.tensor([-m / s for m, s in zip(mean, std, strict=True)], device=images.device).view(3, 1, 1)
    return images.to(torch.float32, copy=True).mul_(scale).add_(shift)
