"""The rolling stock library: car, locomotive and coupler types from ``config/rolling_stock``."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from derail_ros.scenario.files import read_text, rolling_stock_dir
from derail_ros.scenario.messages import first_mistake
from derail_ros.scenario.schema import CarType, CarTypeFile, CouplerSpec, CouplerTypeFile
from derail_ros.scenario.strict_yaml import parse


@dataclass(frozen=True)
class RollingStock:
    """Types by name."""

    cars: dict[str, CarType]
    couplers: dict[str, CouplerSpec]


def load_rolling_stock(folder: Path | None = None) -> RollingStock:
    """Read every file of a rolling stock folder (default: the shipped one).

    A file holds either ``car_types`` or ``coupler_types``. Files are read again when they change.

    Raises
    ------
    ScenarioError
        Naming the file, line and field of the first mistake.
    """
    folder = rolling_stock_dir() if folder is None else folder
    files = tuple((str(p), p.stat().st_mtime_ns) for p in sorted(folder.glob("*.yaml")))
    return _load(files)


@functools.lru_cache(maxsize=8)
def _load(files: tuple[tuple[str, int], ...]) -> RollingStock:
    cars: dict[str, CarType] = {}
    couplers: dict[str, CouplerSpec] = {}
    for name, _ in files:
        document = parse(read_text(Path(name)), name)
        model = CouplerTypeFile if "coupler_types" in document.data else CarTypeFile
        try:
            content = model.model_validate(document.data)
        except ValidationError as error:
            mistake = first_mistake(error, model)
            raise document.error(mistake.path, mistake.reason) from None
        if isinstance(content, CouplerTypeFile):
            couplers.update(content.coupler_types)
        elif isinstance(content, CarTypeFile):
            for key in content.car_types:
                if key in cars:
                    raise document.error(("car_types", key), "is defined in two files")
            cars.update(content.car_types)
    return RollingStock(cars, couplers)
