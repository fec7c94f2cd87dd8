"""Parquet files of recordings, by pyarrow, which is an extra of this project."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from eap.codec.basetypes import Block, Boolean, DataType, Integer, Real, Text, WideChar
from eap.codec.enumerations import Enumeration
from eap.codec.times import Timed
from eap.errors import EnvironmentalError
from eap.recording.export import TIME, ExportCount, Selection, column_names, merged_rows
from eap.recording.rows import TimeWindow, plain_value

try:
    import pyarrow as pa
    from pyarrow import parquet
except ImportError:
    raise EnvironmentalError(
        "Parquet needs pyarrow, which is not installed: pip install 'eap-appliance[export]' (in the"
        " project's folder: pip install '.[export]')"
    ) from None

if TYPE_CHECKING:
    from eap.recording.recording_file import Recording

_BATCH = 20_000
"""Rows of a row group."""


def write_parquet(
    recording: Recording, window: TimeWindow, selection: Selection, path: Path
) -> ExportCount:
    """Write a row for each time; cells without a value then are null.

    Columns have the types of their variables; enumerations are names, times and dates texts.

    Raises:
        FileExistsError: *path* is there.
    """
    names = column_names(selection)
    columns = {each.name: each for chosen in selection.values() for each in chosen.values()}
    fields = [pa.field(TIME, pa.int64())]
    fields += [
        pa.field(name, _arrow_type(columns[name].kind), metadata={"unit": columns[name].unit})
        for name in names
    ]
    facts = {f"eap.{name}": text for name, text in recording.facts.items()}
    schema = pa.schema(fields, metadata=facts)
    plans = {
        source: [
            (position, column.name, column.kind, isinstance(column.kind, Enumeration | Timed))
            for position, column in chosen.items()
        ]
        for source, chosen in selection.items()
    }
    # Never over a file that is there: it may be the only copy of an earlier export.
    with path.open("xb") as file, parquet.ParquetWriter(file, schema, compression="zstd") as writer:
        batch = _Batch(writer, schema, names)
        for at_ns, rows in merged_rows(recording.rows(window, plans.keys())):
            for row in rows:
                for position, name, kind, is_text in plans[row.source]:
                    value = row.values[position]
                    batch.row[name] = plain_value(kind, value) if is_text else value
            batch.end_row(at_ns)
        batch.write()
    return ExportCount(batch.count, len(names))


class _Batch:
    """Rows of one row group; *row* has the values of the next one."""

    def __init__(self, writer: Any, schema: Any, names: list[str]) -> None:
        self._writer = writer
        self._schema = schema
        self._times: list[int] = []
        self._cells: dict[str, list[Any]] = {name: [] for name in names}
        self.row: dict[str, Any] = {}
        self.count = 0

    def end_row(self, at_ns: int) -> None:
        self._times.append(at_ns)
        self.count += 1
        # By name: a variable in several PDs has one cell.
        for name, cells in self._cells.items():
            cells.append(self.row.get(name))
        self.row.clear()
        if len(self._times) >= _BATCH:
            self.write()

    def write(self) -> None:
        arrays = [pa.array(self._times, pa.int64())]
        arrays += [
            pa.array(cells, self._schema.field(name).type) for name, cells in self._cells.items()
        ]
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))
        self._times.clear()
        for cells in self._cells.values():
            cells.clear()


def _arrow_type(kind: DataType) -> Any:
    if isinstance(kind, Boolean):
        return pa.bool_()
    if isinstance(kind, Real):
        return pa.float32() if kind.size == 4 else pa.float64()
    if isinstance(kind, Block):
        return pa.binary(kind.size)
    # Names, not numbers: the file goes to people who do not have the description of the type.
    if isinstance(kind, Text | WideChar | Enumeration | Timed):
        return pa.string()
    is_signed = isinstance(kind, Integer) and kind.signed
    # Arrow has no integers of 3, 5, 6 or 7 bytes.
    size = next(each for each in (1, 2, 4, 8) if each >= kind.size)
    return getattr(pa, f"{'int' if is_signed else 'uint'}{8 * size}")()
