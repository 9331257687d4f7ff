"""What is new in an image: the part of it off the subspace of the training images, beyond the size seen there.

The images of one scene lie near a subspace of few dimensions, their first principal components: how a border moves when
the car turns is in them, and what no training image shows is not. With z a standardised image at half the resolution,

    r = z - V' V z,    excess = gain * sign(r) * max(|r| / q - 1, 0)

where q is a high quantile of |r| of each number over the training images. In training the excess is nearly always 0, so
that whatever reads it keeps its random initial weights; where something new stands it is large, also in front of pixels
that vary much in training, for which standardisation alone is blind. There the network's answer is that of its prior,
as with randomized prior functions (Osband et al. 2018, arXiv 1806.03335), and its posterior samples disagree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from safeswitch.seeding import stream

Floats = NDArray[np.float32]
Episodes = Callable[[], Iterable[Tensor]]
"""Makes an iterator over the training images of one episode after the other, (L, d)."""

OVERSAMPLING, PASSES = 16, 3
"""Of the randomised range finder: further directions, and passes over the data."""
QUANTILE, STRIDE = 0.995, 4
"""Of |r|, taken over every fourth training image."""


def halved(images: Tensor) -> Tensor:
    """Standardised images (n, H, W, C) at half the resolution, each the mean of four pixels, flattened (n, d)."""
    n, height, width, depth = images.shape
    return images.reshape(n, height // 2, 2, width // 2, 2, depth).mean(dim=(2, 4)).flatten(1)


@dataclass(frozen=True)
class Subspace:
    """Subspace of the training images, and how far they are off it.

    Attributes:
        components: (k, d), V, orthonormal rows.
        reach: (d,), q: what |r| hardly ever exceeds in training.
    """

    components: Floats
    reach: Floats

    @classmethod
    def fit(cls, episodes: Episodes, count: int, floor: float) -> Subspace:
        """First `count` principal components, and what they leave.

        Halko, Martinsson & Tropp 2011, https://doi.org/10.1137/090771806, algorithm 4.4, in passes over the episodes.

        Args:
            episodes: the training images, (L, d) an episode.
            count: k.
            floor: smallest q, in units of a standardised pixel.
        """
        basis: Tensor | None = None
        for _ in range(PASSES):
            product: Tensor | None = None
            for images in episodes():
                if basis is None:
                    shape = (images.shape[1], count + OVERSAMPLING)
                    basis = torch.from_numpy(stream(0, "principal-components").standard_normal(shape, np.float32))
                part = images.t() @ (images @ basis)
                product = part if product is None else product + part
            assert product is not None
            basis, _ = torch.linalg.qr(product)
        assert basis is not None
        components = _rotated(basis, episodes)[:, :count].t().contiguous()
        rows = [images[::STRIDE] - (images[::STRIDE] @ components.t()) @ components for images in episodes()]
        reach = np.quantile(torch.cat(rows).abs().numpy(), QUANTILE, axis=0)
        return cls(components.numpy(), np.maximum(reach, floor).astype(np.float32))


def _rotated(basis: Tensor, episodes: Episodes) -> Tensor:
    """The orthonormal `basis` (d, m) turned onto the principal axes within it, the largest first."""
    small = torch.zeros(basis.shape[1], basis.shape[1])
    for images in episodes():
        seen = images @ basis
        small += seen.t() @ seen
    _, axes = torch.linalg.eigh(small)
    return basis @ axes.flip(1)


class Excess:
    """Computes what is new in standardised images.

    Args:
        subspace: of the training images.
        gain: factor of the excess.
        device: where the images are.
    """

    def __init__(self, subspace: Subspace, gain: float, device: torch.device | str = "cpu") -> None:
        # `clone`: memory that torch aligned itself, so that products round the same in every process.
        self._components = torch.from_numpy(subspace.components).clone().to(device)
        self._inverse = torch.from_numpy(1.0 / subspace.reach).clone().to(device)
        self._gain = gain

    def __call__(self, images: Tensor) -> Tensor:
        """Excess (n, H, W, C) of standardised images (n, H, W, C), each value in a square of four pixels."""
        n, height, width, depth = images.shape
        small = halved(images)
        left = (small - (small @ self._components.t()) @ self._components) * self._inverse
        excess = self._gain * (left - left.clamp(-1.0, 1.0))
        square = excess.view(n, height // 2, 1, width // 2, 1, depth)
        return square.expand(-1, -1, 2, -1, 2, -1).reshape(images.shape)
