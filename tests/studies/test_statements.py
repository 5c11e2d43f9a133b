"""Statements of the source, judged on made-up runs; and one run traced."""

from dataclasses import replace

import numpy as np
import pytest

from derail_ros import models
from derail_ros.scenario import load_scenario
from derail_ros.studies.ensemble import Job, never
from derail_ros.studies.published import load_published
from derail_ros.studies.records import Ensemble
from derail_ros.studies.statements import (
    LENGTHS,
    SCALES,
    SEVEN,
    Trace,
    TraceKey,
    ground_jobs,
    judge,
    trace,
    traced_jobs,
)
from derail_ros.vocabulary.events import Collision
from derail_ros.vocabulary.measures import outcome_record
from tests.studies.made_up import outcome

TEXT = load_published().text
BLANK = Collision(0, True, 2, 1, 2, 0, 0.0, 1.0, 1e6, 0.5, 1e6, 0.5, 1.0, 0.0, 0.0, 1.0, 0.0,
                  0.0, 0.0)  # fmt: skip


def made_up(force=1.0, late=0.0, speed=1.0, moving=(), front=1e6):
    """The validation run as published, but for factors and a delay."""
    time = np.arange(0.0, 12.0, 0.05)
    speeds = np.zeros((len(time), 24))
    collisions = []
    for c in TEXT["collisions"]:
        a, b = c["pair"]
        start = c["time_s"] + late - 0.02
        collisions.append(
            replace(BLANK, car_a=b, car_b=a, start=start, peak_time=start + 0.02,
                    peak_force=force * c["force_N"])
        )  # fmt: skip
        if "speed_mps" in c:
            speeds[time <= start + 0.05, a - 1] = speed * c["speed_mps"]
    for car in moving:
        speeds[:, car - 1] = 3.0
    peaks = np.full(24, 2e6)
    peaks[np.array(TEXT["cars_above_10MN"]) - 1] = 12e6
    peaks[0] = front
    out = outcome(n=24, car_peak_force=peaks)
    return Trace(out, collisions, time, np.zeros((len(time), 24, 2)), speeds)


def still(shift=0.0, n=20):
    time = np.arange(0.0, 7.05, 0.05)
    position = np.zeros((len(time), n, 2)) + np.array([shift, 0.0])
    return Trace(outcome(n=n), [], time, position, np.zeros((len(time), n)))


def ensemble(area=1500.0, cars=14, length=60.0):
    made = outcome(scene_area=area, cars_derailed=cars, scene_length=length)
    return Ensemble((outcome_record(made),))


def judged(runs, shifts=None, cases=None, ground=None):
    traces = {TraceKey("validation"): runs, TraceKey("base", SEVEN): [still()]}
    for path, values in (("train.consist.0.count", LENGTHS), ("brakes.force_scale", SCALES)):
        for v in values:
            traces[TraceKey(f"{path}={v}", SEVEN)] = [still((shifts or {}).get(v, 0.0), 30)]
    names = ("base_60", "base_34t", "base_102t", "base_lv_1_0", "base_lv_3_0")
    found = {name: ensemble() for name in names} | (cases or {})
    statements = judge(TEXT, traces, found, ground or {s: ensemble() for s in SCALES})
    return {s.name: s for s in statements}


def test_the_published_run_itself_keeps_everything():
    bigger = {name: ensemble(area=1600.0) for name in ("base_34t", "base_102t")}
    said = judged([made_up()] * 2, cases=bigger, ground={s: ensemble(1600.0) for s in SCALES})
    assert [s.text for s in said.values() if not s.kept] == []
    assert len(said) == 5 + 4 + 4 + 3 + 5
    assert said["speed 8-7"].found == "in 2 of 2 runs, mean 21.0 m/s"


@pytest.mark.parametrize(
    ("changes", "lost"),
    [
        ({"force": 1.2}, {f"collision {p}" for p in ("11-9", "8-6", "8-7", "11-10", "12-11")}),
        ({"speed": 1.2}, {"speed 11-9", "speed 8-6", "speed 8-7", "speed 12-11"}),
        ({"moving": (3,)}, {"stand 5.7"}),
        ({"moving": (7,)}, {"almost_stand 5.7"}),
        ({"moving": (9,)}, {"stand 8"}),
        ({"front": 6e6}, {"front_three"}),
    ],
)
def test_what_differs_is_not_kept(changes, lost):
    before, after = judged([made_up()]), judged([made_up(**changes)])
    assert {name for name in before if before[name].kept and not after[name].kept} == lost


def test_a_statement_needs_half_of_the_runs():
    assert judged([made_up(), made_up(front=6e6)])["front_three"].kept
    assert not judged([made_up(), *[made_up(front=6e6)] * 2])["front_three"].kept


def test_a_force_within_the_noise_of_the_source_is_kept_and_a_late_collision_is_not():
    assert judged([made_up(force=1.07)])["collision 11-9"].kept
    late = judged([made_up(late=0.7)])["collision 11-9"]
    assert not late.kept
    assert late.found == "in 0 of 1 run"


def test_the_first_seven_seconds():
    said = judged([made_up()], shifts={90: 0.2})
    assert not said["seven_seconds lengths"].kept
    assert "0.2 m at 90" in said["seven_seconds lengths"].found
    assert said["seven_seconds brake forces"].kept


def test_quotient_and_area():
    said = judged([made_up()], cases={"base_lv_1_0": ensemble(cars=16)})
    assert not said["quotient"].kept
    assert not judged([made_up()], cases={"base_lv_3_0": ensemble(length=70.0)})["quotient"].kept
    assert not said["area mass"].kept
    assert said["area mass"].found.startswith("base 1500 m2; 34t: 1500")


def test_runs_that_failed_judge_nothing():
    said = judged([])
    assert set(said) == {"seven_seconds lengths", "seven_seconds brake forces", "quotient",
                         "area mass", "area ground"}  # fmt: skip


def test_nothing_is_run_without_a_text():
    assert [*traced_jobs({}, 3, 0, {}), *ground_jobs({}, 3, 0, {})] == []


def test_a_run_traced_is_the_run_itself():
    params = load_scenario("base_train").with_overrides({"train.speed_kmh": 30}).to_params()
    run = models.build(params)
    expected = run.run()
    found = trace(Job(params, key=TraceKey("x")), never)
    assert found.outcome.peak_force == expected.peak_force
    assert len(found.collisions) == len(run.collisions)
    assert found.position[-1] == pytest.approx(expected.pose[:, :2], abs=1e-3)
    assert found.speed[0] == pytest.approx(30 / 3.6, rel=1e-6)
    short = trace(Job(params, key=TraceKey("x", 2.0)), never)
    assert short.time[-1] < 2.0
