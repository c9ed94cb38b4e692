"""The request of an allocation: limits, costs and bounds, checked and normalised.

Place in the pipeline: first step of the allocation.

Symbols: f metric, limit upper or lower bound of it [metric unit], headroom |limit - f(centre)| (the unit of every
margin inside), t half-widths [rad, m] and diameters of zones [m] between `lower` and `upper`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.allocation.cost_models import CostModel, assign_costs
from rfem_jax.tolerancing.allocation.models import Quadratic
from rfem_jax.tolerancing.checks import ErrorValues, error_value, read_limits
from rfem_jax.tolerancing.optimisation.sizes import Sizes, Zones, sizes_of
from rfem_jax.tolerancing.problems.evaluation import evaluate_points, metric_index, read_point, split_errors
from rfem_jax.tolerancing.problems.linearisation import choose_mode, linearise_points
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel, expand_by_differences
from rfem_jax.tolerancing.problems.sample_values import Base


class Limit(NamedTuple):
    """One limit: metric's name, unit and position, sign (1 upper, -1 lower), bound, nominal value, headroom."""

    metric: str
    unit: str
    position: int
    sign: float
    bound: float
    nominal: float
    headroom: float

    @property
    def sense(self) -> str:
        """ "max" for an upper limit (its worst case is a maximum), "min" for a lower one."""
        return "max" if self.sign > 0 else "min"

    def normalise(self, value: Any) -> Any:
        """h = sign (value - bound) / headroom of a number or an array; at most 0 where the limit holds."""
        return self.sign * (value - self.bound) / self.headroom

    def restore(self, h: float) -> float:
        """The metric's value of a normalised h."""
        return self.bound + self.sign * h * self.headroom


@dataclass(frozen=True, eq=False)
class Request:
    """The checked request: the sizes to be found (v), between lower and upper (v,), limits (l), costs (v), the centre
    `at` of the tolerances as fixed errors (`base`) and vector (k,), and the quadratic models there: `model` of the
    metrics by errors, `quadratic` of the limits by coordinates x (`sizes`)."""

    problem: ToleranceProblem
    sizes: Sizes
    lower: Float[np.ndarray, " v"]
    upper: Float[np.ndarray, " v"]
    limits: tuple[Limit, ...]
    costs: tuple[CostModel, ...]
    at: dict[str, float]
    base: Base
    centre: Float[np.ndarray, " k"]
    model: QuadraticModel
    quadratic: Quadratic
    mode: str
    batch: int

    def tolerances(self, t: Float[np.ndarray, " v"]) -> dict[str, float]:
        """{name: size} of t (v,)."""
        return dict(zip(self.sizes.names, map(float, t), strict=True))

    def unit(self, name: str) -> str:
        """SI unit of a size."""
        return "m" if name in self.sizes.zones else self.problem.error_unit(name)

    def values(self, x: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n m"]:
        """Values of all metrics at coordinates x, NaN where a sample failed."""
        points = self.centre + x @ self.sizes.matrix.T
        return evaluate_points(self.problem, self.sizes.errors, self.base, points, self.batch)[0]

    def linearise(
        self, x: Float[np.ndarray, "n k"], metric: Int[np.ndarray, " n"] | None = None
    ) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m k"] | Float[np.ndarray, "n k"]]:
        """Values of all metrics at coordinates x and their derivatives by these; with `metric` those of one each."""
        values, derivatives, _ = linearise_points(
            self.problem, self.sizes.errors, self.base, self.centre + x @ self.sizes.matrix.T,
            metric=metric, mode=self.mode, batch=self.batch,
        )  # fmt: skip
        return values, derivatives @ self.sizes.matrix

    def normalise(self, values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n l"]:
        """Values (n, m) of all metrics -> h (n, l)."""
        return np.stack([limit.normalise(values[:, limit.position]) for limit in self.limits], axis=1)

    def normalise_jacobians(self, jacobians: Float[np.ndarray, "n m k"]) -> Float[np.ndarray, "n l k"]:
        """Jacobians (n, m, k) of all metrics -> those of h (n, l, k)."""
        rows = [limit.sign / limit.headroom * jacobians[:, limit.position] for limit in self.limits]
        return np.stack(rows, axis=1)


def check_request(
    problem: ToleranceProblem,
    limits: Mapping[str, Any],
    cost: CostModel | Mapping[str, CostModel],
    bounds: Mapping[str, Sequence[float | str]],
    at: ErrorValues | None,
    mode: str,
    batch: int,
    model: QuadraticModel | None = None,
    zones: Zones | None = None,
    together: bool = True,
) -> Request:
    """Check and normalise a request (arguments of `allocate`). Raises InputError.

    Args: together: True if the derivatives of all metrics are needed at every point (statistical criteria), False for
        those of one (worst case); it decides the mode of the derivatives.
    """
    sizes, lower, upper = read_bounds(problem, bounds, zones)
    costs, names = assign_costs(cost, sizes.names), sizes.errors
    mode = choose_mode(mode, len(names), len(problem.metrics) if together else 1, problem)
    if model is None:
        typical = dict(zip(names, map(float, sizes.reaches(np.sqrt(lower * upper))), strict=True))
        model = expand_by_differences(problem, at, typical, mode=mode, batch=batch)
    elif model.names != names or model.hessian is None:
        raise InputError(
            "Argument `model` must be of order 2 in the errors of `bounds`, in their order, but it "
            f"has {model.names} of order {1 if model.hessian is None else 2}; leave it out."
        )
    base, centre = split_errors(problem, at, names)
    read = _read_limits(problem, limits, np.asarray(model.value))
    quadratic = _normalised_model(model, read, sizes.matrix)
    return Request(
        problem, sizes, lower, upper, read, costs, read_point(problem, at), base, np.asarray(centre), model,
        quadratic, mode, batch,
    )  # fmt: skip


def _normalised_model(model, limits, matrix) -> Quadratic:
    """The quadratic model of h by coordinates. Raises InputError for a metric without derivatives at the centre."""
    rows = np.array([limit.position for limit in limits])
    factor = np.array([limit.sign / limit.headroom for limit in limits])
    offset = [limit.normalise(limit.nominal) for limit in limits]
    gradient = np.asarray(model.gradient)[rows] @ matrix * factor[:, None]
    hessian = matrix.T @ np.asarray(model.hessian)[rows] @ matrix * factor[:, None, None]
    finite = all(np.all(np.isfinite(a)) for a in (offset, gradient, hessian))
    if int(model.status) != 0 or not finite:
        raise InputError(
            "Argument `limits` must be on metrics that are smooth at the centre of the tolerances, but one has no "
            "finite value, gradient or Hessian there; limit its mean square, not the root."
        )
    return Quadratic(jnp.asarray(offset), jnp.asarray(gradient), jnp.asarray(hessian))


def read_bounds(
    problem: ToleranceProblem, bounds: Mapping[str, Sequence[float | str]], zones: Zones | None
) -> tuple[Sizes, Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """The sizes to be found, and their smallest and largest values (v,) [rad or m]. Raises: InputError."""
    if not isinstance(bounds, Mapping) or not bounds:
        raise InputError(
            f"Argument `bounds` must map names of errors to (smallest, largest) half-width, but it is {bounds!r}."
        )
    sizes, pairs = sizes_of(problem, bounds, zones, "bounds"), []
    for name in sizes.names:
        pair, unit = bounds[name], "m" if name in sizes.zones else problem.error_unit(name)
        ends = [error_value(end, unit, f"`{name}` of `bounds`") for end in pair]
        if len(ends) != 2 or not 0 < ends[0] < ends[1] < np.inf:
            raise InputError(f"Argument `bounds` must give 0 < smallest < largest, but `{name}` has {pair}.")
        pairs.append(ends)
    lower, upper = np.array(pairs).T
    return sizes, lower, upper


def _read_limits(problem, limits, nominal) -> tuple[Limit, ...]:
    """Every finite end of a limit, upper before lower."""
    read = []
    for name, (low, high) in read_limits(limits, tuple(m.name for m in problem.metrics), needed=True).items():
        index = metric_index(problem, name, "limits")
        metric, at = problem.metrics[index], float(nominal[index])
        for sign, bound in ((1.0, high), (-1.0, low)):
            if np.isfinite(bound):
                headroom = abs(bound - at) or abs(bound) or 1.0
                read.append(Limit(metric.name, metric.unit, index, sign, bound, at, headroom))
    if not read:
        raise InputError("Argument `limits` must hold finite limits, but has none; add one.")
    return tuple(read)
