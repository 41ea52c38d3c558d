"use strict";
// Training in a page: the proximal policy optimisation (PPO) of jetbot_mjx, in a worker.
//
// A training step collects unrolls with the current policy, takes their observations into the normaliser, and
// updates both networks in passes and minibatches. The module's functions act, step and update; this file moves
// numbers between them. docs: "The kernels, explained".

/** PPO from scratch, as one object that makes training steps. */
class Trainer {
  /**
   * @param {Engine} engine the module
   * @param {number} seed the seed, from which everything is drawn
   */
  constructor(engine, seed) {
    const about = engine.meta.learner, memory = new Memory(engine.module);
    Object.assign(this, { engine, about, memory, steps: 0, updates: 0 });
    this.robots = new Robots(memory, engine.meta.training_functions, about.environments);
    this.observations = about.shape.observations;
    this.actions = about.shape.actions;
    // The arrays of both functions by name; those of the same name are one.
    this.arrays = {};
    for (const { arrays } of Object.values(about.functions))
      for (const [name, size] of arrays)
        this.arrays[name] ??= memory.array(size, name === "unroll_indices" ? Int32Array : Float32Array);
    const weights = about.initial.map(({ count }) => count), { noise, action_noise } = this.arrays;
    this.random = new Random(memory, seed, Math.max(...weights, noise.length, action_noise.length));
    const bytes = Math.max(...Object.values(about.functions).map((x) => x.scratch));
    this.scratch = memory.array(bytes / 4);
    this.statistics = { count: 0, mean: new Float64Array(this.observations), squares: new Float64Array(this.observations) };
    this.rate = about.optimizer.learning_rate;
    this.begin();
  }

  /** Draws the parameters and the first episodes. */
  begin() {
    const { about, random, robots, memory } = this, params = this.arrays.params.view;
    for (const { start, count, limit, value } of about.initial) {
      if (limit === undefined) params.fill(value, start, start + count);
      else params.set(random.numbers(count, "uniform").map((x) => (2 * x - 1) * limit), start);
    }
    const keys = memory.array(2 * robots.count, Uint32Array);
    random.keys(keys.view);
    robots.reset(keys);
    this.arrays.terms.view.set(about.loss_terms);
    this.takeStatistics();
  }

  /** Calls a function with its arrays. */
  call(name) {
    const { arrays } = this.about.functions[name];
    this.memory.functions[name](...arrays.map(([array]) => this.arrays[array].address), this.scratch.address);
  }

  /** Makes one training step. */
  step() {
    const { adaptive } = this.about.optimizer;
    this.collect();
    // ADAPTIVE_KL compares with the distributions of the collection, so it normalises as that did.
    if (!adaptive) this.takeStatistics();
    this.update();
    if (adaptive) this.takeStatistics();
  }

  /** Collects unrolls with the current policy, and their observations for the normaliser. */
  collect() {
    const { about, arrays, robots, random, observations: size, actions } = this;
    const { collected, time } = about.batch, { environments } = about;
    for (let first = 0; first < collected; first += environments) {
      for (let t = 0; t < time; t++) {
        this.observe(arrays.observations.view, 0);
        arrays.action_noise.view.set(random.numbers(environments * actions, "normal"));
        this.call("ppo_act");
        robots.actions.view.set(arrays.action.view);
        robots.step();
        for (let robot = 0; robot < environments; robot++) this.keep(robot, ((first + robot) * time + t));
      }
      // The value of what an unroll ends with counts, too.
      this.observe(arrays.last.view, first * size);
    }
    this.normalise();
    this.steps += collected * time;
  }

  /** Copies the observations of all robots. */
  observe(target, start) {
    const { robots, observations: size } = this;
    for (let robot = 0; robot < robots.count; robot++) target.set(robots.numbers("obs", robot), start + robot * size);
  }

  /** Writes what a step of a robot was, as a row of the collected data. */
  keep(robot, row) {
    const { about, arrays, robots, observations: size, actions } = this, { columns } = about;
    const rows = arrays.rows.view, at = row * columns.size;
    const copy = (name, source, count) => {
      for (let i = 0; i < count; i++) rows[at + columns[name] + i] = source[robot * count + i];
    };
    copy("observation", arrays.observations.view, size);
    copy("raw_action", arrays.raw_action.view, actions);
    copy("log_prob", arrays.log_prob.view, 1);
    copy("distribution", arrays.distribution_params.view, 2 * actions);
    rows[at + columns.reward] = robots.number("reward", robot);
    rows[at + columns.discount] = 1 - robots.number("done", robot);
    rows[at + columns.truncation] = robots.number("truncation", robot);
  }

  /** Takes all collected observations into the running statistics (Welford). */
  normalise() {
    const { about, arrays, statistics, observations: size } = this, { columns } = about, rows = arrays.rows.view;
    const count = rows.length / columns.size;
    statistics.count += count;
    for (let i = 0; i < size; i++) {
      const before = statistics.mean[i];
      let sum = 0;
      for (let at = columns.observation + i; at < rows.length; at += columns.size) sum += rows[at] - before;
      const mean = before + sum / statistics.count;
      let squares = 0;
      for (let at = columns.observation + i; at < rows.length; at += columns.size)
        squares += (rows[at] - before) * (rows[at] - mean);
      statistics.mean[i] = mean;
      statistics.squares[i] += squares;
    }
  }

  /** Lets the networks normalise by the statistics as they are now. */
  takeStatistics() {
    const { statistics, about, observations: size } = this, { mean, inverse_std } = this.arrays;
    inverse_std.view.fill(1);
    if (!about.normalizes_observations || statistics.count === 0) return;
    for (let i = 0; i < size; i++) {
      const deviation = Math.sqrt(Math.max(statistics.squares[i], 0) / statistics.count);
      mean.view[i] = statistics.mean[i];
      inverse_std.view[i] = 1 / Math.max(Math.min(Math.max(deviation, 1e-6), 1e6), about.smallest_deviations[i]);
    }
  }

  /** Updates both networks in passes over the collected unrolls. */
  update() {
    const { about, arrays, random, updates } = this, { optimizer, progress } = about;
    const { collected } = about.batch, indices = arrays.unroll_indices.view;
    for (let pass = 0; pass < about.passes; pass++) indices.set(random.order(collected), pass * collected);
    const noise = arrays.noise.view;
    noise.set(random.numbers(noise.length, "normal"));
    const terms = { ...optimizer, max_grad_norm: optimizer.max_grad_norm ?? Infinity };
    terms.fraction_done = updates * optimizer.fraction_per_step;
    arrays.adam_terms.view.set(about.adam_terms.map((name) => terms[name]));
    // A row of the progress before each step of Adam, of which the first one is given.
    const rows = arrays.progress.view, [beta1, beta2] = about.betas;
    rows.fill(0);
    rows.set([this.rate, beta1 ** updates, beta2 ** updates]);
    this.call("ppo_update");
    const last = arrays.progress.view.subarray(-(progress.names.length - 1 + progress.metrics.length));
    this.rate = last[0];
    this.updates += last[last.length - 1];
  }

  /** Returns the policy as `Network` takes it. */
  policy() {
    const params = this.arrays.params.view, { layers } = this.about, { mean, inverse_std } = this.arrays;
    const last = layers.length - 1;
    return {
      mean: mean.view.slice(),
      std: Float32Array.from(inverse_std.view, (x) => 1 / x),
      squash: this.about.shape.distribution === "tanh_normal",
      layers: layers.map(({ start, inputs, outputs }, i) => {
        const kept = i < last ? outputs : this.actions, end = start + inputs * outputs;
        const kernel = Float32Array.from({ length: inputs * kept }, (_, j) =>
          params[start + Math.floor(j / kept) * outputs + (j % kept)]);
        return { kernel, bias: params.slice(end, end + kept) };
      }),
    };
  }
}

/** Goals that are the same for every policy and every page, and how many of them a policy reaches. */
class Examination {
  constructor(engine, goals, seed = 1) {
    this.fleet = new Fleet(engine, goals, seed);
    this.seed = seed;
    this.longest = Math.round(engine.meta.episode_seconds / engine.meta.dt);
  }

  /** Returns how many goals a policy reaches within the time limit. */
  reached(policy) {
    const { fleet } = this, ended = new Uint8Array(fleet.count);
    fleet.drivenBy(policy);
    fleet.reset(this.seed);
    let reached = 0;
    for (let step = 0, left = fleet.count; step < this.longest && left > 0; step++) {
      fleet.step();
      for (let robot = 0; robot < fleet.count; robot++) {
        if (ended[robot] || !fleet.done[robot]) continue;
        ended[robot] = 1;
        reached += fleet.success[robot];
        left--;
      }
    }
    return reached;
  }
}

const EXAMINED_GOALS = 256;
const EXAMINED_EVERY = 4;

/** The worker: trains until it is told to stop, and tells the page how far it is. */
class TrainingWorker {
  constructor(send) {
    Object.assign(this, { send, running: false, busy: false, seconds: 0 });
  }

  /** Takes a message of `Learner`, in the order in which they come. */
  async receive({ kind, ...given }) {
    try {
      if (kind === "load") this.loaded = this.load(given);
      await this.loaded;
      if (kind === "knobs") this.setKnobs(given.settings);
      if (kind === "start" || kind === "pause") await this.run(kind === "start");
    } catch (error) {
      this.running = false;
      this.send({ error: error.message });
    }
  }

  async load({ module, meta, seed }) {
    const engine = await Engine.load(module, meta);
    this.trainer = new Trainer(engine, seed);
    this.examination = new Examination(engine, EXAMINED_GOALS);
    this.calls = 0;
    this.report();
  }

  setKnobs(settings) {
    this.trainer.robots.settings = settings;
    this.examination.fleet.robots.settings.splice(0, settings.length, ...settings);
  }

  /** Makes training steps until it is told to pause, with room between them for messages. */
  async run(running) {
    this.running = running;
    if (!running || this.busy) return;
    this.busy = true;
    while (this.running && !this.finished) {
      const begin = performance.now();
      this.trainer.step();
      this.seconds += (performance.now() - begin) / 1000;
      if (++this.calls % EXAMINED_EVERY === 0 || this.finished) this.report();
      await new Promise((resolve) => setTimeout(resolve));
    }
    this.busy = false;
  }

  /** Whether the training has made as many steps as its settings say. */
  get finished() {
    return this.trainer.steps >= this.trainer.about.steps;
  }

  report() {
    const { trainer, examination, seconds, finished } = this, policy = trainer.policy();
    const reached = examination.reached(policy);
    this.send({ steps: trainer.steps, seconds, reached, goals: EXAMINED_GOALS, policy, finished });
  }
}

/** A training in a worker, for the page. `onprogress` is called with steps, seconds, success, interval and policy. */
class Learner {
  constructor(data, { seed = 0 } = {}) {
    const source = URL.createObjectURL(new Blob([document.getElementById("engine").textContent], { type: "text/javascript" }));
    Object.assign(this, { data, seed, onprogress: null, onerror: null, latest: null });
    this.worker = new Worker(source);
    URL.revokeObjectURL(source);
    this.worker.onmessage = ({ data: progress }) => this.#receive(progress);
    this.worker.onerror = (event) => this.onerror?.(event.message);
    this.worker.postMessage({ kind: "load", module: data.module, meta: data.meta, seed });
  }

  #receive(progress) {
    const { error, reached, goals } = progress;
    if (error !== undefined) return this.onerror?.(error);
    this.latest = { ...progress, success: reached / goals, interval: wilson(reached, goals) };
    this.onprogress?.(this.latest);
  }

  start() {
    this.worker.postMessage({ kind: "start" });
  }

  pause() {
    this.worker.postMessage({ kind: "pause" });
  }

  /** Ends the training for good. */
  stop() {
    this.worker.terminate();
  }

  /** Sets success radius [m], share of the largest speed and factor on the friction, from now on. */
  setKnobs(settings) {
    this.worker.postMessage({ kind: "knobs", settings });
  }

  /** Returns the policy as the files `policy.py` and `policy.json`, which jetbot_mjx exports too. */
  download() {
    const { policy, steps } = this.latest, { python, spec, about } = this.data.meta.export;
    const arrays = [policy.mean, policy.std, ...policy.layers.flatMap(({ kernel, bias }) => [kernel, bias])];
    const shapes = arrays.map((array, i) => {
      if (i < 2 || i % 2 === 1) return [array.length];
      const outputs = arrays[i + 1].length;
      return [array.length / outputs, outputs];
    });
    const bytes = arrays.flatMap((array) => [...new Uint8Array(array.buffer, array.byteOffset, array.byteLength)]);
    const lines = btoa(bytes.map((byte) => String.fromCharCode(byte)).join("")).match(/.{1,96}/g).join("\n");
    const text = python
      .replace('"""{}"""', () => `"""${JSON.stringify({ ...about, shapes })}"""`)
      .replace('NUMBERS = """\n"""', () => `NUMBERS = """\n${lines}\n"""`);
    const description = { ...spec, env_steps: steps, run: `page, seed ${this.seed}` };
    return { "policy.py": text, "policy.json": `${JSON.stringify(description, null, 2)}\n` };
  }
}

/** Returns the 95 % interval of a share (Wilson). */
function wilson(successes, count) {
  const z = 1.96, share = successes / count, spread = z * z / count;
  const middle = (share + spread / 2) / (1 + spread);
  const half = z * Math.sqrt((share * (1 - share)) / count + spread / (4 * count)) / (1 + spread);
  return [Math.max(0, middle - half), Math.min(1, middle + half)];
}

if (typeof document === "undefined" && typeof self !== "undefined") {
  const worker = new TrainingWorker((message) => self.postMessage(message));
  self.onmessage = ({ data }) => worker.receive(data);
}
