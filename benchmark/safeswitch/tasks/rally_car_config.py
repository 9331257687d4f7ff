"""Numbers that decide how hard the rally car's task is, chosen on the design split and then frozen."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields

from safeswitch.names import unknown

CONTROL_DT = 0.05
"""Control period [s]."""
TIMESTEP = 0.005
"""Time step of the simulation [s]: yaw rates agree with those at 0.0025 s to 0.1 %."""
HORIZON = 100
"""T, control steps of an episode: 5 s, long enough to meet an obstacle and drive on."""
SPEED = 4.0
"""[m/s]"""
SPEED_GAIN = 2.0
"""Throttle per error of the speed [1/(m/s)]."""
ONSET_RANGE = (0.1, 0.6)
"""The onset of a disturbance that is not placed is uniform between these shares of the episode."""


@dataclass(frozen=True)
class RallyCarConfig:
    """Everything that decides how hard the task is. `RallyCarEnv` takes any of these as keyword arguments.

    Attributes:
        control_dt: control period [s].
        timestep: time step of the simulation [s]; control_dt is a multiple of it.
        horizon: T, control steps of an episode.
        speed: at which an episode starts, and which the car with images holds [m/s].
        speed_gain: of the speed controller, throttle per error [1/(m/s)].
        spread_e_y: starts are uniform within +- this of the centreline [m].
        spread_e_psi: starts are uniform within +- this of the track's direction [rad].
        spread_speed: starts are uniform within +- this of `speed` [m/s].
        image_noise: standard deviation of the noise of every pixel, as a share of the full range.
        onset_low: earliest onset as a share of the episode, of disturbances that are not placed.
        onset_high: latest onset as a share of the episode.
    """

    control_dt: float = CONTROL_DT
    timestep: float = TIMESTEP
    horizon: int = HORIZON
    speed: float = SPEED
    speed_gain: float = SPEED_GAIN
    spread_e_y: float = 0.25
    spread_e_psi: float = 0.10
    spread_speed: float = 0.2
    image_noise: float = 0.009
    onset_low: float = ONSET_RANGE[0]
    onset_high: float = ONSET_RANGE[1]

    def __post_init__(self) -> None:
        """Refuse numbers that make no drive."""
        for name, value in asdict(self).items():
            positive = name in ("control_dt", "timestep", "horizon", "speed")
            if not (math.isfinite(value) and (value > 0.0 if positive else value >= 0.0)):
                raise ValueError(f"{name} must be finite and {'> 0' if positive else '>= 0'}, got {value!r}")
        if not self.onset_low <= self.onset_high < 1.0:
            raise ValueError(f"need onset_low <= onset_high < 1, got {self.onset_low} and {self.onset_high}")
        if self.horizon != int(self.horizon):
            raise ValueError(f"horizon must be a number of steps, got {self.horizon!r}")

    @classmethod
    def of(cls, **design: float) -> RallyCarConfig:
        """The configuration with some numbers replaced; an unknown name lists the valid ones."""
        valid = [field.name for field in fields(cls)]
        for name in design:
            if name not in valid:
                raise unknown("argument of RallyCarEnv", name, valid)
        return cls(**design)  # type: ignore[arg-type]
