"""The loads of a finished run in the axes of links or in global ones.

Place in the pipeline: `Run.loads_in` calls it; files and labelled data ask for it.

Where the mechanism was is known of every run, so that nothing is simulated or recorded for it.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.mechanics.dynamics.load_axes import AXES, turned_loads
from rfem_jax.mechanics.dynamics.loads import JointLoads, static_state
from rfem_jax.mechanics.kinematics.cut_joints import closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.model import Coordinates, Model, length_scale
from rfem_jax.mechanics.model.with_errors import apply_errors

Run = Any  # `rfem_jax.simulation.outcome.run.Run`, which imports this module
Histories = tuple[Float[Array, "*times joints 3"], Float[Array, "*times joints 3"]]


def histories_in(run: Run, axes: str, preload: bool = False) -> Histories:
    """Forces and moments of all joints in the order of the model's topology, at the saved times, or with `preload` at
    the start.

    Raises: InputError for unknown axes, and for a run that does not say where its mechanism is.
    """
    require_choice(axes, tuple(AXES), "axes")
    model, errors, positions = run.model, run.errors, run.motion.positions
    if model is None or errors is None or positions is None:
        raise InputError(
            "Argument `axes` must be `joint` of a run that does not say where its mechanism is, but is "
            f"`{axes}`; take a run as `simulate` returns it."
        )
    batch = np.ndim(run.status)
    loads = [run.preload[name] if preload else run.loads[name] for name in model.topology.joints]
    force, moment = (
        jnp.stack([jnp.asarray(getattr(one, part)) for one in loads], axis=-2) for part in ("force", "moment")
    )
    if preload:
        at = (slice(None),) * batch + (slice(0, 1),)
        positions = jax.tree.map(lambda x: jnp.asarray(x)[at], positions)
        force, moment = (jnp.expand_dims(x, batch) for x in (force, moment))
    # Laws may hold functions of the user, and have no part in where things are.
    model = eqx.tree_at(
        lambda m: (m.forces, m.frame_forces, m.friction, m.bearings, m.points), model, 5 * (None,),
        is_leaf=lambda x: x is None,
    )  # fmt: skip
    turned = _turned(model, errors, positions, (force, moment), axes, batch)
    return tuple(jnp.squeeze(x, batch) for x in turned) if preload else turned  # pyright: ignore[reportReturnType]


@partial(Program, nameless=True)
def _turned(
    model: Model, errors: AssemblyErrors, positions: Coordinates, loads: Histories, axes: str, batch: int
) -> Histories:
    def of_run(model: Model, errors: AssemblyErrors, positions: Coordinates, loads: Histories) -> Histories:
        actual = apply_errors(model, errors)

        def at_time(both):
            position, (force, moment) = both
            motion = motion_of(actual, static_state(model.topology, position))
            cuts = closure(actual, motion, length_scale(model))
            turned = turned_loads(model.topology, motion, cuts, JointLoads(force.T, moment.T), axes)
            return turned.force.T, turned.moment.T

        return jax.lax.map(at_time, (positions, loads))

    function = of_run
    for _ in range(batch):
        function = eqx.filter_vmap(function)
    return function(model, errors, positions, loads)
