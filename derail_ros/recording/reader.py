"""Reading of a recording: one run of it as numpy arrays.

:func:`read_bag` reads recordings that are cut off, damaged or incomplete as well. It works out
what is missing from the rest, and ``warnings`` of the run says so.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import check_version, is_known, namespace_of
from derail_ros.recording.derived_outcome import derive_couplings, derive_outcome
from derail_ros.recording.manifest import FILE_NAME
from derail_ros.recording.recorded_run import Cars, RecordedRun, SampledLine
from derail_ros.recording.run_messages import REPORTS, STATES, Collector, RunMessages
from derail_ros.recording.storage import OtherTopicsError, RawBag, open_bag
from derail_ros.vocabulary.events import Event
from derail_ros.vocabulary.outcome import Outcome, parted_couplings
from derail_ros.vocabulary.words import count
from msg_adapters.common import NANOSECONDS

F64 = NDArray[np.float64]


def read_bag(
    path: str | Path, run: int | str | None = None, namespace: str | None = None
) -> RecordedRun:
    """Read a run of a recording.

    Parameters
    ----------
    path : the recording's folder, a file of it, or a folder with one recording in it
    run : which run, where the recording holds several: its number from 1, negative from the end,
        or the beginning of its identity. Default: the last.
    namespace : of the topics, where several trains were recorded. Default: the first.

    Raises
    ------
    BagError
        If there is nothing that can be reviewed; its subclass says why.
    """
    bag = open_bag(path)
    check_version(bag)
    prefix, namespaces = namespace_of(bag.channels, namespace)
    if namespace is None and len(namespaces) > 1:
        others = ", ".join(f"{n or '/'}" for n in namespaces[1:])
        bag.warn(f"several trains: {prefix or '/'} is read, not {others}")
    return _Reader(bag, prefix).read(run)


class _Reader:
    def __init__(self, bag: RawBag, prefix: str) -> None:
        self.bag = bag
        self.prefix = prefix
        self.collector = Collector()

    def read(self, run: int | str | None) -> RecordedRun:
        self._pass(lambda c: c.is_manifest or (is_known(c) and c.kind in REPORTS))
        runs = self.collector.runs
        run_ids = [k for k, m in runs.items() if m.consist or m.events or m.outcome]
        if not run_ids:
            raise OtherTopicsError(f"{self.bag.path}: the recording contains no run")
        run_id = self._choose(run_ids, run)
        self._pass(lambda c: is_known(c) and c.kind in STATES, only=run_id)
        if broken := self.collector.broken:
            self.bag.warn(f"{count(broken, 'message')} cannot be read")
        if implausible := self.collector.implausible:
            self.bag.warn(f"{count(implausible, 'message')} with impossible numbers skipped")
        return self._assemble(run_id, run_ids, runs[run_id])

    def _pass(self, wanted: Callable[[Channel], bool], only: str | None = None) -> None:
        """Take the messages of the wanted channels of this train."""
        mine = self.bag.messages(lambda c: c.namespace == self.prefix and wanted(c))
        for channel, _, data in mine:
            self.collector.take(channel, data, only)

    def _manifest(self) -> dict[str, Any]:
        """The manifest in the recording or beside it, {} without."""
        text = self.collector.manifest_text
        folder = self.bag.path if self.bag.path.is_dir() else self.bag.path.parent
        try:
            value = json.loads(text or (folder / FILE_NAME).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            if text:
                self.bag.warn("its manifest cannot be read")
            return {}
        return value if isinstance(value, dict) else {}

    def _choose(self, run_ids: list[str], run: int | str | None) -> str:
        path = self.bag.path
        if run is None:
            if len(run_ids) > 1:
                self.bag.warn(f"{len(run_ids)} runs: the last one is reviewed")
            return run_ids[-1]
        if isinstance(run, int) or run.lstrip("-").isdigit():
            number = int(run)
            index = number - 1 if number > 0 else number + len(run_ids)
            if number == 0 or not 0 <= index < len(run_ids):
                raise OtherTopicsError(
                    f"{path}: no run {number}; the recording has {len(run_ids)}"
                )
            return run_ids[index]
        found = [r for r in run_ids if r.startswith(run)]
        if len(found) != 1:
            many = f"{len(found)} runs begin" if found else "no run begins"
            known = ", ".join(r[:8] for r in run_ids)
            raise OtherTopicsError(f"{path}: {many} with {run!r}; the recording has {known}")
        return found[0]

    # --- putting together ---------------------------------------------------------------------

    def _assemble(self, run_id: str, run_ids: list[str], got: RunMessages) -> RecordedRun:
        bag = self.bag
        left_out = "".join(f"; {w}" for w in bag.warnings if "impossible numbers" in w)
        if got.consist is None:
            raise OtherTopicsError(
                f"{bag.path}: no consist of run {run_id[:8]}: without it the cars are not known"
                + left_out
            )
        consist = got.consist
        cars = Cars.of_message(consist)
        n = len(cars)
        if not got.states.count:
            raise OtherTopicsError(
                f"{bag.path}: no states of run {run_id[:8]} (train_state){left_out}"
            )
        time, pose, velocity, coupler_yaw, truck_on, brake, corner, stamp = got.states.columns()
        if pose.shape[1] != n:
            raise OtherTopicsError(
                f"{bag.path}: the states have {count(pose.shape[1], 'car')}, the consist has {n}"
            )
        if got.line is None:
            bag.warn("no track: assuming a straight one")
        _drop_unknown_cars(got, n, int(cars.represents.sum()))
        self._count_missing(got.events, "event")
        self._count_missing(got.collisions, "collision")
        events = tuple(sorted(got.events.values(), key=lambda e: e.time))
        if got.states.every > 1:
            bag.warn(f"long recording: only every {got.states.every}th state is shown")
        else:
            self._count_gaps(time)
        scenario = _scenario(consist.scenario_yaml, bag)
        energy: dict[str, F64] = {}
        energy_time = np.zeros(0)
        if got.energy.count:
            energy_time, table, names = got.energy.columns()
            energy = {str(entry): table[:, k] for k, entry in enumerate(names[0])}
        else:
            bag.warn("no energy ledger")
        run = RecordedRun(
            path=bag.path,
            storage=bag.storage,
            size=bag.size,
            prefix=self.prefix,
            warnings=(),
            run_id=run_id,
            run_ids=tuple(run_ids),
            name=str(consist.scenario_name),
            title=str(scenario.get("title") or consist.scenario_name or "train"),
            scenario=scenario,
            scenario_hash=str(consist.scenario_hash),
            model=str(consist.model),
            software=str(consist.software_version),
            files={str(f.name): bytes(f.content) for f in consist.files},
            initial_speed=float(consist.initial_speed),
            manifest=self._manifest(),
            cars=cars,
            line=got.line or SampledLine(),
            events=events,
            collisions=tuple(got.collisions[k] for k in sorted(got.collisions)),
            outcome=Outcome.nothing(pose[-1], "", float(time[-1])),
            commands=tuple(got.commands[k] for k in sorted(got.commands)),
            time=time,
            stamp0=float(stamp[0] / NANOSECONDS - time[0]),
            pose=pose,
            velocity=velocity,
            coupler_yaw=coupler_yaw,
            truck_on=truck_on,
            coupled=self._coupled(got, events, time, cars.cut),
            brake_force=brake,
            corner_force=corner,
            thinned=got.states.every,
            energy_time=energy_time,
            energy=energy,
        )
        outcome = got.outcome
        if outcome is None or not outcome.final or len(outcome.pose) != n:
            outcome = derive_outcome(run, outcome)
            if outcome.final:
                bag.warn("no final outcome: computed from states, events and collisions")
            else:
                bag.warn(
                    "the recording ends before the run: the outcome is that at"
                    f" {outcome.time:.2f} s, the last recorded moment"
                )
        if set(outcome.energy) == {"initial"} and np.any(energy_time >= outcome.time - 1e-9):
            # Of the ledger, outcomes of version 1 hold how it began; its messages hold the rest.
            outcome = replace(outcome, energy=run.ledger() | dict(outcome.energy))
        outcome = replace(
            outcome,
            train=cars.totals,
            parted=outcome.parted or parted_couplings(run.events, cars.own),
        )
        return replace(run, outcome=outcome, warnings=tuple(bag.warnings))

    def _coupled(
        self,
        got: RunMessages,
        events: tuple[Event, ...],
        time: F64,
        cut: NDArray[np.int64],
    ) -> NDArray[np.bool_]:
        n = len(cut)
        if got.couplings.count:
            when, table = got.couplings.columns()
            if table.ndim == 2 and table.shape[1] == n - 1:
                index = np.clip(np.searchsorted(when, time + 1e-9) - 1, 0, len(when) - 1)
                return np.asarray(table[index], dtype=bool)
        elif n > 1:
            self.bag.warn("no coupler states: couplings are taken from the events")
        return derive_couplings(events, time, cut)

    def _count_missing(self, numbered: dict[int, Any], noun: str) -> None:
        """Warn of gaps in numbers that begin at 0."""
        if missing := max(numbered, default=-1) + 1 - len(numbered):
            self.bag.warn(f"{count(missing, noun)} {'is' if missing == 1 else 'are'} missing")

    def _count_gaps(self, time: F64) -> None:
        """Warn of states that are missing by their regular times."""
        steps = np.diff(time)
        if len(steps) < 3:
            return
        missing = int(np.maximum(np.round(steps / np.median(steps)) - 1, 0).sum())
        if missing:
            share = 100.0 * missing / (missing + len(time))
            are = "is" if missing == 1 else "are"
            self.bag.warn(f"{count(missing, 'state')} {are} missing ({share:.1f} %)")


def _scenario(text: str, bag: RawBag) -> dict[str, Any]:
    """The scenario as plain data, {} where it cannot be read."""
    try:
        value = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError:
        bag.warn("its scenario cannot be read")
        return {}
    return value if isinstance(value, dict) else {}


def _drop_unknown_cars(got: RunMessages, n: int, real: int) -> None:
    """Leave out what is said about cars that the train does not have.

    Events also name the cars that the last body stands for.
    """

    def pair(a: int, b: int, obstacle: str = "") -> bool:
        return 1 <= a <= n and a != b and (1 <= b <= n or bool(obstacle))

    got.events = {k: e for k, e in got.events.items() if all(1 <= c <= real for c in e.cars)}
    got.collisions = {k: c for k, c in got.collisions.items() if pair(c.car_a, c.car_b, c.object)}
    if (o := got.outcome) is not None:
        struck = o.peak_force_pair is None or pair(*o.peak_force_pair)
        if not struck or any(not 1 <= c <= real for c in o.derailed_cars):
            got.outcome = None
