"""What deviates from the nominal mechanism, by its names: errors of assembly as arrays over joints and links, and
numbers of the description.

Place in the pipeline: model, names and numbers -> **errors** -> designs, which put the numbers into the model;
with_errors, which applies what is left.
"""

import dataclasses
import warnings
from collections.abc import Mapping
from typing import NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import ArrayLike, Bool, Float

from rfem_jax.compilation.naming import Names
from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.parameters.parameters import ParameterNames, require_each_once
from rfem_jax.description.tolerances.error_catalogue import BOWS, NO_BOW, error_dimension
from rfem_jax.mechanics.algebra.reordering import rows
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.planar_loops import require_closable
from rfem_jax.mechanics.model.topology import Topology

NO_PARAMETERS = ParameterNames(())  # of a model that has lost its description
HALF_TURN = np.pi * (1.0 + 1e-12)  # rad


class Owners(NamedTuple):
    """Names of the joints and links that errors belong to, in the order of the arrays."""

    joints: tuple[str, ...]
    links: tuple[str, ...]

    def renamed(self, names: Names) -> "Owners":
        """With other names; called by `compilation.naming`."""
        return Owners(tuple(map(names.of, self.joints)), tuple(map(names.of, self.links)))


class AssemblyErrors(eqx.Module):
    """Errors of the assembly, all zero by default.

    seat, bore: (delta_x, delta_z [rad], d_x, d_y, d_z [m]) of every joint in its parent and child, and delta_y
    [rad] last where any joint may have it (`Topology.error_components`); pin: tilts [rad] about x and z of a crooked
    pin, on both sides at once; length [m] and twist [rad] of every link; bow [m] along y and z of every link,
    None where no link has errors of form; owners: whose errors these are, so that no other mechanism takes them for its
    own.
    """

    seat: Float[Array, "components joints"]
    bore: Float[Array, "components joints"]
    pin: Float[Array, "2 joints"]
    length: Float[Array, " links"]
    twist: Float[Array, " links"]
    bow: Float[Array, "2 links"] | None = None
    owners: Owners | None = eqx.field(static=True, default=None)


class Deviations(eqx.Module):
    """What deviates from the nominal mechanism.

    errors: of the assembly; parameters: deviations of numbers of the description from their values [SI units], by their
    full names, which `designed` adds to these.
    """

    errors: AssemblyErrors
    parameters: dict[str, Float[Array, ""]] = eqx.field(default_factory=dict)


Errors = Deviations | AssemblyErrors | Mapping[str, ArrayLike | str]  # or by names [rad, m, or strings with a unit]


@overload
def assembly_errors(model: Model, values: None = None) -> AssemblyErrors: ...


@overload
def assembly_errors(model: Model, values: Mapping[str, ArrayLike | str]) -> AssemblyErrors: ...


def assembly_errors(model: Model, values: Mapping[str, ArrayLike | str] | None = None) -> AssemblyErrors | Deviations:
    """The errors with the given names, every other one zero.

    **Arguments:** `values`: name -> number in rad or m, array scalar (traced or not), or a string
    with a unit; names as "D.delta_x", "D.d_y", "C.child.delta_z", "C.pin_tilt_x", "coupler.length".

    **Raises:** `InputError` for a name that the model does not have. A name of a number of the description, of which
    `deviations` tells, makes this a call of an earlier version, which warns.
    """
    found = deviations(model, values)
    if not found.parameters:
        return found.errors
    warnings.warn(
        f"`assembly_errors` makes errors of the assembly; {next(iter(found.parameters))!r} is a number of the "
        "description: write deviations(model, {...}), which a later version needs.",
        DeprecationWarning,
        stacklevel=2,
    )
    return found


def deviations(model: Model, values: Mapping[str, ArrayLike | str] | None = None) -> Deviations:
    """What deviates, by names of errors, as of `assembly_errors`, and of numbers of the description.

    **Arguments:** `values`: name -> number, array scalar (traced or not), or a string with a unit; beside errors
    [rad, m] any parameter of the model (`rfem_jax.parameters`), which then differs from its value by a number in its
    unit.

    **Raises:** `InputError` for what is no table, a name that the model does not have, and a parameter by both of its
    names.
    """
    if values is not None and not isinstance(values, Mapping):
        raise InputError(
            f"Argument `errors` must be errors from assembly_errors or a table of them by their names, but is "
            f'{values!r}; write for example {{"{model.topology.error_names[0]}": 0.001}}.'
        )
    _require_closable(model, values or {})
    errors, parameters = {}, {}
    names = NO_PARAMETERS if model.source is None else model.source.blueprint.names
    for name, value in (values or {}).items():
        require_number(name, value)
        if name in names and name not in model.topology.error_names:
            number = quantity(value, names[name].dimension, f"error {name!r}") if isinstance(value, str) else value
            parameters[name] = jnp.asarray(number, jnp.float64)
        else:
            errors[name] = value
    require_each_once([names[name] for name in parameters], "errors")
    parameters = {names[name].full: number for name, number in parameters.items()}
    return Deviations(_errors_by_name(model.topology, errors, names), parameters)


def _errors_by_name(topology: Topology, values: Mapping[str, ArrayLike | str], names: ParameterNames) -> AssemblyErrors:
    """The errors of the given names; `names`: of the model's numbers."""
    n_joints, n_links = len(topology.joints), topology.n_links
    parts = {
        "seat": np.zeros((len(topology.error_components), n_joints)),
        "bore": np.zeros((len(topology.error_components), n_joints)),
        "pin": np.zeros((2, n_joints)),
        "length": np.zeros(n_links),
        "twist": np.zeros(n_links),
    } | ({"bow": np.zeros((2, n_links))} if topology.formed else {})
    traced = []
    for name, value in values.items():
        part, place = _locate(topology, name, names.about(name))
        if isinstance(value, str):
            value = quantity(value, error_dimension(name), f"error {name!r}")
        if isinstance(value, Tracer):
            traced.append((part, place, value))
        else:
            parts[part][place] = value
    arrays = {part: jnp.asarray(values, jnp.float64) for part, values in parts.items()}
    errors = AssemblyErrors(**arrays, owners=Owners(topology.joints, topology.links))
    return _insert(errors, *zip(*traced)) if traced else errors


def _require_closable(model: Model, values: Mapping[str, ArrayLike | str]) -> None:
    """Raise InputError for traced errors that open planar loops of rigid links across their plane."""
    names = [name for name, x in values.items() if isinstance(x, Tracer)] if model.topology.across else []
    parameters = NO_PARAMETERS if model.source is None else model.source.blueprint.names
    numbers = [parameters[name].full for name in names if name in parameters]
    require_closable(model, [*(name for name in names if name in model.topology.error_names), *numbers], "errors")


def deviations_of(model: Model, errors: Errors | None) -> Deviations:
    """What deviates, as a function was given it: from `deviations` or `assembly_errors`, by names, or None for a
    perfect mechanism.

    **Raises:** `InputError` for anything else, and as `deviations`.
    """
    if isinstance(errors, Deviations):
        return errors
    if isinstance(errors, AssemblyErrors):
        return Deviations(errors)
    return deviations(model, errors)


def require_errors_of(topology: Topology, errors: AssemblyErrors) -> None:
    """Raise InputError for errors of a mechanism with other joints or links."""
    owners = Owners(topology.joints, topology.links) if errors.owners is None else errors.owners
    seats = len(topology.error_components), len(topology.joints)
    shapes = seats, seats, (2, len(topology.joints)), (topology.n_links,), (topology.n_links,)
    arrays = errors.seat, errors.bore, errors.pin, errors.length, errors.twist
    if (owners.joints, owners.links) == (topology.joints, topology.links):
        given = tuple(map(jnp.shape, arrays))
        if given == shapes:
            return
        raise InputError(
            f"Argument `errors` must be those of one assembly, but has arrays of the shape {given[0]} in the place of "
            f"{shapes[0]}; map over several assemblies by jax.vmap."
        )
    raise InputError(
        f"Argument `errors` must be errors of this mechanism, with joints {', '.join(topology.joints)} and links "
        f"{', '.join(topology.links)}, but is for joints {', '.join(owners.joints)} and links "
        f"{', '.join(owners.links)}; make it by assembly_errors(model, {{...}}) with the same model."
    )


def require_number(name: str, value: ArrayLike | str, argument: str = "errors") -> None:
    """Raise InputError for a value in a table that is neither a real number nor a string."""
    if isinstance(value, str):
        return
    kind = value.dtype.kind if isinstance(value, Tracer) else np.asarray(value).dtype.kind
    if kind not in "fiu" or np.ndim(value) != 0:
        what = f"an array of the shape {np.shape(value)}" if np.ndim(value) else repr(value)
        raise InputError(
            f"Argument `{argument}` must hold numbers, but {name!r} is {what}; give a number in SI units or a string "
            "with a unit, and map over several by jax.vmap."
        )


def sum_of(one: Deviations, other: Deviations) -> Deviations:
    """Sum of what deviates in two ways; a parameter may do so in one of them alone."""
    both = dict(one.parameters)
    for name, value in other.parameters.items():
        both[name] = both[name] + value if name in both else value
    return Deviations(jax.tree.map(jnp.add, one.errors, other.errors), both)


@Program
def _insert(
    errors: AssemblyErrors,
    parts: tuple[str, ...],
    places: tuple[int | tuple[int, int], ...],
    values: tuple[Float[Array, ""], ...],
) -> AssemblyErrors:
    """The errors with `values` at `places` of the arrays named `parts`."""
    arrays = {field.name: getattr(errors, field.name) for field in dataclasses.fields(errors)}
    for part in dict.fromkeys(parts):
        array, own = arrays[part], [i for i, one in enumerate(parts) if one == part]
        # All at once, and read, not written: of one after the other XLA would make a program of its own each.
        order = np.arange(array.size).reshape(array.shape)
        for n, i in enumerate(own):
            order[places[i]] = array.size + n
        arrays[part] = jnp.concatenate([array.reshape(-1), jnp.stack([values[i] for i in own])])[order]
    return AssemblyErrors(**arrays)


def _locate(topology: Topology, name: str, about: str) -> tuple[str, int | tuple[int, int]]:
    """Field of `AssemblyErrors` and place in it of a named error; `about`: what is known of a number that has no
    name."""
    if name not in topology.error_names:
        raise InputError(
            f"Argument `errors` must name errors of the model, but {name!r} is not one; "
            f"{about or (NO_BOW if name.endswith(BOWS) else suggestion(name, topology.error_names))}"
        )
    owner, *middle, kind = name.split(".")
    if kind in BOWS:
        return "bow", (BOWS.index(kind), topology.links.index(owner))
    if kind in ("length", "twist"):
        return kind, topology.links.index(owner)
    joint = topology.joints.index(owner)
    if kind.startswith("pin_tilt"):
        return "pin", (("pin_tilt_x", "pin_tilt_z").index(kind), joint)
    return ("bore" if middle else "seat"), (topology.error_components.index(kind), joint)


def require_possible(model: Model, errors: AssemblyErrors) -> None:
    """Raise InputError for errors that leave a link no length, or that turn anything by more than half a turn, if they
    are concrete numbers; traced errors have a status instead."""
    topology = model.topology
    leaves = model.length, errors.length, errors.seat, errors.bore, errors.pin, errors.twist
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return
    length, change, seat, bore, pin, twist = map(np.asarray, leaves)
    for name, long, more in zip(topology.links, length, change):
        if more <= -long:
            raise InputError(
                f"Argument `errors` must leave link `{name}` longer than 0, but its length is {long:g} m and the error "
                f"{more:g} m; give a smaller error."
            )
    tilts = [k for k, name in enumerate(topology.error_components) if name.startswith("delta")]
    for names, values in (
        (topology.joints, np.concatenate([seat[tilts], bore[tilts], pin])),
        (topology.links, twist[None]),
    ):
        largest = np.abs(values).max(axis=0)
        if (largest > HALF_TURN).any():
            place = int(np.nanargmax(largest))
            raise InputError(
                f"Argument `errors` must turn nothing by more than half a turn, but turns `{names[place]}` by "
                f"{largest[place]:g} rad; check the number and its unit."
            )


def possible_errors(model: Model, errors: AssemblyErrors) -> Bool[Array, ""]:
    """Whether all links have a length, and nothing is turned by more than half a turn, with the errors; what is NaN is
    left to the checks of assembly."""
    is_turn = np.array([name.startswith("delta") for name in model.topology.error_components])
    turns = [rows(side, np.flatnonzero(is_turn)).ravel() for side in (errors.seat, errors.bore)]
    turned = jnp.any(jnp.abs(jnp.concatenate([*turns, errors.pin.ravel(), errors.twist])) > HALF_TURN)
    return ~(turned | jnp.any(errors.length <= -model.length))
