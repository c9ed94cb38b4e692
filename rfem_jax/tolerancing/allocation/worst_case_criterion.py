"""The worst-case criterion of an allocation: every limit holds everywhere in the tolerance box, or in its zones.

Place in the pipeline: between the models an allocation is solved on (models.py) and the full problem. A
criterion can solve on its model, observe the full problem at a point (which corrects the model for the next solve),
and verify a point with random numbers that have not been used before.

The model is the set of worst points found so far, at first those of the quadratic model. Each observation searches new
ones on the full problem and takes values and gradients of all of them there: a converged answer satisfies the
first-order conditions of the full problem, not only of the quadratic one.

Symbols: t (v,) sizes [rad, m], x = log t, h (l,) normalised limits (<= 0 holds), z points of the unit box, with zones
of a product of unit balls; coordinates t z (`sizes`).
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.tolerancing.allocation.models import Answer, Scenarios, Verified, cheapest
from rfem_jax.tolerancing.allocation.request import Request
from rfem_jax.tolerancing.optimisation.starting_points import maximise_quadratic
from rfem_jax.tolerancing.sampling.sequences import RandomKey
from rfem_jax.tolerancing.worst_cases import STARTS, WorstCase, worst_case

MOST_SCENARIOS = 64
NEW_SCENARIO = 1e-6
SOLVES = 30  # on the quadratic model, each with the worst points of the last answer

HalfWidths = Float[np.ndarray, " v"]
Normalised = Float[np.ndarray, " l"]


class WorstCaseCriterion:
    """Limits hold in the whole box; see the module's docstring.

    Args: request; key of the searches on the quadratic model; starts of each search, as for `worst_case`.
    """

    joint = False
    settling = 1.0

    def __init__(self, request: Request, key: RandomKey, starts: Mapping[str, int] = STARTS):
        self.request, self.key, self.starts = request, key, starts
        k = len(request.sizes.errors)
        self.points, self.owner = np.zeros((0, k)), np.zeros(0, dtype=int)
        self.anchors, self.values, self.gradients = np.zeros((0, k)), np.zeros(0), np.zeros((0, k))
        self.anchored = False
        self.failed = 0

    def model(self) -> Scenarios:
        """The scenarios as a pytree, filled up to 4, 8, 16 ... rows so that few programs are compiled."""
        count = len(self.points)
        size = max(4, 1 << max(0, count - 1).bit_length())

        def fill(a):
            return jnp.asarray(np.concatenate([a, np.zeros((size - count, *a.shape[1:]), a.dtype)]))

        mask = jnp.asarray(np.arange(size) < count)
        arrays = (self.points, self.owner, self.anchors, self.values, self.gradients)
        points, owner, anchors, values, gradients = map(fill, arrays)
        quadratic = self.request.quadratic
        return Scenarios(quadratic, points, owner, mask, anchors, values, gradients)

    def _per_limit(self, h) -> Normalised:
        """The largest h of the scenarios of each limit."""
        limits = range(len(self.request.limits))
        h = np.asarray(h)[: len(self.owner)]
        return np.array([np.max(h[self.owner == i], initial=-np.inf) for i in limits])

    def _add(self, points, owner: int) -> None:
        """Add points (p, k) of one limit that are not there yet, anchored at the centre."""
        for z in points:
            same = self.points[self.owner == owner]
            if len(same) and np.min(np.max(np.abs(same - z), axis=1)) < NEW_SCENARIO:
                continue
            quadratic = self.request.quadratic
            self.points = np.concatenate([self.points, z[None]])
            self.owner = np.append(self.owner, owner)
            self.anchors = np.concatenate([self.anchors, np.zeros((1, len(z)))])
            self.values = np.append(self.values, float(quadratic.offset[owner]))
            gradient = np.asarray(quadratic.gradient[owner])[None]
            self.gradients = np.concatenate([self.gradients, gradient])

    def quadratic_worst(self, t: HalfWidths) -> Normalised:
        """h (l,) of the quadratic model alone."""
        return self._quadratic_maxima(t)[0]

    def _quadratic_maxima(self, t) -> tuple[Normalised, list[Float[np.ndarray, "p k"]]]:
        """h (l,) of the quadratic model alone, and its worst points (p, k) of each limit."""
        q, heights, found = self.request.quadratic, [], []
        sizes = self.request.sizes
        t = sizes.spread(t)
        for i in range(len(self.request.limits)):
            hessian = np.asarray(q.hessian[i]) * np.outer(t, t)
            points, values = maximise_quadratic(
                float(q.offset[i]), np.asarray(q.gradient[i]) * t, hessian, sizes.region, self.key
            )
            heights.append(values[0])
            found.append(points[values >= values[0] - 1e-9][:2])
        return np.array(heights), found

    def solve(
        self, x: Float[np.ndarray, " v"], lower: Float[np.ndarray, " v"], upper: Float[np.ndarray, " v"]
    ) -> Answer:
        """Cheapest x = log t on the model, from the start x (v,) and between lower and upper (v,).

        Before the first observation the quadratic model's own worst points are added until there are no new ones.
        """
        if self.anchored:
            return self._solve_once(x, lower, upper)
        self._add_quadratic(x)
        answer = self._solve_once(x, lower, upper)
        for _ in range(SOLVES - 1):
            if not self._add_quadratic(answer.x):
                break
            answer = self._solve_once(answer.x, lower, upper)
        return answer

    def _add_quadratic(self, x) -> int:
        """Add the worst points of the quadratic model at t = exp(x); returns the number of new ones."""
        before = len(self.points)
        for i, points in enumerate(self._quadratic_maxima(np.exp(x))[1]):
            self._add(points, i)
        return len(self.points) - before

    def _solve_once(self, x, lower, upper) -> Answer:
        start, low, high = map(jnp.asarray, (x, lower, upper))
        solution, unit, h = cheapest(
            self.model(), self.request.costs, jnp.asarray(self.request.sizes.owner), start, low, high
        )
        multipliers = np.asarray(solution.multipliers)[: len(self.owner)] * float(unit)
        prices = [np.sum(multipliers[self.owner == i]) for i in range(len(self.request.limits))]
        h = self._per_limit(h)
        cost = float(solution.cost) * float(unit)
        return Answer(np.asarray(solution.point), cost, h, float(h.max()), np.array(prices))

    def _search(self, t, key, starts, corners) -> tuple[Normalised, list[WorstCase]]:
        """h (l,) and the worst case of each limit on the full problem."""
        request, found = self.request, []
        parts = jax.random.split(key, len(request.limits))
        for limit, part in zip(request.limits, parts, strict=True):
            found.append(
                worst_case(
                    request.problem, request.sizes.tolerances(t), limit.metric, key=part, starts=starts,
                    at=request.at, sense=limit.sense, corners=corners, model=request.model,
                    mode=request.mode, batch=request.batch,
                )
            )  # fmt: skip
        self.failed += sum(w.failed for w in found)
        values = [limit.normalise(w.value) for limit, w in zip(request.limits, found, strict=True)]
        return np.array(values), found

    def observe(self, t: HalfWidths, key: RandomKey) -> Normalised:
        """h (l,) of the full problem's worst cases at t; corrects the model."""
        h, found = self._search(t, key, self.starts, False)
        self._correct(t, found)
        return h

    def learn(self, t: HalfWidths, fresh: Verified) -> None:
        """Correct the model by the worst cases of a fresh run at t."""
        self._correct(t, fresh.worst)

    def _correct(self, t, found: Sequence[WorstCase]) -> None:
        """Take worst cases of the full problem at t as scenarios and anchor all scenarios at t."""
        request = self.request
        for number, worst in enumerate(found):
            i = number % len(request.limits)
            maximisers = [np.array([e[n] for n in request.sizes.errors]) for e in worst.maximisers[:2]]
            if maximisers:
                away = request.sizes.coordinates(np.array(maximisers) - request.centre)
                self._add(away / request.sizes.spread(t), i)
        values, gradients = self._linearise(t)
        pairs = zip(self.owner, values, strict=True)
        h = np.array([request.limits[o].normalise(v) for o, v in pairs])
        factor = np.array([request.limits[o].sign / request.limits[o].headroom for o in self.owner])
        usable = np.isfinite(h) & np.all(np.isfinite(gradients), axis=1)
        order = np.argsort(np.where(usable, -h, np.inf), kind="stable")[:MOST_SCENARIOS]
        kept = np.sort(order[usable[order]])
        self.points, self.owner = self.points[kept], self.owner[kept]
        self.anchors = self.points * request.sizes.spread(t)
        self.values, self.gradients = h[kept], gradients[kept] * factor[kept, None]
        self.anchored = True

    def _linearise(self, t) -> tuple[np.ndarray, np.ndarray]:
        """Value (j,) and gradient (j, k) of each scenario's metric on the full problem at t."""
        request = self.request
        metric = np.array([request.limits[o].position for o in self.owner], dtype=int)
        values, gradients = request.linearise(self.points * request.sizes.spread(t), metric)
        return values[np.arange(len(metric)), metric], gradients

    def verify(self, t: HalfWidths, key: RandomKey) -> Verified:
        """Two searches from fresh starts, and every corner where they are few."""
        runs = [
            self._search(t, part, self.starts, corners)
            for part, corners in zip(jax.random.split(key), ("auto", False), strict=True)
        ]
        h = np.fmax(runs[0][0], runs[1][0])
        found = runs[0][1] + runs[1][1]
        failed = sum(w.failed for w in found)
        return Verified(h, h, h, np.nan, (np.nan, np.nan), failed, tuple(found))

    def best(self, key: RandomKey) -> Normalised:
        """Lowest reachable h (l,): boxes are nested, so it is that of the smallest tolerances."""
        return self._search(self.request.lower, key, self.starts, "auto")[0]
