"""The table of measures: the numbers of an outcome in tables, JSON, studies, figures, messages.

To add a measure, add one row to :data:`MEASURES`; everything else reads the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from derail_ros.vocabulary.ledger import available
from derail_ros.vocabulary.outcome import COUPLING_VALUES, Outcome
from derail_ros.vocabulary.severity import severity
from derail_ros.vocabulary.site import SiteOutcome
from derail_ros.vocabulary.status import AT_REST, FAILED
from derail_ros.vocabulary.words import finite, number_list

SCHEMA = "derail_ros/outcome"
SCHEMA_VERSION = 2
"""Version of the records below; 1 had ``rear_stop_m`` and ``duration_s`` of runs not at rest."""

NUMBER = "number"
COUNT = "count"
CARS = "cars"
PAIR = "pair"
FLAG = "flag"
TEXT = "text"

HEADLINE = "headline"
DETAIL = "detail"
NUMERICS = "numerics"

Record = dict[str, Any]


@dataclass(frozen=True)
class Measure:
    """One number or list of an outcome.

    Attributes
    ----------
    key : its name everywhere: in JSON, tables of studies, messages; ends with its SI unit
    words : its name for people
    of : its value from an outcome
    kind : NUMBER, COUNT, CARS (car numbers; counts by their number), PAIR, FLAG or TEXT
    unit : SI unit, "" for none
    shown_unit, scale, digits : how it is shown to people: unit, factor from SI, digits
    group : HEADLINE for the table of an outcome, DETAIL for JSON, studies and messages only,
        NUMERICS for the numerical quality
    former : names it had before, which are still read
    everywhere : False if tables leave it out where a run has none: few models or sites have it
    """

    key: str
    words: str
    of: Callable[[Outcome], Any]
    kind: str = NUMBER
    unit: str = ""
    shown_unit: str = ""
    scale: float = 1.0
    digits: int = 1
    group: str = HEADLINE
    former: tuple[str, ...] = ()
    everywhere: bool = True

    @property
    def numeric(self) -> bool:
        """It has a mean over runs."""
        return self.kind in (NUMBER, COUNT, CARS)

    @property
    def whole(self) -> bool:
        """It is a count."""
        return self.kind in (COUNT, CARS)

    @property
    def title(self) -> str:
        """Words with the unit it is shown in."""
        unit = self.shown_unit or self.unit
        return f"{self.words} ({unit})" if unit else self.words

    def value(self, outcome: Outcome) -> Any:
        """Its value for JSON; None if it does not exist."""
        value = self.of(outcome)
        if self.kind == NUMBER:
            return finite(value)
        if self.kind == COUNT:
            return None if value is None else int(value)
        if self.kind in (CARS, PAIR):
            return None if value is None else [int(v) for v in value]
        if self.kind == FLAG:
            return None if value is None else bool(value)
        return str(value)

    def number(self, value: Any) -> float | None:
        """A recorded value as a number: a list of cars by its length; None where there is none."""
        if value is None or not self.numeric:
            return None
        return finite(len(value) if isinstance(value, (list, tuple)) else value)

    def shown(self, value: Any, more: int = 0) -> str:
        """A value for people, in the unit it is shown in, ``-`` for none; ``more`` digits."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return "-"
        if isinstance(value, (list, tuple)):
            if self.kind == PAIR:
                return "car {} into car {}".format(*value)
            return f"{len(value)}  ({number_list(value)})" if value else "0"
        if self.kind in (FLAG, TEXT):
            return str(value)
        if self.whole and float(value) == int(value) and not more:
            return str(int(value))
        digits = max(self.digits, 1) if self.whole else self.digits
        return f"{value * self.scale:.{digits + more}f}"

    def shown_mean(self, value: float | None) -> str:
        """A mean or a deviation for people: like :meth:`shown`, a count with one digit."""
        return f"{value:.1f}" if self.whole and value is not None else self.shown(value)


def _share(*entries: str) -> Callable[[Outcome], float]:
    """Share of the energy that the train had to lose (``ledger.available``)."""

    def share(o: Outcome) -> float:
        total = available(o.energy)
        taken = [o.energy[e] for e in entries if e in o.energy]
        return sum(taken) / total if total > 0.0 and taken else math.nan

    return share


def _braked(o: Outcome) -> bool | None:
    """Whether a brake took energy; None of a model without brakes."""
    taken = o.energy.get("brakes", math.nan)
    return abs(taken) > 0.0 if math.isfinite(taken) else None


def _standing(o: Outcome, what: str) -> tuple[int, ...] | None:
    return getattr(o.standing, what) if o.standing.cars else None


def _standing_force(o: Outcome) -> float:
    return float(o.car_peak_force[-o.standing.cars :].max()) if o.standing.cars else math.nan


def _all(*measures: Measure) -> dict[str, Measure]:
    return {m.key: m for m in measures}


MEASURES: dict[str, Measure] = _all(
    Measure("cars_derailed", "cars derailed", lambda o: o.cars_derailed, COUNT),
    Measure("derailed_cars", "which cars", lambda o: o.derailed_cars, CARS),
    Measure("first_derailed", "first car derailed",
            lambda o: o.derailed_cars[0] if o.derailed_cars else None, COUNT, group=DETAIL),
    Measure("last_derailed", "last car derailed",
            lambda o: o.derailed_cars[-1] if o.derailed_cars else None, COUNT, group=DETAIL),
    Measure("first_derailment_s", "first derailment", lambda o: o.first_derailment, unit="s",
            digits=2, group=DETAIL),
    Measure("duration_s", "time to rest", lambda o: o.duration, unit="s", digits=2),
    Measure("peak_force_N", "largest force", lambda o: o.peak_force, unit="N", shown_unit="MN",
            scale=1e-6, digits=2, former=("peak_force_MN",)),
    Measure("peak_force_pair", "between", lambda o: o.peak_force_pair, PAIR),
    Measure("peak_force_time_s", "at", lambda o: o.peak_force_time, unit="s", digits=2),
    Measure("peak_resultant_N", "largest resultant between two cars", lambda o: o.peak_resultant,
            unit="N", shown_unit="MN", scale=1e-6, digits=2,
            former=("peak_resultant_MN",), group=DETAIL),
    Measure("cars_above_5MN", "cars struck above 5 MN", lambda o: o.cars_above_5MN, CARS),
    Measure("cars_above_10MN", "cars struck above 10 MN", lambda o: o.cars_above_10MN, CARS),
    Measure("scene_length_m", "scene length", lambda o: o.scene_length, unit="m"),
    Measure("scene_width_m", "scene width", lambda o: o.scene_width, unit="m"),
    Measure("scene_area_m2", "scene area", lambda o: o.scene_area, unit="m2",
            shown_unit="m\N{SUPERSCRIPT TWO}", digits=0),
    Measure("cars_on_side", "cars on their side", lambda o: o.values.get("cars_on_side"), COUNT,
            everywhere=False),
    Measure("pile_height_m", "height of the pile", lambda o: o.values.get("pile_height_m"),
            unit="m", everywhere=False),
    Measure("cars_spilled", "open cars tilted beyond their load's angle of repose",
            lambda o: o.values.get("cars_spilled"), COUNT, group=DETAIL),
    Measure("largest_roll_rad", "largest roll", lambda o: o.values.get("largest_roll_rad"),
            unit="rad", shown_unit="\N{DEGREE SIGN}", scale=180.0 / math.pi, digits=0,
            group=DETAIL),
    Measure("severity", "severity (base run: 1)", severity, digits=2),
    Measure("rear_part_first_car", "first car on the rails behind",
            lambda o: o.rear_part_first_car or None, COUNT, group=DETAIL),
    Measure("rear_part_coordinate_m", "its front truck", lambda o: o.rear_part_coordinate,
            unit="m", group=DETAIL),
    Measure("rear_stop_m", "rear part stopped at", lambda o: o.rear_stop, unit="m"),
    Measure("energy_initial_J", "kinetic and elastic energy at the start",
            lambda o: o.energy.get("initial", math.nan), unit="J", shown_unit="MJ", scale=1e-6,
            former=("energy_MJ",), group=DETAIL),
    Measure("share_brakes", "share of the energy taken by the brakes", _share("brakes"),
            digits=3, group=DETAIL),
    Measure("share_ground", "share of the energy taken by the ground",
            _share("ground_trucks", "ground_body"), digits=3, group=DETAIL),
    Measure("share_collisions", "share of the energy taken by collisions",
            _share("collisions"), digits=3, group=DETAIL),
    Measure("braked", "brakes applied", _braked, FLAG, group=DETAIL),
    Measure("train_cars", "cars in the train", lambda o: o.train.cars, COUNT, group=DETAIL),
    Measure("train_locomotives", "locomotives in the train", lambda o: o.train.locomotives, COUNT,
            group=DETAIL),
    Measure("train_loads", "loaded cars in the train", lambda o: o.train.loads, COUNT,
            group=DETAIL),
    Measure("train_empties", "empty cars in the train", lambda o: o.train.empties, COUNT,
            group=DETAIL),
    Measure("train_length_m", "length of the train over couplers", lambda o: o.train.length,
            unit="m", group=DETAIL),
    Measure("train_mass_kg", "mass of the train", lambda o: o.train.mass, unit="kg",
            shown_unit="t", scale=1e-3, digits=0, group=DETAIL),
    Measure("standing_cars", "standing cars", lambda o: o.standing.cars or None, COUNT,
            group=DETAIL),
    Measure("standing_struck", "standing cars struck", lambda o: _standing(o, "struck"), CARS,
            everywhere=False),
    Measure("standing_moved", "standing cars moved", lambda o: _standing(o, "moved"), CARS,
            everywhere=False),
    Measure("standing_derailed", "standing cars derailed", lambda o: _standing(o, "derailed"),
            CARS, everywhere=False),
    Measure("standing_peak_force_N", "largest force on a standing car", _standing_force,
            unit="N", shown_unit="MN", scale=1e-6, digits=2, everywhere=False),
    Measure("max_draft_N", "largest draft force", lambda o: o.largest("draft")[0],
            unit="N", shown_unit="MN", scale=1e-6, digits=2),
    Measure("max_draft_coupling", "in the coupling behind car",
            lambda o: o.largest("draft")[1] or None, COUNT, group=DETAIL),
    Measure("max_buff_N", "largest buff force", lambda o: o.largest("buff")[0],
            unit="N", shown_unit="MN", scale=1e-6, digits=2),
    Measure("max_buff_coupling", "in the coupling behind the car",
            lambda o: o.largest("buff")[1] or None, COUNT, group=DETAIL),
    Measure("beyond_track_m", "rolled beyond the end of the alignment",
            lambda o: o.values.get("beyond_track_m"), unit="m", group=DETAIL, everywhere=False),
    Measure("status", "status", lambda o: o.status, TEXT, group=DETAIL),
    Measure("at_rest", "came to rest", lambda o: o.status == AT_REST, FLAG, group=DETAIL),
    Measure("void", "void", lambda o: o.void, FLAG, group=DETAIL),
    Measure("end_time_s", "run time at the end", lambda o: o.time, unit="s", digits=2,
            group=DETAIL),
    Measure("max_coupler_gap_m", "largest coupler gap", lambda o: o.max_coupler_gap, unit="m",
            shown_unit="\N{MICRO SIGN}m", scale=1e6, digits=3, group=NUMERICS),
    Measure("max_truck_offset_m", "largest offset of a truck from the track",
            lambda o: o.max_truck_offset, unit="m", shown_unit="\N{MICRO SIGN}m", scale=1e6,
            digits=3, group=NUMERICS),
    Measure("energy_residual", "largest energy imbalance, of the energy at the start",
            lambda o: o.energy_residual, shown_unit="%", scale=100.0, digits=4, group=NUMERICS),
    Measure("steps", "steps", lambda o: o.steps, COUNT, group=NUMERICS),
    Measure("rejected_steps", "rejected steps", lambda o: o.rejected_steps, COUNT,
            group=NUMERICS),
    Measure("real_time_factor", "simulated time over computing time",
            lambda o: o.values.get("real_time_factor"), digits=2, group=NUMERICS),
)  # fmt: skip
"""All measures, in the order of tables and records."""


def measure(name: str) -> Measure:
    """A measure by its key or a former name.

    Raises
    ------
    KeyError
        If there is none.
    """
    if name in MEASURES:
        return MEASURES[name]
    for m in MEASURES.values():
        if name in m.former:
            return m
    raise KeyError(name)


def outcome_record(outcome: Outcome, wall_s: float | None = None) -> Record:
    """An outcome as plain data: every measure, ``train``, the ledger, the wall time."""
    energy = {key: finite(value) for key, value in outcome.energy.items()}
    return {
        **{key: m.value(outcome) for key, m in MEASURES.items()},
        "train": outcome.train.record,
        "energy_J": energy,
        "in_train": in_train(outcome),
        "parted": [
            {"coupling": p.coupling, "time_s": p.time, "cause": p.cause}
            | ({"force_N": p.force} if p.force else {})
            for p in outcome.parted
        ],
        "site": (outcome.site or SiteOutcome()).record(),
        "wall_s": finite(wall_s, 6),
    }


def in_train(outcome: Outcome) -> Record:
    """Largest forces in the couplings: of the train, and of each coupling with its time."""
    told = outcome.couplings
    values = [outcome.of_train(told[key]) if key in told else () for key in COUPLING_VALUES]
    rows = zip(*values, strict=True)
    couplings = [
        {"coupling": k, **{key: finite(v) for key, v in zip(COUPLING_VALUES, row, strict=True)}}
        for k, row in enumerate(rows, 1)
    ]
    most = {key: MEASURES[key].value(outcome) for key in ("max_buff_N", "max_draft_N")}
    return {**most, "couplings": couplings}


def shown_of(record: Mapping[str, Any], m: Measure) -> str:
    """A measure of a record for people; the largest forces in the train with place and time."""
    text = m.shown(record.get(m.key))
    which = m.key.removeprefix("max_").removesuffix("_N")
    car = record.get(f"max_{which}_coupling")
    if m.key != f"max_{which}_N" or text == "-" or car is None:
        return text
    couplings = (record.get("in_train") or {}).get("couplings") or []
    time = couplings[car - 1][f"max_{which}_time_s"] if car <= len(couplings) else None
    when = "" if time is None else f" at {time:.2f} s"
    return f"{text}  (between cars {car} and {car + 1}{when})"


def shown_rows(
    record: Mapping[str, Any], groups: Sequence[str] = (HEADLINE,), without: Sequence[str] = ()
) -> list[tuple[str, str]]:
    """Title and value, for people, of each measure that a record has."""
    return [
        (m.title, shown_of(record, m))
        for m in MEASURES.values()
        if m.group in groups and m.key not in without and record.get(m.key) is not None
    ]


def failed_record(error: str, wall_s: float | None = None) -> Record:
    """The record of a run that failed."""
    return {"error": error, "status": FAILED, "wall_s": finite(wall_s, 6)}


def counted(record: Mapping[str, Any]) -> bool:
    """Whether a record counts in statistics: neither failed nor void."""
    return "error" not in record and not record.get("void", False)


def record_numbers(record: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of a record that have a mean: measures, and entries like ``energy_J.brakes``."""
    flat: dict[str, float] = {}
    for key, value in record.items():
        if key in MEASURES:
            number = MEASURES[key].number(value)
        elif key == "energy_J":
            flat |= {f"{key}.{k}": float(v) for k, v in value.items() if v is not None}
            continue
        else:
            plain = isinstance(value, (int, float)) and not isinstance(value, bool)
            number = finite(value) if plain else None
        if number is not None and key != "derailed_cars":
            flat[key] = number
    return flat
