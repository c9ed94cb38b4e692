"""Drives on rotations and translations, several at once: against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Automatic,
    ForceFunction,
    ForceRamp,
    ForceTable,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointSpring,
    Leapfrog,
    Mechanism,
    MomentFunction,
    PrescribedFunction,
    PrescribedRate,
    PrescribedSpeed,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    check_step,
    choose_method,
    discretise,
    simulate,
)
from rfem_jax.simulation.system.driving import require_driven
from rfem_jax.simulation.vibrations.stability import eigenvalues
from tests.derivatives import check_derivatives
from tests.mechanisms import body, link

EXPLICIT, IMPLICIT = RungeKutta4(step=1e-4), GeneralisedAlpha(step=1e-4, tolerance=1e-10)


class TestForceOnASlide:
    """Newton's second law for a block on a guide under a force that grows and ends."""

    MASS, FORCE, RISE, START = 0.5 + 1e-10, 6.0, 0.05, 0.2

    def model(self):
        joint = Joint("G", "base", "block", kind="prismatic", displacement=self.START)
        return discretise(Mechanism([body("block", 0.5)], [joint], driven_joint="G"))

    @pytest.mark.parametrize(
        ("method", "accuracy"), [(Leapfrog(step=1e-5), 1e-8), (IMPLICIT, 1e-6)], ids=["leapfrog", "implicit"]
    )
    def test_motion_load_and_work(self, method, accuracy):
        drive = ForceRamp("G", "6 N", "50 ms")
        run = simulate(Simulation(self.model(), drive=drive, duration=0.1, method=method, save_every=0.01))
        assert int(run.status) == 0
        t = np.asarray(run.times)
        rising, speed = np.minimum(t, self.RISE), 0.5 * self.FORCE * self.RISE / self.MASS
        x = self.START + self.FORCE * rising**3 / (6.0 * self.MASS * self.RISE) + speed * (t - rising)
        v = 0.5 * self.FORCE * rising**2 / (self.RISE * self.MASS)
        np.testing.assert_allclose(run.motion.displacements["G"], x, rtol=0, atol=accuracy)
        history = run.motion.drives["G"]
        np.testing.assert_array_equal(history.position, run.motion.displacements["G"])
        np.testing.assert_allclose(history.rate, v, rtol=0, atol=10.0 * accuracy)
        np.testing.assert_allclose(history.force[:5], self.FORCE * t[:5] / self.RISE, rtol=1e-12)
        assert float(history.force[-1]) == 0.0
        # A given force acts from outside: no load along the guide.
        np.testing.assert_allclose(run.loads["G"].force[:, 0], 0.0, atol=1e-9)
        np.testing.assert_allclose(run.energy.work, 0.5 * self.MASS * v**2, rtol=0, atol=10.0 * accuracy)
        assert float(run.checks.energy_balance_error) < 1e-5 and float(run.checks.momentum_balance_error) < 1e-9
        assert float(run.checks.hinge_moment_error) < 1e-9

    def test_assembly_holds_the_slide(self):
        """On a guide that slopes down by 0.3 rad, the holding force is part of the preload."""
        joint = Joint("G", "base", "block", kind="prismatic", displacement=0.2, orientation=(0.0, 0.3, 0.0))
        model = discretise(Mechanism([body("block", 0.5)], [joint], driven_joint="G"))
        assembled = assemble(model, assembly_errors(model))
        np.testing.assert_allclose(assembled.state.position.joints, [0.2], rtol=1e-14)
        np.testing.assert_allclose(assembled.preload["G"].force[0], -0.5 * 9.81 * np.sin(0.3), rtol=1e-8)


CRANK, ROD, RATE = 0.06, 0.2, 60.0


def slider_crank(driven, angle):
    """Crank, rod and piston; spherical crank pin and cylindrical wrist pin leave no redundant rows."""
    links = [
        body("crank", 0.4, (0.02, 0, 0.003), (1.5e-4, 3e-4, 2.5e-4), length=CRANK),
        body("piston", 0.5, (0.012, 0, 0.006), (3e-4, 4e-4, 3.5e-4)),
        body("rod", 0.35, (0.07, 0, 0.004), (1e-4, 1.6e-3, 1.55e-3), length=ROD),
    ]
    joints = [
        Joint("A", "base", "crank", angle=angle),
        Joint("G", "base", "piston", kind="prismatic", position=(0, 0, 0.01), displacement=float(slide(angle))),
        Joint("C", "piston", "rod", kind="cylindrical", position=(0, 0, 0), child_position=(ROD, 0, 0), angle=0.2),
        Joint("B", "crank", "rod", kind="spherical", cut=True, child_position=(0, 0, 0)),
    ]
    return discretise(Mechanism(links, joints, driven_joint=driven))


def slide(angle):
    """Displacement of the piston at a crank angle."""
    height = 0.01 + CRANK * jnp.sin(angle)
    return CRANK * jnp.cos(angle) + jnp.sqrt(ROD**2 - height**2)


SETTINGS = {"duration": 8e-3, "method": RungeKutta4(step=5e-5), "save_every": 1e-3}


@pytest.fixture(scope="module")
def by_crank():
    """The slider-crank with a crank that turns at a constant rate, which has its test among the kinds of joints."""
    return simulate(Simulation(slider_crank("A", -0.9), drive=PrescribedRate("A", RATE), **SETTINGS))


class TestSliderCrank:
    """One mechanism driven at its crank, at its slider, and at both."""

    START = -0.9

    def speed(self, times):
        return np.asarray(jax.vmap(jax.grad(slide))(self.START + RATE * jnp.asarray(times))) * RATE

    @pytest.mark.long
    def test_the_slider_drives_the_crank(self, by_crank):
        """The slider moves as the crank at a constant rate makes it move, from its start rate on."""
        model = slider_crank("G", self.START)
        drive = PrescribedFunction("G", lambda t: slide(self.START + RATE * t) - slide(self.START))
        run = simulate(Simulation(model, drive=drive, **SETTINGS))
        assert int(run.status) == 0
        np.testing.assert_allclose(run.motion.angles["A"], self.START + RATE * np.asarray(run.times), rtol=0, atol=1e-8)
        # Both drives do the same work: F x' = M omega.
        force = np.asarray(by_crank.motion.drive_moment) * RATE / self.speed(run.times)
        np.testing.assert_allclose(run.motion.drives["G"].force, force, rtol=1e-6, atol=1e-6 * np.abs(force).max())
        # What enforces a motion is inside the joint's load.
        np.testing.assert_allclose(run.loads["G"].force[:, 0], run.motion.drives["G"].force, rtol=1e-12)
        np.testing.assert_allclose(run.loads["A"].moment[:, 1], 0.0, atol=1e-8)
        np.testing.assert_allclose(run.energy.work, by_crank.energy.work, rtol=0, atol=1e-6)
        assert float(run.checks.energy_balance_error) < 1e-7 and float(run.checks.momentum_balance_error) < 1e-10

    @pytest.mark.slow
    def test_a_force_on_the_slider_of_a_driven_crank(self, by_crank):
        """Prescribed motion and given force in one loop, the force with a jump: virtual power of the force."""
        model = slider_crank(["A", "G"], self.START)
        topology = model.topology
        # The slide follows from the crank, so that assembly holds the crank alone.
        assert topology.drive_labels == ("A", "G") and (topology.held, topology.dependent) == ((0,), (1,))
        drives = [ForceTable("G", [0, 3e-3, 3e-3, 1.0], [-50.0, 100.0, 20.0, 20.0]), PrescribedRate("A", RATE)]
        run = simulate(Simulation(model, drive=drives, **SETTINGS))
        assert int(run.status) == 0
        times = np.asarray(run.times)
        force = np.where(times <= 3e-3 + 1e-9, -50.0 + 150.0 * times / 3e-3, 20.0)
        np.testing.assert_allclose(run.motion.drives["G"].force, force, rtol=0, atol=1e-9)
        change = np.asarray(run.motion.drives["A"].force) - np.asarray(by_crank.motion.drive_moment)
        np.testing.assert_allclose(change, -force * self.speed(times) / RATE, rtol=0, atol=1e-6)
        np.testing.assert_allclose(run.loads["G"].force[:, 0], 0.0, atol=1e-7)
        assert float(run.checks.energy_balance_error) < 1e-6 and float(run.checks.momentum_balance_error) < 1e-10

    def test_dependent_motions_are_not_both_prescribed(self):
        model = slider_crank(["A", "G"], self.START)
        with pytest.raises(InputError, match="follows from those of other driven joints; prescribe one less"):
            require_driven(model, [PrescribedRate("A", RATE), PrescribedSpeed("G", 0.1)])
        with pytest.raises(InputError, match="prescribed motions first"):
            require_driven(flexible_slider_crank(["A", "G"]), [MOMENT, PrescribedSpeed("G", 0.1)])
        require_driven(flexible_slider_crank(["G", "A"]), [MOMENT, PrescribedSpeed("G", 0.1)])


MOMENT = MomentFunction("A", lambda t, phase: 0.0 * t)


def flexible_slider_crank(driven):
    links = [link("crank", CRANK), link("piston", 0.05), link("rod", ROD, 2)]
    joints = [
        Joint("A", "base", "crank", angle=-0.9),
        Joint("G", "base", "piston", kind="prismatic", displacement=float(slide(-0.9))),
        Joint("C", "piston", "rod", position=(0, 0, 0), child_position=(0, 0, 0), angle=np.pi),
        Joint("B", "crank", "rod", cut=True),
    ]
    return discretise(Mechanism(links, joints, driven_joint=driven))


class Arm:
    """A turning and sliding arm: revolute about y, then prismatic along x, under gravity."""

    FIRST, SECOND = (0.7, 0.08, 2e-3), (0.4, 0.05, 1e-3)  # masses, distances of their centres, moments of inertia
    ANGLE, REACH = -0.7, 0.15

    @classmethod
    @functools.cache
    def model(cls):
        (m1, c1, j1), (m2, c2, j2) = cls.FIRST, cls.SECOND
        links = [
            body("arm", m1, (c1, 0, 0), (j1, j1, j1)),
            body("hand", m2, (c2, 0, 0), (j2, j2, j2)),
        ]
        joints = [
            Joint("R", "base", "arm", angle=cls.ANGLE),
            Joint("P", "arm", "hand", kind="prismatic", position=(0, 0, 0), displacement=cls.REACH),
        ]
        return discretise(Mechanism(links, joints, driven_joint=["R", "P"]))

    @classmethod
    def angle(cls, t):
        return cls.ANGLE + 2.0 * t + 0.5 * (1.0 - jnp.cos(8.0 * t))

    @classmethod
    def reach(cls, t):
        return cls.REACH + 0.04 * (1.0 - jnp.cos(11.0 * t))

    @classmethod
    def forces(cls, t):
        """Moment and force of inverse dynamics, from Lagrange's equations."""
        (m1, c1, j1), (m2, c2, j2) = cls.FIRST, cls.SECOND
        turn, turn_rate, turning = (derivative(cls.angle, n)(t) for n in range(3))
        reach, speed, sliding = (derivative(cls.reach, n)(t) for n in range(3))
        arm, g = reach + c2, 9.81
        inertia = j1 + m1 * c1**2 + j2 + m2 * arm**2
        moment = inertia * turning + 2.0 * m2 * arm * speed * turn_rate - (m1 * c1 + m2 * arm) * g * jnp.cos(turn)
        return moment, m2 * (sliding - arm * turn_rate**2 - g * jnp.sin(turn))


def derivative(function, order):
    for _ in range(order):
        function = jax.grad(function)
    return function


ROTATION = PrescribedFunction("R", lambda t: Arm.angle(t) - Arm.ANGLE)
SLIDE = PrescribedFunction("P", lambda t: Arm.reach(t) - Arm.REACH)
PUSH = ForceFunction("P", lambda t, phase: Arm.forces(t)[1])


class TestArm:
    """Two drives at once on an open chain: its inverse dynamics in closed form."""

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("drives", "method"), [([SLIDE, ROTATION], EXPLICIT), ([ROTATION, PUSH], IMPLICIT)], ids=["prescribed", "mixed"]
    )
    def test_motion_and_forces(self, drives, method):
        run = simulate(Simulation(Arm.model(), drive=drives, duration=0.1, method=method, save_every=0.02))
        assert int(run.status) == 0
        times = jnp.asarray(run.times)
        accuracy = 1e-9 if method is EXPLICIT else 1e-5
        np.testing.assert_allclose(run.motion.angles["R"], jax.vmap(Arm.angle)(times), rtol=0, atol=accuracy)
        np.testing.assert_allclose(run.motion.displacements["P"], jax.vmap(Arm.reach)(times), rtol=0, atol=accuracy)
        moments, forces = jax.vmap(Arm.forces)(times)
        accuracy = 1e-7 if method is EXPLICIT else 1e-3
        np.testing.assert_allclose(run.motion.drives["R"].force, moments, rtol=0, atol=accuracy)
        np.testing.assert_allclose(run.motion.drives["P"].force, forces, rtol=0, atol=accuracy)
        inside = forces if drives[0] is SLIDE else 0.0 * forces
        np.testing.assert_allclose(run.loads["P"].force[:, 0], inside, rtol=0, atol=accuracy)
        assert float(run.checks.energy_balance_error) < (1e-7 if method is EXPLICIT else 1e-4)
        assert float(run.checks.momentum_balance_error) < 1e-9

    @pytest.mark.long
    def test_derivatives_by_numbers_of_both_drives(self):
        """The rate of one drive and the force of the other, whose rise ends within the run."""

        def end(values):
            drives = [PrescribedRate("R", values[0], 0.01), ForceRamp("P", values[1], 0.016)]
            run = simulate(
                Simulation(Arm.model(), drive=drives, duration=0.02, save_every=5e-3, method=RungeKutta4(step=1e-3))
            )
            return jnp.stack(
                [run.motion.displacements["P"][-1], run.metrics.mean_square_moment["R"], run.energy.work[-1]]
            )

        at = jnp.asarray([3.0, 20.0])
        check_derivatives(end, at, 1e-4 * at, reverse=1e-8, differences=1e-6)

    @pytest.mark.long
    def test_auto_and_the_largest_step(self):
        drives = [ROTATION, PUSH]
        assert check_step(Arm.model(), EXPLICIT, drives) > EXPLICIT.step
        assert choose_method(Arm.model(), Automatic(accuracy=0.05), drives, 0.02).step <= 0.02


class TestVibration:
    """Prescribed slides are held in the modes of vibration."""

    def test_of_two_blocks_and_a_spring(self):
        joints = [
            Joint("G", "base", "one", kind="prismatic"),
            Joint("H", "one", "two", kind="prismatic", position=(0, 0, 0), displacement=0.1),
        ]
        spring = JointSpring("coil", "H", stiffness=200.0, rest=0.1)
        links = [body("one", 0.5), body("two", 0.3)]
        model = discretise(Mechanism(links, joints, driven_joint="G", forces=[spring]))
        held = eigenvalues(model, PrescribedSpeed("G", "0.1 m/s"))
        np.testing.assert_allclose(np.abs(held).max(), np.sqrt(200.0 / 0.3), rtol=1e-6)
        free = eigenvalues(model, ForceRamp("G", 1.0, 1.0))
        np.testing.assert_allclose(np.abs(free).max(), np.sqrt(200.0 * 0.8 / 0.15), rtol=1e-6)

    def test_a_held_slide_is_a_clamp(self):
        def beam(kind):
            driven = "G" if kind == "prismatic" else None
            return discretise(
                Mechanism([link("beam", 0.3, 3)], [Joint("G", "base", "beam", kind=kind)], driven_joint=driven)
            )

        held, clamped = eigenvalues(beam("prismatic"), PrescribedSpeed("G", 0.1)), eigenvalues(beam("fixed"))
        np.testing.assert_allclose(np.sort(np.abs(held)), np.sort(np.abs(clamped)), rtol=1e-6)
