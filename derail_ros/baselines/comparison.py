"""Models side by side on one train: tables of measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from derail_ros.baselines.models import MODELS, ModelRun, run_model
from derail_ros.baselines.train import ModelError
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.measures import MEASURES, Record
from derail_ros.vocabulary.status import AT_REST

if TYPE_CHECKING:
    from derail_ros.vocabulary.params import TrainParams

WALL = "wall_s"

KEYS = ("cars_derailed", "duration_s", "peak_force_N", "scene_length_m", "scene_width_m", WALL)
"""What is compared."""


@dataclass(frozen=True)
class Entry:
    """A model's answer, or why there is none."""

    model: str
    run: ModelRun | None
    error: str | None = None

    @property
    def record(self) -> Record | None:
        """The outcome."""
        return None if self.run is None else self.run.record

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        if self.run is None:
            return {"error": self.error}
        return {"outcome": self.run.record, "notes": self.run.notes}


def compare(
    params: TrainParams,
    models: Sequence[str] = tuple(MODELS),
    progress: Callable[[str, int], None] | None = None,
) -> list[Entry]:
    """Run models on a train; one that cannot be run is an entry with the reason.

    ``progress`` is called with the model that comes next and the number of those done.
    """
    from derail_ros.vocabulary.errors import DerailError

    entries = []
    for done, name in enumerate(models):
        if progress is not None:
            progress(name, done)
        try:
            entries.append(Entry(name, run_model(name, params)))
        except (ModelError, DerailError) as error:
            entries.append(Entry(name, None, " ".join(str(error).split())))
    return entries


def heading(key: str) -> str:
    """Heading of the column of a measure."""
    return "wall time (s)" if key == WALL else MEASURES[key].title


def cell(record: Mapping[str, Any] | None, key: str) -> str:
    """A measure as text; ``-`` where the model does not compute it."""
    value = None if record is None else record.get(key)
    if key == WALL:
        return "-" if value is None else f"{value:.3f}"
    return MEASURES[key].shown(value)


def comparison_table(entries: Sequence[Entry]) -> Table:
    """A row a model: the measures, and a remark."""
    rows = []
    for entry in entries:
        record = entry.record
        remark = entry.error or ""
        if record is not None and record["status"] != AT_REST:
            remark = record["status"]
        rows.append([entry.model, *(cell(record, key) for key in KEYS), remark])
    return Table(["model", *map(heading, KEYS), ""], rows)


def by_speed_table(speeds: Sequence[float], runs: Sequence[Sequence[Entry]]) -> Table:
    """Cars derailed and duration of each model (rows) at each speed (columns, km/h)."""
    rows = []
    for k, entry in enumerate(runs[0]):
        records = [entries[k].record for entries in runs]
        rows.append(
            [entry.model, *(f"{cell(r, 'cars_derailed')}, {cell(r, 'duration_s')} s"
                            for r in records)]
        )  # fmt: skip
    return Table(["model", *(f"{v:g} km/h" for v in speeds)], rows)
