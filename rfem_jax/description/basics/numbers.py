"""Numbers that may be traced: the objects of a description hold them, and its formulas serve a design as well.

Place in the pipeline: units -> **numbers** -> the objects of a description; sections, materials, rigid_bodies, building
write their formulas with these.

A description holds floats, and NumPy computes with them on the host. A user, or a design, puts traced scalars in their
places, and the same formulas are then operations of JAX.
"""

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import GetAttrKey
from jaxtyping import Array, Bool, Float

from rfem_jax.description.basics.errors import InputError, subject
from rfem_jax.description.basics.units import non_negative_quantity, positive_quantity, quantity, vector

Number = float | Float[np.ndarray, ""] | Float[Array, ""]
Numbers = float | Float[np.ndarray, "..."] | Float[Array, "..."]  # or one for each of several places
POSITIVE, NOT_NEGATIVE, ANY = "positive", "not_negative", "any"
SIGN_WORDS = {POSITIVE: "greater than 0", NOT_NEGATIVE: "at least 0"}
READERS = {POSITIVE: positive_quantity, NOT_NEGATIVE: non_negative_quantity, ANY: quantity}
# Of the numbers of an object of a description, which a design may set: {field: (dimension, sign)}.
Fields = Mapping[str, tuple[str, str]]


class NumberTree:
    """Base of the dataclasses of a description, which makes them pytrees of JAX whose leaves are their numbers.

    Texts, choices and counts are static. `equinox.tree_at` puts other numbers in the places of some, traced ones, too;
    nothing is checked then.
    """

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        jax.tree_util.register_pytree_with_keys(cls, _flatten, partial(_unflatten, cls))

    def with_fields(self, **values: Any) -> Any:
        """A copy with other values in some fields; nothing is checked."""
        other = copy.copy(self)
        for name, value in values.items():
            object.__setattr__(other, name, value)
        return other


def _flatten(thing: Any) -> tuple[list[tuple[Any, Any]], tuple]:
    values = [(field.name, getattr(thing, field.name)) for field in fields(thing)]
    numbers = [(GetAttrKey(name), value) for name, value in values if not _is_static(value)]
    return numbers, tuple((name, value if _is_static(value) else NumberTree) for name, value in values)


def _unflatten(kind: type, static: tuple, numbers: Iterable[Any]) -> Any:
    thing, left = object.__new__(kind), iter(numbers)
    for name, value in static:
        object.__setattr__(thing, name, next(left) if value is NumberTree else value)
    return thing


def _is_static(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(map(_is_static, value))
    return value is None or isinstance(value, (str, int))


def value_of(number: Any) -> float | None:
    """The value of a number: None of a traced one within `jax.jit` and `jax.vmap`; within derivatives alone it has
    one."""
    try:
        return float(jax.lax.stop_gradient(number) if isinstance(number, Tracer) else number)
    except jax.errors.ConcretizationTypeError:
        return None


def is_known(*numbers: Any) -> bool:
    """Whether all numbers of nested sequences have values already, so that they can be compared."""
    if any(isinstance(number, (list, tuple)) and not is_known(*number) for number in numbers):
        return False
    return not any(isinstance(number, Tracer) and value_of(number) is None for number in numbers)


def read_number(value: Any, field: tuple[str, str], where: str) -> Any:
    """As `number`, of the dimension and the sign of a field."""
    return number(value, field[0], where, READERS[field[1]])


def number(value: Any, dimension: str, where: str, read: Callable[[Any, str, str], float] = quantity) -> Any:
    """As `quantity`; a traced float64 scalar stays as it is, and is checked as far as its value is known."""
    if not isinstance(value, Tracer):
        return read(value, dimension, where)
    if value.shape != () or value.dtype != jnp.float64:
        raise InputError(
            f"{subject(where)} must be a float64 scalar, but has the type {value.dtype} and "
            f"the shape {value.shape}; convert it first."
        )
    known = value_of(value)
    if known is not None:
        read(known, dimension, where)
    return value


def positive_number(value: Any, dimension: str, where: str) -> Any:
    """As `number`, and greater than zero."""
    return number(value, dimension, where, positive_quantity)


def non_negative_number(value: Any, dimension: str, where: str) -> Any:
    """As `number`, and not less than zero."""
    return number(value, dimension, where, non_negative_quantity)


def number_vector(value: Any, dimension: str, where: str) -> tuple[Any, Any, Any]:
    """Three numbers along (or about) x, y and z."""
    return vector(value, dimension, where, number)


def traced(values: Any) -> bool:
    """Whether any number of nested sequences is an array of JAX."""
    if isinstance(values, (list, tuple)):
        return any(traced(one) for one in values)
    return isinstance(values, jax.Array)


def array_of(values: Any) -> Float[np.ndarray, "*shape"] | Float[Array, "*shape"]:
    """Nested sequences of numbers of equal lengths as an array, of JAX where any number is one."""
    if not traced(values):
        return np.array(values, dtype=float)
    if isinstance(values, (list, tuple)):
        return jnp.stack([jnp.asarray(array_of(one)) for one in values])
    return jnp.asarray(values, jnp.float64)


def larger(one: Numbers, other: Numbers) -> Numbers:
    """The larger of two numbers."""
    return jnp.maximum(one, other) if traced((one, other)) else np.maximum(one, other)


def smaller(one: Numbers, other: Numbers) -> Numbers:
    """The smaller of two numbers."""
    return jnp.minimum(one, other) if traced((one, other)) else np.minimum(one, other)


def chosen(condition: bool | Bool[np.ndarray, "..."] | Bool[Array, "..."], one: Numbers, other: Numbers) -> Numbers:
    """The first number where a condition holds, else the second one; of arrays, too."""
    if traced((condition, one, other)):
        return jnp.where(condition, one, other)
    return np.where(condition, one, other) if np.ndim(condition) else one if condition else other  # pyright: ignore[reportReturnType]


def rotation_of_angles(angles: Sequence[Number]) -> Float[np.ndarray, "3 3"] | Float[Array, "3 3"]:
    """R = R_z R_y R_x of three angles about x, y, z [rad]."""
    module: Any = jnp if traced(angles) else np
    (cx, cy, cz), (sx, sy, sz) = (tuple(f(angle) for angle in angles) for f in (module.cos, module.sin))
    rx = array_of([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    ry = array_of([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rz = array_of([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return rz @ ry @ rx
