"""Models are composed from the checkout's MJCF, once per configuration, with every number arriving exactly."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from safeswitch.tasks import models
from safeswitch.tasks.cart_pole import CartPoleConfig

REPOSITORY = Path(__file__).resolve().parents[1]


def test_assets_come_from_the_checkout() -> None:
    assert models.assets_folder() == REPOSITORY / "assets"


def test_missing_assets_say_where_they_were_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "__file__", str(tmp_path / "site" / "safeswitch" / "tasks" / "models.py"))
    with pytest.raises(FileNotFoundError, match="expected common/scene.xml"):
        models.assets_folder()
    wheel = tmp_path / "site" / "safeswitch" / "assets" / "common"
    wheel.mkdir(parents=True)
    (wheel / "scene.xml").touch()
    assert models.assets_folder() == wheel.parent


def test_one_compilation_per_configuration() -> None:
    assert models.cart_pole(CartPoleConfig()) is models.cart_pole(CartPoleConfig())
    assert models.cart_pole(CartPoleConfig(rail=2.5)) is not models.cart_pole(CartPoleConfig())


def test_numbers_arrive_to_the_last_bit() -> None:
    config = CartPoleConfig(cart_mass=1 / 3, pole_length=np.pi / 7, pole_inertia=1e-4 / 3, force_limit=1e-20 + 29 / 3)
    model = models.cart_pole(config)
    assert model.body_mass[model.body("cart").id] == config.cart_mass
    assert model.body_ipos[model.body("pole").id, 2] == config.pole_length
    assert model.body_inertia[model.body("pole").id, 1] == config.pole_inertia
    assert model.actuator_gear[0, 0] == config.force_limit


def test_drawing_follows_the_configuration() -> None:
    model = models.cart_pole(CartPoleConfig(rail=3.0, pole_length=0.8))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.geom("beam").size[0] == 3.0
    assert [model.geom(name).pos[0] for name in ("stop_left", "stop_right")] == [-3.0, 3.0]
    hinge = data.body("pole").xpos
    np.testing.assert_allclose(data.geom("bob").xpos, hinge + [0, 0, 0.8])
    np.testing.assert_allclose(data.geom("bob").xpos, data.body("pole").xipos)
    assert 2 * model.geom("pole").size[1] == pytest.approx(0.8)


def test_scene_has_the_switches_that_the_tasks_rely_on() -> None:
    model = models.cart_pole(CartPoleConfig())
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4.value


def test_importing_safeswitch_is_light() -> None:
    """Neither simulator nor learning library is imported before an environment is made."""
    code = (
        "import sys, safeswitch; heavy = {'torch', 'mujoco', 'dm_control', 'casadi'} & set(sys.modules); "
        "assert not heavy, heavy; import safeswitch.tasks.cart_pole; "
        "late = {'torch', 'dm_control', 'casadi', 'OpenGL.GL'} & set(sys.modules); assert not late, late"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
