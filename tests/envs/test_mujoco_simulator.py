"""C MuJoCo in the place of MJX: the same robot and rules, and deterministic results."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jetbot_mjx.config import RandomizationConfig, RobotParams, load_config, parse_config
from jetbot_mjx.envs import mujoco_simulator
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper
from jetbot_mjx.envs.mujoco_simulator import in_mujoco, make_model, training_numerics
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.wrappers import EpisodeWrapper
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys, summarize
from jetbot_mjx.evaluation.rollout import rollout_fn
from jetbot_mjx.runs.checkpoint import PRETRAINED, load_checkpoint
from onekernel.aot.program_cache import ProgramCache

ROBOTS = 16
STEPS = 128
POSITION_TOLERANCE = 2e-4  # [m] of MJX in float32 from C MuJoCo
ROUNDING = 1e-5  # [m] what float32 makes of a state, once per environment step


def held(draw, hold=16):
    """Actions that are held for `hold` steps each, on the host."""
    actions = draw(np.random.default_rng(0), (ROBOTS, STEPS // hold, 2))
    return np.repeat(actions, hold, axis=1).astype(np.float32)


def uniform(rng, shape):
    return rng.uniform(-1, 1, shape)


def bang_bang(rng, shape):
    return rng.choice([-1.0, 1.0], shape)


def trajectories(env, actions):
    """Drive from the first state on: `qpos` (n, t, nq)."""

    def drive(actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state.pipeline_state.qpos

        return jax.lax.scan(step, env.reset(jax.random.PRNGKey(0)), actions)[1]

    return np.asarray(jax.jit(jax.vmap(drive))(actions))


def in_plain_c(env, robot, actions):
    """One robot by MuJoCo's own loop, never rounded: `qpos` (t, nq)."""
    model = make_mj_model(robot, env.config.physics)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data = mujoco.MjData(model)
    data.qpos[:] = env.mj_model.qpos0
    trail = []
    for target in np.asarray(jax.vmap(env.wheel_targets)(actions)):
        data.ctrl[:] = target
        mujoco.mj_step(model, data, env.config.physics.n_substeps)
        trail.append(data.qpos.copy())
    return np.stack(trail)


def apart(a, b):
    """Largest distance of the robots of two runs [m]."""
    return np.linalg.norm(a[..., :3] - b[..., :3], axis=-1).max()


@pytest.mark.parametrize(
    "preset_env", [pytest.param("isaac", marks=pytest.mark.slow), "real"], indirect=True
)
def test_with_the_numerics_of_training_it_drives_as_the_environment_does(preset_env):
    simulator = in_mujoco(preset_env, training_numerics(preset_env.config.physics))
    actions = held(uniform)
    distance = apart(trajectories(simulator, actions), trajectories(preset_env, actions))
    print(f"\n{preset_env.robot.label}: within {distance * 1e3:.3f} mm of MJX")
    assert distance < POSITION_TOLERANCE


def test_many_robots_in_batches_are_the_robot_of_mujocos_own_loop(preset_env):
    simulator = in_mujoco(preset_env, training_numerics(preset_env.config.physics))
    actions = held(bang_bang)
    driven = trajectories(simulator, actions)
    for index in range(ROBOTS):
        expected = in_plain_c(preset_env, preset_env.robot, actions[index])
        assert apart(driven[index], expected) < ROUNDING


@pytest.mark.parametrize(
    ("preset_env", "mass", "shift"),
    [
        ("isaac", 0.8, (0.01, 0.005, 0.0)),
        ("real", 1.3, (0.0, 0.0, 0.02)),
        pytest.param("isaac", 1.3, (0.0, 0.0, 0.02), marks=pytest.mark.slow),
        pytest.param("real", 0.8, (0.01, 0.005, 0.0), marks=pytest.mark.slow),
    ],
    indirect=["preset_env"],
)
def test_a_varied_robot_is_the_one_that_mujoco_compiles(preset_env, mass, shift):
    moments = preset_env.robot.moments_of_chassis
    changed = {
        "chassis_com": tuple(np.add(preset_env.robot.chassis_com, shift)),
        "chassis_mass": mass * preset_env.robot.chassis_mass,
        "chassis_inertia": tuple(mass * moment for moment in moments),
        "friction": 0.7,
        "max_wheel_speed": None,
    }
    robot = preset_env.robot.model_copy(update=changed)
    simulator = in_mujoco(preset_env, training_numerics(preset_env.config.physics))
    varied = DomainRandomizationWrapper(simulator, RobotParams(0.7, mass, *shift))
    actions = held(uniform)
    actions[..., 0] = -0.6  # [0.2 m/s], so that no motor is at its limit
    driven = trajectories(varied, actions)
    for index in range(0, ROBOTS, 4):
        assert apart(driven[index], in_plain_c(preset_env, robot, actions[index])) < ROUNDING
    assert apart(driven, trajectories(simulator, actions)) > 100 * ROUNDING


def test_derived_model_values_follow_the_masses(preset_env):
    robot = preset_env.robot
    changed = {
        "chassis_mass": 1.3 * robot.chassis_mass,
        "chassis_inertia": robot.moments_of_chassis,
    }
    heavy = robot.model_copy(update=changed)
    compiled = make_mj_model(heavy, preset_env.config.physics, visual=False)
    preset = make_model(preset_env, training_numerics(preset_env.config.physics))
    mass = compiled.body_mass[None].astype(np.float32)
    (made,) = mujoco_simulator._ModelCache(preset).models({"body_mass": mass})
    for name in ("body_subtreemass", "body_invweight0", "dof_invweight0"):
        before, after = getattr(preset, name), getattr(made, name)
        np.testing.assert_allclose(after, getattr(compiled, name), rtol=1e-3)
        assert not np.allclose(after, before, rtol=5e-2)


def test_every_episode_has_its_own_robot(world_env):
    ranges = RandomizationConfig(friction=(0.3, 1.2), mass=(0.8, 1.25), motor_gain=(0.5, 1.0))
    simulator = in_mujoco(world_env)
    together = episodes(
        DomainRandomizationWrapper(simulator, ranges=ranges), report_keys(8), steps=20
    )
    assert len({tuple(end) for end in together.end_w.tolist()}) == 8
    # Each is the robot that its key draws, whoever drives beside it.
    alone = episodes(
        DomainRandomizationWrapper(simulator, ranges=ranges), report_keys(8)[3:5], steps=20
    )
    np.testing.assert_array_equal(alone.end_w, together.end_w[3:5])


def episodes(env, keys, steps, action=(0.2, 0.1)):
    """Whole episodes under one action, on the host."""
    rollout = rollout_fn(env, [lambda params, state, key: jnp.asarray(action)], steps)
    return jax.device_get(jax.jit(rollout)(0, None, keys))


def test_no_result_depends_on_how_many_threads_there_are(world_env):
    found = [
        episodes(in_mujoco(world_env, threads=threads), report_keys(30), steps=40)
        for threads in (1, 3)
    ]
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_the_numerics_are_those_asked_for(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "examples"))
    env = make_env(load_config(root / "examples" / "pillars.yaml"))
    model = make_model(env, mujoco_simulator.OTHER_NUMERICS)
    option = model.opt
    assert (option.iterations, option.ls_iterations, option.tolerance) == (100, 50, 1e-12)
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert option.timestep == pytest.approx(1 / 480)
    # Of wheels, casters and the task's own pillars alike.
    assert model.npair == 7
    np.testing.assert_array_equal(model.pair_solref, np.tile((0.02, 1.0), (7, 1)))
    own = make_model(env, training_numerics(env.config.physics))
    np.testing.assert_array_equal(own.pair_solref[:4], np.tile((0.04, 1.0), (4, 1)))
    assert own.opt.timestep == pytest.approx(1 / 120)
    assert own.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    # Every drawn robot is a copy of it.
    assert mujoco.mj_sizeModel(model) < 50_000


def test_a_scene_may_use_materials_wherever_it_likes(world_env, monkeypatch):
    def build_scene(spec):
        tendon = spec.add_tendon(name="a tendon that shows", material="goal")
        tendon.wrap_joint("left_wheel_joint", 1.0)

    monkeypatch.setattr(world_env.task, "build_scene", build_scene)
    assert make_model(world_env, mujoco_simulator.OTHER_NUMERICS).npair == 4


def test_solid_bodies_stand_where_the_episode_has_them(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "examples"))
    import pillars_task

    env = in_mujoco(make_env(load_config(root / "examples" / "pillars.yaml")))
    first = env.reset(jax.random.PRNGKey(0))

    def drive(y):
        far = jnp.array([[5.0, 0.0, 0.125], [5.0, 1.0, 0.125]])
        pillars_w = jnp.concatenate([jnp.stack([0.5, y, 0.125])[None], far])
        goal = first.goal._replace(goal_w=jnp.array([9.0, 0.0, 0.05]), pillars_w=pillars_w)

        def step(state, _):
            return env.step(state, jnp.array([1.0, 0.0])), None

        return jax.lax.scan(step, first.replace(goal=goal), length=90)[0].pipeline_state.qpos

    ahead, beside = jax.jit(jax.vmap(drive))(jnp.array([0.0, 0.4]))
    front = ahead[0] + pillars_task.BUMPER_POS[0] + pillars_task.BUMPER_RADIUS
    assert front == pytest.approx(0.5 - pillars_task.PILLAR_RADIUS, abs=0.003)
    assert beside[0] > 1.0


def test_a_task_with_a_memory_advances_and_ends(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "examples"))
    env = EpisodeWrapper(in_mujoco(make_env(load_config(root / "examples" / "gates.yaml"))), 75)
    start = env.reset(jax.random.PRNGKey(0))
    gates_w = jnp.array([[0.3, 0.0, 0.1], [0.6, 0.0, 0.1], [0.9, 0.0, 0.1]])
    goal = start.goal._replace(gates_w=gates_w, headings=jnp.zeros(3))

    def step(state, _):
        state = env.step(state, jnp.array([1.0, 0.0]))
        return state, (state.pipeline_state.qpos[0], state.goal.passed, state.info["terminated"])

    _, (x, passed, terminated) = jax.lax.scan(step, start.replace(goal=goal), length=74)
    np.testing.assert_array_equal(passed, np.searchsorted([0.3, 0.6, 0.9], x))
    np.testing.assert_array_equal(terminated, passed == 3)
    assert passed[-1] == 3


def test_an_episode_is_cut_off_where_its_time_is_out(world_env):
    found = episodes(in_mujoco(world_env), report_keys(4), steps=5)
    np.testing.assert_array_equal(found.steps, 5)
    np.testing.assert_array_equal(found.terminated + found.nonfinite, 0)


def test_a_non_finite_robot_is_counted_and_changes_no_other(
    world_env, tmp_path, monkeypatch, capfd
):
    # MuJoCo would write a log into the working folder.
    monkeypatch.chdir(tmp_path)
    env = in_mujoco(world_env)

    def broken(params, state, key):
        return jnp.where(state.goal[1] > 0, jnp.nan, jnp.array([0.2, 0.1]))

    keys = report_keys(16)
    found = jax.device_get(jax.jit(rollout_fn(env, [broken], 20))(0, None, keys))
    healthy = episodes(env, keys, steps=20)
    hurt = healthy.goal_w[:, 1] > 0
    assert 0 < hurt.sum() < 16
    np.testing.assert_array_equal(found.nonfinite > 0, hurt)
    np.testing.assert_array_equal(found.end_w[~hurt], healthy.end_w[~hurt])
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""


def test_a_model_that_cannot_be_handed_over_is_refused(world_env):
    option = world_env.mjx_model.opt
    other = world_env.mjx_model.replace(opt=option.replace(gravity=jnp.zeros(3)))
    with pytest.raises(UserError, match=r"the model's opt\.gravity differs from robot to robot"):
        in_mujoco(world_env).with_model(other)


def test_without_a_cpu_for_jax_it_says_what_to_set(world_env, monkeypatch):
    def local_devices(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "local_devices", local_devices)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(UserError, match=r"JAX_PLATFORMS = 'cuda' leaves out the CPU"):
        in_mujoco(world_env)


@pytest.mark.slow
@pytest.mark.parametrize(
    "run", [pytest.param("jetbot_egocentric", marks=pytest.mark.slow), "real_jetbot"]
)
def test_the_shipped_policies_drive_there_too(run):
    checkpoint = load_checkpoint(PRETRAINED / run)
    env = in_mujoco(checkpoint.make_env())
    driven = Evaluator(env, checkpoint.networks, ProgramCache({})).run(
        checkpoint.params, report_keys(64)
    )
    assert summarize(driven, env.dt).success_rate == 1.0


def test_a_run_of_another_time_step_keeps_its_control_step():
    config = parse_config({"physics": {"ctrl_dt": 0.02, "sim_dt": 0.005}})
    numerics = training_numerics(config.physics)
    assert numerics.substeps == 4
    assert make_model(make_env(config), numerics).opt.timestep == pytest.approx(0.005)
