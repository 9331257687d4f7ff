"""SafeSwitch: when should a learned controller hand control back to an expert?

Importing this package registers the environments with Gymnasium and imports neither MuJoCo nor torch::

    import gymnasium as gym
    import safeswitch  # or gym.make("safeswitch:SafeSwitch/CartPole-v0")

    env = gym.make("SafeSwitch/CartPole-v0", disturbance="cart-mass", severity=3)
"""

from __future__ import annotations

import gymnasium as gym

__version__ = "0.1.0"

ENTRY_POINTS: dict[str, str] = {
    "SafeSwitch/CartPole-v0": "safeswitch.tasks.cart_pole:CartPoleEnv",
    "SafeSwitch/CartPoleImage-v0": "safeswitch.tasks.cart_pole_image:CartPoleImageEnv",
    "SafeSwitch/RallyCar-v0": "safeswitch.tasks.rally_car:RallyCarEnv",
    "SafeSwitch/RallyCarImage-v0": "safeswitch.tasks.rally_car_image:RallyCarImageEnv",
}
"""Environment id -> where its class is, imported when the environment is made."""

HANDOVER_TASKS: dict[str, str] = {
    "SafeSwitch/CartPoleHandover-v0": "cart-pole",
    "SafeSwitch/CartPoleImageHandover-v0": "cart-pole-image",
    "SafeSwitch/RallyCarImageHandover-v0": "rally-car-image",
}
"""Environment id of the switching problem -> the task whose handover tables it is served from."""


def register() -> None:
    """Register every SafeSwitch id that Gymnasium does not know yet.

    No `max_episode_steps`: the environments count their own steps, because a snapshot restored in the middle of an
    episode would leave the counter of a `TimeLimit` wrapper behind.
    """
    for env_id, entry_point in ENTRY_POINTS.items():
        if env_id not in gym.registry:
            gym.register(id=env_id, entry_point=entry_point)
    for env_id, task in HANDOVER_TASKS.items():
        if env_id not in gym.registry:
            gym.register(
                id=env_id,
                entry_point="safeswitch.handover.served:make",
                vector_entry_point="safeswitch.handover.served:make_vector",
                kwargs={"task": task},
            )


register()
