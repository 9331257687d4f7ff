"""The Bayesian learner for images: a `DropoutVGG` that remembers the last frames (Kendall & Gal, arXiv 1703.04977).

One frame shows no velocity, so the network sees a stack of the last F frames, the oldest first. The stack is the
learner's own memory: it starts with the episode, filled with the first frame. Apart from it, a prediction is a function
of (episode seed, step) alone, as the masks of all learners are (`dropout.MaskStream`).
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from numpy.typing import NDArray

from safeswitch.protocols import Prediction
from safeswitch_baselines.learners.dropout import FrozenLayers, MaskStream, one_thread, scaled_masks
from safeswitch_baselines.learners.gaussian import moments
from safeswitch_baselines.learners.trained import TrainedLearner
from safeswitch_baselines.learners.vgg import DropoutVGG, PixelEncoding, VGGConfig

if TYPE_CHECKING:
    from safeswitch.demos import Demonstrations
    from safeswitch_baselines.learners.descent import Progress


class _SharedEncoder(threading.local):
    """What the network sees of a stack of frames; of the last stack it is remembered, in each thread its own.

    Learners of the same demonstrations encode alike. They share an encoder, so that an ensemble encodes a stack once.
    """

    def __init__(self, encoding: PixelEncoding, frames: int) -> None:
        height, width, self._depth = encoding.observation_shape
        self._differences = encoding.change is not None
        self._scale, self._offset = encoding.factors(frames)
        self._excess = encoding.excess()
        self._frames = np.full((height, width, frames * self._depth), np.nan, np.float32)
        channels = (frames + (self._excess is not None)) * self._depth
        self._encoded = np.zeros((1, height, width, channels), np.float32)
        self._tensor = torch.from_numpy(self._encoded).permute(0, 3, 1, 2)

    def __call__(self, frames: NDArray[np.float32]) -> torch.Tensor:
        """The encoded stack (1, channels, H, W) of frames (H, W, F C), valid until the next call."""
        if np.array_equal(frames, self._frames):
            return self._tensor
        depth = self._depth
        self._frames[...] = frames
        encoded = self._encoded[0, ..., : frames.shape[-1]]
        encoded[...] = frames
        if self._differences:
            encoded[..., :-depth] = frames[..., depth:] - frames[..., :-depth]
        np.multiply(encoded, self._scale, out=encoded)
        np.add(encoded, self._offset, out=encoded)
        if self._excess is not None:
            newest = torch.from_numpy(np.ascontiguousarray(encoded[None, ..., -depth:]))
            self._encoded[..., -depth:] = self._excess(newest).numpy()
        return self._tensor


_encoders: WeakValueDictionary[str, _SharedEncoder] = WeakValueDictionary()


def _shared_encoder(encoding: PixelEncoding, frames: int) -> _SharedEncoder:
    """The one encoder of stacks of so many frames under these very numbers."""
    digest = hashlib.sha256(str(frames).encode())
    for name, array in encoding.arrays().items():
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    encoder = _encoders.get(digest.hexdigest()) or _SharedEncoder(encoding, frames)
    _encoders[digest.hexdigest()] = encoder
    return encoder


class FrameStack:
    """The last F frames, and from them what the network sees.

    Args:
        encoding: of a stack.
        frames: F.
    """

    def __init__(self, encoding: PixelEncoding, frames: int) -> None:
        height, width, self._depth = encoding.observation_shape
        self._frames = np.zeros((height, width, frames * self._depth), np.float32)
        self._encode = _shared_encoder(encoding, frames)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._empty = True

    def push(self, frame: NDArray[np.uint8]) -> torch.Tensor:
        """Take the next frame (H, W, C) in; the encoded stack (1, F C, H, W), valid until the next call.

        The next call may be another stack's with the same encoding.
        """
        depth, frames = self._depth, self._frames
        if self._empty:
            frames[...] = np.tile(frame, frames.shape[-1] // depth)
            self._empty = False
        else:
            frames[..., :-depth] = frames[..., depth:]
            frames[..., -depth:] = frame
        return self._encode(frames)


class DropoutVGGLearner(TrainedLearner[DropoutVGG, PixelEncoding, VGGConfig]):
    """DropoutVGG as a `safeswitch.protocols.Learner`; see `TrainedLearner` for its arguments."""

    FORMAT = "safeswitch-dropout-vgg-1"

    def _prepare(self) -> None:
        """Build what `predict` needs from the model."""
        config = self.config
        height, width, _ = self.encoding.observation_shape
        self._stack = FrameStack(self.encoding, config.frames)
        self._head = FrozenLayers(self.model.linears(), config.head_rates, config.samples, config.shared_trunk)
        self._masks = MaskStream(config.layout(height, width), config.samples)

    def reset(self, seed: int) -> None:
        """Start an episode: forget the frames and key the dropout masks by its seed."""
        self._stack.reset()
        self._masks.reset(seed)

    def predict(self, observation: NDArray[Any], step: int) -> Prediction:
        """Action and variances for one frame (H, W, C) uint8 at environment step `step`.

        `features` are the flattened features (d,) of the trunk before dropout.
        """
        frame = self._checked(observation)
        masks = self._masks.draw(step)
        blocks = len(self.config.channels)
        with one_thread(), torch.inference_mode():
            stack = self._stack.push(frame)
            features = self.model.trunk(stack).numpy()
            if self.config.shared_trunk:
                self._head.inputs[...] = features
            else:
                factors = scaled_masks(masks[:blocks], self.config.trunk_rates)
                copies = stack.expand(self.config.samples, -1, -1, -1).contiguous(memory_format=torch.channels_last)
                self._head.inputs[...] = self.model.trunk(copies, factors).numpy()
            output = self._head(masks[blocks:])
        action, epistemic_var, aleatoric_var = moments(output, self.model.actions, self.config.log_var_bounds)
        return Prediction(np.minimum(np.maximum(action, -1.0), 1.0), epistemic_var, aleatoric_var, features[0].copy())

    def mean_action(self, observation: NDArray[Any], step: int) -> NDArray[np.float64]:
        """Action (nu,) without dropout (weight scaling) for the next frame: what `predict` samples about, at less cost.

        It takes the frame into the memory as `predict` does: in an episode, call the one or the other.
        """
        with one_thread(), torch.inference_mode():
            mean, _ = self.model(self._stack.push(self._checked(observation)))
        return np.clip(mean[0].numpy().astype(np.float64), -1.0, 1.0)

    def _checked(self, observation: NDArray[Any]) -> NDArray[np.uint8]:
        frame = np.asarray(observation)
        if frame.shape != self.encoding.observation_shape or frame.dtype != np.uint8:
            raise ValueError(
                f"observation has shape {frame.shape} and type {frame.dtype}, but this learner was trained on images "
                f"of shape {self.encoding.observation_shape} and type uint8"
            )
        return frame

    def features(self, demonstrations: Demonstrations) -> NDArray[np.float32]:
        """Trunk features (n, d) of every training step, in order.

        They are computed in batches; those of `predict` may differ in the last bits.
        """
        from safeswitch_baselines.learners.image_training import trunk_features

        return trunk_features(self.model, self.encoding, demonstrations)

    @classmethod
    def train(
        cls, demos: Demonstrations, seed: int, options: Mapping[str, Any] | None = None, progress: Progress = False
    ) -> DropoutVGGLearner:
        """Train on demonstrations; `options` are fields of `VGGConfig`. See `image_training.train_dropout_vgg`."""
        from safeswitch_baselines.learners.image_training import train_dropout_vgg

        config = cls.configure(options or {})
        model, encoding, history = train_dropout_vgg(demos, seed, config, progress)
        return cls(model, encoding, config, history)

    @classmethod
    def configure(cls, options: Mapping[str, Any]) -> VGGConfig:
        """The configuration that `options` ask for."""
        return VGGConfig.from_json(options)

    @classmethod
    def _parts(
        cls, description: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
    ) -> tuple[PixelEncoding, VGGConfig]:
        return PixelEncoding(**arrays), VGGConfig.from_json(description["config"])

    @staticmethod
    def _build(encoding: PixelEncoding, config: VGGConfig, actions: int, generator: torch.Generator) -> DropoutVGG:
        return DropoutVGG(encoding.observation_shape, actions, config, generator)


class PaperLiteralLearner(DropoutVGGLearner):
    """The paper's learner, taken literally: a single frame, plain NLL, centred images, dropout everywhere."""

    @classmethod
    def configure(cls, options: Mapping[str, Any]) -> VGGConfig:
        """The paper's settings where `options` say nothing."""
        return VGGConfig.from_json({**PAPER_LITERAL, **options})


PAPER_LITERAL: Mapping[str, Any] = {
    "frames": 1,
    "loss": "nll",
    "warmup_epochs": 0,
    "standardisation": "centred",
    "trunk_dropout": 0.1,
    "feature_dropout": 0.1,
    "hidden_dropout": 0.1,
}
"""What sets `PaperLiteralLearner` apart; everything else is as in `VGGConfig`."""
