"""Accident reports: reading, averages, and the models on their trains."""

import csv
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.baselines import reenact
from derail_ros.baselines.models import run_model
from derail_ros.cli import main
from derail_ros.scenario import load_scenario
from derail_ros.studies import accidents as a
from derail_ros.studies.ensemble import ensemble_jobs
from derail_ros.studies.records import ensembles

YEARLY = {
    "RAILROAD": "BNSF", "INCDTNO": "A1", "YEAR4": "2010", "TYPE": "01", "TYPEQ": "1",
    "TYPTRK": "1", "TRNSPD": "040", "POSITON1": "012", "HEADEND1": "2", "LOADF1": "100",
    "EMPTYF1": "10", "LOADF2": "20", "EMPTYF2": "1", "TONS": "12100", "CAUSE": "T207 ",
}  # fmt: skip
PORTAL = {
    "Reporting Railroad Code": "BNSF", "Accident Number": "A1", "Accident Year": "2010",
    "Accident Type": "Derailment", "Equipment Type": "Freight Train", "Track Type": "Main",
    "Train Speed": "40", "First Car Position": "12", "Head End Locomotives": "2",
    "Loaded Freight Cars": "100", "Empty Freight Cars": "10", "Derailed Loaded Freight Cars": "20",
    "Derailed Empty Freight Cars": "1", "Gross Tonnage": "12,100",
    "Primary Accident Cause Code": "T207",
}  # fmt: skip


def write(path, *rows, heads=None):
    """A file of reports; the columns in another order than the reader's, one more before them."""
    heads = ["OTHER", *reversed(heads or list(rows[0]))]
    with open(path, "w", encoding="latin-1", newline="") as stream:
        out = csv.DictWriter(stream, heads, restval="Ã¤,\n x", quoting=csv.QUOTE_ALL)
        out.writeheader()
        out.writerows(rows)
    return path


@pytest.fixture
def many(tmp_path):
    """See :func:`many_reports`."""
    return many_reports(tmp_path / "many.txt")


def many_reports(path):
    """Two classes of speed, different causes, lengths and loads; numbers as in real reports."""
    rows = [
        YEARLY | {"INCDTNO": str(k), "TRNSPD": v, "POSITON1": "5", "LOADF1": cars,
                  "EMPTYF1": "0", "LOADF2": derailed, "EMPTYF2": "0",
                  "TONS": str(int(cars) * tons), "CAUSE": cause}
        for k, (v, cars, derailed, tons, cause) in enumerate(
            [("10", "60", "4", 100, "T207"), ("10", "60", "6", 100, "T220"),
             ("10", "20", "1", 50, "E53C"), ("12", "60", "9", 130, "T204"),
             ("25", "60", "10", 100, "T207"), ("25", "70", "14", 130, "H501"),
             ("25", "60", "12", 9, "T207")])
    ]  # fmt: skip
    return write(path, *rows)


@pytest.mark.parametrize("row", [YEARLY, PORTAL], ids=["yearly", "portal"])
def test_a_report(tmp_path, row):
    (report,) = a.read_reports([write(tmp_path / "x.csv", row)])
    assert report == a.Report(
        railroad="BNSF", number="A1", year=2010, speed_kmh=40 * 1.609344, cars=110, loaded=100,
        derailed=21, first=10, mass_kg=12100 * 907.18474 / 110, cause="T207",
    )  # fmt: skip
    assert report.behind == 101


@pytest.mark.parametrize(
    "other",
    [{"TYPE": "02"}, {"TYPEQ": "7"}, {"TYPTRK": "2"}, {"LOADF2": "0", "EMPTYF2": "0"},
     {"TRNSPD": ""}, {"TRNSPD": "0"}, {"LOADF1": "0", "EMPTYF1": "0"}, {"LOADF2": "110"},
     {"LOADF1": "991"}],
    ids=str,
)  # fmt: skip
def test_reports_that_are_left_out(tmp_path, other):
    path = write(tmp_path / "x.csv", YEARLY | other, YEARLY | {"INCDTNO": "A2"})
    assert [r.number for r in a.read_reports([path])] == ["A2"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_byte_order_mark_is_no_part_of_the_first_heading(tmp_path, encoding):
    path = tmp_path / "x.csv"
    with open(path, "w", encoding=encoding, newline="") as stream:
        out = csv.DictWriter(stream, list(YEARLY))
        out.writeheader()
        out.writerow(YEARLY)
    assert [r.number for r in a.read_reports([path])] == ["A1"]


def test_numbers_as_they_are_written(tmp_path):
    path = write(
        tmp_path / "x.csv", YEARLY | {"TRNSPD": "39.5", "TONS": "12,100.", "LOADF1": "100.0"}
    )
    (report,) = a.read_reports([path])
    assert (report.speed_kmh, report.loaded) == (39.5 * 1.609344, 100)
    assert report.mass_kg == 12100 * 907.18474 / 110


def test_a_report_in_two_files_counts_once_two_trains_of_it_twice(tmp_path):
    one = write(tmp_path / "1.csv", YEARLY, YEARLY | {"LOADF1": "50"})
    two = write(tmp_path / "2.csv", YEARLY, YEARLY | {"YEAR4": "2011"})
    reports = a.read_reports([one, two])
    assert [(r.cars, r.year) for r in reports] == [(110, 2010), (60, 2010), (110, 2011)]


@pytest.mark.parametrize("tons", ["0", "100", "30000"])
def test_a_weight_that_cannot_be_right_is_none(tmp_path, tons):
    (report,) = a.read_reports([write(tmp_path / "x.csv", YEARLY | {"TONS": tons})])
    assert report.mass_kg is None
    with pytest.raises(ValueError, match="BNSF A1: the mass of a car is not known"):
        reenact.train_of(load_scenario("base_train"), report)


def test_the_place_of_the_first_car_stays_within_the_train(tmp_path):
    for position, first in (("0", 1), ("1", 1), ("3", 1), ("4", 2), ("200", 110)):
        (report,) = a.read_reports([write(tmp_path / "x.csv", YEARLY | {"POSITON1": position})])
        assert (report.first, report.placed) == (first, position != "0")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "x.csv: is empty"),
        ("\n\n", "x.csv: is empty"),
        ("a,b\n1,2\n", "x.csv: line 1: has no column RAILROAD or Reporting Railroad Code"),
        ("\na,b\n1,2\n", "x.csv: line 2: has no column RAILROAD"),
        (None, "x.csv: line 3: has 3 columns, fewer than line 1"),
        ({"TRNSPD": "fast"}, "x.csv: line .*: TRNSPD: must be a number from 0 to .*, got 'fast'"),
        ({"TRNSPD": "39,5"}, "x.csv: line .*: TRNSPD: .* got '39,5'"),
        ({"TONS": "-5"}, "x.csv: line .*: TONS: must be a number from 0 to .*, got '-5'"),
        ({"LOADF1": "nan"}, "x.csv: line .*: LOADF1: .* got 'nan'"),
        ({"LOADF1": "1e9"}, "x.csv: line .*: LOADF1: .* got '1e9'"),
        ({"LOADF1": "9" * 400}, r"x.csv: line .*: LOADF1: .* to 1000, got '9{20}\.\.\.'"),
        ({"EMPTYF2": "1.5"}, "x.csv: line .*: EMPTYF2: must be a whole number, got '1.5'"),
        ({"YEAR4": ""}, "x.csv: line .*: YEAR4: is empty"),
    ],
    ids=[
        "empty",
        "blank lines",
        "no columns",
        "later heading",
        "short",
        "word",
        "comma",
        "negative",
        "nan",
        "exponent",
        "huge",
        "fraction",
        "no year",
    ],
)
def test_a_file_that_is_wrong_is_told_by_line_and_column(tmp_path, capsys, text, words):
    path = tmp_path / "x.csv"
    if isinstance(text, dict):
        write(path, YEARLY | text)
    elif text is None:
        write(path, YEARLY)
        whole = path.read_text(encoding="latin-1").replace("\n x", "")
        path.write_text(whole + '"a","b","c"\n', encoding="latin-1")
    else:
        path.write_text(text, encoding="latin-1")
    with pytest.raises(a.AccidentFileError, match=words):
        a.read_reports([path])
    assert main(["accidents", str(path)]) == 2
    out, err = capsys.readouterr()
    assert re.search(words, err)
    assert (err.count("\n"), out) == (1, "")


def test_binary_is_refused(tmp_path):
    path = tmp_path / "x.db3"
    path.write_bytes(bytes(range(256)) * 50)
    with pytest.raises(a.AccidentFileError, match=r"x\.db3"):
        a.read_reports([path])


def test_groups(many):
    reports = a.read_reports([many])
    sizes = {name: sum(r in group for r in reports) for name, group in a.GROUPS.items()}
    assert sizes == {
        "all": 7, "broken_rail": 5, "broken_rail_long": 5, "broken_rail_long_loaded": 5
    }  # fmt: skip
    assert a.Group(behind=58).words == "all causes, 58 or more cars behind"
    assert [r.behind for r in reports if r in a.Group(behind=58)] == [58, 58, 58, 58, 68, 58]
    assert (
        a.Group(("E53C",), 2, 0.5).words == "E53C, 2 or more cars behind, 50 % of the cars loaded"
    )


def test_averages(many):
    slow, fast = a.by_speed(a.read_reports([many]))
    assert (slow.reports, fast.reports) == (4, 3)
    assert slow.mean == np.mean([4, 6, 1, 9])
    assert slow.error == pytest.approx(np.std([4, 6, 1, 9], ddof=1) / 2.0)
    assert slow.speed_kmh == pytest.approx(10.5 * 1.609344)
    assert (fast.median, fast.q90) == (12.0, np.quantile([10, 12, 14], 0.9))
    assert (slow.low_kmh, slow.high_kmh) == pytest.approx((5 * 1.609344, 15 * 1.609344))
    assert slow.behind == np.mean([58, 58, 18, 58])
    assert slow.mass_kg == pytest.approx(np.mean([100, 100, 50, 130]) * 907.18474)
    assert fast.mass_kg == pytest.approx(115 * 907.18474)  # the third has no mass
    (one,) = a.by_speed(a.read_reports([many])[:1])
    assert one.error == 0.0
    (none,) = a.by_speed(replace(r, mass_kg=None) for r in a.read_reports([many])[:1])
    assert none.mass_kg is None


def test_a_speed_at_a_limit_belongs_to_the_class_below(tmp_path):
    rows = [YEARLY | {"INCDTNO": v, "TRNSPD": v} for v in ("5", "15", "16", "90", "91")]
    reports = a.read_reports([write(tmp_path / "x.csv", *rows)])
    numbers = [[r.number for r in chosen] for *_, chosen in a.in_classes(reports)]
    assert numbers == [["15"], ["16"], ["90"]]


def test_shipped_statistics(capsys):
    statistics = a.load_statistics()
    assert list(statistics.groups) == list(a.GROUPS)
    counts = {name: sum(c.reports for c in g) for name, g in statistics.groups.items()}
    assert list(counts.values()) == sorted(counts.values(), reverse=True)
    for name in a.GROUPS:
        for c in statistics.groups[name]:
            assert c.low_kmh < c.speed_kmh <= c.high_kmh
            assert c.mean >= 1.0
            assert c.median <= c.q90
            assert (c.error > 0.0) == (c.reports > 1)
    assert main(["accidents", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["years"] == list(statistics.years)
    assert told["groups"]["all"]["classes"][0]["reports"] == statistics.groups["all"][0].reports
    assert main(["accidents"]) == 0
    out = capsys.readouterr().out
    for name in a.GROUPS:
        words = a.GROUPS[name].words
        assert f"{words[0].upper()}{words[1:]}: {counts[name]} reports" in out


def test_the_train_of_a_report(tmp_path):
    (report,) = a.read_reports([write(tmp_path / "x.csv", YEARLY)])
    base = load_scenario("base_train")
    train = reenact.train_of(base, report)
    assert len(train.cars) == report.behind == 101
    assert {c.mass for c in train.cars} == {report.mass_kg}
    assert {c.brakes[0].weight for c in train.cars} == {report.mass_kg}
    own = base.to_params()
    for old, new in zip(own.cars, train.cars, strict=False):
        assert new.inertia / new.mass == pytest.approx(old.inertia / old.mass)
        assert replace(new, mass=old.mass, inertia=old.inertia, brakes=old.brakes) == old
    # the signal of the brakes has as far to go as in a train of this length
    lengths = [2.0 * c.pivot_distance + c.front.length + c.rear.length for c in train.cars]
    assert train.cars[-1].brakes[0].distance == pytest.approx(sum(lengths[:-1]), rel=0.02)
    assert train.initiation.speed == pytest.approx(report.speed_kmh / 3.6)
    # at its own mass, speed and length it is the base train
    same = replace(report, mass_kg=own.cars[0].mass, cars=60, first=1, speed_kmh=60.0)
    assert reenact.train_of(base, same) == own


def test_reenacted_counts_are_those_of_single_runs(many):
    reports = reenact.sample(a.read_reports([many]), 100)
    assert len(reports) == 6  # one has no mass
    late = reenact.Way("late", "planar", {"brakes.delay_s": 10.0})
    ways = (reenact.Way("now", "planar", {}), late)
    seen = []
    counts = reenact.reenact(reports, ways, jobs=2, progress=lambda *x: seen.append(x))
    assert seen == [(k, 12) for k in range(1, 13)]
    for settings, label in (({}, "now"), (late.settings, "late")):
        base = reenact.real_base_train(settings)
        alone = [run_model("planar", reenact.train_of(base, r)).record["cars_derailed"]
                 for r in reports]  # fmt: skip
        assert counts[label] == alone
    assert sum(counts["late"]) > sum(counts["now"])
    rows = reenact.averages(reports, counts)
    assert [n for n, *_ in rows] == [4, 2]
    n, speed, own, cells = rows[1]
    assert own.mean == 12.0
    assert cells["now"].mean == np.mean(counts["now"][4:])
    assert cells["now"].error == pytest.approx(np.std(counts["now"][4:], ddof=1) / math.sqrt(n))


def test_a_report_as_a_scenario(many, tmp_path, capsys):
    arguments = ["accidents", str(many), "--report", "3", "--set", "brakes.delay_s=10"]
    assert main(arguments) == 0
    path = tmp_path / "accident.yaml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    scenario = load_scenario(str(path))
    assert scenario.title == "BNSF 3, 2010: 60 cars at 19 km/h"
    (report,) = (r for r in a.read_reports([many]) if r.number == "3")
    late = reenact.real_base_train({"brakes.delay_s": 10.0})
    assert late.to_params().contact.inside == "held"
    assert scenario.to_params() == reenact.train_of(late, report)
    assert "cause T204: 60 freight cars, 60 of them loaded, car 3 the first" in path.read_text(
        encoding="utf-8"
    ).replace("\n ", "")


def test_a_report_without_the_place_of_the_first_car_says_so(tmp_path):
    (report,) = a.read_reports([write(tmp_path / "x.csv", YEARLY | {"POSITON1": "0"})])
    told = reenact.told_scenario(load_scenario("base_train"), report).description
    assert "the first one involved not given (here: car 1)" in told


@pytest.mark.parametrize("delay", [0.0, 10.0])
def test_mean_trains_beside_what_was_reported(delay):
    """As the thesis found with statistics of its time: 10 s late as many, at once too few."""
    base = reenact.real_base_train({"brakes.delay_s": delay})
    classes = a.load_statistics().groups["broken_rail_long"][1:5]  # 24 to 89 km/h
    assert min(one.reports for one in classes) >= 40
    trains = [reenact.scenario_of(base, reenact.mean_report(one)) for one in classes]
    runs = ensembles(
        (job for k, train in enumerate(trains) for job in ensemble_jobs(train, 6, key=str(k))),
        jobs=2,
    )
    counts = [runs[str(k)].mean()["cars_derailed"] for k in range(len(classes))]
    ratios = [n / one.mean for n, one in zip(counts, classes, strict=True)]
    if delay:
        assert all(0.85 < ratio < 1.15 for ratio in ratios)
    else:
        assert all(ratio < 0.95 for ratio in ratios)


def test_mean_trains_by_the_command(capsys):
    arguments = ["accidents", "--broken-rail", "--behind", "50", "-m", "blockage"]
    assert main([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    classes = a.load_statistics().groups["broken_rail_long"]
    for row, one in zip(told["mean_trains"], classes, strict=True):
        assert row["cars"] == round(one.behind)
        assert row["mass_kg"] == one.mass_kg
        assert row["reported"] == {"mean": one.mean, "error": one.error, "reports": one.reports}
        train = reenact.train_of(load_scenario("base_train"), reenact.mean_report(one))
        alone = run_model("blockage", train).record["cars_derailed"]
        assert row["models"] == {"blockage": alone}
    assert main([*arguments[:-1], "bar-1"]) == 0  # the quickest model
    assert "broken rail, 50 or more cars behind" in capsys.readouterr().out


def test_sample_takes_at_most_so_many_of_a_class_and_the_same_again(tmp_path):
    rows = [YEARLY | {"INCDTNO": str(k), "TRNSPD": "40" if k < 50 else "10"} for k in range(55)]
    reports = a.read_reports([write(tmp_path / "x.csv", *rows)])
    few = reenact.sample(reports, 10, seed=3)
    assert sorted(r.speed_kmh > 50 for r in few) == [False] * 5 + [True] * 10
    assert few == reenact.sample(reports, 10, seed=3)
    assert few != reenact.sample(reports, 10, seed=4)
    assert len(set(few)) == 15


def test_agreement():
    reports = [replace(REPORT, derailed=n, speed_kmh=v) for n, v in ((2, 90), (4, 20), (12, 50))]
    found = reenact.agreement(reports, [4.0, 5.0, 30.0])
    assert found.trains == 3
    assert found.ratio == pytest.approx(39 / 18)
    assert found.rms == pytest.approx(math.sqrt((4 + 1 + 324) / 3))
    assert found.rank == pytest.approx(1.0)
    assert found.within == pytest.approx(2 / 3)  # twice as many still counts
    assert reenact.agreement(reports, [4.0, None, 30.0]).trains == 2
    assert reenact.rank_correlation(reports, [r.speed_kmh for r in reports]) == pytest.approx(-0.5)


@pytest.mark.parametrize("values", [[4.0], [4.0, 4.0, 4.0], [None, None]], ids=str)
@pytest.mark.filterwarnings("error")
def test_where_there_is_no_correlation_there_is_a_dash(values):
    reports = [replace(REPORT, number=str(k), derailed=3 + k) for k in range(len(values))]
    assert math.isnan(reenact.agreement(reports, values).rank)
    row = reenact.agreement_table(reports, {"x": values}).rows[0]
    some = values[0] is not None
    assert [cell == "-" for cell in row] == [False, not some, not some, True, not some]


def test_the_mean_of_its_class_is_what_a_model_has_to_surpass():
    reports = [replace(REPORT, number=str(k), derailed=n, speed_kmh=v)
               for k, (n, v) in enumerate([(2, 60), (4, 60), (9, 80), (30, 300)])]  # fmt: skip
    assert reenact.means_of_classes(reports) == [3.0, 3.0, 9.0, None]


REPORT = a.Report("X", "1", 2010, 60.0, 60, 60, 10, 1, 100e3, "T207")


def test_models_by_the_command(many, capsys):
    assert main(["accidents", str(many), "--broken-rail", "-m", "planar", "-m", "blockage",
                 "--set", "brakes.delay_s=10", "-j", "1", "--json"]) == 0  # fmt: skip
    told = json.loads(capsys.readouterr().out)
    assert told["group"] == "broken rail"
    assert [c["trains"] for c in told["classes"]] == [3, 1]
    reports = [r for r in a.read_reports([many]) if r in a.Group(a.BROKEN_RAIL) and r.mass_kg]
    base = reenact.real_base_train({"brakes.delay_s": 10.0})
    last = run_model("planar", reenact.train_of(base, reports[-1])).record["cars_derailed"]
    assert told["classes"][1]["models"]["planar"]["mean"] == last
    assert main(["accidents", str(many), "-m", "planar", "--most", "1"]) == 0
    out = capsys.readouterr().out
    assert "means of 2 trains: all causes" in out
    assert re.search(r"^planar +\d\.\d\d +\d+\.\d ", out, re.MULTILINE)


@pytest.mark.filterwarnings("error")
def test_one_train_has_no_correlation(many, capsys):
    arguments = ["accidents", str(many), "--cause", "E53C", "-m", "blockage", "-j", "1"]
    assert main([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["agreement"]["blockage"]["rank"] is None
    assert told["agreement"]["blockage"]["trains"] == 1
    assert told["rank_speed"] is None
    assert main(arguments) == 0
    assert "nan" not in capsys.readouterr().out


def test_reports_of_other_speeds_are_counted_beside_the_classes(tmp_path, capsys):
    rows = [YEARLY | {"INCDTNO": v, "TRNSPD": v} for v in ("5", "40", "95")]
    path = str(write(tmp_path / "x.csv", *rows))
    assert main(["accidents", path]) == 0
    assert "All causes: 1 report, and 2 of other speeds" in capsys.readouterr().out
    assert main(["accidents", path, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["reports"], told["outside"], len(told["classes"])) == (3, 2, 1)


@pytest.mark.parametrize(
    ("other", "words"),
    [({"TRNSPD": "5"}, "no report of a speed of 8 to 145 km/h: all causes"),
     ({"TONS": "0"}, "no report has a plausible weight: all causes")],
    ids=str,
)  # fmt: skip
def test_no_train_to_run_is_told_with_its_reason(tmp_path, capsys, other, words):
    path = write(tmp_path / "x.csv", YEARLY | other, YEARLY | {"INCDTNO": "2", "TRNSPD": "3"})
    assert main(["accidents", str(path), "-m", "planar"]) == 2
    assert capsys.readouterr() == ("", f"derail: {path}: {words}\n")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--broken-rail"], "need files of reports"),
        (["-m", "planar", "--behind", "7"], "no averages are shipped for: all causes, 7 or more"),
        (["-m", "planar", "--set", "brakes.delay=3"], "brakes.delay: unknown key"),
        (["--set", "brakes.delay_s=3"], "--set: changes the trains that --model runs"),
        (["{many}", "--broken-rail", "--cause", "T207"], "--broken-rail and --cause"),
        (["{many}", "--set", "train.speed_kmh=60"], "--set: changes the trains that --model runs"),
        (["{many}", "-m", "tome"], "--model: unknown model 'tome'"),
        (["{many}", "-m", "planar", "--set", "brakes.delay=3"], "brakes.delay: unknown key"),
        (
            ["{many}", "-m", "planar", "--set", "train.speed_kmh=60"],
            "speed_kmh is given by each report",
        ),
        (
            ["{many}", "-m", "planar", "--set", "train.consist=[]"],
            "train.consist is given by each report",
        ),
        (["{many}", "--cause", ""], "--cause: is empty"),
        (["{many}", "--cause", "Z9"], "no freight train derailed on main track: Z9"),
        (["{many}", "--behind", "500"], "500 or more cars behind"),
        (["/no/such.csv"], "/no/such.csv: No such file"),
        (["--report", "3"], "--report: name the files"),
        (
            ["{many}", "--report", "3", "-m", "planar"],
            "--report: takes no other option than --set",
        ),
        (
            ["{many}", "--report", "nine"],
            "0 freight trains derailed on main track have the number",
        ),
        (["{many}", "--report", "6"], "--report: BNSF 6: the mass of a car is not known"),
        (["{many}", "--report", "3", "--set", "train.speed_kmh=9"], "is given by each report"),
    ],
)
def test_mistakes_are_one_line_before_the_first_run(many, capsys, arguments, word):
    before = many.read_bytes()
    assert main(["accidents", *(x.replace("{many}", str(many)) for x in arguments)]) == 2
    out, err = capsys.readouterr()
    assert word in err
    assert (err.count("\n"), out) == (1, "")
    assert many.read_bytes() == before
