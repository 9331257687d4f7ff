"""DropoutVGG: a VGG-style network (Simonyan & Zisserman, arXiv 1409.1556) with dropout as a sample of the posterior.

    trunk: blocks of 3x3 convolution, max pool and ReLU, the first convolution with stride 2
    head:  fully connected ReLU layers, and one linear output split into mean and log-variance

Where dropout sits is a setting. With none in the trunk, the K samples of a decision share one pass through it, and only
the small head runs K times. Images are standardised pixel by pixel: what never changes in training is divided by
little, so something new stands out by many standard deviations. That, more than anything else, makes the network's
uncertainty see it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from safeswitch.names import unknown
from safeswitch_baselines.learners.config import TrainingConfig, factors_of, rates_of, require
from safeswitch_baselines.learners.dropout import MaskLayout
from safeswitch_baselines.learners.gaussian import bounded_log_var
from safeswitch_baselines.learners.manifold import Excess, Subspace, halved

REACH_FLOOR = 0.05
"""Smallest reach of the training images off their subspace, in units of a standardised pixel."""
STANDARDISATIONS = ("per-pixel", "centred", "none")


@dataclass(frozen=True, kw_only=True)
class VGGConfig(TrainingConfig):
    """Everything that decides a trained DropoutVGG, besides its data and its seed. Plain JSON values.

    Attributes:
        frames: F, last frames that the network sees.
        channels: of each block.
        strides: of each block's convolution, one or one per block.
        pools: size of the max pool after each convolution, one or one per block; 1 for no pool. A first block that
            pools too, though it has a stride already, makes training three times as fast.
        hidden: width of each fully connected layer.
        trunk_dropout: chance to drop a unit after each block, one rate or one per block. Where it is not 0, every
            sample of a decision runs the whole trunk.
        branches: B, parts into which the channels of the trunk are split after the first block, each a small network
            of its own (grouped convolutions). A divisor of all channels.
        feature_dropout: the same on the flattened features of the trunk; with branches, whole branches are dropped:
            a decision then asks subsets of networks that were trained together, which agree on what training showed
            and on little else (Durasov et al. 2021, arXiv 2012.08334).
        hidden_dropout: the same after each fully connected layer, one rate or one per layer.
        standardisation: "per-pixel" (mean and deviation of every pixel and channel over the training images),
            "centred" (mean of every channel, no division) or "none"; of pixels in [0, 1].
        pixel_floor: added to the deviation, so that constant pixels are divided by this.
        differences: whether the older frames enter as differences of neighbouring frames, in units of their own size:
            what moves then need not be found as a small difference of large numbers.
        components: k, principal components of the training images. What is off them in the newest frame, beyond what is
            seen in training, enters as further channels; 0 for none. See `manifold`.
        excess_gain: factor of these channels.
        pool_episodes: episodes held in memory at a time, as uint8; all of them stay there if they are no more.
    """

    frames: int = 3
    channels: tuple[int, ...] = (16, 32, 64, 64)
    strides: int | tuple[int, ...] = (2, 1, 1, 1)
    pools: int | tuple[int, ...] = (2, 2, 2, 1)
    hidden: tuple[int, ...] = (128, 64)
    trunk_dropout: float | tuple[float, ...] = 0.0
    branches: int = 1
    feature_dropout: float = 0.2
    hidden_dropout: float | tuple[float, ...] = (0.3, 0.0)
    standardisation: str = "per-pixel"
    pixel_floor: float = 0.03
    differences: bool = True
    components: int = 0
    excess_gain: float = 4.0
    pool_episodes: int = 100
    loss: str = "beta-nll"
    warmup_epochs: int = 3
    epochs: int = 16
    batch_size: int = 128
    learning_rate: float = 1e-3

    def _check(self) -> None:
        for name in ("channels", "hidden"):
            widths = getattr(self, name)
            require(len(widths) > 0 and min(widths) > 0, name, widths, "one or more positive widths")
        factors_of("strides", self.strides, len(self.channels))
        factors_of("pools", self.pools, len(self.channels))
        rates_of("trunk_dropout", self.trunk_dropout, len(self.channels))
        rates_of("feature_dropout", self.feature_dropout, 1)
        rates_of("hidden_dropout", self.hidden_dropout, len(self.hidden))
        if self.standardisation not in STANDARDISATIONS:
            raise unknown("standardisation", self.standardisation, STANDARDISATIONS)
        for name in ("pixel_floor", "excess_gain"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        require(self.components >= 0, "components", self.components, "0 or a number of principal components")
        for channels in self.channels:
            fits = self.branches >= 1 and channels % self.branches == 0
            require(fits, "branches", self.branches, "a common divisor of channels")
        for name in ("frames", "pool_episodes"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "a positive integer")
        super()._check()

    @property
    def trunk_rates(self) -> tuple[float, ...]:
        """Dropout rate after every block."""
        return rates_of("trunk_dropout", self.trunk_dropout, len(self.channels))

    @property
    def head_rates(self) -> tuple[float, ...]:
        """Dropout rate on the features and after every fully connected layer."""
        return self.feature_dropout, *rates_of("hidden_dropout", self.hidden_dropout, len(self.hidden))

    @property
    def rates(self) -> tuple[float, ...]:
        """Dropout rates of trunk and head, in the order of the masks."""
        return self.trunk_rates + self.head_rates

    @property
    def shared_trunk(self) -> bool:
        """Whether all samples of a decision share one pass through the trunk."""
        return not any(self.trunk_rates)

    def depth(self, channels: int) -> int:
        """Channels of the network's input for frames of so many channels."""
        return (self.frames + (self.components > 0)) * channels

    def factors(self) -> list[tuple[int, int]]:
        """(stride, pool) of every block."""
        blocks = len(self.channels)
        strides, pools = factors_of("strides", self.strides, blocks), factors_of("pools", self.pools, blocks)
        return list(zip(strides, pools, strict=True))

    def block_shapes(self, height: int, width: int) -> list[tuple[int, int, int]]:
        """(height, width, channels) of every block's output for images of this size."""
        shapes = []
        for channels, (stride, pool) in zip(self.channels, self.factors(), strict=True):
            height, width = (-(-size // stride) // pool for size in (height, width))
            shapes.append((height, width, channels))
        require(min(height, width) > 0, "channels", self.channels, "few enough blocks for the size of the images")
        return shapes

    def layout(self, height: int, width: int) -> MaskLayout:
        """Layout of the masks of trunk and head for images of this size."""
        blocks = [int(np.prod(shape)) for shape in self.block_shapes(height, width)]
        if self.branches == 1:
            return MaskLayout.of((*blocks, blocks[-1], *self.hidden), self.rates)
        channel = np.arange(blocks[-1]) % self.channels[-1]  # features are flattened pixel by pixel
        branch = channel // (self.channels[-1] // self.branches)
        groups = (*[None] * len(blocks), branch, *[None] * len(self.hidden))
        return MaskLayout.of((*blocks, self.branches, *self.hidden), self.rates, groups)


@dataclass(frozen=True)
class PixelEncoding:
    """Stack of frames, uint8 -> network input, float32.

    The newest frame enters as `frame * scale + offset`. The older ones do too, or, with `change`, in their place the
    differences of neighbouring frames, `(frame - frame before) * change`.

    Attributes:
        scale: (H, W, C), float32.
        offset: (H, W, C), float32.
        change: (H, W, C), float32; None where frames enter as they are.
        components: (k, d), float32, principal components of standardised frames; None where there are none.
        reach: (d,), float32, what is hardly ever left of a training frame without them.
        gain: (1,), float32, factor of what exceeds it.
    """

    scale: NDArray[np.float32]
    offset: NDArray[np.float32]
    change: NDArray[np.float32] | None = None
    components: NDArray[np.float32] | None = None
    reach: NDArray[np.float32] | None = None
    gain: NDArray[np.float32] | None = None

    @classmethod
    def fit(cls, episodes: Iterable[NDArray[np.uint8]], config: VGGConfig) -> PixelEncoding:
        """Statistics of the training images, (L, H, W, C) an episode, in one pass; their order does not matter."""
        count, total, squares, changes = 0, *(np.zeros((), np.int64) for _ in range(3))
        for frames in episodes:
            # Integers: the sums are exact, and the same bits in whichever order they are made.
            count += len(frames)
            total = total + frames.sum(axis=0, dtype=np.int64)
            squares = squares + _squares(frames)
            changes = changes + _squares(np.diff(frames.astype(np.int16), axis=0))
        mean = total / count
        deviation = np.sqrt(np.maximum(squares / count - mean**2, 0.0)) / 255.0
        change = np.sqrt(changes / count) / 255.0
        mean /= 255.0
        if config.standardisation == "per-pixel":
            divisor, change = deviation + config.pixel_floor, change + config.pixel_floor
        else:
            divisor = change = np.ones_like(mean)
            mean = np.broadcast_to(mean.mean(axis=(0, 1)), mean.shape) * (config.standardisation == "centred")
        scale, offset, change = 1.0 / (255.0 * divisor), -mean / divisor, 1.0 / (255.0 * change)
        differences = change.astype(np.float32) if config.differences else None
        return cls(scale.astype(np.float32), offset.astype(np.float32), differences)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of a frame, (H, W, C)."""
        return self.scale.shape

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Scale and offset, and what else is used."""
        names = ("scale", "offset", "change", "components", "reach", "gain")
        parts = {name: getattr(self, name) for name in names}
        return {name: value for name, value in parts.items() if value is not None}

    def with_subspace(self, read: Callable[[], Iterable[NDArray[np.uint8]]], config: VGGConfig) -> PixelEncoding:
        """The same with the principal components of the training images; `read` begins to go through them again."""
        if not config.components:
            return self
        scale, offset = torch.from_numpy(self.scale), torch.from_numpy(self.offset)

        def standardised() -> Iterator[Tensor]:
            for frames in read():
                yield halved(torch.addcmul(offset, torch.from_numpy(frames).float(), scale))

        subspace = Subspace.fit(standardised, config.components, REACH_FLOOR)
        gain = np.array([config.excess_gain], np.float32)
        return replace(self, components=subspace.components, reach=subspace.reach, gain=gain)

    def excess(self, device: torch.device | str = "cpu") -> Excess | None:
        """What computes the excess of standardised frames; None where there is none."""
        if self.components is None or self.reach is None or self.gain is None:
            return None
        return Excess(Subspace(self.components, self.reach), float(self.gain[0]), device)

    def factors(self, frames: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Scale and offset (H, W, F C) of a whole stack, oldest first, after differences were taken."""
        if self.change is None:
            return np.tile(self.scale, frames), np.tile(self.offset, frames)
        older = frames - 1
        scales = [*[self.change] * older, self.scale]
        return np.concatenate(scales, axis=2), np.concatenate([*[0 * self.offset] * older, self.offset], axis=2)


def _squares(frames: NDArray[Any]) -> NDArray[np.int64]:
    """Sum of the squares over the frames (n, H, W, C), (H, W, C)."""
    return np.einsum("n...,n...->...", frames, frames, dtype=np.int64)


class DropoutVGG(nn.Module):
    """Trunk of convolution blocks, head of fully connected layers, dropout wherever `config` says.

    Args:
        shape: (H, W, C) of a frame.
        actions: number of actions, nu.
        config: see `VGGConfig`.
        generator: source of the initial weights (Kaiming uniform, small ones for the output).
    """

    def __init__(
        self, shape: Sequence[int], actions: int, config: VGGConfig, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.actions, self.config = actions, config
        height, width, depth = shape
        self.shapes = config.block_shapes(height, width)
        self.pools = [pool for _, pool in config.factors()]
        inputs = (config.depth(depth), *config.channels)
        # `skip_init`: a plain layer would draw its weights from the global generator.
        self.blocks = nn.ModuleList(
            nn.utils.skip_init(nn.Conv2d, a, b, 3, padding=1, stride=stride, groups=config.branches if block else 1)
            for block, ((a, b), (stride, _)) in enumerate(zip(pairwise(inputs), config.factors(), strict=True))
        )
        widths = (self.features, *config.hidden)
        self.layers = nn.ModuleList(nn.utils.skip_init(nn.Linear, a, b) for a, b in pairwise(widths))
        self.output = nn.utils.skip_init(nn.Linear, widths[-1], 2 * actions)
        for layer in self.weighted():
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        with torch.no_grad():
            self.output.weight.mul_(0.1)  # first predictions near 0, first variances near 1
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def features(self) -> int:
        """Number of flattened trunk features, d."""
        return int(np.prod(self.shapes[-1]))

    def linears(self) -> list[nn.Linear]:
        """The fully connected layers and the output layer, in order."""
        return [layer for layer in (*self.layers, self.output) if isinstance(layer, nn.Linear)]

    def weighted(self) -> list[nn.Conv2d | nn.Linear]:
        """Every layer with weights, in order."""
        return [*(layer for layer in self.blocks if isinstance(layer, nn.Conv2d)), *self.linears()]

    def forward(self, stacks: Tensor, masks: Sequence[Tensor | None] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, each (n, nu), for encoded stacks (n, F C, H, W), the newest frame last.

        `masks` has one entry per block (n, H' W' C'), one for the features (n, d) and one per fully connected layer
        (n, width): 0 for a dropped unit, 1 / (1 - rate) for a kept one; None keeps all. Without masks the network is
        deterministic (weight scaling).
        """
        masks = masks or [None] * len(self.config.rates)
        blocks = len(self.blocks)
        return self.head(self.trunk(stacks, masks[:blocks]), masks[blocks:])

    def trunk(self, stacks: Tensor, masks: Sequence[Tensor | None] | None = None) -> Tensor:
        """Flattened features (n, d), pixel by pixel, before their dropout."""
        hidden = stacks
        for index, block in enumerate(self.blocks):
            hidden = block(hidden)
            if self.pools[index] > 1:
                hidden = nn.functional.max_pool2d(hidden, self.pools[index])
            hidden = hidden.relu_()  # after the pool: the same numbers, and a quarter of the work
            mask = masks[index] if masks is not None else None
            if mask is not None:
                hidden = hidden * mask.view(-1, *self.shapes[index]).permute(0, 3, 1, 2)
        return hidden.permute(0, 2, 3, 1).flatten(1)

    def head(self, features: Tensor, masks: Sequence[Tensor | None]) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, each (n, nu), for trunk features (n, d)."""
        hidden = features if masks[0] is None else features * masks[0]
        for layer, mask in zip(self.layers, masks[1:], strict=True):
            hidden = torch.relu(layer(hidden))
            if mask is not None:
                hidden = hidden * mask
        mean, raw = self.output(hidden).split(self.actions, dim=1)
        return mean, bounded_log_var(raw, self.config.log_var_bounds)
