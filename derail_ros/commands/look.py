"""``derail look``: a live run in a browser, with a rail to break and brakes to apply."""

from __future__ import annotations

import threading
from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK
from derail_ros.commands.options import Settings

SCENARIO = "curve_derailment"


def run(
    scenario: Annotated[
        str | None,
        typer.Argument(
            help=f"Name of a scenario, or a YAML file; default: {SCENARIO}, its rail whole until "
            "you break it."
        ),
    ] = None,
    settings: Settings = None,
    rate: Annotated[
        float, typer.Option("--rate", min=0.1, max=10.0, help="Run time per wall time.")
    ] = 1.0,
    host: Annotated[
        str,
        typer.Option("--host", help="Address to serve at; 0.0.0.0 lets others in the network in."),
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="Port; default: 8631, or a free one."),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
) -> int:
    """Open a page of a live run: break the rail, brake, restart at another speed. Needs no ROS."""
    import webbrowser

    from derail_ros.look.live import LiveRun, Wish
    from derail_ros.look.server import serving
    from derail_ros.vocabulary.errors import ParameterError

    changed = tuple(common.overrides(settings).items())
    wish = Wish(scenario or SCENARIO, changed, whole=scenario is None)
    loaded = wish.load()
    common.warm_up(loaded.to_params().model)
    with common.refusing(ParameterError, at=loaded.name):
        live = LiveRun(wish, rate)
    address = f"{host}:{port or ''}"
    try:
        with common.refusing(OSError, at=address), serving(live.board, host, port) as server:
            print(f"look: {'  '.join(server.addresses)}  (Ctrl-C ends)", flush=True)
            if not server.local:
                common.note("derail: everyone in this network can see and control this run")
            if browser:
                # Beside the run: some browsers answer only when they are closed.
                threading.Thread(
                    target=webbrowser.open, args=(server.addresses[0],), daemon=True
                ).start()
            live.go_on()
    except KeyboardInterrupt:
        pass
    return OK
