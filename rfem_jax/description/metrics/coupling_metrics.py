"""Metrics of couplings: the load of a mesh at its second coordinate.

Place in the pipeline: metric_catalogue -> **coupling_metrics**, which register themselves.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from rfem_jax.description.metrics.catalogue import BELOW, PEAK_POWER, MetricKind, add_metric, p_norm


def _loads(run: Any, coupling: str) -> Array:
    """Loads (times, 1) [N m, N] along the second coordinate."""
    return jnp.asarray(run.couplings[coupling].loads)[..., 1:]


def _register(load: str, unit: str, turns: bool) -> None:
    """The largest load, and the smooth norm below it, of couplings whose second coordinate turns or not."""
    other = "mesh_moment" if not turns else "mesh_force"

    def refusal(subject: Any) -> str | None:
        if subject.turns == turns:
            return None
        return f"its second coordinate is a {'translation' if turns else 'rotation'} (`max_{other}`)"

    def add(name: str, label: str, function: Callable[..., Any], description: str, **more: Any) -> None:
        add_metric(
            MetricKind(
                name, unit, function, f"{label} of {{coupling}}", True, "coupling", True, None, (), description,
                refusal, **more,
            )
        )  # fmt: skip

    words = f"{load} that the mesh exerts along its second coordinate"
    add(
        f"max_mesh_{load}", f"largest mesh {load}", lambda run, one: jnp.max(jnp.abs(_loads(run, one))),
        f"largest saved {words}", kinked=True, equation="(16.3)", at_rest=True,
    )  # fmt: skip
    add(
        f"peak_mesh_{load}", f"{PEAK_POWER}-norm of the mesh {load}, below its maximum,",
        lambda run, one: p_norm(_loads(run, one)), f"{BELOW}, of the {words}", equation="(8.7)",
        note=f"{BELOW}, which is `max_mesh_{load}`", at_rest=True,
    )  # fmt: skip


_register("moment", "N m", True)
_register("force", "N", False)
