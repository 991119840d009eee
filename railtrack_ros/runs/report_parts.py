"""What the reports of estimates and replays have in common."""

from __future__ import annotations

from collections.abc import Sequence

from railtrack_ros.estimation.analysis import Analysis
from railtrack_ros.estimation.bands import band_name
from railtrack_ros.estimation.indicators import Section
from railtrack_ros.estimation.section import Judge
from railtrack_ros.report import sections, style
from railtrack_ros.report.content import Card, Indicators, Tile
from railtrack_ros.report.corrugation import card
from railtrack_ros.runs.corrugation_report import corrugation_data
from railtrack_ros.runs.rail_rows import Setting
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle


def indicators_of(found: Sequence[Section], judge: Judge) -> Indicators:
    """Return sections as the plots want them, with those limits of the judge that are RMS."""
    limits = judge.limits
    by_band = {f'rms_{band_name(band)}_um': limits.of(band) for band in judge.bands}
    rms = limits.statistic == 'moving_rms'
    return Indicators(
        [section.row() for section in found],
        {name: 1e6 * item.limit for name, item in by_band.items() if rms and item is not None},
        f'Limits: {limits.title} ({limits.source}).')


def corrugation_cards(found: Analysis, judge: Judge, vehicle: Vehicle) -> list[Card]:
    """Return the plots of the rails' corrugation, none where no section of a rail is valid."""
    if not found.rails:
        return []
    wheel = vehicle.wheel
    setting = Setting(judge, load=wheel.static_load, radius=wheel.radius)
    return [card(corrugation_data(found, setting))]


def corrugation_findings(indicators: Indicators | None) -> list[str]:
    """Say where the irregularity is above its limit."""
    if indicators is None or not indicators.rows or not indicators.limits:
        return []
    found = sections.exceedances(indicators)
    if not found:
        return ['No section is above its limit in any band of wavelength.']
    first = found[0]
    same = [e for e in found if e.band == first.band and e.start < first.end
            and first.start < e.end]
    rails = 'both rails' if len({e.rail for e in same}) > 1 else f'the {first.rail} rail'
    begin, end = min(e.start for e in same), max(e.end for e in same)
    band = style.band_title(first.band)
    if first.wavelength is None:
        text = (f'From {begin:.0f} m to {end:.0f} m irregularity of {band} wavelength is above its '
                f'limit on {rails}: up to')
    else:
        verb = 'are' if rails.startswith('both') else 'is'
        text = (f'{rails[0].upper()}{rails[1:]} {verb} corrugated from {begin:.0f} m to '
                f'{end:.0f} m, with a wavelength of {first.wavelength * 1e3:.0f} mm: irregularity '
                f'of {band} wavelength reaches')
    text += (f' {first.worst:.1f} µm RMS in a section, {first.worst / first.limit:.1f} times the '
             'limit.')
    others = [e for e in found if e not in same]
    if others:
        text += (f' {len(others)} more stretch{"es are" if len(others) > 1 else " is"} above a '
                 f'limit, by a factor of {others[0].worst / others[0].limit:.1f} at most.')
    return [text]


def worst_tile(indicators: Indicators | None) -> list[Tile]:
    """Return the key figure of the stretch that is furthest above its limit."""
    if indicators is None or not indicators.limits:
        return []
    above = sections.exceedances(indicators)
    if not above:
        return [Tile('above a limit', 'nothing', 'in any band of wavelength')]
    return [Tile('worst stretch', f'{above[0].worst / above[0].limit:.1f} × limit',
                 f'{above[0].start:.0f} to {above[0].end:.0f} m, {above[0].rail} rail, '
                 f'{style.band_title(above[0].band)}')]


def described_track(track: Track, vehicle: Vehicle) -> dict[str, dict[str, str]]:
    """Return the figures of track and vehicle, in groups."""
    rail, support, wheel = track.rail, track.support, vehicle.wheel
    return {
        f'track {track.name}': {
            'support': f'{support.kind}, every {support.spacing:g} m',
            'rail pad': f'{support.pad_stiffness / 1e6:g} MN/m, {support.pad_damping / 1e3:g} '
                        f'kNs/m, {support.pad_length * 1e3:g} mm long',
            'sleeper mass per rail': f'{support.sleeper_mass:g} kg',
            'ballast': f'{support.ballast_stiffness / 1e6:g} MN/m, '
                       f'{support.ballast_damping / 1e3:g} kNs/m',
            'rail': f'EI {rail.bending_stiffness / 1e6:.4g} MNm², '
                    f'{rail.mass_per_length:.4g} kg/m, loss factor {rail.loss_factor:g}',
        },
        f'vehicle {vehicle.name}': {
            'axle boxes': str(len(vehicle.axle_boxes)),
            'wheel': f'{wheel.mass:g} kg unsprung, {wheel.static_load / 1e3:g} kN static load',
            'contact': f'{vehicle.contact.stiffness:g} N/m^{vehicle.contact.exponent:g}',
        },
    }
