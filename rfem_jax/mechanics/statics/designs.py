"""Designs: new values for numbers of a description, and the model that follows from them.

Place in the pipeline: model and its source, parameters -> **designs** -> statics, simulation.

A `Design` holds values, `Deviations.parameters` deviations from them. Of the model's arrays those are made anew,
by the formulas that made the nominal ones, that depend on a number that is set (theory (14.1)); with a new geometry the
loops are closed anew (`start_closure`, theory (14.2) to (14.5)). What is on which rigid finite element stays: a joint,
a mass or a force whose point leaves its rfe is carried by a rigid arm, which is as exact as the division of the link as
long as it is shorter than half an rfe; a longer one is told by the status.

A design that cannot be is computed with the nominal numbers, so that a batch goes on, and its status says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import ArrayLike, Bool, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.numbers import ANY, POSITIVE, SIGN_WORDS
from rfem_jax.description.drives.numbers_by_name import read_drive_number
from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.parameters.parameters import Parameter, require_each_once
from rfem_jax.description.parameters.parts import Parts
from rfem_jax.description.study_file.study import Study
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.model.building import PartStructure, arrays_of
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import (
    AssemblyErrors,
    Errors,
    deviations_of,
    require_errors_of,
    require_possible,
)
from rfem_jax.mechanics.model.model import Model, at_closing
from rfem_jax.mechanics.model.planar_loops import require_closable
from rfem_jax.mechanics.model.sources import NOTHING, Blueprint, Source
from rfem_jax.mechanics.model.status import DESIGN_OUT_OF_RANGE, NOT_CLOSED, OK, STATUS
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.warmth import growths
from rfem_jax.mechanics.statics.start_closure import close_start

ROUNDING = 1e-12  # of a link's length: a load along it may end beyond it by so much
LONGEST_ARM = 0.5  # of a segment between two spring-damping elements


class Design(eqx.Module):
    """New values for some numbers.

    values: of parameters of the model, by their full names, in SI units; drives: of the drives, by names such as
    "drive.moment".
    """

    values: dict[str, Float[Array, ""]]
    drives: dict[str, Float[Array, ""]]


@dataclass(frozen=True)
class NamedValue:
    """A parameter of a model: its value, its SI unit, and its full name, which is as good as the shorter one."""

    value: float
    unit: str
    full: str


def parameters(model: Model) -> dict[str, NamedValue]:
    """All numbers of a model's description that a design may set or a tolerance scatter, by their names.

    **Raises:** `InputError` for a model without a description.
    """
    source = source_in(model)
    numbers = np.asarray(source.numbers).tolist()
    named = zip(source.blueprint.names.all, numbers, strict=True)
    return {one.name: NamedValue(value, one.unit, one.full) for one, value in named}


def design(model: Model, values: Mapping[str, ArrayLike | str]) -> Design:
    """New values for numbers of a model's description, and of its drives.

    **Arguments:** `values`: name -> number in SI units, array scalar (traced or not), or a string with a unit; names
    are those of `parameters(model)`, and of drives "drive.moment", "drive.rate", "drive.force", "drive.speed" or
    "drive.factor" (of a table), with the driven motion in between, as "drive.A.moment", where there are several.

    **Raises:** `InputError` for unknown names and for values that a description may not have.
    """
    names = source_in(model).blueprint.names
    found, drives, used = {}, {}, []
    for name, value in values.items():
        where = f"`{name}` of the design"
        if name.startswith("drive.") and name not in names:
            drives[name] = _scalar(value, partial(read_drive_number, name, labels=model.topology.drive_labels), where)
            continue
        parameter = names.find(name, "design")
        used.append(parameter)
        found[parameter.full] = _scalar(value, parameter.read, where)
    require_each_once(used, "design")
    require_closable(model, [name for name, value in found.items() if isinstance(value, Tracer)], "design")
    return Design(found, drives)


def _scalar(value: Any, read: Any, where: str) -> Float[Array, ""]:
    """A scalar array; traced values stay as they are."""
    if isinstance(value, Tracer):
        if value.shape != ():
            raise InputError(
                f"Argument {where} must be a scalar, but has the shape {value.shape}; map over it by vmap."
            )
        return value.astype(jnp.float64)
    return jnp.asarray(read(value, where), jnp.float64)


def source_in(model: Model) -> Source:
    """The numbers from which a model was made; raises InputError for a model without them."""
    if model.source is None:
        raise InputError(
            "Argument `model` must know the numbers of its description, but has lost them; take the model that "
            "`discretise` returns."
        )
    return model.source


class Designed(NamedTuple):
    """A model of a design and deviations, and errors without these; status: OK, or why it cannot be; gap [m]: what the
    loops stay open by at the start.  The last two are None where nothing was set."""

    model: Model
    errors: AssemblyErrors
    status: Int[Array, ""] | None = None
    gap: Float[Array, ""] | None = None


def designed(model: Model, design: Design | None, errors: Errors | None = None) -> Designed:
    """The model of a design, without a source, and the errors that are left for `apply_errors`.

    **Arguments:** `design`: None or a `Design` of this model; `errors`: from `assembly_errors` or `deviations`, or by
    their names, of which those of parameters are added (None: perfect).

    **Raises:** `InputError` for a design or errors of another model, and as `deviations`.
    """
    given = deviations_of(model, errors)
    values, deviations = {} if design is None else design.values, given.parameters
    left, bare = given.errors, replace(model, source=None)
    require_errors_of(model.topology, left)
    if not values and not deviations:
        require_possible(bare, left)
        return Designed(bare, left)
    source = source_in(model)
    for name in (*values, *deviations):
        _require_possible(source, source.blueprint.names.find(name, "design"), values, deviations)
    plan = _plan_of(source.blueprint, model.topology, tuple(sorted({*values, *deviations})))
    base = bare
    if plan.products and base.point_products is None:
        base = replace(base, point_products=jnp.zeros_like(base.point_inertia))
    changed, status, gap = _designed_arrays(base, source, values, deviations, plan)
    return Designed(_with_leaves(base, plan.changes, changed), left, status, gap)


def model_of_study(study: Study, at_rest: bool = False, rfes: Mapping[str, int] | None = None) -> Model:
    """The model of a study's mechanism with the values of its design, from which parameters deviate; `at_rest`: of
    the mechanism as its table [statics] holds it; `rfes`: as of `discretise`.

    **Raises:** `InputError` as `discretise`, and for a design that cannot be.
    """
    model = discretise(study.mechanism_at_rest if at_rest else study.mechanism, rfes)
    values = {name: value for name, value in study.design_values.items() if not name.startswith("drive.")}
    if not values:
        return model
    wanted = design(model, values)
    made = designed(model, wanted)
    assert made.status is not None and made.gap is not None, "numbers were set"
    if int(made.status) != OK:
        raise InputError(
            f"Argument `design` must be one that can be built, but is not ({STATUS[int(made.status)].message.lower()} "
            f"gap {float(made.gap):.3g} m); change it."
        )
    source = source_in(model)
    numbers = np.array(source.numbers)
    for i, one in enumerate(source.blueprint.names.all):
        numbers[i] = wanted.values.get(one.full, numbers[i])
    return replace(made.model, source=replace(source, numbers=jnp.asarray(numbers)))


def _require_possible(
    source: Source, parameter: Parameter, values: Mapping[str, Array], deviations: Mapping[str, Array]
) -> None:
    """Raise InputError for a parameter that has not the sign that it must have, where it is a concrete number."""
    if parameter.full not in deviations or parameter.sign == ANY:
        return
    nominal = values.get(parameter.full, source.numbers[source.blueprint.names.all.index(parameter)])
    parts = nominal, deviations[parameter.full]
    if any(isinstance(part, Tracer) for part in parts):
        return
    nominal, deviation = (np.asarray(part) for part in parts)
    if np.any(nominal + deviation <= 0.0 if parameter.sign == POSITIVE else nominal + deviation < 0.0):
        raise InputError(
            f"Argument `errors` must leave `{parameter.name}` {SIGN_WORDS[parameter.sign]}, but its value is "
            f"{nominal:g} {parameter.unit} and the deviation {deviation:g} {parameter.unit}; give a smaller deviation."
        )


# Of each field of a model: of every leaf whether it changes, or, where things have names, these and likewise. Programs
# have other names, in another order than the leaves of dictionaries here.
Changes = tuple[tuple[bool | tuple[str, tuple[bool, ...]], ...], ...]
FIELDS = tuple(field.name for field in fields(Model) if field.name not in ("topology", "source"))


def _changes_of(flags: Model) -> Changes:
    """Of a model that has flags in the place of its arrays."""
    return tuple(
        tuple((name, tuple(map(bool, jax.tree.leaves(value[name])))) for name in sorted(value))
        if isinstance(value, dict)
        else tuple(map(bool, jax.tree.leaves(value)))
        for value in (getattr(flags, field) for field in FIELDS)
    )


def _changing_leaves(model: Model, changes: Changes) -> list[Any]:
    """The leaves of a model that change."""
    found: list[Any] = []

    def keep(part: Any, flags: Any) -> Any:
        found.extend(leaf for leaf, wanted in zip(jax.tree.leaves(part), flags, strict=True) if wanted)
        return part

    _by_parts(model, changes, keep)
    return found


def _with_leaves(model: Model, changes: Changes, leaves: Sequence[Any]) -> Model:
    """The model with others in the places of `_changing_leaves`."""
    new = iter(leaves)

    def put(part: Any, flags: Any) -> Any:
        old, tree = jax.tree.flatten(part)
        return tree.unflatten([next(new) if wanted else leaf for leaf, wanted in zip(old, flags, strict=True)])

    return replace(model, **_by_parts(model, changes, put))


def _by_parts(model: Model, changes: Changes, what: Callable[[Any, Any], Any]) -> dict[str, Any]:
    """The fields of a model, of which `what` is made of each part and its flags."""
    made: dict[str, Any] = {}
    for field, flags in zip(FIELDS, changes, strict=True):
        value = getattr(model, field)
        if isinstance(value, dict):
            named: Any = flags
            made[field] = value | {name: what(value[name], own) for name, own in named}
        else:
            made[field] = what(value, flags)
    return made


class Plan(NamedTuple):
    """The part of a model that changes with some parameters: leaves that change, start values of the joints among them,
    by the fields of the model, those of things by their names; closes: whether loops are to be closed; arms: whether
    points may leave their rfes; products: whether bodies have products of inertia."""

    changes: Changes
    closes: bool
    arms: bool
    products: bool


@lru_cache(maxsize=256)
def _plan_of(blueprint: Blueprint, topology: Topology, names: tuple[str, ...]) -> Plan:
    """Arrays that depend on these parameters, found by evaluating the model with NaN in their place."""
    parts = [name.split(".") for name in names]
    turned = any(p[0] == "link" and (p[2] == "orientation" or (p[2] == "inertia" and len(p[3]) == 2)) for p in parts)
    structure = PartStructure(topology, blueprint.points, blueprint.products or turned)
    # The other numbers are those of a description, since formulas may not be defined for any.
    described = zip(blueprint.names.all, blueprint.described, strict=True)
    numbers = [NOTHING if one.full in names else number for one, number in described]
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        model = jax.tree.map(np.asarray, arrays_of(blueprint.filled(numbers), structure))
    flags = jax.tree.map(lambda x: np.isnan(x).any(), model)  # of NumPy: the sections' numbers, unlike choices
    frames = flags.length, flags.parent_rotation, flags.parent_position, flags.child_rotation, flags.child_position
    at_start = at_closing(model).topology
    coupled = [(flags.couplings or {})[name] for name in at_start.ideal]
    moved = bool(any(frames) or flags.start_joints or any(jax.tree.leaves(coupled)))
    closes = moved and at_start.n_constraints > 0
    elements = jax.tree.leaves(flags.frame_forces)
    flags = eqx.tree_at(lambda tree: (tree.start_joints, tree.cut_angles), flags, (moved, closes))
    arms = bool(any(frames) or flags.point_position or any(elements))
    return Plan(_changes_of(flags), closes, arms, structure.products)


@partial(Program, nameless=True)
def _designed_arrays(
    base: Model, source: Source, values: dict[str, Array], deviations: dict[str, Array], plan: Plan
) -> tuple[list[Array], Int[Array, ""], Float[Array, ""]]:
    """The leaves that change, status and gap [m]."""
    return kernel(partial(_arrays_of_design, source.blueprint, plan), name="design")(
        base, source.numbers, values, deviations
    )


def _arrays_of_design(
    blueprint: Blueprint,
    plan: Plan,
    base: Model,
    numbers: Float[Array, " parameters"],
    values: dict[str, Array],
    deviations: dict[str, Array],
) -> tuple[list[Array], Int[Array, ""], Float[Array, ""]]:
    """As `_designed_arrays`, of the numbers of a source."""
    structure = PartStructure(base.topology, blueprint.points, plan.products)
    nominal = [numbers[i] for i in range(len(blueprint.names))]
    named = list(zip(blueprint.names.all, nominal, strict=True))
    wanted = [values.get(one.full, number) for one, number in named]
    actual = [x + deviations[one.full] if one.full in deviations else x for (one, _), x in zip(named, wanted)]

    def closed(numbers: list[Array], start: Model) -> tuple[Model, Float[Array, ""]]:
        made = arrays_of(blueprint.filled(numbers), structure)
        made = replace(made, start_joints=_start_values(start, made), cut_angles=start.cut_angles)
        if not plan.closes:
            return made, jnp.zeros(())
        found = close_start(start, made)
        return replace(made, start_joints=found.joints, cut_angles=found.cut_angles), found.gap

    # What deviations open is for assembly to bend together, as what errors do.
    made, gap = closed(wanted, base) if values else (base, jnp.zeros(()))
    if deviations:
        made, _ = closed(actual, made)
    fits = gap <= blueprint.closing_tolerance * jnp.max(made.length)
    pairs = [(one, x) for (one, _), x in zip(named, actual) if one.full in values or one.full in deviations]
    possible = _possible(blueprint.filled(actual), pairs)
    bodies = [one.link for one in base.topology.reduced]
    # Rigid links may have no section, and reduced bodies have none.
    flexible = [l for l, n in enumerate(base.topology.elements) if n > 1 and l not in bodies]
    flexible = np.array(flexible, dtype=int)
    possible = possible & jnp.all(made.section.stiffness[:, flexible] > 0.0)
    if plan.arms:
        possible = possible & (_longest_arm(made) <= LONGEST_ARM)
    status = jnp.where(possible, jnp.where(fits, OK, NOT_CLOSED), DESIGN_OUT_OF_RANGE).astype(jnp.int32)
    leaves = zip(*(_changing_leaves(one, plan.changes) for one in (made, base)), strict=True)
    return [jnp.where(status == OK, new, old) for new, old in leaves], status, gap


def _start_values(base: Model, made: Model) -> Float[Array, " numbers"]:
    """Start values: those that drives hold are numbers of the design, the others start from the nominal ones."""
    topology = base.topology
    held = np.isin(np.arange(base.start_joints.shape[0]), [topology.place_of(k) for k in topology.drives])
    return jnp.where(held, made.start_joints, base.start_joints)


def _possible(parts: Parts, numbers: list[tuple[Parameter, Array]]) -> Bool[Array, ""]:
    """Whether numbers are finite and of the signs that they must have, and all walls thin enough."""
    good = jnp.ones((), bool)
    for one, value in numbers:
        right = value > 0.0 if one.sign == POSITIVE else value >= 0.0
        good = good & jnp.isfinite(value) & (True if one.sign == ANY else right)
    for force in parts.forces:
        if isinstance(force, DistributedForce):
            begin, end = force.along(link := parts.link(force.link))
            good = good & (jnp.asarray(begin) >= 0.0) & (begin < end) & (end <= link.length * (1.0 + ROUNDING))
    for growth in growths(parts).values():
        good = good & (growth > 0.0)
    for link in parts.links:
        for section in link.sections:
            for gap in section.gaps:
                good = good & (jnp.asarray(gap) > 0.0)
        for span in link.spans if link.stations else ():
            good = good & (jnp.asarray(span.begin) < span.end)
    return good


def _longest_arm(model: Model) -> Float[Array, ""]:
    """By how much any point lies outside the segment of the rfe that holds it, over the distance of two sdes."""
    topology, arms = model.topology, [jnp.zeros(())]
    places = [
        *zip(topology.parents, model.parent_position.T),
        *zip(topology.children, model.child_position.T),
        *zip(topology.masses, model.point_position.T),
        *((end.node, end.position) for one in (model.frame_forces or {}).values() for end in (one.parent, one.child)),
        *((one.node, one.position) for one in (model.points or {}).values()),
    ]
    for node, position in places:
        if node == BASE or topology.elements[topology.link_of(node)] == 1 or topology.link_of(node) in topology.curved:
            continue  # a link with an axis may have arms beside it
        link, n = topology.link_of(node), topology.n_links
        shares = topology.fractions(link)[0]
        i = 0 if node < n else node - n - topology.ranges[link][0] + 1
        # The origin of rfe 0 is at its start, that of the others in the middle.
        low, high = (0.0, shares[0]) if i == 0 else (-0.5 * shares[i], 0.5 * shares[i])
        x = position[0] / model.length[link]
        beyond = jnp.maximum(low - x, x - high)
        arms.append(jnp.maximum(beyond, 0.0) * (topology.elements[link] - 1))
    return jnp.max(jnp.stack(arms))


def status_of(status: Int[Array, "*positions"], made: Designed) -> Int[Array, "*positions"]:
    """A status of a model of a design: that of the design, if it is not OK."""
    return status if made.status is None else jnp.where(made.status == OK, status, made.status)
