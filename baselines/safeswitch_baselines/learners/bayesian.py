"""The Bayesian learner: K dropout samples of an MLP in one batched pass (Kendall & Gal 2017; Gal & Ghahramani 2016).

    action        = mean_k mu_k           (clipped to [-1, 1])
    epistemic_var = var_k mu_k            (population variance)
    aleatoric_var = mean_k sigma_k^2

The K masks of a decision are a function of (episode seed, environment step) alone (`MaskStream`). Two runs that visit
the same state at the same step therefore predict the same bits, whatever was predicted before, in whichever process
and with however many workers. Only one torch thread is used, and weights and buffers lie in memory that torch aligned
itself, because matrix products may round differently otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from safeswitch.protocols import Prediction
from safeswitch_baselines.learners.dropout import FrozenLayers, MaskStream, one_thread
from safeswitch_baselines.learners.gaussian import moments
from safeswitch_baselines.learners.networks import BayesianMLP, InputEncoding, MLPConfig
from safeswitch_baselines.learners.trained import TrainedLearner

if TYPE_CHECKING:
    from safeswitch.demos import Demonstrations
    from safeswitch_baselines.learners.training import Progress


class BayesianLearner(TrainedLearner[BayesianMLP, InputEncoding, MLPConfig]):
    """Bayesian MLP as a `safeswitch.protocols.Learner`; see `TrainedLearner` for its arguments."""

    FORMAT = "safeswitch-bayesian-mlp-1"

    def _prepare(self) -> None:
        """Build what `predict` needs from the model."""
        self._network = FrozenLayers(self.model.linears(), (0.0, *self.config.rates), self.config.samples)
        self._masks = MaskStream(self.config.layout, self.config.samples)

    def reset(self, seed: int) -> None:
        """Start an episode: key the dropout masks by its seed."""
        self._masks.reset(seed)

    def predict(self, observation: NDArray[Any], step: int) -> Prediction:
        """Action and variances for one observation (d,) at environment step `step`.

        `features` are the activations (h,) of the first hidden layer before dropout: the trunk all samples share.
        """
        self._network.inputs[...] = self.encoding(self._checked(observation)[None, :])
        masks = self._masks.draw(step)
        with one_thread(), torch.inference_mode():
            output = self._network([None, *masks])
        features = self._network.first_hidden[0].copy()
        action, epistemic_var, aleatoric_var = moments(output, self.model.actions, self.config.log_var_bounds)
        return Prediction(np.minimum(np.maximum(action, -1.0), 1.0), epistemic_var, aleatoric_var, features)

    def _checked(self, observation: NDArray[Any]) -> NDArray[np.float64]:
        value = np.asarray(observation, dtype=np.float64)
        if value.shape != self.encoding.observation_shape:
            raise ValueError(
                f"observation has shape {value.shape}, but this learner was trained on observations of shape "
                f"{self.encoding.observation_shape}"
            )
        if not np.isfinite(value).all():
            raise ValueError(f"observation must be finite; got {value.tolist()}")
        return value

    def features(self, demonstrations: Demonstrations) -> NDArray[np.float32]:
        """First hidden layer (n, h) of every training step, in order, before dropout.

        Computed in one batch; the features of `predict` may differ in the last bits.
        """
        inputs = torch.from_numpy(self.encoding(np.asarray(demonstrations.observations)).astype(np.float32))
        with one_thread(), torch.inference_mode():
            return torch.relu(self.model.linears()[0](inputs)).numpy()

    @classmethod
    def train(
        cls, demos: Demonstrations, seed: int, options: Mapping[str, Any] | None = None, progress: Progress = False
    ) -> BayesianLearner:
        """Train on demonstrations; `options` are fields of `MLPConfig`. See `training.train_bayesian_mlp`."""
        from safeswitch_baselines.learners.training import train_bayesian_mlp

        return train_bayesian_mlp(demos, seed, MLPConfig.from_json(options or {}), progress)

    @classmethod
    def _parts(
        cls, description: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
    ) -> tuple[InputEncoding, MLPConfig]:
        config = MLPConfig.from_json(description["config"])
        return InputEncoding(tuple(description["observation_shape"]), config.angles, **arrays), config

    @staticmethod
    def _build(encoding: InputEncoding, config: MLPConfig, actions: int, generator: torch.Generator) -> BayesianMLP:
        return BayesianMLP(encoding.size, actions, config, generator)
