"""MJX's line search in float32: steps that it cannot resolve, and costs relative to the start."""

import functools
import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import forward, solver

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import line_search, mjx
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.state import PhysicsState

STEP_TOLERANCE = 1e-5  # [m/s, rad/s] of all velocities after one physics step

library = solver._linesearch, solver._LSPoint.create


def numbers(text):
    return np.array(text.split(), np.float32)


STATES = {
    # The cost is 155, of which float32 resolves 1.5e-5, and 7.5e-6 can be gained.
    "small gain": (
        1.0,
        PhysicsState(
            numbers(
                "-0.12049419 0.4182252 0.03180438 -0.07542123 -0.0013339615 -0.0006613176"
                " -0.9971507 17.43903 50.216667"
            ),
            numbers(
                "-0.22473143 0.07640367 -3.2717453e-05 0.019068394 0.012437695 7.986152"
                " -6.5226164 21.65653"
            ),
            numbers(
                "-1.4503479 -1.7120957 0.012648497 -0.28612176 -0.78784865 8.302076"
                " 13.28728 50.089954"
            ),
            time=np.float32(0.0),
        ),
        numbers("36.206604 25.33186"),
    ),
    # The first length that is tried is so long that halving it four times gains nothing.
    "slippery floor": (
        0.1,
        PhysicsState(
            numbers(
                "-0.0031105606 -0.027342422 0.031853788 0.72668624 -0.0017019557 0.00012700578"
                " -0.68696743 5.5072317 5.4191422"
            ),
            numbers(
                "0.010003679 -0.14615086 0.024883145 -0.13862655 -0.31318364 -1.3064846"
                " 8.256449 10.706236"
            ),
            numbers(
                "-0.005277446 -0.72801167 0.45433357 -3.864987 -5.716604 -0.21871409"
                " 163.43022 162.46497"
            ),
            time=np.float32(0.0),
        ),
        numbers("5.437372 -5.437372"),
    ),
}


@functools.cache
def physics_step(impl):
    """An environment, and its physics step with another model; XLA compiles one for all models."""
    env = make_env(parse_config({"physics": {"ctrl_dt": 1 / 120, "impl": impl}}))

    def step(model, *given):
        return env.with_model(model).physics.step(*given)

    if impl == "xla":
        return env, jax.jit(step)
    return env, lambda model, *given: jax.jit(functools.partial(step, model))(*given)


@pytest.mark.parametrize(
    ("name", "impl"),
    [
        ("small gain", "auto"),
        pytest.param("small gain", "xla", marks=pytest.mark.slow),
        ("slippery floor", "xla"),
        pytest.param("slippery floor", "auto", marks=pytest.mark.slow),
    ],
)
def test_a_physics_step_ends_where_c_mujoco_converges(name, impl):
    friction, state, ctrl = STATES[name]
    env, step = physics_step(impl)
    robot = env.robot.model_copy(update={"friction": friction})
    model = make_mj_model(robot, env.config.physics, visual=False)
    after = step(mjx.put_model(model), state, ctrl)

    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = state.qpos, state.qvel, ctrl
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(after.qvel, data.qvel, rtol=0, atol=STEP_TOLERANCE)


@functools.cache
def problem(xml=None, cone=mujoco.mjtCone.mjCONE_PYRAMIDAL):
    """A model, its data and the beginning of a line search."""
    if xml is None:
        env = make_env(parse_config({}))
        mj_model = make_mj_model(env.robot, env.config.physics, visual=False)
        qpos = STATES["small gain"][1].qpos
    else:
        mj_model = mujoco.MjModel.from_xml_string(xml)
        qpos = np.float32(mj_model.qpos0)
    mj_model.opt.cone = cone
    model = mjx.put_model(mj_model)
    data = mjx.make_data(mj_model).replace(qpos=qpos, qvel=jnp.full(mj_model.nv, 0.3))
    qacc = np.random.default_rng(0).normal(size=mj_model.nv)

    @jax.jit
    def prepare(data):
        for stage in ("position", "velocity", "actuation", "acceleration"):
            data = getattr(forward, f"fwd_{stage}")(model, data)
        data = data.replace(qacc=jnp.asarray(qacc, jnp.float32))
        return data, solver.Context.create(model, data)

    return model, *prepare(data)


def search(find, *problem):
    """The state of the solver after a line search."""
    model, data, context = problem
    return jax.jit(lambda data, context: find(model, data, context))(data, context)


SPHERE = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/>
  <body pos="0 0 0.09"><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>
"""

PENDULUM = """
<mujoco><option jacobian="dense"/><worldbody>
  <body name="one">
    <joint axis="0 1 0" limited="true" range="-9 -1"/><geom size="0.1" pos="1 0 0"/>
  </body>
  <body name="two"><joint axis="0 1 0" {}/><geom size="0.1" pos="1 0 0" contype="0"/></body>
</worldbody><equality><weld body1="one" body2="two"/></equality></mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("xml", [None, PENDULUM.format("")], ids=["robot", "weld and limit"])
def test_relative_costs_are_differences_of_mjx_costs(xml):
    model, data, context = problem(xml)
    change = data._impl.efc_J @ context.search
    weights = data._impl.efc_D
    rows = [context.Jaref**2 / 2, change * context.Jaref, change**2 / 2]
    quad = (jnp.stack(rows) * weights).T
    quad_gauss = jnp.array([context.gauss, -0.5, 0.25])

    @jax.jit
    @jax.vmap
    def costs(alpha):
        args = model, data, context, alpha, change, quad, quad_gauss, 0.0, 0.0, 0.0, 0.0
        creates = line_search._relative_point, library[1]
        return jnp.stack([create(*args).cost for create in creates])

    # The last row, of a contact or a limit, becomes active or inactive half-way. There rounding
    # decides which, and the cost must be the same either way.
    furthest = -2 * context.Jaref[-1] / change[-1]
    ours, theirs = np.asarray(costs(jnp.linspace(0, furthest, 21)), np.float64).T
    assert ours[0] == 0
    rounding = 2e-6 * np.abs(theirs).max()
    np.testing.assert_allclose(ours, theirs - theirs[0], rtol=1e-5, atol=rounding)


@pytest.mark.slow
def test_a_search_ends_where_mjxs_does_when_the_gain_is_large():
    model, data, context = problem()
    theirs = search(library[0], model, data, context)
    with line_search.relative_costs():
        ours = search(solver._linesearch, model, data, context)
    assert not np.array_equal(ours.qacc, context.qacc)
    np.testing.assert_allclose(ours.qacc, theirs.qacc, rtol=1e-4)
    assert ours.gauss == context.gauss
    assert ours.cost == context.cost


@pytest.mark.slow
@pytest.mark.parametrize(
    ("xml", "cone"),
    [
        (SPHERE, mujoco.mjtCone.mjCONE_ELLIPTIC),
        (PENDULUM.format('frictionloss="0.1"'), mujoco.mjtCone.mjCONE_PYRAMIDAL),
    ],
    ids=["elliptic cone", "dry friction"],
)
def test_costs_that_are_not_quadratic_are_mjxs_part(xml, cone):
    beginning = problem(xml, cone)
    theirs = search(library[0], *beginning)
    with line_search.relative_costs():
        ours = search(solver._linesearch, *beginning)
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def test_outside_it_all_is_as_before():
    with line_search.relative_costs():
        assert solver._linesearch is line_search._line_search
        with line_search.relative_costs():
            pass
        assert solver._linesearch is line_search._line_search
    assert (solver._linesearch, solver._LSPoint.create) == library


def test_threads_take_turns():
    entered, leave, seen = threading.Event(), threading.Event(), []

    def other():
        with line_search.relative_costs():
            seen.append(leave.is_set())

    thread = threading.Thread(target=other)
    with line_search.relative_costs():
        thread.start()
        entered.wait(0.1)
        leave.set()
    thread.join()
    assert seen == [True]
    assert solver._linesearch is library[0]


@pytest.mark.slow
def test_another_thread_has_mjx_s_own_line_search_meanwhile():
    mj_model = mujoco.MjModel.from_xml_string(SPHERE)
    model, first = mjx.put_model(mj_model), mjx.make_data(mj_model)

    def program():
        def step(qpos, qvel):
            return forward.step(model, first.replace(qpos=qpos, qvel=qvel)).qvel

        return str(jax.make_jaxpr(step)(first.qpos, first.qvel))

    alone, texts = program(), []
    with line_search.relative_costs():
        thread = threading.Thread(target=lambda: texts.append(program()))
        thread.start()
        thread.join()
        assert program() != alone
    assert texts == [alone]
    assert (solver._linesearch, solver._LSPoint.create) == library
    assert program() == alone
