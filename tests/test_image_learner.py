"""The learner for images: its memory, its masks, and the same bits wherever it runs."""

from __future__ import annotations

import hashlib
import itertools
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from safeswitch import registry
from safeswitch.demos import Demonstrations
from safeswitch.protocols import Learner
from safeswitch_baselines.learners.dropout import MaskStream, scaled_masks
from safeswitch_baselines.learners.image import DropoutVGGLearner, FrameStack, PaperLiteralLearner
from safeswitch_baselines.learners.image_training import EVALUATION_BATCH, Encoder, Pool
from safeswitch_baselines.learners.storage import CONFIG, WEIGHTS
from safeswitch_baselines.learners.vgg import DropoutVGG, PixelEncoding, VGGConfig

SHAPE = (16, 20, 3)
FRAMES = np.random.default_rng(3).integers(0, 256, (20, *SHAPE), np.uint8)
SMALL = {"channels": (4, 6), "strides": (2, 1), "pools": (1, 2), "hidden": (16, 8), "samples": 7}
SETTINGS = {
    "shared trunk": {},
    "dropout everywhere": {"trunk_dropout": 0.1, "hidden_dropout": 0.1},
    "dropout in one block": {"trunk_dropout": (0.0, 0.2), "feature_dropout": 0.0},
    "late dropout": {"feature_dropout": 0.0, "hidden_dropout": (0.0, 0.3)},
    "single frame": {"frames": 1},
    "frames as they are": {"differences": False},
    "branches": {"channels": (4, 6), "branches": 2, "feature_dropout": 0.4},
}


def make_learner(actions: int = 2, shape: tuple[int, ...] = SHAPE, **options) -> DropoutVGGLearner:
    config = VGGConfig.from_json({**SMALL, **options})
    frames = FRAMES if shape == SHAPE else np.random.default_rng(0).integers(0, 256, (5, *shape), np.uint8)
    encoding = PixelEncoding.fit([frames], config).with_subspace(lambda: [frames], config)
    model = DropoutVGG(shape, actions, config, torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.output.weight.mul_(5.0)  # predictions far from zero, so that errors show
    return DropoutVGGLearner(model, encoding, config, {"loss": [1.0, 0.5]})


def demonstrations() -> Demonstrations:
    return Demonstrations(FRAMES, np.zeros((20, 2)), np.repeat([0, 1, 2], [9, 1, 10]))


def bits(learner: DropoutVGGLearner, seed: int = 11, frames=FRAMES) -> bytes:
    learner.reset(seed)
    return bytes_of([learner.predict(frame, step) for step, frame in enumerate(frames)])


def bytes_of(predictions) -> bytes:
    parts = ((p.action, p.epistemic_var, p.aleatoric_var, p.features) for p in predictions)
    return b"".join(value.tobytes() for values in parts for value in values if value is not None)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_decision_is_the_plain_network_under_each_mask(name):
    learner = make_learner(**SETTINGS[name])
    config, encoding = learner.config, learner.encoding
    stream = MaskStream(config.layout(*SHAPE[:2]), config.samples)
    for array in (stream, learner):
        array.reset(5)
    unit = FRAMES.astype(np.float32)
    scale, offset = encoding.factors(config.frames)
    for step in range(5):
        prediction = learner.predict(FRAMES[step], step)
        rows = [max(step - back, 0) for back in reversed(range(config.frames))]  # oldest first
        older = [unit[b] - unit[a] if config.differences else unit[a] for a, b in itertools.pairwise(rows)]
        encoded = np.concatenate([*older, unit[rows[-1]]], axis=2) * scale + offset
        stack = torch.from_numpy(encoded).permute(2, 0, 1)[None]
        means, variances = [], []
        for k in range(config.samples):
            masks = [None if mask is None else mask[k : k + 1] for mask in stream.draw(step)]
            with torch.no_grad():
                mean, log_var = learner.model(stack, scaled_masks(masks, config.rates))
            means.append(mean[0].double().numpy())
            variances.append(np.exp(log_var[0].double().numpy()))
        np.testing.assert_allclose(prediction.action, np.clip(np.mean(means, axis=0), -1, 1), rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(prediction.epistemic_var, np.var(means, axis=0), rtol=1e-2, atol=1e-8)
        np.testing.assert_allclose(prediction.aleatoric_var, np.mean(variances, axis=0), rtol=1e-3)
        np.testing.assert_allclose(prediction.features, learner.model.trunk(stack)[0].detach(), rtol=1e-3, atol=1e-5)


def test_prediction_has_the_promised_types_for_images_of_the_car_too():
    learner = make_learner(shape=(48, 96, 3))
    assert isinstance(learner, Learner) and learner.observation_shape == (48, 96, 3)
    prediction = learner.predict(np.zeros((48, 96, 3), np.uint8), 0)
    for value in (prediction.action, prediction.epistemic_var, prediction.aleatoric_var):
        assert value.shape == (2,) and value.dtype == np.float64
    assert prediction.features is not None and prediction.features.dtype == np.float32
    assert prediction.features.shape == (learner.model.features,)
    assert np.all(prediction.epistemic_var > 0) and np.all(prediction.aleatoric_var > 0)


def test_memory_is_the_last_frames_and_ends_with_the_episode():
    learner = make_learner(frames=3)
    learner.reset(1)
    ahead = [learner.predict(frame, step) for step, frame in enumerate(FRAMES)]
    learner.reset(1)
    for step in range(10, 13):  # three frames are all that step 12 depends on
        again = learner.predict(FRAMES[step], step)
    np.testing.assert_array_equal(again.action, ahead[12].action)
    assert not np.array_equal(learner.predict(FRAMES[0], 13).features, ahead[13].features)
    learner.reset(1)
    first = learner.predict(FRAMES[0], 0)
    np.testing.assert_array_equal(first.action, ahead[0].action)
    np.testing.assert_array_equal(first.features, ahead[0].features)


@pytest.mark.parametrize("options", [{}, {"components": 3}, {"frames": 1}])
def test_learners_that_share_an_encoder_decide_as_they_do_alone(options):
    """In lockstep, as an ensemble drives them, and apart; in one thread and in two."""
    first, second = make_learner(**options), make_learner(**options)
    other = make_learner(**options, standardisation="centred")
    assert first._stack._encode is second._stack._encode is not other._stack._encode
    alone = bits(first)
    assert bits(second) == alone
    driven = [(first, FRAMES), (second, FRAMES[::-1]), (other, FRAMES)]
    apart = [bits(learner, frames=frames) for learner, frames in driven]
    for learner, _ in driven:
        learner.reset(11)
    in_turn = [[learner.predict(frames[step], step) for learner, frames in driven] for step in range(len(FRAMES))]
    assert [bytes_of(each) for each in zip(*in_turn, strict=True)] == apart
    with ThreadPoolExecutor(2) as pool:
        each = pool.map(lambda learner: [bits(learner) for _ in range(4)], [first, second])
        assert list(each) == 2 * [4 * [alone]]


def test_features_are_kept_when_the_next_decision_is_made():
    learner = make_learner()
    first = learner.predict(FRAMES[0], 0)
    copy = np.copy(first.features)
    learner.predict(FRAMES[1], 1)
    np.testing.assert_array_equal(first.features, copy)


@pytest.mark.parametrize("differences", [True, False])
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_stacks_in_training_are_those_of_the_decisions(frames, differences):
    encoding = PixelEncoding.fit([FRAMES], VGGConfig(differences=differences))
    demos = demonstrations()
    order = [2, 0, 1]
    pool = Pool.read(demos, order, frames)
    encoder = Encoder(encoding, frames, EVALUATION_BATCH, torch.device("cpu"))
    rows = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    stacks = encoder(pool, rows)[torch.argsort(rows)].numpy()
    memory, expected = FrameStack(encoding, frames), []
    for episode in order:
        memory.reset()
        expected.extend(memory.push(frame).numpy()[0].copy() for frame in demos.episode(episode))
    np.testing.assert_allclose(stacks, np.stack(expected), atol=1e-5)


@pytest.mark.parametrize("name", ["shared trunk", "dropout everywhere"])
def test_masks_are_a_function_of_seed_and_step_alone(name):
    learner = make_learner(**{**SETTINGS[name], "frames": 1})  # one frame: no memory in between
    learner.reset(8)
    ahead = [learner.predict(FRAMES[0], step) for step in range(6)]
    learner.reset(9)
    other = learner.predict(FRAMES[0], 3)
    learner.reset(8)
    for step in (5, 0, 3, 3, 1):
        again = learner.predict(FRAMES[0], step)
        np.testing.assert_array_equal(again.action, ahead[step].action)
        np.testing.assert_array_equal(again.epistemic_var, ahead[step].epistemic_var)
    assert not np.array_equal(other.action, ahead[3].action), "the seed does not matter"
    assert len({prediction.action.tobytes() for prediction in ahead}) == 6, "the step does not matter"
    with pytest.raises(ValueError, match="step=-1"):
        learner.predict(FRAMES[0], -1)


def test_decisions_leave_global_generators_and_threads_alone():
    learner = make_learner()
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), torch.get_num_threads()
    bits(learner)
    assert torch.equal(torch.get_rng_state(), before[0])
    np.testing.assert_array_equal(np.random.get_state()[1], before[1])
    assert torch.get_num_threads() == before[2]


@pytest.mark.parametrize("name", ["shared trunk", "dropout everywhere"])
def test_saved_and_pickled_learners_predict_the_same_bits(tmp_path, name):
    learner = make_learner(**SETTINGS[name])
    learner.save(tmp_path / "learner")
    loaded = DropoutVGGLearner.load(tmp_path / "learner")
    assert bits(loaded) == bits(learner) == bits(pickle.loads(pickle.dumps(learner)))
    assert loaded.config == learner.config and loaded.history == learner.history
    loaded.save(tmp_path / "again")
    for file in (WEIGHTS, CONFIG):
        assert (tmp_path / "again" / file).read_bytes() == (tmp_path / "learner" / file).read_bytes()


def test_another_process_with_other_threads_predicts_the_same_bits(tmp_path):
    learner = make_learner()
    learner.save(tmp_path)
    np.save(tmp_path / "frames.npy", FRAMES)
    code = f"""
import hashlib, numpy as np
from safeswitch_baselines.learners.image import DropoutVGGLearner
learner = DropoutVGGLearner.load({str(tmp_path)!r})
learner.reset(11)
digest = hashlib.sha256()
for step, frame in enumerate(np.load({str(tmp_path / "frames.npy")!r})):
    p = learner.predict(frame, step)
    digest.update(p.action.tobytes() + p.epistemic_var.tobytes() + p.aleatoric_var.tobytes() + p.features.tobytes())
print(digest.hexdigest())
"""
    environment = {**os.environ, "OMP_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == hashlib.sha256(bits(learner)).hexdigest()


def test_features_of_demonstrations_are_those_of_the_decisions():
    learner, demos = make_learner(), demonstrations()
    features = learner.features(demos)
    assert features.dtype == np.float32 and features.shape == (20, learner.model.features)
    assert learner.features(demos).tobytes() == features.tobytes()
    decisions = []
    for episode in range(3):
        learner.reset(0)
        decisions.extend(learner.predict(frame, step).features for step, frame in enumerate(demos.episode(episode)))
    np.testing.assert_allclose(features, np.stack(decisions), rtol=1e-4, atol=1e-5)


def test_wrong_observations_and_folders_are_refused(tmp_path):
    learner = make_learner()
    with pytest.raises(ValueError, match=r"shape \(8, 8, 3\).*images of shape \(16, 20, 3\)"):
        learner.predict(np.zeros((8, 8, 3), np.uint8), 0)
    with pytest.raises(ValueError, match="type float64"):
        learner.predict(np.zeros(SHAPE), 0)
    with pytest.raises(FileNotFoundError, match="config.json is missing"):
        DropoutVGGLearner.load(tmp_path)


def test_the_paper_literal_learner_has_the_paper_s_settings_and_takes_others():
    assert registry.find("learner", "paper-literal") is PaperLiteralLearner
    assert registry.find("learner", "dropout-vgg") is DropoutVGGLearner
    config = PaperLiteralLearner.configure({"hidden_dropout": 0.2})
    assert (config.frames, config.loss, config.warmup_epochs, config.standardisation) == (1, "nll", 0, "centred")
    assert config.rates == (0.1, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2)
    with pytest.raises(ValueError, match="nearest first: hidden"):
        PaperLiteralLearner.configure({"hiden": 1})


def test_the_mean_action_is_the_prediction_without_dropout():
    learner = make_learner(feature_dropout=0.0, hidden_dropout=0.0)
    learner.reset(0)
    predicted = [learner.predict(frame, step).action for step, frame in enumerate(FRAMES)]
    learner.reset(0)
    means = [learner.mean_action(frame, step) for step, frame in enumerate(FRAMES)]
    np.testing.assert_allclose(means, predicted, atol=1e-5)
    assert np.std(means) > 0.05
    dropping = make_learner()
    dropping.reset(0)
    np.testing.assert_allclose([dropping.mean_action(frame, step) for step, frame in enumerate(FRAMES)], means)
