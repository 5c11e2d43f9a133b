"""Engine time of this tree against another one, in pairs.

    python benchmarks/bench_paired.py OTHER [--scenario NAME] [--pairs 10] [--runs 200]

OTHER is a commit or the path of a tree. A pair is two fresh processes, one a tree, that take the
steps of the same derailments around a scenario (``mississauga_published``; each tree reads its own
file) in turn, run by run, so that what else the machine does meets both alike; the time is
processor time, and the kernels are compiled before. The table ends with the mean of the ratio
this / other over the pairs and its one-sided 95 % upper confidence bound (Student's t on the
logarithms).
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
from typing import Any

HERE = Path(__file__).resolve().parent.parent


def work(scenario: str) -> None:
    """Run a derailment for each speed (a factor, one a line) that is asked for; print the time."""
    try:
        from derail_ros.engine import PlanarSimulation as Simulation
    except ImportError:  # a tree from before the engine's run had this name
        from derail_ros.engine import Simulation
    from derail_ros.scenario import load_scenario_by_name

    params = load_scenario_by_name(scenario).to_params()
    Simulation(params).run()
    for line in sys.stdin:
        speed = params.initiation.speed * float(line)
        run = Simulation(replace(params, initiation=replace(params.initiation, speed=speed)))
        began = time.process_time()
        run.advance_to(math.inf)
        print(time.process_time() - began, flush=True)


def start(tree: Path, scenario: str) -> subprocess.Popen[str]:
    """A process that works with the package of ``tree``."""
    return subprocess.Popen(
        [sys.executable, __file__, "--work", "--scenario", scenario],
        env={**os.environ, "PYTHONPATH": str(tree)}, cwd=tree,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def ask(process: Any, factor: float) -> float:
    """Processor time of the steps of one run, s."""
    process.stdin.write(f"{factor}\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def pair(other: Path, scenario: str, runs: int) -> tuple[float, float]:
    """Processor time of this tree and of the other one, s."""
    spent = [0.0, 0.0]
    processes = [start(HERE, scenario), start(other, scenario)]
    try:
        for k in range(runs):
            for side in ((0, 1), (1, 0))[k % 2]:
                spent[side] += ask(processes[side], 0.9 + 0.2 * k / runs)
    finally:
        for process in processes:
            process.communicate()
    return spent[0], spent[1]


def compare(other: Path, scenario: str, pairs: int, runs: int) -> None:
    """Print the table."""
    from scipy.stats import t

    pair(other, scenario, 1)  # compiles
    print("| pair | this, s | other, s | ratio |\n| --- | --- | --- | --- |")
    logs = []
    for k in range(pairs):
        mine, others = pair(other, scenario, runs)
        logs.append(math.log(mine / others))
        print(f"| {k + 1} | {mine:.2f} | {others:.2f} | {mine / others:.3f} |", flush=True)
    mean = statistics.fmean(logs)
    half = t.ppf(0.95, pairs - 1) * statistics.stdev(logs) / math.sqrt(pairs)
    below = math.exp(mean + half)
    print(f"\n{scenario}, {runs} runs each: ratio {math.exp(mean):.4f}, below {below:.4f}")


def main() -> None:
    """Compare, or be one of the processes that are compared."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("other", nargs="?", default="HEAD")
    parser.add_argument("--scenario", default="mississauga_published")
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.scenario)
    elif Path(given.other).is_dir():
        compare(Path(given.other).resolve(), given.scenario, given.pairs, given.runs)
    else:
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder) / "other"
            git = ["git", "-C", str(HERE), "worktree"]
            subprocess.run([*git, "add", "--detach", "--quiet", tree, given.other], check=True)
            try:
                compare(tree, given.scenario, given.pairs, given.runs)
            finally:
                subprocess.run([*git, "remove", "--force", tree], check=True)


if __name__ == "__main__":
    main()
