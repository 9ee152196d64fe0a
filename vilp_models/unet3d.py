"""The 3D UNet of the planner: noisy clips in, what they are to become out (the paper's section on the video planner, second stage).

Shape suffixes: B batch, C channels, T frames, H and W latent pixels, S = T H W tokens, L context tokens, D context size. Height and width
are halved between levels; time never is. The coarsest level and the middle hold transformer blocks: self-attention over time and space
together, attention to the context, a gated MLP.

The context does not change while a clip is denoised, so what attention needs of it is computed once (`UNet3d.project`) and handed
to every call. With one context token that is exact and more: a softmax over one key is 1 whatever the query, so the block adds
a projection of the token and needs neither queries nor keys.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Convolutions = Literal["full", "factorised"]
Projected = tuple[Tensor, ...]
"""What one attention to the context keeps of it: (addition [B,1,C],) for one token, else (keys, values) [B,heads,L,C/heads]."""


class UNet3d(nn.Module):
    """x_BCTHW, level t_B and projected context to a prediction [B,out_channels,T,H,W]. See the module's text."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        channels: Sequence[int],
        blocks: int,
        convolutions: Convolutions = "full",
        groups: int = 32,
        head_size: int = 8,
        context_size: int | None = None,
        one_token: bool = True,
    ) -> None:
        """`channels` of each level, finest first. `context_size` D, or None for a network without context; `one_token`
        says that the context is always a single token."""
        super().__init__()
        time_size = 4 * channels[0]
        self.time_in_size = channels[0]
        self.level_in = nn.Sequential(nn.Linear(channels[0], time_size), nn.SiLU(), nn.Linear(time_size, time_size))
        self.frame_in = nn.Sequential(nn.Linear(channels[0], time_size), nn.SiLU(), nn.Linear(time_size, time_size))

        def residual(before: int, after: int) -> ResidualBlock:
            return ResidualBlock(before, after, time_size, groups, convolutions)

        def transformer(size: int) -> TransformerBlock:
            return TransformerBlock(size, groups, head_size, context_size, one_token=one_token)

        deepest = len(channels) - 1
        self.conv_in = convolution(in_channels, channels[0], convolutions)
        skips, size = [channels[0]], channels[0]
        self.down = nn.ModuleList()
        for level, after in enumerate(channels):
            for _ in range(blocks):
                self.down.append(Stage(residual(size, after), transformer(after) if level == deepest else None))
                skips.append(size := after)
            if level < deepest:
                self.down.append(Halve(size))
                skips.append(size)
        self.middle = nn.ModuleList([Stage(residual(size, size), transformer(size)), Stage(residual(size, size), None)])
        self.up = nn.ModuleList()
        for level, after in reversed(list(enumerate(channels))):
            for block in range(blocks + 1):
                stage = Stage(residual(size + skips.pop(), after), transformer(after) if level == deepest else None)
                self.up.append(stage)
                size = after
                if block == blocks and level > 0:
                    self.up.append(Double(size))
        self.norm_out = nn.GroupNorm(groups, size)
        self.conv_out = zeroed(convolution(size, out_channels, convolutions))
        self.halvings = deepest

    def project(self, context_BLD: Tensor | None) -> list[Projected]:
        """What each attention to the context needs of it, in the order they run: for all calls about the same clip."""
        attentions = [module for module in self.modules() if isinstance(module, (CrossAttention, OneTokenAttention))]
        if not attentions:
            return []
        assert context_BLD is not None
        return [attention.project(context_BLD) for attention in attentions]

    def forward(self, x_BCTHW: Tensor, t_B: Tensor, projected: Sequence[Projected] = ()) -> Tensor:
        frames = torch.arange(x_BCTHW.shape[2], device=x_BCTHW.device)
        level, frame = sinusoids(t_B, self.time_in_size), sinusoids(frames, self.time_in_size)
        time = self.level_in(level)[:, None] + self.frame_in(frame)
        context = iter(projected)
        x = self.conv_in(x_BCTHW)
        skips = [x]
        for stage in self.down:
            x = stage(x, time, context)
            skips.append(x)
        for stage in self.middle:
            x = stage(x, time, context)
        for stage in self.up:
            x = stage(x if isinstance(stage, Double) else torch.cat([x, skips.pop()], dim=1), time, context)
        out: Tensor = self.conv_out(F.silu(self.norm_out(x)))
        return out


class Stage(nn.Module):
    """A residual block, and a transformer block where the level has them."""

    def __init__(self, residual: ResidualBlock, transformer: TransformerBlock | None) -> None:
        super().__init__()
        self.residual, self.transformer = residual, transformer

    def forward(self, x_BCTHW: Tensor, time: Tensor, context: Iterator[Projected]) -> Tensor:
        x: Tensor = self.residual(x_BCTHW, time)
        return x if self.transformer is None else self.transformer(x, context)


class ResidualBlock(nn.Module):
    """Two normalised convolutions around an addition of the noise level, past a skip."""

    def __init__(self, before: int, after: int, time_size: int, groups: int, convolutions: Convolutions) -> None:
        super().__init__()
        self.norm_in = nn.GroupNorm(groups if before % groups == 0 else math.gcd(before, groups), before)
        self.conv_in = convolution(before, after, convolutions)
        self.time = nn.Linear(time_size, after)
        self.norm_out = nn.GroupNorm(groups, after)
        self.conv_out = zeroed(convolution(after, after, convolutions))
        self.skip = nn.Conv3d(before, after, 1) if before != after else nn.Identity()

    def forward(self, x_BCTHW: Tensor, time_BTE: Tensor) -> Tensor:
        h = self.conv_in(F.silu(self.norm_in(x_BCTHW)))
        h = h + self.time(F.silu(time_BTE)).transpose(1, 2)[..., None, None]
        out: Tensor = self.skip(x_BCTHW) + self.conv_out(F.silu(self.norm_out(h)))
        return out


class TransformerBlock(nn.Module):
    """Self-attention over all frames' pixels, attention to the context, a gated MLP (GEGLU; Shazeer 2020): each past a skip."""

    def __init__(self, size: int, groups: int, head_size: int, context_size: int | None, *, one_token: bool) -> None:
        super().__init__()
        self.norm_in = nn.GroupNorm(groups, size)
        self.proj_in = nn.Linear(size, size)
        self.norm_self, self.attend_self = nn.LayerNorm(size), SelfAttention(size, head_size)
        self.attend_context: OneTokenAttention | CrossAttention | None = None
        if context_size is not None:
            kind = OneTokenAttention if one_token else CrossAttention
            self.attend_context = kind(size, context_size, head_size)
        self.norm_mlp, self.mlp_in, self.mlp_out = (
            nn.LayerNorm(size), nn.Linear(size, 8 * size), nn.Linear(4 * size, size),
        )  # fmt: skip
        self.proj_out = zeroed(nn.Linear(size, size))

    def forward(self, x_BCTHW: Tensor, context: Iterator[Projected]) -> Tensor:
        x = self.proj_in(self.norm_in(x_BCTHW).flatten(2).transpose(1, 2))
        x = x + self.attend_self(self.norm_self(x))
        if self.attend_context is not None:
            x = x + self.attend_context(x, next(context))
        h, gate = self.mlp_in(self.norm_mlp(x)).chunk(2, dim=-1)
        x = x + self.mlp_out(h * F.gelu(gate))
        out: Tensor = x_BCTHW + self.proj_out(x).transpose(1, 2).reshape(x_BCTHW.shape)
        return out


class SelfAttention(nn.Module):
    """[B,S,C] to [B,S,C]."""

    def __init__(self, size: int, head_size: int) -> None:
        super().__init__()
        self.head_size = head_size
        self.to_qkv, self.to_out = nn.Linear(size, 3 * size, bias=False), nn.Linear(size, size)

    def forward(self, x_BSC: Tensor) -> Tensor:
        q, k, v = (_heads(part, self.head_size) for part in self.to_qkv(x_BSC).chunk(3, dim=-1))
        out: Tensor = self.to_out(_joined(F.scaled_dot_product_attention(q, k, v)))
        return out


class CrossAttention(nn.Module):
    """Attention from x [B,S,C] to a context [B,L,D]; keys and values are computed by `project`."""

    def __init__(self, size: int, context_size: int, head_size: int) -> None:
        super().__init__()
        self.head_size = head_size
        self.norm, self.to_q = nn.LayerNorm(size), nn.Linear(size, size, bias=False)
        self.to_k, self.to_v = (nn.Linear(context_size, size, bias=False) for _ in range(2))
        self.to_out = nn.Linear(size, size)

    def project(self, context_BLD: Tensor) -> Projected:
        return _heads(self.to_k(context_BLD), self.head_size), _heads(self.to_v(context_BLD), self.head_size)

    def forward(self, x_BSC: Tensor, projected: Projected) -> Tensor:
        q = _heads(self.to_q(self.norm(x_BSC)), self.head_size)
        keys, values = projected
        out: Tensor = self.to_out(_joined(F.scaled_dot_product_attention(q, keys, values)))
        return out


class OneTokenAttention(nn.Module):
    """`CrossAttention` to a single token: equal for any queries and keys, so it has none."""

    def __init__(self, size: int, context_size: int, head_size: int) -> None:
        super().__init__()
        self.head_size = head_size
        self.to_v, self.to_out = nn.Linear(context_size, size, bias=False), nn.Linear(size, size)

    def project(self, context_B1D: Tensor) -> Projected:
        if context_B1D.shape[1] != 1:
            raise ValueError(f"one token, not {context_B1D.shape[1]}: build the network with one_token=False")
        return (self.to_out(self.to_v(context_B1D)),)

    def forward(self, x_BSC: Tensor, projected: Projected) -> Tensor:
        return projected[0]

    def as_full(self) -> CrossAttention:
        """The same function as plain attention, with queries and keys that decide nothing: what the shortcut is measured against."""
        full = CrossAttention(self.to_out.in_features, self.to_v.in_features, self.head_size)
        full.to_v, full.to_out = self.to_v, self.to_out
        return full.to(self.to_out.weight)


class Halve(nn.Module):
    """Height and width by two, by a strided convolution of each frame."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(size, size, (1, 3, 3), (1, 2, 2), (0, 1, 1))

    def forward(self, x_BCTHW: Tensor, _time: Tensor, _context: Iterator[Projected]) -> Tensor:
        out: Tensor = self.conv(x_BCTHW)
        return out


class Double(nn.Module):
    """Height and width by two, by repeating pixels, then a convolution of each frame."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(size, size, (1, 3, 3), padding=(0, 1, 1))

    def forward(self, x_BCTHW: Tensor, _time: Tensor, _context: Iterator[Projected]) -> Tensor:
        out: Tensor = self.conv(F.interpolate(x_BCTHW, scale_factor=(1, 2, 2), mode="nearest"))
        return out


def convolution(before: int, after: int, convolutions: Convolutions) -> nn.Module:
    """3x3x3 that keeps the size, or its factors: each frame by itself, then each pixel through time."""
    if convolutions == "full":
        return nn.Conv3d(before, after, 3, padding=1)
    over_space = nn.Conv3d(before, after, (1, 3, 3), padding=(0, 1, 1))
    over_time = nn.Conv3d(after, after, (3, 1, 1), padding=(1, 0, 0))
    nn.init.dirac_(over_time.weight)  # at first each frame by itself: it learns faster so
    return nn.Sequential(over_space, over_time)


def zeroed(module: nn.Module) -> nn.Module:
    """The same module, whose last layer gives zero until it is trained, so that a block starts as its skip."""
    last = module[-1] if isinstance(module, nn.Sequential) else module
    for parameter in last.parameters():
        nn.init.zeros_(parameter)
    return module


def sinusoids(t_B: Tensor, size: int) -> Tensor:
    """Noise levels as sines and cosines of geometrically falling frequencies, float32 [B,size] (Vaswani et al. 2017)."""
    frequencies = torch.exp(-math.log(10_000.0) * torch.arange(size // 2, device=t_B.device) / (size // 2))
    angles = t_B[:, None].float() * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def _heads(x_BSC: Tensor, head_size: int) -> Tensor:
    return x_BSC.view(*x_BSC.shape[:2], -1, head_size).transpose(1, 2)


def _joined(x: Tensor) -> Tensor:
    return x.transpose(1, 2).flatten(2)
