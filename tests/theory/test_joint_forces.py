"""Springs, dampers and laws on the free motions of joints, against closed forms and reference values."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GeneralisedAlpha,
    Joint,
    JointForceFunction,
    JointForceTable,
    JointSpring,
    Leapfrog,
    Mechanism,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    discretise,
    largest_stable_step,
    simulate,
)
from rfem_jax.mechanics.dynamics import energy_and_momentum
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.vibrations import vibration
from rfem_jax.simulation.vibrations.stability import eigenvalues
from tests.derivatives import check_derivatives
from tests.mechanisms import body, four_bar, link, released

MASS, STIFFNESS, DAMPING, REST, PRELOAD, START = 0.5, 80.0, 2.5, 0.1, 3.0, 0.24
METHODS = (RungeKutta4(step=1e-4), Leapfrog(step=2e-5), GeneralisedAlpha(step=1e-4))
by_name = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)


def slider(*forces, gravity=(0.0, 0.0, -9.81)):
    joint = Joint("G", "base", "block", kind="prismatic", displacement=START)
    return discretise(Mechanism([body("block", MASS)], [joint], forces=list(forces), gravity=gravity))


SPRING = JointSpring("coil", "G", stiffness="80 N/m", damping=DAMPING, rest="100 mm", preload=PRELOAD)


def oscillation(t):
    """Displacement, and energy that the damper has taken, of the damped oscillator from rest at the start."""
    mass = MASS + 1e-10
    centre, decay = REST + PRELOAD / STIFFNESS, DAMPING / (2.0 * mass)
    rate = np.sqrt(STIFFNESS / mass - decay**2)
    a, b = START - centre, (START - centre) * decay / rate
    x = centre + np.exp(-decay * t) * (a * np.cos(rate * t) + b * np.sin(rate * t))
    v = np.exp(-decay * t) * (-(rate * a + decay * b) * np.sin(rate * t) + (rate * b - decay * a) * np.cos(rate * t))
    return x, v


class TestOscillator:
    """A block on a guide with a spring and a damper."""

    @pytest.mark.slow
    @by_name
    def test_motion_load_and_energy(self, method):
        run = released(slider(SPRING), duration=0.4, method=method, save_every=0.1)
        assert int(run.status) == 0
        x, v = oscillation(np.asarray(run.times))
        np.testing.assert_allclose(run.motion.displacements["G"], x, rtol=0, atol=2e-7)
        # The spring and the damper are inside the joint: their force is its load along the guide.
        force = PRELOAD - STIFFNESS * (x - REST) - DAMPING * v
        np.testing.assert_allclose(run.loads["G"].force[:, 0], force, rtol=0, atol=1e-4)
        energy = 0.5 * STIFFNESS * (x - REST) ** 2 - PRELOAD * (x - REST)
        np.testing.assert_allclose(run.energy.elastic, energy, rtol=0, atol=1e-5)
        lost = energy[0] - energy - 0.5 * MASS * v**2
        np.testing.assert_allclose(run.energy.dissipation, lost, rtol=0, atol=1e-5)
        assert float(run.checks.hinge_moment_error) < 1e-6
        assert float(run.checks.momentum_balance_error) < 1e-6

    @pytest.mark.slow
    def test_rest_is_where_the_spring_holds_the_preload(self):
        model = slider(SPRING)
        assembled = assemble(model, assembly_errors(model))
        assert int(assembled.status) == 0
        np.testing.assert_allclose(assembled.state.position.joints, [REST + PRELOAD / STIFFNESS], rtol=1e-12)

    @pytest.mark.slow
    def test_held_it_carries_the_spring(self):
        model = slider(SPRING)
        assembled = assemble(model, assembly_errors(model), hold={"G": 0.2})
        # What holds the joint leaves nothing of the spring: the block is in balance.
        np.testing.assert_allclose(assembled.preload["G"].force[0], 0.0, atol=1e-12)

    def test_eigenvalues_and_step(self):
        model = slider(SPRING)
        decay = DAMPING / (2.0 * MASS)
        expected = -decay + 1j * np.sqrt(STIFFNESS / MASS - decay**2)
        np.testing.assert_allclose(np.sort_complex(eigenvalues(model))[-1], expected, rtol=1e-6)
        stiff = slider(JointSpring("coil", "G", stiffness=1e8))
        limit = largest_stable_step(stiff, Leapfrog(step=1e-6))
        np.testing.assert_allclose(limit, 2.0 / np.sqrt(1e8 / MASS), rtol=5e-3)

    def test_a_stiff_spring_in_long_steps(self):
        """A period is 0.4 steps: without its tangent in the iteration matrix, Newton's method would fail."""
        spring = JointSpring("coil", "G", stiffness=1e8, rest=START, preload=50.0)
        run = released(slider(spring), duration=0.05, method=GeneralisedAlpha(step=1e-3), save_every=0.01)
        assert int(run.status) == 0
        np.testing.assert_allclose(run.motion.displacements["G"], START, rtol=0, atol=2 * 50.0 / 1e8)

    @pytest.mark.long
    def test_derivatives_with_respect_to_all_numbers(self):
        model = slider(SPRING)

        def end(values):
            law = eqx.tree_at(
                lambda s: (s.stiffness, s.damping, s.rest, s.preload), model.forces["coil"], tuple(values)
            )
            moved = eqx.tree_at(lambda m: m.forces["coil"], model, law)
            run = released(moved, duration=0.1, method=METHODS[2], save_every=0.05)
            return jnp.stack([run.motion.displacements["G"][-1], run.metrics.mean_square_force["G"]])

        at = jnp.asarray([STIFFNESS, DAMPING, REST, PRELOAD])
        check_derivatives(end, at, 1e-4 * at, reverse=1e-8, differences=2e-5)


class TestLaws:
    """Tables and functions act from outside: they do work and are no part of the joint's load."""

    @pytest.mark.slow
    @by_name
    def test_a_table_is_a_spring_between_its_rows(self, method):
        table = JointForceTable("gas", "G", [-0.1, REST, 0.5], [STIFFNESS * 0.2, 0.0, -STIFFNESS * 0.4])
        run = released(slider(table), duration=0.4, method=method, save_every=0.1)
        rate = np.sqrt(STIFFNESS / (MASS + 1e-10))
        x = REST + (START - REST) * np.cos(rate * np.asarray(run.times))
        np.testing.assert_allclose(run.motion.displacements["G"], x, rtol=0, atol=1e-6)
        np.testing.assert_allclose(run.loads["G"].force[:, 0], 0.0, atol=1e-6)
        kinetic = 0.5 * MASS * ((START - REST) ** 2 - (x - REST) ** 2) * rate**2
        np.testing.assert_allclose(run.energy.work, kinetic, rtol=0, atol=1e-5)
        assert float(run.checks.energy_balance_error) < 1e-4

    @pytest.mark.slow
    def test_outside_its_positions_it_is_constant(self):
        table = JointForceTable("push", "G", [0.0, 0.1], [0.0, 2.0])
        run = released(slider(table), duration=0.1, method=METHODS[0])
        np.testing.assert_allclose(run.motion.displacements["G"][-1], START + 0.5 * 2.0 / MASS * 0.1**2, rtol=1e-8)

    @pytest.mark.slow
    def test_a_function_of_position_and_rate(self):
        class Cubic(eqx.Module):
            stiffness: jax.Array

            def __call__(self, position, rate):
                return -self.stiffness * position**3 - 0.5 * rate

        model = slider(JointForceFunction("cubic", "G", Cubic(jnp.asarray(900.0))))

        def reference(stiffness):
            def derivative(y):
                return jnp.stack([y[1], (-stiffness * y[0] ** 3 - 0.5 * y[1]) / (MASS + 1e-10)])

            def step(y, _):
                h = 1e-4
                a = derivative(y)
                b = derivative(y + h / 2 * a)
                c = derivative(y + h / 2 * b)
                return y + h / 6 * (a + 2 * b + 2 * c + derivative(y + h * c)), None

            return jax.lax.scan(step, jnp.array([START, 0.0]), length=1000)[0][0]

        def end(stiffness):
            moved = eqx.tree_at(lambda m: m.forces["cubic"].function.stiffness, model, stiffness)
            return released(moved, duration=0.1, method=METHODS[0], save_every=0.05).motion.displacements["G"][-1]

        np.testing.assert_allclose(end(jnp.asarray(900.0)), jax.jit(reference)(900.0), rtol=1e-12)
        np.testing.assert_allclose(jax.jit(jax.grad(end))(900.0), jax.jit(jax.grad(reference))(900.0), rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_a_spring_in_a_loop_at_rest(elements):
    """The moment that holds the crank is the derivative of the potential of links and spring along the mechanism."""
    spring = JointSpring("torsion", "D", stiffness=50.0, rest=-1.0)
    model = discretise(four_bar(rfes=2, forces=[spring], gravity=(0.0, 0.0, 0.0)), elements=elements)
    errors = assembly_errors(model, {"D.delta_x": 2e-3})

    def at(angle):
        assembled = assemble(model, errors, hold={"A": angle})
        energy = energy_and_momentum.energies(apply_errors(model, errors), assembled.state).elastic
        rocker = assembled.state.position.joints[model.topology.joints.index("D")]
        return energy, (assembled.preload["A"].moment[1], assembled.preload["D"].moment[1], rocker, assembled.status)

    (energy, (moment, of_spring, rocker, status)), derivative = jax.jit(jax.value_and_grad(at, has_aux=True))(-1.4)
    assert int(status) == 0 and float(energy) > 1.0
    np.testing.assert_allclose(of_spring, -50.0 * (rocker + 1.0), rtol=1e-9)
    assert abs(float(moment)) > 1.0
    np.testing.assert_allclose(moment, derivative, rtol=1e-8)


@pytest.mark.slow
def test_a_prescribed_drive_works_against_the_spring():
    spring = JointSpring("torsion", "A", stiffness=4.0, damping=0.2, rest=0.3)
    mechanism = Mechanism([link("arm", 0.2)], [Joint("A", "base", "arm", angle=0.3)], driven_joint="A",
                          gravity=(0.0, 0.0, 0.0), forces=[spring])  # fmt: skip
    model = discretise(mechanism)
    for method in METHODS[::2]:
        run = simulate(Simulation(model, drive=PrescribedRate("A", 3.0), duration=0.2, method=method, save_every=0.1))
        # At a constant rate the joint carries no moment about its axis: the drive holds the spring.
        np.testing.assert_allclose(run.loads["A"].moment[:, 1], 0.0, atol=1e-9)
        np.testing.assert_allclose(run.motion.drive_moment, 4.0 * 3.0 * run.times + 0.2 * 3.0, rtol=1e-9)
        assert float(run.checks.energy_balance_error) < 1e-6


class TestVibrationOfFlexibleLinks:
    """A spring so soft that the links turn like rigid ones, and one so stiff that rfe 0 shakes on it."""

    @staticmethod
    def expected(stiffness, damping, inertia):
        decay = damping / (2.0 * inertia)
        return -decay + 1j * np.sqrt(stiffness / inertia - decay**2)

    def test_soft_springs_at_the_base_and_behind_a_flexible_link(self):
        inertia = 0.785 * 0.2**3 / 3.0
        spring = JointSpring("soft", "B", stiffness=1e-2, damping=1e-5)
        second = Joint("B", "first", "second")
        joints = [Joint("A", "base", "first", kind="fixed"), second]
        behind = Mechanism([link("first", 0.1, 3), link("second", 0.2)], joints, forces=[spring])
        alone = Mechanism([link("second", 0.2, 3)], [Joint("B", "base", "second")], forces=[spring])
        for mechanism in (behind, alone):
            values = eigenvalues(discretise(mechanism))
            slowest = values[np.argmin(np.abs(values))]
            found = slowest.real + 1j * abs(slowest.imag)
            np.testing.assert_allclose(found, self.expected(1e-2, 1e-5, inertia), rtol=2e-3)

    def test_a_stiff_spring_in_a_large_mechanism(self, monkeypatch):
        spring = JointSpring("stiff", "B", stiffness=1e7, damping=0.3)
        model = discretise(Mechanism([link("arm", 0.2, 3)], [Joint("B", "base", "arm")], forces=[spring]))
        largest = np.abs(eigenvalues(model)).max()
        monkeypatch.setattr(vibration, "MOST_BODIES", 0)
        np.testing.assert_allclose(np.abs(eigenvalues(model)).max(), largest, rtol=0.05)
