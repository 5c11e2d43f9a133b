"""``derail estimate``: the quick estimates, a train as a sliding bar."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure
from derail_ros.commands.options import Json
from derail_ros.vocabulary.words import finite


@dataclass(frozen=True)
class Estimate:
    """An estimate with the parameters of its published figure."""

    title: str
    speed_kmh: float
    mu1: float
    mu2: float
    forms: bool = True


ESTIMATES = {
    "bar-1": Estimate(
        "a uniform bar slides from the rails onto the ground", 64.0, 0.05, 0.5, forms=False
    ),
    "bar-2": Estimate(
        "as bar-1, but what has gone over three car lengths too far is left behind",
        64.0, 0.05, 1.0,
    ),
    "bar-3": Estimate("as bar-2, with brakes instead of rolling friction", 105.0, 0.1, 1.0),
}  # fmt: skip


def parse_cars(text: str) -> list[int]:
    """``60``, ``20,40,60`` or ``10:100:10`` (first, last, step) as numbers of cars."""
    cars: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?::(\d+)(?::(\d+))?)?\s*", part)
        if match is None:
            raise CommandFailure(f"--cars: must be like 60 or 20,40 or 10:100:10, got {text!r}")
        first = int(match[1])
        last = first if match[2] is None else int(match[2])
        step = 1 if match[3] is None else int(match[3])
        if first < 1 or last < first or step < 1 or (last - first) // step >= 10_000:
            raise CommandFailure(f"--cars: must be like 10:100:10 and rise, got {part.strip()}")
        cars += range(first, last + 1, step)
    return cars


def run(
    name: Annotated[str, typer.Argument(help="bar-1, bar-2 or bar-3.")],
    form: Annotated[
        str | None, typer.Option(help="published or corrected (bar-2 and bar-3).")
    ] = None,
    speed_kmh: Annotated[float | None, typer.Option(help="Speed of the train, km/h.")] = None,
    mu1: Annotated[
        float | None, typer.Option(help="Friction on the rails; bar-3: of the braked train.")
    ] = None,
    mu2: Annotated[float | None, typer.Option(help="Friction on the ground.")] = None,
    cars: Annotated[
        str, typer.Option(help="Numbers of cars: 60, or 20,40,60, or first:last:step.")
    ] = "10:100:10",
    car_length: Annotated[float, typer.Option(help="Length of a car, m.")] = 15.0,
    as_json: Json = False,
) -> int:
    """Estimate the cars derailed: the train is a bar that slides onto the ground.

    The defaults are the parameters of the published figures.
    """
    from derail_ros.baselines import bar
    from derail_ros.studies.tables import Table

    if name not in ESTIMATES:
        raise CommandFailure(f"unknown estimate {name!r}; choose one of {', '.join(ESTIMATES)}")
    case = ESTIMATES[name]
    form = "published" if form is None else form
    speed_kmh = case.speed_kmh if speed_kmh is None else speed_kmh
    mu1 = case.mu1 if mu1 is None else mu1
    mu2 = case.mu2 if mu2 is None else mu2
    counts = parse_cars(cars)
    function = {"bar-1": bar.bar_case_1, "bar-2": bar.bar_case_2, "bar-3": bar.bar_case_3}[name]
    arguments: dict[str, Any] = {"mu1": mu1, "mu2": mu2, "car_length": car_length}
    if case.forms:
        arguments["form"] = form
    with common.refusing(ValueError):
        answer = function(speed_kmh / 3.6, counts, **arguments)
        limits = bar.limiting_speed(counts, **arguments) * 3.6 if name == "bar-2" else None
    trains = [
        {
            "cars": n,
            "cars_derailed": finite(answer.cars_derailed[k], 3),
            "whole_train": bool(answer.whole_train[k]),
            "distance_m": finite(answer.distance[k], 2),
            "duration_s": finite(answer.duration[k], 2),
            **({} if limits is None else {"limiting_speed_kmh": finite(limits[k], 2)}),
        }
        for k, n in enumerate(counts)
    ]
    report = {
        "estimate": name,
        "form": form if case.forms else None,
        "speed_kmh": speed_kmh,
        "mu1": mu1,
        "mu2": mu2,
        "car_length_m": car_length,
        "trains": trains,
    }
    if as_json:
        common.print_json("estimate", report)
        return OK
    console = common.out()
    console.print(f"[bold]{name}[/bold]: {case.title}")
    console.print(
        f"{speed_kmh:g} km/h, mu1 = {mu1:g}, mu2 = {mu2:g}, cars of {car_length:g} m"
        + (f", {form} form" if case.forms else "")
    )
    rows = []
    for t in trains:
        whole = "whole train" if t["whole_train"] else ""
        numbers = [f"{t[key]:.1f}" for key in ("distance_m", "duration_s")]
        limit = [f"{t['limiting_speed_kmh']:.1f}"] if limits is not None else []
        rows.append([str(t["cars"]), f"{t['cars_derailed']:.1f}", whole, *numbers, *limit])
    heads = ["cars", "derailed", "", "distance (m)", "duration (s)"]
    more = ["limiting speed (km/h)"] if limits is not None else []
    common.print_tables(Table([*heads, *more], rows, texts=0))
    return OK
