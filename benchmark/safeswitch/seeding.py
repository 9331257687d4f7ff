"""Named random streams. Every random number of the suite comes from here, none from a global generator."""

from __future__ import annotations

import zlib

import numpy as np


def seed_sequence(seed: int, *names: str | int) -> np.random.SeedSequence:
    """Seed sequence of the stream `names` of `seed`; streams with different names are independent."""
    keys = [zlib.crc32(name.encode()) if isinstance(name, str) else int(name) for name in names]
    return np.random.SeedSequence([int(seed), *keys])


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Generator of the stream `names` of `seed`, for example ``stream(7, "initial-state")``."""
    return np.random.default_rng(seed_sequence(seed, *names))
