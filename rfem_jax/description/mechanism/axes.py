"""The axis of a link that is not straight: corners, bends, arcs, or a smooth curve.

Place in the pipeline: curves -> **axes** -> links.

Source: theory (1.20), (1.21).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError
from rfem_jax.description.basics.numbers import (
    ANY,
    POSITIVE,
    Fields,
    Number,
    NumberTree,
    array_of,
    is_known,
    number_vector,
    read_number,
    traced,
)
from rfem_jax.description.mechanism.curves import Curve, Piece, arc, joined, smooth, straight

SMALLEST_PIECE = 1e-9  # of the longest one
LEAST_BEND = 1e-6  # rad, below which an arc or a bend is straight


@dataclass(frozen=True)
class AxisPoint(NumberTree, ChecksItself):
    """The next point on the axis of a link, in the link's frame, in whose origin the axis begins.

    Args:
        to: the point (x, y, z) [m], which the axis reaches along a straight line from the point before.
        through: another point [m]; the axis reaches `to` along the arc through it.
        radius: of the bend [m] by which a corner at this point is rounded, > 0.
        roll: angle [rad] by which the section is turned about the axis when this point is reached, changing evenly
            from the point before; None = 0.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    to: tuple[float, float, float]
    through: tuple[float, float, float] | None = None
    radius: float | None = None
    roll: float | None = None

    numbers: ClassVar[Fields] = {
        "to": ("length", ANY),
        "through": ("length", ANY),
        "radius": ("length", POSITIVE),
        "roll": ("angle", ANY),
    }

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("to", number_vector, "length", "`to` of a point of an axis")
        if self.through is not None:
            checks.convert("through", number_vector, "length", "`through` of a point of an axis")
        for name in ("radius", "roll"):
            if getattr(self, name) is not None:
                checks.convert(name, read_number, self.numbers[name], f"`{name}` of a point of an axis")


def curve_of(axis: Sequence[AxisPoint], through_points: bool) -> Curve:
    """The curve of an axis, whose numbers may be traced; `through_points`: the smooth one through all points."""
    points = [np.zeros(3), *(array_of(point.to) for point in axis)]
    rolls = [0.0 if point.roll is None else point.roll for point in axis]
    if through_points:
        return joined([([piece], roll) for piece, roll in zip(smooth(points), rolls, strict=True)], False)
    parts: list[tuple[list[Piece], Any]] = []
    begin = points[0]
    for n, (point, last, roll) in enumerate(zip(axis, points[1:], rolls, strict=True)):
        pieces, end = _leg(point, begin, last, points[n + 2 :])
        parts.append((pieces, roll))
        begin = end
    return joined(parts, True)


def _leg(point: AxisPoint, begin: Any, last: Any, more: Sequence[Any]) -> tuple[list[Piece], Any]:
    """The pieces that lead to a point, with its bend, and where they end."""
    if point.through is not None:
        return [arc(begin, array_of(point.through), last)], last
    if point.radius is None or not more:
        return [straight(begin, last)], last
    first, middle, end = _bend(begin, last, more[0], point.radius)
    return [straight(begin, first), arc(first, middle, end)], end


def _bend(before: Any, corner: Any, after: Any, radius: Number) -> tuple[Any, Any, Any]:
    """Begin, middle and end of the arc that rounds a corner."""
    xp: Any = jnp if traced([before, corner, after, radius]) else np
    along, away = (one / xp.sqrt(xp.sum(one**2)) for one in (corner - before, after - corner))
    cosine = xp.sum(along * away)
    back = radius * xp.sqrt((1.0 - cosine) / (1.0 + cosine))
    inwards = (away - along) / xp.sqrt(xp.sum((away - along) ** 2))
    middle = corner + inwards * radius * (xp.sqrt(2.0 / (1.0 + cosine)) - 1.0)
    return corner - back * along, middle, corner + back * away


def require_curve(axis: Sequence[AxisPoint], through_points: bool, of: str) -> None:
    """Raise InputError for points through which there is no axis, as far as their numbers are known."""
    for n, point in enumerate(axis, start=1):
        given = [name for name in ("through", "radius") if getattr(point, name) is not None]
        wrong = through_points and given
        if len(given) == 2 or wrong:
            why = "where the axis is smooth" if wrong else "where the other one is given"
            raise InputError(
                f"Argument `axis` {of} must have no `{given[0]}` {why}, but point {n} has one; leave it out."
            )
        if point.radius is not None and (n == len(axis) or axis[n].through is not None):
            raise InputError(
                f"Argument `axis` {of} must have a `radius` at a corner between two straight parts, but point {n} is "
                "none; leave it out."
            )
    if not is_known([[one.to, one.through or (), one.radius or 0.0] for one in axis]):
        return
    points = [np.zeros(3), *(np.array(one.to, dtype=float) for one in axis)]
    apart = [float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(points)]
    for n, (point, distance) in enumerate(zip(axis, apart, strict=True), start=1):
        if distance <= SMALLEST_PIECE * max(apart):
            raise InputError(
                f"Argument `axis` {of} must lead from point to point, but point {n} is where the one before is; move "
                "or remove it (the axis begins in the origin of the link's frame)."
            )
        if point.through is not None:
            _require_arc(points[n - 1], np.array(point.through, dtype=float), points[n], f"point {n}", of)
    _require_bends(axis, points, of)


def _require_arc(first: Any, through: Any, last: Any, which: str, of: str) -> None:
    u, v = through - first, last - first
    if np.linalg.norm(np.cross(u, v)) <= LEAST_BEND * np.linalg.norm(v) * max(np.linalg.norm(u), np.linalg.norm(v)):
        raise InputError(
            f"Argument `axis` {of} must have a `through` off the line from point to point, but that of {which} is on "
            "it; leave it out where the axis is straight."
        )


def _require_bends(axis: Sequence[AxisPoint], points: Sequence[Any], of: str) -> None:
    used = 0.0  # of a leg, by the bend before
    for n, point in enumerate(axis[:-1], start=1):
        if point.radius is None:
            used = 0.0
            continue
        along, away = points[n] - points[n - 1], points[n + 1] - points[n]
        one, other = np.linalg.norm(along), np.linalg.norm(away)
        cosine = float(along @ away) / (one * other)
        back = float(point.radius) * np.sqrt(max(1.0 - cosine, 0.0) / max(1.0 + cosine, 1e-300))
        straight_on = np.arccos(np.clip(cosine, -1.0, 1.0)) <= LEAST_BEND
        if straight_on or used + back >= one or back >= other:
            raise InputError(
                f"Argument `axis` {of} must have bends that fit between its points, but that of point {n} with the "
                f"radius {float(point.radius):g} m does not; give a smaller `radius`, or none where there is no corner."
            )
        used = back
