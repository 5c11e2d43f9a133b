"""A planar run as bytes, its arrays with and without their spare rows, and its hash."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout
from derail_ros.engine.arrays import State
from derail_ros.engine.serial import pack, unpack
from derail_ros.vocabulary.errors import DerailError, StateFormatError
from derail_ros.vocabulary.events import Command, Event
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.plain import from_plain, to_plain

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation

_ROWS = {"pairs": "pairs", "mask": "pairs", "pair": "pairs", "contact": "contacts"}
"""Arrays with spare rows, and the counter of those in use."""

LATER_ARRAYS = (
    *("coupling", "over_since", "loose"),
    *("struck", "hold", "dent", "group", "inside"),
)
"""Arrays that came later than the format of saved states."""


def grown_pairs(state: State) -> State:
    """The state with twice the room for pairs, and room for their contacts."""
    grown: dict[str, NDArray[Any]] = {}
    for name in ("pairs", "mask", "pair"):
        old = getattr(state, name)
        grown[name] = _longer(old, 2 * len(old))
    return grown_contacts(state._replace(**grown))


def grown_contacts(state: State) -> State:
    """The state with more than twice the room for contacts."""
    old = state.contact
    more = len(old) + len(state.pairs) + len(state.struck)
    return state._replace(contact=_longer(old, len(old) + more))


def _longer(array: NDArray[Any], rows: int, fill: float = 0.0) -> NDArray[Any]:
    new = np.full((rows, *array.shape[1:]), fill, dtype=array.dtype)
    new[: len(array)] = array
    return new


def grown_breaks(state: State) -> State:
    """The state with twice the room for rail breaks."""
    return state._replace(breaks=_longer(state.breaks, 2 * len(state.breaks) + 2, np.inf))


def _arrays(state: State) -> dict[str, NDArray[Any]]:
    """The state's arrays without their spare rows, tables as plain arrays."""
    arrays = {}
    for name, array in state._asdict().items():
        if name in _ROWS:
            array = array[: int(state.cnt[_ROWS[name]][0])]
        if array.dtype.names:
            array = array.view(array.dtype[0]).reshape(len(array), len(array.dtype.names))
        arrays[name] = array[0] if name in ("clock", "cnt") else array
    return arrays


def to_bytes(run: PlanarSimulation) -> bytes:
    """The whole run: parameters, state, events and commands."""
    header = {
        "params": to_plain(run.params),
        "events": to_plain(run._events),
        "commands": to_plain(run._commands),
        "scheduled": to_plain(run._scheduled),
    }
    return pack(header, _arrays(run._state))


def from_bytes(kind: type[PlanarSimulation], data: bytes) -> PlanarSimulation:
    """The run of `to_bytes`."""
    header, arrays = unpack(data)
    try:
        run = kind(from_plain(TrainParams, header["params"]))
        run._state = _restored(run._state, arrays)
        run._events = [from_plain(Event, e) for e in header["events"]]
        run._commands = [from_plain(Command, c) for c in header["commands"]]
        run._scheduled = [from_plain(Event, e) for e in header["scheduled"]]
    except StateFormatError:
        raise
    except (KeyError, TypeError, ValueError, DerailError) as error:
        raise StateFormatError(f"the saved state is damaged ({error})") from error
    run._make_work()
    return run


def _restored(fresh: State, saved: dict[str, NDArray[Any]]) -> State:
    """Saved arrays in place of a fresh run's, with spare rows again."""
    fields = fresh._asdict()
    saved = _of_today(fields, saved)
    if set(fields) != set(saved):
        raise StateFormatError("the arrays of the saved state do not match this version")
    arrays = {name: _as_rows(name, array, fields[name]) for name, array in saved.items()}
    counts = arrays["cnt"][0]
    pair_rows = max(len(fresh.pairs), 2 * int(counts["pairs"]) + 64)
    contact_rows = max(len(fresh.contact), 2 * int(counts["contacts"]) + 64)
    for name, array in arrays.items():
        if name in _ROWS:
            array = _longer(array, contact_rows if name == "contact" else pair_rows)
        elif name != "breaks" and array.shape != fields[name].shape:
            raise StateFormatError(f"array {name} does not fit this train or this version")
        fields[name] = array
    return State(**fields)


def _of_today(
    fresh: dict[str, NDArray[Any]], saved: dict[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """Arrays of a state from before there were forces along the track, or sites: none of them."""
    arrays = dict(saved)
    of = len(saved["power"]) if "power" in saved else layout.N_POWER
    none = np.zeros(max(layout.N_POWER - of, 0))
    for name in ("energy", "energy0", "power", "power0", "power1"):
        if name in saved and len(none):
            arrays[name] = np.concatenate([saved[name][:of], none, saved[name][of:]])
    for name in LATER_ARRAYS if len(none) else ():  # a state of today has them all
        if name not in saved:
            array = fresh[name]
            kind = array.dtype
            if kind.names:
                array = array.view(kind[0]).reshape(len(array), len(kind.names))
            arrays[name] = array
    return arrays


def _as_rows(name: str, array: NDArray[Any], own: NDArray[Any]) -> NDArray[Any]:
    """A saved array in the form of the run's ``own``."""
    columns = own.dtype.names
    kind = own.dtype[0] if columns else own.dtype
    shape = (len(columns),) if columns else own.shape[1:]
    if array.dtype != kind or array.shape[array.ndim - len(shape) :] != shape:
        raise StateFormatError(f"array {name} does not match this version")
    return array.reshape(-1).view(own.dtype) if columns else array


def state_hash(state: State) -> str:
    """SHA-256 (hex) of all that decides the future of the run."""
    digest = hashlib.sha256()
    for name, array in _arrays(state).items():
        data = array
        if name == "cnt":  # evaluations count work done, not where the run is
            data = array.copy()
            data.view(layout.COUNT)["evaluations"] = 0
        elif name == "breaks":
            data = array[np.isfinite(array)]
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(data).tobytes())
    return digest.hexdigest()
