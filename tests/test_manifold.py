"""What is off the subspace of the training images: the laws of the residual, and that learners use and keep it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from safeswitch.demos import Demonstrations
from safeswitch_baselines.learners.image import DropoutVGGLearner
from safeswitch_baselines.learners.image_training import Encoder, Pool
from safeswitch_baselines.learners.manifold import Excess, Subspace, halved

HEIGHT, WIDTH, RANK = 8, 12, 3
OPTIONS = {
    "frames": 1,
    "differences": False,
    "channels": (8, 8),
    "strides": 1,
    "pools": 2,
    "hidden": (16,),
    "hidden_dropout": (0.2,),
    "components": RANK + 1,
    "epochs": 2,
    "warmup_epochs": 1,
    "batch_size": 16,
    "validation_fraction": 0.0,
}


def images(count: int, seed: int) -> np.ndarray:
    """Frames (count, H, W, 3) uint8 on a subspace of RANK dimensions, with a little noise."""
    basis = np.random.default_rng(0).normal(size=(RANK, HEIGHT, WIDTH, 3))
    rng = np.random.default_rng(seed)
    pixels = 128 + 12 * np.tensordot(rng.normal(size=(count, RANK)), basis, 1)
    return np.clip(np.rint(pixels + rng.normal(size=pixels.shape)), 0, 255).astype(np.uint8)


def demonstrations() -> Demonstrations:
    frames = images(240, 1)
    labels = (frames.mean(axis=(1, 2, 3)) / 128.0 - 1.0)[:, None]
    return Demonstrations(frames, labels, np.repeat(np.arange(12), 20))


def with_patch(frames: np.ndarray) -> np.ndarray:
    patched = frames.copy()
    patched[:, 2:6, 4:8] = (250, 10, 10)
    return patched


@pytest.fixture(scope="module")
def standardised() -> list[torch.Tensor]:
    frames = torch.from_numpy(images(200, 2)).float()
    return list(halved((frames - frames.mean(0)) / (frames.std(0) + 1.0)).split(20))


@pytest.fixture(scope="module")
def subspace(standardised: list[torch.Tensor]) -> Subspace:
    def episodes() -> Iterator[torch.Tensor]:
        return iter(standardised)

    return Subspace.fit(episodes, RANK, 0.01)


@pytest.fixture(scope="module")
def learner() -> DropoutVGGLearner:
    return DropoutVGGLearner.train(demonstrations(), 0, OPTIONS)


def test_components_are_orthonormal(subspace: Subspace) -> None:
    np.testing.assert_allclose(subspace.components @ subspace.components.T, np.eye(RANK), atol=1e-5)


def test_components_span_the_principal_axes(subspace: Subspace, standardised: list[torch.Tensor]) -> None:
    axes = np.linalg.svd(torch.cat(standardised).numpy(), full_matrices=False)[2][:RANK]
    np.testing.assert_allclose(np.linalg.svd(axes @ subspace.components.T)[1], 1.0, atol=1e-4)


def test_the_reach_is_a_high_quantile_of_what_is_left(subspace: Subspace, standardised: list[torch.Tensor]) -> None:
    images = torch.cat(standardised).numpy()
    left = np.abs(images - (images @ subspace.components.T) @ subspace.components)
    assert 0.97 < np.mean(left <= subspace.reach) < 1.0


def test_the_excess_is_zero_within_reach_and_proportional_beyond(subspace: Subspace) -> None:
    nothing = torch.zeros(1, HEIGHT, WIDTH, 3)
    assert not Excess(subspace, 4.0)(nothing).any()
    novel = nothing.clone()
    novel[0, 2:4, 4:6] = 50.0
    once, twice = Excess(subspace, 1.0)(novel), Excess(subspace, 2.0)(novel)
    torch.testing.assert_close(2 * once, twice)
    assert once[0, 2:4, 4:6].min() > 1.0


def test_the_fit_repeats_bit_for_bit(subspace: Subspace, standardised: list[torch.Tensor]) -> None:
    again = Subspace.fit(lambda: iter(standardised), RANK, 0.01)
    assert np.array_equal(again.components, subspace.components) and np.array_equal(again.reach, subspace.reach)


def test_something_new_is_seen_and_nothing_else(learner: DropoutVGGLearner) -> None:
    """The excess channels of new frames of the same scene are nearly empty, those of frames with a patch are not."""
    frames, labels, episodes = images(50, 3), np.zeros((50, 1)), np.zeros(50, np.int64)
    pool = [Pool.read(Demonstrations(each, labels, episodes), [0], 1) for each in (frames, with_patch(frames))]
    encoder = Encoder(learner.encoding, 1, 50, torch.device("cpu"))
    plain, patched = (encoder(each, torch.arange(50))[:, 3:].abs().mean().item() for each in pool)
    assert patched > 20 * plain


def test_a_decision_sees_what_training_saw(learner: DropoutVGGLearner) -> None:
    """The stack that a decision encodes frame by frame is the one that training encodes in batches."""
    frames = with_patch(images(6, 4))
    pool = Pool.read(Demonstrations(frames, np.zeros((6, 1)), np.zeros(6, np.int64)), [0], 1)
    encoded = Encoder(learner.encoding, 1, 6, torch.device("cpu"))(pool, torch.arange(6))
    learner.reset(0)
    for index, frame in enumerate(frames):
        torch.testing.assert_close(learner._stack.push(frame)[0], encoded[index], rtol=1e-4, atol=1e-4)


def test_a_learner_is_saved_and_loaded_with_it(learner: DropoutVGGLearner, tmp_path: Path) -> None:
    again = DropoutVGGLearner.load(learner.save(tmp_path / "learner"))
    frame = with_patch(images(1, 5))[0]
    for each in (learner, again):
        each.reset(7)
    before, after = learner.predict(frame, 0), again.predict(frame, 0)
    assert np.array_equal(before.action, after.action) and np.array_equal(before.epistemic_var, after.epistemic_var)


def test_no_components_leave_the_network_as_it_was() -> None:
    plain = DropoutVGGLearner.train(demonstrations(), 0, {**OPTIONS, "components": 0})
    assert plain.encoding.components is None and plain.model.blocks[0].in_channels == 3
