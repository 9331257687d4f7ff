"""Dropout as a sample of the posterior (Gal & Ghahramani 2016, arXiv 1506.02142): masks and the layers they act on.

Masks are arguments of a network, never drawn inside: training draws them from its own generator, a decision from one
keyed by (episode seed, step). No global random generator is touched.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from safeswitch.seeding import seed_sequence

Masks = Sequence[NDArray[np.bool_] | None]


@dataclass(frozen=True)
class MaskLayout:
    """Where the dropout units of the layers lie in one block of random numbers (rows, units).

    A unit is kept when a uniform 16-bit number is at least rate * 65536, so a rate is met to 1 / 65536.

    Attributes:
        columns: the block's columns of each layer; None for a layer without dropout.
        limits: (units,), smallest number that keeps each unit.
        groups: of each layer, None or (width,) the dropout unit that each of its numbers belongs to.
    """

    columns: tuple[slice | None, ...]
    limits: NDArray[np.uint16]
    groups: tuple[NDArray[np.intp] | None, ...]

    @classmethod
    def of(
        cls,
        widths: Sequence[int],
        rates: Sequence[float],
        groups: Sequence[NDArray[np.intp] | None] | None = None,
    ) -> MaskLayout:
        """Layout of layers with these numbers of dropout units and these rates."""
        used = [width if rate > 0 else 0 for width, rate in zip(widths, rates, strict=True)]
        limits = np.repeat([round(rate * 65536) for rate in rates], used).astype(np.uint16)
        columns = tuple(slice(int(a), int(b)) if b > a else None for a, b in pairwise(np.cumsum([0, *used])))
        return cls(columns, limits, (None,) * len(columns) if groups is None else tuple(groups))

    def words(self, rows: int) -> int:
        """64-bit words that `rows` rows take from a bit generator."""
        return -(-rows * len(self.limits) // 4)

    def draw(self, bits: np.random.BitGenerator, rows: int) -> list[NDArray[np.bool_] | None]:
        """Independent masks, one (rows, width) per layer; True keeps the unit."""
        numbers = bits.random_raw(self.words(rows)).view(np.uint16)[: rows * len(self.limits)]
        keep = numbers.reshape(rows, len(self.limits)) >= self.limits
        return [
            None if columns is None else keep[:, columns] if group is None else keep[:, columns][:, group]
            for columns, group in zip(self.columns, self.groups, strict=True)
        ]


class MaskStream:
    """Dropout masks of the decisions, keyed by (episode seed, step).

    The seed keys one long PCG64DXSM sequence, and step s reads its own stretch of it, reached by a jump.

    Args:
        layout: widths and dropout rates of the layers.
        samples: K, masks of a decision.
    """

    def __init__(self, layout: MaskLayout, samples: int) -> None:
        self._layout = layout
        self._samples = samples
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Key the stream by an episode seed."""
        self._bits = np.random.PCG64DXSM(seed_sequence(seed, "dropout-masks"))
        self._start = self._bits.state

    def draw(self, step: int) -> list[NDArray[np.bool_] | None]:
        """Masks of environment step `step`, one (K, width) per layer, None without dropout."""
        if step < 0:
            raise ValueError(f"step={step} is not allowed: it counts the environment's steps from 0")
        self._bits.state = self._start
        self._bits.advance(int(step) * self._layout.words(self._samples))
        return self._layout.draw(self._bits, self._samples)


def scaled_masks(keep: Masks, rates: Sequence[float], device: torch.device | str = "cpu") -> list[Tensor | None]:
    """Factors of the units from keep-masks: 0 for a dropped unit, 1 / (1 - rate) for a kept one."""
    return [
        None if mask is None else torch.from_numpy(mask * np.float32(1.0 / (1.0 - rate))).to(device)
        for mask, rate in zip(keep, rates, strict=True)
    ]


class FrozenLayers:
    """Linear layers with ReLU between, frozen for single decisions: all samples in one pass, no autograd.

    Layers before the first dropout are the same for all samples and computed once. The scale 1 / (1 - rate) of kept
    units is folded into the weights that read them.

    Args:
        linears: the layers, the output layer last.
        rates: dropout rate on the input of each layer.
        samples: K.
        shared: whether the input is one row for all samples; otherwise it has K rows.
    """

    def __init__(self, linears: Sequence[nn.Linear], rates: Sequence[float], samples: int, shared: bool = True) -> None:
        scales = [1.0 / (1.0 - rate) if rate > 0 else 1.0 for rate in rates]
        # `clone` puts every matrix into memory that torch aligned; a tensor read from a file need not be.
        self._weights = [
            (layer.weight.detach().cpu() * scale).t().contiguous().clone()
            for layer, scale in zip(linears, scales, strict=True)
        ]
        self._biases = [layer.bias.detach().cpu().clone() for layer in linears]
        # Outputs are computed transposed: a product with two long columns takes twice the time of two long rows.
        self._weights[-1] = self._weights[-1].t().contiguous()
        self._biases[-1] = self._biases[-1][:, None]
        first = next((index for index, rate in enumerate(rates) if rate > 0), len(rates))
        rows = [samples if index > first or not shared else 1 for index in range(len(rates))]
        # What each layer reads, before and after its dropout.
        self._before = [torch.empty(n, layer.in_features) for n, layer in zip(rows, linears, strict=True)]
        self._after = [
            torch.empty(samples, read.shape[1]) if index == first else read for index, read in enumerate(self._before)
        ]
        # The same memory seen by numpy, which is faster at the small element-wise steps.
        self._before_views = [read.numpy() for read in self._before]
        self._after_views = [read.numpy() for read in self._after]
        self._output = torch.empty(linears[-1].out_features, len(self._after[-1]))
        self._output_view = self._output.numpy()

    @property
    def inputs(self) -> NDArray[np.float32]:
        """Where to write the input (1, e), or (K, e) if it is not shared, before a call."""
        return self._before_views[0]

    @property
    def first_hidden(self) -> NDArray[np.float32]:
        """Activations (rows, h) of the first layer at the last call; before dropout if that was the first one."""
        return self._before_views[1]

    def __call__(self, masks: Masks) -> NDArray[np.float64]:
        """Raw outputs (2 nu, K), or (2 nu, 1) without dropout, for what was written into `inputs`."""
        last = len(self._weights) - 1
        for index, mask in enumerate(masks):
            if mask is not None:
                np.multiply(self._before_views[index], mask, out=self._after_views[index])
            reading = self._after[index]
            if index < last:
                torch.addmm(self._biases[index], reading, self._weights[index], out=self._before[index + 1]).relu_()
        torch.addmm(self._biases[-1], self._weights[-1], self._after[-1].t(), out=self._output)
        return self._output_view.astype(np.float64)


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread inside the block, then as before: the number of threads must not change any rounding."""
    threads = torch.get_num_threads()
    if threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
