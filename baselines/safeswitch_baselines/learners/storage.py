"""A trained learner on disk: weights as safetensors, everything else as JSON, and never a mixture of two learners."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import load, save
from torch import Tensor

from safeswitch.files import atomic_write_bytes, load_json, save_json

WEIGHTS, CONFIG = "model.safetensors", "config.json"


def write(folder: Path | str, kind: str, tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> Path:
    """Write `tensors` and `description` into `folder`; `kind` names the format.

    Each file appears whole or not at all, and the config, written last, holds the hash of the weights.
    """
    path = Path(folder)
    weights = save({name: value.contiguous() for name, value in tensors.items()})
    head = {"format": kind, "weights_sha256": hashlib.sha256(weights).hexdigest()}
    atomic_write_bytes(path / WEIGHTS, weights)
    save_json(path / CONFIG, {**head, **description})
    return path


def read(folder: Path | str, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the description that `write` put into `folder`."""
    path = Path(folder)
    for name in (CONFIG, WEIGHTS):
        if not (path / name).is_file():
            raise FileNotFoundError(f"{path} holds no saved Bayesian learner: {name} is missing")
    description = load_json(path / CONFIG)
    if description.get("format") != kind:
        raise ValueError(f"{path / CONFIG}: format is {description.get('format')!r}, expected {kind!r}")
    weights = (path / WEIGHTS).read_bytes()
    if hashlib.sha256(weights).hexdigest() != description["weights_sha256"]:
        raise ValueError(f"{path / WEIGHTS} is not the file that {CONFIG} describes: save the learner again")
    return load(weights), description
