"""Balances of a run, and whether it is accepted.

Place in the pipeline: carry, records -> **balances** -> integration, accuracy.

Errors of the energy balance and of the balance of joint loads against the rate of momentum are relative to what is
exchanged and carried (theory, part 11); a run that is off by more than `remarks.BALANCE_LIMIT` is not accepted.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.elements.linear_validity import linear_error
from rfem_jax.mechanics.forces.nonsmooth_forces import may_be_only_loads
from rfem_jax.mechanics.implicit.residual import rounding_force
from rfem_jax.mechanics.model.model import Model, length_scale
from rfem_jax.mechanics.model.status import (
    CONTACT_NOT_RESOLVED,
    DIVERGED,
    DRIFTED,
    NOT_BALANCED,
    NOT_CONVERGED,
    OK,
    OUT_OF_RANGE,
    STEPS_EXHAUSTED,
)
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.outcome.observation import Record
from rfem_jax.simulation.outcome.remarks import BALANCE_LIMIT
from rfem_jax.simulation.outcome.run import RESIDUAL_LIMIT, Checks, Energy
from rfem_jax.simulation.stages.stepping import Carry
from rfem_jax.simulation.system import equations

DRIFT_LIMIT = 1e-6
# Of the work of the largest joint force over the longest link: where less energy moves, its errors say nothing.
LEAST_EXCHANGE = 1e-3


@partial(kernel, name="checks", in_parts=True)
def checks_of(
    model: Model,
    actual: ModelWithErrors,
    assembled: Int[Array, ""],
    carry: Carry,
    record: Record,
    energy: Energy,
    duration: Float[Array, ""],
    shortest: Float[Array, ""],
) -> tuple[Checks, Int[Array, ""]]:
    """The checks that say whether a run is to be trusted, and its status; `assembled`: that of the assembly;
    `duration` [s]; `shortest` [s]: step."""
    drift = jnp.max(record.drift)
    largest = force_scale(model, actual, carry, energy, duration, shortest)
    error, (momentum, moment) = balance_error(model, energy, largest), momentum_error(model, record, largest)
    residual = carry.residual / safe_divisor(largest)
    checks = Checks(
        energy_balance_error=error,
        closure_drift=drift,
        closure_drift_angle=jnp.max(record.drift_angle),
        momentum_balance_error=momentum,
        hinge_moment_error=jnp.max(record.hinge_residual) / safe_divisor(moment),
        stabilisation_share=jnp.max(record.stabilising) / safe_divisor(jnp.max(record.multiplier)),
        solution_residual=residual,
        linear_error=linear_error(record.linear),
        equation_residual=record.residual,
    )
    used = jnp.max(record.range_used)
    return checks, status_of_run(model, assembled, carry, (error, momentum), drift, used, residual)


def status_of_run(
    model: Model,
    assembled: Int[Array, ""],
    carry: Carry,
    balances: tuple[Float[Array, ""], Float[Array, ""]],
    drift: Float[Array, ""],
    used: Float[Array, ""],
    residual: Float[Array, ""],
) -> Int[Array, ""]:
    """Status code: that of the assembly, or what is worst of a run.

    `balances`: errors of energy and momentum; `drift` [m]; `used`: share of the range of coordinates; `residual`: of
    an implicit method, relative.
    """
    energy, momentum = balances
    finite = jnp.isfinite(energy) & jnp.all(jnp.isfinite(carry.peaks))
    for leaf in jax.tree.leaves(carry.trajectory):
        finite = finite & jnp.all(jnp.isfinite(leaf))
    code = jnp.where(drift < DRIFT_LIMIT * length_scale(model), OK, DRIFTED)
    code = jnp.where(momentum < BALANCE_LIMIT, code, NOT_BALANCED)
    code = jnp.where(energy < BALANCE_LIMIT, code, CONTACT_NOT_RESOLVED if model.topology.clearances else NOT_BALANCED)
    code = jnp.where(residual < RESIDUAL_LIMIT, code, NOT_CONVERGED)
    code = jnp.where(used < 1.0, code, OUT_OF_RANGE)
    code = jnp.where(carry.exhausted, STEPS_EXHAUSTED, code)
    code = jnp.where(finite, code, DIVERGED)
    return jnp.where(assembled == OK, code, assembled).astype(jnp.int32)


def largest_force(carry: Carry) -> Float[Array, ""]:
    """The largest axial or normal force [N] that any joint has carried."""
    return equations.safe_sqrt(equations.largest_component(carry.peaks))


def force_or_moment(model: Model, force: Float[Array, ""], moment: Float[Array, ""]) -> Float[Array, ""]:
    """A largest force [N], or with friction, whose moments may be the only loads, a moment [N m] over the longest link
    where that is larger."""
    return jnp.maximum(force, moment / length_scale(model)) if may_be_only_loads(model) else force


def force_scale(
    model: Model,
    actual: ModelWithErrors,
    carry: Carry,
    energy: Energy,
    duration: Float[Array, ""],
    shortest: Float[Array, ""],
) -> Float[Array, ""]:
    """Force [N] with which residual forces are compared: the largest joint force. It is at least the largest RMS moment
    over the longest link with friction, which may be the only load; the kinetic energy over that link with free links
    or couplings, whose joints may carry no load; and the effect of rounding in the `shortest` step [s]."""
    mean_square = jnp.max(carry.trajectory.integrals.moment_square) / duration
    largest = force_or_moment(model, largest_force(carry), equations.safe_sqrt(mean_square))
    if carry.memory is not None:
        largest = jnp.maximum(largest, rounding_force(actual, length_scale(model), shortest))
    if "free" not in model.topology.kinds and model.couplings is None:
        return largest
    return jnp.maximum(largest, jnp.max(energy.kinetic) / length_scale(model))


def momentum_error(
    model: Model, record: Record, largest: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Error of the momentum balance over joint loads, and the largest joint moment [N m].

    Of a hinge at the origin, which has no arm there, a moment is compared with its force on the longest link; joints of
    free bodies carry nothing but rounding, beside the `largest` force [N] of `force_scale`.
    """
    force, moment = jnp.max(record.largest_load, axis=0)
    force = jnp.maximum(force, largest)
    moment = moment + force * length_scale(model)
    return jnp.max(jnp.max(record.momentum_residual, axis=0) / safe_divisor(jnp.stack([force, moment]))), moment


def balance_error(model: Model, energy: Energy, largest: Float[Array, ""]) -> Float[Array, ""]:
    """Error of the energy balance over the energy that is exchanged, or over a share of the work of the `largest` joint
    force [N] over the longest link; forces of impacts are large and do little work, so with clearance a share of the
    largest energy takes its place."""
    balance = energy.total - energy.work + energy.dissipation
    work = jnp.max(jnp.abs(energy.total)) if model.topology.clearances else largest * length_scale(model)
    least = LEAST_EXCHANGE * work
    return jnp.max(jnp.abs(balance - balance[0])) / safe_divisor(jnp.maximum(energy.exchanged, least))


def safe_divisor(value: Array) -> Array:
    """The values, with one in place of zeros."""
    return jnp.where(value > 0.0, value, 1.0)
