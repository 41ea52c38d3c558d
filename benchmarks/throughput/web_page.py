"""Measure a policy's web page in Chromium: `python benchmarks/throughput/web_page.py`.

The page is that of a run, or of a training by `configs/jetbot_egocentric.yaml` that the command
makes first, and has three policies: untrained, early and final. It is served with a content
security policy as strict as it allows. Measured are its size, the time to its first frame, frames
per second with 64 and 1,024 robots, with and without a training beside them, physics steps per
second of one core, and the time in which a training on the page reaches 95 % of the fixed goals.
Without a GPU, Chromium draws on the processor.
"""

import argparse
import base64
import contextlib
import datetime
import functools
import gzip
import html
import http.server
import json
import os
import re
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness import results
from benchmarks.harness.browser import Tab, open_tab
from benchmarks.harness.processes import run_module
from benchmarks.harness.timing import available_cores
from jetbot_mjx import cli
from jetbot_mjx.deployment import write_web_page
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import load_checkpoint
from jetbot_mjx.runs.run_dir import versions

SIZE = (1280, 720)
ROBOTS = (64, 1024)
AIM = 0.95
LOADS, FRAME_SECONDS, TRAINING_SECONDS = 5, 6.0, 120.0
_EARLY = ("--set", "checkpoint_interval=49_152")
_ALLOWED = ("default-src", "script-src", "style-src", "worker-src")

# The frame after the first that was drawn has it on the screen.
_FIRST_FRAME = """
const wait = () => window.jetbot && jetbot.ready
  ? window.firstFrame = performance.now() : requestAnimationFrame(wait);
requestAnimationFrame(wait);
"""

_FRAMES = """
new Promise((resolve) => {
  let frames = -1, begin;
  const count = (now) => {
    begin ??= now;
    frames++;
    if (now - begin < 1000 * SECONDS) requestAnimationFrame(count);
    else resolve([1000 * frames / (now - begin), jetbot.app.simulation.pace]);
  };
  requestAnimationFrame(count);
})
"""

# Robots under commands of ±1, as trained policies give them, without a policy.
_STEPS = """
(() => {
  const { robots, count } = jetbot.fleet, rates = [];
  const actions = Float32Array.from({ length: 64 * robots.actions.length },
    () => Math.random() < 0.5 ? -1 : 1);
  for (let repeat = 0; repeat < 7; repeat++) {
    const begin = performance.now();
    let steps = 0;
    while (performance.now() < begin + 1000) {
      const first = (steps >> 3) % 64 * robots.actions.length;
      robots.actions.view.set(actions.subarray(first, first + robots.actions.length));
      robots.step();
      steps++;
    }
    rates.push(1000 * steps * count / (performance.now() - begin));
  }
  return rates.slice(1);
})()
"""


def train_run(folder: Path) -> Path:
    """Train by the configuration that the docs' page shows, and keep an early checkpoint."""
    run_module("train", ["jetbot_egocentric", "--run-dir", str(folder), *_EARLY])
    return folder


def security_policy(page: str) -> str:
    """Return the strictest header under which a page works, from what it states itself."""
    (stated,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    directives = [one.strip() for one in html.unescape(stated).split(";")]
    return "; ".join(one for one in directives if one.partition(" ")[0] in _ALLOWED)


@contextlib.contextmanager
def served(page: Path) -> Iterator[str]:
    """Serve a page with its strict policy; yield its address."""
    policy = security_policy(page.read_text("utf-8"))

    class Handler(http.server.SimpleHTTPRequestHandler):
        def end_headers(self) -> None:
            self.send_header("Content-Security-Policy", policy)
            super().end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    serve = functools.partial(Handler, directory=str(page.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/{page.name}"
        finally:
            server.shutdown()


def sizes(page: Path) -> dict[str, int]:
    """Return bytes of a page, compressed, and of its engine: module and scripts, compressed."""
    text = page.read_text("utf-8")
    data, *scripts = re.findall(r"<script[^>]*>(.*?)</script>", text, re.DOTALL)
    module = base64.b64decode(json.loads(data)["module"])
    return {
        "bytes": page.stat().st_size,
        "gzip_bytes": len(gzip.compress(text.encode())),
        "engine_gzip_bytes": len(gzip.compress(module + scripts[0].encode())),
        "module_bytes": len(module),
        "policies": len(json.loads(data)["policies"]),
    }


def load(tab: Tab, page: str) -> float:
    """Open a page; return the time from the request to its first frame [s]."""
    tab.open("about:blank", *SIZE)
    tab.open(page, *SIZE)
    tab.wait_for("window.firstFrame > 0")
    return tab.run("firstFrame") / 1000


def frames(tab: Tab, robots: int) -> tuple[float, float]:
    """Return frames per second, and the share of real time that the robots keep up with."""
    tab.run(f"document.querySelector('input[name=count][value=\"{robots}\"]').click()")
    time.sleep(3)
    return tuple(tab.run(_FRAMES.replace("SECONDS", str(FRAME_SECONDS))))


def train(tab: Tab, page: str, seed: int) -> dict[str, float]:
    """Train on a page until the aim; return the seconds since the click, and what it learnt in."""
    load(tab, page)
    tab.run(f"document.getElementById('seed').value = {seed}")
    begin = time.monotonic()
    tab.run("document.getElementById('start').click()")
    reached = f"(jetbot.learner?.latest?.success ?? 0) >= {AIM}"
    tab.wait_for(reached, TRAINING_SECONDS)
    seconds = time.monotonic() - begin
    latest = "(({ steps, seconds, success }) => ({ steps, seconds, success }))"
    told = tab.run(f"{latest}(jetbot.learner.latest)")
    learning = {"steps": told["steps"], "learning_seconds": told["seconds"]}
    return {"seed": seed, "seconds": seconds, **learning, "success": told["success"]}


def measure(tab: Tab, page: str, n_substeps: int, seeds: int) -> dict[str, Any]:
    """Measure all of a page but its size."""
    tab.send("Page.addScriptToEvaluateOnNewDocument", source=_FIRST_FRAME)
    loads = [load(tab, page) for _ in range(LOADS)]
    rates = []
    for training in (False, True):
        load(tab, page)
        if training:
            tab.run("document.getElementById('start').click()")
            tab.wait_for("jetbot.learner?.latest?.steps > 0")
        for robots in ROBOTS:
            per_second, pace = frames(tab, robots)
            row = {"robots": robots, "training": training}
            rates.append({**row, "frames_per_second": per_second, "real_time": pace})
    load(tab, page)
    tab.run("jetbot.app.setPaused(true)")
    tab.run("jetbot.app.setCount(1024, 0)")
    steps = [n_substeps * rate for rate in tab.run(_STEPS)]
    trainings = [train(tab, page, seed) for seed in range(seeds)]
    return {
        "browser": tab.send("Browser.getVersion")["product"],
        "first_frame_seconds": {"median": statistics.median(loads), "repeats": loads},
        "frames": rates,
        "physics_steps_per_second": {"median": statistics.median(steps), "repeats": steps},
        "training": {
            "median_seconds": statistics.median(one["seconds"] for one in trainings),
            "runs": trainings,
        },
        "console_errors": len(tab.errors),
    }


def summarize(values: dict[str, Any]) -> str:
    """Return the measured values as lines for the terminal."""
    size, training = values["size"], values["training"]
    lines = [
        f"{size['policies']} policies: {size['bytes'] / 1e6:.2f} MB,"
        f" {size['gzip_bytes'] / 1e3:.0f} kB compressed,"
        f" of which the engine {size['engine_gzip_bytes'] / 1e3:.0f} kB",
        f"first frame after {values['first_frame_seconds']['median']:.2f} s",
        *(
            f"{one['robots']:5,} robots{', training' if one['training'] else '':10}"
            f" {one['frames_per_second']:5.1f} frames/s, {one['real_time']:.2f} × real time"
            for one in values["frames"]
        ),
        f"{values['physics_steps_per_second']['median'] / 1e6:.2f} M physics steps/s on one core",
        f"{AIM:.0%} of the goals after {training['median_seconds']:.1f} s: "
        + ", ".join(f"{one['seconds']:.1f} s" for one in training["runs"]),
        f"console errors: {values['console_errors']}",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, measure and write the file of results.

    Returns:
      0; 1 if the page's console reported errors; 2 after an error that the user can correct.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", nargs="?", help="a run folder; default: a new training")
    parser.add_argument("--seeds", type=cli.positive_int, default=5, help="default: 5")
    parser.add_argument(
        "--output", type=Path, help="default: results/web-page-<device>.json, none of a run folder"
    )
    options = parser.parse_args(arguments)
    try:
        stored = results.default_output("web-page-")
        output = results.output_for(options.output, stored, is_own=options.run is not None)
        results.check_output(output)
        with tempfile.TemporaryDirectory() as folder, open_tab() as tab:
            run = options.run or train_run(Path(folder, "jetbot_egocentric"))
            n_substeps = load_checkpoint(run).config.physics.n_substeps
            page = write_web_page(run, Path(folder, "page.html")).path
            load_before = os.getloadavg()[0]
            with served(page) as address:
                measured = measure(tab, address, n_substeps, options.seeds)
            values = {
                "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
                "cpu_cores": available_cores(),
                "load_before": load_before,
                "nice": os.nice(0),
                "run": Path(run).name,
                "versions": versions(),
                "canvas": SIZE,
                "size": sizes(page),
                **measured,
            }
        print(summarize(values))
        results.write(output, values)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return int(values["console_errors"] > 0)


if __name__ == "__main__":
    sys.exit(main())
