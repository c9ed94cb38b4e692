"""How a simulation starts: as the description says or in equilibrium, which coordinates are held, at which rates."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    Compliance,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointSpring,
    Link,
    Mechanism,
    MomentTable,
    PointMass,
    PrescribedRate,
    RigidBody,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    describe,
    design,
    discretise,
    load_study,
    parameters,
    run_cases,
    simulate,
)
from rfem_jax.report.contents.files import start_of, write_files
from rfem_jax.report.contents.summary import summarise
from rfem_jax.simulation.stages import integration
from rfem_jax.simulation.unfinished import Unfinished
from tests.mechanisms import (
    chain_of_kinds,
    compliant_four_bar,
    four_bar,
    link,
    loop_with_a_ball,
    open_chain,
    three_link_loop,
    two_loop_six_bar,
)
from tests.study_texts import STEEL, hinge, rectangle
from tests.study_texts import link as study_link

IMPLICIT = GeneralisedAlpha(step=1e-3, corrections=9, tolerance=1e-14)


def undriven(mechanism):
    return dataclasses.replace(mechanism, driven_joint=None)


def held(mechanism):
    """Names of all coordinates that the start holds."""
    start = describe(discretise(mechanism)).start
    return (*start.driven, *start.undriven)


def rod(name, length):
    """A slender rod of 1 kg/m."""
    return Link(name, length, body=RigidBody(length, (length / 2.0, 0, 0), (1e-6, length**3 / 12.0, length**3 / 12.0)))


def falling(**more):
    """Four slender rods of 1 m, 2 m and sqrt 2 m, the first one upright, that fall."""
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2, **more),
        Joint("B", "crank", "coupler", angle=np.pi / 2),
        Joint("D", "base", "rocker", position=(1.0, 0, 0), angle=-np.pi / 4),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    links = [rod("crank", 1.0), rod("coupler", 2.0), rod("rocker", np.sqrt(2.0))]
    return Mechanism(links, joints, redundant_reactions="minimum_norm")


class TestWithoutADrive:
    @pytest.mark.long
    def test_rods_fall_from_where_they_are(self):
        """The equilibrium, at which it started once, has other forces and does not move."""
        model = discretise(falling())
        settings = {"duration": 0.1, "method": RungeKutta4(step=2e-3), "save_every": 0.1}
        run = simulate(Simulation(model, drive=None, **settings))
        assert int(run.status) == 0
        np.testing.assert_allclose(run.motion.angles["A"][0], -np.pi / 2, rtol=0, atol=1e-14)
        forces = {name: float(jnp.linalg.norm(run.loads[name].force[0])) for name in "ABCD"}
        assert forces == pytest.approx({"A": 18.218, "B": 8.513, "C": 12.121, "D": 22.030}, abs=6e-4)
        assert float(run.checks.energy_balance_error) < 1e-9 and float(run.energy.kinetic[-1]) > 0.1
        # A moment drive that gives nothing is the same mechanism: it always held what it drives.
        driven = discretise(dataclasses.replace(falling(), driven_joint="A"))
        other = simulate(Simulation(driven, drive=MomentTable("A", [0.0, 1.0], [0.0, 0.0]), **settings))
        np.testing.assert_allclose(run.motion.angles["D"], other.motion.angles["D"], rtol=0, atol=1e-12)

    @pytest.mark.long
    def test_an_equilibrium_is_there_for_who_asks(self):
        model = discretise(falling())
        run = simulate(Simulation(model, drive=None, duration=0.01, method=RungeKutta4(step=5e-3), start="equilibrium"))
        np.testing.assert_allclose(run.motion.angles["A"], np.radians(-117.3), rtol=0, atol=2e-3)
        assert float(run.energy.kinetic[-1]) < 1e-20
        same = discretise(dataclasses.replace(falling(), start="equilibrium"))
        other = simulate(Simulation(same, drive=None, duration=0.01, method=RungeKutta4(step=5e-3)))
        np.testing.assert_array_equal(run.motion.angles["A"], other.motion.angles["A"])
        back = simulate(Simulation(same, drive=None, duration=0.01, method=RungeKutta4(step=5e-3), start="as_given"))
        np.testing.assert_allclose(back.motion.angles["A"][0], -np.pi / 2, rtol=0, atol=1e-14)

    @pytest.mark.long
    def test_a_flexible_bar_sags_and_is_let_go(self):
        """Its preload is a cantilever's, moment of the hold included; loads of the first instant are of the bar that
        falls: no moment about the hinge, a quarter of the weight at a rigid one."""
        length, density = 0.5, 7850.0 * 1e-4
        model = discretise(Mechanism([link("bar", length, 5)], [Joint("A", "base", "bar", angle=0.0)]))
        made = assemble(model, assembly_errors(model), hold="as_given")
        weight = density * length * 9.81
        np.testing.assert_allclose(made.state.position.joints, [0.0], atol=1e-15)
        np.testing.assert_allclose(np.abs(made.preload["A"].moment[1]), weight * length / 2.0, rtol=1e-4)
        tip = weight * length**3 / (8.0 * 210e9 * 1e-8 / 12.0)
        np.testing.assert_allclose(-made.state.position.elastic[2, -1], tip, rtol=0.15)  # of the middle of the last rfe
        run = simulate(Simulation(model, drive=None, duration=1e-3, method=IMPLICIT, save_every=1e-3))
        np.testing.assert_allclose(run.preload["A"].moment, made.preload["A"].moment, rtol=1e-12)
        assert abs(float(run.loads["A"].moment[0, 1])) < 1e-9 * weight * length
        np.testing.assert_allclose(run.motion.angles["A"][0], 0.0, atol=1e-15)
        rigid = discretise(Mechanism([link("bar", length)], [Joint("A", "base", "bar", angle=0.0)]))
        run = simulate(Simulation(rigid, drive=None, duration=1e-3, method=IMPLICIT, save_every=1e-3))
        np.testing.assert_allclose(np.linalg.norm(run.loads["A"].force[0]), 0.25 * weight, rtol=1e-3)

    @pytest.mark.slow
    def test_a_spring_on_a_free_motion_holds_nothing(self):
        spring = JointSpring("coil", "A", stiffness=50.0)
        mechanism = Mechanism([link("bar", 0.5)], [Joint("A", "base", "bar", angle=0.3)], forces=[spring])
        model = discretise(mechanism)
        settings = {"drive": None, "duration": 2e-3, "method": IMPLICIT, "save_every": 1e-3}
        assert float(simulate(Simulation(model, **settings)).motion.angles["A"][0]) == 0.3
        resting = simulate(Simulation(model, start="equilibrium", **settings)).motion.angles["A"]
        torque = 7850.0 * 1e-4 * 0.5 * 9.81 * 0.25
        np.testing.assert_allclose(50.0 * resting, torque * np.cos(resting), rtol=1e-6)
        # None of `assemble` still finds the equilibrium of what no drive holds.
        found = assemble(model, assembly_errors(model)).state.position.joints
        np.testing.assert_allclose(found, resting[:1], rtol=1e-9)

    @pytest.mark.long
    def test_a_freedom_beside_a_drive(self):
        """Of a chain of two bars with a moment on the first hinge the second starts as given, too."""
        links, joints = (
            [rod("upper", 1.0), rod("lower", 0.5)],
            [Joint("A", "base", "upper", angle=0.2), Joint("B", "upper", "lower", angle=0.4)],
        )
        model = discretise(Mechanism(links, joints, driven_joint="A"))
        settings = {"duration": 2e-3, "method": IMPLICIT, "save_every": 1e-3}
        for drive in (MomentTable("A", [0.0, 1.0], [0.0, 0.0]), PrescribedRate("A", 0.5)):
            run = simulate(Simulation(model, drive=drive, **settings))
            assert float(run.motion.angles["B"][0]) == pytest.approx(0.4, abs=1e-14)
        settled = simulate(Simulation(model, drive=drive, start="equilibrium", **settings))
        assert float(settled.motion.angles["B"][0]) == pytest.approx(np.pi / 2 - 0.2, abs=1e-9)


class TestWhatIsHeld:
    def test_of_open_chains_and_loops(self):
        assert held(undriven(open_chain())) == ("A", "B", "C")
        assert held(open_chain()) == ("A", "B", "C")
        assert held(undriven(four_bar(2))) == ("A",)
        assert held(four_bar(2)) == ("A",)
        assert held(undriven(two_loop_six_bar())) == ("A",)
        assert held(three_link_loop()) == ()  # nothing moves: a structure settles
        everything = held(chain_of_kinds())
        assert everything == ("A", "P", "U.R_y", "U.R_z", "C.R_y", "C.T_y", "L.T_x", "L.T_z", "L.R_y", "R")

    def test_what_is_sprung_settles(self):
        assert held(undriven(compliant_four_bar(rfes=None))) == ("A",)
        bushing = Compliance(T_x=1e4, T_y=1e4, T_z=1e4, R_x=10.0, R_y=10.0, R_z=10.0)
        fixed = Joint("F", "base", "bar", kind="fixed", compliance=bushing)
        model = discretise(Mechanism([link("bar", 0.2)], [fixed]))
        assert model.topology.held_at_start == ()
        run = simulate(Simulation(model, drive=None, duration=1e-3, method=IMPLICIT, save_every=1e-3))
        assert int(run.status) == 0 and float(run.energy.kinetic[-1]) < 1e-18

    @pytest.mark.parametrize("kind", ["spherical", "free"])
    def test_of_joints_about_any_axis(self, kind):
        """A body on a ball joint, which no equilibrium search can assemble, starts as its three angles say."""
        start = (0.3, -0.2, 0.5) if kind == "spherical" else (0.1, 0.2, 0.3, 0.3, -0.2, 0.5)
        body = Link("bar", 0.2, body=RigidBody(0.5, (0.1, 0.02, 0.0), (1e-4, 2e-3, 2e-3)))
        mechanism = Mechanism([body], [Joint("S", "base", "bar", kind=kind, start=start)])
        turns = ("S.R_x", "S.R_y", "S.R_z")
        assert held(mechanism) == (turns if kind == "spherical" else ("S.T_x", "S.T_y", "S.T_z", *turns))
        run = simulate(Simulation(discretise(mechanism), drive=None, duration=2e-3, method=RungeKutta4(step=1e-3)))
        assert int(run.status) == 0
        np.testing.assert_allclose(run.motion.angles["S"][0], start[-3:], rtol=0, atol=1e-12)
        if kind == "free":
            np.testing.assert_allclose(run.loads["S"].force, 0.0, atol=1e-12)
            np.testing.assert_allclose(
                run.motion.displacements["S"][-1], [0.1, 0.2, 0.3 - 0.5 * 9.81 * 4e-6], atol=1e-9
            )

    @pytest.mark.long
    def test_an_idle_rod_is_held_with_the_rest(self):
        """A rod between two balls: its spin is held, and may have a rate, with the crank driven or not."""
        loop = loop_with_a_ball()
        joints = [dataclasses.replace(one, kind="spherical", child_orientation=(0.0, 0.0, 0.0)) if one.cut else one
                  for one in loop.joints]  # fmt: skip
        rod_loop = dataclasses.replace(loop, joints=joints, links=[rod(one.name, one.length) for one in loop.links])
        model, free = discretise(rod_loop), discretise(undriven(rod_loop))
        assert describe(free).idle == ("coupler",) and describe(free).rigid_mobility == 2
        for one in (model, free):
            assert set(one.topology.held_at_start) == {*one.topology.idle, one.topology.coordinates[0][0]}
        # Start angles are rough: both close about that of the crank.
        np.testing.assert_allclose(model.start_joints, free.start_joints, rtol=0, atol=1e-14)
        # The rod hangs along z of the crank's end.
        rates, n = [0.0, 0.0, 50.0], 2
        for mechanism in (undriven(rod_loop), rod_loop):
            spun = [dataclasses.replace(one, rates=rates) if one.name == "B" else one for one in joints]
            model = discretise(dataclasses.replace(mechanism, joints=spun))
            start = integration.prepare(model, assembly_errors(model), None, None).state
            of_ball = list(model.topology.own_coordinates[model.topology.joints.index("B")])
            assert float(start.velocity.joints[of_ball[n]]) == pytest.approx(50.0)
            # The rod alone turns: crank and rocker stand still.
            others = np.delete(np.asarray(start.velocity.joints), of_ball)
            np.testing.assert_allclose(others, 0.0, atol=1e-9)
        rates = [50.0, 0.0, 50.0]
        with pytest.raises(
            InputError, match="`rates` of joint `B` must be of a motion that can be chosen, but follows"
        ):
            wrong = [dataclasses.replace(one, rates=rates) if one.name == "B" else one for one in joints]
            discretise(dataclasses.replace(rod_loop, joints=wrong))

    def test_independent_of_names_and_well_conditioned(self):
        """Renamed and turned about, the first in the file; near a dead centre of the crank the rocker."""
        loop = undriven(four_bar(None, redundant_reactions="minimum_norm"))
        new = dict(zip("ABCD", "zyxw", strict=True))
        renamed = dataclasses.replace(
            loop, joints=[dataclasses.replace(one, name=new[one.name]) for one in loop.joints]
        )
        assert held(loop) == ("A",) and held(renamed) == ("z",)
        backwards = dataclasses.replace(loop, joints=loop.joints[::-1])
        assert held(backwards) == ("D",)
        # Crank and coupler nearly in line: the rocker hardly moves while the crank turns, and determines it badly.
        reach = 0.4199
        inner = np.arccos((0.3**2 + reach**2 - 0.3**2) / (2.0 * 0.3 * reach))
        outer = np.pi - np.arccos((0.3**2 + 0.3**2 - reach**2) / (2.0 * 0.3 * 0.3))
        starts = {"A": -inner, "B": 0.05, "D": -outer}
        joints = [dataclasses.replace(one, angle=starts.get(one.name)) for one in backwards.joints]
        assert held(dataclasses.replace(backwards, joints=joints)) == ("B",)

    def test_the_file_counts_where_other_angles_are_rough(self):
        """Loops close about the angle that is held, not by the least change of all."""
        joints = [
            dataclasses.replace(one, angle=round(one.angle, 1)) if one.name in "BD" else one
            for one in four_bar().joints
        ]
        model = discretise(undriven(dataclasses.replace(four_bar(), joints=joints)))
        exact = discretise(undriven(four_bar()))
        assert float(model.start_joints[0]) == pytest.approx(-np.pi / 2, abs=1e-15)
        np.testing.assert_allclose(model.start_joints, exact.start_joints, rtol=0, atol=1e-12)


class TestRates:
    @pytest.mark.long
    def test_others_follow(self):
        """Rates of a falling four-bar by the rate of its crank: those of the closure equations, at every joint."""
        model = discretise(falling(rate=2.0))
        run = simulate(Simulation(model, drive=None, duration=0.02, method=RungeKutta4(step=1e-3), save_every=1e-3))
        assert int(run.status) == 0 and float(run.checks.energy_balance_error) < 1e-9
        prepared = integration.prepare(model, assembly_errors(model), None, None)
        rates = np.asarray(prepared.state.velocity.joints)
        later = {name: np.asarray(run.motion.angles[name]) for name in "ADB"}
        order = [model.topology.joints.index(name) for name in "ADB"]
        for name, k in zip("ADB", order, strict=True):
            h, x = 1e-3, later[name]
            slope = (-25 * x[0] + 48 * x[1] - 36 * x[2] + 16 * x[3] - 3 * x[4]) / (12 * h)
            assert slope == pytest.approx(rates[k], abs=1e-6)
        assert rates[order[0]] == pytest.approx(2.0, rel=1e-12)
        # The rate decides which coordinate is held.
        joints = [
            dataclasses.replace(one, rate=rates[order[1]]) if one.name == "D" else one for one in falling().joints
        ]
        other = discretise(dataclasses.replace(falling(), joints=joints))
        assert describe(other).start.undriven == ("D",)
        same = integration.prepare(other, assembly_errors(other), None, None).state.velocity.joints
        np.testing.assert_allclose(same, rates, rtol=1e-12)

    @pytest.mark.slow
    def test_of_a_flexible_bar(self):
        """Quasi-static: the whole bar turns about the hinge, with the change of its sag."""
        joint = Joint("A", "base", "bar", angle=0.0, rate="60 rpm")
        model = discretise(Mechanism([link("bar", 0.5, 4)], [joint]))
        run = simulate(Simulation(model, drive=None, duration=1e-3, method=IMPLICIT, save_every=1e-3))
        inertia = 7850.0 * 1e-4 * 0.5**3 / 3.0
        assert float(run.energy.kinetic[0]) == pytest.approx(0.5 * inertia * (2.0 * np.pi) ** 2, rel=1e-2)

    @pytest.mark.long
    def test_lists_and_slides(self):
        body = Link("ball", 0.2, body=RigidBody(0.5, (0, 0, 0), (1e-3, 1e-3, 1e-3)))
        rates = ["1 m/s", 0, "2 m/s", "60 rpm", 0, 1.0]
        free = Joint("F", "base", "ball", kind="free", start=[0, 0, 1.0, 0, 0, 0], rates=rates)
        model = discretise(Mechanism([body], [free]))
        run = simulate(Simulation(model, drive=None, duration=0.2, method=RungeKutta4(step=0.1), save_every=0.1))
        t = np.asarray(run.times)
        expected = np.stack([t, 0.0 * t, 1.0 + 2.0 * t - 0.5 * 9.81 * t**2], axis=1)
        np.testing.assert_allclose(run.motion.displacements["F"], expected, rtol=0, atol=1e-12)
        assert float(run.energy.kinetic[0]) == pytest.approx(0.25 * 5.0 + 0.5e-3 * (4.0 * np.pi**2 + 1.0))
        slide = Joint("G", "base", "ball", kind="prismatic", displacement=0.1, speed="0.5 m/s")
        model = discretise(Mechanism([body], [slide]))
        run = simulate(Simulation(model, drive=None, duration=0.2, method=RungeKutta4(step=0.1), save_every=0.1))
        np.testing.assert_allclose(run.motion.displacements["G"], 0.1 + 0.5 * t, rtol=0, atol=1e-12)

    def test_beside_a_moment(self):
        """A flywheel that turns already when its moment begins."""
        wheel = Link("wheel", 0.2, body=RigidBody(1.0, (0, 0, 0), (0.1, 0.2, 0.1)))
        model = discretise(Mechanism([wheel], [Joint("A", "base", "wheel", rate=3.0)], driven_joint="A"))
        drive = MomentTable("A", [0.0, 1.0], [0.4, 0.4])
        run = simulate(Simulation(model, drive=drive, duration=0.1, method=RungeKutta4(step=0.05), save_every=0.05))
        np.testing.assert_allclose(run.motion.rate, 3.0 + 2.0 * np.asarray(run.times), rtol=1e-12)
        with pytest.raises(InputError, match=r"must not prescribe .* initial rate.*leave out the rate"):
            simulate(Simulation(model, drive=PrescribedRate("A", 1.0), duration=0.1, method=RungeKutta4(step=0.05)))

    def test_refused(self):
        joints = [dataclasses.replace(one, rate=1.0) if one.name in "AD" else one for one in falling().joints]
        with pytest.raises(InputError, match=r"`rate` of joint `D` .* follows from `A`; leave it out"):
            discretise(dataclasses.replace(falling(), joints=joints))
        only = [one if one.name == "D" else dataclasses.replace(one, rate=None) for one in joints]
        with pytest.raises(InputError, match=r"`rate` of joint `D` .* follows from `A`"):
            discretise(dataclasses.replace(falling(), joints=only, driven_joint="A"))
        with pytest.raises(InputError, match="joint `C` must be left out because the joint is cut"):
            Joint("C", "a", "b", cut=True, rate=1.0)
        with pytest.raises(InputError, match="`speed` of joint `C` must be left out because the joint is revolute"):
            Joint("C", "a", "b", speed=1.0)
        with pytest.raises(InputError, match=r"`rates` of joint `C` must be a list of 3 numbers"):
            Joint("C", "a", "b", kind="planar", rates=[1.0])
        with pytest.raises(InputError, match='must be "as_given" where joints have initial rates'):
            dataclasses.replace(falling(rate=1.0), start="equilibrium")
        with pytest.raises(InputError, match='must be "as_given" where joints have initial rates'):
            simulate(
                Simulation(
                    discretise(falling(rate=1.0)), drive=None, duration=0.1, method=IMPLICIT, start="equilibrium"
                )
            )
        with pytest.raises(InputError, match="did you mean `equilibrium`"):
            simulate(Simulation(discretise(falling()), drive=None, duration=0.1, method=IMPLICIT, start="equilibrum"))


class TestWhyNot:
    """A start that is not found says which of its causes it was."""

    def status(self, model, errors=None, **more):
        return STATUS[int(assemble(model, assembly_errors(model, errors or {}), **more).status)]

    @pytest.mark.long
    def test_a_loop_in_which_nothing_gives(self):
        loop = four_bar(None, redundant_reactions="minimum_norm")
        for error in ("D.delta_x", "D.d_y", "B.child.delta_z"):
            found = self.status(discretise(loop), {error: 1e-3})
            assert found.name == "cannot_close" and "links flexible" in found.message
        assert self.status(discretise(loop), {"D.d_x": 1e-3}).name == "ok"
        # What gives closes it; what gives too far is another cause.
        assert self.status(discretise(compliant_four_bar(rfes=None)), {"D.d_y": 1e-3}).name == "ok"
        assert self.status(discretise(four_bar(2)), {"D.d_x": 0.5}).name == "not_assembled"

    @pytest.mark.slow
    def test_a_freedom_that_nothing_holds(self):
        body = Link("bar", 0.2, body=RigidBody(0.5, (0.1, 0.02, 0.0), (1e-4, 2e-3, 2e-3)))
        for joint in (
            Joint("S", "base", "bar", kind="spherical", start=(0.3, -0.2, 0.5)),
            Joint("G", "base", "bar", kind="prismatic", orientation=(0.0, 0.5, 0.0)),
        ):
            model = discretise(Mechanism([body], [joint]))
            found = self.status(model)
            assert found.name == "no_equilibrium" and 'start = "as_given"' in found.message
            assert self.status(model, hold="as_given").name == "ok"


def ends(model, names, numbers):
    """Loads and angles soon after the start by errors and numbers of the design."""

    def function(values):
        errors = assembly_errors(model, dict(zip(names, values[: len(names)], strict=True)))
        wanted = design(model, dict(zip(numbers, values[len(names) :], strict=True)))
        run = simulate(
            Simulation(model, drive=None, duration=1e-3, method=IMPLICIT, save_every=1e-3, design=wanted), errors
        )
        loads = [run.loads[name].force[-1] for name in model.joint_names]
        return jnp.concatenate(
            [*loads, run.preload["D"].moment, jnp.stack([run.motion.angles[name][-1] for name in "ABD"])]
        )

    return function


class TestDerivatives:
    @pytest.mark.long
    def test_by_errors_and_design_in_both_modes(self):
        joints = [dataclasses.replace(one, rate=5.0) if one.name == "A" else one for one in four_bar(2).joints]
        model = discretise(undriven(dataclasses.replace(four_bar(2), joints=joints)))
        names, numbers = ["D.delta_x", "B.d_z"], ["coupler.length", "A.rate"]
        at, steps = jnp.asarray([2e-3, 1e-4, 0.3001, 5.2]), np.array([1e-5, 1e-6, 1e-6, 1e-3])
        function = eqx.filter_jit(ends(model, names, numbers))
        forward, backward = (np.asarray(mode(function)(at)) for mode in (jax.jacfwd, jax.jacrev))
        size = np.abs(forward).max(axis=0)
        np.testing.assert_allclose(forward / size, backward / size, rtol=1e-6, atol=1e-9)
        assert size.min() > 0.0
        for k, h in enumerate(steps):
            one = np.eye(4)[k] * h
            pairs = [(function(at + n * one) - function(at - n * one)) / (2 * n * h) for n in (1, 2)]
            expected = (4.0 * pairs[0] - pairs[1]) / 3.0
            np.testing.assert_allclose(forward[:, k], expected, rtol=1e-4, atol=2e-5 * size[k])
        # The crank stands where the description says, whatever the design and the errors.
        zero = assemble(model, assembly_errors(model), hold="as_given", design=design(model, {"coupler.length": 0.31}))
        assert float(zero.state.position.joints[0]) == pytest.approx(-np.pi / 2, abs=1e-14)


@pytest.mark.slow
def test_new_numbers_do_not_retrace_and_batches_start_each_on_its_own():
    model = discretise(undriven(four_bar(2)))
    traced = eqx.debug.assert_max_traces(integration.prepare, max_traces=1)
    prepare = eqx.filter_jit(traced)
    for tilt in (0.0, 1e-3):
        for angle in (-np.pi / 2, -1.5):
            moved = eqx.tree_at(lambda m: m.start_joints, model, model.start_joints.at[0].set(angle))
            prepare(moved, assembly_errors(model, {"D.delta_x": tilt}), None, None)
    runs = eqx.filter_vmap(
        lambda tilt: integration.prepare(model, assembly_errors(model, {"D.delta_x": tilt}), None, None)
    )(jnp.asarray([0.0, 1e-3, np.nan]))
    assert np.asarray(runs.status).tolist()[:2] == [0, 0] and int(runs.status[2]) != 0
    np.testing.assert_allclose(runs.state.position.joints[:2, 0], -np.pi / 2, atol=1e-14)


@pytest.mark.slow
def test_point_masses_hang_where_they_are_told():
    """A pendulum of a mass and a massless-looking rod on a universal joint: both angles are held."""
    bob = Link("bob", 0.4, body=RigidBody(0.01, (0.2, 0, 0), (1e-6, 1e-4, 1e-4)), point_masses=[PointMass(1.0, 0.4)])
    model = discretise(Mechanism([bob], [Joint("U", "base", "bob", kind="universal", start=(0.4, 0.2))]))
    run = simulate(Simulation(model, drive=None, duration=2e-3, method=RungeKutta4(step=1e-3), save_every=1e-3))
    np.testing.assert_allclose(run.motion.angles["U"][0], [0.4, 0.2], atol=1e-14)


FILE = f"""
title = "A bar falls"
{STEEL}
{rectangle()}
{study_link("bar", 0.5)}
{hinge("bar", "angle = '30 deg'")}
[simulation]
duration = 0.01
method = "rk4"
step = 5e-3
"""


class TestStudyFiles:
    def study(self, tmp_path, *changes):
        text = FILE
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "study.toml"
        path.write_text(text, encoding="utf-8")
        return load_study(path)

    @pytest.mark.long
    def test_runs_say_what_their_start_held(self, tmp_path):
        wanted = {
            "as_given": ((), np.radians(30.0), ["A"]),
            "equilibrium": ((("[simulation]", '[simulation]\nstart = "equilibrium"'),), np.pi / 2, []),
        }
        digests = set()
        for kind, (changes, angle, undriven) in wanted.items():
            study = self.study(tmp_path, *changes)
            model, runs = run_cases(study)
            np.testing.assert_allclose(runs["nominal"].motion.angles["A"][0], angle, rtol=1e-9)
            summaries = summarise(study, runs, {"nominal": ("ok", "")})
            write_files(tmp_path, study, runs, summaries, start_of(runs))
            written = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["start"]
            assert written == {"kind": kind, "driven": [], "undriven": undriven, "rates": []}
            # What an interrupted simulation leaves is of one start.
            digests.add(Unfinished(tmp_path / "left.npz", (model, study.duration)).digest)
        assert len(digests) == 2

    def test_initial_rates(self, tmp_path):
        study = self.study(tmp_path, ("angle =", "rate = '10 rpm'\nangle ="))
        assert study.mechanism.joint("A").rate == pytest.approx(np.pi / 3)
        model = discretise(study.mechanism)
        assert parameters(model)["A.rate"].value == pytest.approx(np.pi / 3)
        # Other numbers of rates are the same program.
        other = discretise(self.study(tmp_path, ("angle =", "rate = 7.0\nangle =")).mechanism)
        assert jax.tree.structure(model) == jax.tree.structure(other)

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            (("[simulation]", '[simulation]\nstart = "equilibriun"'), "did you mean `equilibrium`"),
            (("angle =", "rate = '1 m/s'\nangle ="), "`rate` of joint `A` must be"),
            (
                ("angle =", "speed = 1.0\nangle ="),
                "`speed` of joint `A` must be left out because the joint is revolute",
            ),
            (("angle =", "rates = [1.0]\nangle ="), "`rates` of joint `A` must be left out .* give `rate`"),
            (
                ("[simulation]", '[drive]\njoint = "A"\nkind = "prescribed_rate"\nrate = 1.0\n[simulation]'),
                "`rate` of joint `A` must be left out where a drive prescribes this motion",
            ),
            (
                ("[simulation]", '[simulation]\nstart = "equilibrium"'),
                'must be "as_given" where joints have initial rates',
            ),
        ],
    )
    def test_refused(self, tmp_path, change, sentence):
        rate = [] if change[0] == "angle =" else [("angle =", "rate = 2.0\nangle =")]
        with pytest.raises(InputError, match=sentence) as caught:
            self.study(tmp_path, *rate, change)
        assert str(caught.value).count("\n") == 0
