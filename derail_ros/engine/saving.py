"""A planar run as bytes, its arrays with and without their spare rows, and its hash."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import State
from derail_ros.engine.serial import pack, unpack
from derail_ros.vocabulary.errors import DerailError, StateFormatError
from derail_ros.vocabulary.events import Command, Event
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.plain import from_plain, to_plain

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation

_ROWS = {"pairs": L.N_PAIRS, "mask": L.N_PAIRS, "pair": L.N_PAIRS, "contact": L.N_CONTACTS}
"""Arrays with spare rows, and the counter of those in use."""


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
    return state._replace(contact=_longer(old, 2 * len(old) + len(state.pairs)))


def _longer(array: NDArray[Any], rows: int, fill: float = 0.0) -> NDArray[Any]:
    new = np.full((rows, *array.shape[1:]), fill, dtype=array.dtype)
    new[: len(array)] = array
    return new


def grown_breaks(state: State) -> State:
    """The state with twice the room for rail breaks."""
    return state._replace(breaks=_longer(state.breaks, 2 * len(state.breaks) + 2, np.inf))


def _arrays(state: State) -> dict[str, NDArray[Any]]:
    """The state's arrays without their spare rows."""
    return {
        name: array[: int(state.cnt[_ROWS[name]])] if name in _ROWS else array
        for name, array in state._asdict().items()
    }


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
    if set(fields) != set(saved):
        raise StateFormatError("the arrays of the saved state do not match this version")
    pair_rows = max(len(fresh.pairs), 2 * int(saved["cnt"][L.N_PAIRS]) + 64)
    contact_rows = max(len(fresh.contact), 2 * int(saved["cnt"][L.N_CONTACTS]) + 64)
    for name, array in saved.items():
        own = fields[name]
        if array.dtype != own.dtype or array.shape[1:] != own.shape[1:]:
            raise StateFormatError(f"array {name} does not match this version")
        if name in _ROWS:
            array = _longer(array, contact_rows if name == "contact" else pair_rows)
        elif name != "breaks" and array.shape != own.shape:
            raise StateFormatError(f"array {name} does not fit this train or this version")
        fields[name] = array
    return State(**fields)


def state_hash(state: State) -> str:
    """SHA-256 (hex) of all that decides the future of the run."""
    digest = hashlib.sha256()
    for name, array in _arrays(state).items():
        data = array
        if name == "cnt":  # evaluations count work done, not where the run is
            data = array.copy()
            data[L.EVALS] = 0
        elif name == "breaks":
            data = array[np.isfinite(array)]
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(data).tobytes())
    return digest.hexdigest()
