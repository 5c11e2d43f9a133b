"""Consist lists as railways keep them: a CSV file, a car a row, read into a scenario.

A heading says what a column is and in which unit: ``Gross (lb)``, ``length_ft``, ``Tare, kg``.
What a list does not say is taken from the car type in the library; what the library does not say
is assumed. Both are told in :attr:`ConsistList.assumed`.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from derail_ros.scenario.errors import ScenarioError
from derail_ros.scenario.messages import did_you_mean, shown
from derail_ros.scenario.resolve import LEAST_LOAD
from derail_ros.scenario.rolling_stock import RollingStock, load_rolling_stock
from derail_ros.scenario.scenario import Scenario, loads_scenario
from derail_ros.scenario.schema import FORMAT_VERSION, MAX_CARS, CarType
from derail_ros.scenario.strict_yaml import flow
from derail_ros.scenario.units import UNITS
from derail_ros.vocabulary.limits import KNUCKLE
from derail_ros.vocabulary.words import cars

MAX_BYTES = 1024 * 1024
"""Largest list that is read, bytes."""

LENGTH, MASS = "length", "mass"
HEADINGS = {
    "position": "position, pos, position in train, #, seq, sequence, line, no",
    "name": (
        "name, car, car number, number, initial, car initial, mark, reporting mark, reporting "
        "marks, car id, id, equipment, equipment id, unit"
    ),
    "type": (
        "type, car type, car type code, kind, car kind, aar, aar code, aar type, aar car "
        "type, equipment type, umler, model, description, spec, specification, class"
    ),
    "length_over_couplers": (
        "length, length over couplers, coupled length, over couplers, coupled, length over "
        "pulling faces, over pulling faces, outside length, overall length, car length"
    ),
    "length": (
        "body length, length of body, length over strikers, over strikers, length over end "
        "sills, body"
    ),
    "truck_centres": (
        "truck centres, truck centers, truck centre, truck center, truck centre distance, "
        "truck center distance, truck spacing, distance between truck centers, bolster "
        "centers"
    ),
    "trucks": "trucks, number of trucks",
    "tare": "tare, tare weight, tare mass, light weight, empty weight, empty mass, empty, lt wt",
    "gross": (
        "gross, loaded weight, loaded mass, car weight, gross weight, gross mass, weight, "
        "mass, total weight, total mass, gross rail load, grl, gross wt, weight on rail"
    ),
    "lading": "lading, lading weight, net, net weight, net mass, load weight, payload",
    "load": (
        "load, l/e, e/l, l or e, le, load/empty, loaded/empty, load or empty, ld/mt, loaded, "
        "load status, status, load state"
    ),
    "contents": (
        "contents, commodity, lading/contents, hazmat, stcc, product, cargo, goods, lading "
        "description"
    ),
    "brakes": "brakes, brake, brake type, brake shoe, shoe, brake status",
    "count": "count, qty, quantity, cars, number of cars",
    "width": "width, body width",
}
"""Headings by what they mean, in small letters and without their unit."""

QUANTITIES = {
    "length_over_couplers": LENGTH,
    "length": LENGTH,
    "truck_centres": LENGTH,
    "width": LENGTH,
    "tare": MASS,
    "gross": MASS,
    "lading": MASS,
}
UNIT_WORDS = {
    LENGTH: {
        "ft": ("ft", "feet", "foot", "'"),
        "in": ("in", "inch", "inches"),
        "m": ("m", "metre", "metres", "meter", "meters"),
    },
    MASS: {
        "lb": ("lb", "lbs", "pound", "pounds"),
        "kg": ("kg", "kgs", "kilogram", "kilograms"),
        "long_tons": ("long ton", "long tons"),
        "t": ("t", "tonne", "tonnes", "metric ton", "metric tons", "metric tonnes", "mt"),
        "short_tons": ("short ton", "short tons", "ton", "tons", "us tons", "st"),
    },
}
"""Words for a unit in a heading; tons are short tons of 2000 lb, as in America."""

LOADS = {
    **dict.fromkeys(("L", "LD", "LOAD", "LOADED", "F", "FULL"), "loaded"),
    **dict.fromkeys(("E", "MT", "EMPTY", "M"), "empty"),
}
BRAKES: dict[str, dict[str, Any]] = {
    **dict.fromkeys(("COMPOSITION", "OK", "IN", "CUT IN", "OPERATIVE"), {}),
    "CAST IRON": {"shoe": "cast_iron"},
    "NONE": {"shoe": "none"},
    **dict.fromkeys(("CUT OUT", "OUT", "INOPERATIVE", "BAD ORDER"), {"cut_out": True}),
    **dict.fromkeys(("HAND BRAKE", "HANDBRAKE", "HB"), {"hand_brake": True}),
    "NO EMPTY/LOAD": {"empty_load_device": False},
}
SIZES = {
    "length_over_couplers": (6.0, 60.0, "short", "long"),
    "length": (6.0, 60.0, "short", "long"),
    "tare": (8e3, 250e3, "light", "heavy"),
    "gross": (8e3, 250e3, "light", "heavy"),
}
"""Meaning -> least and largest size of a car, m or kg, and what one beyond them is called."""
TRUCK_SHARE = 0.75
"""Truck centres over length over couplers of a car of no type, assumed."""
COUPLINGS = (
    f"knuckles break at {KNUCKLE * 1e-6:.2f} MN (AAR M-211); couplings are rigid below that, "
    "without slack and draft gear (couplers.draft_gear)"
)
"""Assumed of every list."""
FEET = re.compile(r"(\d+(?:\.\d+)?)\s*(?:'|ft|-)\s*(?:(\d+(?:\.\d+)?)\s*(?:\"|''|in)?)?\Z")


@dataclass(frozen=True)
class Column:
    """A column: its place, heading, meaning, unit (a key of ``units.UNITS``), its word there."""

    index: int
    heading: str
    meaning: str
    unit: str = ""
    word: str = ""


@dataclass
class ConsistList:
    """A list that was read.

    Attributes
    ----------
    file, content : name and bytes of the file
    blocks : entries of ``train.consist``
    lines, bodies : line of the file of each entry, and bodies of each of its cars
    assumed : what is assumed, and of which cars, in sentences
    locomotives : number of locomotives at the head
    """

    file: str
    content: bytes
    blocks: list[dict[str, Any]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    bodies: list[int] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    locomotives: int = 0

    def to_yaml(self) -> str:
        """A scenario with this train; how it runs and derails is assumed and marked so."""
        title = f"Train of {self.file}"[:120]
        digest = hashlib.sha256(self.content).hexdigest()
        first = min(self.locomotives + 1, sum(block.get("count", 1) for block in self.blocks))
        lines = [f"# Made from {self.file} by `derail consist`. Assumed:"]
        lines += [f"#   {text}" for text in self.assumed]
        lines += [
            "#   speed, place of the broken rail and brakes: see below, change them to the case",
            f"version: {FORMAT_VERSION}",
            f"title: {flow(title)}",
            f"inputs: [{flow({'file': self.file, 'sha256': digest})}]",
            "",
            "train:",
            "  speed_kmh: 60  # assumed",
            "  consist:",
        ]
        number = 1
        for block, bodies in zip(self.blocks, self.bodies):
            last = number + block.get("count", 1) * bodies - 1
            lines.append(f"    - {flow(block)}  # {cars(range(number, last + 1))}")
            number = last + 1
        lines += [
            "",
            "track:",
            f"  rail_breaks_under_cars: [{first}]  # assumed",
            "",
            "initiation:",
            f"  lateral_force_car: {first}  # assumed",
            "",
            "brakes:",
            "  vent_on_parting: true  # assumed; and an emergency from the front at the start",
            "",
            "couplers:",
            f"  knuckle_strength_N: {KNUCKLE * 1e-6:.2f}e6  # assumed: AAR M-211, static test",
        ]
        return "\n".join(lines) + "\n"

    def to_scenario(self) -> Scenario:
        """The scenario of :meth:`to_yaml`.

        Raises
        ------
        ScenarioError
            With the line of the list.
        """
        try:
            scenario = loads_scenario(self.to_yaml(), Path(self.file).stem)
        except ScenarioError as error:
            steps = error.field.split(".")
            line = self.lines[int(steps[2])] if steps[:2] == ["train", "consist"] else None
            raise ScenarioError(
                self.file, line, ".".join(steps[3:]) or error.field, error.reason
            ) from None
        scenario._document.files[self.file] = self.content
        scenario._document.notes.clear()
        return scenario


def read_consist_list(path: Path) -> ConsistList:
    """Read a consist list.

    Parameters
    ----------
    path
        CSV file with headings in its first line; commas, semicolons or tabs between columns.

    Raises
    ------
    ScenarioError
        Naming file, line, heading and reason.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ScenarioError(str(path), None, "", error.strerror or str(error)) from None
    if len(content) > MAX_BYTES:
        raise ScenarioError(str(path), None, "", f"is over the limit of {MAX_BYTES // 1024} KB")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    found = ConsistList(path.name, content)
    _Reader(found, load_rolling_stock()).read(text)
    return found


class _Reader:
    def __init__(self, result: ConsistList, stock: RollingStock) -> None:
        self.result = result
        self.stock = stock
        self.notes: dict[str, list[int]] = {}
        self.columns: list[Column] = []
        self.number = 1

    def error(self, line: int | None, heading: str, reason: str) -> ScenarioError:
        return ScenarioError(self.result.file, line, heading, reason)

    def note(self, text: str, n: int = 1) -> None:
        self.notes.setdefault(text, []).extend(range(self.number, self.number + n))

    def read(self, text: str) -> None:
        first = next((row for row in text.splitlines() if row.strip()), "")
        delimiter = max(",;\t", key=first.count)
        try:
            rows = list(csv.reader(io.StringIO(text), delimiter=delimiter, strict=True))
        except csv.Error as error:
            raise self.error(None, "", f"not valid CSV: {error}") from None
        table = [
            (i, [cell.strip() for cell in row])
            for i, row in enumerate(rows, 1)
            if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("# ")
        ]
        if not table:
            raise self.error(None, "", "is empty")
        self._headings(*table[0])
        for line, cells in self._ordered(table[1:]):
            self._row(line, cells)
        if not self.result.blocks:
            raise self.error(None, "", "has headings and no cars")
        for note, numbers in self.notes.items():
            self.result.assumed.append(f"{cars(numbers)}: {note}")
        self.result.assumed.append(COUPLINGS)

    # --- headings ---------------------------------------------------------------------------

    def _headings(self, line: int, cells: list[str]) -> None:
        seen: dict[str, Column] = {}
        unknown = []
        for i, heading in enumerate(cells):
            if not heading:
                continue
            column = self._column(line, i, heading)
            if column is None:
                unknown.append(heading)
                continue
            self.columns.append(column)
            other = seen.setdefault(column.meaning, column)
            if other is not column and column.meaning not in ("type", "name"):
                reason = f"means the same as {other.heading!r}: give one of the two"
                raise self.error(line, heading, reason)
        if "type" not in seen:  # a column "Car" names the kind of car where no other one does
            for i, column in enumerate(self.columns):
                if column.heading.lower() == "car":
                    seen["type"] = self.columns[i] = Column(column.index, column.heading, "type")
        if not seen.keys() & {"type", "length_over_couplers", "length"}:
            reason = "no column gives the type or the length of the cars"
            raise self.error(line, "", f"{reason}; headings: {', '.join(cells)[:200]}")
        length = seen.get("length_over_couplers")
        if length and not re.search("coupl|pulling", length.heading.lower()):
            self.result.assumed.append(f"column {length.heading!r} taken as over couplers")
        for heading in unknown:
            self.result.assumed.append(f"column {heading!r} is not used")

    def _column(self, line: int, index: int, heading: str) -> Column | None:
        words = re.sub(r"[_()\[\],.:;]+", " ", heading.lower()).split()
        for cut in (0, 1, 2, 3):
            head, tail = words[: len(words) - cut], " ".join(words[len(words) - cut :])
            meaning = _meaning(" ".join(head))
            if meaning is None:
                continue
            if tail:  # "Trucks (ft)" is a distance, "Loaded (lb)" a mass
                meaning = {"trucks": "truck_centres", "load": "gross"}.get(meaning, meaning)
            quantity = QUANTITIES.get(meaning)
            if quantity is None:
                return Column(index, heading, meaning) if not tail else None
            unit = next((u for u, names in UNIT_WORDS[quantity].items() if tail in names), "")
            if tail and not unit:
                continue
            if not unit and head == ["lading"]:
                return Column(index, heading, "contents")
            if not unit:
                example = "ft" if quantity == LENGTH else "lb"
                reason = f"names no unit; write for example {heading + f' ({example})'!r}"
                raise self.error(line, heading, reason)
            return Column(index, heading, meaning, unit, tail)
        return None

    # --- rows -------------------------------------------------------------------------------

    def _ordered(self, rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
        """The rows from the head of the train back, by the column of positions if there is one."""
        column = next((c for c in self.columns if c.meaning == "position"), None)
        if column is None:
            return rows
        by_number: dict[int, tuple[int, list[str]]] = {}
        for line, cells in rows:
            text = cells[column.index] if column.index < len(cells) else ""
            if not text.isdigit():
                raise self.error(line, column.heading, f"must be a whole number, got {text!r}")
            if int(text) == 0:
                raise self.error(line, column.heading, "is 0; positions count from 1, the head")
            if int(text) in by_number:
                other = by_number[int(text)][0]
                raise self.error(line, column.heading, f"{text} is on line {other} already")
            by_number[int(text)] = (line, cells)
        numbers = sorted(by_number)
        if any(c.meaning == "count" for c in self.columns):
            return [by_number[n] for n in numbers]
        for n, m in zip(numbers, numbers[1:]):
            if m != n + 1:
                line = by_number[m][0]
                raise self.error(line, column.heading, f"{m} follows {n}: a car is missing")
        return [by_number[n] for n in numbers]

    def _row(self, line: int, cells: list[str]) -> None:
        texts: dict[str, list[tuple[Column, str]]] = {}
        for column in self.columns:
            if column.index < len(cells) and cells[column.index]:
                texts.setdefault(column.meaning, []).append((column, cells[column.index]))
        car = _Car(self, line, texts)
        block = car.block()
        result = self.result
        n = block.get("count", 1) * car.bodies
        if car.kind is not None and car.kind.locomotive and self.number == result.locomotives + 1:
            result.locomotives += n
        last = result.blocks[-1] if result.blocks else None
        if car.bodies == 1 and last and _alike(last, block):
            last["count"] = last.get("count", 1) + block.get("count", 1)
        else:
            result.blocks.append(block)
            result.lines.append(line)
            result.bodies.append(car.bodies)
        self.number += n
        if self.number > MAX_CARS + 1:
            raise self.error(line, "", f"more than {MAX_CARS} cars")


class _Car:
    """A row of the list on its way to an entry of the consist."""

    def __init__(
        self, reader: _Reader, line: int, texts: dict[str, list[tuple[Column, str]]]
    ) -> None:
        self.reader, self.line, self.texts = reader, line, texts
        self.count = self._count()
        self.type_name, told = self._type()
        self.kind: CarType | None = reader.stock.cars.get(self.type_name)
        self.bodies = len(self.kind.platforms) if self.kind and self.kind.platforms else 1
        if told:
            self.note(told)

    def error(self, meaning: str, reason: str) -> ScenarioError:
        heading = self.texts[meaning][0][0].heading if meaning in self.texts else meaning
        return self.reader.error(self.line, heading, reason)

    def note(self, text: str) -> None:
        self.reader.note(text, self.count * self.bodies)

    def text(self, meaning: str) -> str:
        return " ".join(text for _, text in self.texts.get(meaning, ()))

    def number(self, meaning: str) -> tuple[float, str] | None:
        """Value and unit of a quantity; a zero says as little as an empty cell."""
        if meaning not in self.texts:
            return None
        ((column, text),) = self.texts[meaning]
        feet = FEET.match(text) if column.unit == "ft" and not _plain(text) else None
        if feet:
            value: float | None = float(feet[1]) + float(feet[2] or 0.0) / 12.0
        else:
            value = _plain(text)
        if value is None or value < 0.0:
            raise self.error(meaning, f"must be a number of {column.word}, got {shown(text)}")
        if value:
            self._check_size(column, value)
        value = round(value, 4)
        return (int(value) if value == int(value) else value, column.unit) if value else None

    def _check_size(self, column: Column, value: float) -> None:
        """Refuse what no car has, in the words of the list."""
        if column.meaning not in SIZES:
            return
        units = UNITS[QUANTITIES[column.meaning]]
        low, high, small, large = SIZES[column.meaning]
        size = value * units[column.unit]
        if low <= size <= high:
            return
        others = [u for u in ("m", "ft", "lb", "kg") if low <= value * units.get(u, 0.0) <= high]
        hint = f"; is it in {others[0]}?" if others else ""
        reason = f"{value:g} {column.word}: no car is that {small if size < low else large}"
        raise self.error(column.meaning, reason + hint)

    def written(self, meaning: str) -> str:
        """A quantity as the list has it, with its unit."""
        ((column, text),) = self.texts[meaning]
        return f"{text} {column.word}"

    def si(self, meaning: str) -> float | None:
        given = self.number(meaning)
        if given is None:
            return None
        return given[0] * UNITS[QUANTITIES[meaning]][given[1]]

    def _count(self) -> int:
        text = self.text("count") or "1"
        if not text.isdigit() or not 1 <= int(text) <= MAX_CARS:
            raise self.error("count", f"must be a whole number from 1 up, got {shown(text)}")
        return int(text)

    def _type(self) -> tuple[str, str]:
        """Name of the car type in the library, "" where there is none; what is assumed of it."""
        given = self.texts.get("type", [])
        found = [
            (match, text) for _, text in given if (match := find_type(text, self.reader.stock))
        ]
        if found:
            (name, sure), text = max(found, key=lambda item: item[0][1])
            return name, "" if sure == EXACT else f"{text!r} taken as {name}"
        if given and not (self.has_length and ("gross" in self.texts or "tare" in self.texts)):
            text = given[0][1]
            near = did_you_mean(text.lower().replace(" ", "_"), self.reader.stock.cars)
            reason = (
                f"unknown car type {shown(text)}{near}; without a type length and mass are needed"
            )
            raise self.error("type", reason)
        if not given and not self.has_length:
            raise self.error("length_over_couplers", "is empty, and the car has no type")
        return "", ""

    @property
    def has_length(self) -> bool:
        return "length_over_couplers" in self.texts or "length" in self.texts

    def block(self) -> dict[str, Any]:
        """The entry of the consist."""
        block: dict[str, Any] = {"car": self.type_name} if self.kind else {}
        if self.count > 1:
            block["count"] = self.count
        name = self.text("name") or ("" if self.kind else self.text("type"))
        for key, value in (("name", name), ("contents", self.text("contents"))):
            if value:
                block[key] = value[:60]
        if brake := self._brake():
            block["brake"] = brake
        self._check_trucks()
        if self.bodies > 1:
            block |= self._share()
            return block
        block |= self._masses()
        for meaning in ("length_over_couplers", "length", "width", "truck_centres"):
            if given := self.number(meaning):
                block[f"{meaning}_{given[1]}"] = given[0]
        block |= self._trucks()
        if self.kind is None:
            block["coupler"] = "E60"
            self.note("no car type: couplers E60")
        return block

    def _brake(self) -> dict[str, Any]:
        text = self.text("brakes").upper().replace("_", " ")
        if not text:
            return {}
        if text not in BRAKES:
            raise self.error(
                "brakes", f"must be one of {', '.join(BRAKES).lower()}, got {shown(text)}"
            )
        return BRAKES[text]

    def _check_trucks(self) -> None:
        text = self.text("trucks")
        if not text:
            return
        value = _plain(text)
        if value != self.bodies + 1:
            kind = self.type_name or "a car of no type"
            known = [name for name, car in self.reader.stock.cars.items() if car.platforms]
            reason = f"{text} trucks, but {kind} has {self.bodies + 1}"
            raise self.error("trucks", f"{reason}; articulated types: {', '.join(known)}")

    def _load(self) -> float | str | None:
        text = self.text("load").upper()
        if not text:
            return None
        if text in LOADS:
            return LOADS[text]
        value = _plain(text)
        if value is None or not 0.0 <= value <= 1.0:
            raise self.error("load", f"must be L or E, or a share from 0 to 1, got {shown(text)}")
        return value

    def _masses(self) -> dict[str, Any]:
        """What the list says of mass and load, in its own units."""
        load = self._load()
        tare, gross, lading = (self.number(key) for key in ("tare", "gross", "lading"))
        light, heavy, goods = (self.si(key) for key in ("tare", "gross", "lading"))
        if light is not None and heavy is not None and heavy < light:
            reason = f"{self.written('gross')} is below the tare of {self.written('tare')}"
            raise self.error("gross", reason)
        if self.kind is not None and self.kind.locomotive:
            given = gross or tare
            return {f"mass_{given[1]}": given[0]} if given else {}
        if goods is not None and gross is None:
            own = light
            if own is None and self.kind is not None:
                own = self.kind.empty_mass_kg
            if own is None:
                raise self.error(
                    "lading", "the tare is needed with it: neither list nor type has it"
                )
            gross, heavy = (round(own + goods, 3), "kg"), own + goods
        if load is None:
            if gross is None and self.text("lading"):
                load = "empty"  # a lading of nothing
            elif light is not None and heavy is not None:
                load = "loaded" if heavy > 1.1 * light else "empty"
            elif gross is not None:
                return {f"mass_{gross[1]}": gross[0]}
            else:
                load = "loaded"
                self.note("taken as loaded")
        empty = load == "empty" or load == 0.0
        own = self.kind.empty_mass_kg if self.kind is not None and light is None else None
        if own and heavy is not None and "gross" in self.texts and not empty and heavy <= own:
            ((column, _),) = self.texts["gross"]
            usual = own / UNITS[MASS][column.unit]
            reason = f"{self.written('gross')} loaded is not above the empty mass of "
            raise self.error("gross", f"{reason}{self.type_name}, {usual:.4g} {column.word}")
        if self.kind is None and gross is None and (tare is None or not empty):
            key = "tare" if empty else "gross"
            raise self.error(key, f"is needed of a car that is {load} and has no type")
        masses: dict[str, Any] = {"load": load}
        if empty and tare is None and gross is not None:
            tare, gross = gross, None
        if tare is not None:
            masses[f"empty_mass_{tare[1]}"] = tare[0]
        if gross is not None and not (empty and light is not None and heavy <= 1.1 * light):  # type: ignore[operator]
            masses[f"loaded_mass_{gross[1]}"] = gross[0]
        if tare is None and gross is None and self.kind is not None:
            self.note(f"mass of {self.type_name}")
        return masses

    def _share(self) -> dict[str, Any]:
        """The load of an articulated car, whose masses are those of its platforms' types."""
        types = [self.reader.stock.cars[name] for name in self.kind.platforms]  # type: ignore[union-attr]
        light = sum(t.empty_mass_kg or 0.0 for t in types)
        span = sum(t.loaded_mass_kg or 0.0 for t in types) - light
        heavy, goods = self.si("gross"), self.si("lading")
        own = self.si("tare") or light
        load = self._load()
        if goods is None and heavy is not None:
            goods = max(heavy - own, 0.0)
        self.note(f"lengths and tare of {self.type_name}")
        if goods is None:
            return {} if load is None else {"load": load}
        share = min(goods / span, 1.0)
        if goods > span:
            self.note(f"more load than {self.type_name} holds: taken as full")
        return {"load": round(share if share >= LEAST_LOAD / 10 else 0.0, 4)}

    def _trucks(self) -> dict[str, Any]:
        """Truck centres where the list has none and the type's would not fit the length."""
        if "truck_centres" in self.texts:
            return {}
        length = self.si("length_over_couplers")
        if self.kind is None:
            own = length or self.si("length")
            assert own is not None
            self.note(f"no car type: truck centres {TRUCK_SHARE:g} of the length")
            return {"truck_centres_m": round(TRUCK_SHARE * own, 3)}
        usual = self.kind.length_over_couplers_m
        if length is None or usual is None or abs(length / usual - 1.0) < 0.02:
            return {}
        self.note(f"truck centres of {self.type_name} in proportion to the length")
        assert self.kind.truck_centres_m is not None
        return {"truck_centres_m": round(self.kind.truck_centres_m * length / usual, 3)}


EXACT, SPECIFICATION, CODE, ALIAS, LIKELY = 4, 3, 2, 1, 0
"""How sure a type is: by its name, by an alias with a number (DOT-111), by a code of more than a
letter (C112), by another alias (covered hopper), by a letter or a part of the text."""


def find_type(text: str, stock: RollingStock) -> tuple[str, int] | None:
    """The library type that a list means, and how sure that is.

    By its name, an alias, the beginning of its AAR car type code (a letter and three figures), or
    an alias within the text.
    """
    plain = _normal(text)
    if text in stock.cars:
        return text, EXACT
    for name, kind in stock.cars.items():  # today's cars before older ones of the same name
        if plain in map(_normal, kind.aliases):
            return name, SPECIFICATION if re.search(r"\d", plain) else ALIAS
    for name in stock.cars:
        if plain == _normal(name):
            return name, ALIAS
    if re.fullmatch(r"[A-Z]\d{2,3}[A-Z]?|[A-Z]", plain):
        codes = [(code, n) for n, kind in stock.cars.items() for code in kind.aar_codes]
        fits = [(len(code), n) for code, n in codes if plain.startswith(code)]
        if not fits:
            return None
        length, name = max(fits)
        return name, CODE if length > 1 else LIKELY
    inside = [
        (len(_normal(alias)), name)
        for name, kind in stock.cars.items()
        for alias in kind.aliases
        if len(_normal(alias)) >= 4 and _normal(alias) in plain
    ]
    return (max(inside)[1], LIKELY) if inside else None


def _normal(text: str) -> str:
    return re.sub(r"[^A-Z0-9]+", "", text.upper())


def _meaning(words: str) -> str | None:
    return next((key for key, names in HEADINGS.items() if words in names.split(", ")), None)


def _plain(text: str) -> float | None:
    """A number, with commas or blanks between thousands."""
    text = text.replace(" ", "").replace("\N{NO-BREAK SPACE}", "")
    if re.fullmatch(r"\d{1,3}(,\d{3})+(\.\d+)?", text):
        text = text.replace(",", "")
    if re.fullmatch(r"\d+,\d+", text):
        text = text.replace(",", ".")
    return float(text) if re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)", text) else None


def _alike(last: dict[str, Any], block: dict[str, Any]) -> bool:
    return {**last, "count": 1} == {**block, "count": 1}
