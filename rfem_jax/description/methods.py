"""Method: the name of an integration method and its settings.

Place in the pipeline: specified in a study; `simulation` turns it into a solver.

Symbols: step h [s]; rtol, atol [1] relative and absolute tolerance of adaptive steps; stabilisation
[1] dimensionless Baumgarte gain; accuracy [1] relative accuracy asked of the method "auto".
Source: theory (3.12), (3.13), (5.7), (7.1) to (7.7), (11.4).
"""

from dataclasses import dataclass, fields
from numbers import Real
from typing import Any

from rfem_jax.description.errors import ChecksItself, InputError, require_choice
from rfem_jax.description.units import non_negative_quantity, positive_quantity

ADAPTIVE_METHODS = ("tsit5", "dopri5", "dopri8", "bosh3", "heun", "midpoint", "ralston")
FIXED_METHODS = ("rk4", "leapfrog")
IMPLICIT_METHODS = ("generalised_alpha",)
METHODS = (*FIXED_METHODS, *IMPLICIT_METHODS, *ADAPTIVE_METHODS, "auto")

# Which settings a method has; all others must be left out.
SETTINGS_OF: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(FIXED_METHODS, ("step", "stabilisation")),
    **dict.fromkeys(IMPLICIT_METHODS, ("step", "spectral_radius", "corrections", "tolerance")),
    **dict.fromkeys(ADAPTIVE_METHODS, ("step", "rtol", "atol", "stabilisation")),
    "auto": ("accuracy", "stabilisation"),
}
_DIMENSIONS = {"step": "time"}  # of the settings that have one
_MAY_BE_ZERO = ("stabilisation", "spectral_radius")
_BELOW_ONE = {
    "accuracy": "it is a relative error, such as 1e-4",
    "spectral_radius": "the joint loads would oscillate from step to step; the default is 0.6",
    "tolerance": "it is a share of the largest joint load, such as 1e-08",
}
_DEFAULTS = {"spectral_radius": 0.6, "corrections": 5, "tolerance": 1e-8}


@dataclass(frozen=True)
class Method(ChecksItself):
    """An integration method; numbers in SI or strings with a unit.

    Args:
        name: "rk4" (classical Runge-Kutta 4), "leapfrog", "generalised_alpha", an explicit solver of diffrax
            by its lower-case name ("tsit5", "dopri5", "dopri8", ...), or "auto".
        step: h [s], > 0; needed by "rk4", "leapfrog" and "generalised_alpha". The solvers of diffrax take
            either a step (fixed) or both tolerances (adaptive).
        rtol, atol: tolerances, > 0.
        stabilisation: Baumgarte gain, >= 0; None = the default, 0 = none.
        accuracy: > 0, < 1; for "auto" only, which chooses step and tolerances itself.
        spectral_radius: of "generalised_alpha" at infinite frequency, from 0 (such vibrations vanish in one
            step) to below 1 (they stay); default 0.6.
        corrections: largest number of Newton increments in a step of "generalised_alpha"; at least 1, default 5.
        tolerance: largest residual allowed, as a share of the largest joint load, > 0, < 1; default 1e-8.
    Raises:
        InputError: an unknown name, a value out of range, or settings that do not fit the method.
    """

    name: str = "rk4"
    step: float | None = None
    rtol: float | None = None
    atol: float | None = None
    stabilisation: float | None = None
    accuracy: float | None = None
    spectral_radius: float | None = None
    corrections: int | None = None
    tolerance: float | None = None

    def __post_init__(self):
        require_choice(self.name, METHODS, "`name` of the method")
        for field in SETTINGS_OF[self.name]:
            self._set(field)
        for field in (one.name for one in fields(self) if one.name != "name"):
            if getattr(self, field) is not None and field not in SETTINGS_OF[self.name]:
                others = ", ".join(f'"{name}"' for name, settings in SETTINGS_OF.items() if field in settings)
                raise InputError(
                    f'Argument `{field}` must be left out with the method "{self.name}", but was given; remove it, or '
                    f"take a method that has it ({others})."
                )
        if self.name in ADAPTIVE_METHODS:
            self._check_adaptive()
        elif self.name != "auto" and self.step is None:
            raise InputError(
                f'Argument `step` must be given for the method "{self.name}", but is missing; '
                f"add for example step = {'1e-3' if self.implicit else '1e-5'}."
            )

    @property
    def adaptive(self) -> bool:
        """True if the method chooses its steps from tolerances."""
        return self.rtol is not None

    @property
    def implicit(self) -> bool:
        """True if every step solves equations."""
        return self.name in IMPLICIT_METHODS

    def _set(self, field: str) -> None:
        """Check and convert one setting; one that is left out takes its default, if it has one."""
        given = getattr(self, field)
        given = _DEFAULTS.get(field) if given is None else given
        if given is None:
            return
        where = f"`{field}` of the method"
        if field == "corrections":
            value = self._whole(given)
        else:
            convert = non_negative_quantity if field in _MAY_BE_ZERO else positive_quantity
            value = convert(given, _DIMENSIONS.get(field, "none"), where)
        if field in _BELOW_ONE and value >= 1.0:
            raise InputError(f"Argument `{field}` must be less than 1, but is {value:g}; {_BELOW_ONE[field]}.")
        object.__setattr__(self, field, value)

    @staticmethod
    def _whole(count: Any) -> int:
        if isinstance(count, bool) or not isinstance(count, Real) or not float(count).is_integer() or count < 1:
            raise InputError(
                f"Argument `corrections` must be a whole number of at least 1, but is {count}; the "
                f"default is {_DEFAULTS['corrections']}."
            )
        return int(float(count))

    def _check_adaptive(self) -> None:
        tolerances = self.rtol is not None or self.atol is not None
        if self.step is not None and tolerances:
            raise InputError(
                f'Argument `step` of the method "{self.name}" must be given or else `rtol` and '
                "`atol`, but both are; keep the step for fixed steps, the tolerances for adaptive "
                "ones."
            )
        if self.step is None and (self.rtol is None or self.atol is None):
            raise InputError(
                f'Argument `step` of the method "{self.name}" must be given or else both `rtol` '
                "and `atol`, but neither is complete; add for example rtol = 1e-8 and atol = 1e-10."
            )
