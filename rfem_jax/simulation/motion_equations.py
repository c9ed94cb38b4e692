"""The equations of motion of one mechanism as a vector field, for the caller's own solver, events and saved times.

Place in the pipeline: Simulation, errors -> **EquationsOfMotion** -> diffrax.diffeqsolve.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from rfem_jax.description.basics.calls import with_known_arguments
from rfem_jax.description.basics.errors import InputError
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import energy_and_momentum
from rfem_jax.mechanics.model.errors import Errors
from rfem_jax.mechanics.model.inputs import Stabilisation
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, with_structural_zeros
from rfem_jax.mechanics.statics.assembly import Load, named
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.simulation.specification import Simulation, simulation_of_call
from rfem_jax.simulation.stages.integration import prepare
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.driving import ActiveDrives, active_drives, all_jumps, drive_of_design
from rfem_jax.simulation.system.equations import Conditions, Trajectory
from rfem_jax.simulation.system.stabilisation import stabilisation_of


class EquationsOfMotion(eqx.Module):
    """The equations of motion of an assembled mechanism: a vector field f(t, state, args) for `diffrax.ODETerm`.

    start: the state at the start, a `Trajectory`: position and velocity of all coordinates, and integrals over time of
    squared loads, work and dissipation, which are zero; preload of every joint; status of the assembly (0 = ok);
    jumps [s]: times at which drives or forces jump, for `jump_ts` of diffrax's step size controllers. At a jump the
    field is that after it.
    """

    start: Trajectory
    preload: dict[str, Load]
    status: Int[Array, ""]
    model: Model
    actual: ModelWithErrors
    drives: ActiveDrives
    stabilisation: Stabilisation
    jumps: tuple[float, ...] = eqx.field(static=True)

    def __call__(self, t: ArrayLike, state: Trajectory, args: object = None) -> Trajectory:
        """Derivative of the state with respect to the time t [s]; `args` are not used."""
        del args
        return _rate(jnp.asarray(t, jnp.float64), state, self._conditions(t))

    def loads(self, t: ArrayLike, state: Trajectory) -> dict[str, Load]:
        """Force [N] and moment [N m] of every joint at the time t [s], in its frame H."""
        instant = equations.at_instant(jnp.asarray(t, jnp.float64), state, self._conditions(t))
        return named(self.model, instant[3])

    def energy(self, state: Trajectory) -> Float[Array, ""]:
        """Kinetic, elastic and gravity energy [J]; less `integrals.work` and plus `integrals.dissipation` it stays."""
        return sum(energy_and_momentum.energies(self.actual, State(state.position, state.velocity)), jnp.zeros(()))

    def _conditions(self, t: ArrayLike) -> Conditions:
        passed = jnp.sum(jnp.asarray(t) >= jnp.asarray(self.jumps, jnp.float64)).astype(jnp.int32)
        return Conditions(self.actual, self.drives, passed, self.stabilisation)


@kernel
def _rate(t: Float[Array, ""], state: Trajectory, conditions: Conditions) -> Trajectory:
    known = dataclasses.replace(conditions, actual=with_structural_zeros(conditions.actual))
    return equations.right_hand_side(t, state, known)


@with_known_arguments("equations_of_motion")
def equations_of_motion(simulation: Simulation, errors: Errors | None = None) -> EquationsOfMotion:
    """The equations of motion of a mechanism with its errors, assembled.

        motion = equations_of_motion(simulation, errors)
        controller = diffrax.PIDController(rtol=1e-8, atol=1e-10, jump_ts=motion.jumps or None)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(motion), diffrax.Dopri8(), 0.0, 0.5, 1e-5, motion.start, stepsize_controller=controller
        )

    **Arguments:** `simulation`: its duration is not used, of its method only the gain of Baumgarte's stabilisation;
    `errors` from `assembly_errors`, or {name: value} (None: perfect).

    **Returns:** a pytree, which may be an argument of a compiled function. Links with contacts and friction have memory
    or stiff laws for which `simulate` has methods of its own.
    """
    simulation = simulation_of_call("equations_of_motion", simulation, {})
    made = designed(simulation.model, simulation.design, errors)
    model = made.model
    if model.topology.reduced:
        raise InputError(
            "Argument `simulation` must be of a mechanism without reduced bodies, whose mass matrices couple their "
            "interfaces, but has one; use `simulate` with an implicit method."
        )
    drive = drive_of_design(model, simulation.drive, simulation.design)
    prepared = prepare(model, made.errors, drive, simulation.start)
    return EquationsOfMotion(
        equations.start_trajectory(model, prepared.state),
        named(model, prepared.preload),
        prepared.status,
        model,
        prepared.actual,
        active_drives(model, drive),
        stabilisation_of(model, simulation.chosen),
        all_jumps(drive, model),
    )
