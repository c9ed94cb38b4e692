"""Clearance of a joint: the play of a pin in its bush, and the law of the contacts that hold it there.

Place in the pipeline: a `Joint` holds it; `mechanics` frees the directions that the kind holds, and puts the contact
between the frames on parent and child in their place.

The pin has a length, and touches the bush at its two ends, so that contacts carry tilting moments; an axial stop in
its middle acts both ways. Source: theory (15.1) to (15.8).
"""

from dataclasses import dataclass
from typing import Any

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_choice
from rfem_jax.description.basics.iso_fits import clearance_fit, is_fit
from rfem_jax.description.basics.numbers import (
    NOT_NEGATIVE,
    POSITIVE,
    Fields,
    NumberTree,
    is_known,
    non_negative_number,
    positive_number,
)
from rfem_jax.description.basics.units import Quantity, positive_quantity

PINS = ("child", "parent")
_LENGTHS = {"axial": non_negative_number, "length": positive_number}
_OPTIONAL = {  # of what may be left out: how it is read, and its dimension
    "diameter": (positive_number, "length"),
    "damping": (non_negative_number, "contact_damping"),
    "restitution": (non_negative_number, "none"),
    "friction": (non_negative_number, "none"),
    "sliding_speed": (positive_number, "speed"),
}


@dataclass(frozen=True)
class Clearance(NumberTree, ChecksItself):
    """The play of a pin in its bush: two contacts at the pin's ends and an axial stop in its middle.

    A contact that is pressed in by delta and goes on at the rate delta' pushes with K delta^n (1 + chi delta'), and
    never pulls. With `damping` chi is that number (Hunt and Crossley); with `restitution` r it is
    3 (1 - r^2) / (4 v), v the speed at which this contact began (Lankarani and Nikravesh), which needs the implicit
    method; without both contacts are elastic. Friction acts against sliding of the pin's surface at a contact.

    Steps of the implicit method are divided where contacts need it (its `contact_tolerance`), and those of an adaptive
    one follow contacts; other fixed steps do not: take a tenth of what a contact lasts. Where they are too long the
    energy is off; from a twentieth on the status of a run is `contact_not_resolved`.

    Args:
        radial: [m] clearance between the radii of bush and pin, >= 0: half the difference of the diameters; or the ISO
            code of a fit, as "20 H7/f7", which means the middle of its clearances.
        length: [m] of the pin, centred on the joint's point on the link that holds the pin: its ends are where it
            touches.
        stiffness: K of each of the two contacts at the ends [N/m^n], as "50 kN/mm" with n = 1, "60 kN/mm^1.5" with
            n = 1.5, a plain number with others; of one contact over the whole length take half its stiffness.
        axial: [m] clearance along the axis, >= 0, on each side of the middle.
        exponent: n, from 1 (surfaces that conform) to 3; 1.5 of Hertz.
        axial_stiffness: K of the axial stop in N/m^n; None = `stiffness`.
        axial_exponent: n of the axial stop; None = `exponent`.
        damping: chi [s/m], >= 0, the same at all speeds.
        restitution: coefficient r from 0 to 1 of Lankarani and Nikravesh.
        slowest_approach: [m/s] speed that approaching counts as at least, as of contacts closed at the start.
        friction: Coulomb's coefficient at the contacts, >= 0; None = none.
        diameter: [m] of the pin, at which its surface slides; needed with `friction`.
        sliding_speed: [m/s] of the smooth sign tanh(v / sliding_speed) of friction, far below speeds of interest;
            needed with `friction`.
        pin: the link that holds the pin, "child" or "parent"; the other one holds the bush.
        centring: [N/m] stiffness of a weak spring between the axes that holds a pin which nothing else holds; results
            tell its force.
    Raises:
        InputError: a value is out of range or of the wrong kind, missing, or not used.
    """

    radial: Quantity
    length: Quantity
    stiffness: Quantity
    axial: Quantity = 0.0
    exponent: Quantity = 1.5
    axial_stiffness: Quantity | None = None
    axial_exponent: Quantity | None = None
    damping: Quantity | None = None
    restitution: Quantity | None = None
    slowest_approach: Quantity = 1e-3
    friction: Quantity | None = None
    diameter: Quantity | None = None
    sliding_speed: Quantity | None = None
    pin: str = "child"
    centring: Quantity = 1e-3

    def _check_fields(self, checks: Checks) -> None:
        of = "of a clearance"
        checks.convert("radial", _radial, f"`radial` {of}")
        for name, read in _LENGTHS.items():
            checks.convert(name, read, "length", f"`{name}` {of}")
        checks.convert("exponent", _exponent, f"`exponent` {of}")
        if self.axial_exponent is not None:
            checks.convert("axial_exponent", _exponent, f"`axial_exponent` {of}")
        for name, exponent in (("stiffness", "exponent"), ("axial_stiffness", "axial_exponent")):
            if getattr(self, name) is not None and checks.passed("exponent", exponent):
                checks.convert(name, positive_number, stiffness_dimension(self, name), f"`{name}` {of}")
        for name, (read, dimension) in _OPTIONAL.items():
            if getattr(self, name) is not None:
                checks.convert(name, read, dimension, f"`{name}` {of}")
        checks.convert("slowest_approach", positive_number, "speed", f"`slowest_approach` {of}")
        checks.convert("pin", require_choice, PINS, f"`pin` {of}")
        checks.convert("centring", positive_number, "stiffness", f"`centring` {of}")
        checks.relation(("exponent", "axial_exponent"), self._check_axial)
        checks.relation(("damping", "restitution"), self._check_dampers)
        checks.relation(("friction", "diameter", "sliding_speed"), self._check_friction)

    @property
    def numbers(self) -> Fields:
        """Its numbers; the dimensions of stiffnesses follow from its exponents."""
        return {
            "radial": ("length", NOT_NEGATIVE),
            "axial": ("length", NOT_NEGATIVE),
            "length": ("length", POSITIVE),
            "diameter": ("length", POSITIVE),
            **{name: (stiffness_dimension(self, name), POSITIVE) for name in ("stiffness", "axial_stiffness")},
            "damping": ("contact_damping", NOT_NEGATIVE),
            "restitution": ("none", NOT_NEGATIVE),
            "slowest_approach": ("speed", POSITIVE),
            "friction": ("none", NOT_NEGATIVE),
            "sliding_speed": ("speed", POSITIVE),
            "centring": ("stiffness", POSITIVE),
        }

    @property
    def of_stop(self) -> tuple[Any, Any]:
        """Stiffness K [N/m^n] and exponent n of the axial stop."""
        exponent = self.exponent if self.axial_exponent is None else self.axial_exponent
        return (self.stiffness if self.axial_stiffness is None else self.axial_stiffness), exponent

    def _check_axial(self) -> None:
        if self.axial_stiffness is None and self.axial_exponent not in (None, self.exponent):
            raise InputError(
                "Argument `axial_stiffness` of a clearance must be given with an `axial_exponent` other than "
                "`exponent`, but is missing; its unit is another one than that of `stiffness`."
            )

    def _check_dampers(self) -> None:
        if self.damping is not None and self.restitution is not None:
            raise InputError(
                "Argument `restitution` of a clearance must be left out with `damping`, but both are given; keep the "
                "fixed chi or the one that follows from restitution and the speed of approach."
            )
        restitution: Any = self.restitution
        if restitution is not None and is_known(restitution) and restitution > 1.0:
            raise InputError(
                f"Argument `restitution` of a clearance must be at most 1, but was {restitution}; 1 loses nothing."
            )

    def _check_friction(self) -> None:
        beside = {"diameter": self.diameter, "sliding_speed": self.sliding_speed}
        for name, value in beside.items():
            if self.friction is not None and value is None:
                raise InputError(
                    f"Argument `{name}` of a clearance must be given with `friction`, but is missing; give it."
                )
        if self.friction is None and self.sliding_speed is not None:
            raise InputError(
                "Argument `sliding_speed` of a clearance must be left out without `friction`, but was given; remove "
                "it, or give the coefficient of friction."
            )


def _radial(value: Any, where: str) -> Any:
    """A radial clearance [m], of a fit the middle one."""
    if is_fit(value):
        return clearance_fit(value, "radial").radial[0]
    return non_negative_number(value, "length", where)


def _exponent(value: Any, where: str) -> float:
    number = positive_quantity(value, "none", where)
    if not 1.0 <= number <= 3.0:
        raise InputError(
            f"Argument {where} must be from 1 to 3, but was {value}; conforming surfaces have 1, Hertz's contacts 1.5."
        )
    return number


def stiffness_dimension(clearance: Clearance, name: str) -> str:
    """Dimension of the field `stiffness` or `axial_stiffness`, which the exponent decides; "none" (N/m^n) of exponents
    that no unit is known for."""
    exponent: Any = clearance.of_stop[1] if name == "axial_stiffness" else clearance.exponent
    return {1.0: "stiffness", 1.5: "hertz_stiffness"}.get(exponent, "none")
