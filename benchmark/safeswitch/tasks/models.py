"""Composes the MJCF of a task (base model + scene) with `dm_control.mjcf` and compiles it for MuJoCo.

`dm_control` composes, nothing more: the compiled model is stepped and rendered by `mujoco` itself. It is imported
lazily, because it takes half a second and because it fails where `MUJOCO_GL` names a missing library (importing
`safeswitch.tasks` has taken care of that by the time anything here runs).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco

from safeswitch.tasks.opengl import switched_off

if TYPE_CHECKING:
    from safeswitch.tasks.cart_pole import CartPoleConfig

RAIL_LEG_INSET = 0.2
"""Distance of the legs from the ends of the rail [m]; only for the eye."""
ROD_RADIUS, BOB_RADIUS = 0.04, 0.1
"""Of the pole as the image task draws it [m]: two and six pixels wide."""


def assets_folder() -> Path:
    """Folder of the MJCF files: the checkout's `assets` if there is one, else the copy inside an installed wheel.

    The checkout comes first because an editable install may leave a stale copy of `assets` in site-packages.
    """
    package = Path(__file__).resolve().parents[1]
    candidates = (package.parents[1] / "assets", package / "assets")
    for folder in candidates:
        if (folder / "common" / "scene.xml").is_file():
            return folder
    listing = " or ".join(str(folder) for folder in candidates)
    raise FileNotFoundError(f"the MJCF files of SafeSwitch are missing: expected common/scene.xml in {listing}")


def compose(base: str, model: str = "common/scene.xml") -> Any:
    """MJCF tree of the scene `model` with the robot `base` merged into it, names kept; both relative to `assets`."""
    scene = part(model)
    scene.include_copy(part(base), override_attributes=True)
    return scene


def part(path: str) -> Any:
    """MJCF tree of one file below `assets`."""
    with switched_off():  # dm_control composes and never draws: it need not start OpenGL
        from dm_control import mjcf

    return mjcf.from_path(str(assets_folder() / path))


def compile_model(tree: Any) -> mujoco.MjModel:
    """Compile an MJCF tree. 17 digits, so that every number of the tree arrives in the model to the last bit."""
    xml = tree.to_xml_string(precision=17, zero_threshold=0.0, filename_with_hash=True)
    return mujoco.MjModel.from_xml_string(xml, tree.get_assets())


@lru_cache(maxsize=64)
def cart_pole(config: CartPoleConfig) -> mujoco.MjModel:
    """Compiled cart-pole with the numbers of `config`. Shared within the process: copy it before changing it."""
    return compile_model(_cart_pole_tree(config))


@lru_cache(maxsize=64)
def cart_pole_image(config: CartPoleConfig) -> mujoco.MjModel:
    """The same physics in a studio: a wall, props, a third-person camera, and a pole that 64 pixels can show."""
    tree = _cart_pole_tree(config)
    tree.include_copy(part("cart_pole/studio.xml"))
    rod, bob = tree.find("geom", "pole"), tree.find("geom", "bob")
    rod.size = [ROD_RADIUS, rod.size[1]]
    bob.size = [BOB_RADIUS]
    return compile_model(tree)


def _cart_pole_tree(config: CartPoleConfig) -> Any:
    tree = compose("cart_pole/cart_pole.xml")
    tree.option.timestep = config.timestep

    tree.find("body", "cart").inertial.mass = config.cart_mass
    tree.find("joint", "slide").damping = config.cart_damping
    pole = tree.find("body", "pole")
    pole.inertial.mass = config.pole_mass
    pole.inertial.pos = [0.0, 0.0, config.pole_length]
    pole.inertial.diaginertia = [config.pole_inertia] * 3
    tree.find("joint", "hinge").damping = config.pole_damping
    tree.find("actuator", "force").gear = [config.force_limit, 0.0, 0.0, 0.0, 0.0, 0.0]

    _draw_pole(tree, config.pole_length)
    _draw_rail(tree, config.rail)
    return tree


def _draw_pole(tree: Any, length: float) -> None:
    """Let the rod reach from the hinge to the bob at `length` [m]."""
    rod = tree.find("geom", "pole")
    rod.size = [rod.size[0], 0.5 * length]
    rod.pos = [0.0, 0.0, 0.5 * length]
    tree.find("geom", "bob").pos = [0.0, 0.0, length]


def _draw_rail(tree: Any, rail: float) -> None:
    """Let the beam span +-`rail` [m], with its stops at the ends and its legs inside them."""
    beam = tree.find("geom", "beam")
    beam.size = [rail, *beam.size[1:]]
    for side, name in ((-1.0, "left"), (1.0, "right")):
        stop, leg = tree.find("geom", f"stop_{name}"), tree.find("geom", f"leg_{name}")
        stop.pos = [side * rail, *stop.pos[1:]]
        leg.pos = [side * (rail - RAIL_LEG_INSET), *leg.pos[1:]]
