"""Speed of the engine: the tables and the figure of docs/performance.md.

``python bench_performance.py`` runs all cases (some minutes), prints the tables, and writes
``docs/performance.json``, ``docs/images/chain_work_precision.svg`` and the tables of
``docs/performance.md``. Single-thread times are processor times, the least of several runs; the
engine's kernels are compiled and loaded before. A small fixed kernel is timed beside everything:
divide by it to compare machines. Peers that are not installed (extra ``bench``) are left out.
"""

from __future__ import annotations

import json
import math
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
sys.path.insert(0, str(HERE))
import chain  # noqa: E402

ONE_THREAD = {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM")
}


def fixed_kernel() -> float:
    """Time of one unit of a fixed loop of plain arithmetic in Python, ms (least of 30)."""

    def unit() -> float:
        x = 0.5
        for _ in range(20000):
            x = 3.9 * x * (1.0 - x)
        return x

    best = 1e9
    for _ in range(30):
        began = time.process_time()
        unit()
        best = min(best, time.process_time() - began)
    return 1e3 * best


def timed(params: Any, repeats: int) -> tuple[float, Any]:
    """Least processor time of a run, s, and the run."""
    from derail_ros.engine import PlanarSimulation

    best, run = 1e9, None
    for _ in range(repeats):
        run = PlanarSimulation(params)
        began = time.process_time()
        run.advance_to(math.inf)
        best = min(best, time.process_time() - began)
    return best, run


def scenarios() -> list[dict[str, Any]]:
    """(a) and (b): the derailment of Mississauga to rest, default method and reference."""
    from derail_ros.scenario import load_scenario_by_name

    rows = []
    for name in ("mississauga_published", "mississauga"):
        base = load_scenario_by_name(name).to_params()
        for method, rtol in (("row", 1e-3), ("rkf45", 1e-4)):
            params = replace(base, integration=replace(base.integration, method=method, rtol=rtol))
            wall, run = timed(params, 7)
            count = run.statistics
            rows.append(
                {
                    "case": name, "method": method, "bodies": run.n_cars, "simulated_s": run.time,
                    "cpu_s": wall, "times_real_time": run.time / wall,
                    "us_per_evaluation": 1e6 * wall / count["evaluations"],
                    "energy_residual": run.outcome().energy_residual, **count,
                }
            )  # fmt: skip
    return rows


def peers() -> list[dict[str, Any]]:
    """(c): the chain of 100 bars, each computation in a process of its own."""
    rows = []
    for name, settings in chain.SETTINGS.items():
        for index in range(len(settings)):
            out = subprocess.run(
                [sys.executable, str(HERE / "chain.py"), name, str(index)],
                env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False,
            )  # fmt: skip
            if out.returncode:
                last = (out.stderr.strip().splitlines() or ["?"])[-1]
                print(f"{name} {settings[index]}: left out ({last})", file=sys.stderr)
                continue
            rows.append(json.loads(out.stdout.strip().splitlines()[-1]))
    return rows


def lengths() -> tuple[list[dict[str, Any]], float]:
    """(d): chains of 25 to 1000 cars, processor time of a step."""
    rows = []
    for bars in (25, 50, 100, 200, 400, 1000):
        best, steps = 1e9, 0
        chain.PINS = np.resize(chain.PINS, bars + 1)
        for _ in range(5):
            run = chain.chain_run("row", 1e-3, bars, 2.0)
            began = time.process_time()
            run.advance_steps(200)
            best = min(best, time.process_time() - began)
            steps = run.step_count
        rows.append({"cars": bars, "us_per_step": 1e6 * best / steps})
    return rows, exponent([r["cars"] for r in rows], [r["us_per_step"] for r in rows])


def pile_ups() -> tuple[list[dict[str, Any]], float]:
    """(e): pile-ups with contacts in proportion to the cars: time per simulated second.

    Groups of 25 free cars, thrown together head on in pairs, 200 m apart.
    """
    from derail_ros.engine import PlanarSimulation
    from derail_ros.scenario import load_scenario_by_name
    from derail_ros.vocabulary.params import BrakeParams, InitiationParams

    base = load_scenario_by_name("base_train").to_params()
    car = replace(base.cars[0], brakes=())
    rows = []
    for cars in (25, 50, 100, 200, 400):
        trucks = tuple((i + 1, end) for i in range(cars) for end in ("front", "rear"))
        params = replace(
            base,
            cars=(car,) * cars,
            initiation=InitiationParams(
                speed=0.0, derailed_trucks=trucks, parted_couplings=tuple(range(1, cars))
            ),
            track=replace(base.track, rail_breaks=()),
            brakes=BrakeParams(triggers=()),
            integration=replace(base.integration, time_limit=3.0),
        )
        best, contacts = 1e9, 0
        for _ in range(3):
            run = PlanarSimulation(params)
            state = run._state
            for i in range(cars):
                group, k = divmod(i, 25)
                row, column = divmod(k, 5)
                rng = np.random.default_rng(k)  # all groups alike
                x, y = 60.0 * (row - 2) * 0.3, 4.6 * (column - 2)
                state.q[i] = (x - 200.0 * group, y, *[rng.normal(0.0, 0.05)] * 3)
                state.v[i] = (-4.0 * (row - 2), -1.5 * (column - 2), rng.normal(0.0, 0.2), 0, 0)
            state.cnt["pairs"] = 0  # no neighbours yet
            run._evaluate()
            began = time.process_time()
            run.advance_to(3.0)
            best = min(best, time.process_time() - began)
            contacts = len(run.collisions)
        rows.append({"cars": cars, "contacts": contacts, "cpu_s_per_simulated_s": best / run.time})
    times = [r["cpu_s_per_simulated_s"] for r in rows]
    return rows, exponent([r["cars"] for r in rows], times)


def ensemble(members: int) -> dict[str, Any]:
    """(f): many runs of (a) on all cores, threads in this process."""
    from derail_ros.scenario import load_scenario_by_name
    from derail_ros.studies.ensemble import default_jobs, ensemble_jobs, run_many

    scenario = load_scenario_by_name("mississauga_published")
    rates = {}
    for jobs, count in ((1, max(20, members // 10)), (default_jobs(), members)):
        began = time.perf_counter()
        spent = time.process_time()
        done = sum(r.error is None for r in run_many(ensemble_jobs(scenario, count), jobs=jobs))
        rates[jobs] = done / (time.perf_counter() - began)
        per_run = (time.process_time() - spent) / done
    jobs = default_jobs()
    return {
        "runs": members, "jobs": jobs, "runs_per_s": rates[jobs],
        "single_core_runs_per_s": rates[1], "share_of_ideal": rates[jobs] / (jobs * rates[1]),
        "cpu_s_per_run": per_run,
        "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }  # fmt: skip


def start_up() -> list[dict[str, Any]]:
    """Wall times of whole processes, s: compiling into an empty cache, then starting from it.

    The least of five, but for the first.
    """
    first_step = (
        "from derail_ros.engine import PlanarSimulation\n"
        "from derail_ros.scenario import load_scenario_by_name\n"
        "PlanarSimulation(load_scenario_by_name('mississauga').to_params()).advance_steps(1)"
    )
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        env = {**os.environ, "DERAIL_CACHE_DIR": cache}
        for what, repeats, arguments in (
            ("first start, compiling, to the first step", 1, ["-c", first_step]),
            ("second start to the first step", 5, ["-c", first_step]),
            ("of which import", 5, ["-c", first_step.rsplit("\n", 1)[0]]),
            ("`derail --help`", 5, ["-m", "derail_ros.cli", "--help"]),
        ):
            best, command = 1e9, [sys.executable, *arguments]
            for _ in range(repeats):
                began = time.perf_counter()
                subprocess.run(command, env=env, check=True, capture_output=True)
                best = min(best, time.perf_counter() - began)
            rows.append({"what": what, "wall_s": best})
    return rows


def exponent(x: list[float], y: list[float]) -> float:
    """Slope of a power law by least squares."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def table(rows: list[dict[str, Any]], columns: dict[str, tuple[str, str]]) -> str:
    """Rows as a table in Markdown; columns: key -> (title, format)."""
    from derail_ros.studies.tables import Table

    cells = [[format(row[key], how) for key, (_, how) in columns.items()] for row in rows]
    return Table([title for title, _ in columns.values()], cells, texts=len(columns)).markdown()


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Wall time against gap and energy error."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    labels = {
        "gap_m": "largest gap of a joint, m",
        "energy_error": "error of the energy balance, relative",
    }
    _, axes = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
    for ax, (key, label) in zip(axes, labels.items()):
        for name, marker in zip(chain.SETTINGS, "osv^"):
            own = [r for r in rows if r["engine"] == name]
            if own:
                ax.loglog([max(r[key], 1e-16) for r in own], [r["wall_s"] for r in own],
                          marker, label=name)  # fmt: skip
        ax.set_xlabel(label)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("wall time, s")
    axes[0].legend()
    path.parent.mkdir(exist_ok=True)
    plt.savefig(path, metadata={"Date": None})


def main() -> None:
    os.environ.update(ONE_THREAD)
    quick = "--quick" in sys.argv
    before = fixed_kernel()
    from derail_ros.engine import warm_up

    warm_up()
    runs = scenarios()
    bars = peers()
    cars, grows = lengths()
    piles, piles_grow = pile_ups()
    many = ensemble(200 if quick else 1000)
    starts = start_up()
    after = fixed_kernel()
    for r in bars:
        r["label"] = ", ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in r["setting"])
    text = [
        f"Measured with Python {platform.python_version()} on {os.cpu_count()} cores "
        f"({platform.machine()}); fixed kernel {before:.2f} ms before and {after:.2f} ms after.",
        "**(a), (b) Derailments to rest**, one thread",
        table(runs, {
            "case": ("scenario", ""), "bodies": ("bodies", "d"), "method": ("method", ""),
            "cpu_s": ("time, s", ".3f"), "times_real_time": ("times real time", ".0f"),
            "us_per_evaluation": ("µs an evaluation", ".1f"), "evaluations": ("evaluations", "d"),
            "steps": ("steps", "d"), "rejected": ("rejected", "d"),
            "limited_by_accuracy": ("set by accuracy", "d"),
            "limited_by_stability": ("by stability", "d"), "limited_by_cap": ("by the cap", "d"),
            "ended_at_a_moment": ("by a moment", "d"),
            "implicit": ("implicit", "d"), "energy_residual": ("energy residual", ".0e"),
        }),
        "**(c) Chain of 100 bars, 10 s**, one thread (`benchmarks/chain.py`)",
        table(bars, {
            "engine": ("engine", ""), "label": ("setting", ""), "wall_s": ("wall time, s", ".3f"),
            "setup_s": ("import and set-up, s", ".2f"),
            "gap_m": ("largest gap, m", ".1e"), "energy_error": ("energy error", ".1e"),
        }),
        f"**(d) Chains**: a step costs cars^{grows:.2f}",
        table(cars, {"cars": ("cars", "d"), "us_per_step": ("µs a step", ".1f")}),
        f"**(e) Pile-ups**: a simulated second costs cars^{piles_grow:.2f}",
        table(piles, {
            "cars": ("cars", "d"), "contacts": ("contacts", "d"),
            "cpu_s_per_simulated_s": ("s a simulated second", ".4f"),
        }),
        f"**(f) {many['runs']} runs of (a)** on {many['jobs']} cores: {many['runs_per_s']:.1f} "
        f"runs a second ({many['share_of_ideal']:.0%} of cores times the single-core rate of "
        f"{many['single_core_runs_per_s']:.1f}), {many['cpu_s_per_run']:.3f} s of processor time "
        f"each, {many['peak_memory_MB']:.0f} MB in all. "
        "What else ran on the machine counts here.",
        "**Start-up**, whole processes",
        table(starts, {"what": ("", ""), "wall_s": ("wall time, s", ".2f")}),
    ]  # fmt: skip
    tables = "\n\n".join(text)
    print(tables)
    results = {
        "fixed_kernel_ms": [before, after], "scenarios": runs, "chain": bars, "lengths": cars,
        "lengths_exponent": grows, "pile_ups": piles, "pile_ups_exponent": piles_grow,
        "ensemble": many, "start_up": starts,
    }  # fmt: skip
    (DOCS / "performance.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    figure(bars, DOCS / "images" / "chain_work_precision.svg")
    page = DOCS / "performance.md"
    whole = page.read_text(encoding="utf-8")
    begin, end = "<!-- tables: begin -->", "<!-- tables: end -->"
    head, rest = whole.split(begin)
    tail = rest.split(end)[1]
    page.write_text(f"{head}{begin}\n\n{tables}\n\n{end}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
