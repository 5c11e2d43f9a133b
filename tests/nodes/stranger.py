"""A client that calls whatever comes to its mind: `python -m tests.nodes.stranger SEED CALLS`.

Writes one line of JSON at the end: how many calls were answered, which were accepted, and how
many were sent again because no answer came.
"""

from __future__ import annotations

import json
import math
import random
import sys
import time
from typing import Any

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from derail_ros.nodes.process import Stop
from derail_ros.nodes.serving import service_qos
from tests.nodes.graph import SERVICES, service_path
from tests.nodes.support import SMALL

NUMBERS = [math.nan, math.inf, -math.inf, -1.0, -1e308, 1e308, 5e-324, -0.0, 1e17]
NOWHERE = [math.nan, math.inf, -math.inf, -1e308, 1e308, 1e17]
TEXTS = ["", " ", "x" * 5000, "\u202e\U0001f686", "'; drop", "<script>alert(1)</script>", "%s{0}"]
NAMES = [*TEXTS, "/etc/passwd", "../simulator", "mississauga.yaml", "a\nb", "~", "*", "C:\\x"]
BOMB = "a: &a [x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)},*{chr(97 + i)}]\n" for i in range(20)
)
YAMLS = [
    BOMB,
    "[" * 50_000,
    "a: " + "{a: " * 5000,
    "a: !!python/object/apply:os.system ['true']\n",
    "- 1\n",
    "version: 2\n",
    "version: 1\ntitle: " + "x" * 200_000,
    SMALL.replace("80", ".nan"),
    SMALL.replace("80", "1e999"),
    SMALL.replace("80", "'80'"),
    SMALL.replace("count: 10", "count: 100000000000"),
    SMALL.replace("count: 10", "count: -1"),
    SMALL.replace("[12]", "[.inf]"),
    SMALL.replace("source_base_car", "../secret"),
    SMALL + SMALL,
    SMALL + "---\n" + SMALL,
    "\x01",
]
HUGE = "x: " + "y" * (2 * 1024 * 1024)
"""Megabytes, sent now and then only: they are mostly transport."""
PATIENCE = 20.0
"""Wall time that a client waits for its service or an answer before it is made anew, s."""
RESENDS = 5
"""How often a request is sent at most."""
PARAMETERS: list[tuple[str, Any]] = [
    ("speed_factor", math.nan),
    ("speed_factor", -1.0),
    ("speed_factor", "fast"),
    ("speed_factor", [1.0, 2.0]),
    ("state_rate", 1e308),
    ("marker_rate", -5.0),
    ("clock_rate", 0),
    ("auto_exit", 1),
    ("record", "/tmp/x"),
    ("frame_id", "odom"),
    ("scenario", "nowhere"),
    ("scenario", "/etc/passwd"),
    ("nobody_knows_this", 1),
    ("marker_rate", 10.0),  # accepted
    ("clock_rate", 50),  # accepted
]


def mischief(dice: random.Random) -> tuple[str, dict[str, Any]]:
    """A call that must be refused while a run plays."""
    kind = dice.randrange(7)
    if kind == 0:
        if dice.random() < 0.5:
            return "load_consist", {"scenario_name": dice.choice(NAMES)}
        text = HUGE if dice.random() < 0.03 else dice.choice(YAMLS)
        return "load_consist", {"scenario_yaml": text, "speed_kmh": dice.choice(NUMBERS)}
    if kind == 1:
        return "inject_rail_break", {"track_coordinate": dice.choice(NOWHERE)}
    if kind == 2:
        return "inject_rail_break", {"car": dice.choice([99, 1001, 2**31, 2**32 - 1])}
    if kind == 3:
        fields = {
            "mode": dice.choice([4, 77, 255]),
            "source": dice.randrange(256),
            "car": dice.choice([0, 1, 2**32 - 1]),
            "delay_s": dice.choice(NUMBERS),
        }
        return "trigger_emergency_brake", fields
    if kind == 4:
        return "trigger_emergency_brake", {"delay_s": dice.choice(NUMBERS[:5])}
    if kind == 5:
        return "step_simulation", {"ticks": dice.choice([0, 1, 2**64 - 1])}
    return dice.choice(
        [
            ("set_simulation_state", {"state": dice.choice([3, 4, 255])}),
            ("reset_simulation", {"mode": dice.choice([2, 255])}),
        ]
    )


def sense(dice: random.Random) -> tuple[str, dict[str, Any]]:
    """A call that is right."""
    kind = dice.randrange(10)
    if kind == 0:
        # Far ahead, where the train does not come within the test.
        return "inject_rail_break", {"track_coordinate": dice.uniform(1e5, 2e5)}
    if kind == 1:
        return "trigger_emergency_brake", {"mode": dice.randrange(4), "delay_s": 3e3}
    if kind == 2:
        return "set_simulation_state", {"state": 1}
    return "get_events", {}


def main() -> None:
    seed, calls = int(sys.argv[1]), int(sys.argv[2])
    dice = random.Random(seed)
    stop = Stop()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"stranger_{seed}")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    # Each answer goes to all clients of a service, and with the usual depth of 10 one that gets no
    # processor time while others get ten answers loses its own.
    deep = service_qos()
    kinds = {f"/simulator/{service_path(name)}": kind for name, kind in SERVICES.items()}
    kinds["/simulator/set_parameters"] = SetParameters

    def make(name: str) -> Any:
        return node.create_client(kinds[name], name, qos_profile=deep)

    clients = {name: make(name) for name in kinds}
    # The same name with another type, which needs a context of its own: nobody may answer it.
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    double = rclpy.create_node(f"double_{seed}", context=context)
    reset = SERVICES["reset_simulation"]
    other = double.create_client(reset, "/simulator/inject_rail_break")
    # On a machine that is far behind, Fast DDS now and then never brings a client and a service
    # together that everybody else sees. A client made anew finds it.
    patience = time.monotonic() + PATIENCE
    while absent := [name for name, c in clients.items() if not c.service_is_ready()]:
        if stop.asked:
            print(f"never there: {', '.join(absent)}; nodes seen: {node.get_node_names()}")
            break
        if time.monotonic() > patience:
            print(f"made anew: {', '.join(absent)}", flush=True)
            for name in absent:
                node.destroy_client(clients[name])
                clients[name] = make(name)
            patience = time.monotonic() + PATIENCE
        executor.spin_once(timeout_sec=0.1)
    answered, refused, resent, accepted, wrong = 0, 0, 0, [], []
    for _ in range(calls):
        if stop.asked:
            break
        share = dice.random()
        if share < 0.1:
            name, value = dice.choice(PARAMETERS)
            message = Parameter(name, value=value).to_parameter_msg()
            future = clients["/simulator/set_parameters"].call_async(
                SetParameters.Request(parameters=[message])
            )
            executor.spin_until_future_complete(future, timeout_sec=60.0)
            answered += future.done()
            continue
        right = share < 0.3
        service, fields = sense(dice) if right else mischief(dice)
        request = SERVICES[service].Request(**fields)
        if service != "get_events":
            request.caller = dice.choice(TEXTS)
        if dice.random() < 0.01:
            other.call_async(reset.Request())
        name = f"/simulator/{service_path(service)}"
        for _ in range(RESENDS):
            future = clients[name].call_async(request)
            executor.spin_until_future_complete(future, timeout_sec=PATIENCE)
            if future.done():
                break
            # Fast DDS can lose an answer whose reader it has not matched yet.
            print(f"no answer: {service} {fields!r:.200}", flush=True)
            node.destroy_client(clients[name])
            clients[name] = make(name)
            resent += 1
        if not future.done():
            break
        answered += 1
        if future.result().success:
            if service in ("inject_rail_break", "trigger_emergency_brake"):
                accepted.append([service, int(future.result().step)])
            if not right:
                wrong.append([service, repr(fields)[:200]])
        else:
            refused += 1
            if right:
                wrong.append([service, repr(fields)[:200], future.result().message[:200]])
    report = {
        "answered": answered,
        "refused": refused,
        "resent": resent,
        "accepted": accepted,
        "wrong": wrong,
    }
    print(json.dumps(report), flush=True)
    executor.shutdown()
    node.destroy_node()
    double.destroy_node()
    rclpy.shutdown(context=context)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
