"""The one error that a bad scenario raises."""

from __future__ import annotations


class ScenarioError(ValueError):
    """A scenario, or a rolling stock file that it needs, was refused.

    The message is one line: ``file:line: field: reason``, without what is not known.

    Parameters
    ----------
    file
        Path of the file, or what stands for it: ``"<inline>"``, ``"--set"``, a scenario's name.
    line
        Line of the mistake, from 1; ``None`` where there is none (an override, a missing file).
    field
        Dotted path of the field, for example ``"train.consist.3.length_m"``; ``""`` for the
        file as a whole.
    reason
        What is wrong with it.
    """

    def __init__(self, file: str, line: int | None, field: str, reason: str) -> None:
        super().__init__(file, line, field, reason)
        self.file = file
        self.line = line
        self.field = field
        self.reason = reason

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        parts = [place, self.field, self.reason]
        return ": ".join(part for part in parts if part)


class Refusal(Exception):
    """A mistake found away from its file: the place within the document and the reason.

    Internal; whoever knows the file turns it into a :class:`ScenarioError`.
    """

    def __init__(self, path: tuple[str | int, ...], reason: str) -> None:
        super().__init__(path, reason)
        self.path = path
        self.reason = reason
