"""Metrics of the paths of points: places and their errors, deviations from the perfect path, straightness, circularity.

Place in the pipeline: metric_catalogue -> **path_metrics**, which registers them when the package is imported.

A metric of an instant is of the end of the run, or of "POINT@TIME" or "POINT@VALUE", as "P@0.3s.x" and "P@90deg.x": of
the first instant at which the coordinate of the first drive has that value. Between saved times paths are cubics by
their places and velocities. Deviations are from the path of the mechanism without errors at the same time; at an
instant that the drive's coordinate names, from its place at the same coordinate. Source: theory (8.20) to (8.25).
"""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.metrics.catalogue import BELOW, MetricKind, add_metric, p_norm

COMPARED = 33  # coordinates of the drive in a turn
FEWEST = 4  # places that a line or a circle is sought of
OF_SAVED = "of the places at the saved times, too small where these are few: see `save_every`"
SLOW = 0.01  # of the largest speed: a point that is slower dwells
# Of a point of which a study asks for no metric.
REPORTED = (
    "max_deviation", "rms_deviation", "rms_deviation_along", "rms_deviation_across", "rms_deviation_out_of_plane",
    "max_angle_deviation",
)  # fmt: skip
ROUNDING = 1e-13  # m, rad: of places and angles
_HALVINGS, _SQUARINGS = 40, 20
_WITH_UNIT = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\s*[A-Za-z]+$")
OUT_OF_PLANE = {"xz": (0.0, 1.0, 0.0), "xy": (0.0, 0.0, 1.0)}

Times3 = Float[Array, "times 3"]


class PathInstant(NamedTuple):
    """What "POINT@INSTANT" names: the point; "end", "time" or "drive"; the time [s], or the coordinate [rad, m]."""

    point: str
    kind: str
    value: float


def path_instant(owner: str) -> PathInstant:
    """Point and instant of "P", "P@0.3s" or "P@90deg". Raises InputError."""
    point, at, text = owner.partition("@")
    if not at:
        return PathInstant(point, "end", 0.0)
    for dimension, kind in (("time", "time"), ("angle", "drive"), ("length", "drive")):
        try:
            if _WITH_UNIT.match(text):
                return PathInstant(point, kind, quantity(text, dimension, "metrics"))
        except InputError:
            continue  # a unit of another dimension
    raise InputError(
        "Argument `metrics` must name an instant of a path by a time, or by an angle or a displacement of the drive, "
        f"with its unit, but {owner!r} has {text!r}; write for example {point}@0.3s or {point}@90deg."
    )


class _Between(NamedTuple):
    """A place between two saved times: the number of the one before, the share of the interval, its length [s]; whether
    the run has it."""

    before: Array
    share: Array
    length: Array
    there: Array


def _cubic(at: _Between, values: Float[Array, "times ..."], rates: Float[Array, "times ..."]) -> Float[Array, "..."]:
    """a + s u + s^2 (3 (b - a) - 2 u - v) + s^3 (2 (a - b) + u + v): values a, b and rates u, v at both ends."""
    (a, b), (u, v) = (values[at.before + i] for i in (0, 1)), (at.length * rates[at.before + i] for i in (0, 1))
    s = at.share
    return a + s * (u + s * (3.0 * (b - a) - 2.0 * u - v + s * (2.0 * (a - b) + u + v)))


def _at_time(times: Float[Array, " times"], time: float) -> _Between:
    """Where a time lies among the saved ones."""
    k = jnp.clip(jnp.searchsorted(times, time, side="right") - 1, 0, times.shape[0] - 2)
    length = times[k + 1] - times[k]
    share = jnp.where(length > 0.0, (time - times[k]) / jnp.where(length > 0.0, length, 1.0), 0.0)
    # The last saved time may differ from the duration by rounding.
    return _Between(k, share, length, (time >= times[0]) & (time <= times[-1] * (1.0 + 1e-12)))


def _at_coordinate(
    times: Float[Array, " times"], values: Float[Array, " times"], rates: Float[Array, " times"], wanted: float | Array
) -> _Between:
    """Where a coordinate has a value for the first time."""
    passed = (values[:-1] - wanted) * (values[1:] - wanted) <= 0.0
    k = jnp.argmax(passed)
    start = _Between(k, jnp.zeros(()), times[k + 1] - times[k], jnp.any(passed))
    fixed, fixed_values, fixed_rates = jax.lax.stop_gradient((start, values, rates))
    sign = jnp.sign(fixed_values[k + 1] - fixed_values[k])

    def halve(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        below = sign * (_cubic(fixed._replace(share=middle), fixed_values, fixed_rates) - wanted) < 0.0
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros(()), jnp.ones(())))
    share = 0.5 * (low + high)
    for _ in range(2):  # from the solution each step of Newton's method adds an order of its derivatives
        reached, slope = jax.jvp(
            lambda s: _cubic(start._replace(share=s), values, rates) - wanted, (share,), (jnp.ones(()),)
        )
        share = share - reached / jnp.where(slope == 0.0, 1.0, slope)
    return start._replace(share=share)


def _of_instant(run: Any, owner: str, values: Callable[[Any], tuple[Array, Array]], perfect: bool = False) -> Array:
    """Values (n,) at the instant of an owner, by values and rates (times, n) of a path; NaN where the run has no such
    instant; `perfect`: of the perfect mechanism."""
    point, kind, value = path_instant(owner)
    known = run.recorded[f"{point}.perfect_path"] if perfect else None
    path = run.points[point] if known is None else known.path
    found, rates = (jnp.asarray(x) for x in values(path))
    if kind == "end":
        return found[-1]
    times = jnp.asarray(run.times)
    if kind == "time":
        at = _at_time(times, value)
    elif known is None:
        at = _at_coordinate(times, jnp.asarray(run.motion.angle), jnp.asarray(run.motion.rate), value)
    else:
        at = _at_coordinate(times, jnp.asarray(known.drive_position), jnp.asarray(known.drive_rate), value)
    return jnp.where(at.there, _cubic(at, found, rates), jnp.nan)


def _place(path: Any) -> tuple[Any, Any]:
    return path.position, path.velocity


def _angles(path: Any, plane: str) -> tuple[Array, Array]:
    """Angles (times, 3) of `angles_of_rotation`, and their rates."""
    rotation, spin = jnp.asarray(path.rotation), jnp.asarray(path.angular_velocity)
    if plane == "xy":
        found = _angles_in_xz(_in_xz(rotation), _components_in_xz(spin))
        return _components_in_xy(found[0]), _components_in_xy(found[1])
    return _angles_in_xz(rotation, spin)


def _angles_in_xz(rotation: Float[Array, "times 3 3"], spin: Times3) -> tuple[Times3, Times3]:
    """Angles of rotation = R_y R_z R_x, and their rates."""
    angles = angles_of_rotation(rotation)
    (sy, cy), (sz, cz) = ((jnp.sin(angles[..., i]), jnp.cos(angles[..., i])) for i in (1, 2))
    # spin = y e_y + z (R_y e_z) + x (R_y R_z e_x), solved for the rates.
    in_plane, rate_z = cy * spin[..., 0] - sy * spin[..., 2], sy * spin[..., 0] + cy * spin[..., 2]
    rate_x = in_plane / cz
    return angles, jnp.stack([rate_x, spin[..., 1] - rate_x * sz, rate_z], axis=-1)


def _components_in_xz(vectors: Float[Array, "*times 3"]) -> Float[Array, "*times 3"]:
    """Components of vectors along x, z and -y, which are x, y and z of a mechanism in the plane of x and y that is
    turned into that of x and z."""
    return jnp.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], axis=-1)


def _components_in_xy(vectors: Float[Array, "*times 3"]) -> Float[Array, "*times 3"]:
    """The inverse of `_components_in_xz`."""
    return jnp.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)


def _in_xz(rotation: Float[Array, "*times 3 3"]) -> Float[Array, "*times 3 3"]:
    """A rotation, of a mechanism that is turned likewise."""
    rows = _components_in_xz(rotation)
    return jnp.swapaxes(_components_in_xz(jnp.swapaxes(rows, -1, -2)), -1, -2)


def angles_of_rotation(rotation: Float[Array, "*times 3 3"], plane: str = "xz") -> Float[Array, "*times 3"]:
    """Angles [rad] about x, y and z with rotation = R_y R_z R_x, in the plane of x and y with rotation = R_z R_-y R_x:
    the first of these is the turn in the plane of a planar mechanism, continuous over time (theory (8.20))."""
    if plane == "xy":
        return _components_in_xy(angles_of_rotation(_in_xz(rotation)))
    about_y = jnp.arctan2(-rotation[..., 2, 0], rotation[..., 0, 0])
    about_z = jnp.arcsin(jnp.clip(rotation[..., 1, 0], -1.0, 1.0))
    about_x = jnp.arctan2(-rotation[..., 1, 2], rotation[..., 1, 1])
    return jnp.stack([about_x, jnp.unwrap(about_y, axis=-1), about_z], axis=-1)


def _wrapped(angle: Array) -> Array:
    """Angles from -pi to pi."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def _both(run: Any, owner: str) -> tuple[Any, Any]:
    """The path of a point, and that of the perfect mechanism."""
    point = owner.partition("@")[0]
    return run.points[point], run.recorded[f"{point}.perfect_path"].path


def _deviation(run: Any, owner: str) -> Times3:
    path, perfect = _both(run, owner)
    return jnp.asarray(path.position) - perfect.position


def _deviation_at(run: Any, owner: str) -> Float[Array, "3"]:
    return _of_instant(run, owner, _place) - _of_instant(run, owner, _place, perfect=True)


def _angle_deviation_at(run: Any, owner: str) -> Float[Array, "3"]:
    return _wrapped(_of_angles(run, owner) - _of_angles(run, owner, perfect=True))


def _root(square: Array) -> Array:
    """The root of a square; it and its derivative are zero where the square is rounding, by which two runs without
    errors may differ, and which has no direction."""
    vanish = square <= ROUNDING**2
    return jnp.where(vanish, 0.0, jnp.sqrt(jnp.where(vanish, 1.0, square)))


def _mean_over_time(run: Any, values: Float[Array, " times"]) -> Float[Array, ""]:
    """Mean by the trapezoidal rule."""
    times = jnp.asarray(run.times)
    return jnp.sum(0.5 * (values[1:] + values[:-1]) * (times[1:] - times[:-1])) / (times[-1] - times[0])


def _squared_parts(run: Any, owner: str) -> tuple[Array, Array, Array]:
    """Squares (times,) of the deviation along the perfect path, across it, and out of the plane (theory (8.22))."""
    deviation, speed = _deviation(run, owner), jnp.asarray(_both(run, owner)[1].velocity)
    square = jnp.sum(speed**2, axis=1, keepdims=True)
    tangent = jnp.where(square > 0.0, speed, 0.0) / jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    normal = jnp.asarray(OUT_OF_PLANE[_both(run, owner)[0].plane])[None]
    normal = normal - tangent * jnp.sum(tangent * normal, axis=1, keepdims=True)
    length = jnp.sum(normal**2, axis=1, keepdims=True)
    normal = normal / jnp.sqrt(jnp.where(length > 0.0, length, 1.0))
    along, out = (jnp.sum(deviation * one, axis=1) ** 2 for one in (tangent, normal))
    return along, jnp.maximum(jnp.sum(deviation**2, axis=1) - along - out, 0.0), out


def _turned(run: Any, owner: str) -> Float[Array, " times"]:
    """Squares of the angle [rad^2] by which the link is turned from where the perfect one is: 4 sin^2(angle / 2)."""
    path, perfect = _both(run, owner)
    half = 0.125 * jnp.sum((jnp.asarray(path.rotation) - perfect.rotation) ** 2, axis=(1, 2))  # sin^2(angle / 2)
    small = half < 1e-8
    angle = 2.0 * jnp.arcsin(jnp.sqrt(jnp.where(small, 0.25, jnp.minimum(half, 1.0))))
    return jnp.where(small, 4.0 * half * (1.0 + half / 3.0), angle**2)


def _centred(run: Any, point: str) -> tuple[Times3, Float[Array, "3 3"]]:
    """Places from their mean, and the mean of their outer products."""
    places = jnp.asarray(run.points[point.partition("@")[0]].position)
    if places.shape[0] < FEWEST:  # any of these are straight, or round
        places = places * jnp.nan
    places = places - jnp.mean(places, axis=0)[None]
    return places, places.T @ places / places.shape[0]


def _largest_direction(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The eigenvector of the largest eigenvalue of a matrix that is not negative, by squaring it again and again: it
    has derivatives where the two others are equal, as of a straight path."""
    trace = jnp.trace(matrix)
    power = matrix / jnp.where(trace > 0.0, trace, 1.0)
    for _ in range(_SQUARINGS):
        power = power @ power
        trace = jnp.trace(power)
        power = power / jnp.where(trace > 0.0, trace, 1.0)
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    square = jnp.sum(column**2)
    return column / jnp.sqrt(jnp.where(square > 0.0, square, 1.0))


def _squares_from_line(run: Any, point: str) -> Float[Array, " times"]:
    """Squared distances of the places from their line of least squares."""
    places, spread = _centred(run, point)
    direction = _largest_direction(spread)
    return jnp.sum((places - jnp.outer(places @ direction, direction)) ** 2, axis=1)


def _circularity(run: Any, point: str) -> Float[Array, ""]:
    """Largest less smallest distance from the centre of the circle of least squares in the plane of the path."""
    places, spread = _centred(run, point)
    # The normal of the plane: the columns of the adjugate are products of the two others, here crossed.
    crossed = jnp.stack([jnp.cross(spread[:, (i + 1) % 3], spread[:, (i + 2) % 3]) for i in range(3)], axis=1)
    normal = _largest_direction(crossed)
    in_plane = places - jnp.outer(places @ normal, normal)
    moment = jnp.mean(jnp.sum(in_plane**2, axis=1)[:, None] * in_plane, axis=0)
    # 2 C c = mean(|p|^2 p), with what is missing along the normal.
    centre = jnp.linalg.solve(2.0 * (spread + jnp.trace(spread) * jnp.outer(normal, normal)), moment)
    distance = _root(jnp.sum((in_plane - centre[None]) ** 2, axis=1))
    return jnp.max(distance) - jnp.min(distance)


def _repeatability(run: Any, owner: str) -> Float[Array, ""]:
    """Largest distance between places in the last turn of the drive and in the turn before, at equal coordinates; NaN
    with fewer turns."""
    path, times = run.points[owner.partition("@")[0]], jnp.asarray(run.times)
    angle, rate = jnp.asarray(run.motion.angle), jnp.asarray(run.motion.rate)
    position, velocity = jnp.asarray(path.position), jnp.asarray(path.velocity)
    turn = 2.0 * jnp.pi * jnp.sign(jax.lax.stop_gradient(angle[-1] - angle[0]))
    last = jax.lax.stop_gradient(angle[-1]) - turn * jnp.linspace(0.0, 1.0, COMPARED)

    def place(coordinate: Array) -> Array:
        at = _at_coordinate(times, angle, rate, coordinate)
        return jnp.where(at.there, _cubic(at, position, velocity), jnp.nan)

    here, before = jax.vmap(place)(last), jax.vmap(place)(last - turn)
    return _root(jnp.max(jnp.sum((here - before) ** 2, axis=1)))


def _dwell(run: Any, point: str) -> Float[Array, ""]:
    """Time in which the speed, linear between saved times, is below a hundredth of its largest."""
    speed = _root(jnp.sum(jnp.asarray(run.points[point.partition("@")[0]].velocity) ** 2, axis=1))
    limit, times = SLOW * jnp.max(speed), jnp.asarray(run.times)
    low, high = jnp.minimum(speed[1:], speed[:-1]), jnp.maximum(speed[1:], speed[:-1])
    rising = high > low
    below = jnp.where(rising, (limit - low) / jnp.where(rising, high - low, 1.0), jnp.where(low < limit, 1.0, 0.0))
    return jnp.sum(jnp.clip(below, 0.0, 1.0) * (times[1:] - times[:-1]))


def _add(
    name: str,
    unit: str,
    label: str,
    function: Callable[[Any, str], Array],
    description: str,
    *,
    even: bool | None = True,
    perfect: bool = False,
    nonnegative: bool = True,
    **more: Any,
) -> None:
    """A metric of points; `perfect`: it reads the path of the perfect mechanism, too."""
    records = ("{owner}.perfect_path",) if perfect else ()
    kind = MetricKind(name, unit, function, label, even, "point", nonnegative, None, records, description, None, **more)
    add_metric(kind)


def _add_of_instants() -> None:
    """Components of place, angle and their deviations at an instant."""
    families = (
        ("", "m", _of_place, False, "coordinate of the point", ""),
        (
            "deviation_",
            "m",
            _deviation_at,
            True,
            "coordinate of the point less that of the perfect mechanism",
            "(8.21)",
        ),
        ("angle_", "rad", _of_angles, False, "angle of the link at the point, of R_y R_z R_x", "(8.20)"),
        ("angle_deviation_", "rad", _angle_deviation_at, True, "angle less that of the perfect mechanism", "(8.20)"),
    )
    for before, unit, values, perfect, meaning, equation in families:
        for i, axis in enumerate("xyz"):
            # Out of the plane places, and within it angles of the others, change their sign with the errors.
            even = (axis != "y") == (unit == "m")
            _add(
                f"{before}{axis}", unit, f"{before.replace('_', ' ')}{axis} of {{point}}",
                lambda run, owner, i=i, values=values: values(run, owner)[i],
                f"{axis}: {meaning}, at the end or at the instant that is named", even=True if even else None,
                perfect=perfect, nonnegative=False, equation=equation, instant=True,
                at_rest=True,
            )  # fmt: skip


def _of_place(run: Any, owner: str) -> Array:
    return _of_instant(run, owner, _place)


def _of_angles(run: Any, owner: str, perfect: bool = False) -> Array:
    plane = run.points[owner.partition("@")[0]].plane
    return _of_instant(run, owner, lambda path: _angles(path, plane), perfect)


def _mean_square_deviation(run: Any, owner: str) -> Array:
    return _mean_over_time(run, jnp.sum(_deviation(run, owner) ** 2, axis=1))


def _add_deviations() -> None:
    """Deviations over the whole path."""
    of = "of the distance from where the perfect mechanism has the point at the same time"
    _add("deviation", "m", "deviation of {point}", lambda run, owner: _root(jnp.sum(_deviation_at(run, owner) ** 2)),
         "distance from the place of the perfect mechanism, at the end or at the instant that is named", perfect=True,
         equation="(8.21)", instant=True, at_rest=True)  # fmt: skip
    _add("mean_square_deviation", "m^2", "mean square deviation of {point}", _mean_square_deviation,
         f"mean square over time {of}", perfect=True, equation="(8.21)")  # fmt: skip
    _add("rms_deviation", "m", "RMS deviation of {point}",
         lambda run, owner: _root(_mean_square_deviation(run, owner)), f"root of the mean square over time {of}",
         perfect=True, equation="(8.21)")  # fmt: skip
    _add("max_deviation", "m", "largest deviation of {point}",
         lambda run, owner: _root(jnp.max(jnp.sum(_deviation(run, owner) ** 2, axis=1))),
         f"largest saved value {of}", perfect=True, kinked=True, note=OF_SAVED, equation="(8.21)",
         at_rest=True)  # fmt: skip
    _add("peak_deviation", "m", "16-norm of the deviation of {point}, below its maximum",
         lambda run, owner: p_norm(_deviation(run, owner)), f"{BELOW}, {of}", perfect=True,
         note=f"{BELOW}, which is `max_deviation`", equation="(8.7)", at_rest=True)  # fmt: skip
    for i, (name, words) in enumerate(
        (("along", "along the perfect path"), ("across", "across the perfect path, within the plane"),
         ("out_of_plane", "out of the plane of the mechanism"))
    ):  # fmt: skip
        _add(f"rms_deviation_{name}", "m", f"RMS deviation of {{point}} {words}",
             lambda run, owner, i=i: _root(_mean_over_time(run, _squared_parts(run, owner)[i])),
             f"root of the mean square over time of the deviation {words}", perfect=True,
             equation="(8.22)")  # fmt: skip
    turned = "of the angle between the link at the point and that of the perfect mechanism"
    _add("rms_angle_deviation", "rad", "RMS angle deviation at {point}",
         lambda run, owner: _root(_mean_over_time(run, _turned(run, owner))),
         f"root of the mean square over time {turned}", perfect=True, equation="(8.23)")  # fmt: skip
    _add("max_angle_deviation", "rad", "largest angle deviation at {point}",
         lambda run, owner: _root(jnp.max(_turned(run, owner))), f"largest saved value {turned}", perfect=True,
         kinked=True, equation="(8.23)", at_rest=True)  # fmt: skip


def _length_of(part: str) -> Callable[[Any, str], Array]:
    """Largest length of a vector of the path."""
    return lambda run, owner: _root(
        jnp.max(jnp.sum(jnp.asarray(getattr(run.points[owner.partition("@")[0]], part)) ** 2, axis=1))
    )


def _add_shapes() -> None:
    """Of the path alone."""
    _add("max_speed", "m/s", "largest speed of {point}", _length_of("velocity"), "largest saved speed of the point",
         kinked=True)  # fmt: skip
    _add("max_acceleration", "m/s^2", "largest acceleration of {point}", _length_of("acceleration"),
         "largest saved acceleration of the point", kinked=True)  # fmt: skip
    _add("straightness", "m", "straightness of the path of {point}",
         lambda run, point: 2.0 * _root(jnp.max(_squares_from_line(run, point))),
         "diameter of the cylinder about the line of least squares that holds all saved places", kinked=True,
         note=OF_SAVED, equation="(8.24)")  # fmt: skip
    _add("rms_straightness", "m", "RMS distance of {point} from a straight line",
         lambda run, point: _root(jnp.mean(_squares_from_line(run, point))),
         "root of the mean square distance of the saved places from their line of least squares",
         equation="(8.24)")  # fmt: skip
    _add("circularity", "m", "circularity of the path of {point}", _circularity,
         "largest less smallest distance of the saved places, projected to the plane that is nearest to them, from the "
         "centre of their circle of least squares", kinked=True, note=OF_SAVED, equation="(8.25)")  # fmt: skip
    _add("repeatability", "m", "repeatability of the path of {point}", _repeatability,
         "largest distance between the places at equal coordinates of the first drive in its last turn and in the turn "
         "before; no value before two turns", kinked=True, equation="(8.29)")  # fmt: skip
    _add("dwell", "s", "dwell of {point}", _dwell,
         "time in which the point is slower than a hundredth of its largest speed")  # fmt: skip


_add_of_instants()
_add_deviations()
_add_shapes()
