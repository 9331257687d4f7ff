"""`TaskEnv`: what all tasks share: the clock, the disturbance, snapshots, and Gymnasium's conventions.

An episode is a function of its seed. Three named streams feed it, `initial-state`, `onset` and `disturbance`, so the
undisturbed twin (same seed, ``disturbance=None``) starts in the same state and is identical until the onset step t0.

Each environment owns two copies of the model: the nominal one, and the disturbed one that takes over before the
observation of step t0. Which of them is in force is a function of the step index alone, and MuJoCo's state is never
touched by a disturbance; therefore `restore` needs no memory of what happened.
"""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.names import unknown
from safeswitch.protocols import Expert
from safeswitch.seeding import stream
from safeswitch.tasks.disturbances import Disturbance, make_disturbance
from safeswitch.tasks.rendering import Image, Renderer

Array = NDArray[np.float64]

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION.value)
"""Everything from which MuJoCo computes the next step: positions, velocities, controls, forces, warm start, time."""

HEADER = 4
"""Leading numbers of a snapshot: episode seed, step index, consecutive good states, terminated."""

RESET_OPTIONS = ("initial_state", "onset")


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
        self.render_mode = check_render_mode(arguments["render_mode"], self.metadata["render_modes"])
        self.metadata = {**self.metadata, "render_fps": round(1.0 / control_dt)}
        self.width, self.height = int(arguments["width"]), int(arguments["height"])

        name = arguments["disturbance"]
        self.disturbance: Disturbance | None = (
            None if name is None else make_disturbance(name, arguments["severity"], self.task)
        )
        self._nominal = copy.deepcopy(model)
        self._disturbed = self._nominal if self.disturbance is None else copy.deepcopy(model)
        self._model = self._nominal
        self._data = mujoco.MjData(self._nominal)
        self._ctrl, self._qfrc_applied = self._data.ctrl, self._data.qfrc_applied
        self._substeps = count_substeps(control_dt, model.opt.timestep)
        self._renderer: Renderer | None = None

        self._episode_seed: int | None = None
        self._options: dict[str, Any] = {}
        self._onset: int | None = None
        self._step_index = self._good_steps = 0
        self._terminated = False
        self._nominal_parameters = self._disturbed_parameters = self._read_parameters(self._nominal)

    # -------------------------------------------------------------------------------------------- filled in by a task

    @abstractmethod
    def _draw_initial_state(self, rng: np.random.Generator) -> Array:
        """Initial full state (nx,) [SI units]."""
        raise NotImplementedError

    @abstractmethod
    def _write_state(self, state: Array) -> None:
        """Put the full state (nx,) into the simulator."""
        raise NotImplementedError

    @abstractmethod
    def _read_state(self) -> Array:
        """Full state (nx,) of the simulator [SI units]."""
        raise NotImplementedError

    @abstractmethod
    def _read_parameters(self, model: mujoco.MjModel) -> Array:
        """Model parameters (np,) as the physics uses them, read from `model`."""
        raise NotImplementedError

    @abstractmethod
    def _judge(self) -> tuple[bool, bool]:
        """(good, failed) of the current state: good ones add up to a success, a failed one ends the episode."""
        raise NotImplementedError

    @abstractmethod
    def _reward(self) -> float:
        """Reward of the current state."""
        raise NotImplementedError

    @abstractmethod
    def _observe(self, disturbance: Disturbance | None) -> NDArray[Any]:
        """Observation of the current state under the `disturbance` in force (None: as in the undisturbed task)."""
        raise NotImplementedError

    @abstractmethod
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
            options: `initial_state` (nx,) and `onset` (0 .. T - 1) replace what the seed would give.

        Returns:
            Observation and info of step 0.
        """
        super().reset(seed=seed)
        options = check_options(options)
        self._episode_seed = int(self.np_random.integers(2**31)) if seed is None else int(seed)
        self._options = options
        mujoco.mj_resetData(self._nominal, self._data)
        self._write_state(self._initial_state(self._episode_seed, options.get("initial_state")))
        self._step_index = self._good_steps = 0
        self._prepare_disturbance(self._episode_seed, options.get("onset"))
        good, self._terminated = self._judge()
        self._good_steps = int(good)
        self._choose_model()
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
        if command.shape != self._ctrl.shape or not math.isfinite(command.sum()):
            raise invalid_action(action, self._ctrl.shape)
        if self._episode_seed is None or self.done:
            raise RuntimeError("the episode has not begun or is over: call reset() first")
        np.clip(command, -1.0, 1.0, out=self._ctrl)
        self._apply_force()
        mujoco.mj_step(self._model, self._data, nstep=self._substeps)
        self._step_index += 1
        good, self._terminated = self._judge()
        self._good_steps = self._good_steps + 1 if good else 0
        if self._step_index == self._onset:
            self._choose_model()

    def observe(self, clean: bool = False) -> NDArray[Any]:
        """Observation of the current step; `clean=True` gives the same state without the disturbance."""
        return self._observe(self.disturbance if self.disturbed and not clean else None)

    def render(self) -> Image | None:  # type: ignore[override]
        """Picture (height, width, 3) of the current state, disturbed or not; None without a render mode."""
        if self.render_mode is None:
            gym.logger.warn("render() needs a render mode: gym.make(id, render_mode='rgb_array')")
            return None
        if self._renderer is None:
            self._renderer = Renderer(self._nominal, self.width, self.height, self.camera)
        self._update_kinematics(self._model)
        return self._renderer.render(self._model, self._data)

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
        """t0, the first step that is observed under the disturbance; None in an undisturbed episode."""
        return self._onset

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
        return (self._disturbed_parameters if self._model is self._disturbed else self._nominal_parameters).copy()

    # ----------------------------------------------------------------------------------------------------- snapshots

    def snapshot(self) -> Array:
        """Everything that the rest of the episode depends on, besides its seed and options, as one vector."""
        state = np.empty(HEADER + mujoco.mj_stateSize(self._nominal, STATE))
        state[:HEADER] = (self._seed_key(), self._step_index, self._good_steps, self._terminated)
        mujoco.mj_getState(self._nominal, self._data, state[HEADER:], STATE)
        return state

    def restore(self, snapshot: Array) -> None:
        """Go back, or forward, to a snapshot of the same episode; it continues bit for bit.

        The environment must have been reset with the seed (and options) of the episode that the snapshot is from; the
        snapshot may come from another environment or process. Before its onset, a snapshot of the undisturbed twin
        is valid too.

        Raises:
            ValueError: the snapshot belongs to another task or episode.
        """
        size = HEADER + mujoco.mj_stateSize(self._nominal, STATE)
        if snapshot.shape != (size,):
            raise ValueError(f"a snapshot of {self.task} has shape ({size},), got {snapshot.shape}")
        if self._episode_seed is None or snapshot[0] != self._seed_key():
            raise ValueError(
                f"the snapshot is from another episode: call reset(seed={int(snapshot[0])}) before restore(); "
                f"the current episode seed is {self._episode_seed}"
            )
        self._step_index, self._good_steps = int(snapshot[1]), int(snapshot[2])
        self._terminated = bool(snapshot[3])
        mujoco.mj_setState(self._nominal, self._data, np.ascontiguousarray(snapshot[HEADER:], np.float64), STATE)
        self._choose_model()

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

    def _initial_state(self, seed: int, given: Any) -> Array:
        """The state `given`, checked, or the one that the seed draws."""
        drawn = self._draw_initial_state(stream(seed, "initial-state"))
        if given is None:
            return drawn
        state = np.asarray(given, dtype=np.float64)
        if state.shape != drawn.shape or not np.isfinite(state).all():
            raise ValueError(f"initial_state must be {drawn.shape} finite numbers, got {given!r}")
        return state

    def _prepare_disturbance(self, seed: int, given_onset: int | None) -> None:
        """Draw onset and disturbance, and write the model that takes over at the onset."""
        if self.disturbance is None:
            self._onset = None
            return
        self._onset = self._draw_onset(stream(seed, "onset")) if given_onset is None else int(given_onset)
        if not 0 <= self._onset < self.horizon:
            raise ValueError(f"the onset must be a step from 0 to {self.horizon - 1}, got {self._onset}")
        self.disturbance.reset(stream(seed, "disturbance"), self.horizon)
        self.disturbance.alter(self._nominal, self._disturbed)
        if self.disturbance.changes_inertia:
            # In scratch data: it evaluates the reference pose, and the state of the episode is none of its business.
            mujoco.mj_setConst(self._disturbed, mujoco.MjData(self._disturbed))
        self._disturbed_parameters = self._read_parameters(self._disturbed)

    def _draw_onset(self, rng: np.random.Generator) -> int:
        """Uniform in the onset range, both ends included."""
        low, high = (round(share * self.horizon) for share in self._onset_range)
        return int(rng.integers(low, high, endpoint=True))

    def _choose_model(self) -> None:
        """Put the model that belongs to the current step in force."""
        self._model = self._disturbed if self.disturbed else self._nominal

    def _apply_force(self) -> None:
        """Set the generalised force of the disturbance for the coming step."""
        if self.disturbance is None or self._onset is None or self._step_index < self._onset:
            return
        force = self.disturbance.force(self._step_index - self._onset)
        if force is not None:
            self._qfrc_applied[:] = force

    def _update_kinematics(self, model: mujoco.MjModel) -> None:
        """Bring the geometry up to date with the state; unlike `mj_forward` this leaves the state untouched."""
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_comPos(model, self._data)
        mujoco.mj_camlight(model, self._data)

    def _info(self) -> dict[str, Any]:
        """The same keys at reset and at every step."""
        return {
            "state": self.state,
            "parameters": self.parameters,
            "is_success": self.is_success,
            "disturbed": self.disturbed,
            "step": self._step_index,
            "onset": -1 if self._onset is None else self._onset,
        }

    def _seed_key(self) -> float:
        """The episode seed as it stands in a snapshot (a float holds integers up to 2^53)."""
        return float(self.episode_seed % 2**53)


def count_substeps(control_dt: float, timestep: float) -> int:
    """Simulator steps in a control step."""
    substeps = round(control_dt / timestep)
    if substeps < 1 or not math.isclose(substeps * timestep, control_dt, rel_tol=1e-9):
        raise ValueError(f"control_dt must be a multiple of the time step {timestep} s, got {control_dt} s")
    return substeps


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


def invalid_action(action: Any, shape: tuple[int, ...]) -> ValueError:
    """Error that says what is wrong with an action."""
    array = np.asarray(action, dtype=np.float64)
    if array.shape != shape:
        return ValueError(f"an action has shape {shape}, got {array.shape}: {action!r}")
    return ValueError(f"an action must be finite, got {action!r}")
