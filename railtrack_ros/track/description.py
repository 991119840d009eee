"""What a track is made of: one rail on discrete supports.

All values are SI units and belong to one rail; the two rails of a track are not coupled.
Sleeper centres lie at x = k * spacing for every integer k.  Usually all bays are alike; stretches
and single sleepers may differ (a soft spot, a hanging sleeper, another rail).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from railtrack_ros import parameters, paths
from railtrack_ros.errors import InputError
from railtrack_ros.parameters import ANY, NOT_NEGATIVE, POSITIVE, Range, Section

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
class PadNonlinearity:
    """A progressive rail pad under preload; pad_stiffness is its tangent at the preload.

    The whole pad force at the compression d [m] is k1 d + k3 d^3 for d > 0 and nothing below.
    """

    preload: float  # static force of the fastening on the pad, N
    unloaded_stiffness: float  # k1, tangent of the pad without preload, N/m


@dataclass(frozen=True)
class BallastLiftOff:
    """Ballast that pushes but does not pull: the sleeper lifts off.

    Either it is pressed down at rest, or it hangs above a gap.
    """

    preload: float = 0.0  # static force of a sleeper's share of the dead weight on the ballast, N
    gap: float = 0.0  # void under a hanging sleeper at rest, m


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
    pad_nonlinearity: PadNonlinearity | None = None
    ballast_lift_off: BallastLiftOff | None = None

    @property
    def linear(self) -> bool:
        """Whether forces are proportional to displacements."""
        return self.pad_nonlinearity is None and self.ballast_lift_off is None


@dataclass(frozen=True)
class Stretch:
    """What differs in the bays whose sleeper centres lie in begin <= x < end [m]."""

    begin: float
    end: float
    rail: Rail
    support: Support


@dataclass(frozen=True)
class Track:
    """A rail on sleepers: the same everywhere but for stretches and single sleepers.

    sleepers holds (index, support) of the sleepers that differ from their surroundings.
    """

    name: str
    rail: Rail
    support: Support
    description: str = ''
    stretches: tuple[Stretch, ...] = ()
    sleepers: tuple[tuple[int, Support], ...] = ()

    @property
    def periodic(self) -> bool:
        """Whether all bays are alike."""
        return not (self.stretches or self.sleepers)

    def bay(self, number: int) -> Track:
        """The periodic track whose every bay is like bay `number` of this one."""
        rail, support = self.rail, self.support
        for stretch in self.stretches:
            if stretch.begin <= number * self.support.spacing < stretch.end:
                rail, support = stretch.rail, stretch.support
        support = dict(self.sleepers).get(number, support)
        return Track(self.name, rail, support, self.description)

    def require_linear(self, purpose: str) -> None:
        """Raise InputError where `purpose` takes linear supports alone and one is not."""
        supports = [('support.', self.support),
                    *(('stretches: support.', s.support) for s in self.stretches),
                    *((f'sleepers: {index}: ', s) for index, s in self.sleepers)]
        for place, support in supports:
            for key in NONLINEARITIES:
                if getattr(support, key) is not None:
                    raise InputError(
                        f'track {self.name}: {place}{key}: {purpose} cannot take it, only the '
                        'full model can (simulate --solver newmark); remove the key')

    def require_periodic(self, purpose: str) -> None:
        """Raise InputError where `purpose` needs all bays alike and they are not."""
        if not self.periodic:
            key = 'stretches' if self.stretches else 'sleepers'
            raise InputError(f'track {self.name}: {key}: {purpose} needs a periodic track; '
                             'take a track file without stretches and sleepers')


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

NONLINEARITIES = ('pad_nonlinearity', 'ballast_lift_off')


def load_track(name_or_path: str | Path) -> Track:
    """Read a shipped track by its name, or a track file by its path.

    Raises
    ------
    InputError
        No such track, or something in the file is not understood or impossible.
    """
    path = parameters.find_described('track', name_or_path, _folder())
    file = parameters.read_yaml(path)
    file.expect(('rail', 'support'), ('description', 'stretches', 'sleepers'))

    rail = file.section('rail')
    rail.expect(RAIL_RANGES)

    support = file.section('support')
    support.expect(('kind', *SUPPORT_RANGES), NONLINEARITIES)
    values = support.numbers(SUPPORT_RANGES)
    _check_pad_length(support, values['pad_length'], values['spacing'])
    track = Track(
        name=path.stem,
        rail=Rail(**rail.numbers(RAIL_RANGES)),
        support=_nonlinear(support, Support(
            support.choice('kind', SUPPORT_KINDS), **values)),  # type: ignore[arg-type]
        description=file.text('description', default=''),
    )
    if 'stretches' in file:
        track = dataclasses.replace(track, stretches=_stretches(file, track))
    if 'sleepers' in file:
        track = dataclasses.replace(track, sleepers=_sleepers(file, track))
    return track


# What may change along the track; a hanging sleeper has no ballast, a broken fastening no pad.
CHANGED_SUPPORT_RANGES = {
    key: NOT_NEGATIVE if key.endswith(('_stiffness', '_damping')) else allowed
    for key, allowed in SUPPORT_RANGES.items() if key != 'spacing'
}


def _stretches(file: Section, track: Track) -> tuple[Stretch, ...]:
    """Read `stretches`: where they begin and end, and the rail and support values that differ."""
    found: list[Stretch] = []
    for item in file.sections('stretches'):
        item.expect(('from', 'to'), ('rail', 'support'))
        begin, end = item.number('from', ANY), item.number('to', ANY)
        if not end > begin:
            raise item.error('to', f'expected more than from, {begin:g} m, got {end:g}')
        rail, support = track.rail, track.support
        if 'rail' in item:
            section = item.section('rail')
            section.expect((), RAIL_RANGES)
            rail = dataclasses.replace(rail, **{
                key: section.number(key, RAIL_RANGES[key]) for key in section.values})
        if 'support' in item:
            support = _changed_support(item.section('support'), support)
        if rail == track.rail and support == track.support:
            raise item.error(None, 'changes nothing; give a rail or a support value that differs')
        for other in found:
            if begin < other.end and other.begin < end:
                raise item.error('from', f'overlaps the stretch from {other.begin:g} to '
                                         f'{other.end:g} m')
        found.append(Stretch(begin, end, rail, support))
    return tuple(found)


def _sleepers(file: Section, track: Track) -> tuple[tuple[int, Support], ...]:
    """Read `sleepers`: the index of each and the support values that differ."""
    found: dict[int, Support] = {}
    for item in file.sections('sleepers'):
        item.expect(('index',), ('kind', *CHANGED_SUPPORT_RANGES, *NONLINEARITIES))
        index = item.number('index', ANY)
        if index != round(index):
            raise item.error('index', f'expected a whole number, got {index:g}')
        if int(index) in found:
            raise item.error('index', f'sleeper {index:g} is given twice')
        surroundings = track.bay(int(index)).support
        found[int(index)] = _changed_support(item, surroundings, ('index',))
    return tuple(sorted(found.items()))


def _changed_support(section: Section, support: Support, beside: tuple[str, ...] = ()) -> Support:
    """Return `support` with the values of a section; `beside` are its other keys."""
    if 'spacing' in section:
        raise section.error('spacing', 'the sleeper spacing is the same along the whole track')
    section.expect(beside, ('kind', *CHANGED_SUPPORT_RANGES, *NONLINEARITIES))
    kind = section.choice('kind', SUPPORT_KINDS) if 'kind' in section else support.kind
    values = {key: section.number(key, allowed)
              for key, allowed in CHANGED_SUPPORT_RANGES.items() if key in section}
    changed = dataclasses.replace(support, kind=kind, **values)  # type: ignore[arg-type]
    _check_pad_length(section, changed.pad_length, changed.spacing)
    if changed.pad_stiffness == 0.0 and changed.ballast_stiffness == 0.0:
        raise section.error('pad_stiffness', 'a sleeper needs a pad or ballast to hold it')
    return _nonlinear(section, changed)


def _nonlinear(section: Section, support: Support) -> Support:
    """Return `support` with its non-linear forces; without stiffness there is none."""
    pad, ballast = support.pad_nonlinearity, support.ballast_lift_off
    if 'pad_nonlinearity' in section:
        given = section.section('pad_nonlinearity')
        ranges = {'preload': POSITIVE,
                  'unloaded_stiffness': Range(above=0.0, maximum=support.pad_stiffness)}
        given.expect(ranges)
        pad = PadNonlinearity(**given.numbers(ranges))
    elif pad and 0.0 < support.pad_stiffness < pad.unloaded_stiffness:
        raise section.error('pad_stiffness', 'is less than pad_nonlinearity.unloaded_stiffness, '
                            f'{pad.unloaded_stiffness:g} N/m; give pad_nonlinearity here too')
    if 'ballast_lift_off' in section:
        given = section.section('ballast_lift_off')
        given.expect((), ('preload', 'gap'))
        values = {key: given.number(key, NOT_NEGATIVE) for key in given.values}
        if len(values) != 1:
            raise given.error(None, 'expected preload (a sleeper that lies on the ballast) or gap '
                              '(one that hangs above it)')
        ballast = BallastLiftOff(**values)
    return dataclasses.replace(
        support, pad_nonlinearity=pad if support.pad_stiffness else None,
        ballast_lift_off=ballast if support.ballast_stiffness else None)


def _check_pad_length(section: Section, pad_length: float, spacing: float) -> None:
    if pad_length >= spacing:
        raise section.error(
            'pad_length',
            f'expected less than the sleeper spacing of {spacing:g} m, got {pad_length:g}',
        )


def shipped_tracks() -> list[str]:
    """Return the names of the tracks that come with the program."""
    return parameters.shipped_names(_folder())


def _folder() -> Path:
    return paths.config_directory() / 'tracks'
