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

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from safeswitch.protocols import Prediction
from safeswitch_baselines.learners import storage
from safeswitch_baselines.learners.dropout import FrozenLayers, MaskStream, one_thread
from safeswitch_baselines.learners.gaussian import moments
from safeswitch_baselines.learners.networks import BayesianMLP, InputEncoding, MLPConfig

if TYPE_CHECKING:
    from safeswitch.demos import Demonstrations
    from safeswitch_baselines.learners.training import Progress

FORMAT = "safeswitch-bayesian-mlp-1"


class BayesianLearner:
    """Bayesian MLP as a `safeswitch.protocols.Learner`.

    Args:
        model: the trained network (it is moved to the CPU: one decision is too small for a GPU).
        encoding: observation to network input.
        config: what it was trained with; `config.samples` is K.
        history: one number per epoch and curve, as `training` recorded it.
    """

    def __init__(
        self,
        model: BayesianMLP,
        encoding: InputEncoding,
        config: MLPConfig,
        history: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        self.model = model.cpu().eval()
        self.encoding = encoding
        self.config = config
        self.history = {key: list(values) for key, values in (history or {}).items()}
        self._prepare()

    def _prepare(self) -> None:
        """Build what `predict` needs from the model."""
        self._network = FrozenLayers(self.model.linears(), (0.0, *self.config.rates), self.config.samples)
        self._masks = MaskStream(self.config.layout, self.config.samples)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of the observations it was trained on."""
        return self.encoding.observation_shape

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

    def save(self, folder: Path | str) -> Path:
        """Write weights (safetensors), config and history (JSON) into `folder`, whole or not at all."""
        tensors = {f"network.{key}": value for key, value in self.model.state_dict().items()}
        # float64: predictions of a loaded learner are the same bits.
        tensors["encoding.mean"] = torch.from_numpy(self.encoding.mean)
        tensors["encoding.scale"] = torch.from_numpy(self.encoding.scale)
        description = {
            "observation_shape": self.encoding.observation_shape,
            "actions": self.model.actions,
            "config": self.config.to_json(),
            "history": self.history,
        }
        return storage.write(folder, FORMAT, tensors, description)

    @classmethod
    def load(cls, folder: Path | str) -> BayesianLearner:
        """Learner saved by `save`; it predicts the same bits on the same machine."""
        tensors, description = storage.read(folder, FORMAT)
        config = MLPConfig.from_json(description["config"])
        mean, scale = (tensors.pop(f"encoding.{name}").numpy().copy() for name in ("mean", "scale"))
        encoding = InputEncoding(tuple(description["observation_shape"]), config.angles, mean, scale)
        state = {key.removeprefix("network."): value for key, value in tensors.items()}
        return cls(_network_of(state, encoding, config), encoding, config, description["history"])

    def __getstate__(self) -> dict[str, Any]:
        """What a copy in another process is rebuilt from."""
        weights = {key: value.numpy() for key, value in self.model.state_dict().items()}
        return {"weights": weights, "encoding": self.encoding, "config": self.config, "history": self.history}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild the network in this process's own aligned memory."""
        self.encoding, self.config, self.history = state["encoding"], state["config"], state["history"]
        weights = {key: torch.tensor(value) for key, value in state["weights"].items()}
        self.model = _network_of(weights, self.encoding, self.config).eval()
        self._prepare()


def _network_of(state: Mapping[str, torch.Tensor], encoding: InputEncoding, config: MLPConfig) -> BayesianMLP:
    """Network with the given weights."""
    # The generator only keeps the initial weights, replaced at once, from touching torch's global one.
    generator = torch.Generator().manual_seed(0)
    model = BayesianMLP(encoding.size, len(state["output.bias"]) // 2, config, generator)
    model.load_state_dict(dict(state))
    return model
