"""What an optimisation may change: dimensions and tolerances, scaled to the unit cube.

Place in the pipeline: first step of `optimise` and `allocate`; knows names and numbers, not the problem.

A problem takes deviations {name: number}: of an error from zero, of a parameter from its value in the description.  A
dimension d is set by the deviation d - nominal; an error scatters as t z about it, with the half-width t of its
tolerance and a standard point z; those of a drawing zone have its diameter for t, and scatter together (`sizes`).  A
dimension may scatter, too.

Symbols: d designs, k errors that scatter, v sizes of their tolerances, p = d plus the sizes to be found; y (p,) in the
unit cube: designs in proportion, sizes by their logarithm; t (v,) half-widths [unit of the error] and diameters [m] of
zones; z (n, k) standard points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfem_jax.tolerancing.optimisation.sizes import Sizes


@dataclass(frozen=True, eq=False)
class Variables:
    """The variables of an optimisation.

    Attributes: designs (d names) between design_lower and design_upper, with their nominal values; sizes of
    the tolerances with half_widths (or diameters), of which those at the places `free` are found between width_lower
    and width_upper; centre (names) of all deviations but those of designs.
    """

    designs: tuple[str, ...]
    design_lower: Float[np.ndarray, " d"]
    design_upper: Float[np.ndarray, " d"]
    nominal: Float[np.ndarray, " d"]
    sizes: Sizes
    half_widths: Float[np.ndarray, " v"]
    free: tuple[int, ...]
    width_lower: Float[np.ndarray, " free"]
    width_upper: Float[np.ndarray, " free"]
    centre: Float[np.ndarray, " names"] | float = 0.0

    @property
    def size(self) -> int:
        """Number of variables p."""
        return len(self.designs) + len(self.free)

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of the errors that scatter (k)."""
        return self.sizes.errors

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which the problem is differentiated: designs, then errors that are no designs."""
        return (*self.designs, *(name for name in self.errors if name not in self.designs))

    @property
    def start(self) -> Float[np.ndarray, " p"]:
        """The nominal design, as far as it is within the bounds, with tolerances in the middle of theirs."""
        span = self.design_upper - self.design_lower
        inside = np.clip((self.nominal - self.design_lower) / span, 0.0, 1.0)
        return np.concatenate([inside, np.full(len(self.free), 0.5)])

    def values(self, y: Float[np.ndarray, " p"]) -> Float[np.ndarray, " d"]:
        """The designs at y."""
        return self.design_lower + y[: len(self.designs)] * (self.design_upper - self.design_lower)

    def widths(self, y: Float[np.ndarray, " p"]) -> Float[np.ndarray, " v"]:
        """The sizes of all tolerances at y."""
        found = self.half_widths.copy()
        ratio = self.width_upper / self.width_lower
        found[list(self.free)] = self.width_lower * ratio ** y[len(self.designs) :]
        return found

    def width_slopes(self, y: Float[np.ndarray, " p"]) -> Float[np.ndarray, " free"]:
        """Derivatives of the half-widths to be found by their own variables."""
        return self.widths(y)[list(self.free)] * np.log(self.width_upper / self.width_lower)

    def deviations(self, y: Float[np.ndarray, " p"], z: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n names"]:
        """Deviations that the problem takes, in the order of `names`."""
        return self.scattered(self.widths(y), z, self.values(y) - self.nominal)

    def scattered(
        self, t: Float[np.ndarray, " v"], z: Float[np.ndarray, "n k"], design: Float[np.ndarray, " d"] | float = 0.0
    ) -> Float[np.ndarray, "n names"]:
        """Deviations at sizes t and standard points z, where those of the designs are `design`."""
        points = np.zeros((len(z), len(self.names))) + self.centre
        points[:, : len(self.designs)] += design
        points[:, self._columns()] += z * self.sizes.spread(t) @ self.sizes.matrix.T  # none occurs twice
        return points

    def by_coordinates(self, jacobian: Float[np.ndarray, "*n names"]) -> Float[np.ndarray, "*n k"]:
        """Derivatives by the coordinates t z of the errors from those by the deviations."""
        return jacobian[..., self._columns()] @ self.sizes.matrix

    def pull_back(
        self, y: Float[np.ndarray, " p"], z: Float[np.ndarray, "n k"], jacobian: Float[np.ndarray, "n m names"]
    ) -> Float[np.ndarray, "n m p"]:
        """Derivatives by y from those by the deviations, at standard points z."""
        d = len(self.designs)
        found = np.empty((*jacobian.shape[:2], self.size))
        found[:, :, :d] = jacobian[:, :, :d] * (self.design_upper - self.design_lower)
        along = self.by_coordinates(jacobian) * z[:, None]
        for place, size in enumerate(self.free):
            found[:, :, d + place] = along[:, :, self.sizes.owner == size].sum(axis=2) * self.width_slopes(y)[place]
        return found

    def by_errors(
        self, y: Float[np.ndarray, " p"], jacobian: Float[np.ndarray, "n m names"]
    ) -> Float[np.ndarray, "n m k"]:
        """Derivatives by the standard points from those by the deviations."""
        return self.by_coordinates(jacobian) * self.sizes.spread(self.widths(y))

    def reaches(self, y: Float[np.ndarray, " p"]) -> Float[np.ndarray, " names"]:
        """How far each deviation may be away at y: half the range of a design, the half-width of an error."""
        found = np.zeros(len(self.names))
        found[self._columns()] = self.sizes.reaches(self.widths(y))
        found[: len(self.designs)] = 0.5 * (self.design_upper - self.design_lower)
        return found

    def _columns(self) -> list[int]:
        """Place of every error among `names`."""
        return [self.names.index(name) for name in self.errors]

    def named_values(self, y: Float[np.ndarray, " p"]) -> dict[str, float]:
        """{design: value} at y."""
        return dict(zip(self.designs, map(float, self.values(y)), strict=True))

    def named_widths(self, y: Float[np.ndarray, " p"]) -> dict[str, float]:
        """{error: half-width, or zone: diameter} at y, of all tolerances."""
        return dict(zip(self.sizes.names, map(float, self.widths(y)), strict=True))

    def at_bounds(self, y: Float[np.ndarray, " p"], tolerance: float = 1e-6) -> dict[str, str]:
        """{design or error: "smallest" | "largest"} of the variables that are at a bound; a tolerance of a design is
        called "tolerance of NAME"."""
        free = [self.sizes.names[i] for i in self.free]
        labels = (*self.designs, *(f"tolerance of {name}" if name in self.designs else name for name in free))
        return at_ends(labels, y, np.full(len(y), tolerance), np.full(len(y), 1.0 - tolerance))


def at_ends(
    names: Sequence[str], values: Float[np.ndarray, " n"], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]
) -> dict[str, str]:
    """{name: "smallest" | "largest"} of the values that are not between low and high."""
    ends = {name: "smallest" for name, value, end in zip(names, values, low, strict=True) if value <= end}
    return ends | {name: "largest" for name, value, end in zip(names, values, high, strict=True) if value >= end}


def separate_widths(
    widths: Mapping[str, float | tuple[float, float]],
) -> tuple[Float[np.ndarray, " v"], tuple[int, ...], Float[np.ndarray, " free"], Float[np.ndarray, " free"]]:
    """Half-widths (v,), the places of those to be found, and their smallest and largest values, from {error:
    half-width, or (smallest, largest)}; a half-width to be found begins in the middle of its bounds."""
    values, free, bounds = [], [], []
    for i, width in enumerate(widths.values()):
        if isinstance(width, tuple):
            free.append(i)
            bounds.append(width)
            values.append(float(np.sqrt(abs(width[0] * width[1]))))
        else:
            values.append(width)
    lower, upper = np.array(bounds).reshape(-1, 2).T
    return np.array(values, dtype=float), tuple(free), lower, upper
