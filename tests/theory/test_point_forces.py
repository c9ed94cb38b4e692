"""Forces at points of links and between them, against closed forms and reference values."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GeneralisedAlpha,
    GivenSection,
    Joint,
    Leapfrog,
    Link,
    Mechanism,
    PointForce,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    RungeKutta4,
    assemble,
    assembly_errors,
    discretise,
    largest_stable_step,
)
from rfem_jax.simulation.vibrations.stability import eigenvalues
from tests.mechanisms import body, link, released

MASS, STIFFNESS, DAMPING, FREE, PRELOAD, START = 0.5, 80.0, 2.5, 0.6, 3.0, 0.24
AWAY = 0.5  # from the base's point to the zero of the guide
RK4, ALPHA = RungeKutta4(step=2e-4), GeneralisedAlpha(step=1e-4)


def sliders(*forces, starts=(START,), gravity=(0.0, 0.0, -9.81)):
    """Blocks on one guide along x."""
    names = ["one", "two"][: len(starts)]
    joints = [Joint(f"G{name}", "base", name, kind="prismatic", displacement=x) for name, x in zip(names, starts)]
    return discretise(Mechanism([body(name, MASS) for name in names], joints, forces=list(forces), gravity=gravity))


SPRING = PointSpring("coil", ["base", "one"], [(-AWAY, 0.0, 0.0), 0.0], "80 N/m", DAMPING, "600 mm", PRELOAD)
RAMP = PointForce("push", "one", (0.02, 0.0, 0.01), [(0, 0, 0), (2, 0, 0), (-1, 5, 0), (-1, 0, 0)],
                  times=[0.0, 0.1, 0.1, 0.3])  # fmt: skip


def oscillation(t):
    """Displacement and rate of the damped oscillator from rest at the start."""
    mass = MASS + 1e-10
    centre, decay = FREE - AWAY - PRELOAD / STIFFNESS, DAMPING / (2.0 * mass)
    rate = np.sqrt(STIFFNESS / mass - decay**2)
    a, b = START - centre, (START - centre) * decay / rate
    x = centre + np.exp(-decay * t) * (a * np.cos(rate * t) + b * np.sin(rate * t))
    v = np.exp(-decay * t) * (-(rate * a + decay * b) * np.sin(rate * t) + (rate * b - decay * a) * np.cos(rate * t))
    return x, v


class TestOscillator:
    """A block on a guide with a spring to a point of the base on its line."""

    @pytest.mark.parametrize("method", [RK4, ALPHA], ids=lambda method: method.name)
    def test_motion_tension_and_energy(self, method):
        run = released(sliders(SPRING), duration=0.4, method=method, save_every=0.1)
        assert int(run.status) == 0
        x, v = oscillation(np.asarray(run.times))
        np.testing.assert_allclose(run.motion.displacements["Gone"], x, rtol=0, atol=2e-7)
        tension = PRELOAD + STIFFNESS * (x + AWAY - FREE) + DAMPING * v
        np.testing.assert_allclose(run.forces["coil"].length, x + AWAY, rtol=0, atol=2e-7)
        np.testing.assert_allclose(run.forces["coil"].tension, tension, rtol=0, atol=1e-4)
        # The spring is no part of the joint: along the guide nothing acts.
        np.testing.assert_allclose(run.loads["Gone"].force[:, 0], 0.0, atol=1e-4)
        energy = (0.5 * STIFFNESS * (x + AWAY - FREE) + PRELOAD) * (x + AWAY - FREE)
        np.testing.assert_allclose(run.energy.elastic, energy, rtol=0, atol=1e-5)
        np.testing.assert_allclose(run.energy.dissipation, energy[0] - energy - 0.5 * MASS * v**2, rtol=0, atol=1e-5)
        assert float(run.checks.hinge_moment_error) < 1e-6
        assert float(run.checks.momentum_balance_error) < 1e-6

    def test_a_function_does_the_work_of_the_spring(self):
        """The same spring as a function of length and rate, of which nothing is known but its force: its power is work
        from outside."""

        def tension(length, rate):
            return PRELOAD + STIFFNESS * (length - FREE) + DAMPING * rate

        function = PointSpringFunction("coil", SPRING.links, SPRING.points, tension)
        run = released(sliders(function), duration=0.4, method=RK4, save_every=0.1)
        x, v = oscillation(np.asarray(run.times))
        np.testing.assert_allclose(run.motion.displacements["Gone"], x, rtol=0, atol=2e-7)
        np.testing.assert_allclose(run.forces["coil"].tension, tension(x + AWAY, v), rtol=0, atol=1e-4)
        np.testing.assert_allclose(run.energy.work, 0.5 * MASS * v**2, rtol=0, atol=1e-6)
        assert not run.energy.elastic.any() and not run.energy.dissipation.any()
        assert float(run.checks.energy_balance_error) < 1e-6

    def test_eigenvalues_and_step(self):
        decay = DAMPING / (2.0 * MASS)
        at_rest = PointSpring("coil", SPRING.links, SPRING.points, STIFFNESS, DAMPING, AWAY + START)
        expected = -decay + 1j * np.sqrt(STIFFNESS / MASS - decay**2)
        np.testing.assert_allclose(np.sort_complex(eigenvalues(sliders(at_rest)))[-1], expected, rtol=1e-6)
        stiff = sliders(PointSpring("coil", SPRING.links, SPRING.points, 1e8, free_length=AWAY + START))
        limit = largest_stable_step(stiff, Leapfrog(step=1e-6))
        np.testing.assert_allclose(limit, 2.0 / np.sqrt(1e8 / MASS), rtol=5e-3)

    def test_a_flexible_link_on_a_spring(self):
        """Frequency of a bar that turns like a rigid one on a soft spring at its end, and the stiffest mode of a hard
        one at the middle rfe, which shakes alone on it."""
        inertia, length = 0.785 * 0.2**3 / 3.0, 0.2

        def hinged(stiffness, damping, x):
            spring = PointSpring("s", ["arm", "base"], [x, (x, 0.0, 0.3)], stiffness, damping, 0.3)
            return discretise(Mechanism([link("arm", length, 3)], [Joint("A", "base", "arm")], forces=[spring]))

        values = eigenvalues(hinged(1.0, 1e-3, length))
        slowest = values[np.argmin(np.abs(values))]
        decay = 0.5 * 1e-3 * length**2 / inertia
        expected = -decay + 1j * np.sqrt(length**2 / inertia - decay**2)
        np.testing.assert_allclose(slowest.real + 1j * abs(slowest.imag), expected, rtol=2e-3)
        values = eigenvalues(hinged(1e12, 0.0, 0.5 * length))
        np.testing.assert_allclose(np.abs(values).max(), np.sqrt(1e12 / (0.785 * 0.1)), rtol=1e-3)


class TestTwoBlocks:
    def test_springs_in_series(self):
        """The second block hangs on the first by a spring; forces of both directions pull it."""
        springs = [
            PointSpring("first", ["base", "one"], [(-AWAY, 0, 0), 0.0], 200.0, free_length=AWAY),
            PointSpring("second", ["one", "two"], [0.0, 0.0], 300.0, free_length=0.2),
        ]
        model = sliders(*springs, PointForce("pull", "two", 0.0, (6.0, 1.0, 2.0)), starts=(0.0, 0.2))
        assembled = assemble(model, assembly_errors(model))
        assert int(assembled.status) == 0
        expected = [6.0 / 200.0, 0.2 + 6.0 / 200.0 + 6.0 / 300.0]
        np.testing.assert_allclose(assembled.state.position.joints, expected, rtol=1e-10)
        np.testing.assert_allclose(assembled.preload["Gtwo"].force, [0.0, -1.0, MASS * 9.81 - 2.0], rtol=0, atol=1e-8)

    def test_a_stiff_spring_between_them_in_long_steps(self):
        """Its period is a third of a step: without its coupling of both blocks in the iteration matrix, Newton's method
        would fail.  The blocks move as one under the force."""
        stiff = PointSpring("rod", ["one", "two"], [0.0, (0.0, 0.0, 0.1)], 1e8, free_length=np.hypot(0.2, 0.1))
        model = sliders(stiff, PointForce("pull", "two", 0.0, (3.0, 0.0, 0.0)), starts=(0.0, 0.2))
        method = GeneralisedAlpha(step=1e-3)
        run = released(model, duration=0.05, method=method, save_every=0.01)
        assert int(run.status) == 0
        assert float(run.checks.solution_residual) < 1e-3
        moved = 0.5 * 3.0 / (2 * MASS) * np.asarray(run.times) ** 2
        np.testing.assert_allclose(run.motion.displacements["Gone"], moved, rtol=0, atol=1e-6)
        np.testing.assert_allclose(
            run.motion.displacements["Gtwo"] - run.motion.displacements["Gone"], 0.2, rtol=0, atol=1e-6
        )
        # A damped step after the jump of the force at the start, the rod carries what the first block needs.
        along = run.forces["rod"].force[-1]
        np.testing.assert_allclose(along[0], -1.5, rtol=1e-3)


class Hardening(eqx.Module):
    """A tension that grows with the cube of the stretch, with a damper."""

    stiffness: jax.Array

    def __call__(self, length, rate):
        return self.stiffness * (length - FREE) ** 3 + DAMPING * rate


@pytest.mark.long
def test_equilibrium_on_a_function_and_its_derivatives():
    """x = FREE - AWAY + (pull / stiffness)^(1/3), by both numbers and in both modes."""
    pull, stiffness = 3.0, 400.0
    function = PointSpringFunction("coil", SPRING.links, SPRING.points, Hardening(jnp.asarray(stiffness)))
    model = sliders(function, PointForce("pull", "one", 0.0, (pull, 0.0, 0.0)))

    def place(stiffness, pull):
        numbers = lambda model: (model.frame_forces["coil"].function.stiffness, model.frame_forces["pull"].value.values)  # noqa: E731
        loaded = eqx.tree_at(numbers, model, (stiffness, jnp.asarray([1.0, 0.0, 0.0]) * pull))
        assembled = assemble(loaded, assembly_errors(loaded))
        return assembled.state.position.joints[0], assembled.status

    numbers = jnp.asarray(stiffness), jnp.asarray(pull)
    found, status = place(*numbers)
    stretch = (pull / stiffness) ** (1.0 / 3.0)
    assert int(status) == 0
    np.testing.assert_allclose(found, FREE - AWAY + stretch, rtol=1e-9)
    expected = [-stretch / (3.0 * stiffness), stretch / (3.0 * pull)]
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(place, (0, 1), has_aux=True))(*numbers)[0], expected, rtol=1e-8)


class TestTime:
    def test_a_table_with_a_jump(self):
        """Polynomials of the third degree, which Runge-Kutta 4 integrates exactly if its steps end at the jump."""
        run = released(sliders(RAMP), duration=0.35, method=RK4, save_every=0.05)
        t, mass = np.asarray(run.times), MASS + 1e-10
        rising = 20.0 * t**3 / 6.0
        at, rate = 20.0 * 0.1**3 / 6.0, 20.0 * 0.1**2 / 2.0
        after = at + rate * (t - 0.1) - np.minimum(t - 0.1, 0.2) ** 2 / 2.0
        after = after - np.maximum(t - 0.3, 0.0) * 0.2
        x = START + np.where(t < 0.1, rising, after) / mass
        np.testing.assert_allclose(run.motion.displacements["Gone"], x, rtol=0, atol=1e-12)
        force = np.where(t < 0.1 + 1e-9, 20.0 * t, np.where(t < 0.3 + 1e-9, -1.0, 0.0))
        np.testing.assert_allclose(run.forces["push"].force[:, 0], force, rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.energy.work, run.energy.kinetic, rtol=0, atol=1e-8)
        # Behind the jump 5 N push across, whose moment is that of the arm to the joint.
        just_behind = int(np.argmin(np.abs(t - 0.15)))
        across, load = 5.0 * 0.75, run.loads["Gone"]
        np.testing.assert_allclose(load.force[just_behind, 1], -across, rtol=1e-9)
        np.testing.assert_allclose(load.moment[just_behind], [0.01 * across, 0.01, -0.02 * across], rtol=1e-7)

    @pytest.mark.long
    def test_derivatives_with_respect_to_all_numbers(self):
        model = sliders(SPRING, RAMP)

        def numbers(model):
            coil, push = model.frame_forces["coil"], model.frame_forces["push"]
            return coil.stiffness, coil.damping, coil.free_length, coil.preload, push.value.values

        def end(values):
            moved = eqx.tree_at(numbers, model, (*values[:4], model.frame_forces["push"].value.values * values[4]))
            run = released(moved, duration=0.12, method=GeneralisedAlpha(step=1e-3), save_every=0.06)
            return jnp.stack([run.motion.displacements["Gone"][-1], run.metrics.mean_square_moment["Gone"]])

        at = jnp.asarray([STIFFNESS, DAMPING, FREE, PRELOAD, 1.0])
        end = jax.jit(end)
        forward, backward = jax.jit(jax.jacfwd(end))(at), jax.jit(jax.jacrev(end))(at)
        np.testing.assert_allclose(forward, backward, rtol=1e-8)
        differences = [(end(at + d) - end(at - d)) / (2.0 * d.sum()) for d in jnp.diag(1e-4 * at)]
        np.testing.assert_allclose(forward, np.array(differences).T, rtol=2e-5, atol=1e-12)


SEGMENTS, LENGTH, RIGIDITY = 6, 1.0, 1.0


def clamped(elements, *forces):
    """A beam along x that bends only, without weight."""
    section = GivenSection(1e7, 1e7, 1e7, 1.0, RIGIDITY, RIGIDITY, 1e-9, 2e-13, 1e-13, 1e-13)
    beam = Link("beam", LENGTH, section, rfes=SEGMENTS + 1)
    joint = Joint("A", "base", "beam", kind="fixed")
    return discretise(Mechanism([beam], [joint], forces=list(forces), gravity=(0, 0, 0)), elements=elements)


def bent(model, force, moment):
    """Status, tip rotation about y and last rfe's middle in the plane, under a force and a moment at the tip."""

    def values(model):
        return model.frame_forces["tip"].value.values, model.frame_forces["twist"].value.values

    across, about = jnp.asarray([0.0, 0.0, 1.0]) * force, jnp.asarray([0.0, 1.0, 0.0]) * moment
    loaded = eqx.tree_at(values, model, (across, about))
    out = assemble(loaded, assembly_errors(loaded), {})
    return out.state.position.elastic[:, -1], out.status


def polygon(force, moment):
    """The same of rigid segments joined by springs, from the tip, in whose axes a follower force stays, to the clamp:
    tip rotation, and the place of the last segment's middle from where it is at rest."""
    pitch = LENGTH / SEGMENTS
    turned = jnp.zeros(())
    at, middle = jnp.zeros(2), jnp.asarray([-0.25 * pitch, 0.0])
    # Angles are about y, from z to x; a segment that is turned by a has its axis along (cos a, -sin a).
    for k in range(SEGMENTS):
        along = jnp.stack([jnp.cos(turned), -jnp.sin(turned)])
        at = at - (0.5 if k == 0 else 1.0) * pitch * along
        arm = -at
        bending = moment - arm[0] * force  # y component of arm x (0, 0, force)
        turned = turned - bending * pitch / RIGIDITY
    along = jnp.stack([jnp.cos(turned), -jnp.sin(turned)])
    clamp = at - 0.5 * pitch * along
    # From the clamp, in its axes: turn back.
    c, s = jnp.cos(-turned), jnp.sin(-turned)
    x, z = middle - clamp
    placed = jnp.stack([c * x + s * z, c * z - s * x])
    return -turned, placed - jnp.asarray([LENGTH - 0.25 * pitch, 0.0])


class TestCantilever:
    @pytest.mark.long
    def test_follower_force_and_moment_on_exact_elements(self):
        """Both ways of derivatives, of an unsymmetric tangent; and the elastica's end moment, which bends every
        spring alike."""
        twist = PointMoment("twist", "beam", LENGTH, (0, 1, 0))
        forces = [PointForce("tip", "beam", LENGTH, (0, 0, 1), axes="link"), twist]
        model = clamped("geometrically_exact", *forces)
        shape = jax.jit(jax.vmap(lambda load: bent(model, load[0], load[1])))
        loads_ = np.array([[0.0, 2.0], [-3.0, 0.0], [-2.0, 0.7]])
        elastic, status = shape(loads_)
        assert np.all(np.asarray(status) == 0)
        expected = [polygon(*load) for load in loads_]
        for got, (angle, place) in zip(np.asarray(elastic), expected):
            assert abs(angle) > 0.8
            np.testing.assert_allclose(got[4], angle, rtol=2e-6)
            np.testing.assert_allclose([got[0], got[2]], place, rtol=0, atol=2e-6)
        np.testing.assert_allclose(elastic[0, 4], 2.0 * LENGTH / RIGIDITY, rtol=1e-6)
        angle_of = lambda load: bent(model, load[0], load[1])[0][4]  # noqa: E731
        forward, backward = jax.jit(jax.jacfwd(angle_of))(loads_[2]), jax.jit(jax.jacrev(angle_of))(loads_[2])
        np.testing.assert_allclose(forward, backward, rtol=1e-9)
        derivative = jax.jacfwd(lambda load: polygon(load[0], load[1])[0])(jnp.asarray(loads_[2]))
        np.testing.assert_allclose(forward, derivative, rtol=1e-5)

    @pytest.mark.long
    def test_end_force_and_moment_on_linear_elements(self):
        forces = [PointForce("tip", "beam", LENGTH, (0, 0, 1)), PointMoment("twist", "beam", LENGTH, (0, 1, 0))]
        model = clamped("linear", *forces)

        def shape(load):
            elastic, status = bent(model, load[0], load[1])
            return jnp.stack([elastic[2] - 0.25 / SEGMENTS * elastic[4], elastic[4]]), status

        load = jnp.asarray([-1e-4, 2e-4])
        (deflection, rotation), status = jax.jit(shape)(load)
        assert int(status) == 0
        places = (np.arange(SEGMENTS) + 0.5) / SEGMENTS * LENGTH
        moments = float(load[1]) - float(load[0]) * (LENGTH - places)
        turns = moments * LENGTH / SEGMENTS / RIGIDITY
        np.testing.assert_allclose(rotation, turns.sum(), rtol=1e-6)
        np.testing.assert_allclose(deflection, -np.sum(turns * (LENGTH - places)), rtol=1e-6)
        # The continuous beam's, within the error of the division.
        continuous = float(load[0]) * LENGTH**3 / 3.0 - float(load[1]) * LENGTH**2 / 2.0
        np.testing.assert_allclose(deflection, continuous, rtol=1.0 / SEGMENTS**2)
        forward, backward = (jax.jit(mode(lambda x: shape(x)[0]))(load) for mode in (jax.jacfwd, jax.jacrev))
        np.testing.assert_allclose(forward, backward, rtol=1e-7)
        np.testing.assert_allclose(forward @ load, [deflection, rotation], rtol=1e-5)
