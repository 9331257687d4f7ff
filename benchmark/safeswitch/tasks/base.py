"""`TaskEnv`, what all tasks share: the clock, the disturbance, snapshots, and Gymnasium's conventions.

An episode is a function of its seed. Three named streams feed it, `initial-state`, `onset` and `disturbance`, so the
undisturbed twin (same seed, ``disturbance=None``) starts in the same state and is identical until the onset step t0.

The disturbance sets in before the observation of step t0: from there on the simulator steps with its disturbed model.
t0 is drawn, and which model is in force is a function of the step index alone. A `placed` disturbance is different:
it stands in the world from the reset on, and t0 is the first step at which the trajectory at hand shows it. Until then
nothing that is observed, and no parameter, tells of it; a snapshot remembers whether it has been seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Expert
from safeswitch.seeding import stream
from safeswitch.tasks import checks, rally_disturbances, rally_visual, visual  # noqa: F401  (register disturbances)
from safeswitch.tasks.disturbances import Disturbance, make_disturbance
from safeswitch.tasks.rendering import Image, Renderer
from safeswitch.tasks.simulator import Simulator

Array = NDArray[np.float64]

HEADER = 5
"""Leading numbers of a snapshot: episode seed, step index, consecutive good states, terminated, and the onset of what
is placed (-1 until it is in view)."""


class TaskEnv(gym.Env[NDArray[Any], NDArray[Any]]):
    """Base class of the tasks; see the module docstring.

    A task sets `task`, `parameter_names` and `camera`, its spaces and reward, and fills in the methods that raise
    NotImplementedError here.

    Attributes:
        task: name of the task as it stands in tables.
        parameter_names: names of the model parameters, in the order of `parameters`.
        horizon: T, control steps of an episode.
        control_dt: duration of a control step [s].
        success_steps: number of consecutive good states that makes a success.
    """

    task: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]
    camera: ClassVar[str]
    metadata: dict[str, Any]

    def __init__(
        self,
        model: mujoco.MjModel,
        arguments: Mapping[str, Any],
        *,
        control_dt: float,
        horizon: int,
        success_steps: int,
        onset_range: tuple[float, float],
    ) -> None:
        """Set the episode up.

        Args:
            model: nominal model; copied, so that it may be shared.
            arguments: constructor arguments of the task, including `disturbance`, `severity`, `render_mode`, `width`
                and `height`; an unpickled environment is made from them.
            control_dt: duration of a control step [s], a multiple of the model's time step.
            horizon: T, control steps of an episode.
            success_steps: number of consecutive good states that makes a success.
            onset_range: the onset is uniform between these two shares of the episode.
        """
        self._arguments = dict(arguments)
        self.horizon, self.control_dt, self.success_steps = horizon, control_dt, success_steps
        self._onset_range = onset_range
        self.render_mode = checks.check_render_mode(arguments["render_mode"], self.metadata["render_modes"])
        self.metadata = {**self.metadata, "render_fps": round(1.0 / control_dt)}
        self.width, self.height = int(arguments["width"]), int(arguments["height"])

        name = arguments["disturbance"]
        self.disturbance: Disturbance | None = (
            None if name is None else make_disturbance(name, arguments["severity"], self.task)
        )
        self.simulator = Simulator(model, control_dt, disturbance=self.disturbance is not None)
        self._renderer: Renderer | None = None

        self._episode_seed: int | None = None
        self._options: dict[str, Any] = {}
        self._onset: int | None = None
        self._step_index = self._good_steps = 0
        self._terminated = False
        self._nominal_parameters = self._disturbed_parameters = self._read_parameters(model)

    # -------------------------------------------------------------------------------------------- filled in by a task

    def _draw_initial_state(self, rng: np.random.Generator) -> Array:
        """Initial full state (nx,) [SI units]."""
        raise NotImplementedError

    def _write_state(self, state: Array) -> None:
        """Put the full state (nx,) into the simulator."""
        raise NotImplementedError

    def _read_state(self) -> Array:
        """Full state (nx,) of the simulator [SI units]."""
        raise NotImplementedError

    def _read_parameters(self, model: mujoco.MjModel) -> Array:
        """Model parameters (np,) as the physics uses them, read from `model`."""
        raise NotImplementedError

    def _judge(self) -> tuple[bool, bool]:
        """(good, failed) of the current state: good ones add up to a success, a failed one ends the episode."""
        raise NotImplementedError

    def _reward(self) -> float:
        """Reward of the current state."""
        raise NotImplementedError

    def _observe(self, disturbance: Disturbance | None) -> NDArray[Any]:
        """Observation of the current state under the `disturbance` in force (None: as in the undisturbed task)."""
        raise NotImplementedError

    def _sees(self, disturbance: Disturbance) -> bool:
        """Whether the placed `disturbance` is in view in the current state."""
        raise NotImplementedError

    def distance_ahead(self) -> float:
        """Distance to what a placed disturbance has put in the way [m], negative behind it; NaN without one."""
        return math.nan

    def _actuator(self) -> Callable[[Array], None] | None:
        """Makes the controls from an action (nu,); None where the action is the controls."""
        return None

    def _watcher(self) -> Callable[[], None] | None:
        """What to call after every simulator step of the coming control step; None for nothing."""
        return None

    def make_expert(self) -> Expert:
        """The model-predictive expert of this task."""
        raise NotImplementedError

    # ------------------------------------------------------------------------------------------------------- episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode; the same `seed` gives the same episode.

        Args:
            seed: episode seed. None draws one from `np_random`.
            options: `initial_state` (nx,) and `onset` (0 .. T - 1) replace what the seed would give. The onset of a
                placed disturbance is seen on the way, and cannot be given.

        Returns:
            Observation and info of step 0.
        """
        super().reset(seed=seed)
        options = checks.check_options(options)
        self._episode_seed = int(self.np_random.integers(2**31)) if seed is None else int(seed)
        self._options = options
        self.simulator.reset()
        state = self._draw_initial_state(stream(self._episode_seed, "initial-state"))
        if "initial_state" in options:
            state = checks.check_state(options["initial_state"], state.shape)
        self._write_state(state)
        self._step_index = self._good_steps = 0
        self._prepare_disturbance(self._episode_seed, options.get("onset"))
        good, self._terminated = self._judge()
        self._good_steps = int(good)
        self._look()
        return self.observe(), self._info()

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Apply `action` (nu,) for one control step; components are clipped to [-1, 1].

        Returns:
            Observation, reward, terminated (failure), truncated (step T reached), info.
        """
        self.advance(action)
        truncated = self._step_index >= self.horizon and not self._terminated
        return self.observe(), self._reward(), self._terminated, truncated, self._info()

    def advance(self, action: NDArray[Any] | Sequence[float]) -> None:
        """The physics of `step`, without its observation, reward and info.

        Args:
            action: (nu,), action units; components are clipped to [-1, 1].

        Raises:
            ValueError: wrong shape, or a component that is not finite.
            RuntimeError: the episode has not begun or is over.
        """
        command = np.asarray(action, dtype=np.float64)
        if command.shape != self.simulator.action_shape or not math.isfinite(command.sum()):
            raise checks.invalid_action(action, self.simulator.action_shape)
        if self._episode_seed is None or self.done:
            raise checks.not_running(self._episode_seed is not None, self._step_index, self._terminated)
        self.simulator.advance(command, self._force(), self._actuator(), self._watcher())
        self._step_index += 1
        good, self._terminated = self._judge()
        self._good_steps = self._good_steps + 1 if good else 0
        self._look()

    def observe(self, clean: bool = False) -> NDArray[Any]:
        """Observation of the current step; `clean=True` gives the same state without the disturbance."""
        return self._observe(self.disturbance if self.disturbed and not clean else None)

    def render(self) -> Image | None:  # type: ignore[override]
        """Picture (height, width, 3) of the current state, disturbed or not; None without a render mode."""
        if self.render_mode is None:
            gym.logger.warn("render() needs a render mode: gym.make(id, render_mode='rgb_array')")
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.simulator.nominal, self.width, self.height, self.camera)
        return self._draw(self._renderer, self.disturbance if self.disturbed or self._placed else None)

    def _draw(self, renderer: Renderer, disturbance: Disturbance | None) -> Image:
        """Picture of the current state, with the looks of the `disturbance` in force."""
        model = self.simulator.nominal
        if disturbance is not None:
            model = self.simulator.disturbed
            disturbance.show(model, self._step_index - (self._onset or 0))
        self.simulator.update_kinematics(model)
        return renderer.render(model, self.simulator.data)

    def close(self) -> None:
        """Free the renderer; the physics keeps working and `render` makes a new one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    # ---------------------------------------------------------------------------------------------------- properties

    @property
    def step_index(self) -> int:
        """Control steps executed so far, 0 .. T."""
        return self._step_index

    @property
    def episode_seed(self) -> int:
        """Seed of the episode."""
        if self._episode_seed is None:
            raise RuntimeError("the episode has not begun: call reset() first")
        return self._episode_seed

    @property
    def onset(self) -> int | None:
        """t0, the first step that is observed under the disturbance; None in an undisturbed episode.

        T as long as a placed disturbance has not come into view; it may never do so.
        """
        return self.horizon if self._onset is None and self.disturbance is not None else self._onset

    @property
    def disturbed(self) -> bool:
        """Whether the onset has passed: step_index >= t0."""
        return self._onset is not None and self._step_index >= self._onset

    @property
    def terminated(self) -> bool:
        """Whether the task has failed."""
        return self._terminated

    @property
    def done(self) -> bool:
        """Whether the episode is over: failed, or T steps executed."""
        return self._terminated or self._step_index >= self.horizon

    @property
    def is_success(self) -> bool:
        """The success criterion, evaluated now; at the end of the episode it is the outcome."""
        return not self._terminated and self._good_steps >= self.success_steps

    @property
    def state(self) -> Array:
        """Full state (nx,) [SI units]."""
        return self._read_state()

    @property
    def parameters(self) -> Array:
        """Model parameters (np,) that the physics uses now; they change at the onset of a disturbance of them."""
        return (self._disturbed_parameters if self.disturbed else self._nominal_parameters).copy()

    # ----------------------------------------------------------------------------------------------------- snapshots

    def snapshot(self) -> Array:
        """Everything that the rest of the episode depends on, besides its seed and options, as one vector."""
        snapshot = np.empty(HEADER + self.simulator.state_size)
        onset = self._onset if self._placed and self._onset is not None else -1  # a drawn one follows from the seed
        snapshot[:HEADER] = (self._seed_key(), self._step_index, self._good_steps, self._terminated, onset)
        self.simulator.read(snapshot[HEADER:])
        return snapshot

    def restore(self, snapshot: Array) -> None:
        """Go back, or forward, to a snapshot of the same episode; it continues bit for bit.

        The environment must have been reset with the seed (and options) of the episode that the snapshot is from; the
        snapshot may come from another environment or process. Before its onset, a snapshot of the undisturbed twin
        is valid too.

        Raises:
            ValueError: the snapshot belongs to another task or episode.
        """
        size = HEADER + self.simulator.state_size
        if snapshot.shape != (size,):
            raise ValueError(f"a snapshot of {self.task} has shape ({size},), got {snapshot.shape}")
        if self._episode_seed is None or snapshot[0] != self._seed_key():
            raise ValueError(
                f"the snapshot is from another episode: call reset(seed={int(snapshot[0])}) before restore(); "
                f"the current episode seed is {self._episode_seed}"
            )
        self._step_index, self._good_steps = int(snapshot[1]), int(snapshot[2])
        self._terminated = bool(snapshot[3])
        self.simulator.write(snapshot[HEADER:])
        if self._placed:
            self._onset = None if snapshot[4] < 0 else int(snapshot[4])
        self._look()

    def __getstate__(self) -> dict[str, Any]:
        """Arguments, generator and snapshot: a pickled environment continues its episode, without the simulator."""
        episode = None if self._episode_seed is None else (self._episode_seed, self._options, self.snapshot())
        return {
            "arguments": self._arguments,
            "spec": self.spec,
            "generator": (self._np_random, self._np_random_seed),
            "episode": episode,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the environment anew from its arguments and go to where it was."""
        self.__init__(**state["arguments"])  # type: ignore[misc]
        self.spec = state["spec"]
        if state["episode"] is not None:
            seed, options, snapshot = state["episode"]
            self.reset(seed=seed, options=options)
            self.restore(snapshot)
        self._np_random, self._np_random_seed = state["generator"]

    # ------------------------------------------------------------------------------------------------------- helpers

    def _prepare_disturbance(self, seed: int, given_onset: int | None) -> None:
        """Draw onset and disturbance, and write the model that takes over at the onset."""
        if self.disturbance is None:
            self._onset = None
            return
        if self._placed:
            if given_onset is not None:
                name = self.disturbance.name  # type: ignore[union-attr]
                raise ValueError(f"the onset of {name!r} is the first step at which it is in view: it cannot be given")
            self._onset = None
        else:
            drawn = self._draw_onset(stream(seed, "onset"))
            self._onset = drawn if given_onset is None else checks.check_onset(given_onset, self.horizon)
        self.disturbance.reset(stream(seed, "disturbance"), self.horizon)
        self._place(self.disturbance, stream(seed, "place"))
        self.simulator.disturb(self.disturbance)
        self._disturbed_parameters = self._read_parameters(self.simulator.disturbed)

    @property
    def _placed(self) -> bool:
        """Whether the onset is seen on the way."""
        return self.disturbance is not None and self.disturbance.placed

    def _place(self, disturbance: Disturbance, rng: np.random.Generator) -> None:
        """Put a disturbance, which knows what it is, somewhere in this episode's world; `rng` is its own stream."""

    def _look(self) -> None:
        """Set the onset of a placed disturbance when it comes into view, and choose the model that is in force."""
        if self._placed and self._onset is None and self._sees(self.disturbance):  # type: ignore[arg-type]
            self._onset = self._step_index
        self.simulator.choose(self.disturbed or self._placed)

    def _draw_onset(self, rng: np.random.Generator) -> int:
        """Uniform in the onset range, both ends included."""
        low, high = (round(share * self.horizon) for share in self._onset_range)
        return int(rng.integers(low, high, endpoint=True))

    def _force(self) -> Array | None:
        """Generalised force (nv,) of the disturbance during the coming step; None for none."""
        if self.disturbance is None or self._onset is None or self._step_index < self._onset:
            return None
        return self.disturbance.force(self._step_index - self._onset)

    def _info(self) -> dict[str, Any]:
        """The same keys at reset and at every step."""
        return {
            "state": self.state,
            "parameters": self.parameters,
            "is_success": self.is_success,
            "disturbed": self.disturbed,
            "step": self._step_index,
            "onset": -1 if self.onset is None else self.onset,
        }

    def _seed_key(self) -> float:
        """The episode seed as it stands in a snapshot (a float holds integers up to 2^53)."""
        return float(self.episode_seed % 2**53)
