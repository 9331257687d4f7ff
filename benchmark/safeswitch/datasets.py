"""Demonstrations as Minari datasets: written whole or not at all, images without loss.

A dataset has Minari's usual entries (`actions` are the executed ones) and, in its infos, `expert_action` (L + 1, nu),
the label, and `state` (L + 1, nx), SI units. Its metadata says how it was made.
"""

from __future__ import annotations

import json
import os
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from minari import MinariDataset

    from safeswitch.demos import Noise, Rollout
    from safeswitch.tasks.base import TaskEnv

IMAGE_CHUNK = 16
"""Frames per compressed block of an image dataset: small enough to read a few, large enough to compress well."""

METADATA = "safeswitch_demonstrations"
"""Key of the settings, as JSON text, in the metadata of the dataset."""


class EpisodeFrames:
    """Images (n, H, W, C) uint8 of several episodes that stay in their file until an episode is asked for.

    Args:
        file: the `main_data.hdf5` of a Minari dataset.
        lengths: steps of every episode; the observation after the last step is left out.
    """

    ndim = 4
    dtype = np.dtype(np.uint8)

    def __init__(self, file: Path | str, lengths: Sequence[int]) -> None:
        import h5py

        self.file = Path(file)
        self.lengths = tuple(int(length) for length in lengths)
        with h5py.File(self.file, "r") as data:
            self.shape = (sum(self.lengths), *data["episode_0"]["observations"].shape[1:])

    def __len__(self) -> int:
        return self.shape[0]

    def episode(self, index: int) -> NDArray[np.uint8]:
        """Images (L, H, W, C) of an episode."""
        import h5py

        # Opened for every call: an open file could be neither pickled nor shared with worker processes.
        with h5py.File(self.file, "r") as data:
            images: NDArray[np.uint8] = data[f"episode_{index}"]["observations"][: self.lengths[index]]
        return images

    def first(self, count: int) -> EpisodeFrames:
        """The images of the first `count` episodes."""
        return EpisodeFrames(self.file, self.lengths[:count])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """All images in memory, for those who ask NumPy for them."""
        images = np.concatenate([self.episode(index) for index in range(len(self.lengths))])
        return images if dtype is None else images.astype(dtype)


def write(
    rollouts: Sequence[Rollout],
    env_id: str,
    dataset_id: str,
    root: Path | str,
    noise: Noise,
    env_kwargs: Mapping[str, Any] | None = None,
) -> Path:
    """Write demonstrations as the Minari dataset `dataset_id` below `root`; returns its folder.

    It is written under a temporary root and moved, so an interruption leaves the older dataset, or none, and never a
    part of one.
    """
    root = Path(root)
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".demonstrations-", dir=root) as temporary:
        dataset = _create(rollouts, env_id, dataset_id, Path(temporary), noise, dict(env_kwargs or {}))
        if is_image(rollouts[0].observations):
            _compress(Path(temporary) / dataset_id / "data" / "main_data.hdf5")
        # After the compression, because the metadata states the size of the data.
        dataset.storage.update_metadata({"dataset_size": dataset.storage.get_size()})
        return _move(dataset_id, Path(temporary), root)


def _create(
    rollouts: Sequence[Rollout],
    env_id: str,
    dataset_id: str,
    root: Path,
    noise: Noise,
    env_kwargs: dict[str, Any],
) -> MinariDataset:
    with minari_root(root):
        import minari
        from minari.data_collector import EpisodeBuffer

        buffers = [
            EpisodeBuffer(
                id=index,
                seed=int(rollout.seed),
                observations=rollout.observations,
                actions=rollout.actions,
                rewards=list(rollout.rewards),
                terminations=list(rollout.terminated),
                truncations=list(rollout.truncated),
                infos={"expert_action": rollout.labels, "state": rollout.states},
            )
            for index, rollout in enumerate(rollouts)
        ]
        env = make_task(env_id, env_kwargs)
        with warnings.catch_warnings():
            # Minari asks for an author's e-mail and a link to the code; a benchmark run by anybody has neither.
            warnings.simplefilter("ignore", UserWarning)
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                buffers,
                env=env,
                algorithm_name="MPC with differential dynamic programming (safeswitch.expert)",
                author="SafeSwitch",
                description=_describe(env_id, rollouts, noise),
                requirements=["safeswitch"],
                jpeg_encoding=False,  # JPEG is lossy
            )
        env.close()
    settings = {
        "env": env_id,
        "env_kwargs": env_kwargs,
        "noise": asdict(noise),
        "seeds": [int(rollout.seed) for rollout in rollouts],
        "success": [bool(rollout.success) for rollout in rollouts],
    }
    dataset.storage.update_metadata({METADATA: json.dumps(settings)})
    return dataset


def _describe(env_id: str, rollouts: Sequence[Rollout], noise: Noise) -> str:
    successes = sum(rollout.success for rollout in rollouts)
    return (
        f"{len(rollouts)} episodes of {env_id} driven by a model-predictive expert, {successes} of them successful. "
        f"Gaussian noise is added to the executed action ('actions'), its standard deviation uniform in "
        f"[{noise.low:g}, {noise.high:g}] per episode (action units); infos['expert_action'] is the expert's own "
        "action in the same state, infos['state'] the full state, SI units."
    )


def is_image(observations: Any) -> bool:
    """Whether observations (n, ...) are images: an array, or a dataset in a file."""
    return observations.dtype == np.uint8 and observations.ndim == 4


def _compress(path: Path) -> None:
    """Rewrite the images of a dataset with gzip, without loss: Minari stores them raw, about 30 times as large."""
    import h5py

    packed = path.with_suffix(".packed")
    with h5py.File(path, "r") as source, h5py.File(packed, "w", track_order=True) as target:
        for name, episode in source.items():
            group = target.create_group(name)
            group.attrs.update(episode.attrs)
            for key in episode:
                if key != "observations":
                    source.copy(episode[key], group, key)
            images = episode["observations"][()]
            group.create_dataset(
                "observations",
                data=images,
                chunks=(min(IMAGE_CHUNK, len(images)), *images.shape[1:]),
                maxshape=(None, *images.shape[1:]),
                compression="gzip",
                compression_opts=1,
            )
    os.replace(packed, path)


def _move(dataset_id: str, source: Path, root: Path) -> Path:
    """Move a dataset between roots, with the files that make its parent folders Minari namespaces."""
    target = root / dataset_id
    target.parent.mkdir(parents=True, exist_ok=True)
    for parent in Path(dataset_id).parents:
        marker = source / parent / "namespace_metadata.json"
        if marker.is_file() and not (root / parent / marker.name).exists():
            os.replace(marker, root / parent / marker.name)
    if target.exists():
        os.replace(target, source / "replaced")
    os.replace(source / dataset_id, target)
    return target


@contextmanager
def minari_root(root: Path | str) -> Iterator[None]:
    """Let Minari use the datasets below `root` inside the block."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    try:
        yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before


def make_task(env_id: str, env_kwargs: Mapping[str, Any]) -> TaskEnv:
    """The task without Gymnasium's wrappers; worker processes have to register the ids first."""
    import gymnasium

    import safeswitch

    safeswitch.register()
    env: Any = gymnasium.make(env_id, **env_kwargs).unwrapped
    return env
