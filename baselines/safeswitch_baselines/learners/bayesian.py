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

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load, save

from safeswitch.files import atomic_write_bytes, load_json, save_json
from safeswitch.protocols import Prediction
from safeswitch.seeding import seed_sequence
from safeswitch_baselines.learners.networks import (
    BayesianMLP,
    InputEncoding,
    MaskLayout,
    MLPConfig,
    bounded_variance,
)

if TYPE_CHECKING:
    from safeswitch.demos import Demonstrations
    from safeswitch_baselines.learners.training import Progress

FORMAT = "safeswitch-bayesian-mlp-1"
WEIGHTS, CONFIG = "model.safetensors", "config.json"


class MaskStream:
    """Dropout masks of the decisions, keyed by (episode seed, step).

    The seed keys one long PCG64DXSM sequence, and step s reads its own stretch of it, reached by a jump.

    Args:
        config: widths, dropout rates and K.
    """

    def __init__(self, config: MLPConfig) -> None:
        self._layout = MaskLayout.of(config)
        self._samples = config.samples
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Key the stream by an episode seed."""
        self._bits = np.random.PCG64DXSM(seed_sequence(seed, "dropout-masks"))
        self._start = self._bits.state

    def draw(self, step: int) -> list[NDArray[np.bool_] | None]:
        """Masks of environment step `step`, one (K, width) per hidden layer, None without dropout."""
        self._bits.state = self._start
        self._bits.advance(step * self._layout.words(self._samples))
        return self._layout.draw(self._bits, self._samples)


class _Network:
    """The layers of a `BayesianMLP` frozen for single decisions: all samples in one pass, no autograd.

    Layers up to the first one with dropout are the same for all samples and computed once. The scale 1 / (1 - rate) of
    kept units is folded into the weights that read them.
    """

    def __init__(self, model: BayesianMLP, samples: int) -> None:
        linears = model.linears()
        scales = [1.0, *(1.0 / (1.0 - rate) for rate in model.rates)]
        # `clone` puts every matrix into memory that torch aligned; a tensor read from a file need not be.
        self._weights = [
            (layer.weight.detach().cpu() * scale).t().contiguous().clone()
            for layer, scale in zip(linears, scales, strict=True)
        ]
        self._biases = [layer.bias.detach().cpu().clone() for layer in linears]
        # Outputs are computed transposed: a product with two long columns takes twice the time of two long rows.
        self._weights[-1] = self._weights[-1].t().contiguous()
        self._biases[-1] = self._biases[-1][:, None]
        depth = len(model.rates)
        first = next((index for index, rate in enumerate(model.rates) if rate > 0), depth)
        self._input = torch.empty(1, linears[0].in_features)
        self._input_view = self._input.numpy()
        self._hidden = [
            torch.empty(1 if index <= first else samples, len(bias)) for index, bias in enumerate(self._biases[:-1])
        ]
        self._masked = [
            torch.empty(samples, hidden.shape[1]) if index == first else hidden
            for index, hidden in enumerate(self._hidden)
        ]
        # The same memory seen by numpy, which is faster at the small element-wise steps.
        self._hidden_views = [hidden.numpy() for hidden in self._hidden]
        self._masked_views = [masked.numpy() for masked in self._masked]
        self._output = torch.empty(linears[-1].out_features, 1 if first == depth else samples)
        self._output_view = self._output.numpy()

    def __call__(
        self, inputs: NDArray[np.float64], masks: Sequence[NDArray[np.bool_] | None]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Raw outputs (2 nu, K), or (2 nu, 1) without dropout, and the first hidden layer (h,), before its dropout."""
        self._input_view[...] = inputs
        reading = self._input
        for index, mask in enumerate(masks):
            torch.addmm(self._biases[index], reading, self._weights[index], out=self._hidden[index]).relu_()
            if mask is not None:
                np.multiply(self._hidden_views[index], mask, out=self._masked_views[index])
            reading = self._masked[index]
        torch.addmm(self._biases[-1], self._weights[-1], reading.t(), out=self._output)
        return self._output_view.astype(np.float64), self._hidden_views[0][0].copy()


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
        self._network = _Network(self.model, self.config.samples)
        self._masks = MaskStream(self.config)

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
        inputs = self.encoding(self._checked(observation)[None, :])
        masks = self._masks.draw(_checked_step(step))
        with one_thread(), torch.inference_mode():
            output, features = self._network(inputs, masks)
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

    @classmethod
    def train(
        cls, demos: Demonstrations, seed: int, options: Mapping[str, Any] | None = None, progress: Progress = False
    ) -> BayesianLearner:
        """Train on demonstrations; `options` are fields of `MLPConfig`. See `training.train_bayesian_mlp`."""
        from safeswitch_baselines.learners.training import train_bayesian_mlp

        return train_bayesian_mlp(demos, seed, MLPConfig.from_json(options or {}), progress)

    def save(self, folder: Path | str) -> Path:
        """Write weights (safetensors), config and history (JSON) into `folder`.

        Each file appears whole or not at all, and the config, written last, holds the hash of the weights.
        """
        path = Path(folder)
        tensors = {f"network.{key}": value.contiguous() for key, value in self.model.state_dict().items()}
        # float64: predictions of a loaded learner are the same bits.
        tensors["encoding.mean"] = torch.from_numpy(self.encoding.mean)
        tensors["encoding.scale"] = torch.from_numpy(self.encoding.scale)
        weights = save(tensors)
        description = {
            "format": FORMAT,
            "weights_sha256": hashlib.sha256(weights).hexdigest(),
            "observation_shape": self.encoding.observation_shape,
            "actions": self.model.actions,
            "config": self.config.to_json(),
            "history": self.history,
        }
        atomic_write_bytes(path / WEIGHTS, weights)
        save_json(path / CONFIG, description)
        return path

    @classmethod
    def load(cls, folder: Path | str) -> BayesianLearner:
        """Learner saved by `save`; it predicts the same bits on the same machine."""
        path = Path(folder)
        for name in (CONFIG, WEIGHTS):
            if not (path / name).is_file():
                raise FileNotFoundError(f"{path} holds no saved Bayesian learner: {name} is missing")
        description = load_json(path / CONFIG)
        if description.get("format") != FORMAT:
            raise ValueError(f"{path / CONFIG}: format is {description.get('format')!r}, expected {FORMAT!r}")
        weights = (path / WEIGHTS).read_bytes()
        if hashlib.sha256(weights).hexdigest() != description["weights_sha256"]:
            raise ValueError(f"{path / WEIGHTS} is not the file that {CONFIG} describes: save the learner again")
        config = MLPConfig.from_json(description["config"])
        tensors = load(weights)
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


def moments(
    output: NDArray[np.float64], actions: int, bounds: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mean action, epistemic and aleatoric variance, each (nu,), from raw network outputs (2 nu, K)."""
    samples = output.shape[1]
    mu, raw = output[:actions], output[actions:]
    action = np.add.reduce(mu, axis=1) / samples
    deviation = mu - action[:, None]
    epistemic_var = np.add.reduce(deviation * deviation, axis=1) / samples
    aleatoric_var = np.add.reduce(bounded_variance(raw, bounds), axis=1) / samples
    return action, epistemic_var, aleatoric_var


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


def _checked_step(step: int) -> int:
    if step < 0:
        raise ValueError(f"step={step} is not allowed: it counts the environment's steps from 0")
    return int(step)
