"""What an allocation is asked for: limits, costs and bounds, checked and normalised.

Place in the pipeline: first step of the allocation.

Symbols: f metric, limit upper or lower bound of it [metric unit], headroom |limit - f(centre)| (the
unit of every margin inside), t half-widths [rad, m] between `lower` and `upper`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rfem_jax.description.errors import InputError
from rfem_jax.tolerancing.allocation_models import Quadratic
from rfem_jax.tolerancing.cost_models import assign_costs
from rfem_jax.tolerancing.evaluation import check_known, metric_index, split_errors
from rfem_jax.tolerancing.quadratic_model import choose_mode, expand_by_differences


class Limit(NamedTuple):
    """One limit: metric's name, unit and position, sign (1 upper, -1 lower), bound, headroom."""

    metric: str
    unit: str
    index: int
    sign: float
    bound: float
    nominal: float
    headroom: float

    @property
    def sense(self):
        """ "max" for an upper limit (its worst case is a maximum), "min" for a lower one."""
        return "max" if self.sign > 0 else "min"

    def normalise(self, value):
        """h = sign (value - bound) / headroom; at most 0 where the limit holds."""
        return self.sign * (value - self.bound) / self.headroom

    def restore(self, h):
        """The metric's value of a normalised h."""
        return self.bound + self.sign * h * self.headroom


@dataclass(frozen=True, eq=False)
class Request:
    """The checked request: names (k), lower, upper (k,) half-widths, limits (l), costs (k)."""

    problem: object
    names: tuple
    lower: np.ndarray
    upper: np.ndarray
    limits: tuple
    costs: tuple
    at: dict
    base: dict
    centre: np.ndarray
    model: object
    quadratic: Quadratic
    mode: str
    batch: int

    def tolerances(self, t):
        """{name: half-width} of t (k,)."""
        return dict(zip(self.names, map(float, t), strict=True))

    def normalise(self, values):
        """Values (n, m) of all metrics -> h (n, l)."""
        return np.stack([limit.normalise(values[:, limit.index]) for limit in self.limits], axis=1)

    def normalise_slopes(self, jacobian):
        """Jacobians (n, m, k) of all metrics -> those of h (n, l, k)."""
        rows = [limit.sign / limit.headroom * jacobian[:, limit.index] for limit in self.limits]
        return np.stack(rows, axis=1)


def state_request(problem, limits, cost, bounds, at, mode, batch, model=None, together=True):
    """Check and normalise a request (arguments of `allocate`). Raises InputError.

    Args: together: the slopes of all metrics are needed at every point (statistical criteria), not
        those of one (worst case); it decides the mode of the derivatives.
    """
    names, lower, upper = _read_bounds(problem, bounds)
    costs = assign_costs(cost, names)
    mode = choose_mode(mode, len(names), len(problem.metrics) if together else 1)
    if model is None:
        typical = dict(zip(names, np.sqrt(lower * upper), strict=True))
        model = expand_by_differences(problem, at, typical, mode=mode, batch=batch)
    elif model.names != names or model.hessian is None:
        raise InputError(
            "Argument `model` must be of order 2 in the errors of `bounds`, in their order, but it "
            f"has {model.names} of order {1 if model.hessian is None else 2}; leave it out."
        )
    base, centre = split_errors(problem, at, names)
    read = _read_limits(problem, limits, np.asarray(model.value))
    rows = np.array([limit.index for limit in read])
    factor = np.array([limit.sign / limit.headroom for limit in read])
    offset = [limit.normalise(limit.nominal) for limit in read]
    gradient = np.asarray(model.gradient)[rows] * factor[:, None]
    hessian = np.asarray(model.hessian)[rows] * factor[:, None, None]
    finite = all(np.all(np.isfinite(a)) for a in (offset, gradient, hessian))
    if int(model.status) != 0 or not finite:
        raise InputError(
            "Argument `limits` must be on metrics that are smooth at the centre of the "
            "tolerances, but "
            "one has no finite value, gradient or Hessian there; limit its mean square, not the "
            "root."
        )
    quadratic = Quadratic(jnp.asarray(offset), jnp.asarray(gradient), jnp.asarray(hessian))
    return Request(
        problem, names, lower, upper, read, costs, dict(at or {}), base, np.asarray(centre), model,
        quadratic, mode, batch,
    )  # fmt: skip


def _read_bounds(problem, bounds):
    if not isinstance(bounds, Mapping) or not bounds:
        raise InputError(
            f"Argument `bounds` must map names of errors to (smallest, largest) half-width, but it is {bounds!r}."
        )
    check_known(bounds, problem.error_names, "bounds")
    for name, pair in bounds.items():
        if len(pair) != 2 or not 0 < pair[0] < pair[1] < np.inf:
            raise InputError(f"Argument `bounds` must give 0 < smallest < largest, but `{name}` has {pair}.")
    lower, upper = np.array([[float(a), float(b)] for a, b in bounds.values()]).T
    return tuple(bounds), lower, upper


def _read_limits(problem, limits, nominal):
    if not isinstance(limits, Mapping) or not limits:
        raise InputError(
            f"Argument `limits` must map names of metrics to an upper limit or (lower, upper), but it is {limits!r}."
        )
    read = []
    for name, bound in limits.items():
        index = metric_index(problem, name, "limits")
        low, high = bound if isinstance(bound, (tuple, list)) else (None, bound)
        for sign, value in ((1.0, high), (-1.0, low)):
            if value is None:
                continue
            value, at = float(value), float(nominal[index])
            headroom = abs(value - at) or abs(value) or 1.0
            metric = problem.metrics[index]
            read.append(Limit(metric.name, metric.unit, index, sign, value, at, headroom))
    if not read or not all(np.isfinite(limit.bound) for limit in read):
        raise InputError("Argument `limits` must hold finite limits, but has none or a bad one; correct it.")
    return tuple(read)
