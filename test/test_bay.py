"""The mesh of one bay: every support, every local system."""

import dataclasses

import numpy as np
import pytest

from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import load_track

TRACK = load_track('blanco_table_3_1')
KINDS = ['concentrated', 'concentrated_rotational', 'multipoint', 'distributed']


def with_kind(kind, **changes):
    return dataclasses.replace(
        TRACK, support=dataclasses.replace(TRACK.support, kind=kind, **changes))


@pytest.mark.parametrize('local_system', ['none', 'static', 'dynamic'])
@pytest.mark.parametrize('kind', KINDS)
class TestEverySupport:
    def test_translation_strains_only_the_ballast(self, kind, local_system):
        bay = make_bay(with_kind(kind), Mesh(local_system=local_system))
        u = np.zeros(bay.dofs + 2)
        u[bay.node_dofs] = u[bay.sleeper_dof] = 1.0
        force = bay.stiffness @ u
        ballast = force[bay.sleeper_dof]
        force[bay.sleeper_dof] = 0.0
        assert ballast == pytest.approx(TRACK.support.ballast_stiffness, rel=1e-9)
        assert np.abs(force).max() < 1e-11 * np.abs(bay.stiffness).max()
        np.testing.assert_allclose(bay.shape(np.linspace(0.0, 0.6, 50)) @ u, 1.0, atol=1e-12)

    def test_translation_carries_the_mass_of_rail_and_sleeper(self, kind, local_system):
        bay = make_bay(with_kind(kind), Mesh(local_system=local_system))
        u = np.zeros(bay.dofs + 2)
        u[bay.node_dofs] = u[bay.sleeper_dof] = 1.0
        expected = TRACK.rail.mass_per_length * 0.6 + TRACK.support.sleeper_mass
        assert u @ bay.mass @ u == pytest.approx(expected, rel=1e-9)

    def test_matrices_are_symmetric_and_dissipate(self, kind, local_system):
        bay = make_bay(with_kind(kind), Mesh(local_system=local_system))
        for matrix in (bay.stiffness, bay.damping, bay.mass, bay.rail_stiffness):
            assert np.abs(matrix - matrix.T).max() <= 1e-9 * np.abs(matrix).max()
        scale = np.sqrt(np.diag(bay.mass))
        damping = np.linalg.eigvalsh(bay.damping / np.outer(scale, scale))
        assert damping.min() > -1e-9 * damping.max()
        assert np.linalg.eigvalsh(bay.mass / np.outer(scale, scale)).min() > 0.0

    def test_deflection_is_continuous_over_the_bay_and_into_the_next(self, kind, local_system):
        bay = make_bay(with_kind(kind), Mesh(local_system=local_system))
        u = np.random.default_rng(3).standard_normal(bay.dofs + 2)
        u[bay.modal_dofs] *= 1e-3
        x = bay.table.breaks[1:-1]
        jump = (bay.shape(x - 1e-10) - bay.shape(x + 1e-10)) @ u
        assert np.abs(jump).max() < 1e-7
        right = bay.shape(bay.spacing)[0]
        np.testing.assert_allclose(right[bay.dofs], 1.0, atol=1e-12)


@pytest.mark.parametrize('kind', KINDS)
def test_mirror_symmetric_mesh_about_the_sleeper(kind):
    bay = make_bay(with_kind(kind), Mesh(8))
    np.testing.assert_allclose(bay.nodes + bay.start, -(bay.nodes + bay.start)[::-1], atol=1e-12)


@pytest.mark.parametrize('kind', ['concentrated', 'distributed'])
@pytest.mark.parametrize('count', [3, 5, 6, 7, 9])
def test_every_number_of_elements_fills_one_bay_with_the_sleeper_under_a_node(kind, count):
    mesh = Mesh(count)
    bay = make_bay(with_kind(kind), mesh)
    assert len(bay.nodes) == count + 1
    assert bay.nodes[-1] == pytest.approx(0.6)
    assert np.abs(bay.nodes + bay.start).min() < 1e-12


def test_springs_at_nodes_carry_the_whole_pad():
    for kind in ('multipoint', 'concentrated'):
        bay = make_bay(with_kind(kind))
        u = np.zeros(bay.dofs + 2)
        u[bay.node_dofs] = 1.0
        pad = -(bay.stiffness @ u)[bay.sleeper_dof]
        assert pad == pytest.approx(TRACK.support.pad_stiffness, rel=1e-9)


def test_static_flexibility_is_missing_without_a_local_system_and_shrinks_with_modes():
    none, static, dynamic = (make_bay(with_kind('concentrated'), Mesh(4, local_system=s))
                             for s in ('none', 'static', 'dynamic'))
    x = np.linspace(0.01, 0.59, 40)
    assert np.all(none.flexibility(x) == 0.0)
    assert static.flexibility(0.075)[0] == pytest.approx(1.5368e-10, rel=1e-3)
    assert np.all(dynamic.flexibility(x) < static.flexibility(x))
    assert dynamic.flexibility(0.075)[0] < 0.1 * static.flexibility(0.075)[0]


def test_locate_puts_the_sleeper_centres_at_multiples_of_the_spacing():
    bay = make_bay(with_kind('distributed'))
    number, inside = bay.locate([0.0, 0.6, -1.2, 0.29, 0.31])
    assert number.tolist() == [0, 1, -2, 0, 1]
    np.testing.assert_allclose(inside[:3], -bay.start, atol=1e-9)


@pytest.mark.parametrize(('mesh', 'word'), [
    (Mesh(2, 2), 'elements per bay'), (Mesh(8, local_system='modal'), 'local system'),
])
def test_impossible_mesh_is_refused(mesh, word):
    with pytest.raises(InputError, match=word):
        make_bay(with_kind('distributed'), mesh)


def test_pad_elements_of_a_point_support_are_refused():
    with pytest.raises(InputError, match='elements per pad'):
        make_bay(with_kind('concentrated'), Mesh(8, 2))
