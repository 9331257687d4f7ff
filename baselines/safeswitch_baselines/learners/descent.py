"""Gradient descent on demonstrations, the same for every Bayesian learner: loss, optimiser, schedule and streams."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor, nn

from safeswitch.demos import Demonstrations
from safeswitch.names import unknown
from safeswitch.seeding import seed_sequence, stream
from safeswitch_baselines.learners.config import TrainingConfig
from safeswitch_baselines.learners.gaussian import gaussian_nll

History = dict[str, list[float]]
Progress = bool | Callable[[int, int], None]
"""True: a rich progress bar. A function: called with (epochs done, epochs). False: quiet."""

DEVICES = ("auto", "cpu", "cuda")


def batch_loss(
    model: nn.Module,
    inputs: Tensor,
    labels: Tensor,
    masks: Sequence[Tensor | None],
    config: TrainingConfig,
    warm_up: bool = False,
) -> Tensor:
    """Loss of one batch, summed over action components and averaged over samples."""
    mean, log_var = model(inputs, masks)
    if warm_up:
        loss = 0.5 * (labels - mean) ** 2
    else:
        loss = gaussian_nll(mean, log_var, labels, config.beta if config.loss == "beta-nll" else 0.0)
    return loss.sum(dim=1).mean()


def descend(model: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor, rate: float, max_norm: float) -> None:
    """One step at learning rate `rate`, with gradients clipped to the norm `max_norm` where that is not 0."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    if max_norm > 0:
        torch.nn.utils.clip_grad_norm_(model.parameters(), max_norm)
    optimiser.step()


def make_optimiser(model: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """AdamW; weight decay on matrices and kernels, not on biases."""
    parameters = list(model.parameters())
    groups = [
        {"params": [each for each in parameters if each.ndim > 1], "weight_decay": config.weight_decay},
        {"params": [each for each in parameters if each.ndim == 1], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=config.learning_rate, fused=True)


def learning_rate(config: TrainingConfig, step: int, steps: int) -> float:
    """Cosine from the peak to zero, after a linear rise over the first 2 % of the steps."""
    rise = max(1, steps // 50)
    if step < rise:
        return config.learning_rate * (step + 1) / rise
    return 0.5 * config.learning_rate * (1.0 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


def held_out_episodes(episodes: np.ndarray, fraction: float, seed: int) -> np.ndarray:
    """Boolean (n,): samples of the held-out episodes. Whole episodes, as neighbouring steps are nearly copies."""
    names = np.unique(episodes)
    count = min(math.ceil(fraction * len(names)), len(names) - 1)
    chosen = stream(seed, "validation-episodes").permutation(names)[:count]
    return np.isin(episodes, chosen)


def checked_labels(demos: Demonstrations) -> np.ndarray:
    """Labels (n, nu) of demonstrations whose parts belong together and are finite."""
    labels = np.asarray(demos.actions, dtype=np.float64)
    n = len(demos.observations)
    if n == 0:
        raise ValueError("no demonstrations: observations have length 0")
    if labels.ndim != 2 or len(labels) != n or len(demos.episodes) != n:
        raise ValueError(
            f"demonstrations disagree: observations {demos.observations.shape}, actions {labels.shape} (expected "
            f"({n}, nu)), episodes {demos.episodes.shape} (expected ({n},))"
        )
    for name, values in (("observations", demos.observations), ("actions", labels)):
        # Integers, as images are, need no look at: they may still lie in a file.
        if values.dtype.kind not in "iu" and not np.isfinite(values).all():
            raise ValueError(f"demonstrations hold values that are not finite in {name}")
    return labels


def device_of(name: str) -> torch.device:
    """The device called `name`; "auto" is a GPU where there is one."""
    if name not in DEVICES:
        raise unknown("device", name, DEVICES)
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(name)


def generator(seed: int, name: str) -> torch.Generator:
    """Torch's generator of the stream `name` of `seed`."""
    return torch.Generator().manual_seed(int(seed_sequence(seed, name).generate_state(1, np.uint64)[0] >> np.uint64(1)))


@contextmanager
def reporter(progress: Progress) -> Iterator[Callable[[int, int], None]]:
    """What is called after every epoch."""
    if callable(progress):
        yield progress
    elif progress:
        from rich.progress import Progress as Bar

        with Bar(transient=True) as bar:
            task = bar.add_task("training", total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
    else:
        yield lambda done, total: None
