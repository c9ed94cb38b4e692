"""Calls and loops without a batched argument stay as they are within `jax.vmap`.

Place in the pipeline: `executable` traces programs with it.

JAX batches every `jit`, loop and branch by tracing its body again, also where nothing that goes into it has a batch: in
`jax.jacfwd` all that does not depend on the errors.  In this package's programs (`options.own_program`) such a call is
left alone, so that its body is neither traced nor lowered twice.  A batch whose axis has a name is JAX's own affair: a
body may ask for the axis.
"""

from jax._src import core
from jax.interpreters import batching

from rfem_jax.compilation import options

WITH_BODIES = ("jit", "scan", "while", "cond", "remat2", "custom_linear_solve")


def keep_unbatched_calls() -> None:
    """From now on, in programs of this package."""
    rules = batching.fancy_primitive_batchers
    for primitive, rule in list(rules.items()):
        if primitive.name in WITH_BODIES and not isinstance(rule, _UnlessUnbatched):
            rules[primitive] = _UnlessUnbatched(primitive, rule)


class _UnlessUnbatched:
    """JAX's `rule` to batch a primitive, where there is something to batch."""

    def __init__(self, primitive, rule):
        self.primitive, self.rule = primitive, rule

    def __call__(self, axis, values, places, **params):
        nameless = axis.name is core.no_axis_name and axis.spmd_name is None and not axis.explicit_mesh_axis
        if nameless and all(place is None for place in places) and options.in_own_program():
            results = self.primitive.bind(*values, **params)
            return results, [None] * len(results)
        return self.rule(axis, values, places, **params)
