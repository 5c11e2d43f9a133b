"""States that once made the engine fail, and random derailments that look for more."""

import shutil

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.errors import SimulationError
from tests.data import add
from tests.engine.campaign import attempt, scenario, trouble

AFTER = 2.0
"""How long a run goes on past the next event, s of simulation."""


@pytest.mark.parametrize("path", add.saved_states(), ids=lambda path: path.stem)
def test_what_comes_next(path):
    expected = add.expectation(path)["next"]
    run = PlanarSimulation.from_bytes(path.read_bytes())
    event, error = add.next_event(run)
    found = add.describe(event, error)
    for key in ("time_s", "track_coordinate_m"):
        assert found.pop(key, None) == pytest.approx(expected.pop(key, None), abs=1e-6)
    assert found == expected
    if error:
        # it stopped with a typed error at its last good state
        stopped = run.sample()
        assert np.isfinite(stopped.q).all() and np.isfinite(stopped.v).all()
        assert PlanarSimulation.from_bytes(run.to_bytes()).time == run.time
        with pytest.raises(SimulationError):
            run.advance_steps(1)
        return
    run.advance_to(run.time + AFTER)
    assert trouble(run) == ""


def test_every_state_has_its_expectation_and_the_other_way_round():
    states = {path.stem for path in add.saved_states()}
    assert states
    assert {path.stem for path in add.FOLDER.glob("*.json")} == states
    for path in add.saved_states():
        told = add.expectation(path)
        assert told["why"]
        assert told["next"]["kind"] != "none"
        assert path.stat().st_size < 200_000


def test_a_state_can_be_added_and_renewed(tmp_path, monkeypatch):
    source = add.saved_states()[0]
    shutil.copy(source, tmp_path / "copy.state")
    monkeypatch.setattr(add, "FOLDER", tmp_path)
    told = add.write("new", source.read_bytes(), "why")
    assert (tmp_path / "new.state").read_bytes() == source.read_bytes()
    assert add.expectation(tmp_path / "new.state") == told
    again = add.renew(tmp_path / "new.state")
    assert again["next"]["kind"] == told["next"]["kind"]
    assert again["next"]["cars"] == told["next"]["cars"]


# Random derailments --------------------------------------------------------------------------


def check(finding):
    assert finding.what == "" or finding.what.startswith("refused"), (
        f"python -m tests.engine.campaign {finding.number} 1"
    )


def test_a_campaign_is_the_same_each_time():
    assert scenario(7) == scenario(7) != scenario(8)


@pytest.mark.parametrize("number", range(5))
def test_random_derailments(number):
    check(attempt(number))


@pytest.mark.slow
@pytest.mark.parametrize("first", range(5, 205, 20))
def test_many_random_derailments(first):
    findings = [attempt(number) for number in range(first, first + 20)]
    for finding in findings:
        check(finding)
    # the campaign is about derailments
    assert np.mean([f.derailed > 0 for f in findings]) > 0.7
