"""A campaign of random derailments: trains, tracks, speeds, brakes and breaks of all kinds.

    python -m tests.engine.campaign 0 200

runs the numbers 0 to 199 and prints what went wrong, with a state from shortly before it in a
temporary folder, ready for ``tests/data/add.py``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from derail_ros.engine import PlanarSimulation
from derail_ros.scenario import ScenarioError, loads_scenario
from derail_ros.vocabulary.errors import CommandError, DerailError, ParameterError

CARS = (
    "box_car", "tank_dot_103", "tank_dot_111", "tank_dot_105", "tank_dot_112", "open_top_hopper",
    "covered_hopper_cement", "covered_hopper_grain", "tank_chlorine", "tank_lpg",
    "tank_vinyl_chloride", "tank_caustic_soda", "high_side_gondola", "mill_gondola",
    "source_tank_13m58", "source_tank_12m44", "source_chlorine_tank", "source_tank_18m04",
    "source_box_car", "source_rear_car", "source_base_car",
)  # fmt: skip
WITH_LOAD = frozenset(CARS[:14])
LOCOMOTIVES = ("locomotive_hr416", "locomotive_sd_40_2", "locomotive_c_30_7")

SLICE = 0.5
"""Simulated time between two looks, s; a failure's saved state is at most that old."""

MAX_GAP = 1e-6
MAX_RESIDUAL = 1e-3


def consist(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Blocks of cars; up to three locomotives in front."""
    blocks: list[dict[str, Any]] = []
    if rng.random() < 0.3:
        blocks.append({"car": str(rng.choice(LOCOMOTIVES)), "count": int(rng.integers(1, 4))})
    for _ in range(int(rng.integers(1, 9))):
        kind = str(rng.choice(CARS))
        block: dict[str, Any] = {"car": kind, "count": int(rng.integers(1, 9))}
        if kind in WITH_LOAD:
            block["load"] = float(rng.choice([0.0, 1.0, rng.random()]))
        if rng.random() < 0.1:
            block["brake"] = {"shoe": str(rng.choice(["none", "cast_iron", "composition"]))}
        blocks.append(block)
    return blocks


def alignment(rng: np.random.Generator, behind: float) -> dict[str, Any]:
    """A straight track, or curves and spirals with ``behind`` metres of track for the train."""
    if rng.random() < 0.5:
        return {}
    radius = float(rng.uniform(150.0, 1500.0))
    turn = str(rng.choice(["left", "right"]))
    spiral = float(rng.uniform(20.0, 120.0))
    pieces: list[dict[str, Any]] = [
        {"tangent": {"length_m": behind + float(rng.uniform(0.0, 60.0))}},
        {"spiral": {"length_m": spiral, "radius_end_m": radius, "turn": turn}},
        {
            "curve": {
                "length_m": float(rng.uniform(30.0, radius)),
                "radius_m": radius,
                "turn": turn,
            }
        },
    ]
    if rng.random() < 0.5:
        pieces.append({"spiral": {"length_m": spiral, "radius_start_m": radius, "turn": turn}})
        pieces.append({"tangent": {"length_m": 5000.0}})
    else:  # the curve leads into a wide one that is longer than any stopping distance
        pieces.append({"curve": {"length_m": 6000.0, "radius_m": 3000.0, "turn": turn}})
    return {"alignment": pieces, "start_coordinate_m": -behind}


def scenario(number: int) -> dict[str, Any]:
    """Scenario ``number`` of the campaign, as plain data."""
    rng = np.random.default_rng([2024, number])
    blocks = consist(rng)
    cars = sum(block["count"] for block in blocks)
    behind = 25.0 * cars
    track = alignment(rng, behind)
    position = float(rng.uniform(-20.0, 5.0))
    if track and rng.random() < 0.3:  # begins in the curve
        position = float(rng.uniform(0.0, 120.0))
    breaks = sorted(float(s) for s in rng.uniform(-0.2 * behind, 60.0, int(rng.integers(0, 4))))
    track["rail_breaks"] = breaks
    if not breaks or rng.random() < 0.3:
        track["rail_breaks_under_cars"] = [int(rng.integers(1, cars + 1))]
    start: dict[str, Any] = {"position_m": position, "lateral_force_N": 0.0}
    if rng.random() < 0.7:
        start["derailed_trucks"] = [
            {"car": int(c), "truck": str(rng.choice(["front", "rear", "both"]))}
            for c in sorted(set(rng.integers(1, cars + 1, int(rng.integers(1, 4))).tolist()))
        ]
    if cars > 1 and rng.random() < 0.3:
        start["parted_couplings"] = [int(rng.integers(1, cars))]
    if rng.random() < 0.8:
        start["lateral_force_N"] = float(rng.uniform(-300e3, 300e3))
        start["lateral_force_car"] = int(rng.integers(1, min(cars, 6) + 1))
        start["lateral_force_place"] = str(rng.choice(["front", "rear", "centre"]))
        start["lateral_force_duration_s"] = float(rng.uniform(0.2, 3.0))
    source = str(rng.choice(["front", "rear", "both_ends", "car", "none"]))
    brakes: dict[str, Any] = {
        "signal_source": source,
        "delay_s": float(rng.choice([0.0, rng.uniform(0.0, 10.0)])),
        "vent_on_parting": bool(rng.random() < 0.5),
        "instant": bool(rng.random() < 0.3),
        "traction_limited": bool(rng.random() < 0.3),
    }
    if source == "car":
        brakes["signal_car"] = int(rng.integers(1, cars + 1))
    train: dict[str, Any] = {"speed_kmh": float(rng.uniform(15.0, 160.0)), "consist": blocks}
    last = blocks[-1]["count"]
    if last > 2 and rng.random() < 0.2:  # the last block as one body
        train["virtual_from"] = cars - last + 2
    return {
        "version": 1,
        "title": f"Campaign {number}",
        "train": train,
        "track": track,
        "initiation": start,
        "brakes": brakes,
        "ground": {
            "scale": float(rng.choice([1.0, rng.uniform(0.3, 2.5)])),
            "c_v_s_per_m": float(rng.choice([0.03, rng.uniform(0.0, 0.1)])),
        },
        "contact": {
            "gap_law": str(rng.choice(["gaussian", "gaussian", "lorentzian", "sech2", "quartic"])),
            "inside": str(rng.choice(["held", "even"])),
        },
        "derailment": {
            "lv_limit": float(rng.choice([2.0, rng.uniform(0.6, 4.0)])),
            "break_follows_lateral": bool(rng.random() < 0.3),
        },
        "integration": {
            "method": str(rng.choice(["rkf45", "row"])),
            "rtol": float(rng.choice([1e-4, 1e-4, 1e-3, 1e-5])),
            "locate_crossings": bool(rng.random() < 0.85),
            "time_limit_s": 25.0,
        },
    }


@dataclass(frozen=True)
class Commands:
    """What is done to a run while it goes on."""

    break_at: float
    break_car: int
    brake_at: float
    brake_mode: str


def commands(number: int, cars: int) -> Commands:
    """The commands of run ``number``; a time of infinity is never."""
    rng = np.random.default_rng([4201, number])
    modes = ("conventional", "instant", "traction_limited", "instant_traction_limited")
    return Commands(
        float(rng.uniform(0.0, 8.0)) if rng.random() < 0.3 else float("inf"),
        int(rng.integers(1, cars + 1)),
        float(rng.uniform(0.0, 8.0)) if rng.random() < 0.3 else float("inf"),
        str(rng.choice(modes)),
    )


@dataclass(frozen=True)
class Finding:
    """One run of the campaign.

    Attributes
    ----------
    number : of the run
    what : what is wrong; "" if nothing is, "refused: ..." if the scenario was not valid
    state : saved shortly before it went wrong
    wall_s, simulated_s : time taken and time simulated, s
    """

    number: int
    what: str
    state: bytes
    wall_s: float
    simulated_s: float
    derailed: int = 0


def finite(run: PlanarSimulation) -> bool:
    """State and forces are finite."""
    s = run.sample()
    energy = list(s.energy.values())
    arrays = (s.q, s.v, s.acceleration, s.rail_force, s.coupler_force, s.collision_force, energy)
    return all(bool(np.isfinite(a).all()) for a in arrays)


def trouble(run: PlanarSimulation) -> str:
    """What is wrong with a run, "" if nothing is."""
    if not finite(run):
        return "not finite"
    outcome = run.outcome()
    if not outcome.energy_residual <= MAX_RESIDUAL:
        return f"energy residual {outcome.energy_residual:.2e}"
    if not outcome.max_coupler_gap <= MAX_GAP:
        return f"coupler gap {outcome.max_coupler_gap:.2e} m"
    if not outcome.max_truck_offset <= MAX_GAP:
        return f"truck offset {outcome.max_truck_offset:.2e} m"
    return ""


def attempt(number: int) -> Finding:
    """Run one of the campaign and say what came of it."""
    began = time.perf_counter()
    try:
        params = loads_scenario(yaml.safe_dump(scenario(number))).to_params()
        run = PlanarSimulation(params)
    except (ScenarioError, ParameterError) as error:
        return Finding(number, f"refused: {error}", b"", time.perf_counter() - began, 0.0)
    todo = commands(number, run.n_cars)
    before = run.to_bytes()
    what = ""
    done_break = done_brake = False
    try:
        while not run.ended and not what:
            before = run.to_bytes()
            run.advance_to(run.time + SLICE)
            if run.ended:
                break
            try:
                if run.time >= todo.break_at and not done_break:
                    done_break = True
                    run.inject_rail_break(car=todo.break_car)
                if run.time >= todo.brake_at and not done_brake:
                    done_brake = True
                    run.trigger_emergency_brake(todo.brake_mode)
            except CommandError:
                pass  # the car has left the rails, or is virtual
            what = trouble(run)
        what = what or trouble(run)
    except DerailError as error:
        what = f"{type(error).__name__}: {error}"
    off = run.outcome().cars_derailed
    return Finding(number, what, before, time.perf_counter() - began, run.time, off)


def campaign(first: int, count: int) -> Iterator[Finding]:
    """All findings of the runs ``first`` to ``first + count - 1``."""
    for number in range(first, first + count):
        yield attempt(number)


def main() -> None:
    """Print what went wrong, and where its state is."""
    first, count = int(sys.argv[1]), int(sys.argv[2])
    folder = Path(tempfile.mkdtemp(prefix="campaign-"))
    wrong = refused = 0
    slowest = (0.0, -1)
    for finding in campaign(first, count):
        if finding.what.startswith("refused"):
            refused += 1
        elif finding.what:
            wrong += 1
            path = folder / f"campaign_{finding.number}.state"
            path.write_bytes(finding.state)
            print(f"{finding.number}: {finding.what} ({finding.simulated_s:.3f} s); {path}")
        slow = finding.wall_s / max(finding.simulated_s, 1.0)
        slowest = max(slowest, (slow, finding.number))
        sys.stdout.flush()
    print(
        f"{count} runs, {refused} refused, {wrong} wrong; slowest: {slowest[0]:.2f} s a second "
        f"of simulation (run {slowest[1]})"
    )


if __name__ == "__main__":
    main()
