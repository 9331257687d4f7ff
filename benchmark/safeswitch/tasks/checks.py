"""Checks of what users pass to an environment: clear errors instead of a wrong simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.names import unknown

RESET_OPTIONS = ("initial_state", "onset")
"""What `options` of `reset` may hold."""


def check_render_mode(mode: str | None, valid: Sequence[str]) -> str | None:
    """`mode` if it is None or one of the `valid` ones, else a ValueError."""
    if mode is not None and mode not in valid:
        raise unknown("render_mode", mode, valid)
    return mode


def check_options(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Reset options without unknown names."""
    for name in options or ():
        if name not in RESET_OPTIONS:
            raise unknown("reset option", name, RESET_OPTIONS)
    return dict(options or {})


def check_state(state: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """An initial state as a float64 array of `shape`, else a ValueError."""
    array = np.array(state, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"initial_state must be {shape} finite numbers, got {state!r}")
    return array


def check_onset(onset: Any, horizon: int) -> int:
    """An onset that is a step of the episode, else a ValueError."""
    if onset != int(onset) or not 0 <= onset < horizon:
        raise ValueError(f"the onset must be a step from 0 to {horizon - 1}, got {onset!r}")
    return int(onset)


def invalid_action(action: Any, shape: tuple[int, ...]) -> ValueError:
    """Error that says what is wrong with an action."""
    array = np.asarray(action, dtype=np.float64)
    if array.shape != shape:
        return ValueError(f"an action has shape {shape}, got {array.shape}: {action!r}")
    return ValueError(f"an action must be finite, got {action!r}")


def not_running(begun: bool, step: int, failed: bool) -> RuntimeError:
    """Error for an action outside an episode."""
    if not begun:
        return RuntimeError("the episode has not begun: call reset() first")
    outcome = "failed" if failed else "reached its last step"
    return RuntimeError(f"the episode is over, it {outcome} after {step} steps: call reset() before the next action")
