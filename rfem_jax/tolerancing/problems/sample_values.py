"""Values of many samples at once: one program for all that evaluates a problem.

Place in the pipeline: Monte Carlo (`execution`) and studies that evaluate points (`evaluation`) give it errors.

Symbols: k errors, m metrics, n samples; x (k,) errors [rad, m].
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from rfem_jax.compilation.program import Program
from rfem_jax.tolerancing.problems.problem import Status, ToleranceProblem

LANES = {"cpu": 16}  # enough for a core's vector units; little waste on samples that run long
LANES_ELSEWHERE = 4096  # with 65536 an H200 takes 0.4 times as long for each, and much memory

Base = dict[str, Float[Array, ""]]


def default_lanes() -> int:
    """Samples that a device computes at once by default."""
    return LANES.get(jax.default_backend(), LANES_ELSEWHERE)


def stack_metrics(
    problem: ToleranceProblem, names: Sequence[str], base: Base, x: Float[Array, " k"]
) -> tuple[Float[Array, " m"], Status]:
    """Values (m,) of all metrics and the status at one point x (k,); traced."""
    errors = {**base, **{name: x[i] for i, name in enumerate(names)}}
    values, status = problem(errors)
    return jnp.stack([jnp.asarray(values[m.name], jnp.float64) for m in problem.metrics]), status


def mesh_of(devices: list) -> Mesh:
    """Devices among which samples are divided."""
    return Mesh(np.array(devices), ("samples",))


def one_device() -> Mesh:
    """The device on which JAX puts arrays."""
    return mesh_of(list(jnp.asarray(np.zeros(())).devices()))


def over_samples(mesh: Mesh) -> NamedSharding:
    """Rows divided among the devices of a mesh."""
    return NamedSharding(mesh, PartitionSpec("samples"))


@Program
def evaluate_lanes(problem, names, base, points, mesh):
    """Values (n, m) and status (n,) at points (n, k), whose errors have these names, with the errors `base` fixed;
    traced.

    Each device of the mesh computes equally many points, and sees no other.
    """
    arrays, static = eqx.partition((problem, base), eqx.is_array)

    def values_of(arrays, points):
        problem, base = eqx.combine(arrays, static)
        return jax.vmap(lambda x: stack_metrics(problem, names, base, x))(points)

    rows = over_samples(mesh).spec
    # Device-varying types are not checked: solvers from outside do not annotate their loops.
    return jax.shard_map(values_of, mesh=mesh, in_specs=(PartitionSpec(), rows), out_specs=rows, check_vma=False)(
        arrays, points
    )
