"""Friction in joints of the tree and in cut ones, against closed forms, an integration of its own, and values computed
for this project by two independent programs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    Coordinates,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointFriction,
    Mechanism,
    MomentRamp,
    PointForce,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    State,
    assembly_errors,
    check_step,
    derivative_residual,
    discretise,
    largest_stable_step,
    simulate,
)
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.simulation.vibrations.stability import eigenvalues
from tests.derivatives import check_derivatives
from tests.mechanisms import body, four_bar

RK4, IMPLICIT = RungeKutta4(step=2e-3), GeneralisedAlpha(step=1e-2)
in_tree_or_cut = pytest.mark.parametrize("cut", [False, True], ids=["tree", "cut"])


def one_body(link, kind, cut, *forces, slope=0.0, gravity=(0.0, 0.0, 0.0)):
    """A body on a joint "G" to the base, of the tree, or cut beside a free joint, which takes away nothing."""
    turned = {"orientation": (0.0, slope, 0.0)}
    joints = [Joint("G", "base", "body", kind=kind, cut=cut, child_position=(0.0, 0.0, 0.0), **turned)]
    if cut:
        joints.append(Joint("F", "base", "body", kind="free", **turned))
    return discretise(Mechanism([link], joints, forces=list(forces), gravity=gravity))


def with_rates(model, **rates):
    """The description's start with rates of the motions T_x and R_y."""
    rest = loads.static_state(model.topology, model.start_coordinates())
    places = {1: {"T_x": 0, "R_y": 0}, 6: {"T_x": 0, "R_y": 4}}[model.topology.n_freedoms]
    velocity = np.zeros(model.topology.n_freedoms)
    for motion, rate in rates.items():
        velocity[places[motion]] = rate
    return State(rest.position, Coordinates(jnp.asarray(velocity), rest.velocity.elastic))


class TestFlywheel:
    """Run-down from 30 rad/s by constant and viscous friction."""

    INERTIA, CONSTANT, VISCOUS, SLIDING = 0.012, 0.09, 0.002, 0.02
    ANGLE = (0.0, 13.4800134168, 24.0832237992, 32.0396476179, 37.5609102418, 40.8417164098, 42.0771254091)
    RATE = (30.0, 24.0033310972, 18.4861293668, 13.4100587304, 8.73984829303, 4.44304726503, 0.0)

    def model(self, cut):
        wheel = body("body", 1.0, inertia=(self.INERTIA,) * 3)
        friction = JointFriction(
            "bearing", "G", constant=self.CONSTANT, viscous=self.VISCOUS, sliding_rate=self.SLIDING
        )
        return one_body(wheel, "revolute", cut, friction)

    @pytest.mark.slow
    @pytest.mark.parametrize("cut, method, tolerance", [(False, RK4, 1e-8), (True, IMPLICIT, 2e-5)], ids=str)
    def test_rate_load_and_energy(self, cut, method, tolerance):
        model = self.model(cut)

        def run_down(constant, viscous):
            def numbers(m):
                return m.friction["bearing"].constant, m.friction["bearing"].viscous

            made = eqx.tree_at(numbers, model, (jnp.asarray(constant), jnp.asarray(viscous)))
            start = with_rates(made, R_y=30.0)
            return simulate(Simulation(made, drive=None, start=start, duration=4.0, method=method, save_every=0.5))

        run = run_down(self.CONSTANT, self.VISCOUS)
        assert int(run.status) == 0
        rate = np.asarray(self.RATE)
        energy = 0.5 * self.INERTIA * (900.0 - rate**2)
        given = [0, 1, 2, 3, 4, 5, 8]
        np.testing.assert_allclose(run.energy.dissipation[np.array(given)], energy, rtol=0, atol=5.4 * tolerance)
        np.testing.assert_allclose(run.friction_losses["bearing"], run.energy.dissipation, rtol=1e-12)
        moment = -self.CONSTANT * np.tanh(rate / self.SLIDING) - self.VISCOUS * rate
        np.testing.assert_allclose(run.loads["G"].moment[np.array(given), 1], moment, rtol=0, atol=tolerance)
        assert float(run.checks.energy_balance_error) < tolerance and float(run.checks.hinge_moment_error) < 1e-6
        if not cut:
            np.testing.assert_allclose(run.motion.angles["G"][np.array(given)], self.ANGLE, rtol=0, atol=10 * tolerance)
        # The numbers are inputs of the same program: linear, and exponential, in time.
        times = np.asarray(run.times)
        falling = 30.0 - self.CONSTANT / self.INERTIA * times[:8]
        found = np.asarray(run_down(self.CONSTANT, 0.0).energy.kinetic)[:8]
        np.testing.assert_allclose(np.sqrt(2.0 * found / self.INERTIA), falling, rtol=1e-6 if method is RK4 else 1e-5)
        found = np.asarray(run_down(0.0, 0.02).energy.kinetic)
        decay = 0.5 * self.INERTIA * 900.0 * np.exp(-2.0 * 0.02 / self.INERTIA * times)
        np.testing.assert_allclose(found, decay, rtol=1e-8 if method is RK4 else 2e-3, atol=1e-12)

    @in_tree_or_cut
    def test_the_step_of_explicit_methods(self, cut):
        """Its limit is that of the creep at rest."""
        decay = (self.CONSTANT / self.SLIDING + self.VISCOUS) / self.INERTIA
        model = self.model(cut)
        if not cut:
            np.testing.assert_allclose(np.abs(eigenvalues(model)).max(), decay, rtol=1e-6)
        np.testing.assert_allclose(largest_stable_step(model, RK4) * decay, 2.785, rtol=2e-3)

    def test_a_prescribed_drive_works_against_it(self):
        wheel, joint = body("body", 1.0, inertia=(self.INERTIA,) * 3), Joint("G", "base", "body")
        friction = JointFriction(
            "bearing", "G", constant=self.CONSTANT, viscous=self.VISCOUS, sliding_rate=self.SLIDING
        )
        model = discretise(Mechanism([wheel], [joint], driven_joint="G", forces=[friction], gravity=(0.0, 0.0, 0.0)))
        settings = {"duration": 0.2, "method": RK4, "save_every": 0.1, "start": with_rates(model)}
        run = simulate(Simulation(model, drive=PrescribedRate("G", 3.0), **settings))
        np.testing.assert_allclose(run.loads["G"].moment[:, 1], 0.0, atol=1e-9)
        np.testing.assert_allclose(run.motion.drive_moment, self.CONSTANT + 3.0 * self.VISCOUS, rtol=1e-9)
        assert float(run.checks.energy_balance_error) < 1e-9


class TestRotorOnSprings:
    """A rotor turns under its weight on a bearing that gives way, sunk to where the springs carry it."""

    MASS, STIFFNESS, INERTIA, COEFFICIENT, RADIUS = 2.0, 2e5, 0.012, 0.2, 0.01

    @pytest.mark.slow
    @in_tree_or_cut
    def test_run_down(self, cut):
        wheel = body("body", self.MASS, inertia=(self.INERTIA,) * 3)
        friction = JointFriction("bearing", "G", coefficient=self.COEFFICIENT, radius=self.RADIUS, sliding_rate=1e-2)
        joints = [Joint("G", "base", "body", cut=cut, child_position=(0.0, 0.0, 0.0), compliance=self.springs())]
        if cut:
            joints.append(Joint("F", "base", "body", kind="free"))
        model = discretise(Mechanism([wheel], joints, forces=[friction], gravity=(0.0, 0.0, -9.81)))
        start = loads.static_state(model.topology, model.start_coordinates())
        # Radial springs are T_x and T_z of a hinge about y, before its angle; a free joint has T_y, too.
        sunk = start.position.joints.at[2 if cut else 1].set(-self.MASS * 9.81 / self.STIFFNESS)
        rates = start.velocity.joints.at[4 if cut else 2].set(30.0)
        start = State(Coordinates(sunk, start.position.elastic), Coordinates(rates, start.velocity.elastic))
        run = simulate(Simulation(model, drive=None, start=start, duration=0.2, method=IMPLICIT, save_every=0.1))
        assert int(run.status) == 0
        moment = self.COEFFICIENT * self.RADIUS * self.MASS * 9.81
        np.testing.assert_allclose(run.loads["G"].moment[:, 1], -moment, rtol=1e-6)
        rate = 30.0 - moment / self.INERTIA * np.asarray(run.times)
        np.testing.assert_allclose(run.energy.kinetic, 0.5 * self.INERTIA * rate**2, rtol=1e-6)
        np.testing.assert_allclose(run.energy.elastic, 0.5 * (self.MASS * 9.81) ** 2 / self.STIFFNESS, rtol=1e-6)
        np.testing.assert_allclose(run.friction_losses["bearing"], 0.5 * self.INERTIA * (900.0 - rate**2), rtol=1e-4)
        assert float(run.checks.energy_balance_error) < 1e-4 and float(run.checks.hinge_moment_error) < 1e-6

    def springs(self):
        return Compliance(radial=self.STIFFNESS, radial_damping=50.0)


class TestInclinedGuide:
    """A block slides down a guide of 20 deg; its centre of mass overhangs the shoe, whose ends press by turns."""

    SLOPE, MASS, START, COEFFICIENT, LENGTH = np.radians(20.0), 0.5, 0.3, 0.15, 0.04

    @pytest.mark.long
    @in_tree_or_cut
    def test_acceleration(self, cut):
        method = GeneralisedAlpha(step=5e-3, tolerance=1e-10, corrections=12)

        @eqx.filter_jit
        def run_with_derivative(model, coefficient):
            def run_with(coefficient):
                made = eqx.tree_at(lambda m: m.friction["shoe"].load.arm, model, coefficient)
                start = with_rates(model, T_x=self.START)
                return simulate(Simulation(made, drive=None, start=start, duration=0.2, method=method, save_every=0.1))

            run, change = jax.jvp(run_with, (coefficient,), (jnp.ones_like(coefficient),))
            return run, change.motion.displacements, derivative_residual(change)

        for overhang in (0.0, 0.03):
            self.check(cut, overhang, run_with_derivative)

    def check(self, cut, overhang, run_with_derivative):
        block = body("body", self.MASS, (overhang, 0.0, 0.0))
        friction = JointFriction("shoe", "G", coefficient=self.COEFFICIENT, length=self.LENGTH, sliding_rate=1e-3)
        model = one_body(block, "prismatic", cut, friction, slope=self.SLOPE, gravity=(0.0, 0.0, -9.81))
        run, change, residual = run_with_derivative(model, jnp.asarray(self.COEFFICIENT))
        assert int(run.status) == 0 and float(residual) < 1e-7
        normal = (self.MASS + 1e-10) * 9.81 * np.cos(self.SLOPE) * max(1.0, 2.0 * overhang / self.LENGTH)
        force = self.COEFFICIENT * normal
        acceleration = 9.81 * np.sin(self.SLOPE) - force / (self.MASS + 1e-10)
        along = self.START * run.times + 0.5 * acceleration * run.times**2
        found, derivative = ((x["F"][:, 0] if cut else x["G"]) for x in (run.motion.displacements, change))
        np.testing.assert_allclose(found, along, rtol=1e-7, atol=1e-12)
        by_coefficient = -0.5 * normal / (self.MASS + 1e-10) * run.times**2
        np.testing.assert_allclose(derivative, by_coefficient, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(run.loads["G"].force[:, 0], -force, rtol=1e-7)
        np.testing.assert_allclose(run.friction_losses["shoe"], force * along, rtol=1e-6)
        assert float(run.checks.energy_balance_error) < 1e-7 and float(run.checks.momentum_balance_error) < 1e-9


class TestFromRest:
    """A carriage on a plain guide is pushed from rest at an offset, whose moment presses the ends of its shoe: at
    0.19 m it slides, at 0.21 m it binds; steps are a hundred times as long as it takes to begin to slide."""

    MASS, PUSH, COEFFICIENT, LENGTH, SLIDING, STEP = 2.0, 60.0, 0.25, 0.1, 1e-4, 2e-3

    def made(self, cut, offset, push=((60.0, 0.0, 0.0),), **more):
        described = {"coefficient": self.COEFFICIENT, "length": self.LENGTH, "sliding_rate": self.SLIDING, **more}
        jumps = {"times": [0.0, 0.05, 0.05, 1.0]} if len(push) > 1 else {}
        pushed = PointForce("push", "body", (0.0, 0.0, offset), push if jumps else push[0], **jumps)
        forces = JointFriction("shoe", "G", **described), pushed
        return one_body(body("body", self.MASS), "prismatic", cut, *forces)

    def run(self, model, step=STEP):
        """The run, and the path at the start, after 0.05 s and after 0.1 s."""
        settings = {"duration": 0.1, "method": GeneralisedAlpha(step=step), "save_every": 0.05}
        run = simulate(Simulation(model, drive=None, start=with_rates(model), **settings))
        return run, (run.motion.displacements["F"][:, 0] if model.topology.n_cuts else run.motion.displacements["G"])

    @pytest.mark.slow
    @in_tree_or_cut
    def test_it_slides(self, cut):
        run, path = self.run(self.made(cut, 0.19))
        assert int(run.status) == 0
        friction = self.COEFFICIENT * 2.0 * 0.19 / self.LENGTH * self.PUSH
        along = 0.5 * (self.PUSH - friction) / self.MASS * run.times**2
        np.testing.assert_allclose(path, along, rtol=1e-4)
        np.testing.assert_allclose(run.loads["G"].force[:, 0], [0.0, -friction, -friction], rtol=1e-6)
        np.testing.assert_allclose(run.friction_losses["shoe"], friction * along, rtol=1e-4)
        assert float(run.checks.energy_balance_error) < 1e-6 and float(run.checks.hinge_moment_error) < 1e-6

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("cut", "more"),
        [(False, {}), (True, {}), (False, {"law": "brown_mcphee", "static_coefficient": 0.251})],
        ids=["tree", "cut", "brown_mcphee"],
    )
    def test_it_binds(self, cut, more):
        """It creeps at the rate at which friction holds the push."""
        run, path = self.run(self.made(cut, 0.21, **more))
        assert int(run.status) == 0 and float(run.checks.solution_residual) < 1e-4
        most = 2.0 * 0.21 / self.LENGTH
        creep = np.arctanh(1.0 / (self.COEFFICIENT * most))
        if more:
            x = np.linspace(0.0, 1.0, 100001)
            law = self.COEFFICIENT * np.tanh(4.0 * x) + 0.001 * x / (0.25 * x**2 + 0.75) ** 2
            creep = np.interp(1.0, most * law, x)
        creep = self.SLIDING * creep
        np.testing.assert_allclose(path[2] - path[1], creep * 0.05, rtol=1e-5)
        np.testing.assert_allclose(path[1], creep * 0.05, rtol=0.0, atol=creep * self.STEP)

    @pytest.mark.slow
    def test_a_push_that_jumps(self):
        """It is held, and slides when the push becomes larger than friction."""
        weak, strong = ((20.0, 0.0, 0.0),) * 2, ((60.0, 0.0, 0.0),) * 2
        run, path = self.run(self.made(False, 0.1, (*weak, *strong), constant=15.0))
        assert int(run.status) == 0
        held = self.SLIDING * np.arctanh(20.0 / 25.0) * 0.05  # a creep
        np.testing.assert_allclose(path[1], held, rtol=0.03)
        friction = self.COEFFICIENT * 2.0 * 0.1 / self.LENGTH * self.PUSH + 15.0
        along = 0.5 * (self.PUSH - friction) / self.MASS * 0.05**2
        np.testing.assert_allclose(path[2] - path[1], along, rtol=1e-3)

    @pytest.mark.long
    def test_derivatives(self):
        """Of the path by the coefficient, sliding and bound: one batch."""
        offsets = 0.19, 0.21
        models = jax.tree.map(lambda *x: jnp.stack(x), *(self.made(False, offset) for offset in offsets))

        def paths(coefficients):
            def of_one(model, coefficient):
                return self.run(eqx.tree_at(lambda m: m.friction["shoe"].load.arm, model, coefficient))[1]

            slides, binds = jax.vmap(of_one)(models, coefficients)
            return jnp.stack([slides[2] - slides[0], binds[2] - binds[1]])

        found = check_derivatives(paths, [self.COEFFICIENT] * 2, 1e-6, reverse=1e-9, differences=1e-5)
        sliding, bound = np.diag(found.forward)
        most = [2.0 * offset / self.LENGTH for offset in offsets]
        np.testing.assert_allclose(sliding, -0.5 * most[0] * self.PUSH / self.MASS * 0.1**2, rtol=1e-4)
        share = 1.0 / (most[1] * self.COEFFICIENT)
        by_share = self.SLIDING * 0.05 / (1.0 - share**2)
        np.testing.assert_allclose(bound, -by_share * share / self.COEFFICIENT, rtol=1e-5)


class TestPendulum:
    """A pendulum whose bearing's friction depends on its load, against an integration of its own."""

    MASS, LENGTH, INERTIA, START, DURATION = 0.4, 0.15, 0.002, 1.2, 0.6
    NUMBERS = (0.3 * 0.02, 0.5, 4e-4, 0.01)  # coefficient times radius, sliding rate, viscous, constant

    def reference(self, numbers, steps=1500):
        """Angle, kinetic energy and lost energy at the end, by Runge-Kutta 4."""
        arm, sliding, viscous, constant = numbers
        inertia, g = self.INERTIA + self.MASS * self.LENGTH**2, 9.81

        def derivative(y):
            angle, rate = y
            # Force of the bearing along the rod; the one across it depends on the acceleration, and so on friction.
            radial = self.MASS * (self.LENGTH * rate**2 + g * np.sin(angle))
            acceleration = 0.0
            for _ in range(12):
                normal = np.hypot(radial, self.MASS * (self.LENGTH * acceleration - g * np.cos(angle)))
                friction = -(constant + arm * normal) * np.tanh(rate / sliding) - viscous * rate
                acceleration = (self.MASS * g * self.LENGTH * np.cos(angle) + friction) / inertia
            return np.array([rate, acceleration])

        h, y = self.DURATION / steps, np.array([self.START, -6.0])
        for _ in range(steps):
            a = derivative(y)
            b = derivative(y + h / 2 * a)
            c = derivative(y + h / 2 * b)
            y = y + h / 6 * (a + 2 * b + 2 * c + derivative(y + h * c))
        kinetic, weight = 0.5 * inertia * y[1] ** 2, self.MASS * g * self.LENGTH
        start = 0.5 * inertia * 36.0 - weight * np.sin(self.START)
        return np.array([y[0], kinetic, start - (kinetic - weight * np.sin(y[0]))])

    def made(self):
        """(numbers, steps) -> (angle, rate, lost energy at the end), and the run."""
        rod = body("body", self.MASS, (self.LENGTH, 0.0, 0.0), (self.INERTIA,) * 3)
        friction = JointFriction(
            "pin", "G", coefficient=0.3, radius=0.02, sliding_rate=0.5, viscous=4e-4, constant=0.01
        )
        model = discretise(Mechanism([rod], [Joint("G", "base", "body", angle=self.START)], forces=[friction]))

        def run(numbers):
            def of(m):
                pin = m.friction["pin"]
                return pin.load.arm, pin.sliding_rate, pin.viscous, pin.constant

            made = eqx.tree_at(of, model, tuple(numbers))
            start = with_rates(made, R_y=-6.0)
            method = GeneralisedAlpha(step=1e-3, tolerance=1e-12, corrections=12)
            settings = {"duration": self.DURATION, "method": method, "save_every": self.DURATION / 4}
            run = simulate(Simulation(made, drive=None, start=start, **settings))
            ends = run.motion.angles["G"][-1], run.energy.kinetic[-1], run.friction_losses["pin"][-1]
            return jnp.stack(ends), run

        return run

    @pytest.mark.long
    def test_motion_energy_and_derivatives(self):
        end, at = self.made(), jnp.asarray(self.NUMBERS)
        along = at * jnp.array([1.0, -0.5, 0.7, 0.3])

        @jax.jit
        def with_derivative(numbers):
            (values, run), (change, of_run) = jax.jvp(end, (numbers,), (along,))
            return values, change, run.status, run.checks.momentum_balance_error, derivative_residual(of_run)

        values, change, status, balance, residual = with_derivative(at)
        assert int(status) == 0 and float(values[2]) > 0.05
        np.testing.assert_allclose(values, self.reference(self.NUMBERS), rtol=0, atol=3e-5)
        assert float(balance) < 1e-9
        assert float(residual) < 1e-7
        weights = jnp.array([1.0, 20.0, -30.0])
        gradient = jax.jit(jax.grad(lambda numbers: weights @ end(numbers)[0]))(at)
        np.testing.assert_allclose(gradient @ along, weights @ change, rtol=1e-8)
        ahead, behind = (with_derivative(at + d)[0] for d in (1e-4 * along, -1e-4 * along))
        np.testing.assert_allclose(change, (ahead - behind) / 2e-4, rtol=1e-6)
        ahead, behind = (self.reference(np.asarray(at + d)) for d in (1e-3 * along, -1e-3 * along))
        np.testing.assert_allclose(change, (ahead - behind) / 2e-3, rtol=2e-3)


class TestRigidFourBar:
    """A four-bar of rigid links runs down by friction in all its hinges, one of them cut; loads at 0.1 s."""

    VISCOUS = (0.001, 0.0005, 0.0005, 0.002)

    def model(self, by_hinge):
        links = [
            body("crank", 0.3, (0.03, 0, 0.002), (5e-5, 3e-4, 2.8e-4), 0.08),
            body("coupler", 0.4, (0.11, 0, -0.004), (9e-5, 2.2e-3, 2.15e-3), 0.25),
            body("rocker", 0.35, (0.09, 0, 0.003), (8e-5, 1.3e-3, 1.25e-3), 0.2),
        ]
        joints = [
            Joint("A", "base", "crank", angle="-50 deg"),
            Joint("B", "crank", "coupler", angle=0.9),
            Joint("D", "base", "rocker", position=(0.26, 0, 0), angle=-1.57375351781),
            Joint("C", "coupler", "rocker", cut=True),
        ]
        forces = [JointFriction(f"at_{joint}", joint, viscous=viscous, sliding_rate=0.1, **more)
                  for joint, viscous, more in zip("ABCD", self.VISCOUS, by_hinge, strict=True)]  # fmt: skip
        mechanism = Mechanism(links, joints, redundant_reactions="minimum_norm", driven_joint="A", forces=forces)
        model = discretise(mechanism)
        start = loads.static_state(model.topology, model.start_coordinates())
        names = [model.topology.joints.index(name) for name in "ADB"]
        velocity = np.zeros(3)
        (a, d, b), angle = names, np.asarray(start.position.joints)
        velocity[[a, d, b]] = 18.0, *self.rates(angle[a], angle[a] + angle[b], angle[d])
        return model, State(start.position, Coordinates(jnp.asarray(velocity), start.velocity.elastic))

    @staticmethod
    def rates(crank, coupler, rocker):
        """Rates of the rocker, and of the coupler relative to the crank, at 18 rad/s of the crank."""
        across = [length * np.array([-np.sin(angle), -np.cos(angle)])
                  for length, angle in ((0.08, crank), (0.25, coupler), (0.2, rocker))]  # fmt: skip
        of_coupler, of_rocker = np.linalg.solve(np.stack([across[1], -across[2]], axis=1), -18.0 * across[0])
        return of_rocker, of_coupler - 18.0

    CONSTANT = tuple({"constant": moment} for moment in (0.02, 0.015, 0.01, 0.025))
    BY_LOAD = tuple({"coefficient": 0.2, "radius": radius} for radius in (0.01, 0.008, 0.008, 0.012))
    CASES = (
        (CONSTANT, RungeKutta4(step=2e-4), 0.880259905526,
         (-0.0383052124112, 0.0245472510902, 0.0135144454577, 0.0406363613692),
         ((-6.07870589179, 9.501162168), (-2.8262689845, 5.47319642097), (1.37677666529, 0.35334165761),
          (0.639359094959, 2.14037586253))),
        (BY_LOAD, GeneralisedAlpha(step=1e-4), 0.829052708512,
         (-0.038216677004, 0.0181900330853, 0.00542771470714, 0.0205514629332),
         ((-5.87417850309, 8.48074856104), (-2.82055430467, 4.69697563853), (1.31838638036, 0.28056722108),
          (0.431645617853, 2.01209565947))),
    )  # fmt: skip

    @pytest.mark.slow
    @pytest.mark.parametrize("by_hinge, method, angle, moments, forces", CASES, ids=["constant", "by_load"])
    def test_against_given_values(self, by_hinge, method, angle, moments, forces):
        model, start = self.model(by_hinge)
        run = simulate(Simulation(model, drive=None, start=start, duration=0.1, method=method, save_every=0.05))
        assert int(run.status) == 0
        np.testing.assert_allclose(run.motion.angles["A"][-1], angle, rtol=1e-6)
        found = [run.loads[joint].moment[-1, 1] for joint in "ABCD"]
        np.testing.assert_allclose(found, moments, rtol=0, atol=1e-6 * max(np.abs(moments)))
        found = [np.linalg.norm(run.loads[joint].force[-1]) for joint in "ABCD"]
        np.testing.assert_allclose(found, [np.hypot(*force) for force in forces], rtol=0, atol=1e-6 * 11.3)
        assert float(run.checks.momentum_balance_error) < 1e-9 and float(run.checks.hinge_moment_error) < 1e-6
        assert float(run.checks.energy_balance_error) < 1e-6
        total = sum(run.friction_losses.values())
        np.testing.assert_allclose(total, run.energy.dissipation, rtol=1e-12)

    def test_a_load_that_is_not_unique_is_refused(self):
        by_length = ({"constant": 1.0}, {"constant": 1.0}, {**self.BY_LOAD[2], "length": 0.02}, {"constant": 1.0})
        with pytest.raises(InputError, match="`coefficient` of force `at_C` .* redundant.*`length`"):
            self.model(by_length)

    def test_explicit_methods_are_refused(self):
        model, start = self.model(self.BY_LOAD)
        with pytest.raises(InputError, match="`method` must be .generalised_alpha. .*`at_A`.* 'rk4'"):
            simulate(Simulation(model, drive=None, start=start, duration=0.1, method=RungeKutta4(step=1e-4)))
        with pytest.raises(InputError, match="generalised_alpha"):
            check_step(model, RungeKutta4(step=1e-4))


@pytest.mark.long
def test_flexible_four_bar_with_errors():
    """Hinges under the loads of a misaligned seat; exact elements, preload without friction."""
    radii = zip("ABCD", (0.008, 0.006, 0.006, 0.008), strict=True)
    forces = [JointFriction(f"at_{joint}", joint, coefficient=0.15, radius=r, sliding_rate=0.5) for joint, r in radii]
    model = discretise(four_bar(rfes=5, forces=forces), elements="geometrically_exact")
    errors = assembly_errors(model, {"D.delta_x": "0.5 deg", "D.delta_z": "0.5 deg", "D.d_y": "0.5 mm"})
    method = GeneralisedAlpha(step=5e-4)
    run = simulate(
        Simulation(model, drive=MomentRamp("A", 1.5, 0.1), duration=0.1, method=method, save_every=0.1), errors
    )
    assert int(run.status) == 0
    np.testing.assert_allclose(
        run.loads["A"].force[0], [2.24231096587, 37.6212367122, 0.0770126865668], rtol=0, atol=4e-6
    )
    np.testing.assert_allclose(run.loads["A"].moment[0, 1], 0.0, atol=1e-12)
    moments = [run.loads[joint].moment[-1, 1] for joint in "ABCD"]
    expected = -0.0548543646635, 0.0355678261544, -0.0150611418622, -0.018506884172
    np.testing.assert_allclose(moments, expected, rtol=0, atol=2e-3 * 0.055)
    np.testing.assert_allclose(run.motion.angle[-1], -0.894442235188, rtol=1e-4)
    assert float(run.checks.energy_balance_error) < 1e-3
