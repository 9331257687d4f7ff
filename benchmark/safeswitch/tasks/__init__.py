"""The tasks: Gymnasium environments on MuJoCo, their disturbances and their pictures."""

from __future__ import annotations

from safeswitch.tasks.rendering import choose_backend

# Before anything imports mujoco or dm_control: with MUJOCO_GL=egl and no EGL library, importing either one fails.
choose_backend()
