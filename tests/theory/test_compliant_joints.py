"""Compliant joints against closed forms and values of independent programs.

The reference values of the four-bar on bushings were computed for this project in absolute coordinates, integrated
with order 8 to 1e-9, and by Exudyn beside it; loads are those of the parent on the child about the child's point, in
the axes of the parent's frame.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    GeneralisedAlpha,
    InputError,
    Joint,
    Leapfrog,
    Link,
    Mechanism,
    MomentRamp,
    PointMass,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    discretise,
    largest_stable_step,
    simulate,
)
from rfem_jax.description.mechanism.compliance import SprungDirection
from rfem_jax.mechanics.laws.joint_springs import compliant_spring
from rfem_jax.simulation.vibrations.stability import eigenvalues
from rfem_jax.validation.reference_values import read_reference
from tests.derivatives import check_derivatives
from tests.mechanisms import BAR, NO_MASS, STEEL, link

BUSHING = Compliance(
    radial=5e7, axial=2e7, tilt=2e3, radial_damping=500.0, axial_damping=200.0, tilt_damping=0.02
)  # fmt: skip
TILTED = {"D.delta_x": np.radians(0.5), "D.delta_z": np.radians(0.5), "D.d_y": 5e-4}
STEEL_WITHOUT_DAMPING = dataclasses.replace(STEEL, damping=0.0)
ANGLES = -1.57079632679, -0.62161444632, -1.75896545305  # of the links, perfect


def bushed_four_bar(compliance=BUSHING):
    links = [
        Link(name, length, BAR, STEEL_WITHOUT_DAMPING, rigid=True)
        for name, length in (("crank", 0.12), ("coupler", 0.3), ("rocker", 0.3))
    ]
    crank, coupler, rocker = ANGLES
    joints = [
        Joint("A", "base", "crank", angle=crank, compliance=compliance),
        Joint("B", "crank", "coupler", angle=coupler - crank, compliance=compliance),
        Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=rocker, compliance=compliance),
        Joint("C", "coupler", "rocker", cut=True, compliance=compliance),
    ]
    return Mechanism(links, joints, driven_joint="A")


@pytest.fixture(scope="module")
def bushed():
    return discretise(bushed_four_bar())


def stiffer(model, factor):
    """The model with all stiffnesses of bearings times a factor."""
    return eqx.tree_at(
        lambda m: [spring.stiffness for spring in m.springs.values()],
        model,
        [factor * spring.stiffness for spring in model.springs.values()],
    )


def in_seat(load, angle):
    """Components of a load in the axes of the parent's frame from those in the hinge frame."""
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return turned @ np.asarray(load)


GIVEN = read_reference("nonideal_joints")
RMS = {joint: (GIVEN["rms_force"]["bushings"][joint], GIVEN["rms_moment"]["bushings"][joint]) for joint in "ABCD"}


class TestFourBarOnBushings:
    FORCES: ClassVar = {
        "A": (0.279489464553, 27.3698436479, 2.44419950633),
        "B": (1.42152062415, 27.3750494251, -0.288271032598),
        "C": (-0.307268522718, 27.3648423758, -0.939037986874),
        "D": (-0.518322736171, -27.3382646265, 3.33910797365),
    }
    MOMENTS: ClassVar = {
        "A": (-7.20261585216, 0.0345928140344, -0.64157490612),
        "B": (-0.64169556155, 0.0, 3.91739834934),
        "C": (-3.55831322466, 0.0, -6.45177825565),
        "D": (7.19765183858, 0.0, 8.85272468582),
    }
    PRELOAD: ClassVar = {  # by the errors alone, divided by their size, of a closed form; global axes
        "A": ((0.0, 27.3683361039, 0.0), (-7.20076623163, 0.0, -0.642038127512)),
        "D": ((0.0, -27.3683361039, 0.0), (7.20076623163, 0.0, 8.85253895867)),
    }

    @pytest.mark.slow
    def test_at_rest_with_the_crank_held(self, bushed):
        assembled = assemble(bushed, assembly_errors(bushed, TILTED))
        assert int(assembled.status) == 0
        position, topology = np.asarray(assembled.state.position.joints), bushed.topology
        for joint, load in assembled.preload.items():
            # The load of a cut joint is in the axes of its frame on the parent.
            j = topology.joints.index(joint)
            angle = position[topology.own_positions[j][0]] if j < topology.n_links else 0.0
            np.testing.assert_allclose(in_seat(load.force, angle), self.FORCES[joint], rtol=0, atol=1e-8)
            np.testing.assert_allclose(in_seat(load.moment, angle), self.MOMENTS[joint], rtol=0, atol=1e-8)

    def test_preload_of_small_errors_grows_in_proportion_to_the_stiffness(self, bushed):
        still = eqx.tree_at(lambda m: m.gravity, bushed, jnp.zeros(3))
        small = assembly_errors(still, {name: 1e-3 * size for name, size in TILTED.items()})
        for factor in (0.01, 1.0, 100.0):
            preload = assemble(stiffer(still, factor), small).preload
            for joint, (force, moment) in self.PRELOAD.items():
                angle = ANGLES[0] if joint == "A" else ANGLES[2]
                found = in_seat(preload[joint].force, angle), in_seat(preload[joint].moment, angle)
                np.testing.assert_allclose(1e3 / factor * found[0], force, rtol=0, atol=5e-4)
                np.testing.assert_allclose(1e3 / factor * found[1], moment, rtol=0, atol=1e-4)

    @pytest.mark.long
    def test_derivatives_of_the_preload(self, bushed):
        names = list(TILTED)

        def loads(values):
            errors = assembly_errors(bushed, dict(zip(names, values[:3])))
            made = eqx.tree_at(lambda m: [m.springs["C.tilt"].stiffness, m.springs["A.axial"].stiffness],
                               bushed, [values[3], values[4]])  # fmt: skip
            preload = assemble(made, errors).preload
            return jnp.stack([jnp.sum(preload["C"].moment ** 2), jnp.sum(preload["B"].force ** 2)])

        at = np.array([*TILTED.values(), 2e3, 2e7])
        check_derivatives(loads, at, 1e-4 * at, reverse=1e-8, differences=1e-5)

    @pytest.mark.long
    def test_in_motion(self, bushed):
        method = RungeKutta4(step=1e-5)
        assert largest_stable_step(bushed, method) > 4e-5
        run = simulate(
            Simulation(bushed, drive=MomentRamp("A", 1.5, 0.1), duration=0.4, method=method, save_every=0.05),
            errors=assembly_errors(bushed, TILTED),
        )
        assert int(run.status) == 0
        for joint, (force, moment) in RMS.items():
            np.testing.assert_allclose(run.metrics.rms_force[joint], force, rtol=2e-6)
            np.testing.assert_allclose(run.metrics.rms_moment[joint], moment, rtol=1e-9)
        np.testing.assert_allclose(run.motion.angle[2], -0.877416583055, rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.energy.kinetic[2], 0.859134737515, rtol=1e-8)
        np.testing.assert_allclose(run.energy.elastic[2], 0.0557100668558, rtol=1e-8)
        np.testing.assert_allclose(run.energy.work[2], 0.818895982528, rtol=1e-8)
        for part in (run.checks.energy_balance_error, run.checks.momentum_balance_error, run.checks.hinge_moment_error):
            assert float(part) < 1e-7

    @pytest.mark.long
    def test_bearings_a_hundred_times_as_stiff_in_long_steps(self, bushed):
        """The largest stable step of an explicit method is 5e-6 s; four Newton increments a step are enough."""
        model = stiffer(bushed, 100.0)
        assert largest_stable_step(model, RungeKutta4(step=1e-6)) < 6e-6
        method = GeneralisedAlpha(step=1e-3, corrections=4, spectral_radius=0.3)
        run = simulate(Simulation(model, drive=MomentRamp("A", 1.5, 0.1), duration=0.1, method=method, save_every=0.05))
        assert int(run.status) == 0 and float(run.checks.solution_residual) < 1e-6
        assert float(run.motion.rate[-1]) > 25.0 and float(run.checks.momentum_balance_error) < 1e-6
        # The links move as with ideal joints: the coupler keeps its length.
        crank, rocker = np.asarray(run.motion.angle), np.asarray(run.motion.angles["D"])
        across = 0.3 + 0.3 * np.cos(rocker) - 0.12 * np.cos(crank), 0.12 * np.sin(crank) - 0.3 * np.sin(rocker)
        np.testing.assert_allclose(np.hypot(*across), 0.3, rtol=0, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_stiff_bearings_approach_ideal_ones_where_a_link_is_flexible(elements):
    """The difference is of first order in the compliance."""

    def preload(model):
        errors = assembly_errors(model, {"D.delta_x": 5e-3, "D.delta_z": 5e-3, "D.d_y": 3e-4})
        assembled = assemble(model, errors)
        assert int(assembled.status) == 0
        return np.array([np.concatenate(assembled.preload[joint]) for joint in "ADC"])

    def made(compliance):
        """A triangle of the base, a rigid link and a flexible one."""
        joints = [
            Joint("A", "base", "left", angle=np.radians(-70), compliance=compliance),
            Joint("D", "base", "right", position=(0.2, 0.0, 0.0), angle=np.radians(-120), compliance=compliance),
            Joint("C", "left", "right", cut=True, compliance=compliance),
        ]
        return discretise(Mechanism([link("left", 0.2), link("right", 0.25, 2)], joints), elements=elements)

    ideal = preload(made(None))
    model = made(Compliance(radial=1e11, axial=1e11, tilt=1e8))
    difference = [np.abs(preload(stiffer(model, factor)) - ideal) for factor in (1.0, 10.0, 100.0)]
    assert difference[0].max() > 0.01 * np.abs(ideal).max()
    loaded = difference[0] > 1e-3 * difference[0].max()
    assert loaded.sum() > 8
    np.testing.assert_allclose((difference[1] / difference[2])[loaded], 10.0, rtol=0.03)
    np.testing.assert_allclose((difference[0] / difference[1])[loaded], 10.0, rtol=0.3)


class TestSprings:
    def block(self, joint, mass=0.5, gravity=(0.0, 0.0, 0.0)):
        body = Link("block", 0.1, NO_MASS, rigid=True, point_masses=[PointMass(mass, 0.0, (1e-3, 1e-3, 1e-3))])
        return discretise(Mechanism([body], [joint], gravity=gravity))

    @pytest.mark.slow
    def test_springs_in_series_carry_what_their_compliances_say(self):
        """Two rods between walls: too long by a length, and twisted against each other."""
        stiffness, torsion = (2e6, 3e6, 5e6), (200.0, 300.0)
        links = [Link(name, 0.2, BAR, STEEL, rigid=True) for name in ("first", "second")]
        first, second = (
            Compliance(radial=k, R_x=about, R_y=1e4, R_z=1e4) for k, about in zip(stiffness, torsion, strict=False)
        )
        joints = [
            Joint("F", "base", "first", kind="fixed", compliance=first),
            Joint("G", "first", "second", kind="fixed", compliance=second),
            Joint("H", "base", "second", kind="fixed", position=(0.4, 0, 0), cut=True,
                  compliance=Compliance(T_x=stiffness[2])),
        ]  # fmt: skip
        model = discretise(Mechanism(links, joints, gravity=(0.0, 0.0, 0.0)))
        errors = assembly_errors(model, {"first.length": 1e-4, "second.twist": 2e-3})
        assembled = assemble(model, errors)
        assert int(assembled.status) == 0
        force = 1e-4 / sum(1.0 / k for k in stiffness)
        moment = 2e-3 / sum(1.0 / k for k in torsion)
        for joint, sign in (("F", 1.0), ("G", 1.0), ("H", -1.0)):
            np.testing.assert_allclose(assembled.preload[joint].force, [sign * force, 0.0, 0.0], rtol=1e-9, atol=1e-6)
            np.testing.assert_allclose(np.abs(assembled.preload[joint].moment[0]), moment, rtol=1e-9)
        np.testing.assert_allclose(assembled.state.position.joints[0], -force / stiffness[0], rtol=1e-9)

    @pytest.mark.slow
    def test_a_weight_on_tables(self):
        """Along one axis another table in each sense; across it one over the resultant."""
        hook = Compliance(
            T_z={"positions": [-3e-3, -1e-3, 0.0, 1e-3], "forces": [-20.0, -2.0, 0.0, 1.0]}, T_x=1e5, T_y=1e5
        )  # fmt: skip
        model = self.block(Joint("F", "base", "block", kind="fixed", compliance=hook), gravity=(0.0, 0.0, -10.0))
        found = assemble(model, assembly_errors(model))
        np.testing.assert_allclose(found.state.position.joints, [0.0, 0.0, -1e-3 - 2e-3 * 3.0 / 18.0], rtol=1e-6)
        bearing = Compliance(radial={"positions": [0.0, 1e-3, 2e-3], "forces": [0.0, 2.0, 8.0]})
        gravity = 10.0 * np.array([-0.8, 0.0, -0.6])
        model = self.block(Joint("J", "base", "block", compliance=bearing), gravity=tuple(gravity))
        found = assemble(model, assembly_errors(model), hold={"J": 0.0})
        along = found.state.position.joints[:2] / 1.5e-3
        np.testing.assert_allclose(along, [-0.8, -0.6], rtol=1e-6)
        np.testing.assert_allclose(found.preload["J"].force, -0.5 * gravity, rtol=1e-6)

    def test_eigenvalues_and_steps(self):
        spring = Compliance(radial=1e8, radial_damping=200.0)
        model = self.block(Joint("S", "base", "block", kind="spherical", compliance=spring))
        decay = 200.0 / (2.0 * 0.5)
        expected = -decay + 1j * np.sqrt(1e8 / 0.5 - decay**2)
        values = eigenvalues(model)
        values = values[np.abs(values) > 1.0]
        assert values.shape == (6,)
        np.testing.assert_allclose(values.real + 1j * np.abs(values.imag), expected, rtol=1e-6)
        undamped = Compliance(radial=1e8)
        model = self.block(Joint("S", "base", "block", kind="spherical", compliance=undamped))
        limit = largest_stable_step(model, Leapfrog(step=1e-6))
        np.testing.assert_allclose(limit, 2.0 / np.sqrt(1e8 / 0.5), rtol=5e-3)

    @pytest.mark.parametrize("cut", ["F", "H"])
    def test_vibration_between_two_bearings_one_of_which_is_cut(self, cut):
        """Rocking about the middle, and bouncing, along the axes of the hinges and across."""
        links = [Link("rod", 0.2, BAR, STEEL, rigid=True)]
        ends = {"F": (0.0, 0.0, 0.0), "H": (0.2, 0.0, 0.0)}
        joints = [
            Joint(name, "base", "rod", kind="spherical", position=end, child_position=end, cut=name == cut,
                  compliance=Compliance(T_x=1e6, T_y=4e6, T_z=1e6))
            for name, end in ends.items()
        ]  # fmt: skip
        values = np.sort(np.abs(eigenvalues(discretise(Mechanism(links, joints)))))[-10::2]
        mass = 0.785 * 0.2
        inertia = mass * 0.2**2 / 12.0 + 0.785 * 0.01**2 / 12.0 * 0.2
        squares = [2e6 / mass, 8e6 / mass, 2e6 / mass, 2e6 * 0.1**2 / inertia, 8e6 * 0.1**2 / inertia]
        np.testing.assert_allclose(values, np.sort(np.sqrt(squares)), rtol=1e-6)


@pytest.mark.long
def test_a_tilt_is_smooth_at_zero_and_depends_on_the_angle_alone():
    spring = compliant_spring(SprungDirection("tilt", ("R_x", "R_z"), 3.0, 0.0), (0, 1), (0, 1), ())
    zero = jnp.zeros(2)
    np.testing.assert_allclose(jax.hessian(spring.energy)(zero), 3.0 * np.eye(2), atol=1e-14)
    np.testing.assert_allclose(jax.jacrev(spring.along)(zero, zero), -3.0 * np.eye(2), atol=1e-14)
    p, s = 0.3, -0.4
    angle = np.arccos(np.cos(p) * np.cos(s))
    at = jnp.asarray([p, s])
    np.testing.assert_allclose(spring.energy(at), 1.5 * angle**2, rtol=1e-14)
    np.testing.assert_allclose(spring.along(at, zero), -jax.grad(spring.energy)(at), rtol=1e-12)
    # Across the border of the power series.
    for angle in (0.03162, 0.03164):
        np.testing.assert_allclose(spring.energy(jnp.asarray([angle, 0.0])), 1.5 * angle**2, rtol=1e-14)
    cut = compliant_spring(SprungDirection("tilt", ("R_x", "R_z"), 3.0, 0.0), (), (), (0, 1))
    rows = 0.2 * jnp.asarray([np.sin(0.1), 0.0])
    np.testing.assert_allclose(cut.energy_in_rows(rows, jnp.asarray(0.2)), 1.5 * 0.1**2, rtol=1e-12)
    force = cut.in_rows(rows, 0.0 * rows, jnp.asarray(0.2))
    np.testing.assert_allclose(force, -jax.grad(cut.energy_in_rows)(rows, jnp.asarray(0.2)), rtol=1e-12)


class TestDrives:
    ARM: ClassVar = [Link("arm", 0.2, BAR, STEEL, rigid=True)]

    @pytest.mark.slow
    def test_a_prescribed_angle_where_the_tilt_is_rigid(self):
        """At a constant rate the bearing carries the centripetal force, and gives by it over the stiffness."""
        bearing = Compliance(radial=1e5, axial=1e5, radial_damping=60.0)
        made = Mechanism(self.ARM, [Joint("A", "base", "arm", compliance=bearing)], driven_joint="A", gravity=(0, 0, 0))
        model = discretise(made)
        method = RungeKutta4(step=2e-5)
        run = simulate(Simulation(model, drive=PrescribedRate("A", 20.0), duration=0.1, method=method, save_every=0.05))
        assert int(run.status) == 0
        np.testing.assert_allclose(run.motion.angle, 20.0 * np.asarray(run.times), rtol=1e-9)
        force = 0.157 * 20.0**2 * 0.1 / (1.0 - 0.157 * 20.0**2 / 1e5)
        np.testing.assert_allclose(run.loads["A"].force[-1], [-force, 0.0, 0.0], rtol=1e-6, atol=1e-4)
        assert float(run.checks.hinge_moment_error) < 1e-9 and float(run.checks.momentum_balance_error) < 1e-9

    def test_a_prescribed_angle_of_a_joint_whose_tilt_is_sprung_is_refused(self):
        joints = [Joint("A", "base", "arm", compliance=Compliance(tilt=1e4))]
        model = discretise(Mechanism(self.ARM, joints, driven_joint="A"))
        with pytest.raises(
            InputError, match="the angle of a joint whose tilt is sprung or has play, but prescribes that of `A`"
        ):
            simulate(Simulation(model, drive=PrescribedRate("A", 1.0), duration=0.1, method=RungeKutta4(step=1e-4)))


@pytest.mark.long
def test_derivatives_of_a_motion_with_respect_to_error_and_stiffness():
    """A rod between two bearings, one of them cut: an implicit step has both kinds of springs."""
    first = Compliance(radial=1e5, tilt=50.0, tilt_damping=0.01)
    joints = [
        Joint("A", "base", "arm", compliance=first),
        Joint("C", "base", "arm", kind="spherical", position=(0.2, 0.0, 0.0), cut=True,
              compliance=Compliance(T_x=2e4, T_y=1e4, T_y_damping=20.0)),
    ]  # fmt: skip
    model = discretise(Mechanism(TestDrives.ARM, joints, driven_joint="A"))
    method = GeneralisedAlpha(step=1e-3, tolerance=1e-12, corrections=12)

    def end(values):
        errors = assembly_errors(model, {"A.delta_z": values[0]})
        made = eqx.tree_at(lambda m: [m.springs["C.T_y"].stiffness, m.springs["A.tilt"].stiffness],
                           model, [values[1], values[2]])  # fmt: skip
        run = simulate(Simulation(made, drive=None, duration=0.01, method=method, save_every=0.01), errors=errors)
        return jnp.stack([run.metrics.mean_square_moment["A"], run.metrics.mean_square_force["C"]])

    at = np.array([5e-3, 1e4, 50.0])
    check_derivatives(end, at, 1e-4 * at, reverse=1e-8, differences=2e-4)
