"""Study files: what is read, and every mistake refused before the first run, with its place."""

import pytest

from derail_ros.scenario import ScenarioError
from derail_ros.studies import design as designs
from derail_ros.studies.design import list_studies
from derail_ros.studies.plan import load_study, studies_dir, study_from

HEAD = "version: 1\ntitle: T\nscenario: small\n"
GRID = HEAD + "design: grid\n"


def parameters(text, design="grid", more=""):
    return f"{HEAD}design: {design}\n{more}parameters:\n  p: {text}\n"


def refusal(load, text):
    with pytest.raises(ScenarioError) as caught:
        designs.check(designs.make(load(text)))
    return caught.value


def test_a_study_is_read(load):
    study = load()
    assert study.model.ensemble == 2
    assert study.label("speed") == "speed (km/h)"
    assert designs.make(study).size() == "4 points x 2 runs = 8 runs"


def test_the_size_with_one_run_a_point(load):
    study = load(parameters("{path: train.speed_kmh, values: [10, 12]}", more="ensemble: 1\n"))
    assert designs.make(study).size() == "2 points x 1 run = 2 runs"


SHIPPED = sorted(path.stem for path in studies_dir().glob("*.yaml"))


def test_the_asked_studies_ship():
    assert set(SHIPPED) >= {
        "six_variations",
        "brake_systems",
        "placement",
        "equal_energy",
        "train_length",
        "break_position",
    }
    assert [name for name, _, _ in list_studies()] == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_every_point_of_a_shipped_study_can_be_run(name):
    design = designs.make(load_study(name))
    if len(design) <= 100:
        designs.check(design)
    else:
        for point in design[:: len(design) // 20]:
            designs.scenario_at(design, point)


def test_six_variations_are_25_points_of_20_runs():
    design = designs.make(load_study("six_variations"))
    assert (len(design), design.runs) == (25, 500)
    values = {}
    for point in design:
        if point.varied:
            values.setdefault(point.varied, []).append(point.columns[point.varied])
    assert values["speed"] == [30, 48, 72, 90]
    assert values["number_of_cars"] == [30, 48, 72, 90]
    assert values["car_mass"] == [34e3, 54.4e3, 81.6e3, 102e3]
    for name in ("brake_force", "ground_reaction"):
        assert values[name] == [0.5, 0.8, 1.2, 1.5]
    assert values["derailment_quotient"] == [1.0, 1.6, 2.4, 3.0]


@pytest.mark.parametrize(
    ("text", "field", "reason"),
    [
        (GRID, "parameters", "must vary something"),
        (HEAD + "design: gird\n", "design", "did you mean 'grid'"),
        (GRID.replace("1", "2", 1), "version", "must be 1"),
        (parameters("{path: ground.scale}"), "parameters.p", "needs one of values"),
        (parameters("{path: ground.scale, valeus: [1]}"), "parameters.p.valeus", "did you mean"),
        (parameters("{values: [1, 2]}"), "parameters.p", "needs either path or set"),
        (parameters("{path: ground.scale, values: []}"), "parameters.p.values", "at least one"),
        (parameters("{path: ground.scale, values: [1, 1]}"), "parameters.p.values", "twice"),
        (parameters("{path: ground.scale, values: [1, a]}"), "parameters.p.values", "all numbers"),
        (
            parameters("{path: ground.scale, values: [1], percent: [0]}"),
            "parameters.p",
            "must have only one of values, percent",
        ),
        (
            parameters("{path: ground.scale, range: [2, 1], steps: 3}"),
            "parameters.p.range",
            "must rise, got 2 to 1",
        ),
        (
            parameters("{path: ground.scale, range: [1, 1], steps: 3}"),
            "parameters.p.range",
            "must rise, got 1 to 1",
        ),
        (parameters("{path: ground.scale, range: [1, 2]}"), "parameters.p.steps", "is required"),
        (
            parameters("{path: ground.scale, range: [1, .nan], steps: 2}"),
            "parameters.p.range.1",
            "finite",
        ),
        (
            parameters("{path: train.speed, values: [1, 2]}"),
            "parameters.p.values.0",
            "train.speed: unknown key; did you mean 'speed_kmh'?",
        ),
        (
            parameters("{path: train.speed, percent: [0, 20]}"),
            "parameters.p.path",
            "train.speed: unknown key",
        ),
        (
            parameters("{path: train.consist.3.count, values: [1, 2]}"),
            "parameters.p.values.0",
            "train.consist.3",
        ),
        (
            parameters("{path: train.speed_kmh, values: [10, 600]}"),
            "parameters.p.values.1",
            "train.speed_kmh: must be at most 500, got 600",
        ),
        (
            parameters("{path: train.speed_kmh, values: [10, fast]}"),
            "parameters.p.values",
            "all numbers",
        ),
        (
            parameters("{path: integration.method, values: [rkf45, euler]}"),
            "parameters.p.values.1",
            "method",
        ),
        (
            parameters("{settings: {a: {}, b: {train.consist: []}}}"),
            "parameters.p.settings.b",
            "train.consist",
        ),
        (parameters("{order: [as_given, heavy]}"), "parameters.p.order.1", "unknown order"),
        (parameters("{order: [as_given, reversed], cars: [1, 9]}"), "parameters.p.cars", "no car"),
        (parameters("{set: {ground.scale: 1}, values: [1, 2]}"), "parameters.p.set", "$value"),
        (
            parameters("{path: ground.scale, distribution: {normal: {mean: 1, sd: 1}}}"),
            "parameters.p.distribution",
            "needs levels",
        ),
        (
            parameters("{path: ground.scale, range: [1, 2]}", "latin_hypercube"),
            "points",
            "is required",
        ),
        (
            parameters("{path: ground.scale, range: [1, 2]}", "sobol", "points: 12\n"),
            "points",
            "power of two",
        ),
        (
            parameters(
                "{path: ground.scale, distribution: {triangular: {low: 1, mode: 3, high: 2}}}",
                "sobol",
                "points: 8\n",
            ),
            "parameters.p.distribution.triangular.mode",
            "between",
        ),
        (
            parameters("{path: ground.scale, range: [-1, 1]}", "latin_hypercube", "points: 8\n"),
            "parameters.p.range",
            "ground.scale: must be at least 0",
        ),
        (
            GRID + "parameters:\n  p: {path: ground.scale, values: [1, 2]}\n"
            "  q: {path: ground.scale, values: [1, 2]}\n",
            "parameters.q",
            "varies ground.scale, which parameter 'p' varies too",
        ),
        (
            GRID + "parameters:\n  p: {path: train.consist.0.count, values: [3, 4]}\n"
            "  q: {path: initiation.lateral_force_car, values: [1, 4]}\n",
            "parameters.q",
            "at p 3, q 4",
        ),
        (parameters("{path: ground.scale, values: [1, 2]}", "grid", "measures: [cars]\n"),
         "measures.0", "did you mean"),
        (parameters("{path: ground.scale, values: [1, 2]}", "grid",
                    "measures: [relative_severity]\n"),
         "measures", "needs base, the point to compare with"),
        (parameters("{path: ground.scale, values: [1, 2]}", "grid", "base: {p: 3}\n"),
         "base", "must be a point of the study"),
        (parameters("{path: ground.scale, values: [1, 2]}", "grid",
                    "figures: [{x: q, y: duration_s}]\n"), "figures.0.x", "unknown parameter"),
        (parameters("{path: ground.scale, values: [1]}"), "design", "at least two points"),
        (GRID + "parameters:\n  status: {path: ground.scale, values: [1, 2]}\n",
         "parameters.status", "is reserved"),
        (parameters("{path: ground.scale, values: [1, 2]}", "grid", "ensemble: 0\n"),
         "ensemble", "at least 1"),
        (parameters("{path: ground.scale, values: [1, 2]}", "grid",
                    "overrides: {train.speed_kmh: 0}\n"),
         "overrides.'train.speed_kmh'", "above 0"),
        (HEAD.replace("small", "smal") + "design: grid\n", "scenario", "unknown scenario"),
        (HEAD + "design: cases\ncolumns: {a: {}}\ncases: [{at: {b: 1}}]\n", "cases.0.at", "a"),
        (HEAD + "design: cases\ncolumns: {a: {}}\n"
         "cases: [{at: {a: 1}}, {at: {a: 2}, set: {train.mass: 1}}]\n",
         "cases.1", "train.mass: unknown key"),
    ],
)  # fmt: skip
def test_a_bad_study_is_refused_with_its_field(load, text, field, reason):
    error = refusal(load, text)
    assert error.field == field
    assert reason in error.reason
    assert error.line is not None
    assert "\n" not in str(error)


def test_former_names_of_measures_mean_the_same_in_si_units(load):
    text = GRID + "parameters: {p: {path: ground.scale, values: [1, 2]}}\n"
    model = load(
        text + "measures: [peak_force_MN, energy_MJ]\nfigures: [{x: p, y: peak_force_MN}]\n"
    ).model
    assert model.measures == ("peak_force_N", "energy_initial_J")
    assert model.figures[0].y == "peak_force_N"
    with pytest.raises(ScenarioError, match="is reserved"):
        load(text.replace("p:", "peak_force_MN:", 1))


def test_strict_yaml_is_that_of_scenarios(load):
    assert "duplicate key" in refusal(load, HEAD + "title: again\n").reason
    assert "anchors" in refusal(load, HEAD + "description: &a x\n").reason


def test_unknown_studies_are_named():
    with pytest.raises(ScenarioError, match="did you mean 'six_variations'"):
        load_study("six_variation")


def test_from_text_and_from_data_are_the_same(load):
    text = """\
version: 1
title: study
scenario: base_train
design: one_at_a_time
parameters:
  speed: {path: train.speed_kmh, percent: [-10, 10]}
"""
    data = {
        "scenario": "base_train",
        "design": "one_at_a_time",
        "parameters": {"speed": {"path": "train.speed_kmh", "percent": [-10, 10]}},
    }
    a, b = (designs.make(s) for s in (load(text), study_from(data)))
    assert [p.columns for p in a] == [p.columns for p in b]
    assert [p.columns["speed"] for p in a] == [60, 54, 66]


def test_changes_are_checked_too(load):
    with pytest.raises(ScenarioError, match="ensemble"):
        load().changed(ensemble=0)
    assert load().changed(ensemble=7).model.ensemble == 7
    assert load().with_overrides({"train.speed_kmh": 33}).scenario.model.train.speed_kmh == 33
