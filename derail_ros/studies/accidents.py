"""Reported accidents: derailed freight trains on main track, and their numbers of derailed cars.

The United States' Federal Railroad Administration (FRA) has every accident above a threshold of
damage reported (form F 6180.54) and publishes the reports, a table a year. Of a derailed train
they give the speed, the loaded and empty cars, those derailed, the place of the first car
involved, the weight behind the locomotives and the cause; not the lengths of cars, their
couplers, the brakes, nor where they came to rest.

A :class:`Group` of reports is averaged over classes of speed (:func:`by_speed`). Averages come
with the package (:func:`load_statistics`); the reports themselves are the user's own copy.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from derail_ros.vocabulary.words import count

KMH_PER_MPH = 1.609344
KG_PER_SHORT_TON = 907.18474

EDGES_MPH = (5.0, 15.0, 25.0, 35.0, 45.0, 55.0, 65.0, 90.0)
"""Limits of the classes of speed: reports have round speeds in mph, which lie in their middles."""

BROKEN_RAIL = (
    "T201", "T202", "T203", "T204", "T207", "T208", "T210", "T211", "T212", "T218", "T220",
    "T221",
)  # fmt: skip
"""Codes of causes that the FRA's guide calls "broken rail"."""

MASSES = (20e3, 150e3)
"""Mean masses of a car (kg) outside of which a report's weight or number of cars is wrong."""

MOST_CARS = 1000
"""Of a freight train; a report of more is wrong."""

COLUMNS: dict[str, tuple[str, ...]] = {
    "railroad": ("RAILROAD", "Reporting Railroad Code"),
    "number": ("INCDTNO", "Accident Number"),
    "year": ("YEAR4", "Accident Year"),
    "accident": ("TYPE", "Accident Type Code", "Accident Type"),
    "equipment": ("TYPEQ", "Equipment Type Code", "Equipment Type"),
    "track": ("TYPTRK", "Track Type Code", "Track Type"),
    "speed": ("TRNSPD", "Train Speed"),
    "first": ("POSITON1", "First Car Position"),
    "locomotives": ("HEADEND1", "Head End Locomotives"),
    "loaded": ("LOADF1", "Loaded Freight Cars"),
    "empty": ("EMPTYF1", "Empty Freight Cars"),
    "loaded_derailed": ("LOADF2", "Derailed Loaded Freight Cars"),
    "empty_derailed": ("EMPTYF2", "Derailed Empty Freight Cars"),
    "tons": ("TONS", "Gross Tonnage"),
    "cause": ("CAUSE", "Primary Accident Cause Code"),
}
"""What is needed of a report -> headings of its column: the yearly files', the portal's."""

WANTED: dict[str, tuple[str, ...]] = {
    "accident": ("1", "01", "DERAILMENT"),
    "equipment": ("1", "01", "FREIGHT TRAIN"),
    "track": ("1", "01", "MAIN"),
}
"""What makes a report one of a freight train derailed on a main track. A table without any of
these columns is taken to hold such reports only."""


class AccidentFileError(ValueError):
    """A file of reports that cannot be read; the message names file, line, column and reason."""


@dataclass(frozen=True)
class Report:
    """A freight train derailed on a main track."""

    railroad: str
    number: str
    year: int
    speed_kmh: float  # when it derailed
    cars: int  # freight cars of the train
    loaded: int  # of them loaded
    derailed: int  # freight cars
    first: int  # place of the first car involved among the cars, from 1
    # mean gross mass of a car; None where the report's weight cannot be right
    mass_kg: float | None
    cause: str  # the FRA's code of the primary cause
    placed: bool = True  # the report gives ``first``; otherwise it is taken to be 1

    @property
    def behind(self) -> int:
        """Cars from the first one involved to the end of the train."""
        return self.cars - self.first + 1


# Reading --------------------------------------------------------------------------------------


def _columns(heads: Sequence[str], path: Path, line: int) -> dict[str, int]:
    place = {head.strip().casefold(): i for i, head in enumerate(heads)}
    found = {}
    chosen = all(n.casefold() not in place for key in WANTED for n in COLUMNS[key])
    for key, names in COLUMNS.items():
        if chosen and key in WANTED:
            continue
        at = next((place[n.casefold()] for n in names if n.casefold() in place), None)
        if at is None:
            raise AccidentFileError(
                f"{path}: line {line}: has no column {' or '.join(names)}; it must be a table, "
                "separated by commas, with headings, of reports on form FRA F 6180.54"
            )
        found[key] = at
    return found


_NUMBER = re.compile(r"(\d+|\d{1,3}(,\d{3})+)(\.\d*)?", re.ASCII)
"""A number from 0 on as reports write it, with commas between thousands or without."""


def _number(text: str, where: str, largest: float = 1e6) -> float:
    """A number of a report; 0 where its place is empty."""
    if text and not (_NUMBER.fullmatch(text) and float(text.replace(",", "")) <= largest):
        shown = text if len(text) <= 20 else f"{text[:20]}..."
        raise AccidentFileError(
            f"{where}: must be a number from 0 to {largest:.0f}, got {shown!r}"
        )
    return float(text.replace(",", "") or 0.0)


def _whole(text: str, where: str, largest: float = MOST_CARS) -> int:
    value = _number(text, where, largest)
    if not value.is_integer():
        raise AccidentFileError(f"{where}: must be a whole number, got {text!r}")
    return int(value)


def _text(stream: io.BufferedReader) -> io.TextIOWrapper:
    """As text: Latin-1, in which every byte is a character, unless there is a byte order mark."""
    start = stream.peek(3)[:3]
    encoding = "latin-1"
    if start == codecs.BOM_UTF8:
        encoding = "utf-8-sig"
    elif start[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        encoding = "utf-16"
    return io.TextIOWrapper(stream, encoding, errors="replace", newline="")


def read_reports(paths: Iterable[Path]) -> list[Report]:
    """Reports of freight trains derailed on main track, in the files' order, each one once.

    Left out are reports without a speed or without a car derailed, those with more cars derailed
    than the train had or with more than :data:`MOST_CARS`, and of several with the same railroad,
    number and train the later ones.

    Parameters
    ----------
    paths : CSV files with a line of headings, the FRA's yearly ones or its portal's

    Raises
    ------
    AccidentFileError
        Naming file, line and column.
    """
    reports: dict[tuple[Any, ...], Report] = {}
    for path in paths:
        try:
            with open(path, "rb") as stream, _text(stream) as text:
                for report in _reports(csv.reader(text), path):
                    key = (report.railroad, report.number, report.year, report.cars, report.first)
                    reports.setdefault(key, report)
        except OSError as error:
            raise AccidentFileError(f"{path}: {error.strerror or error}") from None
        except csv.Error as error:
            raise AccidentFileError(f"{path}: is not a table of reports: {error}") from None
    return list(reports.values())


def _reports(lines: Any, path: Path) -> Iterator[Report]:
    heads = next((cells for cells in lines if cells), None)
    if heads is None:
        raise AccidentFileError(f"{path}: is empty")
    first = lines.line_num
    at = _columns(heads, path, first)
    last = max(at.values())
    for cells in lines:
        if not cells:
            continue
        where = f"{path}: line {lines.line_num}"
        if len(cells) <= last:
            raise AccidentFileError(
                f"{where}: has {count(len(cells), 'column')}, fewer than line {first}"
            )
        text = {key: cells[i].strip() for key, i in at.items()}
        if any(key in text and text[key].upper() not in words for key, words in WANTED.items()):
            continue
        place = {key: f"{where}: {heads[i].strip()}" for key, i in at.items()}
        if not text["year"]:
            raise AccidentFileError(f"{place['year']}: is empty")
        year = _whole(text["year"], place["year"], 9999)
        speed, tons = (_number(text[key], place[key]) for key in ("speed", "tons"))
        position, locomotives, loaded, empty, loaded_derailed, empty_derailed = (
            _whole(text[key], place[key])
            for key in ("first", "locomotives", "loaded", "empty", "loaded_derailed",
                        "empty_derailed")
        )  # fmt: skip
        cars, derailed = loaded + empty, loaded_derailed + empty_derailed
        if not speed or not 0 < derailed <= cars <= MOST_CARS:
            continue
        mass = tons * KG_PER_SHORT_TON / cars
        yield Report(
            text["railroad"],
            text["number"],
            year,
            speed * KMH_PER_MPH,
            cars,
            loaded,
            derailed,
            min(max(position - locomotives, 1), cars),
            mass if MASSES[0] <= mass <= MASSES[1] else None,
            text["cause"].upper(),
            position > 0,
        )


# Groups ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Reports that are looked at together."""

    causes: tuple[str, ...] = ()  # codes; all if empty
    behind: int = 1  # least number of cars from the first one involved to the end
    loaded: float = 0.0  # least share of loaded cars

    def __contains__(self, report: Report) -> bool:
        return (
            (not self.causes or report.cause in self.causes)
            and report.behind >= self.behind
            and report.loaded >= self.loaded * report.cars
        )

    @property
    def words(self) -> str:
        """What it is, in words."""
        text = "all causes"
        if self.causes:
            text = "broken rail" if self.causes == BROKEN_RAIL else ", ".join(self.causes)
        if self.behind > 1:
            text += f", {self.behind} or more cars behind"
        if self.loaded > 0.0:
            text += f", {100.0 * self.loaded:.0f} % of the cars loaded"
        return text


GROUPS: dict[str, Group] = {
    "all": Group(),
    "broken_rail": Group(BROKEN_RAIL),
    "broken_rail_long": Group(BROKEN_RAIL, behind=50),
    "broken_rail_long_loaded": Group(BROKEN_RAIL, behind=50, loaded=0.9),
}
"""Those of the shipped statistics."""


@dataclass(frozen=True)
class SpeedClass:
    """Cars derailed in the reports of a class of speed."""

    low_kmh: float
    high_kmh: float  # belongs to the class
    reports: int  # number of them
    speed_kmh: float  # their mean
    mean: float  # of the cars derailed; likewise the next three
    error: float  # standard error of the mean (0 of a single report)
    median: float
    q90: float
    behind: float  # mean number of cars from the first one involved to the end
    # mean of the mean masses of a car that can be right; None: there is none
    mass_kg: float | None


def error_of_mean(values: Any) -> float:
    """``s / sqrt(n)``; 0 of a single value."""
    return float(np.std(values, ddof=1) / math.sqrt(len(values))) if len(values) > 1 else 0.0


def in_classes(reports: Iterable[Report]) -> Iterator[tuple[float, float, list[Report]]]:
    """Limits (km/h) and reports of the classes of speed that have any."""
    reports = list(reports)
    for low, high in zip(EDGES_MPH, EDGES_MPH[1:], strict=False):
        a, b = low * KMH_PER_MPH, high * KMH_PER_MPH
        chosen = [r for r in reports if a < r.speed_kmh <= b]
        if chosen:
            yield a, b, chosen


CLASSES_TEXT = f"{EDGES_MPH[0] * KMH_PER_MPH:.0f} to {EDGES_MPH[-1] * KMH_PER_MPH:.0f} km/h"
"""From the first to the last class of speed."""


def by_speed(reports: Iterable[Report]) -> list[SpeedClass]:
    """Cars derailed over the classes of speed that have reports."""
    found = []
    for low, high, chosen in in_classes(reports):
        n = [r.derailed for r in chosen]
        speed = float(np.mean([r.speed_kmh for r in chosen]))
        masses = [r.mass_kg for r in chosen if r.mass_kg is not None]
        found.append(
            SpeedClass(
                low, high, len(n), speed, float(np.mean(n)), error_of_mean(n),
                float(np.median(n)), float(np.quantile(n, 0.9)),
                float(np.mean([r.behind for r in chosen])),
                float(np.mean(masses)) if masses else None,
            )
        )  # fmt: skip
    return found


@dataclass(frozen=True)
class Statistics:
    """Averages of reports: what is shipped of them."""

    source: str
    years: tuple[int, int]  # first and last
    groups: Mapping[str, tuple[SpeedClass, ...]]  # name of a group -> its classes of speed

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "source": self.source,
            "years": list(self.years),
            "groups": {
                name: {
                    "words": GROUPS[name].words,
                    "classes": [asdict(c) for c in classes],
                }
                for name, classes in self.groups.items()
            },
        }


SOURCE = (
    "Federal Railroad Administration, Rail Equipment Accident/Incident Data (form FRA F 6180.54)"
)

SHIPPED = "accidents.yaml"
"""The shipped statistics, among the data of this package."""


def load_statistics() -> Statistics:
    """The statistics that come with the package."""
    import yaml

    text = (files("derail_ros.studies") / "data" / SHIPPED).read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    names = [f.name for f in fields(SpeedClass)]
    groups = {
        name: tuple(SpeedClass(*(row[n] for n in names)) for row in group["classes"])
        for name, group in data["groups"].items()
    }
    return Statistics(data["source"], tuple(data["years"]), groups)
