"""What a study asks of its mechanism at rest: the table [statics].

Place in the pipeline: study file -> **statics** -> Study -> `rfem-jax statics`, and the tasks, whose metrics are then
those of the mechanism at rest.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, Problems, require_choice
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.drives.driven_motions import motion_label
from rfem_jax.description.mechanism.mechanism import STARTS, Mechanism
from rfem_jax.description.parameters.parameters import parameters_of

MOST_POSITIONS = 100_000
_EXAMPLES = {"positions": '["0 deg", "30 deg"]', "rates": '"60 rpm"', "accelerations": '"100 rad/s^2"'}
DIMENSIONS_OF = {  # of what moves along an axis, and about one
    "positions": ("length", "angle"),
    "rates": ("speed", "rate"),
    "accelerations": ("acceleration", "angular_acceleration"),
}


@dataclass(frozen=True)
class Statics(ChecksItself):
    """A mechanism at rest, or of rigid links in given motion: what holds it, where, and how that moves.

    Args:
        hold: joint or joints that are held besides those of drives and of `positions`, as "A", of a joint with several
            free motions "C.T_y".
        positions: {joint, or joint and motion: its position or a list of positions}, in rad, m or with units; lists
            are of one length, a single position is for all. None: the start.
        rates: {joint, or joint and motion: its rate or a list of rates, one for each position}, in rad/s, m/s or with
            units: of a mechanism of rigid links, whose loads are then those of this motion. None: at rest.
        accelerations: likewise, in rad/s^2, m/s^2.
        start: "as_given": freedoms that nothing holds are held at their start, too; "equilibrium": they settle. None =
            as the mechanism says ("as_given").
    Raises:
        InputError: a value is of the wrong kind.
    """

    hold: str | tuple[str, ...] = ()
    positions: dict[str, Any] = field(default_factory=dict)
    rates: dict[str, Any] = field(default_factory=dict)
    accelerations: dict[str, Any] = field(default_factory=dict)
    start: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("hold", _names)
        for name, example in _EXAMPLES.items():
            checks.convert(name, _table, name, example)
        if self.start is not None:
            checks.convert("start", require_choice, STARTS, "start")

    def resolved(self, mechanism: Mechanism) -> "Statics":
        """The same with names and positions as the mechanism has them. Raises InputError."""
        problems = Problems()
        hold: dict[str, None] = {}
        for name in self.hold:
            with problems.noted():
                hold[_motion_of(mechanism, name, "hold")[0]] = None
        given = {what: self._values(mechanism, what, problems) for what in _EXAMPLES}
        problems.refuse()
        count = max((len(values) for of in given.values() for values in of.values()), default=1)
        for what, of in given.items():
            for label, values in of.items():
                if not values or len(values) not in (1, count) or count > MOST_POSITIONS:
                    raise InputError(
                        f"Argument `{what}` must have lists of one length from 1 to {MOST_POSITIONS}, but `{label}` "
                        f"has {len(values)} and another one {count}; make them alike, or give a single value for all."
                    )
        return replace(self, hold=tuple(hold), **given)

    def _values(self, mechanism: Mechanism, what: str, problems: Problems) -> dict[str, tuple[float, ...]]:
        """Positions, rates or accelerations in SI units, by the names that results have."""
        found: dict[str, tuple[float, ...]] = {}
        for name, values in getattr(self, what).items():
            with problems.noted():
                label, motion = _motion_of(mechanism, name, what)
                if label in found:
                    raise InputError(f"Argument `{what}` must name `{label}` once, but does twice; leave one out.")
                listed = values if isinstance(values, (list, tuple)) else (values,)
                dimension = DIMENSIONS_OF[what][motion.startswith("R")]
                found[label] = tuple(quantity(one, dimension, f"{what}.{label}") for one in listed)
        return found

    @property
    def moves(self) -> bool:
        """Whether it asks for loads in motion."""
        return bool(self.rates or self.accelerations)

    def held(self, mechanism: Mechanism) -> Mechanism:
        """The mechanism of which this holds the coordinates, before those of its drives."""
        drives = [
            motion_label(joint, mechanism.joint(joint).kind, motion) for joint, motion in mechanism.driven_motions
        ]
        names = tuple(dict.fromkeys((*self.positions, *self.rates, *self.accelerations, *self.hold, *drives)))
        start = mechanism.start if self.start is None else self.start
        return replace(mechanism, driven_joint=names or None, start=start)


def _names(value: object) -> tuple[str, ...]:
    names = (value,) if isinstance(value, str) else value
    if not isinstance(names, (list, tuple)) or any(not isinstance(name, str) for name in names):
        raise InputError(
            f'Argument `hold` must be a name of a joint or a list of names, but was {value!r}; write for example "A".'
        )
    return tuple(names)


def _table(value: object, name: str, example: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(
            f"Argument `{name}` must be a table of joints and their {name}, but was {value!r}; write for example "
            f"{{ A = {example} }}."
        )
    return dict(value)


def _motion_of(mechanism: Mechanism, name: str, argument: str) -> tuple[str, str]:
    """Name of a free motion as results have it, and the motion. Raises InputError."""
    try:
        ((joint, motion),) = replace(mechanism, driven_joint=name).driven_motions
    except InputError as error:
        where = f"Argument `{argument}` of [statics]"
        told = (re.sub("^Argument `(driven_joint|name)`", where, one) for one in error.problems)
        raise InputError(*told) from None
    return motion_label(joint, mechanism.joint(joint).kind, motion), motion


def require_no_drive(mechanism: Mechanism, names: Iterable[str], where: str) -> None:
    """Raise InputError for numbers of drives, which do nothing in the tasks of a study with [statics]."""
    known = parameters_of(mechanism)
    of_drives = [name for name in names if name.startswith("drive.") and name not in known]
    if of_drives:
        raise InputError(
            f"Argument {where} must name what acts at rest, since the study has [statics], but has `{of_drives[0]}`; "
            "leave it out."
        )
