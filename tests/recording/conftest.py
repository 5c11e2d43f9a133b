"""Recordings for the tests of reading."""

from tests.recordings import bag, run, sqlite_bag  # noqa: F401
