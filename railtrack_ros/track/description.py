"""What a track is made of: one rail on periodic discrete supports.

All values are SI units and belong to one rail; the two rails of a track are not coupled.
Sleeper centres lie at x = k * spacing for every integer k.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from railtrack_ros import parameters, paths
from railtrack_ros.parameters import NOT_NEGATIVE, POSITIVE, Range

SUPPORT_KINDS = ('concentrated', 'concentrated_rotational', 'multipoint', 'distributed')


@dataclass(frozen=True)
class Rail:
    """A uniform rail as a Timoshenko beam in vertical bending."""

    youngs_modulus: float  # E, Pa
    poisson_ratio: float  # nu, G = E / (2 (1 + nu))
    area: float  # A, m2
    second_moment: float  # I about the horizontal axis, m4
    density: float  # rho, kg/m3
    shear_coefficient: float  # kappa, effective share of the area in shear
    loss_factor: float  # eta, hysteretic: E (1 + i eta)

    @property
    def shear_modulus(self) -> float:
        """Shear modulus G = E / (2 (1 + nu)) [Pa] of the isotropic material."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def bending_stiffness(self) -> float:
        """Bending stiffness E I [N m2]."""
        return self.youngs_modulus * self.second_moment

    @property
    def shear_stiffness(self) -> float:
        """Shear stiffness kappa A G [N]."""
        return self.shear_coefficient * self.area * self.shear_modulus

    @property
    def mass_per_length(self) -> float:
        """Mass per length rho A [kg/m]."""
        return self.density * self.area

    @property
    def rotary_inertia(self) -> float:
        """Rotary inertia per length rho I [kg m]."""
        return self.density * self.second_moment


@dataclass(frozen=True)
class Support:
    """A rail pad on a sleeper on ballast; the sleeper is rigid and moves vertically.

    `kind` says how the pad meets the rail:

    - ``concentrated``: one vertical spring and damper at the sleeper centre;
    - ``concentrated_rotational``: and a rotational pair against the ground, its stiffness
      pad_stiffness * pad_length**2 / 12, its damping pad_damping * pad_length**2 / 12;
    - ``multipoint``: vertical pairs at the nodes of four elements over the pad, tributary shares;
    - ``distributed``: a viscoelastic foundation of pad_stiffness / pad_length over the pad.
    """

    kind: str  # one of SUPPORT_KINDS
    spacing: float  # l, distance of sleeper centres, m
    pad_length: float  # Ls, along the rail, m
    pad_stiffness: float  # Kp, whole pad, N/m
    pad_damping: float  # Cp, whole pad, N s/m
    sleeper_mass: float  # Ms per rail (half a monobloc sleeper), kg
    ballast_stiffness: float  # Kb per rail and sleeper, N/m
    ballast_damping: float  # Cb per rail and sleeper, N s/m


@dataclass(frozen=True)
class Track:
    """A periodic track: the same rail and the same support in every bay."""

    name: str
    rail: Rail
    support: Support
    description: str = ''


RAIL_RANGES = {
    'youngs_modulus': POSITIVE,
    'poisson_ratio': Range(above=-1.0, maximum=0.5),
    'area': POSITIVE,
    'second_moment': POSITIVE,
    'density': POSITIVE,
    'shear_coefficient': Range(above=0.0, maximum=1.0),
    'loss_factor': NOT_NEGATIVE,
}
SUPPORT_RANGES = {
    'spacing': POSITIVE,
    'pad_length': POSITIVE,
    'pad_stiffness': POSITIVE,
    'pad_damping': NOT_NEGATIVE,
    'sleeper_mass': POSITIVE,
    'ballast_stiffness': POSITIVE,
    'ballast_damping': NOT_NEGATIVE,
}


def load_track(name_or_path: str | Path) -> Track:
    """Read a shipped track by its name, or a track file by its path.

    Raises
    ------
    InputError
        No such track, or something in the file is not understood or impossible.
    """
    path = parameters.find_described('track', name_or_path, _folder())
    file = parameters.read_yaml(path)
    file.expect(('rail', 'support'), ('description',), not_yet=('stretches', 'sleepers'))

    rail = file.section('rail')
    rail.expect(RAIL_RANGES)

    support = file.section('support')
    support.expect(('kind', *SUPPORT_RANGES), not_yet=('pad_nonlinearity',))
    values = support.numbers(SUPPORT_RANGES)
    if values['pad_length'] >= values['spacing']:
        raise support.error(
            'pad_length',
            f'expected less than the sleeper spacing of {values["spacing"]:g} m, '
            f'got {values["pad_length"]:g}',
        )
    return Track(
        name=path.stem,
        rail=Rail(**rail.numbers(RAIL_RANGES)),
        support=Support(kind=support.choice('kind', SUPPORT_KINDS), **values),
        description=file.text('description', default=''),
    )


def shipped_tracks() -> list[str]:
    """Return the names of the tracks that come with the program."""
    return parameters.shipped_names(_folder())


def _folder() -> Path:
    return paths.config_directory() / 'tracks'
