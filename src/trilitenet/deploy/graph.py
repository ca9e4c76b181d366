"""The deploy graph: the same function as a network, laid out for speed.

Pixels go in as they are, uint8 and channels-last; boxes come out decoded and masks decided. Everything between is the
network after the exact rewrites of `trilitenet.deploy.rewrites`: no batch normalisation, no pooling of the image, no
sums inside ESP blocks, no transposed convolution at the end (where the layout is channels-last).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.config import DYNAMIC_SIDES, MAX_STRIDE, STRIDES, ArtefactInfo, Masks, ModelCard, Thresholds
from trilitenet.deploy.layers import (
    Activation,
    DepthwiseESPGraph,
    FusedConv,
    FusedTransposedConv,
    Layout,
    SeparableGraph,
    StrideESPGraph,
    columns_before,
    columns_before_doubling,
    concatenate,
    constant,
    depth_to_space,
    fold_block,
    recolumn,
)
from trilitenet.deploy.rewrites import (
    compose_pointwise,
    conv_kernel,
    fold_attention,
    fold_normalisation,
    mask_difference,
    merge_pool_into_stem,
    nest_blocks,
    pad_inputs,
    pool_kernel,
    prelu_slopes,
    reverse_inputs,
    space_to_depth_kernel,
    split_inputs,
    take_outputs,
    transposed_as_pointwise,
    trim_taps,
    upsample_kernel,
)
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.models.attention import BINS, PCAA
from trilitenet.models.detection import DetectionHead, LitePAN
from trilitenet.models.segmentation import SegmentationHead, UpStage
from trilitenet.models.trilitenet import TriLiteNet, foreign_layers
from trilitenet.processing.postprocess import mask_limit

__all__ = ["DeployGraph", "DeployOutputs", "Traceable"]

REDUCED: Final = (torch.float16, torch.bfloat16)


class DeployOutputs(NamedTuple):
    """What the deploy graph returns; None for a task the network lacks.

    Attributes:
        detection: (B, N, 5 + classes) float32: centre x, centre y, width, height in input pixels, objectness, class
            probabilities; levels 1/8, 1/16, 1/32 in turn, within a level by row, column, anchor.
        drivable: (B, scale x H, scale x W), uint8 or float32, see `Masks`.
        lane: Likewise.
    """

    detection: Tensor | None
    drivable: Tensor | None
    lane: Tensor | None


class AttentionGraph(nn.Module):
    """PCAA as batched matrix products over (bins, pixels of a bin, C), see `fold_attention`."""

    def __init__(self, pcaa: PCAA, layout: Layout) -> None:
        super().__init__()
        weights = fold_attention(pcaa)
        self.channels_last = layout.channels_last
        self.maps = constant(weights.maps)
        self.maps_transposed = constant(weights.maps.T)
        self.maps_bias = constant(weights.maps_bias)
        self.nodes = constant(weights.nodes)
        self.nodes_slopes = constant(weights.nodes_slopes)
        self.key = constant(weights.key)
        self.key_bias = constant(weights.key_bias.unsqueeze(1))
        self.fuse = constant(weights.fuse.unsqueeze(0))
        self.fuse_bias = weights.fuse_bias
        self.fuse_slope = weights.fuse_slope
        self.channels = constant(weights.channels)
        self.value = constant(weights.value)
        self.value_bias = constant(weights.value_bias)
        self.act = Activation(weights.out_slopes, maximum=layout.maximum)

    def split(self, x: Tensor) -> Tensor:
        """Return (B, C, H, W) as (B, bins, pixels of a bin, C)."""
        batch, channels, height, width = x.shape
        rows, columns = BINS
        if self.channels_last:
            x = x.permute(0, 2, 3, 1).reshape(batch, rows, height // rows, columns, width // columns, channels)
            return x.permute(0, 1, 3, 2, 4, 5).reshape(batch, rows * columns, -1, channels)
        x = x.reshape(batch * channels * rows, height // rows, columns, width // columns).permute(0, 2, 1, 3)
        return x.reshape(batch, channels, rows * columns, -1).permute(0, 2, 3, 1)

    def merge(self, x: Tensor, height: int, width: int) -> Tensor:
        """Invert `split`."""
        batch, _, _, channels = x.shape
        rows, columns = BINS
        if self.channels_last:
            x = x.reshape(batch, rows, columns, height // rows, width // columns, channels)
            return x.permute(0, 1, 3, 2, 4, 5).reshape(batch, height, width, channels).permute(0, 3, 1, 2)
        x = x.permute(0, 3, 1, 2).reshape(batch * channels * rows, columns, height // rows, width // columns)
        return x.permute(0, 2, 1, 3).reshape(batch, channels, height, width)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block: (B, C, H, W) -> (B, C, H, W)."""
        batch, channels, height, width = x.shape
        bins = BINS[0] * BINS[1]
        pixels = self.split(x)  # (B, bins, R, C)
        weights = F.softmax(torch.matmul(self.maps, pixels.transpose(2, 3)), -1)  # (B, bins, K, R)
        confidence = torch.sigmoid(torch.matmul(pixels.mean(2), self.maps_transposed) + self.maps_bias)
        # Weighted after the reshape: next to the product, OpenVINO 2026.4 fuses the two and computes them wrong in fp32
        # for 128 channels and more.
        local = torch.matmul(weights, pixels).reshape(batch, bins * channels, channels)  # (B, bins K, C)
        local = local * confidence.reshape(batch, bins * channels, 1)
        local = torch.matmul(self.nodes, local.reshape(batch, bins, -1)).reshape(batch, bins, channels, channels)
        local = F.prelu(local, self.nodes_slopes)
        keys = torch.matmul(local, self.key)
        bias = torch.matmul(local, self.key_bias).transpose(2, 3)  # (B, bins, 1, K)
        total = torch.matmul(self.fuse, local.reshape(batch, bins, -1)).reshape(batch, 1, channels, channels)
        total = F.leaky_relu(torch.matmul(total, self.channels) + self.fuse_bias, self.fuse_slope)
        values = torch.matmul(total, self.value) + self.value_bias
        affinity = F.softmax(torch.matmul(pixels, keys.transpose(2, 3)) + bias, -1)  # (B, bins, R, K)
        out: Tensor = x + self.act(self.merge(torch.matmul(affinity, values), height, width))
        return out


class DetectionGraph(nn.Module):
    """SPP, LitePAN, head and decoding: C3, C4, C5 -> (B, N, 5 + classes)."""

    def __init__(self, litepan: LitePAN, spp: nn.Module | None, head: DetectionHead, anchors: Tensor) -> None:
        super().__init__()
        laterals = [conv_kernel(conv) for conv in litepan.laterals]  # type: ignore[arg-type]
        heads = [conv_kernel(conv) for conv in head.convs]  # type: ignore[arg-type]
        self.reduce = None
        if spp is not None:
            self.reduce = FusedConv(conv_kernel(spp.reduce))  # type: ignore[arg-type]
            laterals[2] = compose_pointwise(conv_kernel(spp.expand), laterals[2])  # type: ignore[arg-type]
        self.paths = litepan.paths
        if self.paths:
            self.top_down = nn.ModuleList(SeparableGraph(block) for block in litepan.top_down)  # type: ignore[arg-type]
            self.bottom_up = nn.ModuleList(SeparableGraph(block) for block in litepan.bottom_up)  # type: ignore[arg-type]
            self.smooth = nn.ModuleList(FusedConv(conv_kernel(block.depthwise)) for block in litepan.smooth)  # type: ignore[arg-type]
            heads = [
                compose_pointwise(conv_kernel(block.pointwise), last)  # type: ignore[arg-type]
                for block, last in zip(litepan.smooth, heads, strict=True)
            ]
        else:
            laterals = [compose_pointwise(lateral, last) for lateral, last in zip(laterals, heads, strict=True)]
            heads = []
        self.laterals = nn.ModuleList(FusedConv(kernel) for kernel in laterals)
        self.heads = nn.ModuleList(FusedConv(kernel) for kernel in heads)
        self.values = 5 + head.classes
        # decoded = (a s + b) s + offset, s = sigmoid(logit): xy: 2 stride s; wh: 4 anchor s^2; scores: s.
        square = torch.zeros(len(STRIDES), anchors.shape[1], self.values)
        square[:, :, 2:4] = 4 * anchors
        linear = torch.ones_like(square)
        linear[:, :, 2:4] = 0
        linear[:, :, :2] = 2 * torch.tensor(STRIDES).view(-1, 1, 1)
        self.square = constant(square.flatten(1))
        self.linear = constant(linear.flatten(1))
        # What a step to the next column or row adds: stride to x or y.
        step = torch.zeros(2, len(STRIDES), anchors.shape[1], self.values)
        for axis in range(2):
            step[axis, :, :, axis] = torch.tensor(STRIDES).view(-1, 1)
        self.step = constant(step.flatten(2))

    def forward(self, c3: Tensor, c4: Tensor, c5: Tensor) -> Tensor:
        """Return decoded detections, see `DeployOutputs`."""
        if self.reduce is not None:
            pools = [self.reduce(c5)]
            for _ in range(3):  # stride-1 pools of 5, 9 and 13 are one, two and three pools of 5
                pools.append(F.max_pool2d(pools[-1], 5, stride=1, padding=2))
            c5 = torch.cat(pools, 1)
        p3, p4, p5 = (lateral(c) for lateral, c in zip(self.laterals, (c3, c4, c5), strict=True))
        if self.paths:
            p4 = p4 + F.interpolate(p5, scale_factor=2.0, mode="bilinear", align_corners=False)
            p3 = p3 + F.interpolate(p4, scale_factor=2.0, mode="bilinear", align_corners=False)
            p3, p4, p5 = (block(p) for block, p in zip(self.top_down, (p3, p4, p5), strict=True))
            p4 = self.bottom_up[0](p3, p4)
            p5 = self.bottom_up[1](p4, p5)
            p3, p4, p5 = (
                head(smooth(p)) for head, smooth, p in zip(self.heads, self.smooth, (p3, p4, p5), strict=True)
            )
        return torch.cat([self.decode(level, p) for level, p in enumerate((p3, p4, p5))], 1)

    def decode(self, level: int, logits: Tensor) -> Tensor:
        """Decode one level: (B, anchors x values, h, w) -> (B, h x w x anchors, values)."""
        batch, _, height, width = logits.shape
        # Rows of all values of all columns, so that a processor's vectors are filled.
        logits = logits.permute(0, 2, 3, 1).reshape(batch, height, -1)
        # Sides and centres of boxes do not survive the ten bits of half precision.
        scores = torch.sigmoid(logits.float() if logits.dtype in REDUCED else logits)
        columns = torch.arange(width, dtype=torch.float32, device=logits.device) - 0.5
        rows = torch.arange(height, dtype=torch.float32, device=logits.device) - 0.5
        offset = (columns.view(width, 1) * self.step[0, level]).view(1, -1)
        offset = offset + rows.view(height, 1) * self.step[1, level].repeat(width)
        decoded = (scores * self.square[level].repeat(width) + self.linear[level].repeat(width)) * scores + offset
        return decoded.reshape(batch, -1, self.values)


class UpStageGraph(nn.Module):
    """Transposed convolution x2, concatenation with the image, two 3x3 convolutions; see `Layout`.

    Args:
        stage: The network's.
        layout: How to lay it out.
        columns: Columns that share a cell of its output and of the image; of its input see `columns_before_doubling`.
        block: Side of the pixel blocks of the image and of its output; the input has none.
        before: Channels a pixel in front of those of the image, which are left alone; only where ``layout`` splits.
    """

    def __init__(self, stage: UpStage, layout: Layout, columns: int, block: int = 1, before: int = 0) -> None:
        super().__init__()
        maximum = layout.maximum
        slopes = prelu_slopes(stage.up.act, stage.up.deconv.out_channels)
        self.unblock = 1
        self.up: FusedConv | FusedTransposedConv
        if layout.pointwise or block > 1:
            kernel = transposed_as_pointwise(stage.up.deconv.weight, stage.up.bn)
            self.up = FusedConv(kernel, slopes.repeat(4), maximum=maximum)
            self.unblock = 2 // block
        else:
            self.up = FusedTransposedConv(stage.up.deconv, stage.up.bn, slopes, columns, maximum=maximum)
        cells, blocks = (columns, columns), (block, block)
        kernel, slopes = fold_block(stage.conv1)
        slopes = slopes.repeat(block * block)
        x, image = split_inputs(kernel, len(kernel.weight), 3)
        image = pad_inputs(image, before)
        x, image = (space_to_depth_kernel(part, blocks, blocks) for part in (x, image))
        self.image = None
        if layout.split:
            self.image = FusedConv(image, columns=cells)
        else:
            x = x._replace(weight=torch.cat((x.weight, image.weight), 1))
        self.conv1 = FusedConv(x, slopes, cells, maximum=maximum)
        kernel, slopes = fold_block(stage.conv2)
        kernel = space_to_depth_kernel(kernel, blocks, blocks)
        self.conv2 = FusedConv(kernel, slopes.repeat(block * block), cells, maximum=maximum)

    def forward(self, x: Tensor, image: Tensor) -> Tensor:
        """Map (B, C, H, W) and the image at twice the size to a map of that size; all in cells or blocks."""
        x = self.up(x)
        if self.unblock > 1:
            x = depth_to_space(x, self.unblock)
        x = self.conv1(torch.cat((x, image), 1)) if self.image is None else self.conv1(x, self.image(image))
        out: Tensor = self.conv2(x)
        return out


class MaskGraph(nn.Module):
    """A segmentation head up to the mask.

    Args:
        head: The network's.
        layout: How to lay it out.
        masks: What the mask holds.
        scale: Mask pixels an input pixel, along an axis: 1 or 2.
        threshold: Probability above which a pixel is foreground.
        before: Channels a pixel in front of those of the pooled image at 1/2, which are left alone.
    """

    def __init__(
        self,
        head: SegmentationHead,
        layout: Layout,
        masks: Masks,
        scale: int,
        threshold: float,
        before: int = 0,
    ) -> None:
        super().__init__()
        self.masks = masks
        self.scale = scale
        self.channels_last = layout.channels_last
        self.columns = layout.columns
        self.up1 = UpStageGraph(head.up1, layout, self.columns.quarter)
        self.up2 = UpStageGraph(head.up2, layout, self.columns.half, layout.half, before)
        slopes = prelu_slopes(head.out.act, 2)
        # Decided as the network's rounded probabilities are: between the highest that is not above and the next (at a
        # threshold of 1, which none is above, from nearly 1 on).
        threshold = 0.5 if masks == "probability" else (mask_limit(threshold) + 0.5) / 255
        self.out: FusedConv | FusedTransposedConv
        self.difference, self.enlarge = nn.ModuleList(), nn.ModuleList()
        if not layout.channels_last and layout.half == 1:
            self.out = FusedTransposedConv(head.out.deconv, head.out.bn, slopes, maximum=layout.maximum)
            self.offset = float(mask_difference(1, threshold).bias)
            return
        blocks = (layout.half, layout.half * self.columns.out)  # of pixels a cell, doubled by each step
        kernel = transposed_as_pointwise(head.out.deconv.weight, head.out.bn)
        kernel = nest_blocks(space_to_depth_kernel(kernel, blocks, blocks), blocks)
        self.out = FusedConv(kernel, slopes.repeat(4 * blocks[0] * blocks[1]), maximum=layout.maximum)
        blocks = (2 * blocks[0], 2 * blocks[1])
        kernel = mask_difference(blocks[0] * blocks[1], threshold)
        last = self.difference
        if scale == 2:
            self.difference.append(FusedConv(kernel))
            kernel = nest_blocks(space_to_depth_kernel(upsample_kernel(), blocks, blocks), blocks)
            blocks = (2 * blocks[0], 2 * blocks[1])
            last = self.enlarge
        self.blocks = blocks
        # In cells of columns each row of a block comes from a convolution of its own.
        outputs = torch.arange(len(kernel.weight)).view(blocks[0] if self.columns.out > 1 else 1, -1)
        last.extend(FusedConv(trim_taps(take_outputs(kernel, row))) for row in outputs)

    def forward(self, x: Tensor, i1: Tensor, i2: Tensor) -> Tensor:
        """Return the mask, (B, scale x H, scale x W) for an input of H x W pixels."""
        columns = self.columns
        x = recolumn(self.up1(x, i2), columns.quarter, columns_before_doubling(columns.half))
        x = recolumn(self.up2(x, i1), columns.half, columns.out)
        if not self.difference:
            x = self.out(x)
            x = x[:, 1:] - x[:, :1] + self.offset
            if self.scale == 2:
                x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            return self.decide(x).squeeze(1)
        x = self.out(x)
        if self.enlarge:
            x = self.difference[0](x)
        parts = [conv(x) for conv in self.enlarge or self.difference]
        batch, _, height, width = x.shape
        block_rows, block_columns = self.blocks
        if not self.channels_last:
            return self.decide(depth_to_space(parts[0], block_rows)).squeeze(1)
        if len(parts) > 1:
            lines = [self.decide(part).permute(0, 2, 3, 1).reshape(batch, height, -1) for part in parts]
            x = torch.cat(lines, 2)
        else:
            x = self.decide(parts[0]).permute(0, 2, 3, 1).reshape(batch, height, width, *self.blocks)
            x = x.permute(0, 1, 3, 2, 4)
        return x.reshape(batch, height * block_rows, width * block_columns)

    def decide(self, x: Tensor) -> Tensor:
        """Turn differences of logits into what the mask holds."""
        if self.masks == "decision" and self.columns.out > 1:  # the same decision, whose clamp OpenVINO fuses
            return x.clamp(0, 1).ceil().to(torch.uint8)
        if self.masks == "decision":
            return (x > 0).to(torch.uint8)
        if self.masks == "probability":
            return (torch.sigmoid(x) * 255).round().to(torch.uint8)
        return x


class DeployGraph(nn.Module):
    """The network as one graph from pixels to decoded boxes and masks.

    It equals the network in float32 to rounding: relative error below 1e-5, and more than 0.99999 of mask pixels.

    Args:
        network: What to rewrite: any variant, tasks, classes, blocks and widths, of the layers that
            `trilitenet.build_network` makes. It is not changed.
        layout: How to lay it out; all layouts compute the same function.
        masks: What a mask holds.
        mask_scale: 2 doubles masks inside the graph (bilinear, before the decision), so that a 1280 x 720 frame on
            a 640 x 384 canvas needs no resizing of masks; not with ``masks="probability"``.
        bgr: Take BGR pixels instead of RGB.
        thresholds: Mask thresholds that "decision" and "logit" use; the card's if left out.

    Raises:
        ConfigError: If the options do not fit each other, or the network has other layers or hooks.
    """

    def __init__(
        self,
        network: TriLiteNet,
        layout: Layout | None = None,
        *,
        masks: Masks = "decision",
        mask_scale: int = 1,
        bgr: bool = False,
        thresholds: Thresholds | None = None,
    ) -> None:
        super().__init__()
        if masks not in get_args(Masks):
            raise ConfigError(f"unknown masks {masks!r}; known: {', '.join(get_args(Masks))}")
        if mask_scale not in (1, 2) or (mask_scale == 2 and masks != "decision"):
            raise ConfigError(f"mask_scale is 1, or 2 with masks='decision'; got {mask_scale} with {masks!r}")
        _check_layers(network)
        thresholds = thresholds or network.card.thresholds
        self.layout = layout = layout or Layout()
        encoder = network.encoder
        maximum = layout.maximum
        columns = layout.columns
        # Channels-last, two neighbours in a row share a cell of the pixels, a mere view: the stem has 6 inputs or more.
        pair = 2 if layout.channels_last else 1

        scale, shift = fold_normalisation(network.card.mean, network.card.std)
        self.scale = constant(scale.flip(0) if bgr else scale)
        self.shift = constant(shift.flip(0) if bgr else shift)

        kernel, slopes = fold_block(encoder.level1)
        wide = len(slopes)
        kernel, slopes = merge_pool_into_stem(kernel, slopes)
        kernel = reverse_inputs(kernel) if bgr else kernel
        self.stem_columns = pair * columns.stem
        self.stem = FusedConv(kernel, slopes, (self.stem_columns, columns.stem), maximum=maximum)
        pool = pool_kernel(3)
        self.i1: FusedConv | None = None
        self.i1_columns = pair * columns.half
        before = wide
        if not layout.shared_image:
            kernel = reverse_inputs(pool) if bgr else pool
            kernel = space_to_depth_kernel(kernel, (1, 1), (layout.half, layout.half))
            self.i1 = FusedConv(kernel, columns=(self.i1_columns, columns.half))
            before = 0
        # The image is pooled again from where it is alone, or else from the stem's outputs.
        self.from_stem = self.i1 is None or layout.half > 1
        self.i2_columns = columns_before(columns.quarter)
        self.i2 = FusedConv(pad_inputs(pool, wide if self.from_stem else 0), columns=(self.i2_columns, columns.quarter))

        kernel, slopes = fold_block(encoder.b1)
        self.b1 = FusedConv(kernel, slopes, (columns.front, columns.front), maximum=maximum)
        self.level2_down = StrideESPGraph(encoder.level2_down, columns.level2, maximum=maximum)
        self.level2 = nn.ModuleList(
            DepthwiseESPGraph(block, columns.level2, maximum=maximum)  # type: ignore[arg-type]
            for block in encoder.level2
        )
        kernel, slopes = fold_block(encoder.b2)
        self.b2_image: FusedConv | None = None
        if layout.split:
            kernel, part = split_inputs(kernel, len(slopes) - 3, 3)
            self.b2_image = FusedConv(part)
        self.b2 = FusedConv(kernel, slopes, maximum=maximum)
        self.level3_down = StrideESPGraph(encoder.level3_down, 1, maximum=maximum)
        self.level3 = nn.ModuleList(
            DepthwiseESPGraph(block, 1, maximum=maximum)  # type: ignore[arg-type]
            for block in encoder.level3
        )

        self.detection: DetectionGraph | None = None
        if network.detection is not None:
            assert encoder.c4 is not None
            assert encoder.c5 is not None
            assert network.litepan is not None
            self.c4 = FusedConv(*fold_block(encoder.c4), maximum=maximum)
            self.c5 = FusedConv(*fold_block(encoder.c5), maximum=maximum)
            self.detection = DetectionGraph(network.litepan, network.spp, network.detection, network.anchors)
        self.pcaa = None if network.pcaa is None else AttentionGraph(network.pcaa, layout)
        self.reduce: FusedConv | None = None
        self.head_columns = columns_before_doubling(columns.quarter)
        if network.reduce is not None:
            self.reduce = FusedConv(*fold_block(network.reduce), (self.head_columns,) * 2, maximum=maximum)
        self.drivable: MaskGraph | None = None
        self.lane: MaskGraph | None = None
        if network.drivable is not None:
            self.drivable = MaskGraph(network.drivable, layout, masks, mask_scale, thresholds.drivable, before)
        if network.lane is not None:
            self.lane = MaskGraph(network.lane, layout, masks, mask_scale, thresholds.lane, before)
        self.eval()

    def forward(self, image: Tensor) -> DeployOutputs:
        """Run the graph.

        Args:
            image: (B, H, W, 3) uint8 RGB (or BGR, if built so), letterboxed; H and W multiples of 32. A layout that is
                not channels-last also takes (B, 3, H, W) float32 of 0 .. 255.

        Raises:
            ShapeError: If it is another shape.
        """
        columns = self.layout.columns
        x = self.normalise(image)
        front = self.stem(recolumn(x, 1, self.stem_columns))
        i1 = front if self.i1 is None else self.i1(recolumn(x, 1, self.i1_columns))
        if self.from_stem:
            i2 = self.i2(recolumn(front, columns.stem, self.i2_columns))
        else:
            i2 = self.i2(recolumn(i1, columns.half, self.i2_columns))
        x = self.b1(recolumn(front, columns.stem, columns.front))
        down2 = y = self.level2_down(recolumn(x, columns.front, columns_before(columns.level2)))
        for block in self.level2:
            y = block(y)
        i2_pixels = recolumn(i2, columns.quarter, 1)
        if self.b2_image is None:
            c2 = self.b2(torch.cat((y, down2, i2_pixels), 1))
        else:
            c2 = self.b2(concatenate((y, down2), columns.level2), self.b2_image(i2_pixels))
        down3 = y = self.level3_down(c2)
        for block in self.level3:
            y = block(y)
        c3 = torch.cat((down3, y), 1)

        detection = drivable = lane = None
        if self.detection is not None:
            c4 = self.c4(c3)
            detection = self.detection(c3, c4, self.c5(c4))
        if self.reduce is not None:
            attended = c3 if self.pcaa is None else self.pcaa(c3)
            attended = self.reduce(recolumn(attended, 1, self.head_columns))
            if self.drivable is not None:
                drivable = self.drivable(attended, i1, i2)
            if self.lane is not None:
                lane = self.lane(attended, i1, i2)
        return DeployOutputs(detection, drivable, lane)

    def reduced(self, dtype: torch.dtype) -> DeployGraph:
        """Compute in half precision from here on, all but pixels and the decoding of boxes; return the graph itself.

        Args:
            dtype: torch.float16 or torch.bfloat16.

        Raises:
            ConfigError: If it is another.
        """
        if dtype not in REDUCED:
            raise ConfigError(f"the deploy graph is reduced to float16 or bfloat16, not {dtype}")
        kept = {id(self.scale), id(self.shift)}
        if self.detection is not None:
            kept |= {id(self.detection.square), id(self.detection.linear), id(self.detection.step)}
        for parameter in self.parameters():
            if id(parameter) not in kept:
                parameter.data = parameter.data.to(dtype)
        return self

    def normalise(self, image: Tensor) -> Tensor:
        """Return pixels as a normalised map (B, 3, H, W).

        Channels-last, scale and shift act on rows flattened to (B, rows, columns x 3), which is one pass over
        contiguous memory.
        """
        x = self._normalise(image)
        dtype = self.stem.weight.dtype
        return x.to(dtype) if dtype in REDUCED else x

    def _normalise(self, image: Tensor) -> Tensor:
        if image.ndim == 4 and image.shape[1] == 3 and image.is_floating_point() and not self.layout.channels_last:
            return image * self.scale.view(1, 3, 1, 1) + self.shift.view(1, 3, 1, 1)
        if image.ndim != 4 or image.shape[3] != 3:
            raise ShapeError(f"the deploy graph takes (B, H, W, 3) uint8, got {tuple(image.shape)}")
        if not self.layout.channels_last:
            x = image.permute(0, 3, 1, 2).float()
            return x * self.scale.view(1, 3, 1, 1) + self.shift.view(1, 3, 1, 1)
        batch, height, width, _ = image.shape
        x = image.reshape(batch, height, -1).float() * self.scale.repeat(width) + self.shift.repeat(width)
        return x.view(batch, height, width, 3).permute(0, 3, 1, 2)


def _check_layers(network: TriLiteNet) -> None:
    """Refuse a network whose weights are not all that it computes by: the rewrites read nothing else."""
    foreign = foreign_layers(network)
    if foreign:
        raise ConfigError(
            f"the deploy graph knows the layers of trilitenet.build_network alone, not {', '.join(foreign)}; run the "
            "network itself on PyTorch"
        )
    hooked = [name for name, layer in network.named_modules() if layer._forward_hooks or layer._forward_pre_hooks]
    if hooked:
        raise ConfigError(
            f"the deploy graph would leave out the hooks of {', '.join(name or 'the network' for name in hooked)}; "
            "remove them first (those of pruning with torch.nn.utils.prune.remove)"
        )


class Traceable(nn.Module):
    """The deploy graph as exporters trace it: the outputs of absent tasks left out, with an image to trace it by.

    Args:
        graph: The deploy graph.
        card: What the network is.
        info: How the artefact takes pixels; its ``size`` of None makes height and width dynamic.

    Attributes:
        image: Zeros of the artefact's size, else of the card's, in the artefact's layout.
        dynamic: Which sides may be of any size, as `torch.export.export` takes it; None if none.
    """

    def __init__(self, graph: DeployGraph, card: ModelCard, info: ArtefactInfo) -> None:
        super().__init__()
        self.network = graph
        height, width = info.size or card.input_size
        floats = info.input == "float_nchw"
        self.image = torch.zeros(1, 3, height, width) if floats else torch.zeros(1, height, width, 3, dtype=torch.uint8)
        self.dynamic: tuple[dict[int, Any]] | None = None
        if info.size is None:
            least, most = (side // MAX_STRIDE for side in DYNAMIC_SIDES)
            rows, columns = (MAX_STRIDE * torch.export.Dim(name, min=least, max=most) for name in ("rows", "columns"))
            self.dynamic = ({2: rows, 3: columns} if floats else {1: rows, 2: columns},)
        self.eval()

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Run the graph."""
        return tuple(output for output in self.network(image) if output is not None)
