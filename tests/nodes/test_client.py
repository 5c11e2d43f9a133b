"""The client of a simulator where the middleware does not do its part."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from derail_ros.nodes import client as module
from derail_ros.nodes.client import SimulatorClient, SimulatorClientError
from tests.nodes.graph import LIMIT, graph

pytestmark = pytest.mark.ros


def test_a_client_that_never_finds_its_service_is_made_anew(tmp_path, monkeypatch) -> None:
    """The first one of each service asks for a name that nobody has."""
    monkeypatch.setattr(module, "PATIENCE", 0.5)
    with graph(tmp_path) as made:
        made.simulator(scenario="curve_derailment", start_paused=True)
        monkeypatch.setenv("ROS_DOMAIN_ID", str(made.domain))
        with SimulatorClient(timeout=LIMIT) as simulator:
            create, asked = simulator.node.create_client, []

            def first_in_vain(kind, path, **more):
                asked.append(path)
                return create(kind, path if asked.count(path) > 1 else f"{path}/nobody", **more)

            monkeypatch.setattr(simulator.node, "create_client", first_in_vain)
            simulator.step(2)
            assert asked.count("/simulator/derail/step_simulation") >= 2
            simulator.timeout = 1.0
            simulator.simulator = "/nobody"
            with pytest.raises(SimulatorClientError, match=r"is not there \(waited 1 s\)"):
                simulator.pause()
