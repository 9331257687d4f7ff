"""The Bayesian learner: K dropout samples of an MLP in one batched pass (Kendall & Gal 2017; Gal & Ghahramani 2016).

    action        = mean_k mu_k           (clipped to [-1, 1])
    epistemic_var = var_k mu_k            (population variance)
    aleatoric_var = mean_k sigma_k^2

The K masks of a decision are a function of (episode seed, environment step) alone (`MaskStream`). Two runs that visit the same state at the same step therefore predict the same bits,
whatever was predicted before, in whichever process and with however many workers. Only one torch thread is used, and
weights and buffers lie in memory that torch aligned itself, because matrix products may round differently otherwise.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file

from safeswitch.protocols import Prediction
from safeswitch.seeding import seed_sequence
from safeswitch_baselines.learners.networks import (
    BayesianMLP,
    InputEncoding,
    MLPConfig,
    bounded_log_var_numpy,
)

FORMAT = "safeswitch-bayesian-mlp-1"
_WEIGHTS, _CONFIG = "model.safetensors", "config.json"
_MASK_LEVELS = 1 << 16


class MaskStream:
    """Keep-masks of the dropout units, keyed by (episode seed, step).

    The seed keys one long PCG64DXSM sequence and step s reads its own stretch of it, reached by a jump. A unit is kept
    when a uniform 16-bit number is at least rate * 65536, so a rate is met to 1 / 65536. Row k is the k-th sample.

    Args:
        samples: K.
        widths: units of each hidden layer.
        rates: their dropout rates; a layer with rate 0 has no mask.
    """

    def __init__(self, samples: int, widths: Sequence[int], rates: Sequence[float]) -> None:
        used = [width if rate > 0 else 0 for width, rate in zip(widths, rates, strict=True)]
        edges = np.cumsum([0, *used])
        self._columns = [slice(int(a), int(b)) if b > a else None for a, b in pairwise(edges)]
        self._limits = np.repeat([round(rate * _MASK_LEVELS) for rate in rates], used).astype(np.uint16)
        self._shape = (samples, len(self._limits))
        self._words = -(-samples * len(self._limits) // 4)  # four 16-bit numbers out of each 64-bit word
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Key the stream by an episode seed."""
        self._bits = np.random.PCG64DXSM(seed_sequence(seed, "dropout-masks"))
        self._start = self._bits.state

    def draw(self, step: int) -> list[NDArray[np.bool_] | None]:
        """Masks of environment step `step`, one (K, width) per hidden layer; True keeps the unit."""
        self._bits.state = self._start
        self._bits.advance(step * self._words)
        numbers = self._bits.random_raw(self._words).view(np.uint16)[: self._shape[0] * self._shape[1]]
        keep = numbers.reshape(self._shape) >= self._limits
        return [keep[:, columns] if columns is not None else None for columns in self._columns]


class _Network:
    """The layers of a `BayesianMLP` frozen for single decisions: all samples in one pass, no autograd.

    Layers up to the first one with dropout are the same for all samples and computed once, and its units that ReLU
    switches off are off in every sample, so the next product leaves them out. The scale 1 / (1 - rate) of kept units
    is folded into the weights that read them.
    """

    def __init__(self, model: BayesianMLP, samples: int) -> None:
        linears = model.linears()
        scales = [1.0, *(1.0 / (1.0 - rate) for rate in model.rates)]
        self._depth = len(model.rates)
        self._first = next((index for index, rate in enumerate(model.rates) if rate > 0), self._depth)
        # `clone` puts every matrix into memory that torch aligned; a tensor read from a file need not be.
        self._weights = [
            (layer.weight.detach().cpu() * scale).t().contiguous().clone()
            for layer, scale in zip(linears, scales, strict=True)
        ]
        self._biases = [layer.bias.detach().cpu().clone() for layer in linears]
        self._input = torch.empty(1, linears[0].in_features)
        rows = [1 if index <= self._first else samples for index in range(self._depth)]
        self._hidden = [torch.empty(n, len(bias)) for n, bias in zip(rows, self._biases[:-1], strict=True)]
        self._views = [hidden.numpy() for hidden in self._hidden]  # the same memory, for numpy's faster masking
        width = self._hidden[self._first].shape[1] if self._first < self._depth else 0
        self._masked = torch.empty(samples * width)
        self._samples = samples

    def __call__(
        self, inputs: NDArray[np.float64], masks: Sequence[NDArray[np.bool_] | None]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Raw outputs (K, 2 nu), or (1, 2 nu) without dropout, and the first hidden layer (h,), before its dropout."""
        self._input.numpy()[...] = inputs
        hidden, weight = self._input, self._weights[0]
        for index in range(self._depth):
            torch.addmm(self._biases[index], hidden, weight, out=self._hidden[index])
            view = self._views[index]
            np.maximum(view, 0.0, out=view)
            mask = masks[index]
            if index == self._first and mask is not None:
                hidden, weight = self._spread(view[0], mask, self._weights[index + 1])
                continue
            if mask is not None:
                np.multiply(view, mask, out=view)
            hidden, weight = self._hidden[index], self._weights[index + 1]
        # Transposed, because a product with two long columns is twice as slow as one with two long rows.
        output = torch.addmm(self._biases[-1][:, None], weight.t(), hidden.t())
        return output.numpy().T, self._views[0][0].copy()

    def _spread(
        self, shared: NDArray[np.float32], mask: NDArray[np.bool_], weight: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Masked copies (K, a) of the a active units of the shared layer (h,), and the weights that read them."""
        active = np.flatnonzero(shared)
        hidden = self._masked[: self._samples * len(active)].view(self._samples, len(active))
        np.multiply(shared[active], mask[:, active], out=hidden.numpy())
        return hidden, weight.index_select(0, torch.from_numpy(active))


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
        self._masks = MaskStream(self.config.samples, self.config.hidden, self.config.rates)

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
        samples = output.astype(np.float64)
        action, epistemic_var, aleatoric_var = moments(samples, self.model.actions, self.config.log_var_bounds)
        return Prediction(np.clip(action, -1.0, 1.0), epistemic_var, aleatoric_var, features)

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

    def save(self, folder: Path | str) -> Path:
        """Write weights (safetensors), config and history (JSON) to `folder`, replacing it as a whole."""
        tensors = {f"network.{key}": value.contiguous() for key, value in self.model.state_dict().items()}
        # float64: predictions of a loaded learner are the same bits.
        tensors["encoding.mean"] = torch.from_numpy(self.encoding.mean)
        tensors["encoding.scale"] = torch.from_numpy(self.encoding.scale)
        description = {
            "format": FORMAT,
            "observation_shape": list(self.encoding.observation_shape),
            "actions": self.model.actions,
            "config": self.config.to_json(),
            "history": self.history,
        }
        with replaced_folder(Path(folder)) as fresh:
            save_file(tensors, fresh / _WEIGHTS)
            (fresh / _CONFIG).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
        return Path(folder)

    @classmethod
    def load(cls, folder: Path | str) -> BayesianLearner:
        """Learner saved by `save`; predicts the same bits on the same machine."""
        path = Path(folder)
        for name in (_CONFIG, _WEIGHTS):
            if not (path / name).is_file():
                raise FileNotFoundError(f"{path} holds no saved Bayesian learner: {name} is missing")
        description = json.loads((path / _CONFIG).read_text(encoding="utf-8"))
        if description.get("format") != FORMAT:
            raise ValueError(f"{path / _CONFIG}: format {description.get('format')!r} is not {FORMAT!r}")
        config = MLPConfig.from_json(description["config"])
        tensors = load_file(path / _WEIGHTS)
        encoding = InputEncoding(
            tuple(description["observation_shape"]),
            config.angles,
            tensors.pop("encoding.mean").numpy().copy(),
            tensors.pop("encoding.scale").numpy().copy(),
        )
        # The generator only keeps the initial weights, replaced at once, from touching torch's global one.
        model = BayesianMLP(encoding.size, description["actions"], config, torch.Generator().manual_seed(0))
        model.load_state_dict({key.removeprefix("network."): value for key, value in tensors.items()})
        return cls(model, encoding, config, description["history"])

    def __getstate__(self) -> dict[str, Any]:
        """What a copy in another process is rebuilt from."""
        weights = {key: value.numpy() for key, value in self.model.state_dict().items()}
        return {"weights": weights, "encoding": self.encoding, "config": self.config, "history": self.history}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild the network in this process's own aligned memory."""
        self.encoding, self.config, self.history = state["encoding"], state["config"], state["history"]
        weights = {key: torch.tensor(value) for key, value in state["weights"].items()}
        actions = len(weights["output.bias"]) // 2
        self.model = BayesianMLP(self.encoding.size, actions, self.config, torch.Generator().manual_seed(0)).eval()
        self.model.load_state_dict(weights)
        self._prepare()


def moments(
    samples: NDArray[np.float64], actions: int, bounds: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mean action, epistemic and aleatoric variance, each (nu,), from raw network outputs (K, 2 nu)."""
    mu, raw = samples[:, :actions], samples[:, actions:]
    action = mu.sum(axis=0) / len(mu)
    deviation = mu - action
    epistemic_var = (deviation * deviation).sum(axis=0) / len(mu)
    aleatoric_var = np.exp(bounded_log_var_numpy(raw, bounds)).sum(axis=0) / len(mu)
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


@contextmanager
def replaced_folder(folder: Path) -> Iterator[Path]:
    """An empty folder to write to; it takes the place of `folder` when the block ends without an error."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield fresh
        fresh.chmod(0o755)
        if folder.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{folder.name}-old-", dir=folder.parent))
            folder.replace(old / folder.name)
            fresh.replace(folder)
            shutil.rmtree(old)
        else:
            fresh.replace(folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _checked_step(step: int) -> int:
    if step < 0:
        raise ValueError(f"step={step} is not allowed: it counts the environment's steps from 0")
    return int(step)
