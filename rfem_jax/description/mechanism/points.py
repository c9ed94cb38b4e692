"""Points of links, whose paths are asked for: where a coupler's tool, a wheel's centre or a feeler is and goes.

Place in the pipeline: `Mechanism` holds them; a run follows them, and metrics measure their paths.

A point is given in the frame of its link; on a flexible link the rfe whose segment it lies in carries it, so that its
path has the link's deformation in it. The centres of joints and the ends of links are points that have names already,
as "B" and "coupler.end". Source: theory (8.17) to (8.25).
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from rfem_jax.description.basics.errors import (
    Checks,
    ChecksItself,
    InputError,
    require_entries,
    require_name,
    suggestion,
)
from rfem_jax.description.basics.numbers import ANY, Fields, NumberTree, is_known
from rfem_jax.description.basics.units import Quantity
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import Link, place_on_link

if TYPE_CHECKING:
    Place = Quantity | tuple[Quantity, Quantity, Quantity]
else:
    Place = Quantity

START, END = "start", "end"
_ROUNDING = 1e-12  # a position at the end of a link may exceed its length by rounding


@dataclass(frozen=True)
class Point(NumberTree, ChecksItself):
    """A point of a link, whose path a run follows.

    Args:
        name: a word that no joint and no link has as its name.
        link: the link that carries it.
        position: (x, y, z) [m] in the frame of the link; a single number x means on the axis.
        relative_to: the link in whose frame the path is given; "base": in global axes.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    link: str
    position: Place
    relative_to: str = "base"

    numbers: ClassVar[Fields] = {"position": ("length", ANY)}

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a point", ("base",))
        of = f"of point `{self.name}`"
        checks.convert("link", require_name, f"`link` {of}")
        checks.convert("position", place_on_link, f"`position` {of}")
        checks.convert("relative_to", require_name, f"`relative_to` {of}")

    @property
    def place(self) -> tuple[float, float, float]:
        """Its position [m] as three numbers."""
        return self.position  # pyright: ignore[reportReturnType]  # converted

    def require_links(self, links: Mapping[str, Link]) -> None:
        """Raise InputError unless it is a point of one of `links` (by name) that moves against what it is relative
        to."""
        of = f"of point `{self.name}`"
        for argument, known in (("link", [*links]), ("relative_to", ["base", *links])):
            if getattr(self, argument) not in known:
                raise InputError(
                    f"Argument `{argument}` {of} must be {'' if argument == 'link' else 'the base or '}a link of the "
                    f"mechanism, but there is no link `{getattr(self, argument)}`; "
                    f"{suggestion(getattr(self, argument), known)}"
                )
        link = links[self.link]
        if self.relative_to == self.link and not link.flexible:
            raise InputError(
                f"Argument `relative_to` {of} must be another link, but `{self.link}` is rigid and carries the point, "
                "which does not move in its frame; leave it out for global axes."
            )
        x = self.place[0]
        if (
            link.flexible
            and not link.reduced
            and is_known(x, link.length)
            and not 0.0 <= x <= link.length * (1.0 + _ROUNDING)
        ):
            raise InputError(
                f"Argument `position` {of} must lie on the flexible link `{self.link}` (x from 0 to {link.length} m), "
                f"but has x = {x} m; move it, or make the link rigid."
            )


@dataclass(frozen=True)
class NamedPoint(Point):
    """A point that has a name already, of which the model knows the place.

    Args:
        name: of a joint, as "B", for its centre on its child; or of an end of a link, as "coupler.start" and
            "coupler.end".
        link: the link that carries it.
    """

    position: Any = None

    numbers: ClassVar[Fields] = {}

    def _check_fields(self, checks: Checks) -> None:
        """It is made of names that are there."""

    def require_links(self, links: Mapping[str, Link]) -> None:
        """It is of one of `links`."""


def link_end(name: str) -> tuple[str, bool] | None:
    """The link of a point with a name as "coupler.end", and whether it is the far end; None of other names."""
    link, _, end = name.rpartition(".")
    return (link, end == END) if link and end in (START, END) else None


def named_points(links: Iterable[Link], joints: Iterable[Joint]) -> dict[str, NamedPoint]:
    """The points that have names already, by these: the ends of links, and the centres of joints."""
    carriers = {f"{link.name}.{end}": link.name for link in links for end in (START, END)}
    carriers |= {joint.name: joint.child for joint in joints}
    return {name: NamedPoint(name, link) for name, link in carriers.items()}


def read_points(entries: Any) -> tuple[Point | str, ...]:
    """Points, and names of those that have names already. Raises InputError."""
    called = "Point objects, and of names of joints and ends of links"
    write = 'write for example [Point("P", "coupler", 0.1), "B", "coupler.end"].'
    entries = require_entries(entries, "points", (Point, str), called, write)
    names = Counter(one if isinstance(one, str) else one.name for one in entries)
    if twice := [name for name, count in names.items() if count > 1]:
        raise InputError(
            *(f"Argument `points` must have unique names, but `{name}` occurs twice; rename one." for name in twice)
        )
    return tuple(entries)
