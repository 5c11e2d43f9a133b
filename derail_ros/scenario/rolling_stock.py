"""The rolling stock library: car, locomotive and coupler types from ``config/rolling_stock``."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from derail_ros.config_path import config_dir
from derail_ros.scenario.errors import Refusal
from derail_ros.scenario.files import read_text
from derail_ros.scenario.messages import validated
from derail_ros.scenario.schema import CarType, CarTypeFile, CouplerSpec, CouplerTypeFile
from derail_ros.scenario.strict_yaml import Path as Place
from derail_ros.scenario.strict_yaml import parse
from derail_ros.scenario.units import canonical


@dataclass(frozen=True)
class RollingStock:
    """Types by name."""

    cars: dict[str, CarType]
    couplers: dict[str, CouplerSpec]


def load_rolling_stock() -> RollingStock:
    """Read every file of the shipped rolling stock.

    A file holds either ``car_types`` or ``coupler_types``. Files are read again when they change.

    Raises
    ------
    ScenarioError
        Naming the file, line and field of the first mistake.
    """
    found = sorted((config_dir() / "rolling_stock").glob("*.yaml"))
    files = tuple((str(p), p.stat().st_mtime_ns) for p in found)
    return _load(files)


def check_car_type(kind: CarType, path: Place) -> None:
    """Refuse a car type whose numbers contradict each other or are missing."""
    if kind.platforms:
        return
    if kind.length_m is None and kind.length_over_couplers_m is None:
        raise Refusal((*path, "length_m"), "is required, or length_over_couplers_m")
    for key in ("truck_centres_m", "coupler"):
        if getattr(kind, key) is None:
            raise Refusal((*path, key), "is required")
    if kind.coupler_pivots_m is not None and kind.length_over_couplers_m is not None:
        reason = "length_over_couplers_m is given too: give one of the two"
        raise Refusal((*path, "coupler_pivots_m"), reason)
    span = [kind.empty_mass_kg, kind.loaded_mass_kg]
    if kind.mass_kg is not None:
        if span != [None, None]:
            raise Refusal((*path, "mass_kg"), "goes without empty_mass_kg and loaded_mass_kg")
    elif kind.empty_mass_kg is None or kind.loaded_mass_kg is None:
        reason = "is required, or both empty_mass_kg and loaded_mass_kg"
        raise Refusal((*path, "mass_kg"), reason)
    elif kind.empty_mass_kg > kind.loaded_mass_kg:
        raise Refusal((*path, "empty_mass_kg"), "must not be above loaded_mass_kg")


@functools.lru_cache(maxsize=8)
def _load(files: tuple[tuple[str, int], ...]) -> RollingStock:
    cars: dict[str, CarType] = {}
    couplers: dict[str, CouplerSpec] = {}
    for name, _ in files:
        document = parse(read_text(Path(name)), name)
        model = CouplerTypeFile if "coupler_types" in document.data else CarTypeFile
        with document.refusals():
            document.data = canonical(document.data, model, (), document.written)
            content = validated(model, document.data)
            if isinstance(content, CouplerTypeFile):
                couplers.update(content.coupler_types)
            elif isinstance(content, CarTypeFile):
                for key, kind in content.car_types.items():
                    if key in cars:
                        raise Refusal(("car_types", key), "is defined in two files")
                    check_car_type(kind, ("car_types", key))
                cars.update(content.car_types)
    return RollingStock(cars, couplers)
