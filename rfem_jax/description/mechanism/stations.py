"""Stations along a link, between which its section changes: tapers and steps.

Place in the pipeline: sections -> **stations** -> links; `mechanics` integrates over the spans between them.

The sizes of a section change linearly with x from one station to the next. Source: theory (1.17) to (1.19).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_instance
from rfem_jax.description.basics.numbers import POSITIVE, Fields, Number, NumberTree, is_known, read_number
from rfem_jax.description.mechanism.section_bases import OwnStiffness
from rfem_jax.description.mechanism.sections import SECTION_KINDS, PolygonSection, Section, Tube


@dataclass(frozen=True)
class Station(NumberTree, ChecksItself):
    """A place along a link with a section of its own.

    Args:
        x: place on the link's axis [m], > 0; None = the end of the link.
        section: what the section has become there, changing linearly from the place before; None = it stayed as it was.
        after: the section just behind the place, where the link has a step; None = no step.
    Raises:
        InputError: a value is out of range or of the wrong kind, or neither section nor after is given.
    """

    x: float | None = None
    section: Section | None = None
    after: Section | None = None

    numbers: ClassVar[Fields] = {"x": ("length", POSITIVE)}

    def _check_fields(self, checks: Checks) -> None:
        if self.x is not None:
            checks.convert("x", read_number, self.numbers["x"], "`x` of a station")
        for name in ("section", "after"):
            if getattr(self, name) is not None:
                give = "give a section, or leave it out."
                checks.convert(name, require_instance, f"`{name}` of a station", SECTION_KINDS, give)
        checks.relation(("section", "after"), self._check_any)

    def _check_any(self) -> None:
        if self.section is None and self.after is None:
            raise InputError(
                "Argument `section` of a station must be given where there is no `after`, but is missing; give what "
                "the section becomes there, or the section behind a step."
            )


class Span(NamedTuple):
    """A part of a link from `begin` to `end` [m], along which the sizes of its section change linearly from those of
    `first` to those of `last`."""

    begin: Number
    end: Number
    first: Section
    last: Section


def spans_of(length: Number, section: Section, stations: Sequence[Station]) -> tuple[Span, ...]:
    """The parts of a link of a length [m] that begins with a section."""
    spans, begin, now = [], 0.0, section
    for station in stations:
        end = length if station.x is None else station.x
        reached = now if station.section is None else station.section
        spans.append(Span(begin, end, now, reached))
        begin, now = end, reached if station.after is None else station.after
    if stations and stations[-1].x is None:
        return tuple(spans)
    return (*spans, Span(begin, length, now, now))


def section_between(first: Section, last: Section, share: Any) -> Section:
    """The section, without a name, whose sizes are at a share of the way between those of two sections of one kind;
    nothing is checked."""
    names = [name for name in vars(first) if name != "name" and getattr(first, name) is not None]
    if isinstance(first, Tube) and isinstance(last, Tube) and _derives(first) and _derives(last):
        first = first.with_fields(shear_factor=None)
        names = [name for name in names if name != "shear_factor"]
    values = {name: _between(getattr(first, name), getattr(last, name), share) for name in names}
    return first.with_fields(**values, name=None)


def _between(first: Any, last: Any, share: Any) -> Any:
    """A number, or a table of numbers, between two."""
    if isinstance(first, tuple):
        return tuple(_between(one, other, share) for one, other in zip(first, last, strict=True))
    return first + share * (last - first)


def _derives(tube: Tube) -> bool:
    """Whether the shear factor of a tube follows from its diameters."""
    if tube.shear_factor is None:
        return True
    return is_known(tube.shear_factor, tube.outer_diameter, tube.wall) and tube.shear_factor == tube.derived_factor


def require_order(length: Number, stations: Sequence[Station], of: str) -> None:
    """Raise InputError for stations that do not follow each other on the link, as far as their places are known."""
    for n, station in enumerate(stations, start=1):
        if station.x is None and n < len(stations):
            raise InputError(
                f"Argument `stations` {of} must have an `x` each but for the last, but station {n} has none, which "
                "is the end of the link; give its place, or move it to the end of the list."
            )
        if station.x is None and station.after is not None:
            raise InputError(
                f"Argument `stations` {of} must have no `after` at the end of the link, but station {n} has one; "
                "leave it out, or give its `x`."
            )
    places = [0.0, *(one.x for one in stations if one.x is not None), length]
    if is_known(places) and any(b <= a for a, b in itertools.pairwise(places)):
        raise InputError(
            f"Argument `stations` {of} must follow each other between 0 and {length} m, but their places are "
            f"{', '.join(f'{x:g} m' for x in places[1:-1])}; put them in order, and leave out `x` at the end of the "
            "link."
        )


def require_alike(spans: Sequence[Span], of: str) -> None:
    """Raise InputError for sections between which nothing can change linearly, or whose dampings differ."""
    for span in spans:
        one, other = span.first, span.last
        if isinstance(one, PolygonSection) and isinstance(other, PolygonSection):
            _require_one_polygon(one, other, of)
        given = [{name for name, value in vars(two).items() if value is not None} - {"name"} for two in (one, other)]
        if type(one) is not type(other) or given[0] != given[1]:
            raise InputError(
                f"Argument `stations` {of} must change the section between sections of one kind that give the same "
                f"numbers, but goes from {type(one).__name__} to {type(other).__name__}; give the second one as "
                "`after` of a station, where the link has a step."
            )
    known = [two.damping for span in spans for two in span[2:] if isinstance(two, OwnStiffness)]
    if is_known(known) and len(set(known)) > 1:
        raise InputError(
            f"Argument `stations` {of} must have sections of one `damping`, but they have "
            f"{', '.join(f'{x:g} s' for x in dict.fromkeys(known))}; give all the same."
        )


def _require_one_polygon(one: PolygonSection, other: PolygonSection, of: str) -> None:
    if one.with_fields(scale=other.scale) != other:
        raise InputError(
            f"Argument `stations` {of} must change the scale of a polygon alone between two stations, since its "
            "torsion constant would not follow its corners, but these differ; give the second one as `after` of a "
            "station, where the link has a step."
        )
