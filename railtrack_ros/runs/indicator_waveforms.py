"""Band-limited waveforms of the rails in a table that is written as they come."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from railtrack_ros.estimation.bands import Band, band_name
from railtrack_ros.estimation.waveforms import Waveforms
from railtrack_ros.output import replacing
from railtrack_ros.runs.indicator_tables import load_parquet

ROWS = 50_000  # formatted at a time


def columns(rails: Sequence[str], bands: Sequence[Band]) -> list[str]:
    """Return the names of the columns: the position, then each rail in each band."""
    return ['position_m', *(f'{rail}_{band_name(band)}_um' for rail in rails for band in bands)]


@contextlib.contextmanager
def waveform_table(path: str | Path, rails: Sequence[str], bands: Sequence[Band]
                   ) -> Iterator[Callable[[Waveforms], None]]:
    """Give what takes waveforms stretch by stretch and writes them as CSV, or as .parquet.

    Positions in m, waveforms in um; a field without a valid value is empty.

    Raises
    ------
    InputError
        The file cannot be written, or Parquet without pyarrow.
    """
    names = columns(rails, bands)
    with contextlib.ExitStack() as stack:
        place = stack.enter_context(replacing(path))
        if Path(path).suffix.lower() == '.parquet':
            arrow, parquet = load_parquet(path)
            types = [arrow.float64(), *[arrow.float32()] * (len(names) - 1)]
            schema = arrow.schema(list(zip(names, types, strict=True)))
            writer = stack.enter_context(parquet.ParquetWriter(place, schema))

            def write(found: Waveforms) -> None:
                values = [found.position,
                          *(1e6 * row for rail in rails for row in found.rails[rail])]
                writer.write_table(arrow.table(
                    [arrow.array(column.astype(dtype.to_pandas_dtype()), dtype,
                                 mask=np.isnan(column))
                     for column, dtype in zip(values, types, strict=True)], schema))
        else:
            file = stack.enter_context(open(place, 'w', encoding='utf-8'))
            file.write(','.join(names) + '\n')
            form = ','.join(['%.3f', *['%.4g'] * (len(names) - 1)]) + '\n'

            def write(found: Waveforms) -> None:
                values = np.column_stack(
                    [found.position, *(1e6 * found.rails[rail].T for rail in rails)])
                for first in range(0, len(values), ROWS):
                    rows = values[first : first + ROWS].tolist()
                    file.write(''.join(form % tuple(row) for row in rows).replace('nan', ''))

        yield write
