"""The worst-case criterion of an allocation: every limit holds everywhere in the tolerance box.

Place in the pipeline: between the models an allocation is solved on (allocation_models.py) and the
full problem. A criterion can solve on its model, observe the full problem at a point (which
corrects the model for the next solve), and verify a point with random numbers that served nothing
else.

The model is the set of worst points found so far, of the quadratic model first. Each observation
searches new ones on the full problem and takes value and slope of all of them there: a converged
answer satisfies the first-order conditions of the full problem, not only of the quadratic one.

Symbols: t (k,) half-widths [rad, m], x = log t, h (l,) normalised limits (<= 0 holds), z points of
the unit box, e = t z errors from the centre.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.tolerancing.allocation_models import Answer, Scenarios, Verified, cheapest
from rfem_jax.tolerancing.quadratic_model import linearise_points
from rfem_jax.tolerancing.starting_points import maximise_quadratic
from rfem_jax.tolerancing.worst_cases import STARTS, worst_case

MOST_SCENARIOS = 64
NEW_SCENARIO = 1e-6


class WorstCaseCriterion:
    """Limits hold in the whole box; see the module's docstring."""

    joint = False
    settling = 1.0

    def __init__(self, request, key, starts=STARTS):
        self.request, self.key, self.starts = request, key, starts
        k = len(request.names)
        self.points, self.owner = np.zeros((0, k)), np.zeros(0, dtype=int)
        self.anchors, self.values, self.slopes = np.zeros((0, k)), np.zeros(0), np.zeros((0, k))
        self.anchored = False
        self.failed = 0

    def model(self):
        """The scenarios as a pytree, filled up to 4, 8, 16 ... rows: few programs."""
        count = len(self.points)
        size = max(4, 1 << max(0, count - 1).bit_length())

        def fill(a):
            return jnp.asarray(np.concatenate([a, np.zeros((size - count, *a.shape[1:]), a.dtype)]))

        mask = jnp.asarray(np.arange(size) < count)
        arrays = (self.points, self.owner, self.anchors, self.values, self.slopes)
        points, owner, anchors, values, slopes = map(fill, arrays)
        quadratic = self.request.quadratic
        return Scenarios(quadratic, points, owner, mask, anchors, values, slopes)

    def _per_limit(self, h):
        limits = range(len(self.request.limits))
        h = np.asarray(h)[: len(self.owner)]
        return np.array([np.max(h[self.owner == i], initial=-np.inf) for i in limits])

    def _add(self, points, owner):
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
            slope = np.asarray(quadratic.gradient[owner])[None]
            self.slopes = np.concatenate([self.slopes, slope])

    def quadratic_worst(self, t):
        """h (l,) of the quadratic model alone, and its worst points [(p, k)]."""
        q, heights, found = self.request.quadratic, [], []
        for i in range(len(self.request.limits)):
            hessian = np.asarray(q.hessian[i]) * np.outer(t, t)
            points, values = maximise_quadratic(
                float(q.offset[i]), np.asarray(q.gradient[i]) * t, hessian, "box", self.key
            )
            heights.append(values[0])
            found.append(points[values >= values[0] - 1e-9][:2])
        return np.array(heights), found

    def solve(self, x, lower, upper):
        """Cheapest x on the model; before the first observation the quadratic model's own worst
        points are added until there are no new ones."""
        for _ in range(30):
            if not self.anchored:
                before = len(self.points)
                for i, points in enumerate(self.quadratic_worst(np.exp(x))[1]):
                    self._add(points, i)
                if len(self.points) == before and before:
                    break
            solution, unit, h = cheapest(
                self.model(), self.request.costs, jnp.asarray(x), jnp.asarray(lower),
                jnp.asarray(upper),
            )  # fmt: skip
            x = np.asarray(solution.point)
            if self.anchored:
                break
        multipliers = np.asarray(solution.multipliers)[: len(self.owner)] * float(unit)
        prices = [np.sum(multipliers[self.owner == i]) for i in range(len(self.request.limits))]
        h = self._per_limit(h)
        return Answer(x, float(solution.cost) * float(unit), h, float(h.max()), np.array(prices))

    def _search(self, t, key, starts, corners):
        request, found = self.request, []
        parts = jax.random.split(key, len(request.limits))
        for limit, part in zip(request.limits, parts, strict=True):
            found.append(
                worst_case(
                    request.problem, request.tolerances(t), limit.metric, key=part, starts=starts,
                    at=request.at, sense=limit.sense, corners=corners, model=request.model,
                    mode=request.mode, batch=request.batch,
                )
            )  # fmt: skip
        self.failed += sum(w.failed for w in found)
        values = [limit.normalise(w.value) for limit, w in zip(request.limits, found, strict=True)]
        return np.array(values), found

    def observe(self, t, key):
        """h (l,) of the full problem's worst cases at t; corrects the model."""
        h, found = self._search(t, key, self.starts, False)
        self._correct(t, found)
        return h

    def learn(self, t, verified):
        """Correct by what a fresh run at t found."""
        self._correct(t, verified.worst)

    def _correct(self, t, found):
        """Take worst cases of the full problem at t as scenarios and anchor all scenarios at t."""
        request = self.request
        for number, worst in enumerate(found):
            i = number % len(request.limits)
            maximisers = [np.array([e[n] for n in request.names]) for e in worst.maximisers[:2]]
            if maximisers:
                self._add((np.array(maximisers) - request.centre) / t, i)
        values, slopes = self._linearise(t)
        pairs = zip(self.owner, values, strict=True)
        h = np.array([request.limits[o].normalise(v) for o, v in pairs])
        factor = np.array([request.limits[o].sign / request.limits[o].headroom for o in self.owner])
        usable = np.isfinite(h) & np.all(np.isfinite(slopes), axis=1)
        order = np.argsort(np.where(usable, -h, np.inf), kind="stable")[:MOST_SCENARIOS]
        kept = np.sort(order[usable[order]])
        self.points, self.owner = self.points[kept], self.owner[kept]
        self.anchors = self.points * t
        self.values, self.slopes = h[kept], slopes[kept] * factor[kept, None]
        self.anchored = True

    def _linearise(self, t):
        """Value (j,) and gradient (j, k) of each scenario's metric on the full problem at t."""
        request = self.request
        metric = np.array([request.limits[o].index for o in self.owner], dtype=int)
        values, slopes, _ = linearise_points(
            request.problem, request.names, request.base, self.points * t + request.centre,
            metric=metric, mode=request.mode, batch=request.batch,
        )  # fmt: skip
        return values[np.arange(len(metric)), metric], slopes

    def verify(self, t, key):
        """Two searches from fresh starts, and every corner where they are few."""
        runs = [
            self._search(t, part, self.starts, corners)
            for part, corners in zip(jax.random.split(key), ("auto", False), strict=True)
        ]
        h = np.fmax(runs[0][0], runs[1][0])
        found = runs[0][1] + runs[1][1]
        failed = sum(w.failed for w in found)
        return Verified(h, h, h, np.nan, (np.nan, np.nan), failed, tuple(found))

    def best(self, key):
        """Lowest reachable h (l,): boxes are nested, so it is the one of the smallest
        tolerances."""
        return self._search(self.request.lower, key, self.starts, "auto")[0]
