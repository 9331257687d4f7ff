"""Training of the Bayesian MLP on demonstrations: heteroscedastic negative log-likelihood with dropout on.

Loss per sample `0.5 exp(-s) (y - mu)^2 + 0.5 s`, or its beta-NLL form (`networks.gaussian_nll`). AdamW, cosine
schedule, whole data set preloaded. One torch thread and named random streams: the same seed gives the same bits,
whatever else the machine does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from safeswitch.demos import Demonstrations
from safeswitch.names import unknown
from safeswitch.seeding import seed_sequence, stream
from safeswitch_baselines.learners.bayesian import BayesianLearner, one_thread
from safeswitch_baselines.learners.networks import BayesianMLP, InputEncoding, MaskLayout, MLPConfig, gaussian_nll

History = dict[str, list[float]]
Progress = bool | Callable[[int, int], None]
"""True: a rich progress bar. A function: called with (epochs done, epochs). False: quiet."""

DEVICES = ("auto", "cpu", "cuda")


def train_bayesian_mlp(
    demos: Demonstrations,
    seed: int,
    config: MLPConfig | None = None,
    progress: Progress = False,
    device: str = "auto",
) -> BayesianLearner:
    """Train a Bayesian MLP on demonstrations.

    Args:
        demos: observations (n, d), clean expert labels (n, nu) in action units, episode index (n,).
        seed: learner seed; decides initial weights, order of the samples, masks and the validation episodes.
        config: see `MLPConfig`; None for its defaults.
        progress: True for a progress bar, a function for a bar of one's own.
        device: "auto" trains on a GPU where there is one; "cpu" or "cuda" choose. Decisions always run on the CPU.

    Returns:
        The learner; its `history` has one number per epoch for `loss` and `learning_rate` and, where episodes are
        held out, `validation_nll` and `validation_rmse` (dropout off, action units).
    """
    config = config or MLPConfig()
    labels = _checked_labels(demos)
    encoding = InputEncoding.fit(demos.observations, config.angles)
    inputs = encoding(demos.observations)
    held_out = _validation(demos.episodes, config.validation_fraction, seed)
    place = _device(device)
    with one_thread():
        model = BayesianMLP(encoding.size, labels.shape[1], config, _generator(seed, "weights")).to(place)
        x, y = (torch.from_numpy(value.astype(np.float32)).to(place) for value in (inputs, labels))
        out = torch.from_numpy(held_out).to(place)
        history = fit(model, (x[~out], y[~out]), (x[out], y[out]), seed, config, progress)
    return BayesianLearner(model, encoding, config, history)


def fit(
    model: BayesianMLP,
    train: tuple[Tensor, Tensor],
    validation: tuple[Tensor, Tensor],
    seed: int,
    config: MLPConfig,
    progress: Progress = False,
) -> History:
    """Train `model` in place on (network inputs (n, e), labels (n, nu)); `validation` may be empty."""
    inputs, labels = train
    n = len(inputs)
    steps = math.ceil(n / config.batch_size)
    order = _generator(seed, "sample-order")
    layout = MaskLayout.of(config)
    bits = np.random.PCG64DXSM(seed_sequence(seed, "training-masks"))
    optimiser = _optimiser(model, config)
    history: History = {"loss": [], "learning_rate": []}
    model.train()
    with _reporter(progress) as report:
        for epoch in range(config.epochs):
            permutation = torch.randperm(n, generator=order).to(inputs.device)
            warm_up = epoch < config.warmup_epochs
            total = torch.zeros((), device=inputs.device)
            for step in range(steps):
                rate = _learning_rate(config, epoch * steps + step, config.epochs * steps)
                chosen = permutation[step * config.batch_size : (step + 1) * config.batch_size]
                masks = scaled_masks(layout.draw(bits, len(chosen)), config.rates, inputs.device)
                loss = batch_loss(model, inputs[chosen], labels[chosen], masks, config, warm_up)
                _descend(model, optimiser, loss, rate, config.max_gradient_norm)
                total += loss.detach() * len(chosen)
            history["loss"].append(total.item() / n)
            history["learning_rate"].append(rate)
            if len(validation[0]):
                nll, rmse = evaluate(model, *validation)
                history.setdefault("validation_nll", []).append(nll)
                history.setdefault("validation_rmse", []).append(rmse)
            report(epoch + 1, config.epochs)
    model.eval()
    return history


def scaled_masks(
    keep: Sequence[NDArray[np.bool_] | None], rates: Sequence[float], device: torch.device
) -> list[Tensor | None]:
    """Factors of the hidden units from keep-masks: 0 for a dropped unit, 1 / (1 - rate) for a kept one."""
    return [
        None if mask is None else torch.from_numpy(mask * np.float32(1.0 / (1.0 - rate))).to(device)
        for mask, rate in zip(keep, rates, strict=True)
    ]


def batch_loss(
    model: BayesianMLP,
    inputs: Tensor,
    labels: Tensor,
    masks: Sequence[Tensor | None],
    config: MLPConfig,
    warm_up: bool = False,
) -> Tensor:
    """Loss of one batch, summed over action components and averaged over samples."""
    mean, log_var = model(inputs, masks)
    if warm_up:
        loss = 0.5 * (labels - mean) ** 2
    else:
        loss = gaussian_nll(mean, log_var, labels, config.beta if config.loss == "beta-nll" else 0.0)
    return loss.sum(dim=1).mean()


def evaluate(model: BayesianMLP, inputs: Tensor, labels: Tensor) -> tuple[float, float]:
    """Plain NLL per sample and RMSE [action units] with dropout off."""
    with torch.no_grad():
        mean, log_var = model(inputs)
        nll = gaussian_nll(mean, log_var, labels).sum(dim=1).mean().item()
        return nll, math.sqrt(((mean - labels) ** 2).mean().item())


def _descend(model: BayesianMLP, optimiser: torch.optim.Optimizer, loss: Tensor, rate: float, max_norm: float) -> None:
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    if max_norm > 0:
        torch.nn.utils.clip_grad_norm_(model.parameters(), max_norm)
    optimiser.step()


def _optimiser(model: BayesianMLP, config: MLPConfig) -> torch.optim.Optimizer:
    weights = [layer.weight for layer in model.linears()]
    biases = [layer.bias for layer in model.linears()]
    groups = [
        {"params": weights, "weight_decay": config.weight_decay},
        {"params": biases, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=config.learning_rate, fused=True)


def _learning_rate(config: MLPConfig, step: int, steps: int) -> float:
    """Cosine from the peak to zero, after a linear rise over the first 2 % of the steps."""
    rise = max(1, steps // 50)
    if step < rise:
        return config.learning_rate * (step + 1) / rise
    return 0.5 * config.learning_rate * (1.0 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


def _validation(episodes: np.ndarray, fraction: float, seed: int) -> np.ndarray:
    """Boolean (n,): samples of the held-out episodes. Whole episodes, as neighbouring steps are nearly copies."""
    names = np.unique(episodes)
    count = min(math.ceil(fraction * len(names)), len(names) - 1)
    chosen = stream(seed, "validation-episodes").permutation(names)[:count]
    return np.isin(episodes, chosen)


def _checked_labels(demos: Demonstrations) -> np.ndarray:
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
        if not np.isfinite(values).all():
            raise ValueError(f"demonstrations hold values that are not finite in {name}")
    return labels


def _device(name: str) -> torch.device:
    if name not in DEVICES:
        raise unknown("device", name, DEVICES)
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(name)


def _generator(seed: int, name: str) -> torch.Generator:
    return torch.Generator().manual_seed(int(seed_sequence(seed, name).generate_state(1, np.uint64)[0] >> np.uint64(1)))


@contextmanager
def _reporter(progress: Progress) -> Iterator[Callable[[int, int], None]]:
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
