"""Recordings of runs: rosbag2 (MCAP or SQLite), written with and without a ROS graph."""

from derail_ros.recording.manifest import Manifest, RunEntry, read_manifest
from derail_ros.recording.recorder import RecordingError, RunRecorder
from derail_ros.recording.run import record_run

__all__ = [
    "Manifest",
    "RecordingError",
    "RunEntry",
    "RunRecorder",
    "read_manifest",
    "record_run",
]
