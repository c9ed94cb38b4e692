"""The static equilibrium of pins in their bushes: Newton's method that keeps contacts as they are.

Place in the pipeline: search, bush_contacts, pins_on_compliance -> **contact** -> assembly.

Where a contact is open it has no stiffness, and where it closes its stiffness jumps by orders of magnitude, so that
Newton's method from the closed mechanism does not converge.  Everything but the contacts is smooth and nearly linear.
So only the mechanism is linearised, its pins held where they are by stiff springs, and condensed to the poses of its
pins; there contacts take the place of the springs, which is a problem of six unknowns a pin that is solved
to its end (`pins_on_compliance`).  Poses and all other unknowns follow, and are the start of the next step (theory
(15.11) to (15.13)).

The matrix is that of the undeformed perfect mechanism first, which is the same for all samples of a batch, and only
where that does not converge the present one, under loads that grow by steps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.forces.bush_contacts import pins_of
from rfem_jax.mechanics.forces.element_loads import element_pose
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.laws.frame_forces import Pose
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.statics.pins_on_compliance import HeldPin, Units, change_of, holding, pin_wrenches, pins_at_rest
from rfem_jax.mechanics.statics.search import (
    CHORD_TOLERANCE,
    LARGEST_ROTATION_OF_A_STEP,
    Equations,
    iterate,
    linearised,
    load_steps,
)

CHORD_ITERATIONS = 40


class _Condensed(NamedTuple):
    """The linearised mechanism with held pins: step (n,) of the unknowns without contacts; by_wrenches (n, 6 pins):
    their change by wrenches on the pins; poses (6 pins, n): change of the poses by the unknowns; all scaled."""

    step: Float[Array, " n"]
    by_wrenches: Float[Array, "n k"]
    poses: Float[Array, "k n"]

    def solve(self, actual: ModelWithErrors, at: list[Pose], units: Units) -> Float[Array, " n"]:
        """Step of the unknowns with the contacts of pins at present poses."""
        free, compliance = self.poses @ self.step, self.poses @ self.by_wrenches
        wrenches = pins_at_rest(list(pins_of(actual).values()), at, free, compliance, units)
        return self.step + self.by_wrenches @ wrenches


class _Search(NamedTuple):
    """The equations, and the units of the small problem."""

    equations: Equations
    units: Units

    def poses(self, unknowns: Array, actual: ModelWithErrors) -> list[Pose]:
        """Poses of the pins in their bushes."""

        def poses(unknowns, actual):
            state = loads.static_state(actual.topology, self.equations.coordinates(unknowns))
            motion = motion_of(actual, state)
            return [element_pose(actual.topology, motion, pin) for pin in pins_of(actual).values()]

        return kernel(poses, name="poses of pins")(unknowns, actual)

    def linearised(
        self, unknowns: Array, args: Any, at: list[Pose], wrenches: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Of the mechanism whose pins stiff springs hold at their present poses and that exert the given wrenches:
        residual, Jacobian, derivative of the residual by these wrenches (n, 6 pins), and of the poses by the unknowns
        (6 pins, n)."""
        n = unknowns.size

        def of(both, inputs):
            unknowns, (at, springs, (actual, angles)) = both[:n], inputs
            pins = pins_of(actual)
            names = [clearance_name(joint) for joint in pins]
            parts = zip(pins.values(), at, self.units.wrenches(both[n:]), springs, strict=True)
            held = [HeldPin(pin.parent, pin.child, pose, *wrench, spring) for pin, pose, wrench, spring in parts]
            changed = eqx.tree_at(lambda a: [a.frame_forces.elements[name] for name in names], actual, held)
            value = self.equations.residual(unknowns, (changed, angles))
            change = [change_of(*pair) for pair in zip(self.poses(unknowns, actual), at, strict=True)]
            return jnp.concatenate([value, jnp.concatenate(change) / self.units.of_poses(len(change))])

        springs = self.units.stiffnesses(holding(list(pins_of(args[0]).values()), self.units))
        held_equations = kernel(of, name="equations with held pins")
        value, jacobian = linearised(held_equations, jnp.concatenate([unknowns, wrenches]), (at, springs, args))
        return value[:n], jacobian[:n, :n], jacobian[:n, n:], jacobian[n:, :n]

    def newton(self, start: Array, args: Any, iterations: int) -> tuple[Array, Array, None]:
        """Unknowns after Newton's method with contacts, and whether it converged."""
        n = self.equations.n_coordinates

        def present(unknowns):
            at = self.poses(unknowns, args[0])
            wrenches = pin_wrenches(list(pins_of(args[0]).values()), at, self.units)
            value, jacobian, by_wrenches, poses = self.linearised(unknowns, args, at, wrenches)
            solved = self.equations.solve(jacobian, jnp.concatenate([value[:, None], by_wrenches], axis=1))
            step = _Condensed(-solved[:, 0], -solved[:, 1:], poses).solve(args[0], at, self.units)
            return value, -step, _rows(jacobian, unknowns, n), None

        return *iterate(n, start, iterations, present)[:2], None

    def chord(self, start: Array, undeformed: Array, perfect: Any, args: Any) -> tuple[Array, Array]:
        """Unknowns after the chord method with the matrix of the perfect mechanism, and whether it converged."""
        n = self.equations.n_coordinates
        at = self.poses(undeformed, perfect[0])
        # Without wrenches, which depend on clearances: a batch of these shares the matrix.
        _, jacobian, by_wrenches, poses = self.linearised(undeformed, perfect, at, jnp.zeros(6 * len(at)))
        inverse = self.equations.solve(jacobian, jnp.eye(undeformed.size))
        by_wrenches = -inverse @ by_wrenches

        def constant(unknowns):
            value = self.equations.residual(unknowns, args)
            condensed = _Condensed(-inverse @ value, by_wrenches, poses)
            step = condensed.solve(args[0], self.poses(unknowns, args[0]), self.units)
            return value, -step, _rows(jacobian, unknowns, n), None

        near, converged, _ = iterate(n, start, CHORD_ITERATIONS, constant, tolerance=CHORD_TOLERANCE)
        return near, converged


def _rows(jacobian: Array, unknowns: Array, n: int) -> Array:
    """Change of every residual by a step of size one; the first `n` unknowns are coordinates."""
    return jnp.abs(jacobian) @ jnp.concatenate([jnp.ones(n), 1.0 + jnp.abs(unknowns[n:])])


def search_contact(
    equations: Equations,
    starts: tuple[Float[Array, " n"], Float[Array, " n"]],
    perfect: tuple[ModelWithErrors, Any],
    loaded: tuple[ModelWithErrors, Any],
    scales: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """Unknowns under load and whether the search converged; `starts`: undeformed, without and with the held angles;
    `perfect` and `loaded`: args of the equations; `scales`: length [m] and force [N] of the mechanism."""
    search = _Search(equations, Units(*scales))
    undeformed, guess = starts
    shared = eqx.tree_at(lambda a: a.frame_forces.share, perfect[0], jnp.ones(()))
    near, converged = search.chord(guess, undeformed, (shared, perfect[1]), loaded)
    rotation = equations.coordinates(near - guess).elastic[3:]
    converged = converged & (jnp.max(jnp.abs(rotation), initial=0.0) < LARGEST_ROTATION_OF_A_STEP)

    def followed(undeformed, perfect, loaded, converged):
        return load_steps(equations, undeformed, perfect, loaded, search.newton, converged)[:2]

    follow = kernel(followed, name="contacts under growing loads", in_parts=True)
    end, reached = follow(undeformed, perfect, loaded, converged)
    return jnp.where(converged, near, end), reached
