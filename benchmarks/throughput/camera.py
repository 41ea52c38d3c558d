"""Measure images per second of the robot's camera, beside other renderers on the same machine.

    python benchmarks/throughput/camera.py [--num-envs 65536] [--sizes 32 64] [--output camera.json]

Two scenes: the task's own, and eight primitives on a checker floor. Each renderer draws the same
scenes from the same poses, robots at random places: this package's kernel with one and with four
rays a pixel, MJX-Warp's `render` with one ray a pixel, without shadows, if `warp` is installed and
there is a GPU, and `mujoco.Renderer`, one image after the other, if MUJOCO_GL is egl or osmesa.
Compile times are not part of the rates; a rate is the median of the repeats.
"""

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.timing import available_cores
from jetbot_mjx.config import CameraConfig, Config
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.jetbot_env import make_jetbot_env
from jetbot_mjx.runs.run_dir import versions, write_json

REPEATS = 9
_RENDERED = 200
"""Images of `mujoco.Renderer` in a repeat."""

_EIGHT = """
<mujoco>
  <asset>
    <texture name="checker" type="2d" builtin="checker" rgb1=".86 .87 .88" rgb2=".7 .73 .76"
             width="256" height="256"/>
    <material name="floor" texture="checker" texrepeat="2 2" texuniform="true"/>
  </asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light type="directional" dir="-.12 .15 -1" diffuse=".6 .6 .6"/>
    <geom type="plane" size="0 0 .1" material="floor"/>
    <geom type="box" size=".05 .05 .05" pos=".6 .3 .05" rgba="1 0 0 1"/>
    <geom type="box" size=".05 .05 .05" pos="-.6 .3 .05" euler="0 0 30" rgba="0 1 0 1"/>
    <geom type="box" size=".05 .05 .05" pos="-1 0 .05" euler="0 0 60" rgba="1 .5 0 1"/>
    <geom type="sphere" size=".06" pos=".6 -.3 .06" rgba="0 0 1 1"/>
    <geom type="ellipsoid" size=".06 .04 .05" pos="-.6 -.3 .05" rgba="1 1 0 1"/>
    <geom type="cylinder" size=".05 .05" pos="1 0 .05" rgba="1 0 1 1"/>
    <geom type="cylinder" size=".05 .05" pos="0 -1 .05" euler="0 90 0" rgba="0 .5 1 1"/>
    <geom type="capsule" size=".03 .05" pos="0 1 .08" rgba="0 1 1 1"/>
    <body name="jetbot">
      <freejoint/>
      <geom type="sphere" size=".01" mass="1" group="4"/>
      <camera name="onboard"/>
    </body>
  </worldbody>
</mujoco>
"""


class Row(NamedTuple):
    """A `Row` holds the rate of one renderer."""

    scene: str
    renderer: str
    size: int
    """Height and width of the images [pixels]."""
    rays: int
    """Rays per pixel; 0: not known."""
    num_envs: int
    frames_per_second: float
    compile_seconds: float


class Poses(NamedTuple):
    """A `Poses` holds where the robots and their goals are."""

    position: jax.Array
    """Axle midpoints [m], shape (n, 3)."""
    quat: jax.Array
    """Attitudes, shape (n, 4)."""
    goal: jax.Array
    """Goals [m], shape (n, 3)."""


def draw_poses(count: int) -> Poses:
    """Return robots at random places with random headings, and goals around them."""
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    yaw = jax.random.uniform(keys[0], (count,), minval=-np.pi, maxval=np.pi)
    zero = jnp.zeros(count)
    place = jax.random.uniform(keys[1], (count, 2), minval=-0.5, maxval=0.5)
    goal = jax.random.uniform(keys[2], (count, 2), minval=-1.0, maxval=1.0)
    return Poses(
        jnp.concatenate([place, jnp.full((count, 1), 0.0325)], axis=1),
        jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)], axis=1),
        jnp.concatenate([goal, jnp.full((count, 1), 0.05)], axis=1),
    )


def scenes() -> dict[str, mujoco.MjModel]:
    """Return the models of the scenes, by name."""
    return {
        "task": make_jetbot_env(Config()).mj_model,
        "eight": mujoco.MjModel.from_xml_string(_EIGHT),
    }


def _rate(run: Callable[[], Any], count: int) -> tuple[float, float]:
    """Return images per second, and the time of the first call [s]."""
    start = time.perf_counter()
    run()
    first = time.perf_counter() - start
    run()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return count / statistics.median(times), first


def ours(model: mujoco.MjModel, size: int, samples: int, poses: Poses) -> tuple[float, float]:
    """Measure this package's renderer.

    Args:
      model: the scene.
      size: height and width [pixels].
      samples: rays per side of a pixel.
      poses: the robots and goals.

    Returns:
      Images per second, and the time to compile [s].
    """
    camera = Camera(CameraConfig(width=size, height=size, samples=samples), model)

    def render(pose: Poses) -> jax.Array:
        return camera.render(camera.pose(pose.position, pose.quat), {"goal": pose.goal})

    program = jax.jit(jax.vmap(render))
    return _rate(lambda: program(poses).block_until_ready(), len(poses.quat))


def mjx_warp(model: mujoco.MjModel, size: int, poses: Poses) -> tuple[float, float]:
    """Measure MJX-Warp's renderer on a GPU, as one recorded graph of its launches.

    Args:
      model: the scene.
      size: height and width [pixels].
      poses: the robots and goals.

    Returns:
      Images per second, and the time to compile [s].

    Raises:
      ImportError: there is no `warp`.
    """
    import mujoco.mjx.third_party.mujoco_warp as mjwarp
    import warp as wp  # pyright: ignore[reportMissingImports]

    count = len(poses.quat)
    _mount(model)
    start = mujoco.MjData(model)
    mujoco.mj_forward(model, start)
    on_gpu, data = mjwarp.put_model(model), mjwarp.put_data(model, start, nworld=count)
    qpos = np.tile(np.asarray(model.qpos0, np.float32), (count, 1))
    qpos[:, :3], qpos[:, 3:7] = np.asarray(poses.position), np.asarray(poses.quat)
    wp.copy(data.qpos, wp.from_numpy(qpos, dtype=float))
    if model.nmocap:
        goals = np.asarray(poses.goal, np.float32)[:, None]
        wp.copy(data.mocap_pos, wp.from_numpy(goals, dtype=wp.vec3))
    active = [model.camera(i).name == "onboard" for i in range(model.ncam)]
    context = mjwarp.create_render_context(
        model,
        nworld=count,
        cam_res=(size, size),
        render_rgb=True,
        render_depth=False,
        render_seg=False,
        use_shadows=False,
        cam_active=active,
        enabled_geom_groups=[0, 1, 2],
    )
    mjwarp.kinematics(on_gpu, data)
    mjwarp.camlight(on_gpu, data)

    def launch() -> None:
        mjwarp.refit_bvh(on_gpu, data, context)
        mjwarp.render(on_gpu, data, context)

    begin = time.perf_counter()
    launch()
    wp.synchronize()
    first = time.perf_counter() - begin
    with wp.ScopedCapture() as capture:
        launch()

    def run() -> None:
        wp.capture_launch(capture.graph)
        wp.synchronize()

    return _rate(run, count)[0], first


def mujoco_renderer(model: mujoco.MjModel, size: int, poses: Poses) -> tuple[float, float]:
    """Measure `mujoco.Renderer`, one image after the other, without shadows.

    Args:
      model: the scene.
      size: height and width [pixels].
      poses: the robots and goals, of which the first are drawn.

    Returns:
      Images per second, and the time of the first image [s].
    """
    _mount(model)
    data = mujoco.MjData(model)
    position, quat, goal = (np.asarray(x[:_RENDERED]) for x in poses)

    def draw(renderer: mujoco.Renderer, count: int) -> None:
        for i in range(count):
            data.qpos[:3], data.qpos[3:7] = position[i], quat[i]
            if model.nmocap:
                data.mocap_pos[0] = goal[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera="onboard")
            renderer.render()

    with mujoco.Renderer(model, height=size, width=size) as renderer:
        count = min(_RENDERED, len(quat))
        return _rate(lambda: draw(renderer, count), count)


def _mount(model: mujoco.MjModel) -> None:
    """Put the model's camera where this package's is, and leave out shadows and the robot."""
    config = CameraConfig()
    camera, robot = model.camera("onboard").id, model.body("jetbot").id
    pitch = np.radians(config.pitch)
    right, up = np.array([0.0, -1, 0]), np.array([np.sin(pitch), 0, np.cos(pitch)])
    axes = np.stack([right, up, np.cross(right, up)], axis=1)
    mujoco.mju_mat2Quat(model.cam_quat[camera], axes.ravel())
    model.cam_pos[camera], model.cam_fovy[camera] = config.position, config.fovy
    model.light_castshadow[:] = False
    for geom in range(model.ngeom):
        if model.body_rootid[model.geom_bodyid[geom]] == robot:
            model.geom_group[geom] = 4


def run(num_envs: int, sizes: Sequence[int]) -> Iterator[Row]:
    """Measure all renderers that this machine has.

    Args:
      num_envs: number of images at once.
      sizes: heights and widths [pixels].

    Yields:
      One row for each scene, renderer and size.
    """
    poses = draw_poses(num_envs)
    for name, model in scenes().items():
        for size in sizes:
            for samples in (1, 2):
                rates = ours(model, size, samples, poses)
                yield Row(name, "jetbot_mjx", size, samples**2, num_envs, *rates)
            if jax.default_backend() == "gpu":
                try:
                    yield Row(name, "MJX-Warp", size, 1, num_envs, *mjx_warp(model, size, poses))
                except ImportError as error:
                    print(f"MJX-Warp: {error}", file=sys.stderr)
            if os.environ.get("MUJOCO_GL") in ("egl", "osmesa"):
                yield Row(name, "mujoco.Renderer", size, 0, 1, *mujoco_renderer(model, size, poses))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, measure, print a table and write a file.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    default = 65_536 if jax.default_backend() == "gpu" else 1024
    parser.add_argument("--num-envs", type=int, default=default, help="images at once")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64], help="[pixels]")
    parser.add_argument("--output", type=Path, help="a JSON file for the results")
    options = parser.parse_args(arguments)
    device = jax.devices()[0].device_kind
    print(f"{device}, {available_cores()} cores")
    print(f"{'scene':8}{'renderer':18}{'size':>6}{'rays':>6}{'frames/s':>14}{'compile [s]':>13}")
    rows = []
    for row in run(options.num_envs, options.sizes):
        rows.append(row._asdict())
        print(
            f"{row.scene:8}{row.renderer:18}{row.size:6}{row.rays or '':>6}"
            f"{row.frames_per_second:14,.0f}{row.compile_seconds:13.2f}",
            flush=True,
        )
    if options.output:
        about = {"device": device, "cpu_cores": available_cores(), "versions": versions()}
        write_json(options.output, {**about, "rows": rows})
        print(json.dumps({"wrote": str(options.output)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
