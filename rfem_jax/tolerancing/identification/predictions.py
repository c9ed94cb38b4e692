"""What a mechanism with given errors would have shown to its sensors: signals of many runs at once, with derivatives.

Place in the pipeline: problem with signals -> **predictions** -> residuals, observability.

Runs save signals at their own times; between these a cubic spline goes through them (theory (17.3)), whose error is
estimated by the spline through every second saved time. Forward mode pushes all unknowns through each run.

Symbols: w points, k unknowns, S signals, T saved times.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.interpolate import CubicSpline

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.simulation.specification import Simulation
from rfem_jax.tolerancing.checks import check_known
from rfem_jax.tolerancing.identification.signals import TIME, signal
from rfem_jax.tolerancing.problems.evaluation import run_in_chunks
from rfem_jax.tolerancing.problems.linearisation import push_directions
from rfem_jax.tolerancing.problems.problem import Metric, ToleranceProblem, of_any_step
from rfem_jax.tolerancing.problems.sample_values import (
    Base,
    default_lanes,
    divided,
    local_mesh,
    on_devices,
    stack_metrics,
)
from rfem_jax.tolerancing.problems.simulated_problem import Problem


class Prediction(NamedTuple):
    """Signals of w runs: values (w, S, T), NaN where a run failed or has no derivatives; derivatives (w, S, T, k) by
    the errors [rad, m], or None; status (w,)."""

    values: Float[np.ndarray, "w S T"]
    derivatives: Float[np.ndarray, "w S T k"] | None
    status: Int[np.ndarray, " w"]


class Predictor:
    """The signals of one experiment as a function of the unknowns.

    Args:
        problem: a `Problem` or `Simulation`, whose runs have the columns; or another problem whose metrics are the
            columns, each with the values at `times` (T,), or at those of its metric `time_s`.
        columns: of the signals (S).
        names: of the unknowns (k).
        base: errors held fixed.
        times: of the values of a problem that is not simulated.
        lanes: points without derivatives at once on a device; None: as many as all studies take.
    """

    def __init__(
        self, problem: Any, columns: Sequence[str], names: Sequence[str], base: Base, times: Any = None,
        lanes: int | None = None,
    ):  # fmt: skip
        if isinstance(problem, Simulation):
            problem = Problem(problem, [signal(one) for one in columns])
        if isinstance(problem, Problem):
            clock = Metric(TIME, "s", function=_clock)
            problem = problem.with_metrics([*(signal(one) for one in columns), clock])
        self.problem: ToleranceProblem = problem
        known = [one.name for one in problem.metrics]
        if times is None and TIME not in known:
            raise InputError(
                "Argument `times` must be given with a problem that is not simulated, but is missing; give the times "
                f"of the values of its metrics, or let `{TIME}` be one."
            )
        check_known(columns, known, "signals")
        self.columns, self.names, self.base, self._lanes = tuple(columns), tuple(names), base, lanes
        self.rows = [known.index(one) for one in columns]
        self._clock = known.index(TIME) if times is None else 0
        self.given_times = self._times = None if times is None else np.asarray(times, dtype=float)
        self._width = 1  # points with derivatives at once on a device: that of the searches, whose program serves all

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        """Times (T,) [s] of the values: those that a run saves, known once a run succeeded."""
        assert self._times is not None, "runs first"
        return self._times

    def at(self, points: Float[np.ndarray, "w k"], derivatives: bool) -> Prediction:
        """The signals at points (w, k) [rad, m], and their derivatives where they are asked for."""
        shared, mine, mesh = of_any_step(self.problem), self.base, local_mesh()

        def program(rows):
            return _signals(shared, self.names, mine, divided(mesh, rows), derivatives, mesh)

        self._width = max(self._width, -(-len(points) // mesh.size)) if derivatives else self._width
        width = self._width if derivatives else self._lanes or default_lanes()
        of = self.problem, ("signals", self.names, mine, derivatives)
        values, slopes, status = run_in_chunks(program, width * mesh.size, points, of=of)
        if self._times is None and (status == 0).any():
            self._times = values[int(np.argmax(status == 0)), self._clock]
        failed = (status != 0) | ~np.isfinite(values).all(axis=(1, 2))
        if derivatives:
            failed |= ~np.isfinite(slopes).all(axis=(1, 2, 3))
        values[failed] = np.nan
        return Prediction(values[:, self.rows], slopes[:, self.rows] if derivatives else None, status)


def _clock(run: Any) -> Array:
    return run.times


@partial(Program, nameless=True)
def _signals(problem, names, base, points, derivatives, mesh):
    """Values (w, m, T) of all metrics at points (w, k), derivatives (w, m, T, k), without elements unless they are
    asked for, and status (w,); traced. Points are divided among the devices of a mesh."""

    def of_rows(given, points):
        problem, base = given

        def function(x):
            return stack_metrics(problem, names, base, x)

        def one(x):
            if not derivatives:
                values, status = function(x)
                return values, jnp.zeros((0,)), status
            values, slopes, status = push_directions(function, x, jnp.eye(len(names)), len(names))
            return values, jnp.moveaxis(slopes, 0, -1), status

        return jax.vmap(one)(points)

    return on_devices(mesh, of_rows, (problem, base), points)


def spline(times: Float[np.ndarray, " T"], values: Float[np.ndarray, "T ..."]) -> CubicSpline:
    """The curve through saved values."""
    return CubicSpline(times, values, axis=0)


def interpolation_error(times: Float[np.ndarray, " T"], values: Float[np.ndarray, " T"]) -> float:
    """The largest error of the spline through saved values, about a sixteenth of what that through every second one
    misses (theory (17.3))."""
    if len(times) < 9:
        return 0.0
    coarse = spline(times[::2], values[::2])(times[1:-1:2])
    return float(np.max(np.abs(coarse - values[1:-1:2]))) / 16.0


def scaled_base(base: Mapping[str, float]) -> Base:
    """Errors held fixed, as problems take them."""
    return {name: jnp.asarray(value, jnp.float64) for name, value in base.items()}
