"""Models of descriptions whose numbers are traced, within `jax.jit`, `jax.vmap` and derivatives.

Place in the pipeline: discretisation, designs -> **traced_descriptions** -> the public `discretise`.

The structure of a model, as which coordinates stand for its freedoms and the rank of its loops, is static and found on
the host, where a traced number has no value, except in derivatives alone. Another number stands in for it there; those
of lengths and angles close the loops at the start values of the description, so that they are on its branch. On this
structure the arrays follow from the traced numbers as those of a design do from its values (theory (14.1) to (14.5)).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.numbers import POSITIVE, is_known, value_of
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.parameters.parameters import Parameter, named_parameters
from rfem_jax.description.parameters.parts import Parts, number_at, parts_of
from rfem_jax.mechanics.model import discretisation
from rfem_jax.mechanics.model.building import build_model
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import gaps, geometry_of, place, shortest
from rfem_jax.mechanics.model.status import OK
from rfem_jax.mechanics.statics.designs import Design, designed, source_in

PLACES = ("length", "position", "orientation", "child_position", "child_orientation", "angle", "displacement", "start")
ITERATIONS = 20
DIFFERENCE = 1e-6  # m or rad, of a derivative
LARGEST_STEP = 0.5  # m or rad
CLOSED = 1e-12  # m
SHORTEST = 0.02  # link, of the first guess of its length
SMALLEST_CHANGE = 1e-8  # of an equation of loops, relative


def discretise(mechanism: Mechanism, rfes: int | None = None, elements: str | None = None) -> Model:
    """Divide the links into rigid finite elements and close the loops at the start.

    **Arguments:** `mechanism`: a `Mechanism`, whose numbers that `rfem_jax.parameters` names may be traced; `rfes`:
    number of rfes of every flexible link (None: each link's own); `elements`: "linear" or "geometrically_exact"
    spring-damping elements (None: the mechanism's).

    **Returns:** the model; of traced numbers of which none can be made, as loops that do not close, one of which no
    assembly is found, as the status of a run says.

    **Raises:** `InputError` if JAX is not in double precision, if the loops cannot be closed with
    the given lengths and start angles, or if the reactions are not unique and the mechanism does
    not ask for the minimum-norm ones; for traced numbers that are no parameters, and for places on flexible links of
    which no value is known.
    """
    with jax.ensure_compile_time_eval():  # arrays of known numbers are known within jax.jit, too
        if not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(mechanism, is_leaf=callable)):
            return discretisation.discretise(mechanism, rfes, elements)
        _require_known_places(mechanism)
        model = discretisation.discretise(_with_stand_ins(mechanism), rfes, elements)
    source = source_in(model)
    values = _traced_values(mechanism, source.blueprint.names.all)
    if not values:
        return model
    made = designed(model, Design(values, {}))
    places = np.array([n for n, one in enumerate(source.blueprint.names.all) if one.full in values])
    numbers = source.numbers.at[places].set(jnp.stack(list(values.values())))
    # Designs that cannot be leave the nominal arrays, which nobody asked for here.
    length = made.model.length + jnp.where(made.status == OK, 0.0, jnp.nan)
    return replace(made.model, length=length, source=replace(source, numbers=numbers))


def _traced_values(mechanism: Mechanism, parameters: tuple[Parameter, ...]) -> dict[str, Float[Array, ""]]:
    """{full name: traced number} of parameters, in their order. Raises InputError for other traced numbers."""
    parts, values, used = parts_of(mechanism), {}, set()
    for one in parameters:
        found = [] if one.factor else [number_at(parts, path) for path in one.paths]
        if any(isinstance(number, Tracer) for number in found):
            if one.full.startswith(("section.", "material.")) and len(set(map(id, found))) > 1:
                raise InputError(
                    f"Argument `mechanism` must have one number `{one.name}` of all links that share it, but has "
                    "several traced ones of equal value; give sections and materials that differ different names."
                )
            values[one.full] = jnp.asarray(found[0], jnp.float64)
            used |= set(map(id, found))
    for path, leaf in jax.tree.leaves_with_path(mechanism, is_leaf=callable):
        if isinstance(leaf, Tracer) and id(leaf) not in used:
            raise InputError(
                f"Argument `mechanism` must have numbers that are known before compilation where no parameter is, but "
                f"`{jax.tree_util.keystr(path)[1:]}` is {leaf}; give a number (start values that closing the loops "
                "finds may be coarse)."
            )
    return values


def _require_known_places(mechanism: Mechanism) -> None:
    """Raise InputError for a place on a flexible link of which no value is known: it decides on the rfe there."""
    places = [(joint.parent, joint.position, f"joint `{joint.name}`") for joint in mechanism.joints]
    places += [(joint.child, joint.child_position, f"joint `{joint.name}`") for joint in mechanism.joints]
    places += [(link.name, mass.position, "a point mass") for link in mechanism.links for mass in link.point_masses]
    places += [(point.link, point.place, f"point `{point.name}`") for point in mechanism.points]
    places += [(*end, f"force `{force.name}`") for force in mechanism.point_forces for end in force.ends()]
    flexible = {link.name: link for link in mechanism.links if link.flexible}
    for name, position, what in places:
        if name not in flexible or position is None or is_known(position[0]) or position[0] is flexible[name].length:
            continue
        raise InputError(
            f"Argument `mechanism` must have places on flexible links that are known before compilation, but the place "
            f"of {what} on `{name}` is traced; make its model with a number, and vary it by `rfem_jax.design`."
        )


def _with_stand_ins(mechanism: Mechanism) -> Mechanism:
    """The mechanism with floats in the places of traced numbers: their values, or others as far as none are known."""
    leaves, tree = jax.tree.flatten(mechanism, is_leaf=callable)
    traced = {id(leaf): leaf for leaf in leaves if isinstance(leaf, jax.Array)}
    # Not alike, so that sections of one name, but of different traced numbers, are not taken for one.
    known = {key: value for key, x in traced.items() if (value := value_of(x)) is not None}
    numbers = {key: known.get(key, 1.0 + 0.01 * n) for n, key in enumerate(traced)}

    def filled(more: dict[int, float]) -> Mechanism:
        return tree.unflatten([{**numbers, **more}.get(id(leaf), leaf) for leaf in leaves])

    distances = [link.length for link in mechanism.links]
    distances += [x for joint in mechanism.joints for x in joint.position or ()]
    longest = max((abs(value) for x in distances if (value := value_of(x)) is not None), default=0.0) or 1.0
    guess: dict[int, float] = {}
    nominal = filled({})
    named = named_parameters(parts_of(nominal), nominal.driven_motions).all
    # Of a temperature that is not known, lengths are those at assembly.
    temperatures = [number_at(parts_of(mechanism), one.paths[0]) for one in named if one.dimension == "temperature"]
    numbers |= {id(one): 0.0 for one in temperatures if id(one) in traced and id(one) not in known}
    for one, number in _placing(parts_of(mechanism), named):
        if id(number) in traced and id(number) not in known:
            guess[id(number)] = longest if one.sign == POSITIVE else 0.0
    return filled(_closing(guess, filled) if mechanism.cut_joints else guess)


def _placing(parts: Parts, parameters: tuple[Parameter, ...]) -> Iterator[tuple[Parameter, Any]]:
    """The lengths of links and the numbers of the frames and held start values of joints."""
    for one in parameters:
        kind, _, field, *_ = one.full.split(".")
        if kind in ("link", "joint") and field in PLACES:
            yield one, number_at(parts, one.paths[0])


def _closing(guess: dict[int, float], filled: Callable[[dict[int, float]], Mechanism]) -> dict[int, float]:
    """Numbers [m, rad] near a guess that close the loops as well as they can, all joints at their start values: Gauss
    and Newton's iteration with steps of least norm."""

    def opening(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " constraints"]:
        mechanism = filled(dict(zip(guess, values.tolist(), strict=True)))
        geometry = geometry_of(model := build_model(mechanism, {one.name: one.elements for one in mechanism.links}))
        return gaps(geometry, place(geometry, np.asarray(model.start_joints))).residual * geometry.scale

    values, steps = np.array(list(guess.values())), DIFFERENCE * np.eye(len(guess))
    shortest_length = np.where(values > 0.0, SHORTEST * values, -np.inf)  # the guess of other numbers is zero
    for _ in range(ITERATIONS if guess else 0):
        now = opening(values)
        slopes = np.stack([opening(values + step) - now for step in steps], axis=1) / DIFFERENCE
        change = shortest(slopes, now, SMALLEST_CHANGE)
        largest = np.abs(change).max()
        values = np.maximum(values - change * min(1.0, LARGEST_STEP / max(largest, LARGEST_STEP)), shortest_length)
        if largest < CLOSED:
            break
    return dict(zip(guess, values.tolist(), strict=True))
