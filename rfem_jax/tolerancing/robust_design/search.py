"""The best point of a smooth objective under constraints in the unit cube, and how well it is one.

Place in the pipeline: criteria -> **search** -> optimisation.

Sequential quadratic programming (SciPy's SLSQP: D. Kraft, A software package for sequential quadratic programming,
DFVLR-FB 88-28, 1988) with exact derivatives.  The multipliers come afterwards from the conditions of Karush, Kuhn and
Tucker, by least squares without negative ones; what is left of the conditions is the residual.

Symbols: y (p,) variables; c objective, of the order of one; g (q,) constraints, at most 0.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize, nnls

STATIONARY = 1e-8  # residual of the conditions of optimality at which a search ends
PROGRESS = 1e-7  # a search also ends where nothing became better by this within so many
PATIENCE = 15  # evaluations: simulations are exact to the tolerance of their Newton method only
PENALTY = 10.0  # of a violated constraint, where points are compared
NEAR = 1e-3  # a violation below this is small enough for multipliers
EXACT = 1e-9  # largest constraint of an exact solution
ACTIVE = 1e-5  # a constraint nearer to its limit than this is active
HOLDS = 1e-6  # a constraint above this does not hold

Evaluation = tuple[float, Float[np.ndarray, " p"], Float[np.ndarray, " q"], Float[np.ndarray, "q p"]]


class Found(NamedTuple):
    """The end of a search: y (p,), objective, constraints (q,), their multipliers (q,), the KKT residual |grad L|_inf
    (that of bounds included), and the number of steps."""

    y: Float[np.ndarray, " p"]
    objective: float
    constraints: Float[np.ndarray, " q"]
    multipliers: Float[np.ndarray, " q"]
    residual: float
    steps: int

    @property
    def violation(self) -> float:
        """The largest constraint, 0 if all hold."""
        return float(np.max(self.constraints, initial=0.0))

    @property
    def feasible(self) -> bool:
        """Whether all constraints hold."""
        return self.violation <= HOLDS


def minimise_within(
    function: Callable[[Float[np.ndarray, " p"]], Evaluation],
    start: Float[np.ndarray, " p"],
    *,
    most: int = 100,
    stationary: float = STATIONARY,
) -> Found:
    """Minimise an objective under constraints in the unit cube.

    Arguments: function, y -> (objective, its gradient, constraints, their derivatives), cheap where it is asked again
    for the last y; start; most, number of steps; stationary, the residual at which it ends.
    """
    watched = _Watched(function, stationary)
    with suppress(_Ended):
        minimize(
            lambda y: watched(y)[0],
            start,
            jac=lambda y: watched(y)[1],
            bounds=[(0.0, 1.0)] * len(start),
            constraints={"type": "ineq", "fun": lambda y: -watched(y)[2], "jac": lambda y: -watched(y)[3]},
            method="SLSQP",
            callback=lambda _: watched.count_step(),
            options={"maxiter": most, "ftol": 1e-12},
        )
    y = watched.best
    objective, _, constraints, _ = function(y)
    multipliers, residual = multipliers_at(y, function(y))
    return Found(y, float(objective), constraints, multipliers, residual, watched.steps)


class _Ended(Exception):
    """A search has nothing more to find."""


class _Watched:
    """A function and the best point at which it was evaluated; raises `_Ended` where a search should end.

    Points are compared by an exact penalty: objective + weight times violation, a weight above the multipliers.
    """

    def __init__(self, function: Callable[[Float[np.ndarray, " p"]], Evaluation], stationary: float):
        self.function, self.stationary = function, stationary
        self.steps, self.idle, self.weight = 0, 0, PENALTY
        self.last, self.best, self.at_best = b"", np.zeros(0), (np.inf, 0.0)

    def __call__(self, y: Float[np.ndarray, " p"]) -> Evaluation:
        y = np.clip(y, 0.0, 1.0)
        found = self.function(y)
        if y.tobytes() == self.last:
            return found
        self.last = y.tobytes()
        violation = max(float(np.max(found[2], initial=0.0)), 0.0)
        if violation < NEAR:
            multipliers, residual = multipliers_at(y, found)
            self.weight = max(self.weight, 2.0 * float(multipliers.sum()))
            if violation <= EXACT and residual <= self.stationary:
                self.best = y
                raise _Ended
        better = self._merit(*self.at_best) - self._merit(float(found[0]), violation)
        self.idle = 0 if better > PROGRESS else self.idle + 1
        if better > 0.0:
            self.best, self.at_best = y, (float(found[0]), violation)
        if self.idle >= PATIENCE:
            raise _Ended
        return found

    def _merit(self, objective: float, violation: float) -> float:
        return objective + self.weight * violation

    def count_step(self) -> None:
        self.steps += 1


def least_violation(
    function: Callable[[Float[np.ndarray, " p"]], Evaluation], start: Float[np.ndarray, " p"], *, most: int = 100
) -> Found:
    """The point whose largest constraint is least: how near an infeasible request comes to its limits."""
    worst = float(np.max(function(start)[2]))
    span = max(2.0 * abs(worst), 1.0)

    def relaxed(x: Float[np.ndarray, " r"]) -> Evaluation:
        # The last variable is the violation that is allowed, from -span to span.
        _, gradient, constraints, derivatives = function(x[:-1])
        allowed = span * (2.0 * x[-1] - 1.0)
        along = np.concatenate([derivatives, np.full((len(constraints), 1), -2.0 * span)], axis=1)
        slope = np.append(np.zeros_like(gradient), 2.0)
        return 2.0 * x[-1] - 1.0, slope, constraints - allowed, along

    begin = np.append(start, np.clip(0.5 + 0.5 * worst / span, 0.0, 1.0))
    found = minimise_within(relaxed, begin, most=most)
    return found._replace(y=found.y[:-1], constraints=function(found.y[:-1])[2])


def multipliers_at(y: Float[np.ndarray, " p"], found: Evaluation) -> tuple[Float[np.ndarray, " q"], float]:
    """Multipliers of the constraints, and what is left of grad c + sum mu grad g + those of bounds = 0."""
    _, gradient, constraints, derivatives = found
    active = np.flatnonzero(constraints >= -ACTIVE)
    unit = np.eye(len(y))
    columns = np.concatenate([derivatives[active], unit[y >= 1.0 - ACTIVE], -unit[y <= ACTIVE]]).T
    multipliers = np.zeros(len(constraints))
    if columns.shape[1] == 0:
        return multipliers, float(np.max(np.abs(gradient), initial=0.0))
    solution, _ = nnls(columns, -gradient)
    multipliers[active] = solution[: len(active)]
    return multipliers, float(np.max(np.abs(gradient + columns @ solution)))
