"""Error of finite-element meshes against the exact track: table 3.1, no reflections.

Largest relative error of the complex point receptance at mid-span and above the sleeper, at the
frequencies of the reference table.
"""

import numpy as np
import pytest
from frequency_domain import variant

from railtrack_ros.dynamics.receptance import finite_track, local_modes_around, receptance
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Mesh, make_bay

FREQUENCIES = np.array([
    0.05, 20.0, 50.0, 90.0, 150.0, 230.0, 300.0, 400.0, 514.0, 600.0, 700.0, 800.0, 900.0, 1000.0,
    1068.0, 1080.0, 1150.0, 1400.0, 1800.0, 2200.0, 2500.0])
LOW = FREQUENCIES <= 900.0


def error(track, kind, mesh):
    """Relative error (frequencies,), the larger one of both places."""
    track = variant(track, kind=kind)
    bay = make_bay(track, mesh)
    errors = []
    for x in (0.5 * track.support.spacing, 0.0):
        truth = receptance(track, FREQUENCIES, x)
        errors.append(np.abs(receptance(bay, FREQUENCIES, x) / truth - 1.0))
    return np.max(errors, axis=0)


@pytest.mark.parametrize(('kind', 'elements', 'per_pad', 'limit'), [
    ('concentrated', 4, None, 0.001),
    ('concentrated', 2, None, 0.005),
    ('concentrated_rotational', 4, None, 0.001),
    ('distributed', 4, 1, 0.01),
    ('distributed', 6, 2, 0.001),
    ('multipoint', 8, 4, 0.001),
])
def test_dynamic_local_system_is_accurate_to_2500_hz(kind, elements, per_pad, limit, table_3_1):
    assert error(table_3_1, kind, Mesh(elements, per_pad, 'dynamic')).max() <= limit


def test_two_teefs_a_pad_with_static_local_system(table_3_1):
    e = error(table_3_1, 'distributed', Mesh(8, 2, 'static'))
    assert e[LOW].max() <= 0.01
    assert e[-1] <= 0.03


def test_one_static_teef_a_pad_fails_above_the_sleeper(table_3_1):
    # What two elements a pad, or the dynamic local system, are for.
    assert error(table_3_1, 'distributed', Mesh(5, 1, 'static'))[-1] > 0.3


def test_error_falls_with_the_mesh(table_3_1):
    errors = [error(table_3_1, 'distributed', Mesh(n, 2, 'static'))[LOW].max() for n in (6, 8, 12)]
    assert errors[0] > 1.5 * errors[1]
    assert errors[1] > 1.5 * errors[2]


def test_static_local_system_corrects_between_nodes(table_3_1):
    # Half-way between nodes: without it the rail inside an element is too stiff.
    track = variant(table_3_1, kind='concentrated')
    x = 0.05
    truth = receptance(track, [20.0], x)

    def deviation(local_system):
        bay = make_bay(track, Mesh(6, None, local_system))
        return abs(receptance(bay, [20.0], x) / truth - 1.0)[0]

    assert deviation('static') < 1e-4
    assert deviation('none') > 20.0 * deviation('static')


def test_five_local_elements_around_the_load_leave_what_modes_everywhere_do_not(table_3_1):
    """The thesis' choice: some per cent at 2500 Hz, a third near the pinned-pinned frequency."""
    track = variant(table_3_1, kind='concentrated')
    x, frequencies = 0.225, [514.0, 1080.0, 2500.0]
    truth = receptance(track, frequencies, x)
    everywhere = finite_track(track, Mesh(4, None, 'dynamic'), 201)
    five = local_modes_around(everywhere, x, 5)
    left_everywhere, left_five = (
        np.abs(receptance(model, frequencies, x) / truth - 1.0) for model in (everywhere, five))
    assert left_everywhere.max() < 1e-3
    np.testing.assert_allclose(left_five, [0.0018, 0.345, 0.049], rtol=0.03)


def test_local_elements_need_modes_and_a_middle(table_3_1):
    with pytest.raises(InputError, match='only the dynamic local system'):
        local_modes_around(finite_track(table_3_1, Mesh(8), 5), 0.0, 5)
    with pytest.raises(InputError, match='odd number'):
        local_modes_around(finite_track(table_3_1, Mesh(4, 1, 'dynamic'), 5), 0.0, 4)
