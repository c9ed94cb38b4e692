"""Ideal couplings, theory (16.7) to (16.9), against closed forms."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Coupling,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointSpring,
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
    inverse_dynamics,
    kinetostatic_turn,
    largest_stable_step,
    natural_frequencies,
    simulate,
    static_loads,
    steady_cycle,
)
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.kinematics.cut_joints import closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.outcome.observation import cut_drift
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

MOMENT, BOTH = 3.0, ONE + RATIO**2 * TWO  # inertia of both rotors at A
METHODS = pytest.mark.parametrize("method", [RungeKutta4(step=1e-3), GeneralisedAlpha(step=1e-3), Leapfrog(step=1e-3)],
                                  ids=["rk4", "implicit", "leapfrog"])  # fmt: skip
TEETH = 20, 16, 52  # of sun, planet and ring
DRIVE = MomentTable("A", times=[0.0, 1.0], moments=[MOMENT, MOMENT])


class TestGearPair:
    """One degree of freedom: the equivalent inertia turns, and the mesh carries what accelerates the second rotor."""

    @METHODS
    def test_motion_load_and_balances(self, method):
        simulation = Simulation(discretise(gear_pair()), drive=DRIVE, duration=0.1, method=method, save_every=0.02)
        run = simulate(simulation)
        assert int(run.status) == 0
        angle = 0.5 * MOMENT / BOTH * np.asarray(run.times) ** 2
        np.testing.assert_allclose(run.motion.angles["A"], angle, rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.motion.angles["B"], RATIO * angle, rtol=0, atol=1e-9)
        load = TWO * RATIO * MOMENT / BOTH
        np.testing.assert_allclose(run.couplings["mesh"].loads, np.tile([-RATIO * load, load], (6, 1)), rtol=1e-9)
        np.testing.assert_allclose(run.couplings["mesh"].deflection, 0.0, atol=1e-9)
        np.testing.assert_allclose(np.asarray(run.loads["B"].moment), 0.0, atol=1e-9)
        assert float(run.checks.energy_balance_error) < 1e-9
        assert float(run.checks.momentum_balance_error) < 1e-9

    @METHODS
    def test_a_rate_of_the_second_rotor_is_that_of_the_first(self, method):
        model = discretise(gear_pair(driven=None, rates=(None, 2.0)))
        run = simulate(Simulation(model, drive=None, duration=0.1, method=method, save_every=0.1))
        np.testing.assert_allclose(run.motion.angles["A"][-1], 0.2 / RATIO, rtol=1e-9)

    @pytest.mark.long
    @pytest.mark.parametrize("method", [RungeKutta4(step=1e-3), GeneralisedAlpha(step=1e-3)], ids=["rk4", "implicit"])
    def test_errors_and_derivatives(self, method):
        """The second rotor follows pitch error, eccentricity and ratio; the load, their derivatives."""
        model = discretise(gear_pair(waves=2.0, eccentricity=1e-3, eccentricity_phase=0.4))
        simulation = Simulation(model, drive=DRIVE, duration=0.05, method=method, save_every=0.05)
        names = ("ratio", "eccentricity")

        def end(values):
            numbers = {f"mesh.{name}": value for name, value in zip(names, values, strict=True)}
            made = design(model, {**numbers, "mesh.pitch_error": 1e-3})
            run = simulate(dataclasses.replace(simulation, design=made))
            angles, loads = run.motion.angles, run.couplings["mesh"].loads
            return jnp.stack([angles["A"][-1], angles["B"][-1], loads[-1, 0]])

        at = jnp.asarray([RATIO, 1e-3])
        found = check_derivatives(end, at, 1e-4 * at, reverse=1e-7, differences=1e-5)
        a, b, _ = found.values
        # At the start the mesh is without load at 0 for both, before its errors.
        np.testing.assert_allclose(b, RATIO * (a + 1e-3) + 1e-3 * np.sin(2.0 * a + 0.4), rtol=0, atol=1e-8)

    def test_frequencies_and_step(self):
        """A spring on the first rotor, both turning."""
        stiffness = 80.0
        model = discretise(gear_pair(driven=None, forces=[JointSpring("spring", "A", stiffness=stiffness)]))
        rate = np.sqrt(stiffness / BOTH)
        np.testing.assert_allclose(natural_frequencies(model, count=1).frequency, [rate / (2.0 * np.pi)], rtol=1e-9)
        np.testing.assert_allclose(np.max(eigenvalues(model).imag), rate, rtol=1e-6)
        np.testing.assert_allclose(largest_stable_step(model, Leapfrog(step=1e-6)), 2.0 / rate, rtol=5e-3)

    def test_inverse_dynamics(self):
        found = inverse_dynamics(discretise(gear_pair()), positions={"A": [0.1]}, rates={"A": [2.0]},
                                 accelerations={"A": [-7.0]})  # fmt: skip
        np.testing.assert_allclose(found.holding["A"], [-7.0 * BOTH], rtol=1e-10)

    def test_a_given_offset_closes_the_start_and_follows_a_design(self):
        model = discretise(gear_pair(offset=0.3))
        np.testing.assert_allclose(model.start_joints, [0.0, 0.3], atol=1e-12)

        def second(values):
            made = design(model, {"mesh.offset": values[0], "mesh.ratio": values[1]})
            return assemble(model, hold={"A": 0.2}, design=made).state.position.joints[1]

        found = check_derivatives(second, jnp.asarray([0.5, -0.7]), 1e-5, reverse=1e-12, differences=1e-9)
        np.testing.assert_allclose(found.values, 0.5 - 0.7 * 0.2, rtol=1e-12)

    def test_a_given_offset_beyond_half_a_turn(self):
        """A start value that is far away is given up, and the coordinate is not taken modulo a turn."""
        pair = gear_pair(offset=5.0)
        joints = [dataclasses.replace(joint, angle=0.1 if joint.name == "B" else None) for joint in pair.joints]
        model = discretise(dataclasses.replace(pair, joints=joints))
        np.testing.assert_allclose(model.start_joints, [0.0, 5.0], atol=1e-12)

    def test_couplings_that_say_the_same_are_refused(self):
        other = Coupling("other", ("B", "A"), ratio=1.0 / RATIO)
        with pytest.raises(InputError, match="`stiffness` of coupling 'mesh' must be given.*load is undecided"):
            discretise(gear_pair(forces=[other]))


def test_a_cam_carries_its_followers_inertia_spring_and_preload():
    model = discretise(cam())
    method = GeneralisedAlpha(step=1e-4)
    run = simulate(Simulation(model, drive=PrescribedRate("A", RATE), duration=0.1, method=method, save_every=0.01))
    assert int(run.status) == 0
    angle = RATE * np.asarray(run.times)
    lift, slope = 0.5 * LIFT * (1.0 - np.cos(angle)), 0.5 * LIFT * np.sin(angle)
    np.testing.assert_allclose(run.motion.displacements["G"], lift, rtol=0, atol=1e-6 * LIFT)
    force = FOLLOWER * 0.5 * LIFT * RATE**2 * np.cos(angle) + SPRING * lift + PRELOAD
    # The spline between rows of 5 deg: its second derivative is off by a thousandth.
    np.testing.assert_allclose(run.couplings["lift"].loads[:, 1], force, rtol=1e-4)
    moment = force * slope
    np.testing.assert_allclose(run.motion.drive_moment, moment, rtol=0, atol=1e-4 * moment.max())


def test_a_screw_jack():
    """The moment that holds the screw is the load times the lead over a turn; the table is where the thread says."""
    lead, angle = 5e-3 / (2.0 * np.pi), 3.0
    joints = [Joint("A", "base", "screw"),
              Joint("G", "base", "table", kind="prismatic", orientation=(0.0, -0.5 * np.pi, 0.0))]  # fmt: skip
    jack = Coupling("thread", ("A", "G"), ratio="5 mm/rev")
    model = discretise(Mechanism([rotor("screw", 1e-4), body("table", 50.0)], joints, driven_joint="A", forces=[jack]))
    found = assemble(model, hold={"A": angle})
    assert int(found.status) == 0
    np.testing.assert_allclose(found.state.position.joints[1], lead * angle, rtol=1e-12)
    np.testing.assert_allclose(found.preload["A"].moment[1], 50.0 * 9.81 * lead, rtol=1e-9)
    np.testing.assert_allclose(found.preload["G"].force, 0.0, atol=1e-9)


def planetary(force):
    """Sun and planet, hung on a carrier whose angle drives, in a ring that stands."""
    sun, planet, ring = TEETH
    joints = [Joint("C", "base", "carrier"), Joint("S", "carrier", "sun", position=(0.0, 0.0, 0.0)),
              Joint("P", "carrier", "planet", position=(0.05, 0.0, 0.0))]  # fmt: skip
    forces = [
        Coupling("inner", ("P", "S"), ratio=-planet / sun),
        Coupling("outer", ("C", "P"), ratio=-ring / planet),
        force,
    ]
    links = [rotor(name, 1e-3) for name in ("carrier", "sun", "planet")]
    return discretise(Mechanism(links, joints, gravity=NO_GRAVITY, driven_joint="C", forces=forces))


@pytest.mark.long
def test_a_planetary_train():
    """Willis' ratio, and the moments of sun, ring and carrier in the ratios of their teeth."""
    (sun, planet, ring), load = TEETH, 2.0
    model = planetary(JointSpring("load", "S", preload=load))
    turn = kinetostatic_turn(model, None, [0.0, 0.3])
    assert (np.asarray(turn.status) == 0).all()
    angles = static_loads(model, positions={"C": [0.3]}).angles
    np.testing.assert_allclose(0.3 + angles["S"][0], (1.0 + ring / sun) * 0.3, rtol=1e-12)
    # The load acts between carrier and sun; the ring, which stands, takes it in the ratio of the teeth.
    np.testing.assert_allclose(turn.holding, -load * ring / sun, rtol=1e-10)
    np.testing.assert_allclose(turn.couplings["inner"][:, 1], -load, rtol=1e-10)
    np.testing.assert_allclose(turn.couplings["outer"][:, 1], load * planet / sun, rtol=1e-10)


def test_a_planetary_train_on_a_spring():
    """The frequency of all inertias at the carrier: as the train's own, and of what moves about it."""
    (sun, planet, ring), stiffness = TEETH, 7.0
    model = planetary(JointSpring("spring", "C", stiffness=stiffness))
    inertia = 1e-3 * (1.0 + (1.0 + ring / sun) ** 2 + (1.0 - ring / planet) ** 2) + 1.0 * 0.05**2
    rate = np.sqrt(stiffness / inertia)
    np.testing.assert_allclose(np.max(eigenvalues(model).imag), rate, rtol=1e-6)
    found = natural_frequencies(model, count=1, locked=False).frequency
    np.testing.assert_allclose(found, [rate / (2.0 * np.pi)], rtol=1e-9)


def potential(two):
    """Of the weight of the five-bar's links, cranks at 0 and at an angle."""
    weight, pin = 7850.0 * 1e-4 * 9.81, -CRANK * np.sin(two)
    left, right = rod_angles(0.0, two)
    return weight * (CRANK * 0.5 * pin - ROD * ROD * 0.5 * np.sin(left) + ROD * (pin - 0.5 * ROD * np.sin(right)))


class TestGearedFiveBar:
    """The coupling takes the freedom that the loop leaves."""

    @pytest.mark.parametrize("reactions", ["planar", "minimum_norm"])
    def test_the_mesh_at_rest_carries_what_virtual_work_says(self, reactions):
        model = discretise(geared_five_bar(reactions=reactions))
        found = static_loads(model)
        assert (np.asarray(found.status) == 0).all()
        np.testing.assert_allclose(found.angles["E"], TURN, rtol=1e-12)
        step = 1e-5
        moment = (potential(TURN + step) - potential(TURN - step)) / (2.0 * step)
        np.testing.assert_allclose(found.couplings["mesh"].loads[0, 1], moment, rtol=1e-6)

    @pytest.mark.long
    @pytest.mark.parametrize("rfes, method", [(None, RungeKutta4(step=2e-5)), (3, GeneralisedAlpha(step=5e-4))])
    def test_positions_and_balances(self, rfes, method):
        model = discretise(geared_five_bar(rfes))
        run = simulate(
            Simulation(model, drive=PrescribedRate("A", 5.0, 0.05), duration=0.1, method=method, save_every=0.01)
        )
        assert int(run.status) == 0
        one = np.asarray(run.motion.angles["A"])
        np.testing.assert_allclose(run.motion.angles["E"], TURN + one, rtol=0, atol=1e-10)
        rods = np.array([rod_angles(a, TURN + a) for a in one])
        np.testing.assert_allclose(
            one + run.motion.angles["B"], rods[:, 0], rtol=0, atol=1e-10 if rfes is None else 5e-5
        )
        assert float(run.checks.energy_balance_error) < 1e-4
        assert float(run.checks.momentum_balance_error) < 1e-9

    def test_both_cranks_keep_their_start(self):
        """The rods follow rough starts of theirs, and a design of their lengths: it does not turn the gears."""
        exact = geared_five_bar()
        rough = {"B": 0.05, "D": -0.03}
        joints = [
            dataclasses.replace(joint, angle=joint.angle + rough[joint.name]) if joint.name in rough else joint
            for joint in exact.joints
        ]
        model = discretise(dataclasses.replace(exact, joints=joints))
        np.testing.assert_allclose(model.start_joints, discretise(exact).start_joints, atol=1e-12)
        longer = assemble(model, design=design(model, {"left.length": ROD + 0.01}))
        angles = dict(zip(model.topology.joints, np.asarray(longer.state.position.joints)))
        assert int(longer.status) == 0 and abs(angles["B"] - float(model.start_joints[2])) > 1e-3
        np.testing.assert_allclose([angles["A"], angles["E"]], [0.0, TURN], atol=1e-12)

    def test_what_is_apart_is_drift(self):
        model = discretise(geared_five_bar())
        actual, scale = apply_errors(model, assembly_errors(model)), 0.2
        position = model.start_coordinates()
        state = static_state(model.topology, dataclasses.replace(position, joints=position.joints.at[1].add(0.01)))
        closed = closure(actual, motion_of(actual, state), scale)
        # The rod's end moves by 0.01 times some 50 mm, the gears are apart by 0.01 times the scale.
        np.testing.assert_allclose(cut_drift(closed, scale)[0], 0.01 * scale, rtol=1e-9)

    @pytest.mark.long
    def test_derivatives_of_the_load(self):
        model = discretise(geared_five_bar())
        simulation = Simulation(model, drive=PrescribedRate("A", 5.0, 0.05), duration=0.02,
                                method=GeneralisedAlpha(step=1e-3), save_every=0.02)  # fmt: skip

        def load(values):
            made = design(model, {"mesh.ratio": values[0], "left.length": values[1]})
            return simulate(dataclasses.replace(simulation, design=made)).couplings["mesh"].loads[-1, 0]

        check_derivatives(load, jnp.asarray([1.0, ROD]), 3e-4, reverse=1e-8, differences=1e-4)

    @pytest.mark.long
    @pytest.mark.parametrize("mesh", [{}, {"stiffness": 3e4, "damping": 1.0}], ids=["ideal", "elastic"])
    def test_its_cycle_closes_though_the_second_crank_has_turned(self, mesh):
        drive, method = PrescribedRate("A", 5.0), GeneralisedAlpha(step=2e-3)
        cycle = steady_cycle(Simulation(discretise(geared_five_bar(**mesh)), drive=drive, method=method))
        assert cycle.converged and int(cycle.run.status) == 0
        loads = np.asarray(cycle.run.couplings["mesh"].loads)
        np.testing.assert_allclose(loads[-1], loads[0], rtol=1e-5)


@pytest.mark.long
def test_a_coupling_within_a_loop_makes_a_structure_of_it():
    """Of a four-bar whose rocker is geared to its crank nothing is left to move, and a second gear has no say."""
    model = discretise(dataclasses.replace(geared_five_bar(), driven_joint=None))
    assert model.topology.undriven == (0,)
    more = Coupling("more", ("A", "B"), ratio=0.3)
    stopped = dataclasses.replace(geared_five_bar(), forces=[Coupling("mesh", ("A", "E"), ratio=1.0), more])
    assert discretise(dataclasses.replace(stopped, driven_joint=None)).topology.undriven == ()
    third = Coupling("third", ("A", "D"), ratio=0.2)
    with pytest.raises(InputError, match="load is undecided"):
        discretise(dataclasses.replace(stopped, driven_joint=None, forces=[*stopped.forces, third]))
