"""A MuJoCo model's step as one kernel is MJX's step."""

import os
import re
import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from helpers.mjx_comparison import assert_moves_as_in_mjx
from helpers.small_kernels import launches
from helpers.small_models import (
    BUTTON,
    CART_POLE,
    HOPPER,
    batch_of,
    by_mjx,
    c_steps,
    chain,
    difference,
    model_of,
)
from onekernel import UnsupportedError, fuse
from onekernel.lower import jaxpr
from onekernel.mujoco import MjxState, fuse_mjx

FALLS = (
    '<mujoco><worldbody><body><joint type="slide"/><geom size="0.1"/></body></worldbody></mujoco>'
)
"""The smallest model: XLA compiles its step soonest."""

SENSES = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body>
      <joint type="slide" axis="0 0 1"/><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.05"/><site name="tip" pos="0 0 -0.2"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
  <sensor>
    <jointpos joint="hinge"/><velocimeter site="tip"/><accelerometer site="tip"/>
    <framepos objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""
"""A leg whose foot touches the floor at some angles, with sensors."""


def compared(model, *, with_mjx=False, n_substeps=1):
    """How far the kernel is from C MuJoCo, and from MJX."""
    step = fuse_mjx(model, n_substeps, on_unsupported="raise")
    before, wanted, ctrl = c_steps(model, 64, n_substeps)
    states = batch_of(step, before)
    found = jax.jit(jax.vmap(step))(states, ctrl)
    np.testing.assert_allclose(found.time, wanted["time"], rtol=1e-6)
    np.testing.assert_allclose(found.act, wanted["act"], atol=1e-6)
    return difference(found, wanted), with_mjx and difference(found, by_mjx(step, states, ctrl))


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "n_substeps"), [("Euler", 3), ("RK4", 1)])
def test_a_cart_moves_as_in_c(integrator, n_substeps):
    assert compared(model_of(CART_POLE, integrator), n_substeps=n_substeps)[0] < 1e-6


@pytest.mark.slow
def test_a_cart_moves_as_in_mjx():
    from_c, from_mjx = compared(model_of(CART_POLE, "implicitfast"), with_mjx=True)
    assert from_c < 1e-6
    assert from_mjx < 1e-6


def test_a_leg_meets_the_floor_as_in_mjx():
    from_c, from_mjx = compared(model_of(HOPPER), with_mjx=True)
    assert from_c < 3e-6
    assert from_mjx < 1e-6


@pytest.mark.slow
def test_a_chain_of_fourteen_swings_as_in_c():
    # Its mass matrix is so badly conditioned that MJX in float32 is as far from C.
    assert compared(model_of(chain(14)))[0] < 1e-4


@pytest.fixture(scope="module")
def button():
    return fuse_mjx(model_of(BUTTON), n_substeps=50, on_unsupported="raise")


def test_a_mocap_body_pulls_while_its_constraint_is_active(button):
    def fall(state):
        return button(state, jnp.zeros(0))

    state = button.init()
    assert (state.eq_active.dtype, state.act.shape) == (bool, (0,))
    higher = state.replace(mocap_pos=state.mocap_pos + jnp.array([0.0, 0.0, 0.01]))
    free = state.replace(eq_active=~state.eq_active)
    held, lifted, fallen = jax.jit(lambda *states: [fall(x) for x in states])(state, higher, free)
    assert held.qpos[2] == pytest.approx(0.9, abs=2e-3)
    assert lifted.qpos[2] - held.qpos[2] == pytest.approx(0.01, abs=1e-3)
    assert fallen.qpos[2] == pytest.approx(0.9 - 0.5 * 9.81 * 0.1**2, abs=2e-3)
    assert fallen.time == pytest.approx(0.1)
    np.testing.assert_array_equal(lifted.mocap_pos, higher.mocap_pos)


@pytest.fixture(scope="module")
def falls():
    return fuse_mjx(mujoco.MjModel.from_xml_string(FALLS), on_unsupported="raise")


def test_applied_forces_act(falls):
    state, none = falls.init(), jnp.zeros(0)
    up = jnp.array([3.0])
    mass = falls.mj_model.body_mass[1]
    plain = falls(state, none)
    pushed = falls(state, none, qfrc_applied=up)
    both = falls(state, none, qfrc_applied=up, xfrc_applied=jnp.zeros((2, 6)).at[1, 2].set(2.0))
    step = falls.mj_model.opt.timestep
    np.testing.assert_allclose(plain.qvel, -9.81 * step, rtol=1e-6)
    np.testing.assert_allclose(pushed.qvel - plain.qvel, 3.0 / mass * step, rtol=1e-4)
    np.testing.assert_allclose(both.qvel - plain.qvel, 5.0 / mass * step, rtol=1e-4)


def test_a_state_goes_to_data_of_mjx_and_back(button):
    state = button.init(qvel=np.arange(6.0)).replace(time=jnp.float32(2.0))
    data = button.to_data(state)
    assert isinstance(data, mjx.Data)
    assert data.time == 2.0
    back = button.from_data(data)
    jax.tree.map(np.testing.assert_array_equal, state, back)
    with pytest.raises(ValueError, match=r"ctrl has the shape \(3,\), not \(0,\)"):
        button.to_data(state, jnp.zeros(3))


def test_a_state_begins_as_after_a_reset_or_as_given(button):
    state = button.init()
    np.testing.assert_allclose(state.qpos, [0, 0, 0.9, 1, 0, 0, 0])
    np.testing.assert_allclose(state.mocap_pos, [[0, 0, 1]])
    given = jax.vmap(button.init)(jnp.ones((3, 7)))
    assert given.qpos.shape == (3, 7)
    assert given.qvel.shape == (3, 6)


def test_a_batch_without_vmap_is_refused_in_one_line(falls):
    states = jax.vmap(lambda _: falls.init())(jnp.arange(2))
    with pytest.raises(ValueError, match=r"^qpos has the shape \(2, 1\), not \(1,\).*jax\.vmap"):
        falls(states, jnp.zeros(0))


def test_a_step_is_one_kernel_also_inside_an_environment(falls):
    def env(state, force):
        after = falls(state, jnp.zeros(0), qfrc_applied=force)
        reward = -jnp.square(after.qpos).sum()
        is_done = after.qpos[0] < -1.0
        first = falls.init()
        return jax.tree.map(lambda a, b: jnp.where(is_done, a, b), first, after), reward, is_done

    states = jax.vmap(falls.init)(jnp.array([[0.0], [-2.0]]))
    forces = jnp.array([[1.0], [2.0]])
    fused = fuse(env)
    assert launches(jax.vmap(fused), states, forces) == 1
    for found, wanted in zip(
        jax.tree.leaves(jax.vmap(fused)(states, forces)),
        jax.tree.leaves(jax.vmap(env)(states, forces)),
        strict=True,
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-6)


@pytest.mark.slow
def test_what_follows_from_a_state_is_computed_in_the_same_kernel():
    model = mujoco.MjModel.from_xml_string(SENSES)
    step = fuse_mjx(model, 2, on_unsupported="raise")

    @fuse(on_unsupported="raise")
    def env(state, ctrl):
        state = step(state, ctrl)
        data = step.forward(state, ctrl)
        return state, data.sensordata, data.site_xpos, data._impl.contact.dist

    states = jax.vmap(lambda angle: step.init(jnp.array([0.19, angle])))(jnp.linspace(-1.0, 1.0, 9))
    ctrl = jnp.full((9, 1), 0.1)
    assert launches(jax.vmap(env), states, ctrl) == 1
    after, *found = jax.jit(jax.vmap(env))(states, ctrl)
    data = mujoco.MjData(model)
    for i in range(9):
        data.qpos[:], data.qvel[:], data.ctrl[:] = after.qpos[i], after.qvel[i], ctrl[i]
        data.qacc_warmstart[:] = after.qacc_warmstart[i]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(found[0][i], data.sensordata, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(found[1][i], data.site_xpos, atol=1e-6)
        # MJX keeps the contacts that are possible, MuJoCo those that are there.
        touching = np.sort(found[2][i][found[2][i] < 0])
        np.testing.assert_allclose(touching, np.sort(data.contact.dist[: data.ncon]), atol=1e-6)


def test_a_model_too_large_for_one_kernel_is_stepped_by_xla_with_one_warning(monkeypatch):
    monkeypatch.setattr(jaxpr, "MAX_PROGRAM_OPERATIONS", 3)
    model = mujoco.MjModel.from_xml_string(FALLS)
    step = fuse_mjx(model, 2)
    said = "XLA compiles mjx.step, which is slower: one kernel cannot do .* more than 3"
    with pytest.warns(UserWarning, match=said):
        after = jax.jit(step)(step.init(), jnp.zeros(0))
    # Another shape is traced anew, and says nothing: a second warning would be an error.
    jax.eval_shape(jax.vmap(step), jax.tree.map(lambda x: x[None], after), jnp.zeros((1, 0)))
    assert re.search("more than 3", step.obstacle)
    assert step.kernel is None
    np.testing.assert_allclose(after.qvel, -9.81 * 2 * model.opt.timestep, rtol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        silent = fuse_mjx(model, on_unsupported="xla")
        jax.eval_shape(silent, silent.init(), jnp.zeros(0))
    strict = fuse_mjx(model, on_unsupported="raise")
    with pytest.raises(UnsupportedError, match="more than 3"):
        strict(strict.init(), jnp.zeros(0))


@pytest.mark.parametrize(
    ("option", "said"),
    [('solver="PGS"', "mjSOL_PGS"), ('integrator="implicit"', "mjINT_IMPLICIT")],
)
def test_what_mjx_cannot_do_is_named(option, said):
    xml = FALLS.replace("<worldbody>", f"<option {option}/><worldbody>", 1)
    with pytest.raises(UnsupportedError, match=f"^MJX cannot step this model: .*{said}") as caught:
        fuse_mjx(mujoco.MjModel.from_xml_string(xml))
    assert "\n" not in str(caught.value)


def test_debug_nans_finds_a_state_that_is_not_finite(falls):
    state = falls.init(qvel=[np.nan])
    falls(state, [])
    with jax.debug_nans(True), pytest.raises(FloatingPointError, match="nan"):
        falls(state, [])


def test_a_step_in_float64_is_that_of_c(falls):
    with jax.enable_x64(True):
        assert compared(model_of(HOPPER), n_substeps=3)[0] < 1e-12
        step = fuse_mjx(falls.mj_model)
        state = step.init()
        with pytest.raises(ValueError, match="made for float32, but"):
            falls.init()
    with pytest.raises(ValueError, match="made for float64, but jax_enable_x64 now asks for f"):
        step(state, jnp.zeros(0))


def test_wrong_arguments_are_named():
    model = mujoco.MjModel.from_xml_string(FALLS)
    with pytest.raises(TypeError, match=r"mj_model is a str, not a mujoco\.MjModel"):
        fuse_mjx("hopper.xml")
    for wrong in (0, 1.5, True, "2"):
        with pytest.raises(ValueError, match=f"n_substeps is {wrong!r}, not a whole number"):
            fuse_mjx(model, wrong)
    with pytest.raises(ValueError, match="'never', not warn, xla or raise"):
        fuse_mjx(model, on_unsupported="never")


def test_the_engine_alone_needs_no_mujoco():
    code = "import sys; sys.modules['mujoco'] = None; import onekernel; onekernel.Kernel"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_state_is_replaced_by_field(falls):
    state = falls.init().replace(time=jnp.float32(1.0))
    assert isinstance(state, MjxState)
    assert state.time == 1.0


ASSETS = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("inverted_pendulum", "inverted_double_pendulum", "reacher", "swimmer", "hopper"),
        *("walker2d", "half_cheetah", "ant"),
    ],
)
def test_a_model_of_gymnasium_moves_as_in_mjx(name):
    model = mujoco.MjModel.from_xml_path(os.path.join(ASSETS, f"{name}.xml"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    assert_moves_as_in_mjx(model, *c_steps(model, 64))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("xml", [CART_POLE, HOPPER, BUTTON], ids=["cart", "hopper", "button"])
def test_a_model_moves_as_in_mjx_with_every_integrator(xml, integrator):
    model = model_of(xml, integrator)
    assert_moves_as_in_mjx(model, *c_steps(model, 64))
