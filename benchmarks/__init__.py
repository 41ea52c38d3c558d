"""Measure speed, learning and reliability of jetbot_mjx.

`steps_per_second.py` measures the rates. `throughput/` holds the other measurements of speed,
`learning/` what trainings reach, `reliability/` what must survive and stay bit-identical,
`harness/` what these share, and `results/` the measured numbers. README.md explains their use.
"""

from pathlib import Path

from jetbot_mjx.startup import install_lazy_imports

# Measure programs that start as the commands do.
install_lazy_imports()

ROOT = Path(__file__).resolve().parents[1]
"""The folder of the repository."""

CONFIGS = ROOT / "configs"

RESULTS = ROOT / "benchmarks" / "results"
