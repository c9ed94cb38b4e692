"""Forces at points of links and between them: springs with dampers, forces and moments over time.

Place in the pipeline: forces, links -> **point_forces** -> distributed_forces, mechanism. `Mechanism` holds them beside
those along joints; the mechanics evaluates them inside compiled code.

A point is given in the frame of its link; on a flexible link the rfe whose segment it lies in holds it.  Springs pull
their two points together with their tension, along the line through both.  Source: theory (3.18) to (3.23).
"""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rfem_jax.description.basics.errors import (
    ABSENT,
    Checks,
    ChecksItself,
    InputError,
    require_choice,
    require_name,
    subject,
    suggestion,
)
from rfem_jax.description.basics.numbers import ANY, NOT_NEGATIVE, Fields, is_known, number_vector, read_number
from rfem_jax.description.basics.own_functions import as_tree, checked_function
from rfem_jax.description.basics.units import Quantities, Quantity, sequence, vector
from rfem_jax.description.drives.arguments import checked_breakpoints, table_times
from rfem_jax.description.mechanism.forces import Force
from rfem_jax.description.mechanism.links import Link, place_on_link

if TYPE_CHECKING:
    Law = Callable[[Any, Any], Any]
    Place = Quantity | tuple[Quantity, Quantity, Quantity]
    Vectors = Any
else:
    Law = Place = Vectors = Any  # what is none is refused in a sentence

AXES = ("global", "link")
_ROUNDING = 1e-12  # a position at the end of a link may exceed its length by rounding


class PointLoad(Force, ChecksItself):
    """A force at points of links."""

    @abc.abstractmethod
    def ends(self) -> tuple[tuple[str, tuple[float, float, float]], ...]:
        """Return the (link or "base", place in its frame [m]) that it acts on."""

    def jumps(self) -> tuple[float, ...]:
        """Times [s] > 0 at which it jumps."""
        return ()

    def require_points(self, links: Mapping[str, Link]) -> None:
        """Raise InputError unless its points are points of `links` (by name) and not rigidly joined."""
        for name, place in self.ends():
            self.require_link(name, links)
            if name != "base" and links[name].flexible and not links[name].reduced:
                length = links[name].length
                if is_known(place[0], length) and not 0.0 <= place[0] <= length * (1.0 + _ROUNDING):
                    raise InputError(
                        f"Argument `{self.place_argument}` of force `{self.name}` must lie on the flexible link "
                        f"`{name}` (x from 0 to {length} m), but has x = {place[0]} m; move it, or make the link rigid."
                    )

    def require_link(self, name: str, links: Mapping[str, Link]) -> None:
        """Raise InputError for a name that is neither of `links` nor of the base."""
        if name not in links and name != "base":
            raise InputError(
                f"Argument `{self.link_argument}` of force `{self.name}` must name links of the mechanism, but "
                f"there is no link `{name}`; {suggestion(name, [*links])}"
            )

    link_argument = "link"
    place_argument = "position"


class BetweenPoints(PointLoad):
    """A force along the line through two points, equal and opposite at both."""

    links: tuple[str, str]
    points: tuple[Place, Place]

    link_argument = "links"
    place_argument = "points"

    def _check_ends(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a force")
        of = f"of force `{self.name}`"
        checks.convert("links", _two_names, f"`links` {of}")
        checks.convert("points", _two_places, f"`points` {of}")

    def ends(self) -> tuple[tuple[str, tuple[float, float, float]], ...]:
        return tuple(zip(self.links, self.points, strict=True))  # pyright: ignore[reportReturnType]  # converted

    def require_points(self, links: Mapping[str, Link]) -> None:
        super().require_points(links)
        one, other = self.links
        if one == other and (one == "base" or not links[one].flexible):
            what = "the base" if one == "base" else f"the rigid link `{one}`"
            raise InputError(
                f"Argument `links` of force `{self.name}` must be two that move against each other, but both points "
                f"are on {what}; take points of different links."
            )


@dataclass(frozen=True)
class PointSpring(BetweenPoints):
    """A spring with a damper between two points: tension preload + stiffness * (length - free_length) + damping * rate
    of the length, positive where it pulls the points together.

    Args:
        name: a word.
        links: the two links that it joins, each a link or "base".
        points: its point on each, (x, y, z) [m] in the frame of the link (for the base: global); a single number x
            means on the axis.
        stiffness: [N/m], >= 0.
        damping: [N s/m], >= 0.
        free_length: length [m] at which the tension is the preload, >= 0.
        preload: tension [N] at the length `free_length`.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    links: tuple[str, str]
    points: tuple[Place, Place]
    stiffness: Quantity = 0.0
    damping: Quantity = 0.0
    free_length: Quantity = 0.0
    preload: Quantity = 0.0

    numbers: ClassVar[Fields] = {
        "stiffness": ("stiffness", NOT_NEGATIVE),
        "damping": ("damping", NOT_NEGATIVE),
        "free_length": ("length", NOT_NEGATIVE),
        "preload": ("force", ANY),
    }

    def _check_fields(self, checks: Checks) -> None:
        self._check_ends(checks)
        for name, field in self.numbers.items():
            checks.convert(name, read_number, field, f"`{name}` of force `{self.name}`")


@dataclass(frozen=True)
class PointSpringTable(BetweenPoints):
    """A tension given at distances of two points, linear in between and constant outside.

    Args:
        name: a word.
        links: the two links that it joins, each a link or "base".
        points: its point on each, (x, y, z) [m] in the frame of the link (for the base: global); a single number x
            means on the axis.
        lengths: distances [m] of the points, increasing; at least two.
        forces: tensions [N], as many as lengths; positive where the points are pulled together.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    links: tuple[str, str]
    points: tuple[Place, Place]
    lengths: Quantities
    forces: Quantities

    def _check_fields(self, checks: Checks) -> None:
        self._check_ends(checks)
        of = f"of force `{self.name}`"
        checks.convert("lengths", _lengths, of)
        checks.convert("forces", sequence, "force", f"`forces` {of}")
        checks.relation(("lengths", "forces"), self._check_rows, of)

    def _check_rows(self, of: str) -> None:
        if len(self.forces) != len(self.lengths):
            raise InputError(
                f"Argument `forces` {of} must have as many entries as `lengths` ({len(self.lengths)}), but has "
                f"{len(self.forces)}; give one for each length."
            )


@dataclass(frozen=True)
class PointSpringFunction(BetweenPoints):
    """A tension given by a Python function written in JAX.

    Args:
        name: a word.
        links: the two links that it joins, each a link or "base".
        points: its point on each, (x, y, z) [m] in the frame of the link (for the base: global); a single number x
            means on the axis.
        function: (distance of the points [m], its rate [m/s]) -> tension [N], a float64 scalar, positive where the
            points are pulled together. It may close over what is differentiated;
            an `equinox.Module` that has it as arrays is compiled once for all values.
    Raises:
        InputError: a value is of the wrong kind.
    """

    name: str
    links: tuple[str, str]
    points: tuple[Place, Place]
    function: Law

    def _check_fields(self, checks: Checks) -> None:
        self._check_ends(checks)
        checks.convert("function", _function, f"of force `{self.name}`", "length, rate", (), ("float64", "float64"))


class LoadOnLink(PointLoad):
    """A given force or moment on one link: constant, or over time."""

    link: str
    times: Any
    breakpoints: Any
    axes: str

    unit = "N"
    dimension = "force"  # of what a run tells of it
    vectors: ClassVar[Mapping[str, str]] = {"force": "force"}  # {field: dimension} of what is given

    @property
    def value(self) -> Any:
        """The first of these."""
        return getattr(self, next(iter(self.vectors)))

    @property
    def changes(self) -> bool:
        """Whether it changes over time."""
        return self.times is not None or callable(self.value)

    def jumps(self) -> tuple[float, ...]:
        """Where a table has two rows or ends, and the breakpoints of a function [s]."""
        if self.times is None:
            return tuple(self.breakpoints)
        return (*(later for one, later in pairwise(self.times) if one == later), self.times[-1])

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a force")
        of = f"of force `{self.name}`"
        checks.convert("link", _moving_link, f"`link` {of}")
        self._check_place(checks, of)
        checks.convert("axes", require_choice, AXES, f"`axes` {of}")
        if self.times is not None:
            checks.convert("times", table_times, False)
        checks.convert("breakpoints", checked_breakpoints)
        given = {name: dimension for name, dimension in self.vectors.items() if getattr(self, name) is not None}
        checks.relation(("times", "breakpoints"), self._check_times, next(iter(self.vectors)), of)
        times = None if "times" in checks.wrong else self.times
        for name, dimension in given.items():
            checks.convert(name, _values, dimension, name, of, times)

    @abc.abstractmethod
    def _check_place(self, checks: Checks, of: str) -> None:
        """Convert the numbers that say where on the link it acts."""

    def _check_times(self, value: str, of: str) -> None:
        changes = callable(self.value)
        if self.times is not None and changes:
            raise InputError(
                f"Argument `times` {of} must be left out where `{value}` is a function, but was {list(self.times)}; "
                "remove one of the two."
            )
        if self.breakpoints and not changes:
            raise InputError(
                f"Argument `breakpoints` {of} must be left out where `{value}` is not a function, but was "
                f"{list(self.breakpoints)}; give a time of a table twice for a jump."
            )


class AtPoint(LoadOnLink):
    """A force or a moment at a point of one link."""

    numbers: ClassVar[Fields] = {"position": ("length", ANY)}
    position: Place

    def _check_place(self, checks: Checks, of: str) -> None:
        checks.convert("position", place_on_link, f"`position` {of}")

    def ends(self) -> tuple[tuple[str, tuple[float, float, float]], ...]:
        return ((self.link, self.position),)  # pyright: ignore[reportReturnType]  # converted


@dataclass(frozen=True)
class PointForce(AtPoint):
    """A force at a point of a link, constant or over time; its reaction acts on the base.

    Args:
        name: a word.
        link: the link.
        position: its point (x, y, z) [m] in the frame of the link; a single number x means on the axis.
        force: (x, y, z) [N]; with `times` one such row for each, linear in between and zero after the last time; in
            Python also a function (t [s], phase) -> (3,) array, smooth within a phase.
        times: [s] of a table, from 0, not decreasing; a time given twice is a jump.
        breakpoints: times [s] > 0 at which a function jumps, increasing; phase is the number of those passed.
        axes: "global", or "link": the force turns with the link (a flexible one: with the rfe that holds the point).
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    link: str
    position: Place
    force: Vectors
    times: Quantities | None = None
    breakpoints: Quantities = ()
    axes: str = "global"


@dataclass(frozen=True)
class PointMoment(AtPoint):
    """A moment on a link, constant or over time; its reaction acts on the base.

    Args:
        name: a word.
        link: the link.
        position: the point (x, y, z) [m] in the frame of the link that it acts at; a single number x means on the axis.
            On a rigid link any is the same, on a flexible one the rfe that holds the point is turned.
        moment: (x, y, z) [N m]; with `times` one such row for each, linear in between and zero after the last time; in
            Python also a function (t [s], phase) -> (3,) array, smooth within a phase.
        times: [s] of a table, from 0, not decreasing; a time given twice is a jump.
        breakpoints: times [s] > 0 at which a function jumps, increasing; phase is the number of those passed.
        axes: "global", or "link": the moment turns with the link (a flexible one: with the rfe that holds the point).
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    link: str
    position: Place
    moment: Vectors
    times: Quantities | None = None
    breakpoints: Quantities = ()
    axes: str = "global"

    unit = "N m"
    dimension = "moment"
    vectors: ClassVar[Mapping[str, str]] = {"moment": "moment"}


def _two(entries: Any, where: str, what: str) -> tuple[Any, Any]:
    if not isinstance(entries, (tuple, list)) or len(entries) != 2:
        raise InputError(f"Argument {where} must hold two {what}, but was {entries!r}; give one for each end.")
    return entries[0], entries[1]


def _moving_link(name: Any, where: str) -> str:
    if name == "base":
        raise InputError(f"{subject(where)} must be a link, but was the base, which no force moves; name a link.")
    return require_name(name, where)


def _two_names(links: Any, where: str) -> tuple[str, str]:
    one, other = _two(links, where, "names")
    return require_name(one, where), require_name(other, where)


def _two_places(points: Any, where: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    one, other = _two(points, where, "points")
    return place_on_link(one, where), place_on_link(other, where)


def _lengths(lengths: Quantities, of: str) -> tuple[float, ...]:
    found = sequence(lengths, "length", f"`lengths` {of}")
    if len(found) < 2 or found[0] < 0.0 or not all(np.diff(found) > 0.0):
        raise InputError(
            f"Argument `lengths` {of} must hold at least two lengths from 0 on, increasing, but was {list(found)}; "
            "sort the table and give each length once."
        )
    return found


def _values(values: Any, dimension: str, value: str, of: str, times: Any) -> Any:
    """Three components, a tuple of as many rows of three as times, or a function of time and phase."""
    where = f"`{value}` {of}"
    if callable(values):
        return _function(values, of, "t, phase", (3,), ("float64", "int32"), value)
    if times is None or times is ABSENT:
        return number_vector(values, dimension, where)
    if not isinstance(values, (tuple, list, np.ndarray)) or len(values) != len(times):
        count = len(values) if isinstance(values, (tuple, list, np.ndarray)) else repr(values)
        raise InputError(
            f"Argument {where} must have as many rows as `times` ({len(times)}), but has {count}; give three "
            "components for each time."
        )
    return tuple(vector(row, dimension, where) for row in values)


def _function(
    function: Any, of: str, names: str, shape: tuple[int, ...], kinds: tuple[str, ...], argument: str = "function"
) -> Any:
    """A function as a pytree, tried with arguments of given names and kinds for a float64 result of a shape."""
    where = f"`{argument}` {of}"
    return checked_function(as_tree(function, where, names), where, names, kinds, shape)
