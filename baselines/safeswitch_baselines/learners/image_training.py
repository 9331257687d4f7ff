"""Training of the DropoutVGG on demonstrations with images, which are streamed from their dataset.

Only the episodes of one pool are decoded at a time, as uint8; stacks of frames exist for one batch. Every epoch deals
the episodes into new pools and shuffles the samples within a pool, so each sample is seen once per epoch. One torch
thread and named random streams: the same seed gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from safeswitch.demos import Demonstrations
from safeswitch.seeding import seed_sequence, stream
from safeswitch_baselines.learners.descent import (
    History,
    Progress,
    batch_loss,
    checked_labels,
    descend,
    device_of,
    generator,
    held_out_episodes,
    learning_rate,
    make_optimiser,
    reporter,
)
from safeswitch_baselines.learners.dropout import one_thread, scaled_masks
from safeswitch_baselines.learners.gaussian import gaussian_nll
from safeswitch_baselines.learners.vgg import DropoutVGG, PixelEncoding, VGGConfig

EVALUATION_BATCH = 256
"""Samples of a batch without gradients."""


@dataclass(frozen=True)
class Pool:
    """Decoded episodes of m steps in all, from which stacks are put together a batch at a time.

    Attributes:
        frames: (m, C, H, W) uint8.
        stacks: (m, F), rows of `frames` that each step sees, oldest first, none from another episode.
        labels: (m, nu), float32.
    """

    frames: Tensor
    stacks: Tensor
    labels: Tensor

    @classmethod
    def read(cls, demos: Demonstrations, episodes: Sequence[int], frames: int) -> Pool:
        """Decode these episodes; stacks of `frames` frames."""
        pixels, rows, labels, start = [], [], [], 0
        for episode in episodes:
            images = demos.episode(episode)
            pixels.append(images.transpose(0, 3, 1, 2))
            steps = np.arange(len(images))[:, None] - np.arange(frames)[::-1]
            rows.append(start + np.maximum(steps, 0))
            labels.append(demos.actions[demos.steps(episode)])
            start += len(images)
        return cls(
            torch.from_numpy(np.concatenate(pixels)),
            torch.from_numpy(np.concatenate(rows)),
            torch.from_numpy(np.concatenate(labels).astype(np.float32)),
        )

    def __len__(self) -> int:
        return len(self.stacks)


class Encoder:
    """Rows of a pool -> encoded stacks (n, F C, H, W), channels last.

    All batches share the same memory: fresh memory of this size costs more than the work done in it.

    Args:
        encoding: of a frame.
        frames: F.
        rows: largest batch.
        device: where the stacks go.
    """

    def __init__(self, encoding: PixelEncoding, frames: int, rows: int, device: torch.device) -> None:
        height, width, depth = encoding.observation_shape
        self._scale, self._offset = (torch.from_numpy(value).to(device) for value in encoding.factors(frames))
        self._differences = encoding.change is not None
        self._frames = torch.empty(rows, frames * depth, height, width, dtype=torch.uint8)
        self._pixels = torch.empty(rows, height, width, frames * depth, dtype=torch.uint8)
        self._excess = encoding.excess(device)
        self._images = frames * depth
        channels = self._images + (self._excess is not None) * depth
        self._encoded = torch.empty(rows, height, width, channels, device=device)
        self._depth = depth
        self.device = device

    def __call__(self, pool: Pool, rows: Tensor) -> Tensor:
        """Stacks of these rows, valid until the next call."""
        frames, pixels, whole = (each[: len(rows)] for each in (self._frames, self._pixels, self._encoded))
        encoded = whole[..., : self._images]
        each_frame = frames.view(-1, self._depth, *frames.shape[2:])
        torch.index_select(pool.frames, 0, pool.stacks[rows].flatten(), out=each_frame)
        pixels.copy_(frames.permute(0, 2, 3, 1))  # while they are bytes: a quarter of the memory to go through
        encoded.copy_(pixels)
        if self._differences:
            encoded[..., : -self._depth] = encoded[..., self._depth :] - encoded[..., : -self._depth]
        torch.addcmul(self._offset, encoded, self._scale, out=encoded)
        if self._excess is not None:
            whole[..., self._images :] = self._excess(encoded[..., -self._depth :])
        return whole.permute(0, 3, 1, 2)


def train_dropout_vgg(
    demos: Demonstrations,
    seed: int,
    config: VGGConfig | None = None,
    progress: Progress = False,
    device: str = "auto",
) -> tuple[DropoutVGG, PixelEncoding, History]:
    """Train a DropoutVGG on demonstrations.

    Args:
        demos: images (n, H, W, C) uint8, clean expert labels (n, nu) in action units, episode index (n,).
        seed: learner seed; decides initial weights, pools, order of the samples, masks and the validation episodes.
        config: see `VGGConfig`; None for its defaults.
        progress: True for a progress bar, a function for a bar of one's own.
        device: "auto" trains on a GPU where there is one; "cpu" or "cuda" choose. Decisions always run on the CPU.

    Returns:
        Network, encoding and history: one number per epoch for `loss` and `learning_rate` and, where
        episodes are held out, `validation_nll` and `validation_rmse` (dropout off, action units).
    """
    config = config or VGGConfig()
    labels = checked_labels(demos)
    if len(demos.observations.shape) != 4 or demos.observations.dtype != np.uint8:
        raise ValueError(
            f"a DropoutVGG takes images of shape (n, H, W, C) and type uint8; got {demos.observations.shape} and "
            f"{demos.observations.dtype}"
        )
    out = held_out_episodes(demos.episodes, config.validation_fraction, seed)
    training, held_out = (np.unique(demos.episodes[chosen]) for chosen in (~out, out))
    shape = demos.observations.shape[1:]
    config.block_shapes(*shape[:2])
    place = device_of(device)
    with one_thread():

        def images() -> Iterator[NDArray[np.uint8]]:
            return (demos.episode(int(index)) for index in training)

        encoding = PixelEncoding.fit(images(), config).with_subspace(images, config)
        model = DropoutVGG(shape, labels.shape[1], config, generator(seed, "weights")).to(place)
        history = fit(model, encoding, demos, training, held_out, seed, config, progress)
    return model, encoding, history


def fit(
    model: DropoutVGG,
    encoding: PixelEncoding,
    demos: Demonstrations,
    training: NDArray[np.int64],
    held_out: NDArray[np.int64],
    seed: int,
    config: VGGConfig,
    progress: Progress = False,
) -> History:
    """Train `model` in place on the episodes `training`; `held_out` are for validation and may be empty."""
    place = next(model.parameters()).device
    encoders = [Encoder(encoding, config.frames, max(config.batch_size, EVALUATION_BATCH), place) for _ in range(2)]
    layout = config.layout(*encoding.observation_shape[:2])
    bits = np.random.PCG64DXSM(seed_sequence(seed, "training-masks"))
    optimiser = make_optimiser(model, config)
    n = int(np.isin(demos.episodes, training).sum())
    validation = Pool.read(demos, list(held_out), config.frames) if len(held_out) else None
    history: History = {"loss": [], "learning_rate": []}
    model.train()
    with reporter(progress) as report:
        seen = 0
        for epoch, batches in enumerate(epochs_of(demos, training, seed, config)):
            warm_up = epoch < config.warmup_epochs
            total = torch.zeros((), device=place)
            for pool, rows, stacks in encoded_ahead(batches, encoders):
                rate = learning_rate(config, seen, config.epochs * n)
                masks = scaled_masks(layout.draw(bits, len(rows)), config.rates, place)
                labels = pool.labels[rows].to(place)
                loss = batch_loss(model, stacks, labels, masks, config, warm_up)
                descend(model, optimiser, loss, rate, config.max_gradient_norm)
                total += loss.detach() * len(rows)
                seen += len(rows)
            history["loss"].append(total.item() / n)
            history["learning_rate"].append(rate)
            if validation is not None:
                nll, rmse = evaluate(model, encoders[0], validation)
                history.setdefault("validation_nll", []).append(nll)
                history.setdefault("validation_rmse", []).append(rmse)
            report(epoch + 1, config.epochs)
    model.eval()
    return history


def epochs_of(
    demos: Demonstrations, episodes: NDArray[np.int64], seed: int, config: VGGConfig
) -> Iterator[Iterator[tuple[Pool, Tensor]]]:
    """For every epoch its batches: a pool, and the rows of it that form the batch."""
    rng = stream(seed, "sample-order")
    kept: Pool | None = None
    if len(episodes) <= config.pool_episodes:
        kept = Pool.read(demos, list(episodes), config.frames)
    for _ in range(config.epochs):
        yield _batches(demos, episodes, rng, config, kept)


def _batches(
    demos: Demonstrations, episodes: NDArray[np.int64], rng: np.random.Generator, config: VGGConfig, kept: Pool | None
) -> Iterator[tuple[Pool, Tensor]]:
    order = rng.permutation(episodes)
    for start in range(0, len(order), config.pool_episodes):
        pool = kept or Pool.read(demos, list(order[start : start + config.pool_episodes]), config.frames)
        rows = torch.from_numpy(rng.permutation(len(pool)))
        for first in range(0, len(rows), config.batch_size):
            yield pool, rows[first : first + config.batch_size]


def encoded_ahead(
    batches: Iterator[tuple[Pool, Tensor]], encoders: Sequence[Encoder]
) -> Iterator[tuple[Pool, Tensor, Tensor]]:
    """The batches with their encoded stacks, the next one of which a second thread prepares meanwhile.

    That is a fifth of the work of training, and where another core is idle it costs no time. The bits are the same.
    """

    def encode(batch: tuple[Pool, Tensor], encoder: Encoder) -> tuple[Pool, Tensor, Tensor]:
        return *batch, encoder(*batch)

    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) as executor:
        ahead = None
        for batch, encoder in zip(batches, cycle(encoders), strict=False):
            ready, ahead = ahead, executor.submit(encode, batch, encoder)
            if ready is not None:
                yield ready.result()
        if ahead is not None:
            yield ahead.result()


def evaluate(model: DropoutVGG, encoder: Encoder, pool: Pool) -> tuple[float, float]:
    """Plain NLL per sample and RMSE [action units] with dropout off."""
    nll, squares = 0.0, 0.0
    with torch.no_grad():
        for rows in torch.arange(len(pool)).split(EVALUATION_BATCH):
            labels = pool.labels[rows].to(encoder.device)
            mean, log_var = model(encoder(pool, rows))
            nll += gaussian_nll(mean, log_var, labels).sum().item()
            squares += ((mean - labels) ** 2).sum().item()
    return nll / len(pool), math.sqrt(squares / pool.labels.numel())


def trunk_features(model: DropoutVGG, encoding: PixelEncoding, demos: Demonstrations) -> NDArray[np.float32]:
    """Features (n, d) of every step, an episode at a time, without dropout."""
    encoder = Encoder(encoding, model.config.frames, EVALUATION_BATCH, next(model.parameters()).device)
    features = []
    with one_thread(), torch.inference_mode():
        for episode in np.unique(demos.episodes):
            pool = Pool.read(demos, [int(episode)], model.config.frames)
            for rows in torch.arange(len(pool)).split(EVALUATION_BATCH):
                features.append(model.trunk(encoder(pool, rows)).numpy())
    return np.concatenate(features)
