"""State shown by the page of a live run: the run writes it, clients read it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.recording.recorded_run import Cars, SampledLine
from derail_ros.review import web
from derail_ros.vocabulary.events import Collision, Event
from derail_ros.vocabulary.words import capital

F64 = NDArray[np.float64]

BEHIND, AHEAD = 400.0, 4000.0
"""Straight track that is drawn behind and ahead of the train at its start, m."""
MOST_NEWS = 20_000
"""Events and contacts kept of a run; later ones are not shown."""


class Refused(ValueError):
    """A command that is not carried out, with its reason."""


class Board:
    """The present state and the events of a run.

    Parameters
    ----------
    act : takes a command's name and its arguments; returns what to tell, or raises `Refused`
    can : names of the commands that it takes
    choices : names of the scenarios that may be chosen
    """

    def __init__(
        self,
        act: Callable[[str, dict[str, Any]], str],
        can: tuple[str, ...],
        choices: tuple[str, ...] = (),
    ) -> None:
        self.act = act
        self.can = can
        self.choices = choices
        self._changed = threading.Condition()
        self._run = 0
        self._hello: dict[str, Any] | None = None
        self._state: dict[str, Any] | None = None
        self._count = 0
        self._news: list[tuple[str, dict[str, Any]]] = []
        self.closed = False

    # --- what the run writes ------------------------------------------------------------------

    def begin(
        self, title: str, scenario: str, cars: Cars, line: SampledLine, x: F64, **more: Any
    ) -> None:
        """A run begins: its train, its track and where its cars stand along x, m."""
        track = web.track_data(line, float(x.min()) - BEHIND, float(x.max()) + AHEAD)
        with self._changed:
            self._run += 1
            self._state, self._news = None, []
            self._hello = {
                "run": self._run,
                "title": title,
                "scenario": scenario,
                "cars": web.car_data(cars),
                "track": track,
                "can": list(self.can),
                "choices": list(self.choices),
                **more,
            }
            self._changed.notify_all()

    def state(
        self, time: float, pose: F64, velocity: F64, coupler_yaw: F64, on: Any, coupled: Any,
        **more: Any,
    ) -> None:  # fmt: skip
        """The state of N cars: arrays (N, 6), (N, 6), (N, 2), (N, 2) and (N-1,)."""
        if not np.isfinite(pose).all():
            return
        self._set(
            {
                "time": round(time, 4),
                "x": np.round(pose[:, 0], 3).tolist(),
                "y": np.round(pose[:, 1], 3).tolist(),
                "yaw": np.round(pose[:, 5], 4).tolist(),
                "alpha": np.round(coupler_yaw[:, 0], 3).tolist(),
                "beta": np.round(coupler_yaw[:, 1], 3).tolist(),
                "speed": np.round(np.hypot(velocity[:, 0], velocity[:, 1]), 2).tolist(),
                "on": np.asarray(on, dtype=int).ravel().tolist(),
                "coupled": np.asarray(coupled, dtype=int).tolist(),
                **more,
            }
        )

    def _set(self, state: dict[str, Any]) -> None:
        with self._changed:
            self._state = state
            self._count += 1
            self._changed.notify_all()

    def event(self, event: Event) -> None:
        """Something happened."""
        self._tell(
            "event",
            {
                "time": round(event.time, 3),
                "kind": event.kind.word,
                "cars": list(event.cars),
                "text": capital(event.text),
            },
        )

    def contact(self, contact: Collision) -> None:
        """A collision, again when it has grown or ended."""
        self._tell(
            "contact", {"id": contact.id, "text": contact.text, **web.contact_data(contact)}
        )

    def rail_break(self, x: float, y: float, heading: float, time: float) -> None:
        """A rail is broken from a moment on."""
        self._tell("break", {"x": x, "y": y, "heading": heading, "time": time})

    def end(self, text: str, more: str = "") -> None:
        """The run has ended: its outcome, and a further sentence."""
        self._tell("end", {"text": text, "more": more})

    def _tell(self, kind: str, what: dict[str, Any]) -> None:
        with self._changed:
            if len(self._news) < MOST_NEWS or kind == "end":
                self._news.append((kind, what))
            self._changed.notify_all()

    def close(self) -> None:
        """Nothing more will come: clients are let go."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    # --- what a client reads ------------------------------------------------------------------

    def reader(self) -> Reader:
        """What a client has been told so far: nothing."""
        return Reader(self)


class Reader:
    """A client's place in what a board tells; a slow one misses states, never events."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._run = 0
        self._count = 0
        self._told = 0

    def next(self, timeout: float) -> list[tuple[str, dict[str, Any]]] | None:
        """What is new: kind and content; empty after ``timeout`` s, None when the board closed."""
        b = self._board
        with b._changed:
            b._changed.wait_for(lambda: b.closed or self._waits(), timeout)
            new: list[tuple[str, dict[str, Any]]] = []
            if b._hello is not None and b._run != self._run:
                self._run, self._told, self._count = b._run, 0, -1
                new.append(("hello", b._hello))
            if b._state is not None and b._count != self._count:
                self._count = b._count
                new.append(("state", b._state))
            new += b._news[self._told :]
            self._told = len(b._news)
            return new if new or not b.closed else None

    def _waits(self) -> bool:
        b = self._board
        return b._hello is not None and (
            b._run != self._run
            or self._told < len(b._news)
            or (b._state is not None and b._count != self._count)
        )
