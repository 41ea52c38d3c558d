"""Small MuJoCo models of several kinds, and what C MuJoCo and MJX make of one step."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from onekernel.round_off import noisy

CART_POLE = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0" range="-0.5 0.5" limited="true" damping="0.3"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body>
        <joint type="hinge" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.03" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general joint="slider" dyntype="filter" dynprm="0.05" gainprm="20" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
"""Two joints, one of them with limits, and an actuator with an activation."""

HOPPER = """
<mujoco>
  <option timestep="0.004"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom type="plane" size="5 5 0.1" conaffinity="1"/>
    <body pos="0 0 0.5">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="0.1" mass="2"/>
      <body>
        <joint name="hip" type="hinge" axis="0 1 0" range="-60 60" limited="true" damping="0.5"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.5"/>
        <geom type="sphere" pos="0 0 -0.46" size="0.05" mass="0.2" contype="1" friction="0.8"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hip" gear="5" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
"""A leg on the floor: a contact with friction."""

BUTTON = """
<mujoco>
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"/>
    <body name="held" pos="0 0 0.9">
      <freejoint/>
      <geom type="box" size="0.1 0.05 0.02" mass="1"/>
    </body>
  </worldbody>
  <equality><connect body1="hand" body2="held" anchor="0 0 -0.05"/></equality>
</mujoco>
"""
"""A free body that an equality constraint ties to a mocap body; no actuator."""


def chain(links):
    """Return a chain of hinges in a gravity field, with a motor at each."""
    bodies = "".join(
        f'<body pos="0 0 {-0.2 if i else 0}"><joint name="j{i}" axis="{i % 2} {1 - i % 2} 0"'
        ' damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.1"/>'
        for i in range(links)
    )
    motors = "".join(f'<motor joint="j{i}" gear="0.2"/>' for i in range(links))
    return (
        '<mujoco><option timestep="0.005"/><default><geom contype="0" conaffinity="0"/></default>'
        f"<worldbody>{bodies}{'</body>' * links}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def model_of(xml, integrator="Euler"):
    """Return the model of an MJCF with another integrator."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    return model


STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time")


def c_steps(model, count, n_substeps=1, most=100, seed=0):
    """Return states in float32, controls, and what C MuJoCo makes of them.

    Args:
      model: the model.
      count: number of instances. Each has moved for a time of its own under random controls.
      n_substeps: number of physics steps from the state to the result.
      most: the largest number of physics steps before the state.
      seed: of the random numbers.

    Returns:
      Dictionaries of the fields of the states and of the results, with a leading axis of instances,
      and the controls.
    """
    rng = np.random.default_rng(seed)
    before, after, controls = [], [], []
    for _ in range(count):
        data = mujoco.MjData(model)
        data.qvel[:] = rng.normal(0.0, 0.5, model.nv)
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        for _ in range(rng.integers(0, most)):
            mujoco.mj_step(model, data)
        # C MuJoCo starts from the same numbers, which are those of float32.
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu).astype(np.float32)
        before.append({x: np.float32(getattr(data, x)) for x in STATE})
        for name, value in before[-1].items():
            if name == "time":
                data.time = value
            else:
                getattr(data, name)[:] = value
        controls.append(data.ctrl.astype(np.float32))
        for _ in range(n_substeps):
            mujoco.mj_step(model, data)
        after.append({x: np.array(getattr(data, x)) for x in STATE})
    stacked = [{x: np.stack([one[x] for one in many]) for x in STATE} for many in (before, after)]
    return *stacked, np.stack(controls)


def batch_of(step, states):
    """Return the states of several instances, from their fields."""
    made = jax.vmap(step.init)(states["qpos"], states["qvel"])
    return made.replace(**{name: jnp.asarray(x) for name, x in states.items()})


def by_mjx(step, states, ctrl, *, batched=True, noise=None):
    """Return what one physics step of `mjx.step` makes of states, compiled by XLA.

    Args:
      step: the fused step of the model.
      states: the states of several instances.
      ctrl: their controls.
      batched: whether all instances are stepped at once, or one after the other.
      noise: a seed for each instance, for noise in every operation; None: there is none.

    Returns:
      The next states' fields, and the sensors of the states given under "sensordata", which MJX
      does not keep through a step by Runge and Kutta.
    """

    def one(state, ctrl):
        with jax.default_matmul_precision("highest"):
            after = step.from_data(mjx.step(step.model, step.to_data(state, ctrl)))
        if not step.mj_model.nsensordata:
            return vars(after)
        return vars(after) | {"sensordata": step.forward(state, ctrl).sensordata}

    # On a CPU: on a GPU, XLA's sums differ by 3e-6 from those that it and the kernel find here.
    # Compile in a third of the time: the test makes one step only.
    options = {"xla_backend_optimization_level": 0}
    states, ctrl = jax.device_put((states, ctrl), jax.devices("cpu")[0])
    if noise is not None:
        leaves, structure = jax.tree.flatten((states, ctrl))
        many = jax.vmap(noisy(lambda *x: jax.tree.leaves(one(*structure.unflatten(x)))))
        after = jax.jit(many, compiler_options=options)(noise, *leaves)
        made = jax.eval_shape(jax.vmap(one), states, ctrl)
        return jax.tree.unflatten(jax.tree.structure(made), map(np.asarray, after))
    many = jax.vmap(one) if batched else lambda *x: jax.lax.map(lambda each: one(*each), x)
    after = jax.jit(many, compiler_options=options)(states, ctrl)
    return jax.tree.map(np.asarray, after)


def difference(found, wanted):
    """Return the largest difference of positions or velocities, relative to the largest number."""
    return max(
        np.abs(np.float64(getattr(found, x)) - wanted[x]).max() / np.abs(wanted[x]).max()
        for x in ("qpos", "qvel")
    )
