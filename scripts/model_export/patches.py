"""The authors' network -> a module that PyTorch can trace into ONNX, same numbers.

Each patch replaces one method of the loaded network by our own code, for one image size. What it
replaces and why is said at each; nothing of the authors' source is repeated here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .nets import PATCH, Family, Refused


def exportable(net: nn.Module, family: Family, height: int, width: int, fused: bool) -> nn.Module:
    """Patches `net` in place and wraps it: images [S,3,H,W] -> pose_enc [S,9], depth and depth_conf [S,H,W]."""
    rows, columns = height // PATCH, width // PATCH
    for module in net.modules():
        if type(module).__name__ == "RotaryPositionEmbedding2D":
            _fix_rotation(module, max(rows, columns) + 1)
        if hasattr(module, "position_getter"):
            module.position_getter = _grid_positions
        if hasattr(module, "interpolate_pos_encoding"):
            _freeze_position_embedding(module, height, width)
        for name in ("_add_pos_embed", "_apply_pos_embed"):
            if hasattr(module, name):
                _freeze_addition(module, name)
        _replace_in_namespace(module, "custom_interpolate", _interpolate_to_constant_size)
        _replace_in_namespace(module, "slice_expand_and_flatten", _first_and_other_tokens)
    if fused:
        F.scaled_dot_product_attention = _attention_in_one_node
    wrapped = _Da3(net) if family.family == "da3" else _Vggt(net)
    return wrapped.eval()


class _Da3(nn.Module):
    """Backbone, depth head and pose head; rays, sky and splats stay out."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.backbone, self.head, self.cam_dec = net.backbone, net.head, net.cam_dec

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        frames, _, height, width = images.shape
        # Given camera tokens keep the network from choosing a reference view by a data-dependent branch:
        # the first frame gets the reference token, as with ref_view_strategy="first".
        tokens = _first_and_other_tokens(self.backbone.pretrained.camera_token[:, :, None], 1, frames)
        features, _ = self.backbone(images[None], cam_token=tokens[None, :, 0])
        maps = self.head(features, int(height), int(width), patch_start_idx=0)
        return self.cam_dec(features[-1][1])[0], maps["depth"][0], maps["depth_conf"][0]


class _Vggt(nn.Module):
    """Aggregator, camera head and depth head; the point and track heads stay out."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.aggregator, self.camera_head, self.depth_head = net.aggregator, net.camera_head, net.depth_head

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        batch = images[None]
        tokens, first_patch = self.aggregator(batch)
        pose = self.camera_head(tokens)[-1]
        depth, confidence = self.depth_head(tokens, images=batch, patch_start_idx=first_patch)
        return pose[0], depth[0, ..., 0], confidence[0]


def _grid_positions(batch_size: int, height: int, width: int, device: torch.device) -> Tensor:
    """Row and column of each patch. The original's cartesian product has no ONNX counterpart."""
    rows = torch.arange(height, device=device)
    columns = torch.arange(width, device=device)
    grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1)
    return grid.reshape(1, height * width, 2).expand(batch_size, -1, -1)


def _fix_rotation(rope: nn.Module, n_positions: int) -> None:
    """Rotary embedding with tables of constant length: the original asks the data for the largest position.

    Half of a head's channels turn with the row, half with the column (RoPE, Su et al. 2021, in 2D).
    """
    tables: dict[int, Tensor] = {}

    def table(channels: int, device: torch.device) -> Tensor:
        if channels not in tables:
            powers = torch.arange(0, channels, 2, device=device).float() / channels
            turns = 1.0 / (rope.base_frequency**powers)
            angles = torch.arange(n_positions, device=device).float()[:, None] * turns
            tables[channels] = torch.cat((angles, angles), dim=-1)
        return tables[channels]

    def forward(tokens: Tensor, positions: Tensor) -> Tensor:
        angles = table(int(tokens.shape[-1]) // 2, tokens.device)
        cosine = _per_axis(angles.cos().to(tokens.dtype), positions)
        sine = _per_axis(angles.sin().to(tokens.dtype), positions)
        a, b, c, d = tokens.chunk(4, dim=-1)
        return tokens * cosine + torch.cat((-b, a, -d, c), dim=-1) * sine

    rope.forward = forward


def _per_axis(table: Tensor, positions: Tensor) -> Tensor:
    rows, columns = F.embedding(positions[..., 0], table), F.embedding(positions[..., 1], table)
    return torch.cat((rows, columns), dim=-1)[:, None]


def _freeze_position_embedding(vit: nn.Module, height: int, width: int) -> None:
    """Resizes the position embedding once: antialiased bicubic resizing has no ONNX counterpart."""
    n_tokens = (height // PATCH) * (width // PATCH) + 1
    blank = torch.zeros(1, n_tokens, vit.pos_embed.shape[-1])
    with torch.no_grad():
        vit.register_buffer("frozen_pos_embed", vit.interpolate_pos_encoding(blank, height, width).clone())
    vit.interpolate_pos_encoding = lambda _x, _w, _h: vit.frozen_pos_embed


def _freeze_addition(head: nn.Module, name: str) -> None:
    """Adds a constant where the original builds it anew, partly in float64, which ONNX Runtime refuses.

    The constant is what the original adds to zeros. One pass before tracing fills the table.
    """
    original = getattr(head, name)
    constants: dict[tuple[int, int, int], Tensor] = {}

    def add(x: Tensor, width: int, height: int, *ratio: float) -> Tensor:
        shape = (int(x.shape[1]), int(x.shape[2]), int(x.shape[3]))
        if shape not in constants:
            with torch.no_grad():
                constants[shape] = original(torch.zeros(1, *shape), int(width), int(height), *ratio).float()
        return x + constants[shape]

    setattr(head, name, add)


def _replace_in_namespace(module: nn.Module, name: str, ours: Callable) -> None:
    namespace = sys.modules[type(module).__module__]
    if hasattr(namespace, name):
        setattr(namespace, name, ours)


def _interpolate_to_constant_size(
    x: Tensor,
    size: tuple[int, int] | None = None,
    scale_factor: float | None = None,
    mode: str = "bilinear",
    align_corners: bool = True,
) -> Tensor:
    """Resizing with sizes as literals: the original computes them, and a branch, from tensor shapes."""
    if size is None:
        size = (int(x.shape[-2]) * scale_factor, int(x.shape[-1]) * scale_factor)
    return F.interpolate(x, size=(int(size[0]), int(size[1])), mode=mode, align_corners=align_corners)


def _first_and_other_tokens(tokens: Tensor, _batch: int, frames: int) -> Tensor:
    """[1,2,X,C] -> [S,X,C]: the first frame's token, then the others'. Expanding to S-1 would fix S at export."""
    which = torch.arange(frames, device=tokens.device).clamp(max=1)
    return tokens[0].index_select(0, which)


class _OneNode(torch.autograd.Function):
    """Attention as one ONNX Runtime node, whose memory grows with the tokens and not with their square."""

    @staticmethod
    def forward(_ctx: object, query: Tensor, key: Tensor, value: Tensor, heads: int) -> Tensor:
        def split(x: Tensor) -> Tensor:
            return x.unflatten(-1, (heads, -1)).transpose(1, 2)

        out = torch.nn.functional.softmax(
            split(query) @ split(key).transpose(-2, -1) / (query.shape[-1] // heads) ** 0.5, dim=-1
        ) @ split(value)
        return out.transpose(1, 2).flatten(2)

    @staticmethod
    def symbolic(g, query, key, value, heads: int):  # noqa: ANN001, ANN205 (types of the tracer)
        node = g.op("com.microsoft::MultiHeadAttention", query, key, value, num_heads_i=heads)
        return node.setType(query.type())


def _attention_in_one_node(
    query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor | None = None, dropout_p: float = 0.0
) -> Tensor:
    if attn_mask is not None or dropout_p > 0.0:
        raise Refused("the network masks or drops attention, which --attention fused cannot say; use plain")
    heads, channels = int(query.shape[1]), int(query.shape[3])

    def merge(x: Tensor) -> Tensor:
        return x.transpose(1, 2).flatten(2)

    out = _OneNode.apply(merge(query), merge(key), merge(value), heads)
    return out.unflatten(-1, (heads, channels)).transpose(1, 2)
