"""Worst case: the largest value of a metric over a region of tolerances (theory (10.9)).

Place in the pipeline: after a problem and tolerances; an allocation is built on it and verified by
it.

    max f(centre + M z)  over |z_i| <= 1 (box) or |z| <= 1 (ellipsoid)

Spectral projected gradient from several starts in one batch (starting_points.py says which);
beside it every corner of the box when there are few, the quadratic model's prediction and its
bound. By mirror symmetry e and -e may both be maximisers: the mirror image of the best point is
evaluated too, and every point that ties is reported.

Symbols: z (k,) errors in tolerances, e (k,) errors [rad, m], f metric; KKT residual
|P(z + grad f / spread) - z|_inf, with the spread of f over the starts and the centre as its unit
(0 at an exact maximum, of the order 1 far from one).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description.errors import InputError
from rfem_jax.tolerancing.evaluation import (
    evaluate_points,
    metric_index,
    require_float64,
    select_half_widths,
    split_errors,
)
from rfem_jax.tolerancing.layout import align_columns, show_number, wrap_lines
from rfem_jax.tolerancing.projected_gradient import climb_together
from rfem_jax.tolerancing.quadratic_model import (
    choose_mode,
    expand_by_differences,
    linearise_points,
)
from rfem_jax.tolerancing.starting_points import (
    EXHAUSTIVE,
    box_corners,
    distinct,
    maximise_quadratic,
    projection,
    quadratic_bound,
    region_matrix,
    start_points,
)

STARTS = {"corners": 4, "random": 4, "sobol": 8}
ON_BOUND = 1e-9
TIE = 1e-6


@dataclass(frozen=True, eq=False)
class Corners:
    """Every corner of the box: how many, how many failed, the best value and the errors there;
    values (count,) of all of them, NaN where one failed."""

    count: int
    failed: int
    value: float
    errors: dict
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The worst point found and how far to trust it; errors are {name: rad or m}.

    value, errors: the worst point over search and corners; found_by "search", "mirror" or
    "corners"; maximisers: every distinct point that ties with it (e and -e of an even metric), it
    included; nominal: the metric at the centre; slopes {name: df per tolerance} at the worst point;
    kkt_residual (module docstring); active {name: "lower" | "upper"} bounds of the box, or
    {"ellipsoid": "surface"}; status "ok", "not_converged" (the best search did not reach its
    tolerance) or "failed" (no start could be evaluated);
    evaluations: simulations by the searches (value with gradient) and by corners and starts (value
    alone); failed: samples that failed among the starts, corners and centre;
    starts, ends (n, k) in tolerances, end_values, residuals (n,): every search;
    corners: Corners or None; quadratic_value, quadratic_errors: maximum of the quadratic model;
    quadratic_bound: its bound in closed form (NaN where there is no model); hessian_error: the
    estimated relative error of the model's Hessian by differences (NaN where it is exact).
    """

    metric: str
    unit: str
    region: str
    sense: str
    names: tuple
    status: str
    value: float
    errors: dict
    found_by: str
    maximisers: tuple
    nominal: float
    slopes: dict
    kkt_residual: float
    active: dict
    evaluations: dict
    failed: int
    starts: np.ndarray
    ends: np.ndarray
    end_values: np.ndarray
    residuals: np.ndarray
    corners: Corners | None
    quadratic_value: float
    quadratic_errors: dict
    quadratic_bound: float
    hessian_error: float

    @property
    def scale(self):
        """The size of the metric over the region [its unit], against which rounding is nothing."""
        sizes = np.abs([self.value, *self.end_values])
        return float(np.max(sizes, where=np.isfinite(sizes), initial=0.0))

    def __str__(self):
        word = "Largest" if self.sense == "max" else "Smallest"
        head = f"{word} {self.metric} over the {self.region}: "
        head += f"{self._show(self.value)} {self.unit} (status {self.status}, found by "
        head += f"{self.found_by}, nominal {self._show(self.nominal, 5)})"
        header = ["error", "value", "bound", "slope per tolerance"]
        rows = [
            [n, show_number(self.errors[n]), self.active.get(n, ""), self._show(self.slopes[n], 5)]
            for n in self.errors
        ]
        spent = self.evaluations
        model = f"quadratic model: {self._show(self.quadratic_value)}, "
        model += f"bound {self._show(self.quadratic_bound)}"
        if np.isfinite(self.hessian_error):
            model += f" (Hessian by differences, error {self.hessian_error:.0e})"
        tail = [
            f"KKT residual {self.kkt_residual:.1e}; {len(self.maximisers)} point(s) tie; "
            f"{spent['search']} evaluations with gradient, {spent['values']} without, "
            f"{self.failed} failed",
            model,
        ]
        if self.corners is not None:
            tail.append(f"all {self.corners.count} corners: {self._show(self.corners.value)}")
        table = align_columns(header, rows) if rows else "no point"
        return "\n".join([wrap_lines(head), table, *map(wrap_lines, tail)])

    def _show(self, value, digits=7):
        return show_number(value, digits, self.scale)


def worst_case(
    problem,
    tolerances,
    metric,
    region="box",
    *,
    key,
    starts=STARTS,
    at=None,
    sense="max",
    corners="auto",
    model=None,
    mode="auto",
    evaluations=100,
    tolerance=1e-6,
    batch=256,
):
    """Maximise (or minimise) a metric over the tolerance box or ellipsoid.

    Args: tolerances a Tolerances collection or {error: half-width} [rad, m]; metric its name or the
        object; region "box" or "ellipsoid" (semi-axes the half-widths, tilted by the correlations);
        key a JAX key for random and Sobol' starts; starts {"corners", "random", "sobol": number};
        at {error: value} the centre (default the tolerances' means, else nominal); sense "max" or
        "min"; corners "auto" (all of them when k <= 12), True or False; model a QuadraticModel at
        the centre in the same errors (None: by differences of gradients, False: do without); mode
        of the gradient; evaluations the most of each search; tolerance on the KKT residual; batch
        the most samples at once.
    Returns: WorstCase. Failed samples are counted and walked around, never maximisers.
    Raises: InputError for unknown names or options.
    """
    require_float64()
    if sense not in ("max", "min"):
        raise InputError(f'Argument `sense` must be "max" or "min", but it is {sense!r}.')
    names, half_widths = select_half_widths(problem, tolerances)
    k, index = len(names), metric_index(problem, metric)
    matrix = region_matrix(region, tolerances, half_widths)
    if corners not in ("auto", True, False) or (corners is True and region != "box"):
        raise InputError(
            f"Argument `corners` must be 'auto', True (for a box) or False, but it is "
            f"{corners!r} for "
            f"the region {region!r}."
        )
    sign = 1.0 if sense == "max" else -1.0
    means = tolerances.means() if hasattr(tolerances, "means") else {}
    at = {**{name: float(mean) for name, mean in means.items()}, **(at or {})}
    mode = choose_mode(mode, k, 1)
    if model is None:
        widths = dict(zip(names, half_widths, strict=True))
        model = expand_by_differences(problem, at, widths, mode=mode, batch=batch)
    scaled = None if model is False else _scale_model(model, names, index, sign, matrix)
    keys = jax.random.split(key)
    z0 = start_points(starts, scaled, region, k, keys[0])

    base, centre = split_errors(problem, at, names)
    centre = np.asarray(centre)

    def values_at(z):
        points = centre + z @ matrix.T
        return sign * evaluate_points(problem, names, base, points, batch)[0][:, index]

    first = values_at(np.concatenate([np.zeros((1, k)), z0]))
    spread = np.nanmax(first) - np.nanmin(first) if np.any(np.isfinite(first)) else 0.0
    scale = sign * (spread if spread > 0 else 1.0)

    def function(z):
        """Values (n,) and gradients (n, k) of the metric over its scale, at points z (n, k)."""
        values, slopes, _ = linearise_points(
            problem, names, base, centre + z @ matrix.T, metric=index, mode=mode, batch=batch
        )
        return values[:, index] / scale, slopes @ matrix / scale

    search = climb_together(
        function, projection(region), z0, evaluations=evaluations, tolerance=tolerance
    )
    found = _collect(search, abs(scale), region, k, corners, values_at)
    error = getattr(model, "hessian_error", None)  # model may be False
    error = np.nan if error is None else float(error[index])
    frame = (problem.metrics[index], names, centre, matrix, scale, region, sense, error)
    return _report(frame, function, found, z0, first, scaled, keys[1], search, tolerance)


def _scale_model(model, names, index, sign, matrix):
    """(value, gradient, hessian) of one metric in z, signed so that it is to be maximised."""
    if model.names != names or model.hessian is None:
        raise InputError(
            "Argument `model` must be of order 2 in the errors of `tolerances`, in their order, "
            "but "
            f"it has {model.names} of order {1 if model.hessian is None else 2}."
        )
    value, gradient = float(model.value[index]), np.asarray(model.gradient[index])
    hessian = matrix.T @ np.asarray(model.hessian[index]) @ matrix
    return sign * value, sign * (gradient @ matrix), sign * hessian


def _collect(search, scale, region, k, corners, values_at):
    """Candidates (points, values, origins) of search, mirror images and corners, and the
    corners."""
    points = [np.asarray(search.point)]
    values = [np.asarray(search.value) * scale]
    order = distinct(points[0], values[0])[:4]
    corner_values = None
    if len(order):
        points.append(-points[0][order])
        values.append(values_at(points[1]))
    if region == "box" and (corners is True or (corners == "auto" and k <= EXHAUSTIVE)):
        points.append(box_corners(k))
        corner_values = values_at(points[-1])
        values.append(corner_values)
    origins = ["search"] * len(points[0]) + ["mirror"] * len(order)
    origins += ["corners"] * (0 if corner_values is None else len(corner_values))
    return np.concatenate(points), np.concatenate(values), origins, corner_values


def _report(frame, function, found, z0, first, scaled, key, search, tolerance):
    metric, names, centre, matrix, scale, region, sense, error = frame
    points, values, origins, corner_values = found
    sign = np.sign(scale)

    def errors_at(z):
        return dict(zip(names, map(float, centre + matrix @ z), strict=True))

    corners = None
    if corner_values is not None:
        failed = int(np.sum(~np.isfinite(corner_values)))
        best = np.nanargmax(corner_values) if failed < len(corner_values) else 0
        z = box_corners(len(names))[best]
        corners = Corners(
            len(corner_values), failed, float(sign * corner_values[best]), errors_at(z),
            sign * corner_values,
        )  # fmt: skip
    finite = np.any(np.isfinite(values))
    common = dict(
        metric=metric.name, unit=metric.unit, region=region,
        sense=sense, names=names, nominal=float(sign * first[0]), corners=corners, starts=z0,
        ends=np.asarray(search.point), residuals=np.asarray(search.residual),
        end_values=np.asarray(search.value) * scale,
        failed=int(np.sum(~np.isfinite(first))) + (corners.failed if corners else 0),
        evaluations={"search": int(np.sum(np.asarray(search.evaluations))),
                     "values": len(first) + len(points) - len(z0)},
        **_predict(scaled, sign, region, key, errors_at), hessian_error=error,
    )  # fmt: skip
    if not finite:
        return WorstCase(status="failed", value=np.nan, errors={}, found_by="none", maximisers=(),
                         slopes={}, kkt_residual=np.nan, active={}, **common)  # fmt: skip

    tied = _ties(points, values, abs(scale))
    z = points[tied[0]]
    gradient = function(z[None])[1][0]
    stepped = projection(region)(jnp.asarray(z + gradient))
    residual = float(np.max(np.abs(np.asarray(stepped) - z)))
    slopes = gradient * scale
    return WorstCase(
        status="ok" if residual <= max(tolerance, 1e-6) else "not_converged",
        value=float(sign * values[tied[0]]),
        errors=errors_at(z),
        found_by=origins[tied[0]],
        maximisers=tuple(errors_at(points[i]) for i in tied),
        slopes=dict(zip(names, map(float, slopes), strict=True)),
        kkt_residual=residual,
        active=_active(z, names, region),
        **common,
    )


def _ties(points, values, spread):
    """Indices of the best point and of the distinct ones that tie with it (searches come first)."""
    best = np.nanmax(values)
    near = np.flatnonzero(values >= best - TIE * max(spread, 1e-12 * abs(best)))
    return near[distinct(points[near], values[near])]


def _active(z, names, region):
    if region == "ellipsoid":
        return {"ellipsoid": "surface"} if np.linalg.norm(z) >= 1 - ON_BOUND else {}
    return {
        name: "upper" if x > 0 else "lower"
        for name, x in zip(names, z, strict=True)
        if abs(x) >= 1 - ON_BOUND
    }


def _predict(scaled, sign, region, key, errors_at):
    if scaled is None:
        return dict(quadratic_value=np.nan, quadratic_errors={}, quadratic_bound=np.nan)
    points, heights = maximise_quadratic(*scaled, region, key)
    bound = sign * quadratic_bound(*scaled, region)
    if not len(points):
        return dict(quadratic_value=np.nan, quadratic_errors={}, quadratic_bound=bound)
    return dict(
        quadratic_value=float(sign * heights[0]),
        quadratic_errors=errors_at(points[0]),
        quadratic_bound=bound,
    )
