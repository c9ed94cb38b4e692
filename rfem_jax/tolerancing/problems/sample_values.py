"""Values of many samples at once: one program for all that evaluates a problem.

Place in the pipeline: Monte Carlo (`execution`) and studies that evaluate points (`evaluation`) give it errors.

Symbols: k errors, m metrics, n samples; x (k,) errors [rad, m].
"""

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from rfem_jax.compilation import keys
from rfem_jax.compilation.program import Program
from rfem_jax.tolerancing.problems.problem import Status, ToleranceProblem
from rfem_jax.usable_cores import usable_cores

LANES = {"cpu": 16}  # enough for a core's vector units; little waste on samples that run long
LANES_ELSEWHERE = 4096  # with 65536 an H200 takes 0.4 times as long for each, and much memory

Base = dict[str, Float[Array, ""]]


def default_lanes() -> int:
    """Samples that a device computes at once by default."""
    return LANES.get(jax.default_backend(), LANES_ELSEWHERE)


def stack_metrics(
    problem: ToleranceProblem, names: Sequence[str], base: Base, x: Float[Array, " k"]
) -> tuple[Float[Array, " m *times"], Status]:
    """Values (m,) of all metrics, (m, T) of signals, and the status at one point x (k,); traced."""
    errors = {**base, **{name: x[i] for i, name in enumerate(names)}}
    values, status = problem(errors)
    return jnp.stack([jnp.asarray(values[m.name], jnp.float64) for m in problem.metrics]), status


def mesh_of(devices: list) -> Mesh:
    """Devices among which samples are divided."""
    return Mesh(np.array(devices), ("samples",))


def one_device() -> Mesh:
    """The device on which JAX puts arrays."""
    return mesh_of(list(jnp.asarray(np.zeros(())).devices()))


@runtime_checkable
class Device(Protocol):
    """The part of a JAX device that `too_few_threads` reads."""

    @property
    def platform(self) -> str:
        """ "cpu", "gpu" or "tpu"."""
        ...


def too_few_threads(devices: Sequence[Device]) -> int | None:
    """The number of threads that CPU devices share, where it is so small that samples on several of them could wait for
    each other without end (see `execution`); None where it is enough.

    XLA's pool has NPROC threads (an environment variable, read when JAX starts), without it one for each core that the
    process may use, and never fewer than devices.
    """
    count = len(devices)
    if count < 2 or devices[0].platform != "cpu":
        return None
    specified = os.environ.get("NPROC", "")
    threads = max(int(specified) if specified.isdecimal() else usable_cores(), count)
    return threads if threads < 2 * count else None


def local_mesh() -> Mesh:
    """All devices of this process, whose programs for values of samples are those of a Monte Carlo study; the default
    one alone where it was chosen, and where several have too few threads."""
    devices = jax.local_devices()
    if keys.read_setting("jax_default_device") is not None or too_few_threads(devices) is not None:
        return one_device()
    return mesh_of(devices)


def over_samples(mesh: Mesh) -> NamedSharding:
    """Rows divided among the devices of a mesh."""
    return NamedSharding(mesh, PartitionSpec("samples"))


def divided(mesh: Mesh, rows: Float[np.ndarray, "n k"] | Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Points (n, k), equally many for each device, on their devices."""
    return jnp.asarray(rows) if mesh.size == 1 else jax.device_put(rows, over_samples(mesh))


def on_devices(mesh: Mesh, function: Callable[..., Any], given: Any, *rows: Array) -> Any:
    """`function(given, *rows)` of the rows of each device of a mesh; traced.

    Args: function, returns arrays with as many rows; given, a pytree that all devices have.
    """
    # By leaves: the sections of tapered links would take a tree of truth values for their counts and choices.
    leaves, tree = jax.tree.flatten(given)
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]

    def of_device(arrays, *rows):
        left = iter(arrays)
        filled = [next(left) if eqx.is_array(leaf) else leaf for leaf in leaves]
        return function(jax.tree.unflatten(tree, filled), *rows)

    by_rows = over_samples(mesh).spec
    places = PartitionSpec(), *[by_rows] * len(rows)
    # Device-varying types are not checked: solvers from outside do not annotate their loops.
    return jax.shard_map(of_device, mesh=mesh, in_specs=places, out_specs=by_rows, check_vma=False)(arrays, *rows)


@partial(Program, nameless=True)
def evaluate_lanes(problem, names, base, points, mesh):
    """Values (n, m) and status (n,) at points (n, k), whose errors have these names, with the errors `base` fixed;
    traced.

    Each device of the mesh computes equally many points, and sees no other.
    """

    def values_of(given, points):
        problem, base = given
        return jax.vmap(lambda x: stack_metrics(problem, names, base, x))(points)

    return on_devices(mesh, values_of, (problem, base), points)
