"""Summary, figures, tables, comparisons, films: what comes out of a recording."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from derail_ros import cli
from derail_ros.recording import record_run
from derail_ros.recording.derived_outcome import derive_outcome
from derail_ros.recording.reader import read_bag
from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.review import comparison, drawing, figures, film, histories, plots, summary
from derail_ros.vocabulary import words
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.status import CORNERS
from msg_adapters.definitions import deserialize
from tests.nodes.support import SMALL, simulation, small


def refuses(text: str, arguments: list[str], capsys) -> None:
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("derail: ")
    assert text in error
    assert "\n" not in error


# --- words and summary -----------------------------------------------------------------------


def test_the_summary_holds_what_the_recording_does(run: RecordedRun) -> None:
    facts = summary.findings(run)
    json.dumps(facts, allow_nan=False)
    assert facts["outcome"]["derailed_cars"] == list(run.outcome.derailed_cars)
    assert facts["outcome"]["peak_force_N"] == run.outcome.peak_force
    assert len(facts["collisions"]) == len(run.collisions)
    forces = [c["peak_force_N"] for c in facts["collisions"]]
    assert forces == sorted(forces, reverse=True)
    assert forces[0] == pytest.approx(run.outcome.peak_force)
    for car in facts["cars"]:
        i = car["car"] - 1
        assert (car["derailed"] is not None) == (car["car"] in run.outcome.derailed_cars)
        if car["derailed"]:
            assert car["derailed"]["time_s"] == run.outcome.derail_time[i]
        assert car["parted_rear"] is None or not run.coupled[-1, i]
        struck = [c for c in run.collisions if car["car"] in (c.car_a, c.car_b)]
        assert len(car["struck"]) == len(struck)


def test_forces_in_the_train_have_place_and_time_and_limits(run: RecordedRun) -> None:
    largest, car, time = run.outcome.largest("draft")
    told = dict(run.outcome.couplings)
    factor = 7.5e6 / largest
    told["max_draft_N"] = told["max_draft_N"] * factor
    hard = replace(run, outcome=replace(run.outcome, couplings=told))
    facts, text = summary.findings(hard), summary.text(hard)
    assert any("7.5 MN, above the 2.89 MN at which knuckles break" in x for x in facts["limits"])
    assert "The largest draft force is 7.5 MN" in text
    assert f"7.50  (between cars {car} and {car + 1} at {time:.2f} s)" in text
    breaks = dict(run.scenario) | {"couplers": {"knuckle_strength_N": 2.89e6}}
    assert not any(
        "draft" in x for x in summary.findings(replace(hard, scenario=breaks))["limits"]
    )


def test_a_summary_says_that_it_is_one_run_and_with_which_constants(run: RecordedRun) -> None:
    head = summary.text(run).split("\n\n")[1]
    assert "This is one possible run, with published constants" in head


def test_parts_that_touch_while_they_separate(run: RecordedRun) -> None:
    c = run.collisions[0]
    assert "closing at 3.4 m/s" in replace(c, closing_speed=3.4).text
    assert "separating at 3.4 m/s" in replace(c, closing_speed=-3.4).text


def test_the_timeline_is_in_order_and_leaves_nothing_out(run: RecordedRun) -> None:
    line = summary.timeline(run)
    times = [e["time_s"] for e in line]
    assert times == sorted(times)
    for kind in ("truck_derailed", "coupler_parted", "rail_break_set", "run_ended"):
        there = sum(e["kind"] == kind for e in line)
        assert there == sum(e.kind.word == kind for e in run.events), kind
    hard = [c for c in run.collisions if c.peak_force >= summary.NOTABLE]
    assert sum(e["kind"] == "collision" for e in line) == len(hard)
    rested = {c for e in line if e["kind"] == "car_at_rest" for c in e["cars"]}
    assert rested == {e.cars[0] for e in run.events if e.kind == EventKind.CAR_AT_REST}


def test_shares_of_the_energy_add_up(run: RecordedRun) -> None:
    taken = sum(row["share"] for row in summary.findings(run)["stopped_by"]["shares"])
    left = run.energy["kinetic"][-1] + run.energy["striker"][-1]
    left += run.energy["knuckle"][-1] - run.energy["external"][-1]
    assert taken + left / run.energy["initial"][0] == pytest.approx(1.0, abs=1e-3)
    assert "the brakes" in summary.headline(run)[1]


def test_plain_words(run: RecordedRun) -> None:
    assert words.number_list([1, 2, 3, 5, 7, 8]) == "1 to 3, 5, 7, 8"
    assert words.number_list([]) == "none"
    assert words.force(27.5e6) == "27.5 MN"
    assert words.force(3.4e5) == "340 kN"
    assert words.energy(1.79e9) == "1.79 GJ"
    assert words.energy(12_300.0) == "12.3 kJ"
    assert words.speed(25.0) == "25.0 m/s (90 km/h)"
    for e in run.events:
        text = e.text
        assert text
        assert "nan" not in text
    text = summary.text(run)
    assert "nan" not in text
    for car in run.outcome.derailed_cars:
        assert f"Car {car}" in text


def test_a_quiet_run_can_be_told_and_drawn(run: RecordedRun, tmp_path: Path) -> None:
    """Nothing derails, nothing collides, no ledger: still a summary and figures."""
    calm = replace(
        run,
        events=(),
        collisions=(),
        energy={},
        truck_on=np.ones_like(run.truck_on),
        coupled=np.ones_like(run.coupled),
        outcome=replace(
            run.outcome,
            derailed_cars=(),
            peak_force=0.0,
            peak_force_pair=None,
            peak_force_time=math.nan,
            car_peak_force=np.zeros(run.n),
            car_peak_other=np.zeros(run.n, dtype=np.int64),
            car_peak_time=np.full(run.n, np.nan),
            derail_time=np.full(run.n, np.nan),
            energy={},
            rear_part_first_car=0,
        ),
    )
    facts = summary.findings(calm)
    assert "No car derailed" in summary.text(calm, facts)
    peaks = figures.peak_forces(calm.outcome)
    for figure in (plots.speeds(calm), plots.space_time(calm), peaks):
        drawing.save(figure, tmp_path / "figure.png", dpi=50)
    assert plots.energy_over_time(calm) is None
    assert plots.main_collisions(calm) == []


def test_labels_are_pushed_apart_and_keep_their_order() -> None:
    places = plots.apart([0.0, 0.1, 0.15, 5.0, 5.0, 5.0], 1.0)
    assert all(b - a >= 1.0 - 1e-9 for a, b in zip(places[:-1], places[1:]))
    assert np.mean(places[:3]) == pytest.approx(np.mean([0.0, 0.1, 0.15]))


# --- the commands ----------------------------------------------------------------------------


def test_review_writes_everything(bag, run, tmp_path, capsys) -> None:
    from PIL import Image

    out = tmp_path / "review"
    assert cli.main(["review", str(bag), "-o", str(out)]) == 0
    assert summary.headline(run)[1] in capsys.readouterr().out
    names = {p.name for p in out.iterdir()}
    wanted = {"summary.txt", "summary.json", "replay.html", "final_scene.png", "peak_forces.png"}
    wanted |= {"speeds.png", "energy.png", "space_time.png", "collision_1.png"}
    assert wanted <= names
    facts = json.loads((out / "summary.json").read_text())
    assert (facts["schema"], facts["schema_version"]) == ("derail_ros/review", 2)
    for path in out.glob("*.png"):
        image = np.asarray(Image.open(path).convert("L"))
        assert image.std() > 5.0, f"{path.name} is empty"
    refuses("is not empty", ["review", str(bag), "-o", str(out)], capsys)


def test_review_as_json(bag, tmp_path, capsys) -> None:
    arguments = ["review", str(bag), "-o", str(tmp_path / "r"), "--json"]
    assert cli.main([*arguments, "--no-figures", "--no-replay"]) == 0
    assert json.loads(capsys.readouterr().out)["schema_version"] == 2
    assert {p.name for p in (tmp_path / "r").iterdir()} == {"summary.txt", "summary.json"}


@pytest.mark.parametrize("command", ["review", "export", "animate", "compare", "repair", "play"])
def test_mistakes_are_told_in_a_line(command, tmp_path, capsys) -> None:
    place = str(tmp_path / "nothing")
    more = {
        "review": ["-o", str(tmp_path / "x")],
        "export": ["-o", str(tmp_path / "x")],
        "animate": ["-o", str(tmp_path / "x.gif")],
        "compare": [place],
    }.get(command, [])
    refuses("no such file or folder", [command, place, *more], capsys)
    assert not (tmp_path / "x").exists()


# --- export ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_exported_numbers_are_those_of_the_messages(bag, run, tmp_path, form) -> None:
    out = tmp_path / "tables"
    assert cli.main(["export", str(bag), "-o", str(out), "--format", form]) == 0
    tables = {}
    for path in out.iterdir():
        if form == "csv":
            with path.open(encoding="utf-8", newline="") as file:
                rows = list(csv.DictReader(file))
            tables[path.stem] = {k: [r[k] for r in rows] for k in rows[0]}
        else:
            import pyarrow.parquet as parquet  # of the extra studies

            tables[path.stem] = parquet.read_table(path).to_pydict()
    assert set(tables) == {
        "cars",
        "strikers",
        "couplings",
        "energy",
        "collisions",
        "events",
        "consist",
        "files",
    }
    cars, couplings = tables["cars"], tables["couplings"]
    assert len(cars["time_s"]) == len(run.time) * run.n
    assert len(couplings["time_s"]) == len(run.time) * (run.n - 1)
    assert len(tables["events"]["time_s"]) == len(run.events)
    k = touching = 0
    with Reader(bag) as reader:
        chosen = [c for c in reader.connections if c.topic == "/train_state"]
        for _, _, data in list(reader.messages(chosen))[::40]:
            m = deserialize(data, "derail_msgs/msg/TrainState")
            row = next(i for i, t in enumerate(cars["time_s"]) if float(t) == m.time)
            for field, name in histories.columns_of("TrainState", "N").items():
                for i in range(run.n):
                    assert float(cars[name][row + i]) == float(getattr(m, field)[i]), name
            for field, pattern in histories.columns_of("TrainState", "4 N").items():
                for j in range(4 * run.n):
                    name = pattern.format(CORNERS[j % 4].replace(" ", "_"))
                    cell, sent = cars[name][row + j // 4], float(getattr(m, field)[j])
                    if math.isnan(sent):
                        assert cell == "" or math.isnan(float(cell)), name
                    else:
                        assert float(cell) == sent, name
                        touching += field == "corner_gap"
            for axis in "xy":
                total = sum(
                    getattr(m, f"ground_force_{part}_{axis}") for part in ("front", "rear", "body")
                )
                written = cars[f"ground_force_total_{axis}_N"][row : row + run.n]
                assert [float(cell) for cell in written] == list(total)
            k += 1
    assert k > 5
    assert touching > 5, "corners in contact among the states looked at"
    assert float(tables["energy"]["kinetic_J"][-1]) == run.energy["kinetic"][-1]
    hardest = summary.by_severity(run)[0]
    assert float(tables["collisions"]["peak_force_N"][0]) == hardest.peak_force


SIZES = {"TrainState": ("N", "4 N"), "CouplerStates": ("N-1", "N")}
COLUMNS = {kind: [histories.columns_of(kind, size) for size in SIZES[kind]] for kind in SIZES}


@pytest.mark.parametrize("kind", SIZES)
def test_every_field_of_the_states_is_exported(kind) -> None:
    from msg_adapters.definitions import field_names

    exported = {field for columns in COLUMNS[kind] for field in columns}
    known = {"header", "run_id", "step", "time", "more"}
    assert set(field_names(f"derail_msgs/msg/{kind}")) == exported | known


def test_columns_have_their_units() -> None:
    unitless = {"coupled", "truck_front_on_rails", "truck_rear_on_rails", "corner_other_car_{}"}
    units = ("_m", "_rad", "_m_s", "_rad_s", "_m_s2", "_rad_s2", "_N", "_N_m", "_J", "_s", "_kg")
    names = [n for of in COLUMNS.values() for columns in of for n in columns.values()]
    assert {n for n in names if not n.endswith(units)} == unitless
    for name in ("x_m", "yaw_acceleration_rad_s2", "ground_moment_N_m", "corner_gap_{}_m"):
        assert name in names


def test_texts_that_look_like_formulas_stay_texts(run, tmp_path) -> None:
    cars = replace(run.cars, name=("=1+1", "@x", *run.cars.name[2:]))
    histories.export(replace(run, cars=cars), tmp_path, "csv")
    with (tmp_path / "consist.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["name"] for r in rows[:2]] == ["'=1+1", "'@x"]
    assert [r["contents"] for r in rows] == list(run.cars.contents), "no text is no formula"


def test_what_the_scenario_was_made_from_is_told(run, tmp_path) -> None:
    made = replace(run, files={"yard.yaml": b"abc", "cars.csv": b""})
    # of "abc": FIPS 180-2, appendix B.1
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    facts = summary.findings(made)
    assert facts["scenario"]["files"]["yard.yaml"] == digest
    assert f"made from yard.yaml sha256:{digest}" in summary.text(made, facts)
    histories.export(made, tmp_path, "csv")
    with (tmp_path / "files.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["name"], r["bytes"]) for r in rows] == [("yard.yaml", "3"), ("cars.csv", "0")]
    assert rows[0]["sha256"] == digest


def test_another_format_is_refused(bag, tmp_path, capsys) -> None:
    arguments = ["export", str(bag), "-o", str(tmp_path / "x"), "--format", "xls"]
    refuses("csv or parquet", arguments, capsys)


# --- compare ---------------------------------------------------------------------------------


def test_a_run_is_the_same_as_itself(run) -> None:
    facts = comparison.compare(run, run)
    assert facts["same_events"]
    assert facts["first_difference_s"] is None
    assert not facts["settings"]
    assert "the same to the bit" in comparison.text(facts)


def test_differences_are_found(run, tmp_path) -> None:
    k, parted = next(
        (k, e) for k, e in enumerate(run.events) if e.kind == EventKind.COUPLER_PARTED
    )
    others = [e for i, e in enumerate(run.events) if i != k]
    j = next(
        i for i, e in enumerate(others) if e.kind == EventKind.TRUCK_DERAILED and e.time > 0.5
    )
    later = replace(others[j], time=others[j].time + 0.25)
    others[j] = later
    scenario = {**run.scenario, "title": "another"}
    other = replace(
        run,
        events=tuple(others),
        scenario=scenario,
        title="another",
        outcome=replace(run.outcome, derailed_cars=run.outcome.derailed_cars[:-1]),
    )
    facts = comparison.compare(run, other)
    json.dumps(facts, allow_nan=False)
    assert not facts["same_events"]
    assert [e["cars"] for e in facts["events_only_in_first"]] == [list(parted.cars)]
    assert facts["events_at_other_times"][0]["difference_s"] == pytest.approx(0.25)
    assert facts["first_difference_s"] == pytest.approx(min(parted.time, later.time - 0.25))
    assert facts["derailed_only_in_first"] == [run.outcome.derailed_cars[-1]]
    assert facts["settings"] == [
        {"path": "title", "first": run.scenario["title"], "second": "another"}
    ]
    drawing.save(comparison.scenes(run, other), tmp_path / "scenes.png", dpi=50)


def test_the_key_of_two_scenes_explains_both(run) -> None:
    """A state that only one of them shows is in it too."""
    calm = replace(run, truck_on=np.ones_like(run.truck_on), coupled=np.ones_like(run.coupled))
    for pair in ((run, calm), (calm, run)):
        figure = comparison.scenes(*pair)
        labels = {t.get_text() for t in figure.legends[-1].get_texts()}
        assert {"on the rails", "derailed, uncoupled", "parted"} <= labels
        assert not any("(" in label for label in labels), "numbers would be of one only"


def test_compare_command(bag, sqlite_bag, tmp_path, capsys) -> None:
    out = tmp_path / "compared"
    assert cli.main(["compare", str(bag), str(sqlite_bag), "-o", str(out)]) == 0
    assert "same to the bit" in capsys.readouterr().out
    names = {p.name for p in out.iterdir()}
    assert names == {"comparison.txt", "comparison.json", "scenes.png"}


# --- films -----------------------------------------------------------------------------------


def test_a_gif_has_its_pictures(bag, tmp_path) -> None:
    from PIL import Image

    path = tmp_path / "film.gif"
    arguments = ["animate", str(bag), "-o", str(path), "--start", "2", "--end", "4"]
    assert cli.main([*arguments, "--fps", "5", "--rate", "1", "--width", "480"]) == 0
    with Image.open(path) as film:
        assert film.n_frames == 11
        assert film.size[0] == 480
        assert film.info["duration"] == 200
        first = np.asarray(film.convert("L"))
        film.seek(10)
        assert np.abs(np.asarray(film.convert("L")).astype(int) - first).max() > 50


def test_a_film_tells_how_far_it_is(bag, tmp_path, monkeypatch) -> None:
    """By a bar that counts the pictures."""
    from rich.console import Console

    from derail_ros.commands import common

    arguments = ["animate", str(bag), "-o", str(tmp_path / "film.gif"), "--start", "2"]
    arguments += ["--end", "4", "--fps", "5", "--rate", "1", "--width", "320"]
    terminal = Console(file=io.StringIO(), force_terminal=True, width=80)
    monkeypatch.setattr(common, "err", lambda: terminal)
    assert cli.main(arguments) == 0
    assert "11/11" in terminal.file.getvalue()


@pytest.mark.parametrize("width", [kind.width for kind in film.KINDS.values()])
@pytest.mark.parametrize("metres", [80.0, 200.0, 600.0])
def test_numbers_in_a_film_can_be_read(run, monkeypatch, metres, width) -> None:
    """At any scale of the site: none under 10 pixels at the usual widths, none on another."""
    x, y = run.pose[-1, :, :2].mean(axis=0)
    window = (x - metres / 2, x + metres / 2, y - metres / 4, y + metres / 4)
    monkeypatch.setattr(film.drawing, "stage", lambda scene: window)
    stage = film.Stage(run, width)
    stage.picture(float(run.time[-1]))
    shown = [t for t in stage.numbers if t.get_visible()]
    assert shown
    renderer = stage.figure.canvas.get_renderer()
    boxes = [t.get_window_extent(renderer) for t in shown]
    assert min(t.get_size() * film.DPI / 72.0 for t in shown) >= 10.0
    for k, box in enumerate(boxes):
        for other in boxes[:k]:
            assert not box.overlaps(other)


def test_a_run_that_its_time_limit_ends_is_not_said_to_be_at_rest(
    tmp_path, run: RecordedRun
) -> None:
    text = SMALL + "\nintegration: {time_limit_s: 2.0}\n"
    record_run(simulation(text), small(text), tmp_path / "cut")
    cut = read_bag(tmp_path / "cut")
    assert cut.outcome.status == "time limit"
    assert cut.outcome.final
    facts = summary.findings(cut)
    assert facts["outcome"]["duration_s"] is None
    assert f"ended by its time limit, not at rest, at {cut.outcome.time:.1f} s" in facts["text"]
    said = summary.text(cut)
    assert "time limit" in said
    for wrong in ("at rest after", "time to rest", "rear part stands"):
        assert wrong not in said
    assert f"at rest after {run.outcome.duration:.1f} s" in summary.text(run)


@pytest.mark.parametrize(
    ("status", "said"),
    [
        ("running", "still running at 3.0 s"),
        ("stopped", "stopped by a command at 3.0 s"),
        ("void", "void (a virtual body reached a break) at 3.0 s"),
        ("failed", "failed at 3.0 s"),
        ("cut off", "recorded up to 3.0 s"),
    ],
)
def test_what_ended_a_run_is_said(run: RecordedRun, status, said) -> None:
    cut = replace(
        run,
        outcome=replace(
            run.outcome, status=status, time=3.0, duration=math.nan, rear_part_coordinate=-9.0
        ),
    )
    facts = summary.findings(cut)
    assert said in facts["text"]
    assert facts["outcome"]["duration_s"] is facts["outcome"]["rear_stop_m"] is None
    assert "at rest after" not in summary.text(cut)
    rested = replace(run, outcome=replace(run.outcome, rear_part_coordinate=-9.0))
    assert summary.findings(rested)["outcome"]["rear_stop_m"] == -9.0


def test_a_run_that_a_command_ended_is_known_by_its_events_too(run: RecordedRun) -> None:
    *before, last = run.events
    assert last.kind == EventKind.RUN_ENDED
    by_command = replace(run, events=(*before, replace(last, cause="command")))
    for events, status, rests in ((run, "at rest", True), (by_command, "stopped", False)):
        found = derive_outcome(events)
        assert (found.status, math.isfinite(found.duration)) == (status, rests)


@pytest.mark.parametrize(
    ("n", "said"), [(0, "no car derailed"), (1, "1 car derailed"), (2, "2 cars derailed")]
)
def test_the_number_of_cars_derailed(run: RecordedRun, n, said) -> None:
    few = replace(run, outcome=replace(run.outcome, derailed_cars=tuple(range(1, n + 1))))
    assert summary.findings(few)["text"].startswith(f"{words.capital(said)}, ")


@pytest.mark.parametrize(("prefix", "words"), [("zz", "no run begins with 'zz'")])
def test_a_run_that_is_not_there(bag, tmp_path, capsys, prefix, words) -> None:
    refuses(words, ["review", str(bag), "-o", str(tmp_path / "x"), "--run", prefix], capsys)


def test_the_rear_part_is_one_only_where_the_train_parted(run) -> None:
    behind = replace(run.outcome, rear_part_first_car=7, rear_part_coordinate=-12.0)
    whole = replace(run, outcome=behind, coupled=np.ones_like(run.coupled))
    assert "still on the rails" in summary.text(whole)
    assert "rear part" not in summary.text(whole)
    coupled = np.ones_like(run.coupled)
    coupled[-1, 3] = False
    assert "rear part stands" in summary.text(replace(whole, coupled=coupled))
    coupled[-1, 3], coupled[-1, 7] = True, False  # behind that car
    assert "rear part" not in summary.text(replace(whole, coupled=coupled))


def test_a_run_of_one_moment_is_drawn_without_a_word(run, tmp_path) -> None:
    from derail_ros.commands.recordings import write_figures

    first = {
        name: getattr(run, name)[:1]
        for name in (
            "time",
            "pose",
            "velocity",
            "coupler_yaw",
            "truck_on",
            "coupled",
            "brake_force",
            "corner_force",
        )
    }
    energy = {name: values[:1] for name, values in run.energy.items()}
    short = replace(
        run,
        **first,
        energy_time=run.energy_time[:1],
        energy=energy,
        collisions=(),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "speeds.png" in write_figures(short, tmp_path)


def test_an_mp4_has_its_pictures(bag, tmp_path) -> None:
    path = tmp_path / "film.mp4"
    arguments = ["animate", str(bag), "-o", str(path), "--start", "2", "--end", "4"]
    assert cli.main([*arguments, "--fps", "10", "--width", "480", "--rate", "2"]) == 0
    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    assert about["size"][0] == 480
    assert sum(1 for _ in reader) == 11
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


def test_of_a_damaged_recording_and_its_repair_the_repair_is_read(bag, tmp_path, capsys) -> None:
    (file,) = bag.glob("*.mcap")
    for place in ("folder/run/run_0.mcap", "file/run.mcap"):
        damaged = tmp_path / place
        damaged.parent.mkdir(parents=True)
        damaged.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        folder = tmp_path / place.split("/")[0]
        of = folder / place.split("/")[1]
        assert cli.main(["repair", str(of)]) == 0
        film_of = ["animate", str(folder), "-o", str(tmp_path / "film.gif"), "--width", "320"]
        assert cli.main([*film_of, "--end", "0.5"]) == 0
        warning = f"read in place of {of.name}, from which it was repaired"
        assert warning in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-o", "film.avi"], ".mp4 or .gif"),
        (["-o", "film.gif", "--start", "1e6"], "--start: 1e+06 s is not before its end"),
        (["-o", "film.gif", "--rate", "0"], "above zero"),
        (["-o", "film.gif", "--rate", "1e-6"], "too many"),
    ],
)
def test_films_that_cannot_be(bag, tmp_path, monkeypatch, capsys, arguments, text) -> None:
    monkeypatch.chdir(tmp_path)
    refuses(text, ["animate", str(bag), *arguments], capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_films_that_cannot_be_written(bag, tmp_path, capfd, kind) -> None:
    """One line, and before the pictures are made; nothing is left behind."""
    (tmp_path / f"folder.{kind}").mkdir()
    (tmp_path / "file").touch()
    for name, text in ((f"folder.{kind}", "is a folder"), (f"file/film.{kind}", "file")):
        before = sorted(tmp_path.rglob("*"))
        refuses(text, ["animate", str(bag), "-o", str(tmp_path / name)], capfd)
        assert sorted(tmp_path.rglob("*")) == before


def test_what_ffmpeg_complains_of_is_one_line(run: RecordedRun, tmp_path, monkeypatch) -> None:
    ffmpeg = tmp_path / "ffmpeg"
    ffmpeg.write_text("#!/bin/sh\necho 'several lines' >&2\necho 'no encoder' >&2\nexit 1\n")
    ffmpeg.chmod(0o755)
    monkeypatch.setattr(film, "_ffmpeg", lambda: str(ffmpeg))
    with pytest.raises(film.FilmError) as caught:
        film.film(run, tmp_path / "film.mp4", start=1.0, end=1.2, width=320)
    assert re.fullmatch("ffmpeg: .+", str(caught.value))
    assert [p.name for p in tmp_path.iterdir()] == ["ffmpeg"]


# --- a large recording -----------------------------------------------------------------------

MEASURE = """
import pathlib, sys
from derail_ros import cli
assert cli.main(["review", sys.argv[1], "-o", sys.argv[2]]) == 0
# Its own peak: ru_maxrss would begin with that of the process that started this one.
status = pathlib.Path("/proc/self/status").read_text()
used = int(status.partition("VmHWM:")[2].split()[0]) / 1024
print(f"{used:.0f}", file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_100_mb_are_reviewed_in_500_mb(tmp_path) -> None:
    import subprocess

    from derail_ros.engine import PlanarSimulation
    from derail_ros.recording import record_run
    from derail_ros.scenario import load_scenario

    scenario = load_scenario("mississauga")
    path = tmp_path / "large"
    record_run(PlanarSimulation(scenario.to_params()), scenario, path, state_rate=560.0)
    size = sum(f.stat().st_size for f in path.iterdir()) / 1e6
    assert size > 100.0
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path), str(tmp_path / "review")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert float(done.stderr.strip().splitlines()[-1]) < 500.0
    whole = read_bag(path)
    assert whole.outcome.final


@pytest.mark.slow
def test_the_film_of_half_a_minute_is_below_2_mb(tmp_path) -> None:
    from derail_ros import models
    from derail_ros.scenario import load_scenario

    scenario = load_scenario("mississauga")
    record_run(models.build(scenario.to_params()), scenario, tmp_path / "run")
    film.film(read_bag(tmp_path / "run"), tmp_path / "film.gif")
    assert (tmp_path / "film.gif").stat().st_size < 2e6
