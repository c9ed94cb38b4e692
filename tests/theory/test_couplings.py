"""Couplings of two joint coordinates, theory (16.1) to (16.6), against closed forms."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Coupling,
    GeneralisedAlpha,
    Joint,
    Leapfrog,
    Mechanism,
    MomentTable,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    design,
    discretise,
    kinetostatic_turn,
    largest_stable_step,
    natural_frequencies,
    simulate,
)
from rfem_jax.simulation.vibrations.stability import eigenvalues
from rfem_jax.validation.geared_mechanisms import CRANK, ROD, TURN, rod_angles
from tests.coupled_mechanisms import (
    FOLLOWER,
    LIFT,
    NO_GRAVITY,
    ONE,
    PRELOAD,
    RATE,
    RATIO,
    SPRING,
    TWO,
    cam,
    gear_pair,
    geared_five_bar,
    rotor,
)
from tests.derivatives import check_derivatives
from tests.mechanisms import body

STIFFNESS, MOMENT = 1e4, 3.0


def driven_pair(method, duration=0.02, **mesh):
    drive = MomentTable("A", times=[0.0, 1.0], moments=[MOMENT, MOMENT])
    model = discretise(gear_pair(**({"stiffness": STIFFNESS} | mesh)))
    return simulate(Simulation(model, drive=drive, duration=duration, method=method, save_every=duration / 10))


SQUARE = STIFFNESS * (1.0 / TWO + RATIO**2 / ONE)  # of the angular frequency of the two rotors against each other


class TestGearPair:
    """Two rotors on a mesh: a constant moment on the first accelerates both, and rings the mesh."""

    @pytest.mark.parametrize(
        "method, within", [(RungeKutta4(step=2e-5), 1e-9), (GeneralisedAlpha(step=2e-5), 1e-5)], ids=["rk4", "implicit"]
    )
    def test_motion_mesh_moment_and_balances(self, method, within):
        run = driven_pair(method)
        assert int(run.status) == 0
        t = np.asarray(run.times)
        g = -RATIO * MOMENT / (ONE * SQUARE) * (1.0 - np.cos(np.sqrt(SQUARE) * t))
        mean = 0.5 * MOMENT * t**2 / (ONE + RATIO**2 * TWO)  # of the equivalent inertia at A
        a, b = mean - RATIO * TWO * g / (ONE + RATIO**2 * TWO), RATIO * mean + ONE * g / (ONE + RATIO**2 * TWO)
        np.testing.assert_allclose(run.motion.angles["A"], a, rtol=0, atol=within * a.max())
        np.testing.assert_allclose(run.motion.angles["B"], b, rtol=0, atol=within * a.max())
        history, size = run.couplings["mesh"], STIFFNESS * np.abs(g).max()
        np.testing.assert_allclose(history.deflection, g, rtol=0, atol=within * np.abs(g).max() * 100)
        np.testing.assert_allclose(history.loads[:, 1], -STIFFNESS * g, rtol=0, atol=100 * within * size)
        np.testing.assert_allclose(history.loads[:, 0], RATIO * STIFFNESS * g, rtol=0, atol=100 * within * size)
        np.testing.assert_allclose(
            run.energy.elastic, 0.5 * STIFFNESS * g**2, rtol=0, atol=1e-4 * STIFFNESS * max(g**2)
        )
        # The hinges carry nothing about their axes: the mesh acts beside them.
        np.testing.assert_allclose(np.asarray(run.loads["B"].moment), 0.0, atol=1e-9)
        assert float(run.checks.energy_balance_error) < 1e-4
        assert float(run.checks.momentum_balance_error) < 1e-6

    def test_a_damped_mesh_settles_to_the_ratio_of_the_accelerations(self):
        run = driven_pair(GeneralisedAlpha(step=5e-4), duration=0.2, damping=8.0)
        assert int(run.status) == 0
        acceleration = MOMENT / (ONE + RATIO**2 * TWO)
        np.testing.assert_allclose(run.couplings["mesh"].loads[-1, 1], TWO * RATIO * acceleration, rtol=1e-4)
        rate = np.gradient(np.asarray(run.motion.angles["B"]), np.asarray(run.times))[-2]
        np.testing.assert_allclose(rate, RATIO * acceleration * np.asarray(run.times)[-2], rtol=1e-3)
        assert float(run.energy.dissipation[-1]) > 0.0
        assert float(run.checks.energy_balance_error) < 1e-2

    def test_eigenvalues_and_step(self):
        damping = 4.0
        model = discretise(gear_pair(driven=None, stiffness=STIFFNESS, damping=damping))
        decay = 0.5 * damping * SQUARE / STIFFNESS
        expected = -decay + 1j * np.sqrt(SQUARE - decay**2)
        found = eigenvalues(model)
        np.testing.assert_allclose(found[np.argmax(found.imag)], expected, rtol=1e-6)
        undamped = discretise(gear_pair(driven=None, stiffness=STIFFNESS))
        np.testing.assert_allclose(largest_stable_step(undamped, Leapfrog(step=1e-6)), 2.0 / np.sqrt(SQUARE), rtol=5e-3)

    def test_natural_frequencies(self):
        """With the first rotor locked, and with both free to turn against each other."""
        model = discretise(gear_pair(stiffness=STIFFNESS))
        locked = natural_frequencies(model, count=1).frequency
        np.testing.assert_allclose(locked, [np.sqrt(STIFFNESS / TWO) / (2.0 * np.pi)], rtol=1e-6)
        loose = natural_frequencies(model, locked=False, count=2).frequency
        np.testing.assert_allclose(np.max(loose), np.sqrt(SQUARE) / (2.0 * np.pi), rtol=1e-6)

    def test_a_stiff_mesh_in_long_steps(self):
        """A period is a fifth of a step: without its tangent across both joints Newton's method would fail."""
        drive = MomentTable("A", times=[0.0, 0.05], moments=[0.0, MOMENT])
        model, method = discretise(gear_pair(stiffness=1e9)), GeneralisedAlpha(step=1e-3)
        run = simulate(Simulation(model, drive=drive, duration=0.05, method=method, save_every=0.01))
        assert int(run.status) == 0
        angle = MOMENT * 0.05**2 / 6.0 / (ONE + RATIO**2 * TWO)
        np.testing.assert_allclose(run.motion.angles["A"][-1], angle, rtol=1e-3)
        np.testing.assert_allclose(run.motion.angles["B"][-1], RATIO * angle, rtol=1e-3)

    @pytest.mark.long
    @pytest.mark.parametrize("method", [RungeKutta4(step=2e-4), GeneralisedAlpha(step=2e-4)], ids=["rk4", "implicit"])
    def test_derivatives(self, method):
        drive = MomentTable("A", times=[0.0, 1.0], moments=[MOMENT, MOMENT])
        model = discretise(gear_pair(stiffness=STIFFNESS, damping=2.0, eccentricity=1e-4, eccentricity_phase=0.3))
        simulation = Simulation(model, drive=drive, duration=0.01, method=method, save_every=0.005)
        names = ("ratio", "stiffness", "damping", "pitch_error", "eccentricity")

        def end(values):
            made = design(model, {f"mesh.{name}": value for name, value in zip(names, values, strict=True)})
            run = simulate(dataclasses.replace(simulation, design=made))
            return jnp.stack([run.motion.angles["B"][-1], run.couplings["mesh"].loads[-1, 0]])

        at = jnp.asarray([RATIO, STIFFNESS, 2.0, 1e-4, 1e-4])
        check_derivatives(end, at, 1e-4 * at, reverse=1e-7, differences=1e-4)


class TestFlanks:
    """Flanks that only push, with a play between them."""

    def test_a_rotor_hands_its_rate_over_through_the_backlash(self):
        """Two equal rotors: an elastic impact exchanges the rates, after the play and half a period of the mesh."""
        rate, play, stiffness = 2.0, 0.02, 1e3
        pair = gear_pair(driven=None, rates=(rate, 0.0), ratio=1.0, backlash=play, stiffness=stiffness)
        pair = dataclasses.replace(pair, links=[rotor("one", ONE), rotor("two", ONE)])
        ways = Simulation(discretise(pair), drive=None, duration=0.024, method=RungeKutta4(step=1e-5), save_every=1e-3)
        run = simulate(ways)
        assert int(run.status) == 0
        touch, period = 0.5 * play / rate, np.pi / np.sqrt(2.0 * stiffness / ONE)
        t, load = np.asarray(run.times), np.asarray(run.couplings["mesh"].loads[:, 1])
        inside = (t > touch) & (t < touch + period)
        expected = rate * np.sqrt(0.5 * stiffness * ONE) * np.sin(np.pi * (t - touch) / period)
        np.testing.assert_allclose(load, np.where(inside, expected, 0.0), rtol=0, atol=1e-4 * expected.max())
        assert inside.sum() > 5
        after = t > touch + period
        b = np.asarray(run.motion.angles["B"])[after]
        np.testing.assert_allclose(np.diff(b) / np.diff(t[after]), rate, rtol=1e-6)
        assert float(run.checks.energy_balance_error) < 1e-6

    def test_damped_flanks_balance_their_energy(self):
        pair = gear_pair(driven=None, rates=(2.0, 0.0), backlash=0.01, contact_damping=0.3, stiffness=2e4, exponent=1.5)
        simulation = Simulation(
            discretise(pair), drive=None, duration=0.05, method=GeneralisedAlpha(step=1e-4), save_every=0.01
        )
        run = simulate(simulation)
        assert int(run.status) == 0
        assert float(run.energy.dissipation[-1]) > 1e-3
        assert float(run.checks.energy_balance_error) < 1e-3


class TestCam:
    """One degree of freedom: the contact force is that of the follower's mass and spring on the lift."""

    def test_contact_force_and_moment_of_the_cam(self):
        # The damping of small vibrations is chi times the force, here about that of creeping.
        model = discretise(cam(stiffness=2e6, one_sided=True, contact_damping=20.0))
        run = simulate(
            Simulation(
                model, drive=PrescribedRate("A", RATE), duration=0.3, method=GeneralisedAlpha(step=1e-4),
                save_every=0.01,
            )
        )  # fmt: skip
        assert int(run.status) == 0
        t = np.asarray(run.times)[10:]
        angle = RATE * t
        lift = 0.5 * LIFT * (1.0 - np.cos(angle))
        force = FOLLOWER * 0.5 * LIFT * RATE**2 * np.cos(angle) + SPRING * lift + PRELOAD
        assert force.min() > 0.0
        found = np.asarray(run.couplings["lift"].loads)[10:]
        np.testing.assert_allclose(found[:, 1], force, rtol=5e-3)
        moment = force * 0.5 * LIFT * np.sin(angle)
        np.testing.assert_allclose(-found[:, 0], moment, rtol=0, atol=5e-3 * np.abs(moment).max())
        np.testing.assert_allclose(run.motion.drive_moment[10:], moment, rtol=0, atol=5e-3 * np.abs(moment).max())

    def test_the_table_is_smooth_and_repeats(self):
        law = discretise(cam(stiffness=1e6)).couplings["lift"]
        angles = np.array([-0.4, 0.4, 2.0 * np.pi + 0.4, 3.0])
        value, slope = np.array([law.transmitted(jnp.asarray(angle)) for angle in angles]).T
        np.testing.assert_allclose(value, 0.5 * LIFT * (1.0 - np.cos(angles)), rtol=0, atol=1e-6 * LIFT)
        np.testing.assert_allclose(slope, 0.5 * LIFT * np.sin(angles), rtol=0, atol=1e-5 * LIFT)
        row = 2.0 * np.pi / 72.0
        bends = [
            (law.transmitted(row + x + 1e-4)[1] - law.transmitted(row + x - 1e-4)[1]) / 2e-4 for x in (-2e-4, 2e-4)
        ]
        np.testing.assert_allclose(*bends, rtol=0, atol=1e-4 * LIFT)


class TestStatics:
    """Positions and loads at rest."""

    @pytest.mark.long
    def test_a_screw_jack(self):
        """The moment that holds the screw is the load times the lead over a turn; the mesh gives."""
        lead, stiffness = 5e-3 / (2.0 * np.pi), 2e6
        up = (0.0, -0.5 * np.pi, 0.0)
        joints = [Joint("A", "base", "screw"), Joint("G", "base", "table", kind="prismatic", orientation=up)]
        jack = Coupling("thread", ("A", "G"), ratio="5 mm/rev", stiffness=stiffness)
        model = discretise(
            Mechanism([rotor("screw", 1e-4), body("table", 50.0)], joints, driven_joint="A", forces=[jack])
        )
        angle, weight = 3.0, 50.0 * 9.81
        found = assemble(model, assembly_errors(model), hold={"A": angle})
        assert int(found.status) == 0
        np.testing.assert_allclose(found.state.position.joints[1], lead * angle - weight / stiffness, rtol=1e-9)
        np.testing.assert_allclose(found.preload["A"].moment[1], weight * lead, rtol=1e-9)
        # The thread carries the table: the guide is without load along itself.
        np.testing.assert_allclose(found.preload["G"].force[0], 0.0, atol=1e-9 * weight)

    @pytest.mark.parametrize("flanks", [{}, {"one_sided": True}], ids=["both", "one_sided"])
    def test_a_cam_at_rest(self, flanks):
        """The follower's spring and the mesh in series, and the moment that holds the cam by virtual work."""
        stiffness, angles = 2e6, np.linspace(0.0, 2.0 * np.pi, 9)
        turn = kinetostatic_turn(discretise(cam(stiffness=stiffness, **flanks)), None, angles)
        assert (np.asarray(turn.status) == 0).all()
        lift, slope = 0.5 * LIFT * (1.0 - np.cos(angles)), 0.5 * LIFT * np.sin(angles)
        force = (SPRING * lift + PRELOAD) / (1.0 + SPRING / stiffness)
        np.testing.assert_allclose(turn.couplings["lift"][:, 1], force, rtol=1e-8)
        np.testing.assert_allclose(turn.holding, force * slope, rtol=0, atol=1e-6 * np.abs(force * slope).max())

    def test_willis(self):
        """A planetary train with a ring that stands: sun and planet are hung on the carrier."""
        sun, planet, ring = 20, 16, 52
        joints = [
            Joint("C", "base", "carrier"),
            Joint("S", "carrier", "sun", position=(0.0, 0.0, 0.0)),
            Joint("P", "carrier", "planet", position=(0.05, 0.0, 0.0)),
        ]
        meshes = [
            Coupling("inner", ("P", "S"), ratio=-planet / sun, stiffness=1e5),
            Coupling("outer", ("C", "P"), ratio=-ring / planet, stiffness=1e5),
        ]
        links = [rotor(name, 1e-3) for name in ("carrier", "sun", "planet")]
        model = discretise(Mechanism(links, joints, gravity=NO_GRAVITY, driven_joint="C", forces=meshes))
        found = assemble(model, assembly_errors(model), hold={"C": 0.3})
        assert int(found.status) == 0
        angles = dict(zip(model.topology.joints, found.state.position.joints, strict=True))
        np.testing.assert_allclose(0.3 + angles["S"], (1.0 + ring / sun) * 0.3, rtol=1e-9)

    def test_errors_move_the_second_coordinate(self):
        """Pitch error, eccentricity and ratio error, and derivatives by them."""
        model = discretise(gear_pair(stiffness=STIFFNESS, waves=2.0, eccentricity_phase=0.4))
        angle = 0.7

        def second(values):
            names = ("ratio", "pitch_error", "eccentricity")
            made = design(model, {f"mesh.{name}": value for name, value in zip(names, values, strict=True)})
            return assemble(model, assembly_errors(model), hold={"A": angle}, design=made).state.position.joints[1]

        at = jnp.asarray([-0.51, 2e-3, 3e-3])
        found = check_derivatives(second, at, 1e-3 * at, reverse=1e-9, differences=1e-6)
        wave = np.sin(2.0 * angle + 0.4)
        np.testing.assert_allclose(found.values, -0.51 * (angle + 2e-3) + 3e-3 * wave, rtol=1e-10)
        np.testing.assert_allclose(found.forward, [angle + 2e-3, -0.51, wave], rtol=1e-9)


class TestLoop:
    """A geared five-bar: two cranks whose mesh takes the freedom that the loop leaves."""

    @pytest.mark.long
    @pytest.mark.parametrize("method", [RungeKutta4(step=2e-5), GeneralisedAlpha(step=5e-4)], ids=["rk4", "implicit"])
    def test_positions_and_balances(self, method):
        mechanism = geared_five_bar(stiffness=3e4, damping=1.0)
        run = simulate(
            Simulation(
                discretise(mechanism), drive=PrescribedRate("A", 5.0, 0.05),
                duration=0.1, method=method, save_every=0.01,
            )
        )  # fmt: skip
        assert int(run.status) == 0
        one = np.asarray(run.motion.angles["A"])
        assert one[-1] > 0.3
        two = TURN + one
        np.testing.assert_allclose(run.motion.angles["E"], two, rtol=0, atol=5e-6)
        rods = np.array([rod_angles(a, b) for a, b in zip(one, two, strict=True)])
        np.testing.assert_allclose(one + run.motion.angles["B"], rods[:, 0], rtol=0, atol=1e-5)
        assert np.abs(np.asarray(run.couplings["mesh"].loads)).max() > 0.05
        assert float(run.checks.energy_balance_error) < 1e-2
        assert float(run.checks.momentum_balance_error) < 1e-5

    def test_flexible_rods_at_rest(self):
        """The mesh carries what the weight asks for: the virtual work of a small turn of both cranks."""
        model = discretise(geared_five_bar(rfes=3, stiffness=1e6))
        found = assemble(model, assembly_errors(model))
        assert int(found.status) == 0
        joints = dict(zip(model.topology.joints, found.state.position.joints))
        deflection = float(joints["E"]) - TURN
        # Of rigid links: energies at angles of the second crank, the first one held.
        step = 1e-5

        def energy(two):
            weights = {}
            rods = rod_angles(0.0, two)
            mass = 7850.0 * 1e-4 * 9.81
            pin = -CRANK * np.sin(two)
            weights["two"] = mass * CRANK * 0.5 * pin
            weights["left"] = mass * ROD * 0.5 * -ROD * np.sin(rods[0])
            weights["right"] = mass * ROD * (pin - 0.5 * ROD * np.sin(rods[1]))
            return sum(weights.values())

        moment = (energy(TURN + step) - energy(TURN - step)) / (2.0 * step)
        np.testing.assert_allclose(-1e6 * deflection, moment, rtol=2e-3)
