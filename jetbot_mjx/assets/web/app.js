// The user interface: who drives, how many robots, what is seen, and a training in the page.

const COUNTS = [1, 16, 64, 256, 1024], FIRST_COUNT = 16;
const RATES = [[0.25, "¼×"], [1, "1×"], [4, "4×"]];
const FLEET_SEED = 1;
const STEP_BUDGET = 22; // milliseconds of a frame that may go into steps
const KEPT = 0.98; // share of the frames before in what is told of the pace
const PANEL_SECONDS = 0.12; // between two updates of the numbers
const AIM = 0.95; // the dashed line of the curve
const PUSH_SPEED = 1.2; // m/s
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;

const byId = (id) => document.getElementById(id);

/** Sets an element's text where it has changed. */
function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Returns a new element with attributes and children. */
function make(tag, attributes = {}, ...children) {
  const svg = ["path", "line", "text"].includes(tag);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Says something to screen readers. */
function announce(text) {
  byId("announcer").textContent = text;
}

const percent = (share) => `${(100 * share).toFixed(1)} %`;

/** Returns a number of steps as people write it: 131 k, 2.6 M. */
function shortCount(count) {
  if (count >= 1e6) return `${(count / 1e6).toFixed(1)} M`;
  return count >= 1000 ? `${Math.round(count / 1000)} k` : `${count}`;
}

/** Robots in real time, with whoever drives them. */
class Simulation {
  constructor(engine, data, scene) {
    Object.assign(this, { engine, data, scene, rate: 1, paused: reducedMotion, backlog: 0, chosen: 0, lately: { made: 0, wanted: 0 } });
    this.policies = data.policies.map(policyOf);
    this.driver = { kind: "policy", index: this.policies.length - 1 };
    this.learned = null; // the newest policy of a training
    this.hand = new Float32Array(2); // the action of whoever drives by hand
    this.byHand = false;
    this.knobs = {}; // what the visitor changed
    this.touched = new Set(); // robots in whose episode the visitor moved the goal, pushed or drove
  }

  setCount(count) {
    this.fleet = this.engine.fleet(count, FLEET_SEED);
    Object.assign(this.fleet.knobs, this.knobs);
    const half = Math.sqrt(count) >> 1;
    this.chosen = half * Math.ceil(Math.sqrt(count)) + half; // in the middle
    this.touched.clear();
    this.scene.setFleet(this.fleet);
    this.setDriver(this.driver);
    this.takeWheel(this.byHand);
  }

  /** Lets a policy, the scripted driver or the newest policy of a training drive. */
  setDriver(driver) {
    const { fleet } = this;
    this.driver = driver;
    if (driver.kind === "policy") fleet.drivenBy(this.policies[driver.index]);
    else fleet.drivenBy(driver.kind === "learning" ? this.learned : null);
    fleet.scripted = driver.kind === "scripted";
    this.resetCounters();
  }

  /** Takes a newer policy of the training; the goals that the visitor reached still count. */
  refresh() {
    this.fleet.drivenBy(this.learned);
  }

  setKnob(name, value) {
    this.knobs[name] = value;
    this.fleet.knobs[name] = value;
    this.resetCounters();
  }

  resetCounters() {
    this.fleet.resetCounters();
    this.mine = { episodes: 0, successes: 0 }; // by hand
    this.others = { episodes: 0, successes: 0 }; // touched
  }

  /** Chooses a robot. Whoever drives by hand drives that one. */
  choose(robot) {
    this.fleet.drive(this.chosen, null);
    this.chosen = robot;
    this.takeWheel(this.byHand);
  }

  /** Lets the visitor drive the chosen robot, or its policy again. */
  takeWheel(byHand) {
    this.byHand = byHand;
    this.hand.set([-1, 0]);
    this.fleet.drive(this.chosen, byHand ? this.hand : null);
    if (byHand) this.touched.add(this.chosen);
  }

  /** Whether the task lets a visitor move a goal. */
  get movesGoals() {
    return this.data.meta.robot_functions.functions.includes("move");
  }

  setGoal(robot, x, y) {
    if (!this.movesGoals) return;
    this.fleet.setGoal(robot, x, y);
    this.touched.add(robot);
    this.scene.refreshGoal(robot);
  }

  /** Pushes a robot sideways, and turns it. */
  push(robot) {
    const angle = Math.random() * 2 * Math.PI, spin = Math.random() < 0.5 ? -6 : 6;
    this.fleet.push(robot, PUSH_SPEED * Math.cos(angle), PUSH_SPEED * Math.sin(angle), spin);
    this.touched.add(robot);
  }

  /** Makes the steps that belong to some seconds of real time, but for those that take too long. */
  advance(seconds) {
    if (this.paused) return;
    const { dt } = this.data.meta, end = performance.now() + STEP_BUDGET, wanted = seconds * this.rate;
    this.backlog += wanted;
    let made = 0;
    while (this.backlog >= dt) {
      this.step();
      made += dt;
      this.backlog -= dt;
      if (performance.now() < end) continue;
      this.backlog = Math.min(this.backlog, dt);
      break;
    }
    this.lately = { made: KEPT * this.lately.made + made, wanted: KEPT * this.lately.wanted + wanted };
  }

  /** How much of the time that should have passed lately has passed, up to 1. */
  get pace() {
    const { made, wanted } = this.lately;
    return wanted > 0 ? Math.min(1, made / wanted) : 1;
  }

  step() {
    const { fleet, touched, mine, others } = this;
    fleet.step();
    for (const robot of touched) {
      if (!fleet.done[robot]) continue;
      const driven = this.byHand && robot === this.chosen;
      for (const counter of driven ? [others, mine] : [others]) {
        counter.episodes++;
        counter.successes += fleet.success[robot];
      }
      if (!driven) touched.delete(robot);
    }
    this.scene.record();
  }

  /** How much of the way to the next step has passed. */
  get share() {
    return Math.min(1, this.backlog / this.data.meta.dt);
  }

  /** Goals reached without the visitor, and the episodes of these robots. */
  get score() {
    const { fleet, others } = this;
    return { successes: fleet.successes - others.successes, episodes: fleet.episodes - others.episodes };
  }
}

/** Mouse and touch on the canvas: turn, move and zoom the view, drag goals, choose and push robots. */
class Gestures {
  constructor(canvas, scene, simulation, choose) {
    Object.assign(this, { canvas, scene, simulation, choose, mode: null, dragged: 0, moved: 0 });
    this.pointers = new Map();
    const listen = (name, action, options) => canvas.addEventListener(name, action, options);
    listen("pointerdown", (event) => this.#down(event));
    listen("pointermove", (event) => this.#move(event));
    listen("pointerup", (event) => this.#up(event, true));
    listen("pointercancel", (event) => this.#up(event, false));
    listen("contextmenu", (event) => event.preventDefault());
    listen("wheel", (event) => this.#wheel(event), { passive: false });
  }

  #down(event) {
    const { pointers, canvas, scene } = this, { clientX: x, clientY: y } = event;
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x, y });
    scene.camera.stop();
    if (pointers.size === 2) this.mode = "pinch";
    if (pointers.size !== 1) return;
    const hit = scene.pick(x, y, event.pointerType === "touch" ? 30 : 16);
    this.moved = 0;
    this.hit = hit;
    if (hit?.goal && event.button === 0 && this.simulation.movesGoals) {
      this.mode = "goal";
      this.choose(hit.robot);
    } else this.mode = event.button === 0 && !event.shiftKey ? "orbit" : "pan";
    this.#look();
  }

  #move(event) {
    const { pointers, scene } = this, pointer = pointers.get(event.pointerId), { clientX: x, clientY: y } = event;
    if (!pointer) return this.#look(scene.pick(x, y));
    const before = { ...pointer }, { camera } = scene;
    this.moved += Math.hypot(x - pointer.x, y - pointer.y);
    Object.assign(pointer, { x, y });
    if (this.mode === "goal") this.#dragGoal(x, y);
    else if (this.mode === "pan") camera.pan(before.x, before.y, x, y);
    else if (this.mode === "orbit" && this.moved > 4) camera.orbit(x - before.x, y - before.y);
    else if (this.mode === "pinch") this.#pinch(pointer, before);
  }

  #dragGoal(x, y) {
    const { scene, simulation, hit } = this, place = scene.place(hit.robot, x, y, 0.05);
    if (place) simulation.setGoal(hit.robot, ...place);
  }

  /** Zooms and moves with two fingers, of which one has moved. */
  #pinch(pointer, before) {
    const other = [...this.pointers.values()].find((one) => one !== pointer), { camera } = this.scene;
    if (!other) return;
    const middle = (one) => [(one.x + other.x) / 2, (one.y + other.y) / 2];
    const gap = (one) => Math.max(10, Math.hypot(one.x - other.x, one.y - other.y));
    camera.pan(...middle(before), ...middle(pointer));
    camera.zoom(gap(before) / gap(pointer), ...middle(pointer));
  }

  #up(event, complete) {
    const { clientX: x, clientY: y } = event, single = this.pointers.size === 1;
    this.pointers.delete(event.pointerId);
    if (complete && single && this.moved < 6 && this.mode === "orbit") this.#tap(x, y);
    if (this.pointers.size === 0) this.mode = null;
    this.#look();
  }

  /** Chooses a robot, pushes the one that is chosen, or moves its goal to a place on the floor. */
  #tap(x, y) {
    const { simulation, scene, hit } = this, { chosen } = simulation;
    if (hit && hit.robot === chosen) simulation.push(chosen);
    else if (hit) this.choose(hit.robot);
    else {
      const place = scene.place(chosen, x, y), [, farthest] = scene.meta.goal_range;
      if (place && Math.hypot(...place) < 2.5 * farthest) simulation.setGoal(chosen, ...place);
    }
  }

  #wheel(event) {
    event.preventDefault();
    this.scene.camera.stop();
    const lines = event.deltaMode === 1 ? 24 : 1;
    this.scene.camera.zoom(Math.exp(event.deltaY * lines * 0.0012), event.clientX, event.clientY);
  }

  /** Shows by the cursor what a press would do. */
  #look(hit = this.hit) {
    const drags = this.mode === "goal" || this.mode === "pan";
    const name = drags ? "drag" : hit ? (hit.goal && this.simulation.movesGoals ? "grab" : "point") : "";
    if (this.canvas.className !== name) this.canvas.className = name;
  }
}

/** Driving by hand: arrow keys, WASD and the stick give the share of the full speed and of the full turn. */
class Hand {
  static KEYS = {
    ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0],
    ArrowLeft: [0, 0.75], KeyA: [0, 0.75], ArrowRight: [0, -0.75], KeyD: [0, -0.75],
  };

  constructor(simulation, take) {
    Object.assign(this, { simulation, take, stick: null, speed: 0, turn: 0 });
    this.pressed = new Set();
    addEventListener("keydown", (event) => this.#key(event, true));
    addEventListener("keyup", (event) => this.#key(event, false));
    addEventListener("blur", () => this.pressed.clear());
    this.#listenToStick(byId("stick"));
  }

  #key(event, down) {
    if (!(event.code in Hand.KEYS)) return;
    if (!down) return void this.pressed.delete(event.code);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("input")) return;
    event.preventDefault();
    this.pressed.add(event.code);
    this.take(true);
  }

  #listenToStick(element) {
    const knob = element.firstElementChild, reach = 38;
    const place = (x, y) => {
      knob.style.transform = `translate(${x}px, ${y}px)`;
    };
    const move = (event) => {
      if (!element.hasPointerCapture(event.pointerId)) return;
      const box = element.getBoundingClientRect();
      let x = event.clientX - box.left - box.width / 2, y = event.clientY - box.top - box.height / 2;
      const length = Math.hypot(x, y), share = length > reach ? reach / length : 1;
      [x, y] = [x * share, y * share];
      place(x, y);
      this.stick = [Math.max(0, -y / reach), -x / reach];
    };
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      move(event);
    });
    element.addEventListener("pointermove", move);
    element.addEventListener("lostpointercapture", () => {
      this.stick = null;
      place(0, 0);
    });
  }

  /** Moves the action towards what is pressed. An action of -1, 0 stands still. */
  update(seconds) {
    if (!this.simulation.byHand) return void Object.assign(this, { speed: 0, turn: 0 });
    let speed = 0, turn = 0;
    if (this.stick) [speed, turn] = this.stick;
    for (const code of this.pressed) {
      speed += Hand.KEYS[code][0];
      turn += Hand.KEYS[code][1];
    }
    const ease = Math.min(1, 9 * seconds);
    this.speed += ease * (Math.min(1, Math.max(0, speed)) - this.speed);
    this.turn += ease * (Math.min(1, Math.max(-1, turn)) - this.turn);
    this.simulation.hand[0] = 2 * this.speed - 1;
    this.simulation.hand[1] = this.turn;
  }
}

/** What the chosen robot observes and does. */
class RobotPanel {
  constructor(meta) {
    this.meta = meta;
    this.fields = RobotPanel.#fields(meta.observation).map((field) => ({ ...field, value: this.#row(field) }));
    const actions = meta.export.spec.action;
    this.meters = actions.map(({ name }) => this.#meter(name));
    if (meta.image) this.#prepareImage(meta.image);
  }

  /** Returns the observation's vectors and numbers, each with `name`, `unit`, `start` and `size`. */
  static #fields(observation) {
    const fields = [];
    for (const [start, { name, unit }] of observation.entries()) {
      const base = name.replace(/ \d+$/, "").replaceAll("_", " "), last = fields[fields.length - 1];
      if (last?.name === base) last.size++;
      else fields.push({ name: base, unit, start, size: 1 });
    }
    return fields;
  }

  #row({ name, unit }) {
    const value = make("td");
    byId("observation").append(make("tr", {}, make("th", { scope: "row" }, name), value, make("td", {}, unit === "1" ? "" : unit)));
    return value;
  }

  #meter(name) {
    const fill = make("i"), output = make("output");
    byId("action").append(make("div", { class: "meter" }, make("span", {}, name), make("span", { class: "centre" }, fill), output));
    return { fill, output };
  }

  #prepareImage({ width, height }) {
    const canvas = byId("sees");
    Object.assign(canvas, { width, height, hidden: false });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `The camera image of the chosen robot, ${width} by ${height} pixels`);
    this.context = canvas.getContext("2d");
    this.pixels = this.context.createImageData(width, height);
    this.pixels.data.fill(255);
  }

  update({ fleet, chosen }) {
    write(byId("chosen"), fleet.count > 1 ? `robot ${chosen + 1}` : "");
    if (!byId("robot").open) return;
    const observation = fleet.observation(chosen), action = fleet.action(chosen);
    for (const { value, start, size } of this.fields) {
      const numbers = Array.from(observation.subarray(start, start + size), (x) => RobotPanel.#signed(x, 2));
      write(value, numbers.join(", "));
    }
    const { max_yaw_rate: yaw } = this.meta, speed = this.meta.max_speed === null ? null : fleet.knobs.maxSpeed;
    const units = [`${((Math.max(-1, action[0]) + 1) / 2 * speed).toFixed(2)} m/s`, yaw === null ? "" : `${RobotPanel.#signed(action[1] * yaw, 2)} rad/s`];
    const shown = speed === null ? Array.from(action, (x) => RobotPanel.#signed(x, 2)) : units;
    for (const [i, { fill, output }] of this.meters.entries()) {
      fill.style.left = `${50 + 50 * Math.min(0, action[i])}%`;
      fill.style.width = `${50 * Math.abs(action[i])}%`;
      write(output, shown[i]);
    }
    if (this.context) this.#drawImage(fleet.image(chosen));
  }

  static #signed(x, digits) {
    const text = Math.abs(x).toFixed(digits);
    return `${x < 0 && Number(text) > 0 ? "−" : "+"}${text}`;
  }

  #drawImage(image) {
    const { data } = this.pixels, { channels } = this.meta.image;
    for (let pixel = 0; pixel < data.length / 4; pixel++)
      for (let channel = 0; channel < 3; channel++)
        data[4 * pixel + channel] = image[pixel * channels + Math.min(channel, channels - 1)];
    this.context.putImageData(this.pixels, 0, 0);
  }
}

/** The success rate with its interval. */
class ScorePanel {
  constructor() {
    [this.interval, this.middle] = document.querySelectorAll("#score .bar > *");
  }

  /** Shows goals reached of goals tried; `what` says of which. */
  update(successes, episodes, what) {
    if (episodes === 0) {
      write(byId("rate"), "–");
      write(byId("count"), "no episode has ended yet");
      write(byId("interval"), "");
      this.#draw(0, 0, 0);
      return;
    }
    const share = successes / episodes, [low, high] = wilson(successes, episodes);
    write(byId("rate"), percent(share));
    write(byId("count"), `${successes.toLocaleString("en")} of ${episodes.toLocaleString("en")} ${what}`);
    write(byId("interval"), `95 % interval ${(100 * low).toFixed(1)}–${(100 * high).toFixed(1)} %`);
    this.#draw(share, low, high);
  }

  #draw(share, low, high) {
    this.middle.hidden = high === 0;
    this.interval.style.left = `${100 * low}%`;
    this.interval.style.width = `${100 * (high - low)}%`;
    this.middle.style.left = `${100 * share}%`;
  }
}

/** The curve of a training: success by environment steps, with its interval. */
class Curve {
  constructor(element) {
    Object.assign(this, { element, points: [] });
    this.draw();
  }

  draw() {
    const { element, points } = this, { width, height } = element.getBoundingClientRect();
    if (width === 0) return;
    const left = 34, right = width - 12, top = 6, bottom = height - 18;
    const end = Math.max(200000, ...points.map((point) => point.steps));
    const x = (steps) => (left + ((right - left) * steps) / end).toFixed(1);
    const y = (share) => (bottom - (bottom - top) * Math.min(1, Math.max(0, share))).toFixed(1);
    const line = (share, name) => make("line", { x1: left, x2: right, y1: y(share), y2: y(share), class: name });
    const label = (text, at, anchor) => make("text", { x: at[0], y: at[1], "text-anchor": anchor }, text);
    element.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const path = (key) => points.map((point) => `${x(point.steps)},${y(point[key])}`);
    const parts = [0, 0.5, 1].map((share) => line(share, "grid"));
    parts.push(line(AIM, "aim"));
    for (const share of [0, 0.5, 1]) parts.push(label(`${100 * share} %`, [left - 5, Number(y(share)) + 4], "end"));
    for (const part of [0, 0.5, 1])
      parts.push(label(part ? shortCount(part * end) : "0 steps", [x(part * end), height - 3], ["start", "middle", "end"][2 * part]));
    if (points.length > 1) {
      parts.push(make("path", { class: "band", d: `M${path("high").join("L")}L${path("low").reverse().join("L")}Z` }));
      parts.push(make("path", { class: "line", d: `M${path("success").join("L")}` }));
    }
    element.replaceChildren(...parts);
  }
}

/** Training from scratch. */
class TrainPanel {
  /**
   * @param {object} data what the page was made of
   * @param {Simulation} simulation the robots
   * @param {() => void} onpolicy called with each new policy
   */
  constructor(data, simulation, onpolicy) {
    Object.assign(this, { data, simulation, onpolicy, learner: null, running: false, reachedAim: "" });
    const reason = data.meta.no_learner;
    byId("learner").hidden = reason !== null;
    byId("curve").setAttribute("hidden", "");
    byId("no-learner").hidden = reason === null;
    byId("train").open = reason === null;
    if (reason !== null) return write(byId("no-learner"), `No training here, which needs the fused update: ${reason}.`);
    this.curve = new Curve(byId("curve"));
    byId("train").addEventListener("toggle", () => this.curve.draw());
    byId("start").addEventListener("click", () => this.#toggle());
    byId("stop").addEventListener("click", () => this.#stop("The training was stopped."));
    byId("download").addEventListener("click", () => this.#download());
  }

  #toggle() {
    if (!this.learner) this.#begin();
    this.running = !this.running;
    if (this.running) this.learner.start();
    else this.learner.pause();
    this.#show();
  }

  #begin() {
    const seed = Math.min(2147483647, Math.max(0, Math.trunc(Number(byId("seed").value)) || 0));
    byId("seed").value = seed;
    this.learner = new Learner(this.data, { seed });
    this.learner.onprogress = (progress) => this.#progress(progress);
    this.learner.onerror = (message) => this.#fail(message);
    this.curve.points = [];
    byId("curve").removeAttribute("hidden");
    this.curve.draw();
    this.reachedAim = "";
    write(byId("aim"), "");
    this.takeKnobs();
    announce(`Training from scratch with seed ${seed} has begun.`);
  }

  /** Lets the training go on with what the visitor changed. */
  takeKnobs() {
    if (this.learner) this.learner.setKnobs([...this.simulation.fleet.robots.settings]);
  }

  #progress(progress) {
    const { steps, success, interval, seconds, policy, finished } = progress;
    this.curve.points.push({ steps, success, low: interval[0], high: interval[1] });
    this.curve.draw();
    if (success >= AIM && !this.reachedAim) {
      this.reachedAim = `${100 * AIM} % first reached after ${shortCount(steps)} steps, ${seconds.toFixed(1)} s`;
      announce(`The training reaches ${percent(success)} of its goals after ${steps} steps and ${seconds.toFixed(0)} seconds.`);
    }
    this.simulation.learned = policy;
    this.onpolicy();
    if (finished) this.#stop("The training has made all of its steps.");
    else this.#show();
  }

  #fail(message) {
    if (!this.learner) return;
    this.#stop("The training has failed.");
    write(byId("progress"), `The training ended with an error: ${message}`);
  }

  /** Ends the training, whose policy stays, and says why. */
  #stop(reason) {
    this.learner.stop();
    this.ended = this.learner;
    this.learner = null;
    this.running = false;
    this.#show();
    announce(reason);
  }

  #show() {
    const { learner, running } = this, { latest } = this.current ?? {};
    write(byId("start"), running ? "Pause" : learner ? "Continue" : this.ended ? "Start anew" : "Start");
    byId("start").classList.toggle("main", !running);
    byId("stop").disabled = !learner;
    byId("download").disabled = !latest;
    byId("seed").disabled = Boolean(learner);
    write(byId("training"), running ? "learning" : learner ? "paused" : latest?.finished ? "finished" : "");
    if (!latest) return write(byId("progress"), learner ? "Loading …" : "Stopped before the first result.");
    const { steps, seconds, success } = latest;
    write(byId("progress"), `${percent(success)} · ${shortCount(steps)} steps · ${seconds.toFixed(1)} s`);
    write(byId("aim"), this.reachedAim);
  }

  /** The training that runs or ran last. */
  get current() {
    return this.learner ?? this.ended;
  }

  #download() {
    for (const [name, text] of Object.entries(this.current.download())) {
      const address = URL.createObjectURL(new Blob([text], { type: "application/octet-stream" }));
      make("a", { href: address, download: name }).click();
      setTimeout(() => URL.revokeObjectURL(address), 10000);
    }
  }
}

/** The page. */
class App {
  constructor(data, engine) {
    const { meta } = data;
    this.canvas = byId("view");
    this.scene = new Scene(this.canvas, meta);
    this.scene.ratio = Math.min(2, devicePixelRatio);
    this.simulation = new Simulation(engine, data, this.scene);
    this.meta = meta;
    this.frames = { last: 0, panel: 0, interval: 16, count: 0, since: 0, rate: 0 };
    this.ready = false;
    this.#makeChoices(data);
    this.#makeKnobs();
    this.robotPanel = new RobotPanel(meta);
    this.scorePanel = new ScorePanel();
    for (const id of ["panel", "bar"]) byId(id).hidden = false;
    this.trainPanel = new TrainPanel(data, this.simulation, () => this.#learned());
    this.hand = new Hand(this.simulation, (byHand) => this.setManual(byHand));
    new Gestures(this.canvas, this.scene, this.simulation, (robot) => this.choose(robot));
    this.#listen();
    const { trained } = meta, share = trained.success === null ? "" : ` to ${percent(trained.success)}`;
    write(byId("title"), meta.title);
    write(byId("about"), `robot ${meta.robot} · trained for ${shortCount(trained.steps)} steps${share}`);
    this.setFolded(innerWidth < 740);
    this.setTrails(!reducedMotion);
    this.setPaused(reducedMotion);
    this.setCount(FIRST_COUNT, 0);
    requestAnimationFrame((now) => this.#frame(now));
  }

  /** Makes a group of choices. */
  #choices(parent, name, entries, chosen, action) {
    for (const [value, text, small] of entries) {
      const input = make("input", { type: "radio", name, value });
      input.checked = value === chosen;
      input.addEventListener("change", () => action(value));
      const label = make("span", {}, text, ...(small ? [make("small", {}, small)] : []));
      parent.append(make("label", {}, input, label));
    }
  }

  #makeChoices({ policies }) {
    const drivers = policies.map(({ name, env_steps: steps }, index) =>
      [`policy ${index}`, name[0].toUpperCase() + name.slice(1), `${shortCount(steps)} steps`]);
    // A drive that is a function of its own has no speed and no yaw rate that others could command.
    if (this.meta.max_speed !== null) drivers.push(["scripted", "Scripted", "no network"]);
    byId("manual").hidden = this.meta.max_speed === null;
    byId("move-goals").hidden = !this.simulation.movesGoals;
    drivers.push(["learning", "Learning", "in this page"]);
    this.#choices(byId("drivers"), "driver", drivers, `policy ${policies.length - 1}`, (name) => this.setDriver(name));
    this.learning = document.querySelector("input[value=learning]");
    this.learning.disabled = true;
    const counts = COUNTS.map((count) => [count, count.toLocaleString("en")]);
    this.#choices(byId("counts"), "count", counts, FIRST_COUNT, (count) => this.setCount(count, 0.6));
    this.#choices(byId("rates"), "rate", RATES, 1, (rate) => (this.simulation.rate = rate));
  }

  #makeKnobs() {
    const { success_radius: radius, max_speed: speed, robot_functions: functions } = this.meta;
    byId("knobs").hidden = functions.knobs.length === 0;
    const knobs = [
      ["successRadius", "success_radius", "Success radius", radius, 0.2 * radius, 3 * radius, (x) => `${x.toFixed(2)} m`],
      ["maxSpeed", "speed", "Speed limit", speed, 0.1 * speed, speed, (x) => `${x.toFixed(2)} m/s`],
      ["friction", "friction", "Friction", 1, 0.05, 2, (x) => `× ${x.toFixed(2)}`],
    ];
    for (const [name, knob, text, initial, low, high, format] of knobs) {
      if (!functions.knobs.includes(knob)) continue;
      const input = make("input", { type: "range", min: low, max: high, step: "any", value: initial });
      const output = make("output", {}, format(initial));
      input.addEventListener("input", () => {
        this.simulation.setKnob(name, Number(input.value));
        this.trainPanel.takeKnobs();
        write(output, format(Number(input.value)));
      });
      byId("knobs").lastElementChild.append(make("label", { class: "slider" }, make("span", {}, text), output, input));
    }
  }

  #listen() {
    const click = (id, action) => byId(id).addEventListener("click", action);
    click("pause", () => this.setPaused(!this.simulation.paused));
    click("trails", () => this.setTrails(!this.scene.showTrails));
    click("push", () => this.simulation.push(this.simulation.chosen));
    click("manual", () => this.setManual(!this.simulation.byHand));
    click("fold", () => this.setFolded(!document.body.classList.contains("folded")));
    // After a click the arrow keys drive again; with the keyboard the focus stays.
    byId("panel").addEventListener("pointerup", (event) => {
      if (event.target.closest(".choice")) setTimeout(() => this.canvas.focus({ preventScroll: true }));
    });
    addEventListener("keydown", (event) => this.#key(event));
    addEventListener("resize", () => this.#place());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.scene.recolour());
    this.canvas.addEventListener("webglcontextlost", () => fail("The graphics driver has stopped: load the page again."));
  }

  /** Keys beside those that drive: space, P, Escape, N, Q and E, plus and minus. */
  #key(event) {
    if (event.target.closest("input, button, summary") || event.ctrlKey || event.metaKey || event.altKey) return;
    const { simulation, scene } = this, { camera } = scene, middle = [camera.width / 2, camera.height / 2];
    const actions = {
      " ": () => this.setPaused(!simulation.paused),
      p: () => simulation.push(simulation.chosen),
      n: () => this.choose((simulation.chosen + 1) % simulation.fleet.count),
      q: () => camera.orbit(-12, 0),
      e: () => camera.orbit(12, 0),
      "+": () => camera.zoom(0.9, ...middle),
      "-": () => camera.zoom(1.1, ...middle),
      Escape: () => this.setManual(false),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  setPaused(paused) {
    this.simulation.paused = paused;
    byId("pause").setAttribute("aria-pressed", paused);
    byId("pause").setAttribute("aria-label", paused ? "Resume" : "Pause");
    byId("pause-mark").setAttribute("d", paused ? "M7 4l9 6-9 6z" : "M7 4v12M13 4v12");
  }

  setTrails(shown) {
    this.scene.showTrails = shown;
    byId("trails").setAttribute("aria-pressed", shown);
  }

  setManual(byHand) {
    if (byHand === this.simulation.byHand || this.meta.max_speed === null) return;
    this.simulation.takeWheel(byHand);
    byId("manual").setAttribute("aria-pressed", byHand);
    byId("stick").hidden = !byHand;
    byId("badge").hidden = !byHand;
    announce(byHand ? `You drive robot ${this.simulation.chosen + 1}.` : "The policy drives again.");
  }

  setFolded(folded) {
    document.body.classList.toggle("folded", folded);
    byId("fold").setAttribute("aria-expanded", !folded);
    byId("fold-mark").setAttribute("d", folded === innerWidth < 740 ? "M5 12l5-5 5 5" : "M5 8l5 5 5-5");
    this.trainPanel.curve?.draw();
    this.#place();
  }

  setDriver(name) {
    const [kind, index] = name.split(" ");
    this.simulation.setDriver({ kind, index: Number(index) });
    announce(`Driver: ${name.startsWith("policy") ? this.simulation.data.policies[index].name : name}.`);
  }

  /** Shows another number of robots, and moves the camera to them within some seconds. */
  setCount(count, seconds) {
    const { simulation, scene } = this;
    simulation.setCount(count);
    this.#place();
    scene.camera.moveTo(scene.view(), reducedMotion ? 0 : seconds);
    announce(`${count} robots.`);
  }

  choose(robot) {
    if (robot === this.simulation.chosen) return;
    this.simulation.choose(robot);
    announce(`Robot ${robot + 1} is chosen.`);
  }

  /** Lets the newest policy of the training drive where it was chosen; the first one chooses it. */
  #learned() {
    const first = this.learning.disabled;
    this.learning.disabled = false;
    if (first || this.trainPanel.curve.points.length === 1) this.learning.checked = true;
    if (!this.learning.checked) return;
    if (this.simulation.driver.kind === "learning") this.simulation.refresh();
    else this.simulation.setDriver({ kind: "learning" });
  }

  /** Keeps the view in the middle of what the panel leaves free. */
  #place() {
    const { scene } = this, panel = byId("panel").getBoundingClientRect();
    scene.resize();
    const narrow = innerWidth < 740;
    scene.camera.shift = narrow
      ? [0, (innerHeight - panel.top) / innerHeight]
      : [-(innerWidth - panel.left) / innerWidth, 0.04];
  }

  #frame(now) {
    requestAnimationFrame((next) => this.#frame(next));
    const { frames, simulation, scene } = this, seconds = frames.last ? Math.min(0.25, (now - frames.last) / 1000) : 0;
    this.#measure(now);
    this.hand.update(seconds);
    simulation.advance(seconds);
    scene.camera.ease(seconds);
    scene.draw(simulation.share, simulation.chosen);
    frames.last = now;
    if (now - frames.panel > 1000 * PANEL_SECONDS) {
      frames.panel = now;
      this.#updatePanels();
    }
    this.ready = true;
  }

  /** Measures the frame rate, and draws fewer pixels, then without samples, where frames take long. */
  #measure(now) {
    const { frames, scene } = this, interval = now - frames.last;
    frames.count++;
    if (now - frames.since >= 1000) {
      frames.rate = (1000 * frames.count) / (now - frames.since);
      Object.assign(frames, { since: now, count: 0 });
    }
    if (interval < 500) frames.interval += 0.1 * (interval - frames.interval);
    if (frames.interval < 30) return;
    frames.interval = 16;
    if (scene.ratio > 1) scene.ratio = 1;
    else scene.samples.on = false;
  }

  #updatePanels() {
    const { simulation, scorePanel, trainPanel } = this, { driver, mine, byHand } = simulation;
    const latest = driver.kind === "learning" ? trainPanel.current?.latest : null;
    if (latest) scorePanel.update(latest.reached, latest.goals, "examined goals");
    else scorePanel.update(simulation.score.successes, simulation.score.episodes, "goals");
    this.robotPanel.update(simulation);
    if (byHand) write(byId("badge"), `You drive robot ${simulation.chosen + 1}: ${mine.successes} of ${mine.episodes} goals`);
    const slower = simulation.pace < 0.93 && !simulation.paused ? ` · ${(simulation.pace * simulation.rate).toFixed(2)}× real time` : "";
    write(byId("scale"), `1 square = 1 m${slower}`);
  }
}

/** Says in one line why the page cannot work. */
function fail(text) {
  byId("failure").hidden = false;
  write(byId("failure"), text);
}

/** Starts the page, and lets tests see inside. */
async function start() {
  try {
    const data = readData();
    const app = new App(data, await Engine.load(data.module, data.meta));
    window.jetbot = {
      fps: () => app.frames.rate,
      get fleet() { return app.simulation.fleet; },
      get learner() { return app.trainPanel.learner; },
      get ready() { return app.ready; },
      app,
    };
  } catch (error) {
    if (!(error instanceof UnsupportedError)) throw error;
    fail(error.message);
  }
}

start();
