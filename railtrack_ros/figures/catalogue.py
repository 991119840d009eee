"""All figures that are computed again, in the thesis' order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from railtrack_ros.errors import InputError
from railtrack_ros.figures import chapter1, chapter2, chapter3, chapter4
from railtrack_ros.figures.content import Entry, Figure
from railtrack_ros.figures.draw import write_figure

CATALOGUE = (
    Entry('1.3', 'Receptance of the track and its three resonances', chapter1.figure_1_3),
    Entry('2.2', 'Static deflection with and without local system', chapter2.figure_2_2),
    Entry('2.3', 'Modes of a Timoshenko beam clamped at both ends', chapter2.figure_2_3),
    Entry('2.4', 'Static and dynamic flexibility of the local system', chapter2.figure_2_4),
    Entry('2.5a', 'Contact force: static local system and none', chapter2.figure_2_5a),
    Entry('2.5b', 'Contact force: dynamic and static local system', chapter2.figure_2_5b),
    Entry('2.6', 'Convergence of the dynamic local system', chapter2.figure_2_6),
    Entry('3.2', 'Shape functions: TEEF against TIM4', chapter3.figure_3_2),
    Entry('3.3', 'Shape function of the sleeper', chapter3.figure_3_3),
    Entry('3.4a', 'Receptance at mid-span, three supports', chapter3.figure_3_4a),
    Entry('3.4b', 'Receptance above a sleeper, three supports', chapter3.figure_3_4b),
    Entry('3.5a', 'Rail displacement under a wheel on a smooth rail', chapter3.figure_3_5a),
    Entry('3.5b', 'Contact force on a smooth rail', chapter3.figure_3_5b),
    Entry('3.6', 'Contact force on a corrugated rail, distributed supports', chapter3.figure_3_6),
    Entry('3.7', 'Contact force on a corrugated rail, concentrated supports',
          chapter3.figure_3_7),
    Entry('4.1a', 'Impulse responses above a sleeper', chapter4.figure_4_1a),
    Entry('4.1b', 'Impulse responses at mid-span', chapter4.figure_4_1b),
    Entry('4.3', 'Contact force by convolution and by direct integration', chapter4.figure_4_3),
)


def chosen(numbers: Sequence[str]) -> list[Entry]:
    """Return the entries of some figures, all of them if none is named.

    A number without letter stands for its parts too (3.4 for 3.4a and 3.4b).  Raises InputError.
    """
    if not numbers:
        return list(CATALOGUE)
    for number in numbers:
        if not any(_is(entry, number) for entry in CATALOGUE):
            raise InputError(f'figure {number!r}: expected one of '
                             + ', '.join(entry.number for entry in CATALOGUE))
    return [entry for entry in CATALOGUE if any(_is(entry, number) for number in numbers)]


def _is(entry: Entry, number: str) -> bool:
    return entry.number == number or entry.number.rstrip('ab') == number


def produce(folder: str | Path, entries: Sequence[Entry],
            progress: Callable[[int], object] | None = None,
            ) -> Iterator[tuple[Entry, Figure, list[Path]]]:
    """Compute and write figures one after the other; yields each with the files written.

    A file is there whole or not at all, and what is finished stays when the rest is interrupted.
    progress: called with 1 after each figure.  Raises InputError where the folder cannot be
    written.
    """
    folder = Path(folder).expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = (error.strerror or '').lower()
        raise InputError(f'{folder}: cannot be written: {reason}') from error
    for entry in entries:
        figure = entry.compute()
        yield entry, figure, write_figure(folder, entry.stem, figure)
        if progress is not None:
            progress(1)
