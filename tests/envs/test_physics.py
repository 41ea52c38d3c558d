"""MJX against C MuJoCo and closed-form solutions."""

import copy
import functools
import math
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from helpers import motion
from helpers.small_physics import small_physics
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import kinematics, mjx
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.state import PhysicsState
from onekernel import cpu, gpu

STEPS = 256
FEW, MANY = 64, 256  # robots under each kind of commands
POSITION_TOLERANCE = 0.2  # [mm] of every robot with the preset's friction, over 256 control steps
YAW_TOLERANCE = 0.05  # [°] likewise
SLIPPERY_MEDIAN, SLIPPERY_P95 = 0.005, 0.05  # [mm] at μ = 0.4, where single robots are chaotic
NOISE = 1e-6  # [m/s, rad/s] deviation after every control step: what float32 cannot tell
ASTRAY = 1.0  # [mm] from where on a robot counts as led astray by noise
STEP_TOLERANCE = 1e-6  # [m/s] of 999 in 1,000 single control steps
STEP_OUTLIER = 1e-3  # [m/s] above which at most one in 10,000 may be
CLOSED_FORM_TOLERANCE = 0.015
WORST_TILT = 4.0  # [°]

true_yaw = jax.jit(jax.vmap(jax.vmap(kinematics.yaw)))


@functools.cache
def make_driver(preset):
    """An environment and `(environment, actions (n, t, 2)) -> physics (t, n, ...)`."""
    env = make_env(parse_config({"robot": {"preset": preset}}))

    def drive(here, actions):
        def step(physics, action):
            ctrl = jax.vmap(env.wheel_targets)(action)
            physics = jax.vmap(here.physics.step)(physics, ctrl)
            return physics, physics

        keys = jnp.zeros((len(actions), 2), jnp.uint32)
        first = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
        return jax.lax.scan(step, first, actions.swapaxes(0, 1))[1]

    return env, drive


@pytest.fixture(params=["isaac", "real"])
def driver(request):
    return make_driver(request.param)


def drive_in_c(mj_model, first, ctrl, substeps, noise=0.0):
    """The same targets (t, n, 2) in C MuJoCo: what follows each control step, (t, n, ...)."""
    rng = np.random.default_rng(3)
    steps, robots = ctrl.shape[:2]
    trail = PhysicsState(
        *(np.zeros((steps, robots, size)) for size in (mj_model.nq, mj_model.nv, mj_model.nv)),
        time=np.zeros((steps, robots)),
    )
    for robot in range(robots):
        data = mujoco.MjData(mj_model)
        data.qpos[:] = first.qpos[robot]
        for step in range(steps):
            data.qvel += noise * rng.normal(size=mj_model.nv)
            data.ctrl[:] = ctrl[step, robot]
            mujoco.mj_step(mj_model, data, substeps)
            trail.qpos[step, robot] = data.qpos
            trail.qvel[step, robot] = data.qvel
            trail.qacc_warmstart[step, robot] = data.qacc_warmstart
    return trail


def held(rng, draw, environments, hold):
    """Actions that are held for `hold` steps each."""
    actions = draw(rng, (environments, STEPS // hold, 2))
    return jnp.asarray(np.repeat(actions, hold, axis=1), jnp.float32)


def switched(rng, draw, robots):
    """Actions that each robot holds for 1 to 24 steps, as trained policies do."""
    actions = np.zeros((robots, STEPS, 2))
    for robot in range(robots):
        step = 0
        while step < STEPS:
            hold = rng.integers(1, 25)
            actions[robot, step : step + hold] = draw(rng, 2)
            step += hold
    return jnp.asarray(actions, jnp.float32)


def uniform(rng, shape):
    return rng.uniform(-1, 1, shape)


def bang_bang(rng, shape):
    return rng.choice([-1.0, 1.0], shape)


def converged(mj_model):
    mj_model.opt.iterations, mj_model.opt.ls_iterations, mj_model.opt.tolerance = 100, 50, 1e-12
    return mj_model


def apart(one, other):
    """The largest distance of each of n robots [mm] and turn [°] between paths (t, n, nq)."""
    distance = np.linalg.norm(one[..., :3] - other[..., :3], axis=-1).max(0)
    turned = np.asarray(true_yaw(one[..., 3:7]) - true_yaw(np.float32(other[..., 3:7])))
    turned = np.abs((turned + np.pi) % (2 * np.pi) - np.pi).max(0)
    return 1e3 * distance, np.degrees(turned)


@pytest.fixture
def on_floor(request, driver):
    """An environment on a floor of some friction, and its model in C MuJoCo, converged."""
    env, _ = driver
    robot = env.robot.model_copy(update={"friction": request.param})
    mj_model = make_mj_model(robot, env.config.physics, visual=False)
    here = env.with_model(mjx.put_model(mj_model))
    return request.param, here, converged(copy.copy(mj_model))


@pytest.mark.parametrize(
    ("driver", "on_floor", "robots"),
    [
        ("isaac", 1.0, FEW),
        ("real", 0.4, FEW),
        *(
            pytest.param(preset, friction, MANY, marks=pytest.mark.slow)
            for preset in ("isaac", "real")
            for friction in (1.0, 0.4)
        ),
    ],
    indirect=["driver", "on_floor"],
)
def test_mjx_follows_c_mujoco(driver, on_floor, robots):
    env, drive = driver
    friction, here, reference = on_floor
    rng = np.random.default_rng(0)
    actions = jnp.concatenate([switched(rng, draw, robots) for draw in (uniform, bang_bang)])
    ours = jax.device_get(drive(here, actions))
    first = jax.device_get(jax.jit(jax.vmap(env.reset))(jnp.zeros((2 * robots, 2), jnp.uint32)))
    first = first.pipeline_state
    ctrl = np.asarray(jax.vmap(jax.vmap(env.wheel_targets))(actions)).swapaxes(0, 1)
    substeps = env.config.physics.n_substeps
    theirs = drive_in_c(reference, first, ctrl, substeps)
    distance, turned = apart(ours.qpos, theirs.qpos)
    median, p95 = np.percentile(distance, [50, 95])
    case = f"{env.robot.label}, μ = {friction}"
    print(
        f"\n{case}: MJX is within {distance.max():.3f} mm (median {median:.4f}, p95 {p95:.3f}) and"
        f" {turned.max():.3f}° of converged C MuJoCo over {STEPS} control steps"
    )
    if friction == 1.0:
        assert distance.max() < POSITION_TOLERANCE
        assert turned.max() < YAW_TOLERANCE
    else:
        # Where some robots slide to depends on noise alone: count those that end elsewhere, of ours
        # and of C MuJoCo's own under noise.
        noisy, _ = apart(drive_in_c(reference, first, ctrl, substeps, NOISE).qpos, theirs.qpos)
        astray, allowed = (int((x > ASTRAY).sum()) for x in (distance, noisy))
        print(
            f"{case}: {astray} of {len(distance)} robots beyond {ASTRAY} mm; of C MuJoCo under"
            f" noise of {NOISE} {allowed}, the worst at {noisy.max():.3f} mm"
        )
        assert median < SLIPPERY_MEDIAN
        assert p95 < SLIPPERY_P95
        # Two counts of rare events: their difference deviates by the root of their sum.
        assert astray - allowed <= 3 * math.sqrt(astray + allowed)
    single_steps_agree(case, here, theirs, ctrl)


def single_steps_agree(case, env, theirs, ctrl):
    """Check single control steps, from each state of the converged path to the next one."""
    states = jax.tree.map(lambda x: jnp.float32(x[:-1].reshape(-1, *x.shape[2:])), theirs)
    ahead = jax.jit(jax.vmap(env.physics.step))(states, ctrl[1:].reshape(-1, 2))
    error = np.asarray(ahead.qvel) - theirs.qvel[1:].reshape(ahead.qvel.shape)
    error = np.linalg.norm(error[:, :3], axis=-1)
    outliers = np.flatnonzero(error > STEP_OUTLIER)
    print(
        f"{case}: one control step within {np.quantile(error, 0.999):.1e} m/s (p99.9);"
        f" {len(outliers)} of {len(error):,} above {STEP_OUTLIER}"
    )
    for index in outliers:
        before, robot = divmod(index, ctrl.shape[1])
        print(f"  robot {robot}, control step {before + 1}: {error[index]:.1e} m/s")
    assert np.quantile(error, 0.999) < STEP_TOLERANCE
    assert len(outliers) <= len(error) / 10_000


@pytest.mark.parametrize(
    "driver", [pytest.param("isaac", marks=pytest.mark.slow), "real"], indirect=True
)
def test_straight_driving_and_spinning_match_closed_form(driver):
    env, drive = driver
    limits = {"max_speed": 1.0, "max_yaw_rate": math.pi}
    speed = 1.0 if env.robot.max_wheel_speed is None else 0.4
    twists = jnp.array([[speed, 0.0], [0.0, math.pi], [0.0, -1.0]])
    actions = jax.vmap(lambda twist: kinematics.action_from_twist(twist, **limits))(twists)
    physics = drive(env, jnp.repeat(actions[:, None], STEPS, axis=1))
    velocity = np.asarray(physics.qvel[120:]).mean(axis=0)  # after the motors' run-up
    geometry = {
        "wheel_radius": env.robot.wheel_radius,
        "wheel_separation": env.robot.wheel_separation,
    }
    wheels = jax.vmap(env.wheel_targets)(actions)
    expected = jax.vmap(lambda w: motion.body_twist(w, **geometry))(wheels)
    forward = np.asarray(physics.qpos[-1, 0, 0] - physics.qpos[120, 0, 0]) / (
        (STEPS - 121) * env.dt
    )
    print(
        f"\n{env.robot.label}: straight {forward:.4f} m/s of {speed},"
        f" spin {velocity[1, 5]:.4f} rad/s of {expected[1, 1]:.4f},"
        f" {velocity[2, 5]:.4f} of {expected[2, 1]:.4f}"
    )
    np.testing.assert_allclose(forward, speed, rtol=CLOSED_FORM_TOLERANCE)
    np.testing.assert_allclose(velocity[1, 5], expected[1, 1], rtol=CLOSED_FORM_TOLERANCE)
    np.testing.assert_allclose(velocity[2, 5], expected[2, 1], rtol=CLOSED_FORM_TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "friction"),
    [
        ("isaac", 0.4),
        ("real", 1.0),
        pytest.param("isaac", 1.0, marks=pytest.mark.slow),
        pytest.param("real", 0.4, marks=pytest.mark.slow),
    ],
    indirect=["driver"],
)
def test_nothing_flips_under_held_bang_bang_actions(driver, friction):
    env, drive = driver
    robot = env.robot.model_copy(update={"friction": friction})
    mjx_model = mjx.put_model(make_mj_model(robot, env.config.physics, visual=False))
    rng = np.random.default_rng(1)
    actions = jnp.concatenate([held(rng, bang_bang, 64, hold) for hold in (4, 8, 16, 32)])
    physics = drive(env.with_model(mjx_model), actions)
    assert np.all(np.isfinite(physics.qpos))
    assert np.all(np.isfinite(physics.qvel))
    tilt = np.degrees(jax.jit(jax.vmap(jax.vmap(motion.tilt)))(physics.qpos[:, :, 3:7]).max())
    print(f"\n{env.robot.label}, friction {friction}: worst tilt {tilt:.2f}°")
    assert tilt < WORST_TILT


@pytest.mark.slow
@pytest.mark.skipif(
    (gpu if jax.default_backend() == "gpu" else cpu).obstacle() is not None,
    reason="XLA takes no kernels here",
)
def test_another_solver_is_another_kernel():
    # The number of iterations is not among the arrays of MJX's model, so that a key made of the
    # arrays alone would be the same.
    physics, state = small_physics()
    option = physics.model.opt

    def kernels(**changed):
        here = physics.with_model(physics.model.replace(opt=option.replace(**changed)))
        lowered = jax.jit(here.step).trace(state, jnp.zeros(1)).lower()
        # On a CPU it names machine code by a hash, on a GPU it holds the PTX.
        calls = re.findall(r"custom_call @\S*(?:onekernel_|xla\.gpu\.ptx).*", lowered.as_text())
        (call,) = calls
        return call

    plain = kernels()
    assert kernels() == plain
    changed = {"iterations": 3, "ls_iterations": 3, "tolerance": option.tolerance * 10}
    others = [kernels(**{name: value}) for name, value in changed.items()]
    assert len({plain, *others}) == 1 + len(changed)


def test_physics_keeps_full_precision_in_its_matrix_products():
    # TF32, the GPU's default for float32 products, makes the contact solver diverge.
    env = make_env(parse_config({"physics": {"impl": "xla"}}))
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    step = jax.make_jaxpr(env.physics.step)(state.pipeline_state, jnp.zeros(2))
    products = [e for e in _equations(step.jaxpr) if e.primitive.name == "dot_general"]
    assert products
    highest = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    assert {product.params["precision"] for product in products} == {highest}


def _equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in jax.tree.leaves(value, is_leaf=lambda x: hasattr(x, "eqns")):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _equations(inner)
