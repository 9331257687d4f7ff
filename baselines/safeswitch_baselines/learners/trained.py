"""What every trained Bayesian learner shares: its parts, its files, and copies of it in other processes.

Files and copies hold arrays and JSON values; the network is rebuilt from them, in memory that torch aligned itself:
matrix products may round differently otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import torch
from numpy.typing import NDArray

from safeswitch_baselines.learners import storage
from safeswitch_baselines.learners.config import TrainingConfig


class Encoding(Protocol):
    """Observation to network input."""

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of an observation."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The numbers that it consists of, by name."""


M = TypeVar("M", bound=torch.nn.Module)
E = TypeVar("E", bound=Encoding)
C = TypeVar("C", bound=TrainingConfig)


class TrainedLearner(Generic[M, E, C]):
    """Base of the learners: a subclass says what its format is called and how its parts are built.

    Args:
        model: the trained network (it is moved to the CPU: one decision is too small for a GPU).
        encoding: observation to network input.
        config: what it was trained with; `config.samples` is K.
        history: one number per epoch and curve, as the training recorded it.
    """

    FORMAT: ClassVar[str]

    def __init__(self, model: M, encoding: E, config: C, history: Mapping[str, Sequence[float]] | None = None) -> None:
        self.model = model.cpu().eval()
        self.encoding = encoding
        self.config = config
        self.history = {key: list(values) for key, values in (history or {}).items()}
        self._prepare()

    # ----------------------------------------------------------------------------------------- filled in by a learner

    def _prepare(self) -> None:
        """Build what `predict` needs from the parts."""
        raise NotImplementedError

    @classmethod
    def _parts(cls, description: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> tuple[E, C]:
        """Encoding and config from a file's description and the encoding's arrays."""
        raise NotImplementedError

    @staticmethod
    def _build(encoding: E, config: C, actions: int, generator: torch.Generator) -> M:
        """A network for these parts, with any weights."""
        raise NotImplementedError

    # -------------------------------------------------------------------------------------------------------- shared

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of the observations it was trained on."""
        return self.encoding.observation_shape

    def save(self, folder: Path | str) -> Path:
        """Write weights (safetensors), config and history (JSON) into `folder`, whole or not at all."""
        state = self.model.state_dict()
        tensors = {f"network.{key}": value for key, value in state.items()}
        # The encoding keeps its precision: predictions of a loaded learner are the same bits.
        tensors.update({f"encoding.{key}": torch.from_numpy(value) for key, value in self.encoding.arrays().items()})
        description = {
            "observation_shape": self.encoding.observation_shape,
            "actions": _actions_of(state),
            "config": self.config.to_json(),
            "history": self.history,
        }
        return storage.write(folder, self.FORMAT, tensors, description)

    @classmethod
    def load(cls, folder: Path | str) -> Self:
        """Learner saved by `save`; it predicts the same bits on the same machine."""
        tensors, description = storage.read(folder, cls.FORMAT)
        arrays = {
            key.removeprefix("encoding."): value.numpy().copy()
            for key, value in tensors.items()
            if key.startswith("encoding.")
        }
        encoding, config = cls._parts(description, arrays)
        state = {key.removeprefix("network."): value for key, value in tensors.items() if key.startswith("network.")}
        return cls(cls._with_weights(state, encoding, config), encoding, config, description["history"])

    def __getstate__(self) -> dict[str, Any]:
        """What a copy in another process is rebuilt from; the memory of an episode stays behind."""
        weights = {key: value.numpy() for key, value in self.model.state_dict().items()}
        return {"weights": weights, "encoding": self.encoding, "config": self.config, "history": self.history}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild the network in this process's own aligned memory."""
        self.encoding, self.config, self.history = state["encoding"], state["config"], state["history"]
        weights = {key: torch.tensor(value) for key, value in state["weights"].items()}
        self.model = self._with_weights(weights, self.encoding, self.config).eval()
        self._prepare()

    @classmethod
    def _with_weights(cls, state: Mapping[str, torch.Tensor], encoding: E, config: C) -> M:
        # The generator only keeps the initial weights, replaced at once, from touching torch's global one.
        model = cls._build(encoding, config, _actions_of(state), torch.Generator().manual_seed(0))
        model.load_state_dict(dict(state))
        return model


def _actions_of(state: Mapping[str, torch.Tensor]) -> int:
    """Number of actions, from the output's mean and log-variance of each."""
    return len(state["output.bias"]) // 2
