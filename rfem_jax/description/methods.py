"""Method: the name of an integration method and its settings.

Place in the pipeline: specified in a study; `simulation` turns it into a solver.

Symbols: step h [s]; rtol, atol [1] relative and absolute tolerance of adaptive steps; stabilisation
[1] dimensionless Baumgarte gain; accuracy [1] relative accuracy asked of the method "auto".
Source: theory (3.12), (3.13), (5.7), (7.1) to (7.7), (11.4).
"""

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

from rfem_jax.description.errors import ChecksItself, InputError, require_choice
from rfem_jax.description.units import Quantity, non_negative_quantity, positive_quantity

ADAPTIVE_METHODS = ("tsit5", "dopri5", "dopri8", "bosh3", "heun", "midpoint", "ralston")
FIXED_METHODS = ("rk4", "leapfrog")
IMPLICIT_METHODS = ("generalised_alpha",)
METHODS = (*FIXED_METHODS, *IMPLICIT_METHODS, *ADAPTIVE_METHODS, "auto")
SPECTRAL_RADIUS, CORRECTIONS, TOLERANCE = 0.6, 5, 1e-8


_IMPLICIT_SETTINGS = {
    "spectral_radius": SPECTRAL_RADIUS, "corrections": CORRECTIONS, "tolerance": TOLERANCE
}  # fmt: skip


@dataclass(frozen=True)
class Method(ChecksItself):
    """An integration method; numbers in SI or strings with a unit.

    Args:
        name: "rk4" (classical Runge-Kutta 4), "leapfrog", a diffrax explicit solver by its
            lower-case name, or "auto".
        step: h [s], > 0; needed by "rk4" and "leapfrog". The other diffrax solvers take
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
        self._set("step", positive_quantity, "time")
        self._set("rtol", positive_quantity, "none")
        self._set("atol", positive_quantity, "none")
        self._set("stabilisation", non_negative_quantity, "none")
        self._set("accuracy", positive_quantity, "none")
        self._check_implicit()
        tolerances = self.rtol is not None or self.atol is not None
        if self.name == "auto":
            self._check_auto(tolerances)
            return
        if self.accuracy is not None:
            raise InputError(
                'Argument `accuracy` must be left out unless the method is "auto", but the method '
                f'is "{self.name}"; remove it, or use method = "auto".'
            )
        if self.name in (*FIXED_METHODS, *IMPLICIT_METHODS) and tolerances:
            raise InputError(
                f'Arguments `rtol` and `atol` must be left out with the method "{self.name}", '
                'whose step is fixed, but were given; remove them, or use for example "dopri8".'
            )
        if self.name in (*FIXED_METHODS, *IMPLICIT_METHODS) and self.step is None:
            example = "1e-3" if self.implicit else "1e-5"
            raise InputError(
                f'Argument `step` must be given for the method "{self.name}", but is missing; '
                f"add for example step = {example}."
            )
        if self.name in ADAPTIVE_METHODS:
            self._check_adaptive(tolerances)

    @property
    def adaptive(self) -> bool:
        """True if the method chooses its steps from tolerances."""
        return self.rtol is not None

    @property
    def implicit(self) -> bool:
        """True if every step solves equations."""
        return self.name in IMPLICIT_METHODS

    def _check_implicit(self) -> None:
        for field, default in _IMPLICIT_SETTINGS.items():
            if not self.implicit and getattr(self, field) is not None:
                raise InputError(
                    f'Argument `{field}` must be left out unless the method is "generalised_alpha", '
                    f'but the method is "{self.name}"; remove it.'
                )
            if self.implicit and getattr(self, field) is None:
                object.__setattr__(self, field, default)
        if not self.implicit:
            return
        if self.stabilisation is not None:
            raise InputError(
                'Argument `stabilisation` must be left out with the method "generalised_alpha", which '
                "closes the joints in every step, but was given; remove it."
            )
        radius = self._set("spectral_radius", non_negative_quantity, "none")
        if radius is not None and radius >= 1.0:
            raise InputError(
                "Argument `spectral_radius` must be less than 1, but is "
                f"{radius:g}: the joint loads would oscillate from step to step; "
                f"the default is {SPECTRAL_RADIUS}."
            )
        tolerance = self._set("tolerance", positive_quantity, "none")
        if tolerance is not None and tolerance >= 1.0:
            raise InputError(
                f"Argument `tolerance` must be less than 1, but is {tolerance:g}; it is a share of the "
                f"largest joint load, such as {TOLERANCE:g}."
            )
        count = self.corrections
        if isinstance(count, bool) or not isinstance(count, Real) or count != int(count) or count < 1:
            raise InputError(
                f"Argument `corrections` must be a whole number of at least 1, but is {count}; the "
                f"default is {CORRECTIONS}."
            )

    def _check_auto(self, tolerances: bool) -> None:
        if self.step is not None or tolerances:
            raise InputError(
                'Arguments `step`, `rtol` and `atol` must be left out with the method "auto", '
                "which chooses them, but were given; remove them, or name the method."
            )
        if self.accuracy is not None and self.accuracy >= 1.0:
            raise InputError(
                f"Argument `accuracy` must be less than 1, but was {self.accuracy}; it is a "
                "relative error, such as 1e-4."
            )

    def _check_adaptive(self, tolerances: bool) -> None:
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

    def _set(self, field: str, convert: Callable[[Quantity, str, str], float], dimension: str) -> float | None:
        given = getattr(self, field)
        if given is None:
            return None
        value = convert(given, dimension, f"`{field}` of the method")
        object.__setattr__(self, field, value)
        return value
