"use strict";
// Robots in a page: loads the WebAssembly module that jetbot_mjx wrote, and steps robots with it.
//
// The module's functions take addresses in its memory. Everything below is about numbers of 32 bits: an array
// of `length` numbers begins at an address that is a multiple of 64. A robot's state is a row of words, of which
// `about.places` says what some of them mean.

/** An error that tells the visitor in one line what this browser lacks. */
class UnsupportedError extends Error {}

/** Returns the bytes that a text in base64 holds. */
function bytesOf(text) {
  const characters = atob(text);
  const bytes = new Uint8Array(characters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

/** Returns the float32 numbers that a text in base64 holds. */
function floatsOf(text) {
  return new Float32Array(bytesOf(text).buffer);
}

/** Returns what the page was made of: `meta`, `module` (bytes) and `policies`. */
function readData() {
  const data = JSON.parse(document.getElementById("data").textContent);
  return { meta: data.meta, module: bytesOf(data.module), policies: data.policies };
}

/** Memory of one instance of the module, with its functions. It only grows, and ends with its user. */
class Memory {
  constructor(module) {
    this.functions = new WebAssembly.Instance(module, {}).exports;
    this.top = this.functions.__heap_base.value;
  }

  /**
   * Takes memory for numbers, which begin as zeros.
   * @param {number} length how many
   * @param {Function} kind the typed array that shows them
   */
  array(length, kind = Float32Array) {
    const address = Math.ceil(this.top / 64) * 64;
    this.top = address + 4 * length;
    const missing = this.top - this.functions.memory.buffer.byteLength;
    if (missing > 0) this.functions.memory.grow(Math.ceil(missing / 65536));
    return new Numbers(this.functions.memory, address, length, kind);
  }
}

/** Numbers in a module's memory. */
class Numbers {
  constructor(memory, address, length, kind) {
    Object.assign(this, { memory, address, length, kind, shown: null });
  }

  /** The numbers as a typed array, which is made again where the memory has grown. */
  get view() {
    if (this.shown === null || this.shown.buffer !== this.memory.buffer)
      this.shown = new this.kind(this.memory.buffer, this.address, this.length);
    return this.shown;
  }
}

/** The module, compiled once, and what jetbot_mjx says of it. */
class Engine {
  constructor(module, meta) {
    this.module = module;
    this.meta = meta;
  }

  /**
   * Compiles the module.
   * @param {Uint8Array} bytes the module
   * @param {object} meta what jetbot_mjx says of it
   * @throws {UnsupportedError} this browser cannot run it
   */
  static async load(bytes, meta) {
    if (typeof WebAssembly !== "object")
      throw new UnsupportedError("This page needs WebAssembly, which this browser does not have or has turned off.");
    try {
      return new Engine(await WebAssembly.compile(bytes), meta);
    } catch (error) {
      if (!(error instanceof WebAssembly.CompileError)) throw error;
      throw new UnsupportedError("This page needs WebAssembly with SIMD: Chrome 91, Firefox 89, Safari 16.4 or later.");
    }
  }

  /** Returns robots, each at the beginning of an episode. */
  fleet(count, seed) {
    return new Fleet(this, count, seed);
  }
}

/** Draws random numbers by Threefry, the same for the same seed; each call goes on where the last one ended. */
class Random {
  /**
   * @param {Memory} memory the memory
   * @param {number} seed the seed
   * @param {number} most the largest number of numbers that are drawn at once
   */
  constructor(memory, seed, most = 0) {
    Object.assign(this, { memory, seed, next: 0 });
    this.key = memory.array(2 * most, Uint32Array);
    this.drawn = { normal: memory.array(most), uniform: memory.array(most) };
  }

  /** Fills keys with pairs of words, none of which comes twice. */
  keys(numbers) {
    for (let i = 0; i < numbers.length; i += 2) {
      numbers[i] = this.seed;
      numbers[i + 1] = this.next++;
    }
  }

  /** Returns as many numbers, from the standard normal distribution or uniform from 0 to 1, until the next call. */
  numbers(count, kind) {
    const { key, drawn } = this;
    this.keys(key.view.subarray(0, 2 * count));
    this.memory.functions.robot_draw(key.address, drawn.normal.address, drawn.uniform.address, count);
    return drawn[kind].view.subarray(0, count);
  }

  /** Returns the whole numbers below `count` in a random order. */
  order(count) {
    const uniform = this.numbers(count, "uniform");
    const places = Uint32Array.from({ length: count }, (_, i) => i);
    for (let i = count - 1; i > 0; i--) {
      const j = Math.floor(uniform[i] * (i + 1));
      [places[i], places[j]] = [places[j], places[i]];
    }
    return places;
  }
}

/**
 * The layers of a policy, in a module's memory.
 *
 * `policy` holds `mean` and `std` of the numbers that it observes, `layers` of `kernel` (inputs x outputs, row by
 * row) and `bias`, `squash` (whether tanh follows), and where it sees an `encoder`: the image's `shape`,
 * `convolutions` of `kernel` (side x side x channels x outputs), `bias`, `side` and `stride`, and its `dense` layer.
 */
class Network {
  constructor(memory, policy, count) {
    this.memory = memory;
    this.count = count;
    this.encoder = policy.encoder ? new Encoder(memory, policy.encoder, count) : null;
    this.layers = policy.layers.map(({ kernel, bias }) => new Layer(memory, kernel.length / bias.length, bias.length, count));
    this.inputs = this.layers[0].inputs;
    this.input = memory.array(count * this.inputs);
    this.load(policy);
  }

  /** Copies the numbers of a policy with layers of the same sizes. */
  load(policy) {
    this.mean = policy.mean;
    this.scale = Float32Array.from(policy.std, (x) => 1 / x);
    this.squash = policy.squash;
    for (const [i, layer] of this.layers.entries()) layer.load(policy.layers[i]);
    this.encoder?.load(policy.encoder);
  }

  /**
   * Computes the actions of all robots, in [-1, 1].
   * @param {(robot: number) => Float32Array} observed what a robot observes, in numbers
   * @param {{bytes: Uint8Array, size: number} | null} images the images of all robots, of `size` bytes each
   * @param {Float32Array} actions the result, row by row
   * @param {number} size numbers of an action
   */
  act(observed, images, actions, size) {
    const { count, inputs, mean, scale } = this, seen = inputs - mean.length, input = this.input.view;
    if (this.encoder) this.encoder.look(images, input, inputs);
    for (let robot = 0; robot < count; robot++) {
      const start = robot * inputs + seen, numbers = observed(robot);
      for (let i = 0; i < mean.length; i++) input[start + i] = (numbers[i] - mean[i]) * scale[i];
    }
    // The hidden layers with their activation, and the last one.
    let address = this.input.address, stride = inputs;
    for (const [i, layer] of this.layers.entries()) {
      const { results } = layer;
      layer.apply(address, stride);
      if (i < this.layers.length - 1) this.memory.functions.net_activate(results.address, results.length);
      [address, stride] = [results.address, layer.columns];
    }
    const last = this.layers[this.layers.length - 1], outputs = last.results.view;
    for (let robot = 0; robot < count; robot++)
      for (let i = 0; i < size; i++) {
        const x = outputs[robot * last.columns + i];
        actions[robot * size + i] = this.squash ? Math.tanh(x) : Math.min(1, Math.max(-1, x));
      }
  }
}

/** A layer with columns of zeros up to a multiple of 4, and its results for some rows. */
class Layer {
  /**
   * @param {Memory} memory the memory
   * @param {number} inputs the inputs of its kernel
   * @param {number} outputs the outputs
   * @param {number} rows the most rows to which it is applied at once
   * @param {{used: number, room: number, places: number, stride: number}} layout inputs that come in groups of `room`
   *   numbers, of which the first `used` count, and results for `places` places of a row, which are `stride` apart
   */
  constructor(memory, inputs, outputs, rows, { used = 1, room = 1, places = 1, stride = null } = {}) {
    const columns = Math.ceil(outputs / 4) * 4, groups = inputs / used;
    Object.assign(this, { memory, inputs, outputs, columns, rows, used, room, places });
    this.stride = stride ?? places * columns;
    this.weights = memory.array(groups * room * columns);
    this.results = memory.array(rows * this.stride);
    this.biases = new Float32Array(this.results.length);
  }

  load({ kernel, bias }) {
    const { inputs, outputs, columns, used, room, rows, places, stride, biases } = this, weights = this.weights.view;
    for (let input = 0; input < inputs; input++) {
      const row = Math.floor(input / used) * room + (input % used);
      weights.set(kernel.subarray(input * outputs, (input + 1) * outputs), row * columns);
    }
    for (let row = 0; row < rows; row++)
      for (let place = 0; place < places; place++) biases.set(bias, row * stride + place * columns);
  }

  /** Sets the results to the biases. */
  begin() {
    this.results.view.set(this.biases);
  }

  /** Adds the products of rows of `length` numbers, `stride` apart, with the weights from `first` on. */
  add(address, stride, first, length, place = 0) {
    const { memory, weights, columns, results, rows } = this;
    memory.functions.net_product(
      address, stride, weights.address + 4 * first * columns, columns,
      results.address + 4 * place * columns, this.stride, rows, columns, length,
    );
  }

  /** Computes the results from rows of numbers, `stride` apart. */
  apply(address, stride) {
    this.begin();
    this.add(address, stride, 0, (this.inputs / this.used) * this.room);
  }
}

const TOGETHER = 32; // robots whose images are encoded at once, so that the numbers stay in the processor's cache
const APART = 16; // numbers between the images of two robots: powers of two meet in the same place of a cache

/** The convolutions of a policy and the dense layer behind them, of some robots at a time. */
class Encoder {
  constructor(memory, { shape, convolutions, dense }, count) {
    let [height, width, channels] = shape, room = channels;
    const rows = Math.min(count, TOGETHER), apart = height * width * channels + APART;
    Object.assign(this, { memory, count, rows, size: height * width * channels, apart });
    this.pixels = memory.array(rows * apart);
    this.steps = convolutions.map(({ bias, side, stride }) => {
      const from = { width, room }, inputs = side * side * channels, used = channels;
      height = Math.floor((height - side) / stride) + 1;
      width = Math.floor((width - side) / stride) + 1;
      channels = bias.length;
      const places = height * width, columns = Math.ceil(channels / 4) * 4;
      const layer = new Layer(memory, inputs, channels, rows, { used, room, places, stride: places * columns + APART });
      room = columns;
      return { from, side, stride, height, width, layer };
    });
    const inputs = height * width * channels;
    this.dense = new Layer(memory, inputs, dense.bias.length, rows, { used: channels, room });
  }

  load({ convolutions, dense }) {
    for (const [i, { layer }] of this.steps.entries()) layer.load(convolutions[i]);
    this.dense.load(dense);
  }

  /** Writes the features of all robots' images into rows of `inputs` numbers. */
  look({ bytes, size }, input, inputs) {
    const { count, rows, apart, dense } = this, { outputs, columns } = dense;
    for (let first = 0; first < count; first += rows) {
      // The last robots may be fewer; those before them come again.
      const start = Math.min(first, count - rows), pixels = this.pixels.view;
      for (let row = 0; row < rows; row++)
        pixels.set(bytes.subarray((start + row) * size, (start + row + 1) * size), row * apart);
      this.#encode();
      const features = dense.results.view;
      for (let row = 0; row < rows; row++)
        input.set(features.subarray(row * columns, row * columns + outputs), (start + row) * inputs);
    }
  }

  /** Takes images through all layers, each of which ends with ReLU. */
  #encode() {
    let { address } = this.pixels, robot = this.apart;
    for (const { from, side, stride, height, width, layer } of this.steps) {
      // The inputs of a place are rows of pixels, whose numbers are next to each other.
      const length = side * from.room;
      layer.begin();
      for (let place = 0; place < height * width; place++)
        for (let row = 0; row < side; row++) {
          const y = Math.floor(place / width) * stride + row, x = (place % width) * stride;
          layer.add(address + 4 * (y * from.width + x) * from.room, robot, row * length, length, place);
        }
      rectify(layer.results.view);
      [address, robot] = [layer.results.address, layer.stride];
    }
    this.dense.apply(address, robot);
    rectify(this.dense.results.view);
  }
}

/** Sets negative numbers to zero. */
function rectify(numbers) {
  for (let i = 0; i < numbers.length; i++) if (numbers[i] < 0) numbers[i] = 0;
}

/** Returns the arrays of a policy as `Network` takes them. */
function policyOf(stored) {
  const layer = ({ kernel, bias, ...others }) => ({ kernel: floatsOf(kernel), bias: floatsOf(bias), ...others });
  const encoder = stored.encoder && {
    shape: stored.encoder.shape,
    convolutions: stored.encoder.convolutions.map(layer),
    dense: layer(stored.encoder.dense),
  };
  const { squash } = stored;
  return { mean: floatsOf(stored.mean), std: floatsOf(stored.std), layers: stored.layers.map(layer), squash, encoder };
}

/** The states of some robots, and the functions that step them. */
class Robots {
  /**
   * Begins an episode of each robot.
   * @param {Memory} memory the memory
   * @param {object} about what jetbot_mjx says of these functions
   * @param {number} count the number of robots
   */
  constructor(memory, about, count) {
    Object.assign(this, { memory, about, count });
    this.words = memory.array(count * about.words);
    this.actions = memory.array(count * about.actions);
    this.knobs = memory.array(count * about.initial_knobs.length);
    this.settings = [...about.initial_knobs];
  }

  /** Calls one of the functions. */
  call(name, ...addresses) {
    this.memory.functions[this.about.prefix + name](...addresses);
  }

  /** Begins episodes, from two words for each robot. */
  reset(keys) {
    this.call("reset", keys.address, this.words.address, this.count);
  }

  /** Makes a step of each robot with its action. */
  step() {
    const { words, actions, knobs, settings } = this;
    const given = [words.address, actions.address];
    if (this.about.knobs.length) {
      const view = knobs.view;
      for (let i = 0; i < view.length; i++) view[i] = settings[i % settings.length];
      given.push(knobs.address);
    }
    this.call("step", ...given, words.address, this.count);
  }

  /** Returns a number of a robot by the name of its place. */
  number(name, robot) {
    return this.words.view[robot * this.about.words + this.about.places[name]];
  }

  /** Returns several numbers of a robot, which change when they are changed. */
  numbers(name, robot) {
    const [start, size] = this.about.places[name], first = robot * this.about.words + start;
    return this.words.view.subarray(first, first + size);
  }
}

/** Robots that a page shows, with whoever drives them. Robots are counted from 0. */
class Fleet {
  constructor(engine, count, seed) {
    const { meta } = engine, memory = new Memory(engine.module);
    Object.assign(this, { meta, memory, count, time: 0, network: null, policy: null, scripted: false });
    this.robots = new Robots(memory, meta.robot_functions, count);
    const { actions } = meta.robot_functions;
    this.shown = { poses: memory.array(count * meta.scene.bodies * 7), goals: memory.array(count * 3) };
    this.keys = memory.array(2 * count, Uint32Array);
    this.one = { words: memory.array(meta.robot_functions.words), goal: memory.array(3) };
    this.manual = new Map();
    this.actionSize = actions;
    this.done = new Uint8Array(count);
    this.success = new Uint8Array(count);
    this.eyes = meta.image ? new Eyes(this) : null;
    this.observed = (robot) => this.robots.numbers("obs", robot);
    this.knobs = new Knobs(this.robots.settings, meta);
    this.resetCounters();
    this.reset(seed);
  }

  /** Begins an episode of every robot, the same ones for the same seed. */
  reset(seed) {
    new Random(this.memory, seed).keys(this.keys.view);
    this.begin();
  }

  /** Begins an episode of every robot from the words in `keys`, two for each robot. */
  begin() {
    this.robots.reset(this.keys);
    this.done.fill(1);
    this.time = 0;
    if (this.eyes && this.policy) this.eyes.look(this.done);
    this.done.fill(0);
  }

  /** Lets a policy drive, given as `Network` takes it; null: nobody. */
  drivenBy(policy) {
    // All policies of a page have layers of the same sizes.
    if (policy && this.network) this.network.load(policy);
    else if (policy) this.network = new Network(this.memory, policy, this.count);
    const sees = this.eyes && policy && !this.policy;
    this.policy = policy && this.network;
    this.scripted = false;
    // While others drove, nobody looked.
    if (sees) this.eyes.look(new Uint8Array(this.count).fill(1));
  }

  /** Makes one step of all robots, `meta.dt` seconds. */
  step() {
    const { robots, count, done, success } = this, actions = robots.actions.view;
    if (this.scripted) robots.call("script", robots.words.address, robots.actions.address, count);
    else if (this.policy) this.policy.act(this.observed, this.eyes, actions, this.actionSize);
    for (const [robot, action] of this.manual) actions.set(action.slice(0, this.actionSize), robot * this.actionSize);
    robots.step();
    for (let robot = 0; robot < count; robot++) {
      done[robot] = robots.number("done", robot) > 0 ? 1 : 0;
      success[robot] = done[robot] && robots.number("success", robot) > 0 ? 1 : 0;
      this.episodes += done[robot];
      this.successes += success[robot];
    }
    this.time += this.meta.dt;
    if (this.eyes && this.policy) this.eyes.look(done);
  }

  /** Position (x, y, z) [m] and quaternion (w, x, y, z) of each body of each robot, in the world's frame. */
  poses() {
    this.robots.call("poses", this.robots.words.address, this.shown.poses.address, this.count);
    return this.shown.poses.view;
  }

  /** Position (x, y, z) of each robot's goal [m]. */
  goals() {
    this.robots.call("goals", this.robots.words.address, this.shown.goals.address, this.count);
    return this.shown.goals.view;
  }

  /** The numbers that a robot observes. */
  observation(robot) {
    return this.observed(robot);
  }

  /** What a robot's camera sees now, a byte for each channel of each pixel; null: it has none. */
  image(robot) {
    return this.eyes && this.eyes.newest(robot);
  }

  /** The last action of a robot. */
  action(robot) {
    return this.robots.actions.view.subarray(robot * this.actionSize, (robot + 1) * this.actionSize);
  }

  /** Places a robot's goal on the floor [m]; its time begins again. */
  setGoal(robot, x, y) {
    if (!this.meta.robot_functions.functions.includes("move")) return;
    const { words, about } = this.robots, { one } = this, row = new Uint32Array(words.memory.buffer);
    const place = words.address / 4 + robot * about.words, size = about.words;
    row.copyWithin(one.words.address / 4, place, place + size);
    one.goal.view.set([x, y, this.goals()[3 * robot + 2]]);
    this.robots.call("move", one.words.address, one.goal.address, one.words.address, 1);
    row.copyWithin(place, one.words.address / 4, one.words.address / 4 + size);
  }

  /** Adds to a robot's velocity: along x and y [m/s], and of its yaw [rad/s]. */
  push(robot, x, y, yaw = 0) {
    const velocity = this.robots.numbers("qvel", robot);
    velocity[0] += x;
    velocity[1] += y;
    velocity[5] += yaw;
  }

  /** Drives a robot by hand with an action, until it is null. */
  drive(robot, action) {
    if (action === null) this.manual.delete(robot);
    else this.manual.set(robot, action);
  }

  /** Counts episodes from now on. */
  resetCounters() {
    this.episodes = 0;
    this.successes = 0;
  }
}

/** What a visitor may change, by name: the success radius [m], the largest speed [m/s], a factor on the friction. */
class Knobs {
  #settings;
  #maxSpeed;

  constructor(settings, meta) {
    this.#settings = settings;
    this.#maxSpeed = meta.max_speed;
  }

  get successRadius() {
    return this.#settings[0];
  }

  set successRadius(radius) {
    this.#settings[0] = radius;
  }

  get maxSpeed() {
    return this.#settings[1] * this.#maxSpeed;
  }

  set maxSpeed(speed) {
    this.#settings[1] = Math.min(1, speed / this.#maxSpeed);
  }

  get friction() {
    return this.#settings[2];
  }

  set friction(factor) {
    this.#settings[2] = factor;
  }
}

/** The cameras of a fleet: the newest images of each robot, stacked along the channels as the policy reads them. */
class Eyes {
  constructor(fleet) {
    const { memory, meta, count } = fleet, { height, width, channels, frames, shared, table } = meta.image;
    this.fleet = fleet;
    this.size = height * width * channels * frames;
    this.bytes = new Uint8Array(count * this.size);
    this.shared = memory.array(count * shared);
    this.table = memory.array((floatsOf(table).length));
    this.table.view.set(floatsOf(table));
    this.rendered = memory.array(Math.ceil((count * height * width * channels) / 4), Uint32Array);
  }

  /** Renders the images of some robots, from the first one on, and returns their bytes. */
  #render(first, count) {
    const { robots, meta } = this.fleet, { shared, table, rendered } = this, { height, width, channels } = meta.image;
    robots.call("frame", robots.words.address + 4 * first * robots.about.words, shared.address, count);
    robots.call("image", shared.address, table.address, rendered.address, count);
    return new Uint8Array(rendered.memory.buffer, rendered.address, count * height * width * channels);
  }

  /** Renders the images of all robots; those that begin an episode have copies of the first one. */
  look(begins) {
    const { count, meta } = this.fleet, { channels, frames } = meta.image, stacked = channels * frames;
    const { bytes, size } = this, images = this.#render(0, count);
    if (frames === 1) return void bytes.set(images);
    for (let robot = 0, from = 0; robot < count; robot++) {
      const first = begins[robot] ? 0 : stacked - channels, end = (robot + 1) * size;
      for (let to = robot * size; to < end; to += stacked, from += channels) {
        for (let i = 0; i < first; i++) bytes[to + i] = bytes[to + i + channels];
        for (let i = first; i < stacked; i++) bytes[to + i] = images[from + (i % channels)];
      }
    }
  }

  /** Renders a robot's image, whose bytes stay until the next one is rendered. */
  newest(robot) {
    return this.#render(robot, 1);
  }
}
