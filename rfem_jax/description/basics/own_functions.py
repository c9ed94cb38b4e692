"""Functions of the user's own, written in JAX: how they are checked, and made pytrees.

Place in the pipeline: errors -> **own_functions** -> drives.arguments, forces, point_forces.
"""

from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from rfem_jax.description.basics.errors import InputError


def as_tree(function: Any, where: str, arguments: str, advice: str = "pass one written in JAX") -> Any:
    """A function as a pytree of arrays: an equinox Module keeps its arrays, a plain function is static.

    **Arguments:** `where`: the argument in a message; `arguments`: of the function, in words; `advice`: in a message.

    **Raises:** `InputError` for what is no function, and for a module that holds what cannot be static.
    """
    if not callable(function):
        raise InputError(f"Argument {where} must be a function of {arguments}, but was {function!r}; {advice}.")
    tree: Any = function if isinstance(function, (eqx.Module, Partial)) else Partial(function)
    return _with_arrays_alone(tree, where)


def _with_arrays_alone(tree: Callable, where: str) -> Callable:
    """The function with arrays as its only leaves: what else a module holds, such as the activation function of a
    network, is no argument of a program and has no derivative."""
    leaves, structure = jax.tree.flatten(tree)
    if all(eqx.is_array(leaf) for leaf in leaves):
        return tree
    leaves = [jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf for leaf in leaves]
    arrays = tuple(leaf for leaf in leaves if eqx.is_array(leaf))
    others: Any = tuple(_ARRAY if eqx.is_array(leaf) else leaf for leaf in leaves)
    for leaf in others:
        try:
            hash(leaf)
        except TypeError as error:
            raise InputError(
                f"Argument {where} must hold arrays, functions and plain values, but holds {type(leaf).__name__}, "
                "which cannot be compared with that of another call; make it an array, or a frozen dataclass."
            ) from error
    return _WithSettings(arrays, others, structure)


_ARRAY = type(...)  # in the place of an array


class _WithSettings(eqx.Module):
    """A function by its arrays, and by the other leaves of its structure."""

    arrays: tuple[Array, ...]
    others: tuple[Hashable, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    def __call__(self, *arguments):
        arrays = iter(self.arrays)
        leaves = [next(arrays) if leaf is _ARRAY else leaf for leaf in self.others]
        return jax.tree.unflatten(self.structure, leaves)(*arguments)


class _WithValues(eqx.Module):
    """A function with the values as leaves that it closed over."""

    function: Callable[..., Any] = eqx.field(static=True)
    values: tuple[Array, ...]

    def __call__(self, *arguments):
        return self.function(*arguments, *self.values)


def checked_function(
    tree: Callable, where: str, names: str, kinds: tuple[str, ...], shape: tuple[int, ...] = ()
) -> Any:
    """A function as a pytree, tried with scalars of given names and kinds for a float64 result of a shape.

    What it closes over and JAX is differentiating is among its leaves then: rules of differentiation, as those of the
    implicit method, see leaves alone.

    **Raises:** `InputError` if it cannot be called so, or returns something else.
    """
    numbers = [jax.ShapeDtypeStruct((), jnp.dtype(kind)) for kind in kinds]
    try:
        result = eqx.filter_eval_shape(tree, *numbers)
    except Exception as error:
        raise InputError(
            f"Argument {where} must be callable as function({names}) in JAX, but raised "
            f"{type(error).__name__}: {error}; use jax.numpy and these arguments."
        ) from error
    if getattr(result, "shape", None) != shape or result.dtype != jnp.float64:
        wanted = f"a float64 array of {shape[0]}" if shape else "a float64 scalar"
        raise InputError(f"Argument {where} must return {wanted}, but returned {result}; return one jax.numpy value.")
    # A leaf that is traced already is found again as a value that the call closes over.
    leaves = {id(leaf) for leaf in jax.tree.leaves(tree)}
    converted, values = jax.closure_convert(lambda *given: tree(*given), *(np.zeros((), kind) for kind in kinds))
    return tree if all(id(value) in leaves for value in values) else _WithValues(converted, tuple(values))
