"""Training of the Bayesian MLP on demonstrations: heteroscedastic negative log-likelihood with dropout on.

Loss per sample `0.5 exp(-s) (y - mu)^2 + 0.5 s`, or its beta-NLL form (`networks.gaussian_nll`). AdamW, cosine
schedule, whole data set preloaded. One torch thread and named random streams: the same seed gives the same bits,
whatever else the machine does.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from safeswitch.demos import Demonstrations
from safeswitch.seeding import seed_sequence
from safeswitch_baselines.learners.bayesian import BayesianLearner
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
from safeswitch_baselines.learners.networks import BayesianMLP, InputEncoding, MLPConfig


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
    labels = checked_labels(demos)
    if not isinstance(demos.observations, np.ndarray):
        raise ValueError("a Bayesian MLP takes observations of shape (n, d), and these are images: use `dropout-vgg`")
    encoding = InputEncoding.fit(demos.observations, config.angles)
    inputs = encoding(demos.observations)
    held_out = held_out_episodes(demos.episodes, config.validation_fraction, seed)
    place = device_of(device)
    with one_thread():
        model = BayesianMLP(encoding.size, labels.shape[1], config, generator(seed, "weights")).to(place)
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
    order = generator(seed, "sample-order")
    layout = config.layout
    bits = np.random.PCG64DXSM(seed_sequence(seed, "training-masks"))
    optimiser = make_optimiser(model, config)
    history: History = {"loss": [], "learning_rate": []}
    model.train()
    with reporter(progress) as report:
        for epoch in range(config.epochs):
            permutation = torch.randperm(n, generator=order).to(inputs.device)
            warm_up = epoch < config.warmup_epochs
            total = torch.zeros((), device=inputs.device)
            for step in range(steps):
                rate = learning_rate(config, epoch * steps + step, config.epochs * steps)
                chosen = permutation[step * config.batch_size : (step + 1) * config.batch_size]
                masks = scaled_masks(layout.draw(bits, len(chosen)), config.rates, inputs.device)
                loss = batch_loss(model, inputs[chosen], labels[chosen], masks, config, warm_up)
                descend(model, optimiser, loss, rate, config.max_gradient_norm)
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


def evaluate(model: BayesianMLP, inputs: Tensor, labels: Tensor) -> tuple[float, float]:
    """Plain NLL per sample and RMSE [action units] with dropout off."""
    with torch.no_grad():
        mean, log_var = model(inputs)
        nll = gaussian_nll(mean, log_var, labels).sum(dim=1).mean().item()
        return nll, math.sqrt(((mean - labels) ** 2).mean().item())
