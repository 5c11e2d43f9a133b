"""Engine time of this tree against another one, in pairs.

    python benchmarks/bench_paired.py OTHER [--pairs 10] [--runs 200]

OTHER is a commit or the path of a tree. Each measurement is a process of its own that runs an
ensemble of derailments around ``mississauga_published`` and gives the processor time of their
steps; the kernels are compiled before. The trees alternate, and so does which one begins. The
table ends with the mean of the ratio this / other and its one-sided 95 % upper confidence bound
(Student's t on the logarithms).
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent


def ensemble(runs: int) -> float:
    """Processor time of the steps of ``runs`` derailments at different speeds, s."""
    from derail_ros.engine import Simulation
    from derail_ros.scenario import load_scenario_by_name

    params = load_scenario_by_name("mississauga_published").to_params()
    Simulation(params).run()
    spent = 0.0
    for k in range(runs):
        speed = params.initiation.speed * (0.9 + 0.2 * k / runs)
        run = Simulation(replace(params, initiation=replace(params.initiation, speed=speed)))
        began = time.process_time()
        run.advance_to(math.inf)
        spent += time.process_time() - began
    return spent


def measured(tree: Path, runs: int) -> float:
    """``ensemble`` in a process that imports the package from ``tree``."""
    out = subprocess.run(
        [sys.executable, __file__, "--ensemble", "--runs", str(runs)],
        env={**os.environ, "PYTHONPATH": str(tree)}, cwd=tree,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return float(out.stdout)


def compare(other: Path, pairs: int, runs: int) -> None:
    """Print the table."""
    from scipy.stats import t

    for tree in (HERE, other):
        measured(tree, 1)
    logs = []
    print(f"| pair | this, s | other, s | ratio |\n| --- | --- | --- | --- |   ({runs} runs each)")
    for k in range(pairs):
        spent = {tree: measured(tree, runs) for tree in ((HERE, other), (other, HERE))[k % 2]}
        logs.append(math.log(spent[HERE] / spent[other]))
        print(f"| {k + 1} | {spent[HERE]:.2f} | {spent[other]:.2f} | {math.exp(logs[-1]):.3f} |",
              flush=True)  # fmt: skip
    mean = statistics.fmean(logs)
    half = t.ppf(0.95, pairs - 1) * statistics.stdev(logs) / math.sqrt(pairs)
    print(f"\nmean ratio {math.exp(mean):.4f}, upper confidence bound {math.exp(mean + half):.4f}")


def main() -> None:
    """Measure, or be one of the processes that are measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("other", nargs="?", default="HEAD")
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--ensemble", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.ensemble:
        print(ensemble(given.runs))
    elif Path(given.other).is_dir():
        compare(Path(given.other).resolve(), given.pairs, given.runs)
    else:
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder) / "other"
            git = ["git", "-C", str(HERE), "worktree"]
            subprocess.run([*git, "add", "--detach", "--quiet", tree, given.other], check=True)
            try:
                compare(tree, given.pairs, given.runs)
            finally:
                subprocess.run([*git, "remove", "--force", tree], check=True)


if __name__ == "__main__":
    main()
