"""Design points: the most probable errors at which a limit fails, by the first-order reliability method (FORM).

Place in the pipeline: problem, tolerances, limits -> **design_points** -> importance sampling.

    min |w|  subject to  G(w) = +-(limit - f(e(w)))/scale = 0,        w independent standard normal numbers
    HL-RF:  d = (G'.w - G) G'/|G'|^2 - w,   w <- w + s d,   s halved until |w|^2/2 + c |G| falls (Armijo)

All searches of all limits take their steps together, in one batch of simulations with gradients. Metrics that are even
in the errors have two design points, w and -w, and a gradient that vanishes at w = 0: searches start on a sphere, in
pairs of opposite directions, and at samples that break the limit, as each design point has some of these about it.

Symbols: w (k,) standard normal coordinates of the errors (`Tolerances.from_normal`), G limit state, positive where the
limit holds, beta = |w| of a design point with the sign of G(0) [1].
Source: theory (10.21), (10.22); R. Rackwitz, B. Fiessler, Computers and Structures 9 (1978) 489-494 (HL-RF);
Y. Zhang, A. Der Kiureghian, in: Reliability and Optimization of Structural Systems (1995) 297-304 (step by a merit
function); A. Der Kiureghian, T. Dakessian, Structural Safety 20 (1998) 37-49 (several design points).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.compilation.program import Program
from rfem_jax.tolerancing.optimisation.starting_points import sobol_units, spread_points
from rfem_jax.tolerancing.problems.evaluation import evaluate_points, run_in_chunks
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.reproduction import require_reproduced
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption
from rfem_jax.tolerancing.sampling.sequences import RandomKey

RADIUS = 2.0  # of the sphere on which searches start
FARTHEST = 37.0  # |w| beyond which a probability is below the smallest float64
LARGEST_STEP = 3.0  # of |w| in one step
SHORTEST = 2.0**-12  # share of a step that is still tried
ARMIJO = 1e-4
SAME = 0.05  # design points nearer to each other than this are one
ON_LIMIT = 1e-3  # |G|, by its value at w = 0, of a search that ended on the limit without converging
FAR_BEHIND = 3.0  # |w| beyond that of the nearest design point: of no weight


@dataclass(frozen=True)
class LimitState:
    """One end of a limit: index of its metric, its sign (+1 upper, -1 lower), and the limit in the metric's unit."""

    index: int
    sign: float
    limit: float

    def of(self, values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
        """Distance (n,) of values (n, m) to the limit [metric unit], positive where it holds."""
        return self.sign * (self.limit - values[:, self.index])


@dataclass(frozen=True, eq=False)
class DesignPoints:
    """Design points (p, k) of one limit state in w, nearest first; nominal G at w = 0 [metric unit]; directions (p, k),
    unit vectors of -G'; converged (p,): False where a search ended on the limit, but not at its nearest point."""

    points: Float[np.ndarray, "p k"]
    directions: Float[np.ndarray, "p k"]
    converged: Bool[np.ndarray, " p"]
    nominal: float

    @property
    def beta(self) -> Float[np.ndarray, " p"]:
        """Reliability index of each point, negative where the limit fails at w = 0."""
        return np.copysign(1.0, self.nominal) * np.linalg.norm(self.points, axis=1)

    def joined(self, more: "DesignPoints") -> "DesignPoints":
        """These and the further ones of the same limit state."""
        pairs = zip(*((one.points, -one.directions, one.converged) for one in (self, more)), strict=True)
        return _Ends(*(np.concatenate(pair) for pair in pairs)).distinct().design_points(self.nominal)


@dataclass(frozen=True, eq=False)
class NormalSpace:
    """A problem in standard normal coordinates of its errors."""

    problem: ToleranceProblem
    tolerances: Tolerances
    mode: str
    batch: int

    def errors(self, w: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Errors (n, k) [rad, m] of points w (n, k)."""
        return run_in_chunks(lambda rows: _errors(self.tolerances, rows)[:1], self.batch, w, of=None)[0]

    def values(self, w: Float[np.ndarray, "n k"], progress: ProgressOption = False) -> Float[np.ndarray, "n m"]:
        """Metrics (n, m) at points w (n, k); NaN where a sample failed."""
        names = self.tolerances.names
        with ProgressBar(progress, len(w)) as bar:
            return evaluate_points(self.problem, names, {}, self.errors(w), self.batch, bar.advance)[0]

    def require_reproduced(self) -> None:
        """Raise InputError for derivatives through impacts that a finer step does not reproduce."""
        names, widths = self.tolerances.names, self.tolerances.half_widths()
        centres = self.tolerances.centres()
        at, t = (np.array([float(one.get(name, 0.0)) for name in names]) for one in (centres, widths))
        require_reproduced(self.problem, names, {}, at, t, mode=self.mode, batch=self.batch)

    def linearise(
        self, w: Float[np.ndarray, "n k"], states: Sequence[LimitState]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        """G (n,) [metric unit] and its gradients (n, k) by w, each of its own limit state."""
        errors, jacobians = map(np.asarray, _errors(self.tolerances, jnp.asarray(w)))
        indices = np.array([state.index for state in states])
        values, gradients, _ = linearise_points(
            self.problem, self.tolerances.names, {}, errors, metric=indices, mode=self.mode, batch=self.batch
        )
        signs = np.array([state.sign for state in states])
        limits = np.array([state.limit for state in states])
        distances = signs * (limits - values[np.arange(len(w)), indices])
        return distances, -signs[:, None] * np.einsum("ne,new->nw", gradients, jacobians)


@Program
def _errors(tolerances, w):
    """Errors (n, k) and their Jacobians (n, k, k) by w (n, k)."""

    def one(point):
        errors = tolerances.from_normal(point)
        return jnp.stack([errors[name] for name in tolerances.names])

    return jax.vmap(one)(w), jax.vmap(jax.jacfwd(one))(w)


def sphere_starts(k: int, starts: int, key: RandomKey) -> Float[np.ndarray, "starts k"]:
    """Starts of searches on a sphere about w = 0, in pairs of opposite directions that are drawn with the key."""
    half = spread_points(sobol_units(k + 1, -(-starts // 2), key), "ellipsoid")
    half *= RADIUS / np.linalg.norm(half, axis=1, keepdims=True)
    return np.concatenate([half, -half])[:starts]


def find_design_points(
    space: NormalSpace,
    states: Sequence[LimitState],
    starts: Sequence[Float[np.ndarray, "n k"]],
    *,
    rounds: int = 60,
    accuracy: float = 1e-4,
) -> list[DesignPoints]:
    """The design points of every limit state; none where no search reached the limit.

    Args: starts (n, k) of the searches of each; rounds, the most evaluations with gradients of a search; accuracy of
        |G| relative to its value at w = 0, and of the direction of w.
    """
    values = space.values(np.zeros((1, len(space.tolerances.names))))
    nominal = np.array([float(state.of(values)[0]) for state in states])
    owners = np.repeat(np.arange(len(states)), [len(points) for points in starts])
    scale = np.where(np.isfinite(nominal) & (nominal != 0.0), np.abs(nominal), 1.0)[owners]
    ends, reached = _search(space, [states[int(i)] for i in owners], np.concatenate(starts), scale, rounds, accuracy)
    return [ends.of((owners == i) & reached).distinct().design_points(float(value)) for i, value in enumerate(nominal)]


@dataclass(frozen=True, eq=False)
class _Ends:
    """Ends (n, k) of searches on a limit, the gradients of G there, and whether the searches converged (n,)."""

    points: Float[np.ndarray, "n k"]
    slopes: Float[np.ndarray, "n k"]
    converged: Bool[np.ndarray, " n"]

    def of(self, rows: np.ndarray) -> "_Ends":
        return _Ends(self.points[rows], self.slopes[rows], self.converged[rows])

    def distinct(self) -> "_Ends":
        """Those that differ, converged ones before others at the same place, and none far behind the nearest."""
        lengths = np.linalg.norm(self.points, axis=1)
        left = np.lexsort((lengths, ~self.converged))
        left = left[lengths[left] <= np.min(lengths, initial=np.inf) + FAR_BEHIND]
        kept: list[int] = []
        while len(left):
            kept.append(int(left[0]))
            left = left[np.linalg.norm(self.points[left] - self.points[left[0]], axis=1) > SAME]
        return self.of(np.array(kept, dtype=int))

    def design_points(self, nominal: float) -> DesignPoints:
        """Nearest first."""
        order = np.argsort(np.linalg.norm(self.points, axis=1), kind="stable")
        unit = self.slopes / np.maximum(np.linalg.norm(self.slopes, axis=1, keepdims=True), 1e-300)
        return DesignPoints(self.points[order], -unit[order], self.converged[order], nominal)


def _search(
    space: NormalSpace, states: list[LimitState], w: np.ndarray, scale: np.ndarray, rounds: int, accuracy: float
) -> tuple[_Ends, Bool[np.ndarray, " n"]]:
    """Where searches that start at w (n, k) end, and which of them did so on their limits (n,)."""
    value, slope = _scaled(space, states, w, scale)
    step, direction, penalty = np.ones(len(w)), *_direction(w, value, slope)
    active = np.isfinite(value) & np.all(np.isfinite(slope), axis=1)
    done = np.zeros(len(w), dtype=bool)
    for _ in range(rounds):
        done |= active & _converged(w, value, slope, accuracy)
        active &= ~done & (step >= SHORTEST) & (np.linalg.norm(w, axis=1) < FARTHEST)
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        trial = w[rows] + step[rows, None] * direction[rows]
        found, slopes = _scaled(space, [states[i] for i in rows], trial, scale[rows])
        before = 0.5 * np.sum(w[rows] ** 2, axis=1) + penalty[rows] * np.abs(value[rows])
        after = 0.5 * np.sum(trial**2, axis=1) + penalty[rows] * np.abs(found)
        fall = np.sum(w[rows] * direction[rows], axis=1) - penalty[rows] * np.abs(value[rows])
        with np.errstate(invalid="ignore"):
            good = np.isfinite(found) & np.all(np.isfinite(slopes), axis=1)
            good &= after <= before + ARMIJO * step[rows] * np.minimum(fall, 0.0) + 1e-14
        taken, kept = rows[good], rows[~good]
        w[taken], value[taken], slope[taken] = trial[good], found[good], slopes[good]
        direction[taken], penalty[taken] = _direction(w[taken], value[taken], slope[taken])
        step[taken] = 1.0
        step[kept] *= 0.5
    ends = done | (np.abs(value) <= ON_LIMIT)
    return _Ends(w, slope, done), ends


def _scaled(space, states, w, scale):
    value, slope = space.linearise(w, states)
    return value / scale, slope / scale[:, None]


def _direction(w, value, slope) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, " n"]]:
    """Steps (n, k) of HL-RF, and penalties (n,) with which they lower the merit function."""
    square = np.maximum(np.sum(slope**2, axis=1), 1e-300)
    step = ((np.sum(slope * w, axis=1) - value) / square)[:, None] * slope - w
    length = np.linalg.norm(step, axis=1)
    step *= np.minimum(1.0, LARGEST_STEP / np.maximum(length, 1e-300))[:, None]
    # Twice |w|/|G'|, and enough that a step from inside, which lengthens w, still lowers the merit.
    penalty = 2.0 * np.maximum(np.linalg.norm(w, axis=1), np.linalg.norm(w + step, axis=1)) / np.sqrt(square)
    return step, np.maximum(penalty, 1e-12)


def _converged(w, value, slope, accuracy) -> Bool[np.ndarray, " n"]:
    """Where the limit is met and w stands normal to it."""
    square = np.maximum(np.sum(slope**2, axis=1), 1e-300)
    across = w - (np.sum(slope * w, axis=1) / square)[:, None] * slope
    length = np.maximum(np.linalg.norm(w, axis=1), 1.0)
    return (np.abs(value) <= accuracy) & (np.linalg.norm(across, axis=1) <= accuracy * length)
