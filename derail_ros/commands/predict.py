"""``derail predict``: the number of derailed cars, with bands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure, note
from derail_ros.commands.options import Jobs, Json, Seed, Settings, written

if TYPE_CHECKING:
    from derail_ros.predict.prediction import Prediction

KG_PER_SHORT_TON = 907.18474
DRAWS = 1000


def run(
    scenario: Annotated[
        str | None,
        typer.Argument(
            help="Name of a scenario, or a YAML file. Or describe a train with the options."
        ),
    ] = None,
    settings: Settings = None,
    speed_mph: Annotated[
        float | None, typer.Option(min=1.0, max=150.0, help="Speed, mph.")
    ] = None,
    speed_kmh: Annotated[
        float | None, typer.Option(min=1.0, max=240.0, help="Speed, km/h.")
    ] = None,
    behind: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="Cars from the first one that derails to the last."),
    ] = None,
    tons: Annotated[
        float | None,
        typer.Option(help="Mean gross weight of a car, short tons (of 907 kg); default: 100."),
    ] = None,
    mass_t: Annotated[float | None, typer.Option(help="The same in tonnes.")] = None,
    loaded: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="Share of loaded cars; default: from the weight."),
    ] = None,
    cause: Annotated[
        str, typer.Option(help="broken_rail, track, equipment, human, signal, other, or a code "
                          "of the FRA's such as T207.")
    ] = "broken_rail",
    hazardous: Annotated[
        int, typer.Option(min=0, help="Tank cars among those behind; counts how many release.")
    ] = 0,
    placement: Annotated[
        int,
        typer.Option(min=0, help="Find where in a scenario's train this many tank cars are least "
                     "at risk."),
    ] = 0,
    draws: Annotated[int, typer.Option("--draws", "-n", min=20, help="Number of runs.")] = DRAWS,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
    output: Annotated[
        Path | None, written("Write prediction.json and a picture there.")
    ] = None,
) -> int:  # fmt: skip
    """Predict how many cars derail, with bands, from runs with calibrated constants."""
    from derail_ros.models import source_hash
    from derail_ros.predict.prediction import differs, predict
    from derail_ros.scenario.calibrated import load_calibrated

    group = _group(cause)
    subject, title = _subject(
        scenario, settings, _one(speed_kmh, speed_mph, 1.609344, "--speed-kmh", "--speed-mph"),
        behind, _one(mass_t, tons, KG_PER_SHORT_TON / 1e3, "--mass-t", "--tons"), loaded,
    )  # fmt: skip
    constants = load_calibrated()
    params = subject.to_params() if placement and scenario is not None else None
    if placement and (params is None or not placement < len(params.cars)):
        raise CommandFailure("--placement: name a scenario with more cars than that")
    if output is not None:
        output = common.output_directory(output)
    if params is not None:
        return _place(params, title, constants, group, placement, draws, seed, jobs, output,
                      as_json)  # fmt: skip
    with common.counting_runs("predict") as progress:
        found = predict(
            subject, constants, group, draws=draws, seed=seed, jobs=jobs,
            progress=progress,
        )  # fmt: skip
    warnings = [w for w in (constants.warning(source_hash()), _outside(found)) if w]
    report = {
        "title": title,
        **found.as_dict(hazardous),
        "differs": "" if scenario is None else differs(found, subject.to_params()),
        "seed": seed,
        "provenance": dict(constants.provenance),
        "warnings": warnings,
    }
    if output is not None:
        from derail_ros.predict.picture import picture
        from derail_ros.review.drawing import save

        common.write_json(output / "prediction.json", report)
        save(picture(found, title), output / "prediction.png")
    if as_json:
        common.print_json("prediction", report)
    else:
        _print(found, report, title, output)
    for warning in warnings:
        note(f"derail: warning: {warning}")
    return OK


def _place(
    params: Any, title: str, constants: Any, group: str, n: int, draws: int, seed: int,
    jobs: int | None, output: Path | None, as_json: bool,
) -> int:  # fmt: skip
    """Where ``n`` tank cars are least at risk."""
    from derail_ros.predict import placement

    with common.counting_runs("placement") as progress:
        runs = placement.placement(
            params, constants, group, draws=draws, seed=seed, jobs=jobs, progress=progress
        )
    found = {"title": title, "constants": "calibrated", "cause": group, **runs.as_dict(n)}
    if output is not None:
        from derail_ros.review.drawing import save

        common.write_json(output / "placement.json", found)
        save(placement.picture(found, title), output / "placement.png")
    if as_json:
        common.print_json("placement", found)
        return OK
    console = common.out()
    console.print(title, style="bold", markup=False)
    for sentence in placement.words(found):
        console.print(sentence, soft_wrap=True, markup=False)
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True)
    return OK


def _one(value: float | None, other: float | None, factor: float, a: str, b: str) -> float | None:
    """A value that is given in one unit or another."""
    if value is not None and other is not None:
        raise CommandFailure(f"{a} and {b}: give one of them")
    return other * factor if other is not None else value


def _group(cause: str) -> str:
    from derail_ros.predict.runs import CAUSES, group_of

    key = cause.strip().lower().replace("-", "_").replace(" ", "_")
    if key in CAUSES:
        return key
    if len(key) == 4 and key[0] in "tehsm" and key[1:3].isalnum():
        return group_of(key.upper())
    raise CommandFailure(f"--cause: must be {', '.join(CAUSES)} or a code, got {cause!r}")


def _subject(
    name: str | None, settings: Any, kmh: float | None, behind: int | None, tonnes: float | None,
    loaded: float | None,
) -> tuple[Any, str]:  # fmt: skip
    """What is to be predicted and its title."""
    from derail_ros.predict.trains import Train

    options = {"--speed-mph": kmh, "--behind": behind, "--tons": tonnes, "--loaded": loaded}
    if name is not None:
        if clash := [k for k, v in options.items() if v is not None]:
            raise CommandFailure(f"{', '.join(clash)}: a scenario has its own train")
        scenario = common.load(name, settings)
        if scenario.n_cars < 2:
            raise CommandFailure(f"{scenario.name}: needs at least two cars, has one")
        return scenario, scenario.title
    if settings:
        raise CommandFailure("--set: name a scenario to change")
    if kmh is None or behind is None:
        raise CommandFailure("name a scenario, or give --speed-mph and --behind")
    tonnes = 100.0 * KG_PER_SHORT_TON / 1e3 if tonnes is None else tonnes
    if not 15.0 <= tonnes <= 165.0:
        raise CommandFailure(
            f"--tons: must be the mean weight of a car, 17 to 182 short tons, got "
            f"{tonnes * 1e3 / KG_PER_SHORT_TON:g}"
        )
    if loaded is None:  # empty cars weigh 28.5 t, loaded ones about 118
        loaded = min(max((tonnes - 28.5) / (118.0 - 28.5), 0.0), 1.0)
    return Train(kmh / 3.6, behind, tonnes * 1e3, loaded), "Prediction"


def _outside(found: Prediction) -> str:
    """Where the train is outside of what the constants were learned from."""
    t = found.train
    beyond = []
    if not 8.0 <= t.speed * 3.6 <= 90.0:
        beyond.append(f"{t.speed * 3.6:.0f} km/h (8 to 90)")
    if t.behind > 150:
        beyond.append(f"{t.behind} cars behind (up to 150)")
    if not beyond:
        return ""
    return f"hardly tested, because few reports have such a train: {', '.join(beyond)}"


def _print(found: Prediction, report: Any, title: str, output: Path | None) -> None:
    from derail_ros.predict.prediction import BANDS
    from derail_ros.studies.tables import Table

    console = common.out()
    console.print(title, style="bold", markup=False)
    for sentence in found.sentences():
        console.print(sentence, soft_wrap=True)
    console.print()
    rows = [("cars derailed", report["cars_derailed"], "")]
    rows += [(f"cars derailed, {d['words']}", d, "") for d in report["statistical"].values()]
    rows += [
        ("cars struck above 5 MN", report["cars_struck"]["above_5MN"], ""),
        ("cars struck above 10 MN", report["cars_struck"]["above_10MN"], ""),
        ("scene, length (m)", report["scene_length_m"], ""),
        ("scene, width (m)", report["scene_width_m"], ""),
        ("time to rest (s)", report["duration_s"], ""),
    ]
    for kind in ("single_shell", "double_shell"):
        if "cars" in report["releases"][kind]:
            words = f"tank cars that release, {kind.replace('_', ' ')}"
            rows.append((words, report["releases"][kind]["cars"], ""))
    cells = [
        [name, *(f"{d[k]:.0f}" if d[k] is not None else "-" for k in ("mean", *BANDS))]
        for name, d, _ in rows
    ]
    common.print_tables(Table(["", "mean", "5 %", "25 %", "median", "75 %", "95 %"], cells))
    if report["differs"]:
        console.print(report["differs"], soft_wrap=True, markup=False)
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True)
