"""A measure, or an entry of the energy ledger, is added by one edit of its table.

With them goes a second engine that knows nothing of the planar one: through models, command line,
recording, review, export, study and recomputation.
"""

import json

import pytest

from derail_ros import models
from derail_ros.cli import main
from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.measures import MEASURES
from tests.second_engine import ENTRY, FRICTION, MEASURE, BarEngine

SCENARIO = """
version: 1
title: A bar
model: bar
train: {speed_kmh: 36, consist: [{car: box_car, count: 4}]}
initiation: {await_command: true}
"""
SLIDE = 100.0 / (2.0 * FRICTION * 9.81)


@pytest.fixture
def bar(tmp_path, monkeypatch):
    """The scenario's file, with the engine, the measure and the entry known."""
    monkeypatch.setitem(models._ENGINES, "bar", BarEngine())
    monkeypatch.setitem(MEASURES, MEASURE.key, MEASURE)
    monkeypatch.setitem(ENERGY_ENTRIES, ENTRY.key, ENTRY)
    path = tmp_path / "bar.yaml"
    path.write_text(SCENARIO)
    return path


def said(capsys, *arguments):
    """What a command prints."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 0
    return capsys.readouterr().out


def test_table_and_json(bar, capsys):
    table = said(capsys, "simulate", bar)
    assert f"sliding distance (m) {SLIDE:.1f}" in " ".join(table.split())
    assert "sliding 100 %" in table
    report = json.loads(said(capsys, "simulate", bar, "--json"))
    (outcome,) = report["outcomes"]
    assert outcome["slide_m"] == pytest.approx(SLIDE)
    assert outcome["energy_J"]["sliding"] == pytest.approx(outcome["energy_initial_J"])
    assert outcome["status"] == "at rest" and report["model"] == "bar"


def test_recording_summary_export_and_recomputation(bar, tmp_path, capsys):
    said(capsys, "simulate", bar, "-o", tmp_path / "out")
    said(capsys, "review", tmp_path / "out", "-o", tmp_path / "review")
    summary = json.loads((tmp_path / "review" / "summary.json").read_text())
    assert summary["outcome"]["slide_m"] == pytest.approx(SLIDE)
    assert "sliding 100 %" in (tmp_path / "review" / "summary.txt").read_text()
    said(capsys, "export", tmp_path / "out", "-o", tmp_path / "tables")
    text = "".join(p.read_text() for p in (tmp_path / "tables").rglob("*.csv"))
    assert "slide_m" in text and "sliding_J" in text
    answer = json.loads(said(capsys, "replay", tmp_path / "out", "--json"))
    assert not answer["runs"][0]["differences"]


def test_messages(bar):
    from derail_ros.scenario import load_scenario
    from msg_adapters import reports
    from msg_adapters.common import RunContext
    from msg_adapters.definitions import deserialize
    from msg_adapters.state import StateEncoder

    simulation = models.build(load_scenario(bar).to_params())
    outcome = simulation.run()
    context = RunContext("run")
    message = reports.outcome(outcome, context, time=simulation.time, step=simulation.step_count)
    told = {q.key: q.values.tolist() for q in message.measures}
    assert told["slide_m"] == pytest.approx([SLIDE])
    sent = dict(StateEncoder(simulation.params, context).encode(simulation.sample()))
    ledger = deserialize(sent["energy"], "derail_msgs/msg/EnergyLedger")
    assert dict(zip([q.key for q in ledger.entries], ledger.roles))["sliding"] == "taken out"
    state = deserialize(sent["train_state"], "derail_msgs/msg/TrainState")
    assert [q.key for q in state.more] == ["slide_m"]
    assert state.more[0].values == pytest.approx([SLIDE] * 4)


def test_study(bar, tmp_path, capsys):
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        f"version: 1\ntitle: Bars\nscenario: {bar}\nensemble: 1\n"
        "measures: [slide_m, duration_s]\n"
        "design: grid\nparameters: {speed: {path: train.speed_kmh, values: [18, 36]}}\n"
    )
    said(capsys, "study", plan, "-o", tmp_path / "study", "--json")
    import pandas

    table = pandas.read_parquet(next((tmp_path / "study").glob("*.parquet")))
    assert table["slide_m"].tolist() == pytest.approx([SLIDE / 4.0, SLIDE])


def test_an_unknown_model_is_refused(bar, capsys):
    bar.write_text(SCENARIO.replace("model: bar", "model: flying"))
    assert main(["simulate", str(bar)]) != 0
    assert "model: must be one of planar, spatial, bar, got flying" in capsys.readouterr().err
