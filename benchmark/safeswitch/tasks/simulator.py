"""One state, two models: the nominal one, and the disturbed one that takes over at the onset.

A disturbance writes into the second model and never into the state, so that going over from one to the other, in either
direction, is nothing but stepping with the other model.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.disturbances import Disturbance

Array = NDArray[np.float64]

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION.value)
"""Everything from which MuJoCo computes the next step: positions, velocities, controls, forces, warm start, time."""


class Simulator:
    """MuJoCo state of one environment, and the models that move it.

    Where a model has user data (`nuserdata`), they hold the action in force, and the task makes the controls from it;
    elsewhere the action is the controls.

    Attributes:
        nominal: the undisturbed model; nothing writes to it.
        disturbed: the model from the onset on; the same object where no disturbance is given.
        model: the one of the two that is in force.
        data: the state.
        action: (nu,) the action in force, part of the state.
    """

    def __init__(self, model: mujoco.MjModel, control_dt: float, *, disturbance: bool) -> None:
        """Copy `model`, which may be shared; `disturbance` says whether a second copy is needed."""
        self.nominal = copy.deepcopy(model)
        self.disturbed = copy.deepcopy(model) if disturbance else self.nominal
        self.model = self.nominal
        self.data = mujoco.MjData(self.nominal)
        self._scratch = mujoco.MjData(self.nominal)
        self.action: Array = self.data.userdata if self.nominal.nuserdata else self.data.ctrl
        self._substeps = count_substeps(control_dt, model.opt.timestep)
        self.action_shape = self.action.shape
        self.state_size = mujoco.mj_stateSize(self.nominal, STATE)

    def reset(self) -> None:
        """Reference pose, at rest, in the nominal model."""
        mujoco.mj_resetData(self.nominal, self.data)
        self.model = self.nominal

    def disturb(self, disturbance: Disturbance) -> None:
        """Write the disturbed model of this episode."""
        disturbance.alter(self.nominal, self.disturbed)
        if disturbance.changes_inertia:
            # In scratch data: it evaluates the reference pose, and the state of the episode is none of its business.
            mujoco.mj_setConst(self.disturbed, self._scratch)

    def choose(self, disturbed: bool) -> None:
        """Put one of the two models in force."""
        self.model = self.disturbed if disturbed else self.nominal

    def advance(
        self,
        command: Array,
        force: Array | None,
        actuate: Callable[[Array], None] | None = None,
        watch: Callable[[], None] | None = None,
    ) -> None:
        """One control step.

        Args:
            command: (nu,), clipped to [-1, 1].
            force: generalised force (nv,), or None.
            actuate: makes the controls from the clipped action, where they are not the same.
            watch: called after every simulator step, where one has to look that closely.
        """
        np.maximum(command, -1.0, out=self.action)  # half the time of np.clip
        np.minimum(self.action, 1.0, out=self.action)
        if force is not None:
            self.data.qfrc_applied[:] = force
        if actuate is not None:
            actuate(self.action)
        if watch is None:
            mujoco.mj_step(self.model, self.data, nstep=self._substeps)
            return
        for _ in range(self._substeps):
            mujoco.mj_step(self.model, self.data)
            watch()

    def read(self, out: Array) -> None:
        """Write the full integration state into `out` (state_size,)."""
        mujoco.mj_getState(self.nominal, self.data, out, STATE)

    def write(self, state: Array) -> None:
        """Set the full integration state (state_size,)."""
        mujoco.mj_setState(self.nominal, self.data, np.ascontiguousarray(state, np.float64), STATE)

    def update_kinematics(self, model: mujoco.MjModel) -> None:
        """Bring the geometry up to date with the state; unlike `mj_forward` this leaves the state untouched."""
        mujoco.mj_kinematics(model, self.data)
        mujoco.mj_comPos(model, self.data)
        mujoco.mj_camlight(model, self.data)


def count_substeps(control_dt: float, timestep: float) -> int:
    """Simulator steps in a control step."""
    substeps = round(control_dt / timestep)
    if substeps < 1 or not math.isclose(substeps * timestep, control_dt, rel_tol=1e-9):
        raise ValueError(f"control_dt must be a multiple of the time step {timestep} s, got {control_dt} s")
    return substeps
