"""``derail estimate``: the quick estimates, a train as a sliding bar."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from derail_ros.commands.common import OK, CommandFailure, out, print_json
from derail_ros.vocabulary.words import finite


@dataclass(frozen=True)
class Case:
    """A case with the parameters of its published figure."""

    title: str
    speed_kmh: float
    mu1: float
    mu2: float
    forms: tuple[str, ...]


CASES = {
    "bar-1": Case("a uniform bar slides from the rails onto the ground", 64.0, 0.05, 0.5, ()),
    "bar-2": Case(
        "as bar-1, but what has gone over three car lengths too far is left behind",
        64.0,
        0.05,
        1.0,
        ("published", "corrected"),
    ),
    "bar-3": Case(
        "as bar-2, with brakes instead of rolling friction",
        105.0,
        0.1,
        1.0,
        ("published", "corrected"),
    ),
}


def parse_cars(text: str) -> list[int]:
    """``60``, ``20,40,60`` or ``10:100:10`` (first, last, step) as numbers of cars."""
    cars: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?::(\d+)(?::(\d+))?)?\s*", part)
        if match is None:
            raise CommandFailure(f"--cars: must be like 60 or 20,40 or 10:100:10, not {text!r}")
        first, last, step = (int(g) if g else None for g in match.groups())
        assert first is not None
        last = first if last is None else last
        step = 1 if step is None else step
        if first < 1 or last < first or step < 1 or (last - first) // step >= 10_000:
            raise CommandFailure(f"--cars: {part.strip()} is not a range of numbers of cars")
        cars += range(first, last + 1, step)
    return cars


def run(
    name: str,
    form: str | None,
    speed_kmh: float | None,
    mu1: float | None,
    mu2: float | None,
    cars: str,
    car_length: float,
    as_json: bool,
) -> int:
    """Estimate the number of cars derailed by a bar model."""
    from derail_ros.baselines import bar

    if name not in CASES:
        raise CommandFailure(f"unknown estimate {name!r}; there are {', '.join(CASES)}")
    case = CASES[name]
    form = "published" if form is None else form
    speed_kmh = case.speed_kmh if speed_kmh is None else speed_kmh
    mu1 = case.mu1 if mu1 is None else mu1
    mu2 = case.mu2 if mu2 is None else mu2
    counts = parse_cars(cars)
    function = {"bar-1": bar.bar_case_1, "bar-2": bar.bar_case_2, "bar-3": bar.bar_case_3}[name]
    arguments: dict[str, Any] = {"mu1": mu1, "mu2": mu2, "car_length": car_length}
    if case.forms:
        arguments["form"] = form
    try:
        answer = function(speed_kmh / 3.6, counts, **arguments)
    except ValueError as error:
        raise CommandFailure(str(error)) from None
    rows = [
        {
            "cars": n,
            "cars_derailed": finite(d, 3),
            "whole_train": bool(w),
            "distance_m": finite(x, 2),
            "duration_s": finite(t, 2),
        }
        for n, d, w, x, t in zip(
            counts,
            answer.cars_derailed,
            answer.whole_train,
            answer.distance,
            answer.duration,
            strict=True,
        )
    ]
    limit = None
    if name == "bar-2":
        limit = (
            bar.limiting_speed(counts, mu1=mu1, mu2=mu2, car_length=car_length, form=form) * 3.6
        )
        for row, value in zip(rows, limit, strict=True):
            row["limiting_speed_kmh"] = finite(value, 2)
    shown_form = form if case.forms else None
    if as_json:
        print_json(
            {
                "estimate": name,
                "form": shown_form,
                "speed_kmh": speed_kmh,
                "mu1": mu1,
                "mu2": mu2,
                "car_length_m": car_length,
                "trains": rows,
            }
        )
        return OK
    from rich.table import Table

    console = out()
    console.print(f"[bold]{name}[/bold]: {case.title}")
    console.print(
        f"{speed_kmh:g} km/h, mu1 = {mu1:g}, mu2 = {mu2:g}, cars of {car_length:g} m"
        + (f", {shown_form} form" if shown_form else "")
    )
    table = Table(box=None, pad_edge=False)
    for heading in ("cars", "derailed", "", "distance (m)", "duration (s)"):
        table.add_column(heading, justify="left" if not heading else "right")
    if limit is not None:
        table.add_column("limiting speed (km/h)", justify="right")
    for row in rows:
        cells = [
            str(row["cars"]),
            f"{row['cars_derailed']:.1f}",
            "whole train" if row["whole_train"] else "",
            f"{row['distance_m']:.1f}",
            f"{row['duration_s']:.1f}",
        ]
        if limit is not None:
            cells.append(f"{row['limiting_speed_kmh']:.1f}")
        table.add_row(*cells)
    console.print(table)
    return OK
