"""ASpanFormer (Chen et al. 2022, "Detector-Free Image Matching with Adaptive Span Transformer")."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.contract import Training
from mkpc_kaggle.matchers.networks.adaptive_span import (
    MASKED,
    adaptive_span,
    sample_usable,
    span_attention,
)
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE
from mkpc_kaggle.matchers.networks.grids import (
    Perceptron,
    as_grid,
    as_map,
    mask_valid,
    mean_pool,
    pointwise,
)
from mkpc_kaggle.matchers.networks.layers import ExactConv1d, resize
from mkpc_kaggle.matchers.networks.linear_attention import MaskPair
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, sine_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import TOP
from mkpc_kaggle.matchers.networks.semi_dense import HEADS, SemiDenseNetwork

FLOW = 128  # channels of the flow feature, and of the projected positions
INITIAL_LAYERS = 2  # of the initial stage
BLOCKS = 4  # after it
POOLING = (4, 4)  # rows and columns of the coarse map per cell of the global level


@dataclass(frozen=True, eq=False)
class Side:
    """One image in the coarse transformer.

    Features are ``visual`` (N, h, w, 256) and ``flow`` (N, h, w, 128). ``positions`` (1, h, w, 128)
    are projected. ``mask`` is (N, h, w) bool or None.
    """

    visual: Tensor
    flow: Tensor
    positions: Tensor
    factor: tuple[int, int]  # of pooling, (rows, columns)
    mask: Tensor | None

    def values(self, projection: nn.Conv1d) -> Tensor:
        """Return the joint projection (N, h, w, 256) of visual features and positions."""
        # One table of positions serves all images of the batch.
        positions = self.positions.expand(len(self.visual), -1, -1, -1)
        both = torch.cat([self.visual, positions], dim=-1)  # (N, h, w, 384), features first
        return pointwise(projection, both)

    @property
    def pooled_mask(self) -> Tensor | None:
        """The mask (N, cells) of the global level, or None."""
        if self.mask is None:
            return None
        return mask_valid(self.mask, self.factor).flatten(1)


class ChannelNorm(nn.Module):
    """Layer norm that adds epsilon to the unbiased standard deviation, not to the variance."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.affine = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        deviation, mean = torch.std_mean(x, dim=-1, keepdim=True)
        normed = (x - mean).div_(deviation.add_(1e-6))
        return torch.addcmul(self.bias, normed, self.affine)


def global_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    temperature: Tensor | float,
    masks: tuple[Tensor | None, Tensor | None],
) -> Tensor:
    """Return messages (N, h, w, C) to queries from keys and values (N, h_key, w_key, C).

    Queries have the messages' shape. A masked query gets the mean of all values, as published.
    """
    queries = _tokens_by_head(q)  # (N, heads, L, D)
    keys = _tokens_by_head(k)  # (N, heads, S, D)
    values = _tokens_by_head(v)
    scale = temperature * queries.shape[3] ** -0.5
    logits = queries @ keys.transpose(2, 3) * scale  # (N, heads, L, S)
    query_mask, key_mask = masks
    if query_mask is not None and key_mask is not None:
        valid = query_mask[:, None, :, None] & key_mask[:, None, None, :]
        logits.masked_fill_(~valid, MASKED)
    messages: Tensor = logits.softmax(dim=-1) @ values
    return messages.transpose(1, 2).reshape(q.shape)


def _tokens_by_head(grid: Tensor) -> Tensor:
    """Map (N, h, w, C) to (N, heads, h w, D), a view where the grid is contiguous."""
    width = grid.shape[3] // HEADS
    tokens = grid.flatten(1, 2).view(len(grid), -1, HEADS, width)
    return tokens.transpose(1, 2)


class CrossLayer(nn.Module):
    """Projections for cross-attention, and the update of ``width`` features by a message.

    The coarse stage has no self-attention: all layers are between the two images.
    """

    def __init__(self, width: int, hidden: int, kernel: int) -> None:
        super().__init__()
        self.q_proj = nn.Conv1d(TOP, TOP, 1, bias=False)
        self.k_proj = nn.Conv1d(TOP, TOP, 1, bias=False)
        self.v_proj = nn.Conv1d(TOP + FLOW, TOP, 1, bias=False)
        self.merge_f = Perceptron(
            nn.Conv2d(width + TOP, hidden, 1, bias=False),
            nn.Conv2d(hidden, width, kernel, padding=kernel // 2, bias=False),
        )
        self.norm1 = ChannelNorm(TOP)
        self.norm2 = ChannelNorm(width)

    def projected(self, own: Side, other: Side) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries of ``own``, and keys and values of ``other``, each (N, h, w, 256)."""
        return (
            pointwise(self.q_proj, own.visual),
            pointwise(self.k_proj, other.visual),
            other.values(self.v_proj),
        )

    def updated(self, features: Tensor, message: Tensor) -> Tensor:
        """Map features (N, h, w, width) and a message (N, h, w, 256) to new features."""
        both = torch.cat([features, self.norm1(message)], dim=-1)
        merged: Tensor = self.norm2(self.merge_f(both))
        return merged.add_(features)


class InitialLayer(CrossLayer):
    """An update of the pooled features of one image from the other image."""

    def __init__(self) -> None:
        super().__init__(TOP, 2 * TOP, kernel=1)
        self.merge_head = nn.Conv1d(TOP, TOP, 1, bias=False)

    def forward(self, own: Side, other: Side) -> Tensor:
        """Return the updated features (N, rows, columns, 256) of ``own`` at the global level."""
        masks = (own.pooled_mask, other.pooled_mask)
        # Only the blocks learn a temperature.
        message = global_attention(*self.projected(own, other), 1.0, masks)
        return self.updated(own.visual, pointwise(self.merge_head, message))


class InitialStage(nn.Module):
    """Cross-attention at the global level, which initialises the flow features."""

    def __init__(self) -> None:
        super().__init__()
        self.layers_coarse = nn.ModuleList(InitialLayer() for _ in range(INITIAL_LAYERS))
        self.decoupler = nn.Conv2d(TOP, TOP + FLOW, 1)
        self.up_merge = nn.Conv2d(2 * TOP, TOP, 1)

    def forward(self, side0: Side, side1: Side) -> tuple[Side, Side]:
        """Return both sides with updated visual features and with their first flow features."""
        pooled0 = _pooled(side0)
        pooled1 = _pooled(side1)
        for layer in self.layers_coarse:
            # Both updates start from the features before the layer.
            visual0 = layer(pooled0, pooled1)
            visual1 = layer(pooled1, pooled0)
            pooled0 = replace(pooled0, visual=visual0)
            pooled1 = replace(pooled1, visual=visual1)
        return self._enlarged(side0, pooled0.visual), self._enlarged(side1, pooled1.visual)

    def _enlarged(self, side: Side, pooled: Tensor) -> Side:
        """Split pooled features into a visual and a flow part, and enlarge both to the side."""
        decoupled = as_map(pointwise(self.decoupler, pooled))  # (N, 384, rows, columns)
        large = resize(decoupled, side.visual.shape[1:3])
        visual, flow = torch.split(as_grid(large), [TOP, FLOW], dim=-1)
        both = torch.cat([side.visual, visual], dim=-1)
        added = pointwise(self.up_merge, both)
        return replace(side, visual=added.add_(side.visual), flow=flow)


def _pooled(side: Side) -> Side:
    """Pool features and positions to the global level. The mask is pooled where it is used."""
    visual = mean_pool(side.visual, side.factor)
    positions = mean_pool(side.positions, side.factor)
    return replace(side, visual=visual, positions=positions)


class HierarchicalAttention(nn.Module):
    """Merged messages of the global level and of the two adaptive-span levels."""

    def __init__(self) -> None:
        super().__init__()
        self.temp = nn.Parameter(torch.ones(()))
        self.merge_head = Perceptron(
            nn.Conv1d(3 * TOP, TOP, 1, bias=False),
            nn.Conv1d(TOP, TOP, 1, bias=False),
        )

    def forward(
        self, q: Tensor, k: Tensor, v: Tensor, flow: Tensor, own: Side, other: Side
    ) -> Tensor:
        """Map queries and flow of ``own``, keys and values of ``other``, to a message.

        The message is (N, h, w, 256), like the queries.
        """
        coarse = global_attention(
            mean_pool(q, own.factor),
            mean_pool(k, other.factor),
            mean_pool(v, other.factor),
            self.temp,
            (own.pooled_mask, other.pooled_mask),
        )  # (N, h / rows, w / columns, 256)
        half = _span_message(q, k, v, flow, 2, own.mask)  # (N, h / 2, w / 2, 256)
        full = _span_message(q, k, v, flow, 1, own.mask)  # (N, h, w, 256)
        size = q.shape[1:3]
        # Messages are enlarged to the nearest cell, unlike the initial stage's features.
        levels = [_repeated(coarse, size), _repeated(half, size), full]
        merged: Tensor = self.merge_head(torch.cat(levels, dim=-1))
        return merged


def _repeated(grid: Tensor, size: torch.Size) -> Tensor:
    """Enlarge a grid (N, h, w, C) to ``size`` by repeating its cells."""
    return as_grid(resize(as_map(grid), size, "nearest"))


def _span_message(
    q: Tensor, k: Tensor, v: Tensor, flow: Tensor, factor: int, mask: Tensor | None
) -> Tensor:
    """Return messages (N, h / factor, w / factor, 256) of the span level pooled by ``factor``."""
    q = mean_pool(q, factor)
    k = mean_pool(k, factor)
    v = mean_pool(v, factor)
    samples = adaptive_span(flow, factor)
    usable = None
    if mask is not None:
        usable = sample_usable(samples, mask, (k.shape[1], k.shape[2]), factor)
    return span_attention(q, k, v, samples, HEADS, usable)


class AspanBlock(CrossLayer):
    """A block that decodes the flow and updates visual and flow features along it.

    The last block updates the visual features only: nothing reads a flow after it.
    """

    def __init__(self, last: bool) -> None:
        super().__init__(TOP if last else TOP + FLOW, TOP + FLOW, kernel=3)
        self.last = last
        # Float32 in any precision: its outputs are positions.
        self.flow_decoder = Perceptron(
            ExactConv1d(FLOW, FLOW // 2, 1, bias=False),
            ExactConv1d(FLOW // 2, 4, 1, bias=False),
        )
        self.attention = HierarchicalAttention()

    def decode_flow(self, own: Side, other: Side) -> Tensor:
        """Return (N, h, w, 4): the target (x, y) in ``other``, and log-variances of x and y.

        Targets are in coarse cells, from the corner of ``other``.
        """
        raw = self.flow_decoder(own.flow)
        # x is a share of the other image's width, y of its height.
        size = raw.new_tensor([other.visual.shape[2], other.visual.shape[1]])
        target = raw[..., :2].sigmoid() * size
        return torch.cat([target, raw[..., 2:]], dim=-1)

    def forward(self, own: Side, other: Side) -> Side:
        """Return ``own``, updated."""
        q, k, v = self.projected(own, other)
        message = self.attention(q, k, v, self.decode_flow(own, other), own, other)
        if self.last:
            return replace(own, visual=self.updated(own.visual, message))
        both = torch.cat([own.visual, own.flow], dim=-1)  # (N, h, w, 384)
        updated = self.updated(both, message)
        return replace(own, visual=updated[..., :TOP], flow=updated[..., TOP:])


class AspanTransformer(nn.Module):
    """The coarse transformer; every layer updates both images at once.

    The positions of every image are stretched to ``train_size`` (height, width).
    """

    def __init__(self, train_size: tuple[int, int]) -> None:
        super().__init__()
        self.train_size = train_size
        self.pos_transform = nn.Conv2d(TOP, FLOW, 1, bias=False)
        self.ini_layer = InitialStage()
        self.layers = nn.ModuleList(
            AspanBlock(last=index == BLOCKS - 1) for index in range(BLOCKS)
        )
        # The weights of 3x3 convolutions have the memory layout of the grids.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    def forward(
        self, coarse0: Tensor, coarse1: Tensor, masks: MaskPair | None = None
    ) -> tuple[Tensor, Tensor]:
        """Map (N, 256, h, w) of both images to their visual features (N, h, w, 256)."""
        mask0, mask1 = masks or (None, None)
        side0, side1 = self.ini_layer(self.side(coarse0, mask0), self.side(coarse1, mask1))
        for block in self.layers:
            updated0 = block(side0, side1)
            updated1 = block(side1, side0)  # from side0 before its update
            side0 = updated0
            side1 = updated1
        return side0.visual, side1.visual

    def side(self, coarse: Tensor, mask: Tensor | None) -> Side:
        """Return an image's first state: its coarse map (N, 256, h, w) plus positions."""
        grid = as_grid(coarse)
        height, width = grid.shape[1:3]
        # Each axis has its own factor, as in the published code's online mode.
        train_height, train_width = self.train_size
        scale = (
            train_height / (COARSE_STRIDE * height),
            train_width / (COARSE_STRIDE * width),
        )
        positions = sine_positions(height, width, FIXED_DECAY, scale, grid.device)
        positions = positions[None]  # (1, h, w, 256)
        # Contiguous, because attention reads the grid as tokens by ``view``.
        visual = (grid + positions).contiguous()
        projected = pointwise(self.pos_transform, positions)  # (1, h, w, 128)
        flow = visual.new_empty(0)  # from the initial stage on
        return Side(visual, flow, projected, POOLING, mask)


class AspanFormer(SemiDenseNetwork):
    """ASpanFormer. Sides are multiples of 32; the two images may differ in size.

    Indoor weights were published for 480 x 640 only, without a border, with unscaled positions and
    a global level of 15 x 20 cells. At this size our scaling and pooling are the same.
    """

    def __init__(self, training: Training = Training.OUTDOOR) -> None:
        indoor = training is Training.INDOOR
        transformer = AspanTransformer((480, 640) if indoor else (832, 832))
        super().__init__(transformer, 0 if indoor else 2, learned_temperature=True)
