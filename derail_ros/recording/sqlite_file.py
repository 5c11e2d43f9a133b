"""Messages of one SQLite recording (``.db3``), of a killed writer as well."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from derail_ros.recording.channels import Channel, Message, Span, Wanted, parse_profiles

MAGIC = b"SQLite format 3\0"


def companions(file: Path) -> list[Path]:
    """Journals beside a database: a writer that was killed left them."""
    beside = (file.with_name(file.name + suffix) for suffix in ("-journal", "-wal"))
    return [path for path in beside if path.exists() and path.stat().st_size > 0]


@contextmanager
def _database(file: Path) -> Iterator[sqlite3.Connection]:
    """A connection that never writes to the recording.

    With a journal beside it SQLite must roll back before it can read: this is done on a copy.
    """
    journals = companions(file)
    with tempfile.TemporaryDirectory(prefix="derail_") as folder:
        place = file
        if journals:
            place = Path(folder) / file.name
            for source in (file, *journals):
                shutil.copyfile(source, place.with_name(source.name))
        address = f"{place.resolve().as_uri()}?mode={'rw' if journals else 'ro'}"
        # A generator of messages may be gone through by another thread than began it.
        made = sqlite3.connect(address, uri=True, check_same_thread=False)
        with closing(made) as connection:
            connection.text_factory = lambda b: b.decode("utf-8", "replace")
            yield connection


def channels(file: Path) -> list[Channel]:
    """The topics.

    Raises
    ------
    sqlite3.Error
        If they cannot be read.
    """
    with _database(file) as database:
        return list(_channels(database).values())


def span(file: Path) -> Span | None:
    """First and last time (ns), ``None`` if there are no messages."""
    with _database(file) as database:
        first, last = database.execute(
            "SELECT min(timestamp), max(timestamp) FROM messages"
        ).fetchone()
    return None if first is None else (first, last)


def messages(
    file: Path,
    wanted: Wanted,
    start: int | None = None,
    stop: int | None = None,
    *,
    by_time: bool = True,
) -> Iterator[Message]:
    """Messages from ``start`` to before ``stop`` (ns), by time or as they were written.

    Raises
    ------
    sqlite3.Error
        Where the database is damaged.
    """
    with _database(file) as database:
        chosen = {key: c for key, c in _channels(database).items() if wanted(c)}
        limits = [-(2**63) if start is None else start, 2**63 - 1 if stop is None else stop]
        query = (
            "SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? AND timestamp < ?"
            f" ORDER BY {'timestamp, id' if by_time else 'id'}"
        )
        with closing(database.execute(query, limits)) as rows:
            for key, stamp, data in rows:
                if key in chosen:
                    yield chosen[key], stamp, data


def _channels(database: sqlite3.Connection) -> dict[int, Channel]:
    columns = {row[1] for row in database.execute("PRAGMA table_info(topics)")}
    qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    digest = "type_description_hash" if "type_description_hash" in columns else "''"
    definitions: dict[str, str] = {}
    with suppress(sqlite3.Error):  # before Iron there is no such table
        definitions = dict(
            database.execute(
                "SELECT topic_type, encoded_message_definition FROM message_definitions"
            ).fetchall()
        )
    return {
        key: Channel(topic, kind, definitions.get(kind, ""), parse_profiles(profile), hashed or "")
        for key, topic, kind, profile, hashed in database.execute(
            f"SELECT id, name, type, {qos}, {digest} FROM topics"
        )
    }
