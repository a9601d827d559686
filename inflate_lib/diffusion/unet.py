"""The denoising network: a lean U-Net told the time step and the target descriptor (sections 2.2 and 4.1).

One residual block (or more) per scale on the way down and up, two in the middle; one skip per scale. The up-convolution
also halves the channels (as in Ronneberger et al.), which keeps the costly full-resolution layers narrow.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from inflate_lib._checks import choice, whole_number

CONDITIONINGS = ("scale-shift", "add")
_GROUPS = 8  # of each normalisation; where it does not divide the channels, the largest common divisor


def sinusoidal_embedding(t: Tensor, width: int) -> Tensor:
    """ζ_t: cosines and sines of the time step (n,) at ``width`` / 2 geometrically spaced frequencies → (n, width)."""
    frequencies = torch.exp(-math.log(10_000) * torch.arange(width // 2, device=t.device) / (width // 2))
    angles = t.float()[:, None] * frequencies
    return torch.cat([angles.cos(), angles.sin()], dim=1)


def _zero(layer: nn.Module) -> None:
    """Start a layer at zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)


class ResidualBlock(nn.Module):
    """Two 3×3 convolutions beside a shortcut, told the context ζ between them.

    ``scale_shift``: ζ scales and shifts the second normalisation (Nichol & Dhariwal 2021); else it is added to what
    goes into that normalisation (Ho et al. 2020).
    """

    def __init__(self, inputs: int, outputs: int, embedding: int, groups: int, scale_shift: bool = True):
        super().__init__()
        self.scale_shift = scale_shift
        self.norm1 = nn.GroupNorm(math.gcd(groups, inputs), inputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.context = nn.Linear(embedding, 2 * outputs if scale_shift else outputs)
        self.norm2 = nn.GroupNorm(math.gcd(groups, outputs), outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.shortcut = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()
        _zero(self.conv2)  # each block starts as its shortcut, which makes the first steps stable

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        told = self.context(context)[:, :, None, None]
        h = self.conv1(F.silu(self.norm1(x)))
        if self.scale_shift:
            scale, shift = told.chunk(2, dim=1)
            h = torch.addcmul(shift, self.norm2(h), 1 + scale)
        else:
            h = self.norm2(h + told)
        return self.shortcut(x) + self.conv2(F.silu(h))


class _Attention(nn.Module):
    """Self-attention among the pixels of the coarsest grid."""

    def __init__(self, channels: int, heads: int, groups: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.GroupNorm(math.gcd(groups, channels), channels)
        self.qkv = nn.Conv2d(channels, 3 * channels, 1)
        self.out = nn.Conv2d(channels, channels, 1)
        _zero(self.out)

    def forward(self, x: Tensor) -> Tensor:
        n, c, height, width = x.shape
        qkv = self.qkv(self.norm(x)).reshape(n, 3, self.heads, c // self.heads, -1).transpose(-1, -2)
        h = F.scaled_dot_product_attention(*qkv.unbind(1))
        return x + self.out(h.transpose(-1, -2).reshape(n, c, height, width))


class UNet(nn.Module):
    """ε_θ(x_t, ζ(y, t)), or v_θ: noise (or velocity) in an image, given the time step and the descriptor.

    Parameters
    ----------
    n_conditions : int
        Length N of the descriptor vector y.
    channels : sequence of int
        Channels at each scale; every further scale halves the grid. The paper's: (64, 128, 256) on 28, 14, 7.
    embedding, hidden : int
        Width of the context vector ζ and of the two hidden layers of the descriptor network (paper: 256, 200).
    blocks : int
        Residual blocks per scale, on the way down and on the way up.
    conditioning : "scale-shift" or "add"
        How ζ enters a residual block.
    attention : bool
        Self-attention in the middle, on the coarsest grid.
    parts : sequence of int
        Lengths of the parts of y, in order, each of which may be withheld by NaN; empty: y is given or withheld whole.
    told_guidance : bool
        The strength of guidance is an input as well (:mod:`inflate_lib.alternatives.distillation`).
    image_channels : int
        Channels of the images.
    """

    def __init__(
        self,
        n_conditions: int,
        channels: Sequence[int] = (64, 128, 256),
        embedding: int = 256,
        hidden: int = 200,
        blocks: int = 1,
        conditioning: str = "scale-shift",
        attention: bool = False,
        parts: Sequence[int] = (),
        told_guidance: bool = False,
        image_channels: int = 1,
    ) -> None:
        super().__init__()
        whole_number("n_conditions", n_conditions, 0)
        widths = {"embedding": embedding, "hidden": hidden, "blocks": blocks, "image_channels": image_channels}
        for name, value in widths.items():
            whole_number(name, value, 1)
        if parts and sum(parts) != n_conditions:
            raise ValueError(f"parts of lengths {tuple(parts)} do not make up {n_conditions} conditions")
        self.part_starts = [sum(parts[:i]) for i in range(len(parts))]
        self.n_conditions, self.channels, self.embedding = n_conditions, tuple(channels), embedding
        self.blocks = blocks
        choice("conditioning", conditioning, CONDITIONINGS)
        self.descriptor = nn.Sequential(
            nn.Linear(n_conditions + len(parts), hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, embedding),
        )
        # Stands in for ζ_d where the descriptor is withheld (classifier-free guidance): learned like a weight.
        self.null = nn.Parameter(torch.zeros(embedding))
        self.strength = None
        if told_guidance:
            self.strength = nn.Sequential(nn.Linear(1, hidden), nn.SiLU(), nn.Linear(hidden, embedding))
            _zero(self.strength[2])  # until it is trained, no strength makes a difference

        def block(inputs, outputs):
            return ResidualBlock(inputs, outputs, embedding, _GROUPS, conditioning == "scale-shift")

        def stages(widths):  # at each scale the first block changes the width
            return nn.ModuleList(block(a if i == 0 else b, b) for a, b in widths for i in range(blocks))

        first, last = channels[0], channels[-1]
        pairs = list(pairwise(channels))  # (finer, coarser)
        self.stem = nn.Conv2d(image_channels, first, 3, padding=1)
        self.down_blocks = stages([(first, first), *pairs])
        self.downs = nn.ModuleList([nn.Conv2d(c, c, 3, stride=2, padding=1) for c in channels[:-1]])
        self.middle = nn.ModuleList([block(last, last), block(last, last)])
        self.attention = _Attention(last, max(1, last // 64), _GROUPS) if attention else nn.Identity()
        pairs.reverse()
        self.ups = nn.ModuleList([nn.Conv2d(coarse, fine, 3, padding=1) for fine, coarse in pairs])
        self.up_blocks = stages([(2 * last, last), *((2 * fine, fine) for fine, _ in pairs)])
        self.norm = nn.GroupNorm(math.gcd(_GROUPS, first), first)
        self.out = nn.Conv2d(first, image_channels, 3, padding=1)
        _zero(self.out)
        self.to(memory_format=torch.channels_last)

    @property
    def n_parameters(self) -> int:
        """Number of trainable numbers."""
        return sum(p.numel() for p in self.parameters())

    def context(
        self, t: Tensor, conditions: Tensor | None, dropped: Tensor | None = None, guidance: Tensor | None = None
    ) -> Tensor:
        """ζ(y, t) = ζ_t + ζ_d, with the null vector for ζ_d where ``dropped`` (n,) is true or conditions is None.

        A network that is told the strength w of guidance adds ζ_w.
        """
        if conditions is None:
            described = self.null
        else:
            if self.part_starts:  # zero for what is not known, and a 1 for each part that is
                known = ~conditions[:, self.part_starts].isnan()
                conditions = torch.cat([conditions.nan_to_num(), known.to(conditions.dtype)], dim=1)
                unknown = ~known.any(dim=1)
                dropped = unknown if dropped is None else dropped | unknown
            described = self.descriptor(conditions)
            if dropped is not None:
                described = torch.where(dropped[:, None], self.null, described)
        context = sinusoidal_embedding(t, self.embedding) + described
        if self.strength is not None:
            w = torch.ones(len(t), device=t.device) if guidance is None else guidance
            context = context + self.strength(w.log()[:, None])
        return context

    def forward(
        self,
        x: Tensor,
        t: Tensor,
        conditions: Tensor | None,
        dropped: Tensor | None = None,
        guidance: Tensor | None = None,
    ) -> Tensor:
        """Predict noise (or velocity).

        Parameters
        ----------
        x : Tensor, shape (n, c, h, w)
            Noisy images; h and w divisible by 2 ** (number of scales − 1).
        t : Tensor of int, shape (n,)
            Zero-based time steps.
        conditions : Tensor, shape (n, N), or None
            Descriptors, min–max scaled to [0, 1], parts that are not asked for NaN; None withholds them all.
        dropped : Tensor of bool, shape (n,), optional
            Where true, this row's descriptor is withheld.
        guidance : Tensor, shape (n,), optional
            Strength w > 0, of a network that is told it; 1 by default.

        Returns
        -------
        Tensor, shape (n, c, h, w)
        """
        context = F.silu(self.context(t, conditions, dropped, guidance))
        h = self.stem(x.contiguous(memory_format=torch.channels_last))
        skips = []
        for i, block in enumerate(self.down_blocks):
            if i > 0 and i % self.blocks == 0:  # the next scale
                skips.append(h)
                h = self.downs[i // self.blocks - 1](h)
            h = block(h, context)
        skips.append(h)
        h = self.middle[1](self.attention(self.middle[0](h, context)), context)
        for i, block in enumerate(self.up_blocks):
            if i % self.blocks == 0:
                if i > 0:
                    h = self.ups[i // self.blocks - 1](F.interpolate(h, scale_factor=2.0, mode="nearest"))
                h = torch.cat([h, skips.pop()], dim=1)
            h = block(h, context)
        return self.out(F.silu(self.norm(h)))
