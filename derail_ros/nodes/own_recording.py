"""The recording that the simulator itself writes (parameter ``record``), and its manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from derail_ros.nodes.parameters import Settings
from derail_ros.recording.manifest import Manifest
from derail_ros.recording.recorder import RecordingError, RunRecorder, absolute, recorded_topics
from derail_ros.recording.session import Session
from msg_adapters.topics import ON_MAP, topic_named


class OwnRecording:
    """A recording without loss. If it fails, the run continues; ``error`` gives the reason.

    Raises
    ------
    RecordingError
        If the recording cannot be begun.
    """

    def __init__(self, settings: Settings, log: Any) -> None:
        self.error = ""
        self._settings = settings
        self._log = log
        self._count = 0
        self._manifest = Manifest()
        self._recorder: RunRecorder | None = None
        if settings.record:
            self._open()

    @property
    def path(self) -> str:
        """Folder that is being written, "" for none: nothing is recorded."""
        return "" if self._recorder is None else str(self._recorder.path)

    def _open(self) -> None:
        settings = self._settings
        path = Path(settings.record)
        if self._count:
            path = path.with_name(f"{path.name}_{self._count}")
        self._manifest = Manifest(
            settings={
                "state_rate": settings.state_rate,
                "marker_rate": settings.marker_rate,
                "frame_id": settings.frame_id,
                "storage": settings.record_storage,
            }
        )
        topics = recorded_topics(settings.namespace)
        self._recorder = RunRecorder(path, settings.record_storage, topics)
        self._count += 1

    def _fail(self, error: RecordingError) -> None:
        self._recorder = None
        self.error = f"recording failed: {error}"
        self._log.error(self.error)

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """Record a message."""
        if self._recorder is None:
            return
        name, known = absolute(topic, self._settings.namespace), topic_named(topic)
        try:
            if name not in self._recorder.topics:
                if known is None or known == ON_MAP:  # no player knows its type
                    return
                self._recorder.add(name, known)
            self._recorder.write(name, stamp, data)
        except RecordingError as error:
            self._fail(error)

    def begin_run(self, session: Session) -> None:
        """Enter a run that begins, and write the manifest."""
        self.enter(session)
        if self._recorder is not None:
            self._recorder.write_manifest(self._manifest, session.context.base)

    def enter(self, session: Session) -> None:
        """Bring the entry of a run in the manifest up to date."""
        if self._recorder is None:
            return
        entry, runs = session.entry(), self._manifest.runs
        if runs and runs[-1].run_id == entry.run_id:
            runs[-1] = entry
        else:
            runs.append(entry)

    def restart(self, session: Session) -> None:
        """Simulation time restarts: close this recording and begin another."""
        if self._recorder is None:
            return
        self.close(session)
        try:
            self._open()
        except RecordingError as error:
            self._fail(error)

    def close(self, session: Session | None) -> None:
        """Close the recording whole, or say why it is not."""
        if self._recorder is None:
            return
        if session is not None:
            self.enter(session)
        try:
            self._recorder.close(self._manifest)
            self._log.info(f"recording closed: {self._recorder.path}")
            self._recorder = None
        except RecordingError as error:
            self._fail(error)
