"""Values and derivatives of a problem at many errors, each computed once.

Place in the pipeline: request -> **observations** -> criteria, search.

Symbols: y (p,) variables; z (n, k) standard points; m metrics; values (n, m), NaN where a sample failed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from rfem_jax.tolerancing.problems.evaluation import evaluate_points
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.reproduction import require_reproduced
from rfem_jax.tolerancing.robust_design.request import Request


class Observed(NamedTuple):
    """Values (n, m) of all metrics and their derivatives by the deviations (n, m, names) at n standard points; both
    NaN where a sample failed."""

    values: Float[np.ndarray, "n m"]
    jacobian: Float[np.ndarray, "n m names"]

    @property
    def good(self) -> Bool[np.ndarray, " n"]:
        """Which samples did not fail."""
        return np.all(np.isfinite(self.values), axis=1) & np.all(np.isfinite(self.jacobian), axis=(1, 2))


@dataclass(eq=False)
class Observer:
    """Evaluates a problem at variables and standard points.

    Attributes: told, is called with the number of simulations after every evaluation; simulations, failed: their
    numbers so far.
    """

    request: Request
    told: Callable[[int], object] | None = None
    simulations: int = 0
    failed: int = 0
    _last: dict[bytes, Observed] = field(default_factory=dict)
    _known: dict[bytes, Observed] = field(default_factory=dict)

    def observe(self, y: Float[np.ndarray, " p"], z: Float[np.ndarray, "n k"]) -> Observed:
        """Values and derivatives at variables y and standard points z."""
        return self.observe_points(self.request.variables.deviations(y, z))

    def observe_points(self, points: Float[np.ndarray, "n names"]) -> Observed:
        """Values and derivatives at deviations."""
        key = points.tobytes()
        if key in self._known:
            return self._known[key]
        if key not in self._last:
            found = Observed(*self.linearise(points))
            self.simulations += len(points)
            self.failed += int(np.sum(~found.good))
            if self.told is not None:
                self.told(self.simulations)
            # Searches ask again for the points of the last few steps at most.
            if len(self._last) > 16:
                self._last.pop(next(iter(self._last)))
            self._last[key] = found
        return self._last[key]

    def learn(self, groups: Sequence[Float[np.ndarray, "n names"]]) -> None:
        """Observe several groups of deviations at once; each is known by itself afterwards."""
        together = self.observe_points(np.concatenate(groups))
        stop = 0
        for points in groups:
            start, stop = stop, stop + len(points)
            self._known[points.tobytes()] = Observed(together.values[start:stop], together.jacobian[start:stop])

    def require_reproduced(self) -> None:
        """Raise InputError for derivatives through impacts that a finer step does not reproduce."""
        request, variables = self.request, self.request.variables
        start = variables.start
        centre = variables.deviations(start, np.zeros((1, len(variables.errors))))[0]
        require_reproduced(
            request.problem, variables.names, request.base, centre, variables.reaches(start),
            mode=request.mode, batch=request.batch,
        )  # fmt: skip

    def values(self, points: Float[np.ndarray, "n names"]) -> Float[np.ndarray, "n m"]:
        """Values alone at deviations, by a program without derivatives; NaN where a sample failed."""
        request = self.request
        self.simulations += len(points)
        return evaluate_points(request.problem, request.variables.names, request.base, points, request.batch)[0]

    def linearise(
        self, points: Float[np.ndarray, "n names"], metric: Int[np.ndarray, " n"] | None = None
    ) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m names"] | Float[np.ndarray, "n names"]]:
        """Values of all metrics at deviations and their derivatives by these; with `metric` those of one each."""
        request = self.request
        values, derivatives, _ = linearise_points(
            request.problem, request.variables.names, request.base, points,
            metric=metric, mode=request.mode, batch=request.batch,
        )  # fmt: skip
        return values, derivatives
