"""The network for images: its settings, the encoding of frames, and where dropout acts."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from safeswitch_baselines.learners.gaussian import bounded_log_var
from safeswitch_baselines.learners.vgg import DropoutVGG, PixelEncoding, VGGConfig

SMALL = {"channels": (4, 6), "strides": (2, 1), "pools": (1, 2), "hidden": (8, 5)}


def images(n: int = 30, shape: tuple[int, ...] = (16, 20, 3), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, *shape), np.uint8)


def network(shape=(16, 20, 3), actions: int = 1, **options) -> DropoutVGG:
    config = VGGConfig.from_json({**SMALL, **options})
    return DropoutVGG(shape, actions, config, torch.Generator().manual_seed(0))


def encoded(frames: np.ndarray, config: VGGConfig) -> np.ndarray:
    encoding = PixelEncoding.fit([frames], config)
    return frames * encoding.scale + encoding.offset


@pytest.mark.parametrize("shape", [(64, 64, 3), (48, 96, 3)])
def test_the_default_network_takes_the_images_of_both_tasks(shape):
    config = VGGConfig()
    model = DropoutVGG(shape, 1, config, torch.Generator().manual_seed(0))
    stacks = torch.randn(2, 9, *shape[:2], generator=torch.Generator().manual_seed(1))
    features = model.trunk(stacks)
    assert features.shape == (2, model.features) == (2, 64 * (shape[0] // 16) * (shape[1] // 16))
    mean, log_var = model(stacks)
    assert mean.shape == log_var.shape == (2, 1)
    columns = config.layout(*shape[:2]).columns
    assert [None if c is None else c.stop - c.start for c in columns] == [*[None] * 4, model.features, 128, None]


@pytest.mark.parametrize(("strides", "pools"), [((2, 1), (1, 2)), (2, 1), ((1, 2), (3, 2)), ((3, 1), 2)])
@pytest.mark.parametrize("size", [(16, 20), (17, 23)])
def test_promised_shapes_are_those_of_the_blocks(strides, pools, size):
    model = network((*size, 3), strides=strides, pools=pools)
    hidden = torch.zeros(1, 9, *size)
    for index, block in enumerate(model.blocks):
        hidden = torch.max_pool2d(block(hidden), model.pools[index])
        assert (*hidden.shape[2:], hidden.shape[1]) == model.shapes[index]


def test_masks_drop_and_scale_the_units_they_name():
    model = network(trunk_dropout=0.5, feature_dropout=0.5, hidden_dropout=0.5, frames=1)
    stacks = torch.randn(3, 3, 16, 20, generator=torch.Generator().manual_seed(1))
    layout = model.config.layout(16, 20)
    masks = [torch.from_numpy(2.0 * mask).float() for mask in layout.draw(np.random.PCG64DXSM(0), 3)]
    hidden = stacks
    for index, block in enumerate(model.blocks):
        hidden = torch.max_pool2d(torch.relu(block(hidden)), model.pools[index])
        height, width, channels = model.shapes[index]
        hidden = hidden * masks[index].reshape(3, height, width, channels).permute(0, 3, 1, 2)
    hidden = hidden.permute(0, 2, 3, 1).reshape(3, -1) * masks[2]
    for layer, mask in zip(model.layers, masks[3:], strict=True):
        hidden = torch.relu(layer(hidden)) * mask
    expected = model.output(hidden)
    mean, log_var = model(stacks, masks)
    torch.testing.assert_close(mean, expected[:, :1])
    torch.testing.assert_close(log_var, bounded_log_var(expected[:, 1:], model.config.log_var_bounds))


def test_every_weight_gets_a_gradient():
    model = network(trunk_dropout=0.1)
    stacks = torch.randn(8, 9, 16, 20, generator=torch.Generator().manual_seed(1))
    mean, log_var = model(stacks)
    (mean.square() + log_var).sum().backward()
    for name, value in model.named_parameters():
        assert value.grad is not None and value.grad.abs().max() > 0, name


def test_initial_weights_depend_on_the_generator_alone():
    state = torch.get_rng_state()
    one, two = network(), network()
    assert torch.equal(torch.get_rng_state(), state), "torch's global generator was used"
    for a, b in zip(one.parameters(), two.parameters(), strict=True):
        assert torch.equal(a, b)


def test_per_pixel_standardisation_is_the_formula():
    frames = images()
    frames[:, 3, 4] = 77  # a pixel that never changes
    unit = frames / 255.0
    expected = (unit - unit.mean(axis=0)) / (unit.std(axis=0) + 0.03)
    got = encoded(frames, VGGConfig())
    np.testing.assert_allclose(got, expected, atol=2e-5)
    np.testing.assert_allclose(got[:, 3, 4], 0.0, atol=1e-5)


def test_centred_images_lose_the_mean_of_each_channel_and_keep_their_scale():
    frames = images()
    unit = frames / 255.0
    np.testing.assert_allclose(
        encoded(frames, VGGConfig(standardisation="centred")), unit - unit.mean(axis=(0, 1, 2)), atol=1e-6
    )
    np.testing.assert_allclose(encoded(frames, VGGConfig(standardisation="none")), unit, atol=1e-6)


def test_pixel_statistics_do_not_depend_on_order_or_pools():
    frames = images(40)
    whole = PixelEncoding.fit([frames], VGGConfig())
    parts = PixelEncoding.fit([frames[25:], frames[:10], frames[10:25]], VGGConfig())
    assert whole.scale.tobytes() == parts.scale.tobytes() and whole.offset.tobytes() == parts.offset.tobytes()


def test_differences_are_measured_by_their_own_size_per_pixel():
    frames = images(40)
    frames[:, 2, 5] = 9  # a pixel that never changes
    step = np.diff(frames / 255.0, axis=0)
    encoding = PixelEncoding.fit([frames], VGGConfig())
    expected = 1.0 / (255.0 * (np.sqrt((step**2).sum(axis=0) / 40) + 0.03))
    np.testing.assert_allclose(encoding.change, expected, rtol=1e-5)
    assert PixelEncoding.fit([frames], VGGConfig(differences=False)).change is None
    scale, offset = encoding.factors(3)
    assert scale.shape == offset.shape == (*frames.shape[1:3], 9)
    np.testing.assert_array_equal(scale[..., 3:], np.concatenate([encoding.change, encoding.scale], axis=2))
    assert (offset[..., :6] == 0).all()
    apart = PixelEncoding.fit([frames[:20], frames[20:]], VGGConfig())  # no difference across episodes
    assert (apart.change >= encoding.change).all() and (apart.change > encoding.change).any()


def test_config_survives_json():
    config = VGGConfig.from_json({**SMALL, "trunk_dropout": [0.1, 0.0], "standardisation": "centred"})
    assert VGGConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"trunk_dropuot": 0.1}, r"VGGConfig field 'trunk_dropuot'.*nearest first: trunk_dropout"),
        ({"standardisation": "per_pixel"}, r"'per_pixel'.*nearest first: per-pixel"),
        ({"loss": "nlll"}, r"'nlll'.*nearest first: nll"),
        ({"channels": ()}, "channels"),
        ({"channels": (8, 8)}, r"strides=.*one integer or 2 of them"),
        ({"pools": (2, 0, 1, 1)}, "pools=.*positive integers"),
        ({"trunk_dropout": (0.1, 0.1)}, "one rate or 4 of them"),
        ({"feature_dropout": 1.0}, r"feature_dropout=1.0.*\[0, 1\)"),
        ({"hidden_dropout": (0.1,)}, "one rate or 2 of them"),
        ({"frames": 0}, "frames=0"),
        ({"pixel_floor": 0.0}, "pixel_floor=0.0"),
        ({"pool_episodes": 0}, "pool_episodes=0"),
        ({"samples": 0}, "samples=0"),
        ({"log_var_bounds": (1.0, -1.0)}, "log_var_bounds"),
    ],
)
def test_wrong_settings_name_value_and_what_is_allowed(values, message):
    with pytest.raises(ValueError, match=message):
        VGGConfig.from_json(values)


def test_too_many_blocks_for_an_image_are_refused():
    with pytest.raises(ValueError, match="few enough blocks"):
        VGGConfig(pools=4).block_shapes(64, 64)


def test_branches_share_the_first_block_alone_and_are_dropped_whole():
    config = VGGConfig.from_json(
        {"channels": (4, 8), "strides": (2, 1), "pools": 1, "branches": 4, "feature_dropout": 0.5, "hidden": (6, 5)}
    )
    model = DropoutVGG((12, 12, 3), 1, config, torch.Generator().manual_seed(0))
    stacks = torch.rand((2, 9, 12, 12), generator=torch.Generator().manual_seed(1))
    before = model.trunk(stacks)
    with torch.no_grad():
        model.blocks[0].weight[1] += 0.5  # channel 1 of the first block is all that branch 1 reads
    changed = (model.trunk(stacks) != before).reshape(2, 36, 8).any(dim=1)
    assert changed[:, 2:4].any() and not changed[:, [0, 1, 4, 5, 6, 7]].any()

    masks = config.layout(12, 12).draw(np.random.PCG64DXSM(0), 400)
    features = masks[2]
    assert features is not None and features.shape == (400, 36 * 8)
    by_branch = features.reshape(400, 36, 4, 2)
    assert (by_branch == by_branch[:, :1, :, :1]).all()
    kept = by_branch[:, 0, :, 0]
    assert abs(kept.mean() - 0.5) < 0.05 and len(np.unique(kept, axis=0)) == 16
    with pytest.raises(ValueError, match="branches=3 is not allowed: branches must be a common divisor of channels"):
        VGGConfig(branches=3)
