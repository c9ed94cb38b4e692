"""The worst-case criterion of an allocation: every limit holds everywhere in the tolerance box, or in its zones.

Place in the pipeline: corrected model -> **corrected worst case** -> allocation.

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

from rfem_jax.tolerancing.optimisation.starting_points import maximise_quadratic
from rfem_jax.tolerancing.robust_design.corrected_model import Answer, CorrectedModel, HalfWidths, Normalised
from rfem_jax.tolerancing.robust_design.models import Scenarios
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.robust_design.verification import Verified
from rfem_jax.tolerancing.sampling.sequences import RandomKey
from rfem_jax.tolerancing.worst_cases import STARTS, WorstCase, worst_case

MOST_SCENARIOS = 64
NEW_SCENARIO = 1e-6
SOLVES = 30  # on the quadratic model, each with the worst points of the last answer


class CorrectedWorstCase(CorrectedModel):
    """Limits hold in the whole box; see the module's docstring.

    Args: observer; key of the searches on the quadratic model; starts of each search, as for `worst_case`.
    """

    def __init__(self, observer: Observer, key: RandomKey, starts: Mapping[str, int] = STARTS):
        super().__init__(observer)
        self.key, self.starts = key, starts
        k = len(self.sizes.errors)
        self.points, self.owner = np.zeros((0, k)), np.zeros(0, dtype=int)
        self.anchors, self.values, self.gradients = np.zeros((0, k)), np.zeros(0), np.zeros((0, k))
        self.anchored = False

    def model(self) -> Scenarios:
        """The scenarios, filled up to 4, 8, 16 ... rows so that few programs are compiled."""
        count = len(self.points)
        size = max(4, 1 << max(0, count - 1).bit_length())

        def fill(a):
            return jnp.asarray(np.concatenate([a, np.zeros((size - count, *a.shape[1:]), a.dtype)]))

        mask = jnp.asarray(np.arange(size) < count)
        arrays = (self.points, self.owner, self.anchors, self.values, self.gradients)
        points, owner, anchors, values, gradients = map(fill, arrays)
        return Scenarios(self.quadratic, points, owner, mask, anchors, values, gradients)

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
            quadratic = self.quadratic
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
        q, heights, found = self.quadratic, [], []
        t = self.sizes.spread(t)
        for i in range(len(self.request.limits)):
            hessian = np.asarray(q.hessian[i]) * np.outer(t, t)
            points, values = maximise_quadratic(
                float(q.offset[i]), np.asarray(q.gradient[i]) * t, hessian, self.sizes.region, self.key
            )
            heights.append(values[0])
            found.append(points[values >= values[0] - 1e-9][:2])
        return np.array(heights), found

    def solve(self, x: HalfWidths, lower: HalfWidths, upper: HalfWidths) -> Answer:
        """Cheapest x = log t on the model.

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
        x, cost, h, multipliers = self._cheapest(self.model(), x, lower, upper)
        multipliers = multipliers[: len(self.owner)]
        prices = [np.sum(multipliers[self.owner == i]) for i in range(len(self.request.limits))]
        h = self._per_limit(h)
        return Answer(x, cost, h, float(h.max()), np.array(prices))

    def _search(self, t, key, corners) -> tuple[Normalised, list[WorstCase]]:
        """h (l,) and the worst case of each limit on the full problem."""
        request, found = self.request, []
        parts = jax.random.split(key, len(request.limits))
        for limit, part in zip(request.limits, parts, strict=True):
            found.append(
                worst_case(
                    request.problem, self.sizes.tolerances(t), limit.metric, key=part, starts=self.starts,
                    at=request.at, sense="max" if limit.sign > 0 else "min", corners=corners, model=request.model,
                    mode=request.mode, batch=request.batch,
                )
            )  # fmt: skip
        self.failed += sum(w.failed for w in found)
        values = [limit.normalise(w.value) for limit, w in zip(request.limits, found, strict=True)]
        return np.array(values), found

    def observe(self, t: HalfWidths, key: RandomKey) -> Normalised:
        """h (l,) of the worst cases of the full problem at t; corrects the model."""
        h, found = self._search(t, key, False)
        self._correct(t, found)
        return h

    def learn(self, t: HalfWidths, fresh: Verified) -> None:
        """Take the worst cases of a fresh run at t as scenarios."""
        self._correct(t, fresh.worst)

    def _correct(self, t, found: Sequence[WorstCase]) -> None:
        """Take worst cases of the full problem at t as scenarios and anchor all scenarios at t."""
        limits, spread = self.request.limits, self.sizes.spread(t)
        for number, worst in enumerate(found):
            maximisers = [np.array([e[n] for n in self.sizes.errors]) for e in worst.maximisers[:2]]
            if maximisers:
                away = self.sizes.coordinates(np.array(maximisers) - self.variables.centre)
                self._add(away / spread, number % len(limits))
        values, gradients = self._linearise(t)
        h = np.array([limits[o].normalise(v) for o, v in zip(self.owner, values, strict=True)])
        factor = np.array([limits[o].sign / limits[o].scale for o in self.owner])
        usable = np.isfinite(h) & np.all(np.isfinite(gradients), axis=1)
        order = np.argsort(np.where(usable, -h, np.inf), kind="stable")[:MOST_SCENARIOS]
        kept = np.sort(order[usable[order]])
        self.points, self.owner = self.points[kept], self.owner[kept]
        self.anchors = self.points * spread
        self.values, self.gradients = h[kept], gradients[kept] * factor[kept, None]
        self.anchored = True

    def _linearise(self, t) -> tuple[np.ndarray, np.ndarray]:
        """Value (j,) and gradient (j, k) of each scenario's metric on the full problem at t."""
        metric = np.array([self.request.limits[o].position for o in self.owner], dtype=int)
        values, gradients = self.observer.linearise(self.variables.scattered(t, self.points), metric)
        return values[np.arange(len(metric)), metric], self.variables.by_coordinates(gradients)

    def verify(self, t: HalfWidths, key: RandomKey) -> Verified:
        """Two searches at t from fresh starts, and every corner where they are few."""
        runs = [
            self._search(t, part, corners) for part, corners in zip(jax.random.split(key), ("auto", False), strict=True)
        ]
        h = np.fmax(runs[0][0], runs[1][0])
        what, found = "worst-case searches from new starting points", (*runs[0][1], *runs[1][1])
        return Verified(h, h, h, np.nan, (np.nan, np.nan), 0, what, found)  # failed samples are counted in all searches

    def best(self, key: RandomKey) -> Normalised:
        """Lowest reachable h (l,): boxes are nested, so it is that of the smallest tolerances."""
        return self._search(self.variables.width_lower, key, "auto")[0]
