"""Reading of a recording: one run of it as numpy arrays.

:func:`read_bag` reads recordings that are cut off, damaged or incomplete as well. It works out
what is missing from the rest, and ``warnings`` of the run says so.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import check_version, decode, is_known, namespace_of
from derail_ros.recording.derived_outcome import derive_couplings, derive_outcome
from derail_ros.recording.manifest import FILE_NAME
from derail_ros.recording.plausibility import is_plausible
from derail_ros.recording.recorded_run import Cars, RecordedRun, SampledLine
from derail_ros.recording.storage import OtherTopicsError, RawBag, open_bag
from derail_ros.vocabulary.events import Collision, Event
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.words import count
from msg_adapters.common import NANOSECONDS, stamp_of
from msg_adapters.reports import (
    collision_from_message,
    event_from_message,
    ledger_from_message,
    outcome_from_message,
)
from msg_adapters.topics import MANIFEST

F64 = NDArray[np.float64]

BUDGET = 120_000_000
"""Memory for the states of a run; of longer ones every second, fourth ... state is kept, bytes."""
POSE = ("x", "y", "z", "roll", "pitch", "yaw")
VELOCITY = ("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate")


def read_bag(
    path: str | Path, run: int | str | None = None, namespace: str | None = None
) -> RecordedRun:
    """Read a run of a recording.

    Parameters
    ----------
    path
        The recording's folder, a file of it, or a folder with one recording in it.
    run
        Which run, where the recording holds several: its number from 1, negative from the end,
        or the beginning of its identity. Default: the last.
    namespace
        Of the topics, where several trains were recorded. Default: the first.

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


class _Series:
    """Rows of a state topic; beyond a budget of memory every second one is dropped."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, ...]] = []
        self.every = 1
        self.count = 0
        self.last: tuple[Any, ...] | None = None
        self.limit = 0

    def add(self, row: tuple[Any, ...]) -> None:
        if not self.limit:
            size = sum(a.nbytes if isinstance(a, np.ndarray) else 8 for a in row) + 1200
            self.limit = max(200, BUDGET // size)
        if self.count % self.every == 0:
            self.rows.append(row)
            if len(self.rows) > self.limit:
                del self.rows[1::2]
                self.every *= 2
        self.last = row
        self.count += 1

    def fits(self, row: tuple[Any, ...]) -> bool:
        """Whether a row is of as many cars as the first one."""
        return not self.rows or np.shape(row[1]) == np.shape(self.rows[0][1])

    def columns(self) -> list[Any]:
        """Columns in order of the first one, each time once."""
        rows = self.rows
        if self.last is not None and rows[-1] is not self.last:
            rows = [*rows, self.last]
        times = np.array([row[0] for row in rows])
        _, order = np.unique(times[::-1], return_index=True)  # of equal times the later one
        rows = [rows[len(rows) - 1 - k] for k in order]
        return [np.array(column) for column in zip(*rows)]


@dataclass
class _Collected:
    """What the messages of a run say."""

    consist: Any = None
    line: SampledLine | None = None
    outcome: Outcome | None = None
    events: dict[int, Event] = field(default_factory=dict)
    collisions: dict[int, Collision] = field(default_factory=dict)
    commands: dict[int, dict[str, Any]] = field(default_factory=dict)
    states: _Series = field(default_factory=_Series)
    couplings: _Series = field(default_factory=_Series)
    energy: _Series = field(default_factory=_Series)

    def take_state(self, m: Any) -> bool | None:
        trucks = np.stack([m.truck_status_front, m.truck_status_rear], axis=-1)
        row = (
            float(m.time),
            np.stack([getattr(m, k) for k in POSE], axis=-1),
            np.stack([getattr(m, k) for k in VELOCITY], axis=-1),
            np.stack([m.coupler_angle_front, m.coupler_angle_rear], axis=-1),
            trucks == m.TRUCK_ON_RAILS,
            m.brake_force.astype(np.float32),
            m.largest_corner_force.astype(np.float32),
            stamp_of(m),
        )
        return self.states.add(row) if self.states.fits(row) else False

    def take_couplers(self, m: Any) -> bool | None:
        row = (float(m.time), m.coupled == m.COUPLED)
        return self.couplings.add(row) if self.couplings.fits(row) else False

    def take_ledger(self, m: Any) -> bool | None:
        ledger = ledger_from_message(m.entries)
        row = (float(m.time), np.array(list(ledger.values())), tuple(ledger))
        return self.energy.add(row) if self.energy.fits(row) else False

    def take_event(self, m: Any) -> None:
        self.events[int(m.sequence)] = event_from_message(m)

    def take_collision(self, m: Any) -> None:
        old = self.collisions.get(int(m.id))
        if old is None or not old.final:
            self.collisions[int(m.id)] = collision_from_message(m)

    def take_end(self, m: Any) -> None:
        if self.outcome is None or not self.outcome.final or m.is_final:
            self.outcome = outcome_from_message(m)

    def take_command(self, m: Any) -> None:
        self.commands[int(m.sequence)] = {
            "command": m.command,
            "request": m.request_json,
            "caller": m.caller,
            "accepted": bool(m.accepted),
            "message": m.message,
            "time": float(m.time),
            "step": int(m.step),
        }

    def take_train(self, m: Any) -> None:
        self.consist = m

    def take_track(self, m: Any) -> None:
        self.line = SampledLine.of_message(m)


TAKE: dict[str, Callable[[_Collected, Any], bool | None]] = {
    "Collision": _Collected.take_collision,
    "CommandLog": _Collected.take_command,
    "Consist": _Collected.take_train,
    "CouplerStates": _Collected.take_couplers,
    "EnergyLedger": _Collected.take_ledger,
    "Outcome": _Collected.take_end,
    "Track": _Collected.take_track,
    "TrainEvent": _Collected.take_event,
    "TrainState": _Collected.take_state,
}
"""Type of ``derail_msgs`` -> what keeps its messages; ``False`` if one does not fit the others."""


class _Reader:
    def __init__(self, bag: RawBag, prefix: str) -> None:
        self.bag = bag
        self.prefix = prefix
        self.manifest: dict[str, Any] = {}

    def read(self, run: int | str | None) -> RecordedRun:
        run_ids = self._run_ids("Consist", "Outcome", "TrainEvent") or self._run_ids("TrainState")
        if not run_ids:
            raise OtherTopicsError(f"{self.bag.path}: a recording without a run in it")
        run_id = self._choose(run_ids, run)
        return self._assemble(run_id, run_ids, self._collect(run_id))

    def _messages(self, wanted: Callable[[Channel], bool]) -> Any:
        """Channel and message of the wanted channels of this train, ``None`` if unreadable."""
        for channel, _, data in self.bag.messages(
            lambda c: c.namespace == self.prefix and wanted(c)
        ):
            try:
                yield channel, decode(channel, data)
            except Exception:  # bytes that are no message make rosbags raise anything
                yield channel, None

    def _run_ids(self, *kinds: str) -> list[str]:
        """Identities of the runs in order, from a few kinds of messages; keeps the manifest."""
        seen: dict[str, None] = {}
        for channel, message in self._messages(
            lambda c: _is_manifest(c) or (is_known(c) and c.kind in kinds)
        ):
            if message is None:
                continue
            if not _is_manifest(channel):
                seen.setdefault(message.run_id)
                continue
            try:
                manifest = json.loads(message.data)
                self.manifest = manifest if isinstance(manifest, dict) else {}
            except ValueError:
                self.bag.warn("its manifest cannot be read")
        return list(seen)

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
                raise OtherTopicsError(f"{path}: no run {number}; there are {len(run_ids)}")
            return run_ids[index]
        found = [r for r in run_ids if r.startswith(run)]
        if len(found) != 1:
            many = f"{len(found)} runs begin" if found else "no run begins"
            known = ", ".join(r[:8] for r in run_ids)
            raise OtherTopicsError(f"{path}: {many} with {run!r}; there are {known}")
        return found[0]

    def _collect(self, run_id: str) -> _Collected:
        got = _Collected()
        broken = implausible = 0
        for channel, message in self._messages(lambda c: is_known(c) and c.kind in TAKE):
            if message is None:
                broken += 1
            elif message.run_id != run_id:
                continue
            elif not is_plausible(channel.kind, message):
                implausible += 1
            else:
                try:
                    implausible += TAKE[channel.kind](got, message) is False
                except (KeyError, ValueError):  # a kind of event that is not known here
                    broken += 1
        if broken:
            self.bag.warn(f"{count(broken, 'message')} cannot be read")
        if implausible:
            self.bag.warn(f"{count(implausible, 'message')} with impossible numbers left out")
        return got

    # --- putting together ---------------------------------------------------------------------

    def _assemble(self, run_id: str, run_ids: list[str], got: _Collected) -> RecordedRun:
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
                f"{bag.path}: states of {count(pose.shape[1], 'car')}, but a consist of {n}"
            )
        if got.line is None:
            bag.warn("no track: a straight one is assumed")
        _drop_unknown_cars(got, n, int(cars.represents.sum()))
        self._count_missing(got.events, "event")
        self._count_missing(got.collisions, "collision")
        events = tuple(sorted(got.events.values(), key=lambda e: e.time))
        if got.states.every > 1:
            bag.warn(f"long: of the states every {got.states.every}th is shown")
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
            manifest=self.manifest or _manifest_beside(bag.path),
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
            coupled=self._coupled(got, events, time, n),
            brake_force=brake,
            corner_force=corner,
            thinned=got.states.every,
            energy_time=energy_time,
            energy=energy,
        )
        outcome = got.outcome
        if outcome is None or not outcome.final or len(outcome.pose) != n:
            outcome = derive_outcome(run, outcome)
            if not outcome.final:
                bag.warn(
                    "the end of the run is not in it: it stands as at"
                    f" {outcome.time:.2f} s, the last moment recorded"
                )
        outcome = replace(outcome, train_cars=int(cars.represents.sum()))
        return replace(run, outcome=outcome, warnings=tuple(bag.warnings))

    def _coupled(
        self, got: _Collected, events: tuple[Event, ...], time: F64, n: int
    ) -> NDArray[np.bool_]:
        if got.couplings.count:
            when, table = got.couplings.columns()
            if table.ndim == 2 and table.shape[1] == n - 1:
                index = np.clip(np.searchsorted(when, time + 1e-9) - 1, 0, len(when) - 1)
                return np.asarray(table[index], dtype=bool)
        elif n > 1:
            self.bag.warn("no coupler states: couplings are known from the events only")
        return derive_couplings(events, time, n)

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


def _is_manifest(channel: Channel) -> bool:
    return channel.name == MANIFEST.name and channel.msgtype == MANIFEST.msgtype


def _manifest_beside(path: Path) -> dict[str, Any]:
    folder = path if path.is_dir() else path.parent
    try:
        value = json.loads((folder / FILE_NAME).read_text(encoding="utf-8"))
        return value if isinstance(value, dict) else {}
    except (OSError, ValueError):
        return {}


def _scenario(text: str, bag: RawBag) -> dict[str, Any]:
    """The scenario as plain data, {} where it cannot be read."""
    try:
        value = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError:
        bag.warn("its scenario cannot be read")
        return {}
    return value if isinstance(value, dict) else {}


def _drop_unknown_cars(got: _Collected, n: int, real: int) -> None:
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
