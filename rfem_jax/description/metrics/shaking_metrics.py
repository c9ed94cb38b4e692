"""Metrics of what shakes the frame: the force of the mechanism on its base, and its moment about a point.

Place in the pipeline: metric_catalogue -> **shaking_metrics**, which registers them when the package is imported.

They read the record `shaking`, which runs have for them alone. The moment is about `shaking_point` of the mechanism.
Source: theory (8.27), (8.28).
"""

from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.metrics.catalogue import BELOW, MetricKind, add_metric, p_norm, records_for
from rfem_jax.description.metrics.design_metrics import integral, power_of

RECORD = "shaking"
OF_SAVED = "of the saved times, too small where these are few: see `save_every`"
# Of a mechanism with `shaking_point` in a study that asks for no metric of these.
REPORTED = ("rms_shaking_force", "max_shaking_force", "rms_shaking_moment", "max_shaking_moment")


def _squares(run: Any, load: str) -> Float[Array, " times"]:
    return jnp.sum(getattr(run.recorded[RECORD], load) ** 2, axis=1)


def _mean_square(run: Any, load: str) -> Float[Array, ""]:
    times = jnp.asarray(run.times)
    return integral(_squares(run, load), times) / (times[-1] - times[0])


def _add(name: str, unit: str, label: str, function: Callable[[Any], Array], description: str, **more: Any) -> None:
    # The size of a moment about a point out of the plane changes with the sign of errors out of the plane.
    even = True if name.endswith("force") else None
    add_metric(MetricKind(name, unit, function, label, even, "run", True, None, (RECORD,), description, None, **more))


def _register(load: str, unit: str, squared: str, words: str) -> None:
    name, of = f"shaking_{load}", f"the {words}"
    _add(f"mean_square_{name}", squared, f"mean square shaking {load}", lambda run: _mean_square(run, load),
         f"mean square over time of {of}", equation="(8.28)")  # fmt: skip
    _add(f"rms_{name}", unit, f"RMS shaking {load}", lambda run: power_of(_mean_square(run, load), 1, 2),
         f"root of the mean square over time of {of}", equation="(8.28)")  # fmt: skip
    _add(f"max_{name}", unit, f"largest shaking {load}", lambda run: power_of(jnp.max(_squares(run, load)), 1, 2),
         f"largest saved size of {of}", kinked=True, note=OF_SAVED, equation="(8.28)", at_rest=True)  # fmt: skip
    _add(f"peak_{name}", unit, f"16-norm of the shaking {load}, below its maximum",
         lambda run: p_norm(getattr(run.recorded[RECORD], load)), f"{BELOW}, of {of}",
         note=f"{BELOW}, which is `max_{name}`", equation="(8.7)", at_rest=True)  # fmt: skip


_register("force", "N", "N^2", "force of the mechanism on its base, weight included")
_register("moment", "N m", "(N m)^2", "moment of the mechanism on its base about `shaking_point`, weight included")


def with_shaking(names: Iterable[str], mechanism: Mechanism) -> list[str]:
    """Metrics of a study with those of what shakes the base, if its `shaking_point` asks for them and it names none.

    Raises: InputError for a joint or a force with the name that the columns of these loads have.
    """
    found = list(names)
    if mechanism.shaking_point is not None and RECORD not in records_for(found):
        found += REPORTED
    others = [one.name for one in (*mechanism.joints, *mechanism.forces)]
    if RECORD in others and RECORD in records_for(found):
        raise InputError(
            f"Argument `name` of a joint or a force must not be `{RECORD}` where the shaking force is asked for, whose "
            "columns have that name; rename it."
        )
    return found
