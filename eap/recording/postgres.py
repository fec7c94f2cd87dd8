"""Values in PostgreSQL: a table a station, filled by COPY; psycopg is an extra of this project.

The schema is named as the plant, a table as its station, a column as its variable or part, beside
``time`` (microseconds), ``time_ns`` and ``cycle``.  Missing tables and columns are made.  Where
TimescaleDB is installed, a new table becomes a hypertable.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from eap.codec.basetypes import Block, Boolean, DataType, Real, Text, WideChar
from eap.codec.enumerations import Enumeration
from eap.codec.times import Timed
from eap.errors import EnvironmentalError
from eap.recording.header import RecordingEvent
from eap.recording.rows import plain_value
from eap.recording.stores import StoreError, StoreRow, StoreTable, lost_texts

try:
    import psycopg
    from psycopg import sql
except ImportError:
    raise EnvironmentalError(
        "PostgreSQL needs psycopg, which is not installed: pip install 'eap-appliance[postgres]'"
        " (in the project's folder: pip install '.[postgres]')"
    ) from None

_CONNECT_S = 3
_MOST_COLUMNS = 1590
"""PostgreSQL has at most 1600."""
_LONGEST_NAME = 63
_EVENTS = "recording_events"
_FINAL = ("22", "23", "28", "3D", "3F", "42")
"""Classes of SQLSTATE that another attempt does not cure: data, rights, names, syntax."""


class PostgresStore:
    """One database.

    Args:
        url: ``postgresql://USER@HOST/DATABASE``; libpq's environment and password file count, too.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._connection: Any = None
        self._plant = ""
        self._tables: Sequence[StoreTable] = ()
        self._prepared = False

    def open(self, plant: str, tables: Sequence[StoreTable]) -> None:
        """Connect, and make schema, tables and columns that are missing."""
        if self._tables is not tables:
            self._prepared = False
        self._plant, self._tables = plant, tables
        for table in tables:
            # Found before the recording begins, not with the first rows.
            if len(table.columns) > _MOST_COLUMNS:
                raise StoreError(
                    f"{table.station} has {len(table.columns)} values, a table at most"
                    f" {_MOST_COLUMNS}: select variables by patterns",
                    is_final=True,
                )
        try:
            if self._connection is None:
                self._connection = psycopg.connect(
                    self._url, connect_timeout=_CONNECT_S, application_name="eap-appliance"
                )
                self._prepared = False
            if not self._prepared:
                self._prepare()
                self._prepared = True
        except psycopg.Error as exc:
            raise _store_error(exc) from None

    def write(self, rows: Sequence[StoreRow], events: Sequence[RecordingEvent]) -> None:
        """Copy all rows in one transaction."""
        by_table: dict[int, list[StoreRow]] = {}
        for row in rows:
            by_table.setdefault(row.table, []).append(row)
        try:
            with self._connection.transaction(), self._connection.cursor() as cursor:
                for number, own in by_table.items():
                    table = self._tables[number]
                    names = ["time", "time_ns", "cycle", *column_names(table)]
                    # COPY takes many times the rows a second that INSERT does.
                    command = sql.SQL("COPY {} ({}) FROM STDIN").format(
                        sql.Identifier(self._plant, table.station),
                        sql.SQL(",").join(map(sql.Identifier, names)),
                    )
                    with cursor.copy(command) as copy:
                        copy.write("".join(_lines(table, own)))
                if events:
                    cursor.executemany(
                        sql.SQL("INSERT INTO {} VALUES (to_timestamp(%s), %s, %s, %s, %s)").format(
                            sql.Identifier(self._plant, _EVENTS)
                        ),
                        [(at_ns / 1e9, *rest) for at_ns, *rest in lost_texts(events)],
                    )
        except psycopg.Error as exc:
            raise _store_error(exc) from None

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _prepare(self) -> None:
        schema = sql.Identifier(self._plant)
        with self._connection.transaction(), self._connection.cursor() as cursor:
            # IF NOT EXISTS sends a notice for each table and column that there is already.
            cursor.execute("SET client_min_messages = warning")
            cursor.execute(sql.SQL("CREATE SCHEMA IF NOT EXISTS {}").format(schema))
            cursor.execute(
                sql.SQL(
                    "CREATE TABLE IF NOT EXISTS {} (time timestamptz NOT NULL, kind text NOT NULL,"
                    " station text NOT NULL, text text NOT NULL, count bigint NOT NULL)"
                ).format(sql.Identifier(self._plant, _EVENTS))
            )
            cursor.execute("SELECT 1 FROM pg_extension WHERE extname = 'timescaledb'")
            has_timescale = cursor.fetchone() is not None
            for table in self._tables:
                name = sql.Identifier(self._plant, table.station)
                cursor.execute(
                    sql.SQL(
                        "CREATE TABLE IF NOT EXISTS {} (time timestamptz NOT NULL,"
                        " time_ns bigint NOT NULL, cycle bigint NOT NULL)"
                    ).format(name)
                )
                columns = zip(column_names(table), table.columns, strict=True)
                added = [
                    sql.SQL("ADD COLUMN IF NOT EXISTS {} {}").format(
                        sql.Identifier(column), sql.SQL(_column_type(value.kind))
                    )
                    for column, value in columns
                ]
                cursor.execute(sql.SQL("ALTER TABLE {} {}").format(name, sql.SQL(", ").join(added)))
                # Without the extension they are ordinary tables, with the same columns.
                if has_timescale:
                    cursor.execute(
                        "SELECT create_hypertable(%s::regclass, 'time', if_not_exists => TRUE,"
                        " migrate_data => TRUE)",
                        [f'"{self._plant}"."{table.station}"'],
                    )


def column_names(table: StoreTable) -> list[str]:
    """Return the names of the columns of a table: those of the values without the station."""
    found: list[str] = []
    used = {"time", "time_ns", "cycle"}
    for column in table.columns:
        base = column.name.partition("/")[2]
        # PostgreSQL cuts longer names itself, and two may become one.
        name, number = base.encode()[:_LONGEST_NAME].decode("utf-8", "ignore"), 1
        while name in used:
            number += 1
            end = f"_{number}"
            name = base.encode()[: _LONGEST_NAME - len(end)].decode("utf-8", "ignore") + end
        used.add(name)
        found.append(name)
    return found


def _column_type(kind: DataType) -> str:
    if isinstance(kind, Boolean):
        return "boolean"
    if isinstance(kind, Real):
        return "real" if kind.size == 4 else "double precision"
    if isinstance(kind, Block):
        return "bytea"
    if isinstance(kind, Text | WideChar | Enumeration | Timed):
        return "text"
    limits = kind.scalar_range
    # PostgreSQL has no numbers without a sign.
    return "bigint" if limits is not None and limits[1] < 1 << 63 else "numeric(20)"


def _lines(table: StoreTable, rows: Iterable[StoreRow]) -> Iterable[str]:
    kinds = [column.kind for column in table.columns]
    is_text = [isinstance(kind, Enumeration | Timed) for kind in kinds]
    for row in rows:
        seconds, ns = divmod(row.time_ns, 1_000_000_000)
        cells = [
            _cell(plain_value(kind, value) if named else value)
            for kind, value, named in zip(kinds, row.values, is_text, strict=True)
        ]
        begin = f"{_timestamp(seconds)}.{ns // 1000:06}+00\t{row.time_ns}\t{row.cycle}"
        yield "\t".join((begin, *cells)) + "\n"


def _timestamp(seconds: int) -> str:
    from time import gmtime, strftime

    return strftime("%Y-%m-%d %H:%M:%S", gmtime(seconds))


_ESCAPES = str.maketrans({"\\": "\\\\", "\t": "\\t", "\n": "\\n", "\r": "\\r"})


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "t" if value else "f"
    if isinstance(value, str):
        return value.translate(_ESCAPES)
    return f"\\\\x{value.hex()}" if isinstance(value, bytes) else repr(value)


def _store_error(error: psycopg.Error) -> StoreError:
    text = " ".join(str(error).split()) or type(error).__name__
    state = error.sqlstate or ""
    return StoreError(text, is_final=state.startswith(_FINAL))
