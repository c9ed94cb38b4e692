"""Which assembly errors exist: their names, dimensions and what they mean.

Place in the pipeline: `mechanism` lists the names of its errors, `study` checks those of its cases,
`mechanics` turns them into transforms.

Names: JOINT.delta_x, .delta_y, .delta_z [rad], .d_x, .d_y, .d_z [m] displace the joint's seat in its parent;
JOINT.child.delta_x ... the bore in the child; JOINT.pin_tilt_x, .pin_tilt_z [rad] tilt one pin in
both links (nothing stressed at the start angle); LINK.length [m]; LINK.twist [rad]. Which of them a joint has
depends on its kind (`joint_kinds`). Source: theory (2.3) to (2.5), (2.17).
"""

import math

from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.description.joint_kinds import KINDS, joint_errors

JOINT_ERRORS = {name: dimension for kind in KINDS.values() for name, dimension in joint_errors(kind).items()}
LINK_ERRORS = {"length": "length", "twist": "angle"}
_KNOWN = {**JOINT_ERRORS, **LINK_ERRORS}


def error_dimension(name: object) -> str:
    """Return "angle" or "length" for the error `name`, such as "D.delta_x" or "coupler.length".

    Raises:
        InputError: the part after the joint's or link's name is no error's name.
    """
    owner, dot, component = str(name).partition(".")
    if not (owner and dot):
        raise InputError(
            "Argument `name` of an error must be a joint or a link, a dot and the kind of error, "
            f'but was {name!r}; write for example "D.delta_x" or "coupler.length".'
        )
    if component not in _KNOWN:
        raise InputError(
            "Argument `name` of an error must end in a known kind of error, but "
            f"`{component}` in `{name}` is none; {suggestion(component, _KNOWN)}"
        )
    return _KNOWN[component]


def as_specified(unit: str) -> tuple[str, float]:
    """Unit in which users write an error of the SI unit "rad" or "m", and the factor to it."""
    return {"rad": ("deg", math.degrees(1.0)), "m": ("mm", 1e3)}[unit]


def error_unit(name: str) -> str:
    """Return the SI unit, "rad" or "m", of the error `name`; raises as `error_dimension`."""
    return "rad" if error_dimension(name) == "angle" else "m"
