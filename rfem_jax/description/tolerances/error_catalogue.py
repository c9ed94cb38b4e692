"""Which assembly errors exist: their names, dimensions and what they mean.

Place in the pipeline: `mechanism` lists the names of its errors, `study` checks those of its cases,
`mechanics` turns them into transforms.

Names: JOINT.delta_x, .delta_y, .delta_z [rad], .d_x, .d_y, .d_z [m] displace the joint's seat in its parent;
JOINT.child.delta_x ... the bore in the child; JOINT.pin_tilt_x, .pin_tilt_z [rad] tilt one pin in
both links (nothing stressed at the start angle); LINK.length [m]; LINK.twist [rad]; LINK.bow_y, .bow_z [m], errors of
form, with which the twist is one, too. Which of them a joint has depends on its kind (`joint_kinds`). Source: theory
(1.26), (1.32), (2.3) to (2.5), (2.17).
"""

import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType

from rfem_jax.description.basics.errors import InputError, nearest, suggestion
from rfem_jax.description.basics.joint_kinds import KINDS, joint_errors

JOINT_ERRORS = {name: dimension for kind in KINDS.values() for name, dimension in joint_errors(kind).items()}
LINK_ERRORS = {"length": "length", "twist": "angle"}
BOWS = ("bow_y", "bow_z")  # of links with errors of form
_KNOWN = {**JOINT_ERRORS, **LINK_ERRORS, **dict.fromkeys(BOWS, "length")}
NO_BOW = (
    "errors of form are of straight links with a section and `form_errors = True` (studies that name them set it); of "
    "a link with an axis its points may deviate."
)
_parameters: ContextVar[Mapping[str, str] | None] = ContextVar("parameters", default=MappingProxyType({}))


def error_dimension(name: object, also: Collection[str] = ()) -> str:
    """Return "angle" or "length" for the error `name`, such as "D.delta_x" or "coupler.length", and the dimension of
    a parameter while a study with it is read (`reading_parameters`); `also`: what else may be meant, after a joint's
    name and a dot.

    Raises:
        InputError: the part after the joint's or link's name is no error's name; without a sentence where it is not
            near to one, and may be a parameter of a mechanism that could not be read.
    """
    parameters = _parameters.get()
    owner, dot, component = str(name).partition(".")
    if parameters is None:
        if not (owner and dot) or nearest(component, _KNOWN) is None:
            raise InputError()
        parameters = {}
    if component not in _KNOWN and str(name) in parameters:
        return parameters[str(name)]
    if not (owner and dot):
        raise InputError(
            "Argument `name` of an error must be a joint or a link, a dot and the kind of error, "
            f'but was {name!r}; write for example "D.delta_x" or "coupler.length".'
        )
    if owner == "drive":
        raise InputError(
            "Argument `name` of an error must not be of a drive, which all cases share, but is "
            f"`{name}`; vary it by [sweep] or [tolerances], or make a study of its own."
        )
    if component.startswith("temperature_gradient_"):
        raise InputError(
            f"Argument `name` of an error must be of a flexible link that grows with its temperature, but `{owner}` is "
            "rigid, or nothing says by how much it grows; make it flexible, or give it `thermal_expansion`."
        )
    if component == "temperature":
        raise InputError(
            f"Argument `name` of an error must be of what grows with its temperature, but nothing says by how much "
            f"`{owner}` does; give `thermal_expansion` of its material, of the link, or in [mechanism.base]."
        )
    if component not in _KNOWN:
        raise InputError(
            "Argument `name` of an error must end in a known kind of error, but "
            f"`{component}` in `{name}` is not one; {_suggestion(str(name), component, parameters, also)}"
        )
    return _KNOWN[component]


def parameters_being_read() -> Mapping[str, str]:
    """{name: dimension} of the parameters of the study that is read now; empty outside of `reading_parameters`."""
    return _parameters.get() or {}


def knows_dimension(name: object) -> bool:
    """Whether `error_dimension` knows a name, or refuses it with all names of a study at hand."""
    if _parameters.get():
        return True
    try:
        return bool(error_dimension(name))
    except InputError:
        return False


def _suggestion(name: str, component: str, parameters: Mapping[str, str], also: Collection[str]) -> str:
    """The nearest kind of error or parameter; where none is near, kinds of errors and the parameters of this owner."""
    kinds = (*also, *_KNOWN)
    if nearest(component, kinds) is None and nearest(name, parameters) is not None:
        return suggestion(name, parameters)
    owner = f"{name.partition('.')[0]}."
    return suggestion(component, (*kinds, *(one for one in parameters if one.startswith(owner))))


@contextmanager
def reading_parameters(dimensions: Mapping[str, str] | None) -> Iterator[None]:
    """Within the block `error_dimension` knows the dimensions {name: dimension} of a mechanism's parameters, too: what
    a study file gives deviations to. None: the mechanism could not be read, and may have any parameter."""
    before = _parameters.set(dimensions)
    try:
        yield
    finally:
        _parameters.reset(before)


def as_specified(unit: str) -> tuple[str, float]:
    """Unit in which users write an error of the SI unit "rad" or "m", and the factor to it; other units stay."""
    return {"rad": ("deg", math.degrees(1.0)), "m": ("mm", 1e3)}.get(unit, (unit, 1.0))


def error_unit(name: str) -> str:
    """Return the SI unit, "rad" or "m", of the error `name`; raises as `error_dimension`."""
    return "rad" if error_dimension(name) == "angle" else "m"
