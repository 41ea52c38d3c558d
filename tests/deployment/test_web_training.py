"""A page's training is the package's: the same data, normaliser, update and files; in Node."""

import functools
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics

import jetbot_mjx
from helpers import node
from helpers.further import slow_fixture
from helpers.source_tree import ROOT
from helpers.web_pages import shipped
from jetbot_mjx.agents.fused import arrays, launch
from jetbot_mjx.agents.fused.learner import FusedLearner, shape_of
from jetbot_mjx.envs import wrap_for_training
from jetbot_mjx.evaluation.evaluator import wilson_interval
from onekernel import cpu

sys.path.append(str(ROOT / "deploy"))

import drive

pytest.importorskip("llvmlite")
pytestmark = [
    pytest.mark.cpu,
    pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels for this CPU"),
]

SEED = 5

COPIES = """
const trainer = new Trainer(engine, given.seed), call = trainer.call.bind(trainer);
const copies = () => Object.fromEntries(
  Object.entries(trainer.arrays).map(([name, { view }]) => [name, view.slice()]));
"""

STEPS = f"""{COPIES}
let before = null;
trainer.collect();
const first = copies();
trainer.takeStatistics();
const taken = copies();
trainer.update();
trainer.collect();
trainer.takeStatistics();
const rows = copies();
trainer.call = (name) => {{
  if (name === "ppo_update") before = copies();
  call(name);
}};
const {{ updates }} = trainer;
trainer.update();
return {{ first, taken, second: rows, before, after: copies(), updates,
  steps: trainer.steps, rate: trainer.rate }};
"""


@slow_fixture(scope="module")
def page():
    return shipped("jetbot_egocentric")


@pytest.fixture(scope="module")
def fused(page):
    """The learner of this CPU."""
    ppo, env = page.checkpoint.config.ppo, page.env
    return FusedLearner(ppo, shape_of(ppo, env.observation_size, env.action_size))


@pytest.fixture(scope="module")
def steps(page):
    """Two training steps of a page."""
    return page.run(STEPS, seed=SEED)


def columns(fused, rows):
    """The parts of collected rows, of shape (unrolls, time, ...), by name."""
    places = dict(fused.shape.columns)
    table = rows.reshape(fused.batch.collected, fused.batch.time, places.pop("size"))
    names, ends = [*places], [*places.values()][1:]
    return dict(zip(names, np.split(table, ends, axis=-1), strict=True))


def shaped(fused, given):
    """The arguments of the update, as this CPU's kernel takes them."""
    shapes = arrays.UPDATE.shapes(fused.rule, fused.batch)
    return {name: given[name].reshape(shapes[name]) for name in arrays.UPDATE.arguments}


def test_an_update_is_that_of_the_cpus_kernel_from_the_same_arrays(steps, fused):
    given = shaped(fused, steps["before"])
    results = jax.jit(functools.partial(launch.update, fused.rule))(*given.values())
    for name, theirs in zip(("params", "mu", "nu", "progress"), results, strict=True):
        theirs = np.ravel(theirs)
        largest = np.abs(theirs).max()
        np.testing.assert_allclose(steps["after"][name], theirs, rtol=0, atol=1e-4 * largest)
        assert np.abs(theirs - steps["before"][name]).max() > 1e-3 * largest
    assert steps["rate"] == steps["after"]["progress"].reshape(-1, 10)[-1, 0]


def test_an_update_is_given_what_the_packages_is(steps, fused, page):
    given, ppo = shaped(fused, steps["before"]), page.checkpoint.config.ppo
    # Every pass has each unroll once, in another order.
    orders = given["unroll_indices"].reshape(ppo.num_updates_per_batch, -1)
    everyone = np.arange(fused.batch.collected)
    np.testing.assert_array_equal(np.sort(orders, axis=1), np.tile(everyone, (len(orders), 1)))
    assert len({tuple(order) for order in [*orders, everyone]}) == len(orders) + 1
    assert abs(given["noise"].mean()) < 0.02
    assert given["noise"].std() == pytest.approx(1, abs=0.02)
    np.testing.assert_allclose(given["terms"], fused._loss_terms(), rtol=1e-6)
    assert steps["updates"] == fused.rule.steps
    share = 1 / ppo.gradient_steps
    limit = np.inf if ppo.max_grad_norm is None else ppo.max_grad_norm
    begun = steps["updates"] * share
    expected = [limit, ppo.learning_rate, begun, share, ppo.desired_kl]
    np.testing.assert_allclose(given["adam_terms"][:5], expected, rtol=1e-6)
    power = [0.9 ** steps["updates"], 0.999 ** steps["updates"]]
    np.testing.assert_allclose(given["progress"][0, 1:3], power, rtol=1e-5)
    assert np.all(given["progress"][1:] == 0)
    assert np.all(given["progress"][0, 3:] == 0)


def test_the_first_parameters_are_drawn_as_they_should_be(page):
    body = "return given.seeds.map((seed) => new Trainer(engine, seed).arrays.params.view.slice());"
    first, other = page.run(body, seeds=[SEED, SEED + 1])
    left = np.ones(len(first), bool)
    for entry in page.data["meta"]["learner"]["initial"]:
        place = slice(entry["start"], entry["start"] + entry["count"])
        left[place] = False
        if "value" in entry:
            np.testing.assert_array_equal(first[place], np.float32(entry["value"]))
            continue
        shares = np.sort(first[place]) / entry["limit"]
        # Uniform from -1 to 1, by the statistic of Kolmogorov and Smirnov.
        uniform = np.linspace(-1, 1, len(shares))
        assert np.abs(shares - uniform).max() < 2 * 2 / np.sqrt(len(shares))
        assert abs(np.corrcoef(first[place], other[place])[0, 1]) < 4 / np.sqrt(len(shares))
    assert np.all(first[left] == 0)


# More steps than an episode has.
COLLECTIONS = 18

COLLECTED = f"""
const {{ reset }} = Robots.prototype;
let keys;
Robots.prototype.reset = function (given) {{ keys = given.view.slice(); reset.call(this, given); }};
const trainer = new Trainer(engine, given.seed), rows = [];
for (let i = 0; i < {COLLECTIONS}; i++) {{
  trainer.collect();
  rows.push(trainer.arrays.rows.view.slice());
}}
return {{ keys, rows, last: trainer.arrays.last.view }};
"""


def test_what_is_collected_is_what_the_packages_robots_do(fused, page):
    env, batch = page.env, fused.batch
    found = page.run(COLLECTED, seed=SEED)
    keys = found["keys"].reshape(-1, 2)
    assert len(np.unique(keys, axis=0)) == len(keys) == batch.environments

    def in_order(name):
        """A part of the rows by step and environment: these make one unroll after the other."""
        parts = [columns(fused, rows)[name] for rows in found["rows"]]
        unrolls = np.concatenate(parts).reshape(-1, batch.environments, *parts[0].shape[1:])
        return np.concatenate([x.swapaxes(0, 1) for x in unrolls])

    robots = wrap_for_training(env, env.config.task.episode_length)

    @jax.jit
    def run(keys, actions):
        def step(state, action):
            after = robots.step(state, action)
            ended = after.reward, 1 - after.done, after.info["truncation"]
            return after, (state.obs, *ended)

        end, history = jax.lax.scan(step, robots.reset(keys), actions)
        return *history, end.obs

    *history, last = jax.device_get(run(keys, np.tanh(in_order("raw_action"))))
    names = ("observation", "reward", "discount", "truncation")
    for name, theirs in zip(names, history, strict=True):
        ours = in_order(name).reshape(theirs.shape)
        assert len(np.unique(theirs)) > 1, name
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-3, err_msg=name)
    newest = found["last"].reshape(-1, *last.shape)[-1]
    np.testing.assert_allclose(newest, last, rtol=0, atol=1e-3)


def test_actions_are_drawn_from_the_policy(steps, fused):
    second = columns(fused, steps["second"]["rows"])
    vectors = [steps["second"]["params"], steps["taken"]["mean"], steps["taken"]["inverse_std"]]
    observations = second["observation"].reshape(-1, fused.shape.observations)
    noise = np.zeros((len(observations), fused.shape.actions), np.float32)
    drawn = jax.jit(functools.partial(launch.actions, fused.shape))(*vectors, observations, noise)
    parameters = second["distribution"].reshape(len(noise), -1)
    np.testing.assert_allclose(parameters, drawn.distribution_params, rtol=0, atol=2e-5)
    # The noise of the actions is standard normal, and independent of step and robot.
    mean, scale = np.split(parameters.astype(float), 2, axis=1)
    deviation = np.log1p(np.exp(scale)) + 0.001
    drawn = (second["raw_action"].reshape(mean.shape) - mean) / deviation
    assert abs(drawn.mean()) < 0.02
    assert drawn.std() == pytest.approx(1, abs=0.02)
    series = drawn.reshape(fused.batch.collected, fused.batch.time, -1)
    for a, b in ((series[:, 1:], series[:, :-1]), (series[1:], series[:-1])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.05
    # The density of a normal distribution, and of tanh.
    raw = second["raw_action"].reshape(mean.shape).astype(float)
    density = -0.5 * drawn**2 - np.log(deviation) - 0.5 * np.log(2 * np.pi)
    density -= 2 * (np.log(2) - raw - np.log1p(np.exp(-2 * raw)))
    np.testing.assert_allclose(second["log_prob"].ravel(), density.sum(1), rtol=1e-4, atol=1e-3)


def test_the_normaliser_is_braxs(steps, fused, page):
    state = running_statistics.init_state(
        jax.ShapeDtypeStruct((fused.shape.observations,), jnp.float32)
    )
    for collected, known in (("first", "taken"), ("second", "second")):
        observations = columns(fused, steps[collected]["rows"])["observation"]
        state = jax.jit(running_statistics.update)(state, observations)
        smallest = page.env.observation_min_std
        np.testing.assert_allclose(steps[known]["mean"], state.mean, rtol=1e-5, atol=1e-6)
        deviation = np.maximum(state.std, smallest)
        np.testing.assert_allclose(steps[known]["inverse_std"], 1 / deviation, rtol=1e-5)
    # Before anything is known, the networks take observations as they are.
    assert np.all(steps["first"]["inverse_std"] == 1)
    assert np.all(steps["first"]["mean"] == 0)


def test_the_same_seed_is_the_same_training(page):
    body = """
    const trainers = given.seeds.map((seed) => new Trainer(engine, seed));
    for (const trainer of trainers) trainer.step();
    return trainers.map(({ arrays }) => ({ params: arrays.params.view, rows: arrays.rows.view }));
    """
    one, again, other = page.run(body, seeds=[SEED, SEED, SEED + 1])
    for name in ("params", "rows"):
        np.testing.assert_array_equal(one[name].view(np.uint32), again[name].view(np.uint32))
        assert np.any(one[name] != other[name])
    assert np.isfinite(one["params"]).all()


# A worker in the same thread, whose messages are copies as those of a browser. Each loop of a
# training waits for a timer without a delay between two steps.
LEARNER = """
const later = globalThis.setTimeout;
let loops = 0, mostLoops = 0;
globalThis.setTimeout = (act, delay) => {
  if (delay !== undefined) return later(act, delay);
  mostLoops = Math.max(mostLoops, ++loops);
  return later(() => { loops--; act(); });
};
globalThis.document = { getElementById: () => ({ textContent: "" }) };
const workers = [];
globalThis.Worker = class {
  constructor() {
    workers.push(this);
    const tell = (message) => later(() => this.onmessage({ data: structuredClone(message) }));
    this.inner = new TrainingWorker(tell);
  }
  postMessage(message) { this.inner.receive(structuredClone(message)); }
  terminate() { this.inner.running = false; }
};
// Short examinations.
const meta = { ...given.data.meta, episode_seconds: 1 }, module = bytesOf(given.data.module);
const learner = new Learner({ meta, module }, { seed: given.seed });
const told = [], waiting = [];
learner.onprogress = (progress) => {
  told.push({ ...progress, policy: null });
  while (waiting.length && told.length >= waiting[0].count) waiting.shift().resolve();
};
learner.onerror = (error) => { throw Error(error); };
const reports = (count) => told.length >= count ? null
  : new Promise((resolve) => waiting.push({ count, resolve }));
"""


@pytest.fixture(scope="module")
def observations(page):
    return np.float32(np.random.default_rng(0).normal(size=(50, page.env.observation_size)))


@pytest.fixture(scope="module")
def training(page, observations):
    """A training that is started, paused, downloaded, changed and started again."""
    body = f"""{LEARNER}
    await reports(1);
    learner.start();
    learner.pause();
    learner.start();
    await reports(2);
    learner.pause();
    await new Promise((resolve) => setTimeout(resolve, 200));
    const paused = told.length, {{ policy }} = learner.latest, files = learner.download();
    const size = policy.mean.length, count = given.obs.length / size;
    const actions = new Float32Array(2 * count);
    const network = new Network(new Memory(engine.module), policy, count);
    network.act((i) => given.obs.subarray(i * size, (i + 1) * size), null, actions, 2);
    await new Promise((resolve) => setTimeout(resolve, 500));
    const still = told.length;
    learner.setKnobs([50, 1, 1]);
    learner.start();
    await reports(still + 1);
    learner.stop();
    return {{ told, files, actions, paused, still, mostLoops }};
    """
    return page.run(body, seed=SEED, obs=observations.ravel())


@pytest.mark.slow
def test_what_a_page_downloads_is_read_and_acts_as_on_the_page(
    training, observations, page, tmp_path
):
    for name, text in training["files"].items():
        (tmp_path / name).write_text(text, "utf-8")
    loaded = jetbot_mjx.load_policy(tmp_path)(observations)
    action, wheel_speeds = drive.load_policy(str(tmp_path)).act(observations)
    np.testing.assert_array_equal(loaded, action)
    np.testing.assert_allclose(action, training["actions"].reshape(action.shape), rtol=0, atol=1e-5)
    targets = jax.vmap(page.env.wheel_targets)(action)
    np.testing.assert_allclose(wheel_speeds, targets, rtol=1e-4, atol=1e-4)
    # The description is that of an export, of this training.
    exported = json.loads(training["files"]["policy.json"])
    assert exported["run"] == f"page, seed {SEED}"
    assert exported["env_steps"] == training["told"][1]["steps"] > 0
    assert exported["evaluation"] is None
    assert [one["shape"] for one in exported["inputs"]] == [list(observations.shape[1:])]


def test_a_training_is_paused_goes_on_and_takes_what_a_visitor_changes(training, page):
    told = training["told"]
    assert training["paused"] == training["still"]
    # One loop makes the steps, however often it is started.
    assert training["mostLoops"] == 1
    batch = page.data["meta"]["learner"]["batch"]
    each = 4 * batch["collected"] * batch["time"]
    assert [report["steps"] for report in told] == [each * i for i in range(len(told))]
    assert told[0]["reached"] < 0.5 * told[0]["goals"]
    low, high = told[0]["interval"]
    assert low < told[0]["success"] < high
    # Every robot is within 50 m of its goal.
    assert told[-1]["success"] == 1


def test_the_interval_of_a_page_is_the_packages():
    cases = [(0, 60), (60, 60), (253, 256), (1, 2)]
    found = node.run("return given.cases.map(([a, b]) => wilson(a, b));", cases=cases)
    for (successes, count), (low, high) in zip(cases, found, strict=True):
        assert 0 <= low < high <= 1
        np.testing.assert_allclose((low, high), wilson_interval(successes, count), atol=1e-5)


@pytest.mark.slow
def test_five_trainings_reach_the_goals_in_a_minute(page, capsys):
    body = """
    const found = [];
    for (const seed of given.seeds) {
      const trainer = new Trainer(engine, seed), examination = new Examination(engine, 256);
      let milliseconds = 0, reached = 0;
      while (reached < 0.95 * 256 && trainer.steps < given.most) {
        const begin = performance.now();
        for (let step = 0; step < 4; step++) trainer.step();
        milliseconds += performance.now() - begin;
        reached = examination.reached(trainer.policy());
      }
      found.push({ seconds: milliseconds / 1000, reached, steps: trainer.steps });
    }
    return found;
    """
    found = page.run(body, seeds=[0, 1, 2, 3, 4], most=524_288)
    seconds, steps = (np.median([one[name] for one in found]) for name in ("seconds", "steps"))
    with capsys.disabled():
        print(f"\n95 % of 256 goals: median of 5 seeds {seconds:.1f} s, {steps:,.0f} steps")
    assert min(one["reached"] for one in found) >= 0.95 * 256
    assert steps <= 262_144
