"""The page on the earlier models: what stands on it comes from the runs."""

import re

import numpy as np
import pytest

from derail_ros.baselines.models import MODELS, run_model
from derail_ros.scenario import load_scenario
from derail_ros.studies.accidents import load_statistics
from derail_ros.studies.ensemble import member_factor, vary
from derail_ros.studies.published import load_published
from derail_ros.studies.records import Ensemble
from derail_ros.vocabulary.measures import failed_record
from research import baselines as page
from research.pages import BEGIN, DOCS, END, Options, fill, missing_markers

SHORT = {"train.consist.0.count": 14}
SCOPE = page.Scope(
    speeds=(30.0, 48.0),
    scene_speed=48.0,
    fast=(96.0,),
    classes=2,
    choice_speeds=(65.0,),
    trains=("mississauga", "yang_manos_base"),
    limits=(3e6, 20e6),
    frictions=(1.0, 2.0),
    tuned_speeds=(48.0,),
)


@pytest.fixture(scope="module")
def cases():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "REPEATS", 1)  # its times are nobody's
        return page.compute(page.trials_of(SCOPE, 2), jobs=1)


@pytest.fixture(scope="module")
def written(cases, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    path = folder / "page.md"
    page.write_results(Options(path, members=2, jobs=1), None, cases, SCOPE)
    return path


def table(text, block, heading=None):
    """Rows of a table of a block: first cell -> the others."""
    part = text.split(BEGIN.format(block))[1].split(END)[0]
    tables = [t for t in part.split("\n\n") if t.lstrip().startswith("|")]
    chosen = next(t for t in tables if heading is None or t.lstrip().startswith(f"| {heading}"))
    lines = [[c.strip() for c in x.strip("| ").split(" | ")] for x in chosen.strip().splitlines()]
    return {line[0].strip("`*"): line[1:] for line in lines if "---" not in line[0]}


def runs(scenario, model, members, **overrides):
    params = load_scenario(scenario).with_overrides(overrides).to_params()
    return [run_model(model, vary(params, member_factor(0, i))).record for i in range(members)]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["planar", "yang-manos", "anderson"])
def test_figures_are_means_and_deviations_of_runs(written, model):
    text = written.read_text(encoding="utf-8")
    own = runs("base_train", model, 2, **{"train.speed_kmh": 48.0})
    for heading, key, digits in (("cars derailed", "cars_derailed", 1),
                                 ("time to rest (s)", "duration_s", 2)):  # fmt: skip
        values = np.array([r[key] for r in own])
        expected = f"{values.mean():.{digits}f} ± {values.std(ddof=1):.{digits}f}"
        assert table(text, "base_train", heading)[model][1] == expected
    scenes = table(text, "base_train", "scene")
    mean = [np.mean([r[k] for r in own]) for k in ("scene_length_m", "scene_width_m")]
    assert scenes[model][1] == f"{mean[0]:.0f} x {mean[1]:.0f}"


@pytest.mark.slow
def test_other_trains_and_models_without_a_push(written):
    text = written.read_text(encoding="utf-8")
    for name in ("mississauga", "yang_manos_base"):
        rows = table(text, name)
        assert [row for row in rows if row in MODELS] == list(MODELS)
        (alone,) = runs(name, "blockage", 1)
        assert rows["blockage"][0] == f"{alone['cars_derailed']:.1f}"
        assert rows["blockage"][2:5] == ["-", "-", "-"]
        assert all(float(row[5].split(" ")[0]) >= 0.0 for m, row in rows.items() if m in MODELS)
    peak = [r["peak_force_N"] * 1e-6 for r in runs("mississauga", "planar", 2)]
    expected = f"{np.mean(peak):.2f} ± {np.std(peak, ddof=1):.2f}"
    assert table(text, "mississauga")["planar"][2] == expected


@pytest.mark.slow
def test_published_rows(written):
    text = written.read_text(encoding="utf-8")
    known = {case.name: case.published for case in load_published().cases}
    counts = table(text, "base_train", "cars derailed")["published"]
    assert counts == [str(known[f"base_{v}"]["cars_derailed"]) for v in (30, 48)] == ["5", "10"]
    peaks = table(text, "base_train", "largest force")["published"]
    assert [float(p) for p in peaks] == [
        pytest.approx(known[f"base_{v}"]["peak_force_N"] * 1e-6) for v in (30, 48)
    ]
    row = table(text, "mississauga")["published"]
    assert [float(x) for x in row[:5]] == [24, 25.3, 23.09, 109, 41.7]
    assert table(text, "mississauga")["the accident"][:5] == ["24", "-", "-", "132", "39"]
    assert "published" not in table(text, "yang_manos_base")


@pytest.mark.slow
def test_tables_of_choices(written, cases):
    text = written.read_text(encoding="utf-8")
    row = table(text, "yang_manos_speed")["96"]
    assert row[0] == "-"
    assert row[-2:] == ["0", "1"]  # couplings parted, zig-zag
    lines = table(text, "yang_manos_accidents")
    slow, fast = (page.class_speed(one) for one in page.reported(SCOPE))
    classes = load_statistics().groups["all"]
    for v, one in ((slow, classes[-2]), (fast, classes[-1])):
        row = lines[f"{v:g}"]
        assert row[:2] == [str(one.reports), f"{one.mean:.1f} ± {one.error:.1f}"]
        mean = np.mean([r["cars_derailed"] for r in runs("base_train", "yang-manos", 2,
                                                          **{"train.speed_kmh": v})])  # fmt: skip
        assert row[2].startswith(f"{mean:.1f}")
        assert row[3] == f"{100.0 * mean / one.mean:.0f} %"
    choices = table(text, "yang_manos_choices")
    count = {name: float(cells[0].split(" ")[0]) for name, cells in choices.items()
             if name != "cars derailed of 61"}  # fmt: skip
    assert count["friction 2.0"] < count["friction 1.5"] < count["as configured"]
    assert count["as configured"] < count["brakes of 25 kN a car"] < count["no brakes"]
    assert count["the main model"] < count["the main model, no brakes"]
    limits = table(text, "anderson_limit")
    removed = limits["base train, 48 km/h: springs removed, mean"]
    assert float(removed[0]) > float(removed[1])
    friction = table(text, "roorda_gracie_friction")
    assert float(friction["friction 2"][0]) < float(friction["friction 1"][0])
    assert table(text, "joints")["six equal bars, 450 t"][1] == "-0.268"
    assert re.search(r"10000 trains .*: \d+\.\d s", text)
    images = sorted(p.name for p in (written.parent / "images").iterdir())
    assert images == sorted(page.figures(cases, SCOPE))
    assert all((written.parent / "images" / n).stat().st_size > 5000 for n in images)


@pytest.mark.slow
def test_a_page_is_filled_between_its_marks_only(written):
    text = written.read_text(encoding="utf-8").replace("## joints", "## By hand")
    again = fill(text, {"joints": "NEW", "about": "ABOUT"})
    assert "## By hand" in again
    assert "-0.268" not in again
    assert table(again, "mississauga") == table(text, "mississauga")
    assert fill(again, {"joints": "NEW", "about": "ABOUT"}) == again
    with pytest.raises(ValueError, match="no place for the results joints"):
        fill("# nothing", {"joints": "x"})


def test_the_page_has_a_place_for_every_result():
    text = (DOCS / "baselines.md").read_text(encoding="utf-8")
    assert missing_markers(text, page.NAMES) == []
    for image in re.findall(r"\((images/[a-z0-9_]+\.png)\)", text):
        assert (DOCS / image).stat().st_size > 5000
    # written by the command, with a place for nothing else
    assert set(re.findall(r"<!-- results: (\w+) -->", text)) == set(page.NAMES)
    assert "python -m research baselines" in text


def test_failed_and_void_runs_are_said():
    trial = page.Trial("base_30", "planar", "planar", "base_train", members=3)
    record = runs("base_train", "planar", 1, **{**SHORT, "train.speed_kmh": 20})[0]
    void = {**record, "void": True, "status": "void"}
    records = (record, void, failed_record("StepSizeError: x", 9.0))
    result = page.TrialResult(trial, Ensemble(records))
    assert page.with_spread(result) == f"{record['cars_derailed']:.1f}"
    words = page._left_out([result])
    assert words.startswith("\n\n- base_train, `planar`: ")
    assert page.measure(result, "wall_s") == f"{min(record['wall_s'], 9.0):.3f}"
    assert "1 of 3 failed (StepSizeError: x)" in words
    assert "1 of 3 void" in words


def test_power_law():
    v = np.array([30.0, 60.0, 90.0])
    assert page.power_law(v, 0.04 * v**1.4) == pytest.approx((0.04, 1.4))
