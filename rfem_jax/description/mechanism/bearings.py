"""Capacities of bearings: what a joint carries, for metrics that compare its loads with that.

Place in the pipeline: a `Joint` holds it -> `mechanics.model` -> `design_metrics`. It changes no motion and no load.
Source: theory (8.15) and (8.16); ISO 281 (dynamic capacity, life), ISO 76 (static capacity).
"""

from dataclasses import dataclass

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_choice
from rfem_jax.description.basics.numbers import NumberTree
from rfem_jax.description.basics.units import Quantity, positive_quantity

# Exponent of the load in the life of rolling bearings, as a fraction (ISO 281).
LIFE_EXPONENTS = {"ball": (3, 1), "roller": (10, 3)}
CAPACITIES = {"dynamic_capacity": "force", "static_capacity": "force", "moment_capacity": "moment"}


@dataclass(frozen=True)
class Bearing(NumberTree, ChecksItself):
    """What the bearing of a joint carries; at least one capacity.

    Args:
        dynamic_capacity: basic dynamic load rating C [N], the load of a life of a million revolutions; for life and
            damage.
        static_capacity: largest force [N] that it may carry at any instant; for the ratio of forces.
        moment_capacity: largest moment [N m] across or about its axis at any instant; for the ratio of moments.
        rolling: "ball" (life by the third power of the load) or "roller" (by the power 10/3).
    Raises:
        InputError: a value is out of range or of the wrong kind, or no capacity is given.
    """

    dynamic_capacity: Quantity | None = None
    static_capacity: Quantity | None = None
    moment_capacity: Quantity | None = None
    rolling: str = "ball"

    def _check_fields(self, checks: Checks) -> None:
        for name, dimension in CAPACITIES.items():
            if getattr(self, name) is not None:
                checks.convert(name, positive_quantity, dimension, f"`{name}` of a bearing")
        checks.convert("rolling", require_choice, tuple(LIFE_EXPONENTS), "`rolling` of a bearing")
        checks.relation(tuple(CAPACITIES), self._require_any)

    def _require_any(self) -> None:
        if not self.capacities:
            raise InputError(
                "Argument `bearing` of a joint must have a capacity, but none is given; give `dynamic_capacity`, "
                "`static_capacity` or `moment_capacity`, or leave the bearing out."
            )

    @property
    def capacities(self) -> tuple[str, ...]:
        """Names of the capacities that are given."""
        return tuple(name for name in CAPACITIES if getattr(self, name) is not None)
