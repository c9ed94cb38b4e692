"""Worst case: the largest value of a metric over a region of tolerances (theory (10.9)).

Place in the pipeline: after a problem and tolerances; an allocation is built on it and verified by it.

    max f(centre + M z)  over |z_i| <= 1 (box), |z| <= 1 (ellipsoid), or |z_b| <= 1 for the zones in a box

The search is a spectral projected gradient from several starts in one batch (see starting_points.py). Every corner of
the box is evaluated where there are few, and the prediction and the bound of the quadratic model are reported beside
the result. By mirror symmetry e and -e may both be maximisers: the mirror image of the best point is evaluated too,
and every point that ties is reported.

Symbols: z (k,) errors in tolerances, e (k,) errors [rad, m], f metric; KKT residual |P(z + grad f / spread) - z|_inf,
with the spread of f over the starts and the centre as its unit (0 at an exact maximum, of the order 1 far from one).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.labelled_data import Parts, Table
from rfem_jax.tolerancing.checks import ErrorValues
from rfem_jax.tolerancing.labelled_results import LabelledWorstCase
from rfem_jax.tolerancing.layout import show_error, show_number
from rfem_jax.tolerancing.optimisation.projected_gradient import Search, climb_together
from rfem_jax.tolerancing.optimisation.starting_points import (
    EXHAUSTIVE,
    Expansion,
    Region,
    box_corners,
    distinct,
    maximise_quadratic,
    projection,
    quadratic_bound,
    region_matrix,
    region_of,
    start_points,
)
from rfem_jax.tolerancing.problems.evaluation import (
    evaluate_points,
    metric_index,
    select_half_widths,
    split_errors,
)
from rfem_jax.tolerancing.problems.linearisation import choose_mode, linearise_points
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances, distributions_of
from rfem_jax.tolerancing.problems.problem import Metric, ToleranceProblem
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel, expand_by_differences
from rfem_jax.tolerancing.problems.reproduction import require_reproduced
from rfem_jax.tolerancing.problems.sample_values import Base
from rfem_jax.tolerancing.sampling.sequences import RandomKey

STARTS = {"corners": 4, "random": 4, "sobol": 8}
ON_BOUND = 1e-9
TIE = 1e-6


@dataclass(frozen=True, eq=False)
class Corners:
    """All corners of the box: their number, how many failed, the best value and the errors there; values of all of
    them, NaN where one failed."""

    count: int
    failed: int
    value: float
    errors: dict[str, float]
    values: Float[np.ndarray, " corners"]


@dataclass(frozen=True, eq=False)
class WorstCase(LabelledWorstCase):
    """The worst point found and how far to trust it; errors are {name: rad or m}.

    status "ok", "not_converged" (the best search did not reach its tolerance) or "failed" (no start could be
    evaluated); names, error_units: of the errors, "rad" or "m" each;
    value, errors: the worst point over searches and corners; found_by "search", "mirror" or "corners";
    maximisers: every distinct point that ties with it (e and -e of an even metric), itself included; nominal: the
    metric at the centre; slopes {name: df per tolerance}: the gradient at the worst point; kkt_residual (module
    docstring); active {name: "lower" | "upper"}: bounds of the box, {"ellipsoid": "surface"} or {"zone 1":
    "surface"}, zones counted ball by ball;
    evaluations: simulations by the searches (value with gradient) and of corners and starts (value alone);
    failed: samples that failed among the starts, corners and centre;
    starts, ends (n, k) in tolerances, end_values, residuals (n,): of every search;
    corners: Corners or None; quadratic_value, quadratic_errors: maximum of the quadratic model;
    quadratic_bound: its bound in closed form (NaN where there is no model); hessian_error: the estimated relative
    error of the model's Hessian by differences (NaN where it is exact).
    """

    metric: str
    unit: str
    region: str
    sense: str
    names: tuple[str, ...]
    error_units: tuple[str, ...]
    status: str
    value: float
    errors: dict[str, float]
    found_by: str
    maximisers: tuple[dict[str, float], ...]
    nominal: float
    slopes: dict[str, float]
    kkt_residual: float
    active: dict[str, str]
    evaluations: dict[str, int]
    failed: int
    starts: Float[np.ndarray, "n k"]
    ends: Float[np.ndarray, "n k"]
    end_values: Float[np.ndarray, " n"]
    residuals: Float[np.ndarray, " n"]
    corners: Corners | None
    quadratic_value: float
    quadratic_errors: dict[str, float]
    quadratic_bound: float
    hessian_error: float

    @property
    def scale(self) -> float:
        """Size of the metric over the region [its unit]; much smaller numbers are rounding."""
        sizes = np.abs([self.value, *self.end_values])
        return float(np.max(sizes, where=np.isfinite(sizes), initial=0.0))

    def parts(self) -> Parts:
        """The worst point, and how far to trust it."""
        word = "Largest" if self.sense == "max" else "Smallest"
        head = f"{word} {self.metric} over the {self.region}: "
        head += f"{self._show(self.value)} {self.unit} (status {self.status}, found by "
        head += f"{self.found_by}, nominal {self._show(self.nominal, 5)})"
        unit = dict(zip(self.names, self.error_units, strict=True))
        header = ["error", "value", "bound", "gradient per tolerance"]
        rows = [
            [n, show_error(self.errors[n], unit[n]), self.active.get(n, ""), self._show(self.slopes[n], 5)]
            for n in self.errors
        ]
        spent = self.evaluations
        model = f"quadratic model: {self._show(self.quadratic_value)}, "
        model += f"bound {self._show(self.quadratic_bound)}"
        if np.isfinite(self.hessian_error):
            model += f" (Hessian by differences, error {self.hessian_error:.0e})"
        tail = [
            f"KKT residual {self.kkt_residual:.1e}; attained at {len(self.maximisers)} point(s); "
            f"{spent['search']} evaluations with gradient, {spent['values']} without, "
            f"{self.failed} failed",
            model,
        ]
        if self.corners is not None:
            tail.append(f"all {self.corners.count} corners: {self._show(self.corners.value)}")
        return [head, Table(header, rows) if rows else "no point", *tail]

    def _show(self, value, digits=7):
        return show_number(value, digits, self.scale)


def worst_case(
    problem: ToleranceProblem,
    tolerances: Tolerances | ErrorValues,
    metric: str | Metric,
    region: str = "box",
    *,
    key: RandomKey,
    starts: Mapping[str, int] = STARTS,
    at: ErrorValues | None = None,
    sense: str = "max",
    corners: bool | str = "auto",
    model: QuadraticModel | Literal[False] | None = None,
    mode: str = "auto",
    evaluations: int = 100,
    tolerance: float = 1e-6,
    batch: int = 256,
) -> WorstCase:
    """Maximise (or minimise) a metric over the tolerance box or ellipsoid.

    Args: tolerances, a Tolerances collection or {error: half-width}, in rad or m, or strings with a unit; metric, its
        name or the object; region "box" or "ellipsoid" (semi-axes the half-widths, tilted by the correlations); key, a
        JAX key for random and Sobol' starts; starts {"corners", "random", "sobol": number}; at {error: value}, the
        centre (default the tolerances' means, else nominal); sense "max" or "min"; corners "auto" (all of them when
        k <= 12), True or False; model, a QuadraticModel at the centre in the same errors (None: by differences of
        gradients, False: none); mode of the gradient; evaluations, the largest number of them in each search;
        tolerance on the KKT residual; batch, the most samples at once on each device.
    Returns: WorstCase. Failed samples are counted, and never maximisers.
    Raises: InputError for unknown names or options.
    """
    require_float64()
    tolerances = distributions_of(tolerances)
    _check_options(region, sense, corners)
    names, half_widths = select_half_widths(problem, tolerances)
    index, matrix = metric_index(problem, metric), region_matrix(region, tolerances, half_widths)
    searched = region_of(region, tolerances)
    _check_corners(corners, searched)
    centres = tolerances.centres() if isinstance(tolerances, Tolerances) else {}
    at = {**{name: float(centre) for name, centre in centres.items()}, **(at or {})}
    mode = choose_mode(mode, len(names), 1, problem)
    if model is None:
        widths = dict(zip(names, map(float, half_widths), strict=True))
        model = expand_by_differences(problem, at, widths, mode=mode, batch=batch)
    base, centre = split_errors(problem, at, names)
    if model is False:
        require_reproduced(problem, names, base, np.asarray(centre), half_widths, mode=mode, batch=batch)
    frame = _Frame(problem, names, base, np.asarray(centre), index, matrix, searched, sense, mode, batch)
    scaled = None if model is False else frame.scale_model(model)
    error = np.nan if model is False or model.hessian_error is None else float(model.hessian_error[index])
    keys = jax.random.split(key)
    z0 = start_points(starts, scaled, searched, len(names), keys[0])
    first = frame.values(np.concatenate([np.zeros((1, len(names))), z0]))
    spread = float(np.nanmax(first) - np.nanmin(first)) if np.any(np.isfinite(first)) else 0.0
    scale = spread if spread > 0 else 1.0
    search = climb_together(
        lambda z: frame.linearise(z, scale), projection(searched), z0, evaluations=evaluations, tolerance=tolerance
    )
    candidates = _collect(search, scale, frame, corners)
    common = _describe(frame, candidates, z0, first, search, scale)
    common |= _predict(frame, scaled, keys[1]) | {"hessian_error": error}
    return _report(frame, candidates, scale, tolerance, common)


def _check_options(region, sense, corners) -> None:
    if sense not in ("max", "min"):
        raise InputError(f'Argument `sense` must be "max" or "min", but it is {sense!r}.')
    if corners not in ("auto", True, False) or (corners is True and region != "box"):
        raise InputError(
            f"Argument `corners` must be 'auto', True (for a box) or False, but it is {corners!r} for "
            f"the region {region!r}."
        )


def _check_corners(corners, region: Region) -> None:
    if corners is True and isinstance(region, tuple):
        raise InputError(
            "Argument `corners` must be 'auto' or False for tolerances with zones, which have no corners, but is True."
        )


@dataclass(frozen=True, eq=False)
class _Frame:
    """The metric as a function to be maximised of z: e = centre + M z, with the sign of `sense`."""

    problem: ToleranceProblem
    names: tuple[str, ...]
    base: Base
    centre: Float[np.ndarray, " k"]
    index: int
    matrix: Float[np.ndarray, "k k"]
    region: Region
    sense: str
    mode: str
    batch: int

    @property
    def sign(self) -> float:
        """1 for a maximum, -1 for a minimum."""
        return 1.0 if self.sense == "max" else -1.0

    def errors(self, z: Float[np.ndarray, " k"]) -> dict[str, float]:
        """{name: error [rad or m]} of a point z."""
        return dict(zip(self.names, map(float, self.centre + self.matrix @ z), strict=True))

    def values(self, z: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """Values at points z (n, k), NaN where a sample failed."""
        points = self.centre + z @ self.matrix.T
        values, _ = evaluate_points(self.problem, self.names, self.base, points, self.batch)
        return self.sign * values[:, self.index]

    def linearise(
        self, z: Float[np.ndarray, "n k"], scale: float
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        """Values (n,) and gradients (n, k), divided by `scale`, at points z (n, k)."""
        values, gradients, _ = linearise_points(
            self.problem, self.names, self.base, self.centre + z @ self.matrix.T,
            metric=self.index, mode=self.mode, batch=self.batch,
        )  # fmt: skip
        scale = self.sign * scale
        return values[:, self.index] / scale, gradients @ self.matrix / scale

    def scale_model(self, model: QuadraticModel) -> Expansion:
        """Value, gradient and Hessian of the metric in z. Raises InputError for a model that does not fit."""
        if model.names != self.names or model.hessian is None:
            raise InputError(
                "Argument `model` must be of order 2 in the errors of `tolerances`, in their order, but it has "
                f"{model.names} of order {1 if model.hessian is None else 2}."
            )
        value, gradient = float(model.value[self.index]), np.asarray(model.gradient[self.index])
        hessian = self.matrix.T @ np.asarray(model.hessian[self.index]) @ self.matrix
        return self.sign * value, self.sign * (gradient @ self.matrix), self.sign * hessian


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Points (n, k) in z, their values (n,) and origins: ends of searches, mirror images, corners; the values of the
    corners alone, None without."""

    points: Float[np.ndarray, "n k"]
    values: Float[np.ndarray, " n"]
    origins: list[str]
    corners: Float[np.ndarray, " corners"] | None


def _collect(search: Search, scale, frame, corners) -> _Candidates:
    k = len(frame.names)
    points = [np.asarray(search.point)]
    values = [np.asarray(search.value) * scale]
    order = distinct(points[0], values[0])[:4]
    corner_values = None
    if len(order):
        points.append(-points[0][order])
        values.append(frame.values(points[1]))
    if frame.region == "box" and (corners is True or (corners == "auto" and k <= EXHAUSTIVE)):
        points.append(box_corners(k))
        corner_values = frame.values(points[-1])
        values.append(corner_values)
    origins = ["search"] * len(points[0]) + ["mirror"] * len(order)
    origins += ["corners"] * (0 if corner_values is None else len(corner_values))
    return _Candidates(np.concatenate(points), np.concatenate(values), origins, corner_values)


def _best_corner(frame, values) -> Corners | None:
    if values is None:
        return None
    failed = int(np.sum(~np.isfinite(values)))
    best = np.nanargmax(values) if failed < len(values) else 0
    errors = frame.errors(box_corners(len(frame.names))[best])
    return Corners(len(values), failed, float(frame.sign * values[best]), errors, frame.sign * values)


def _describe(frame, candidates, z0, first, search, scale) -> dict[str, Any]:
    """Fields of the result that do not depend on the worst point."""
    metric = frame.problem.metrics[frame.index]
    corners = _best_corner(frame, candidates.corners)
    return {
        "metric": metric.name,
        "unit": metric.unit,
        "region": "box with zones" if isinstance(frame.region, tuple) else frame.region,
        "sense": frame.sense,
        "names": frame.names,
        "error_units": tuple(frame.problem.error_unit(name) for name in frame.names),
        "nominal": float(frame.sign * first[0]),
        "corners": corners,
        "starts": z0,
        "ends": np.asarray(search.point),
        "residuals": np.asarray(search.residual),
        "end_values": np.asarray(search.value) * (frame.sign * scale),
        "failed": int(np.sum(~np.isfinite(first))) + (corners.failed if corners else 0),
        "evaluations": {
            "search": int(np.sum(np.asarray(search.evaluations))),
            "values": len(first) + len(candidates.points) - len(z0),
        },
    }


def _report(frame, candidates, scale, tolerance, common: dict[str, Any]) -> WorstCase:
    points, values = candidates.points, candidates.values
    if not np.any(np.isfinite(values)):
        return WorstCase(
            status="failed", value=np.nan, errors={}, found_by="none", maximisers=(), slopes={}, kkt_residual=np.nan,
            active={}, **common,
        )  # fmt: skip
    tied = _ties(points, values, scale)
    z = points[tied[0]]
    gradient = frame.linearise(z[None], scale)[1][0]
    stepped = projection(frame.region)(jnp.asarray(z + gradient))
    residual = float(np.max(np.abs(np.asarray(stepped) - z)))
    slopes = gradient * (frame.sign * scale)
    return WorstCase(
        status="ok" if residual <= max(tolerance, 1e-6) else "not_converged",
        value=float(frame.sign * values[tied[0]]),
        errors=frame.errors(z),
        found_by=candidates.origins[tied[0]],
        maximisers=tuple(frame.errors(points[i]) for i in tied),
        slopes=dict(zip(frame.names, map(float, slopes), strict=True)),
        kkt_residual=residual,
        active=_active(z, frame.names, frame.region),
        **common,
    )


def _ties(points, values, spread) -> np.ndarray:
    """Indices of the best point and of the distinct ones that tie with it (searches come first)."""
    best = np.nanmax(values)
    near = np.flatnonzero(values >= best - TIE * max(spread, 1e-12 * abs(best)))
    return near[distinct(points[near], values[near])]


def _active(z, names, region) -> dict[str, str]:
    if isinstance(region, tuple):
        parts = np.split(z, np.cumsum(region)[:-1])
        alone = region.count(1)  # they come first
        balls = enumerate(parts[alone:], start=1)
        found = {f"zone {number}": "surface" for number, part in balls if np.linalg.norm(part) >= 1 - ON_BOUND}
        return _active(z[:alone], names[:alone], "box") | found
    if region == "ellipsoid":
        return {"ellipsoid": "surface"} if np.linalg.norm(z) >= 1 - ON_BOUND else {}
    return {name: "upper" if x > 0 else "lower" for name, x in zip(names, z, strict=True) if abs(x) >= 1 - ON_BOUND}


def _predict(frame, scaled: Expansion | None, key) -> dict[str, Any]:
    """Maximum and bound of the quadratic model: fields of the result."""
    if scaled is None:
        return {"quadratic_value": np.nan, "quadratic_errors": {}, "quadratic_bound": np.nan}
    points, heights = maximise_quadratic(*scaled, frame.region, key)
    bound = frame.sign * quadratic_bound(*scaled, frame.region)
    if not len(points):
        return {"quadratic_value": np.nan, "quadratic_errors": {}, "quadratic_bound": bound}
    return {
        "quadratic_value": float(frame.sign * heights[0]),
        "quadratic_errors": frame.errors(points[0]),
        "quadratic_bound": bound,
    }
