"""Benchmarks of joints of other kinds than revolute; `rfem-jax validate` also computes those with flexible links."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from rfem_jax import assemble, assembly_errors, discretise
from rfem_jax.validation import (
    acting_forces,
    andrews_squeezer,
    bennett_loop,
    clearances,
    flexible_slider_crank,
    force_tables,
    geared_mechanisms,
    impacts,
    joint_cases,
    joint_tables,
    nonideal_joints,
    published_linkages,
    slider_cranks,
    spatial_linkages,
    spinning_bodies,
)
from rfem_jax.validation.lines import NOT_MET, PASS
from tests.validation.test_benchmarks import assert_all_pass, computed


def failed(lines):
    return [line.name for line in lines if line.verdict != PASS]


def test_spinning_bodies():
    assert_all_pass(computed(spinning_bodies.validate), 5)
    assert np.degrees(spinning_bodies.nutating_top()[2].max()) > 160.0


def test_a_top_of_slightly_other_inertia_fails(monkeypatch):
    monkeypatch.setattr(spinning_bodies, "AXIAL", 1.00001 * spinning_bodies.AXIAL)
    _, known, _ = spinning_bodies.nutating_top()
    monkeypatch.undo()
    run, right, _ = spinning_bodies.nutating_top()
    found = spinning_bodies.rotations(run)
    assert spinning_bodies.turned(found, right).max() < spinning_bodies.TURNED
    assert spinning_bodies.turned(found, known).max() > 10.0 * spinning_bodies.TURNED


@pytest.mark.slow
def test_rigid_slider_crank():
    run = slider_cranks.run_rigid()
    lines = joint_cases.checked(slider_cranks.REFERENCE, "rigid", "", run, slider_cranks.RIGID)
    assert_all_pass(lines, 14)
    assert float(run.checks.energy_balance_error) < 1e-8
    assert float(run.checks.momentum_balance_error) < 1e-12
    assert float(run.checks.hinge_moment_error) < 1e-12


@pytest.mark.slow
def test_gas_force():
    run = acting_forces.run_gas()
    assert_all_pass(acting_forces.gas_lines(run), 8)
    assert float(run.checks.energy_balance_error) < 1e-6
    # Moment about the wrist pin, from that about the guide's point.
    at = int(np.argmin(np.abs(np.asarray(run.times) - 0.0261799387799)))
    about_pin = run.loads["G"].moment[at] + np.cross([0.02, 0.0, 0.008], run.loads["G"].force[at])
    np.testing.assert_allclose(about_pin[1], 2.22659110509, rtol=1e-7)


def test_gears(monkeypatch):
    assert_all_pass(geared_mechanisms.lines(geared_mechanisms.run_five_bar()), 24)
    monkeypatch.setattr(geared_mechanisms, "TURN", 1.00001 * geared_mechanisms.TURN)
    assert len(failed(geared_mechanisms.lines(geared_mechanisms.run_five_bar()))) > 20


def test_spring_and_forces_at_points(monkeypatch):
    run = acting_forces.run_pendulum()
    assert_all_pass(acting_forces.pendulum_lines(run), 13)
    assert float(run.checks.energy_balance_error) < 1e-6 and float(run.checks.momentum_balance_error) < 1e-9
    monkeypatch.setattr(acting_forces, "ANGLE", 1.00001 * acting_forces.ANGLE)
    assert len(failed(acting_forces.pendulum_lines(acting_forces.run_pendulum()))) > 5


@pytest.mark.slow
@pytest.mark.parametrize("case, count", [("RSSR", 14), ("RSUR rigid", 22), ("RSRC", 27), ("RSUP", 20)])
def test_rigid_spatial_linkages(case, count):
    run = spatial_linkages.rigid_runs()[case][1]()
    assert int(run.status) == 0
    assert_all_pass(spatial_linkages.rigid_lines(case, run), count)
    if case == "RSRC":
        assert np.isnan(run.metrics.max_axial_force["F"]) and np.isfinite(run.metrics.max_axial_force["D"])


@pytest.mark.slow
def test_flexible_linkages_at_rest():
    """The slider-crank without one of its errors fails."""
    model = discretise(slider_cranks.flexible())
    for left_out in (None, "C.delta_z"):
        errors = {name: value for name, value in slider_cranks.ERRORS.items() if name != left_out}
        preload = assemble(model, assembly_errors(model, errors)).preload
        lines = joint_cases.preload_lines(slider_cranks.REFERENCE, "moment", "", preload, 1e-8)
        assert len(lines) == 8 and (failed(lines) == []) == (left_out is None)
    linear = discretise(slider_cranks.flexible("linear"))
    preload = assemble(linear, assembly_errors(linear, slider_cranks.ERRORS)).preload
    for case, count in (("linear", 0), ("moment", 8)):
        lines = joint_cases.preload_lines(slider_cranks.REFERENCE, case, "", preload, 1e-8)
        assert len(lines) == 8 and len(failed(lines)) == count


def test_derivatives_that_are_off_fail():
    known = {load: slider_cranks.REFERENCE[f"d_mean_square_{load}"] for load in ("force", "moment")}
    lines = slider_cranks.derivative_lines(known)
    assert len(lines) == 10 and failed(lines) == []
    off = {**known["moment"], "G.d_y": {**known["moment"]["G.d_y"], "B": 428059.0}}
    lines = slider_cranks.derivative_lines({**known, "moment": off})
    assert failed(lines) == ["mean square moment of B by G.d_y"]


@pytest.mark.slow
def test_the_published_equations_of_the_elastic_rod(monkeypatch):
    """Without their quadratic strain; and with it the deflection is a quarter larger."""
    found = flexible_slider_crank.published_motion()
    assert_all_pass(flexible_slider_crank.published_lines(found), 4)
    stiffened, published = flexible_slider_crank.theory()[-1], found[-1, 1]
    assert 1.2 < stiffened / published < 1.26
    monkeypatch.setattr(flexible_slider_crank, "SLIDER", 1.001 * flexible_slider_crank.SLIDER)
    changed = flexible_slider_crank.published_lines(flexible_slider_crank.published_motion())
    assert "deflection, sine 1 at 0.1 s" in failed(changed)


@pytest.mark.slow
def test_elastic_rod():
    """All is met but the published deflection, whose model has no quadratic strain."""
    lines = computed(flexible_slider_crank.validate)
    missed = [line for line in lines if line.verdict != PASS]
    assert len(lines) == 8 and [line.name for line in missed] == ["deflection at 0.1 s"]
    assert missed[0].verdict == NOT_MET and 0.15 < missed[0].difference / missed[0].reference < 0.3


def test_flywheel_with_friction(monkeypatch):
    assert_all_pass(nonideal_joints.wheel_lines(), 5)
    monkeypatch.setattr(nonideal_joints, "COULOMB", 1.0001 * nonideal_joints.COULOMB)
    assert failed(nonideal_joints.wheel_lines()) == ["angle at 4 s, at rest"]


@pytest.mark.slow
@pytest.mark.parametrize("case, count", [("constant", 14), ("by load", 14), ("bushings", 13)])
def test_joints_that_are_not_ideal(case, count):
    group, run, allowed = nonideal_joints.CASES[case]
    assert_all_pass(joint_cases.checked(nonideal_joints.REFERENCE, case, group, run(), allowed), count)


@pytest.mark.slow
def test_pins_pressed_at_rest(monkeypatch):
    """A stiffness that is off by a thousandth fails."""
    assert_all_pass(clearances.pressed_lines(), 21)
    monkeypatch.setattr(clearances, "HERTZ", 1.001 * clearances.HERTZ)
    wrong = {"penetration, start", "penetration, end", "place z, start", "place z, end"}
    assert wrong == set(failed(clearances.pressed_lines()))


@pytest.mark.slow
@pytest.mark.parametrize("cut", [False, True])
def test_misaligned_shaft(monkeypatch, cut):
    """A bush that is tilted by a little more fails."""
    model = clearances.shaft(cut)
    assert_all_pass(clearances.shaft_lines(model), 18)
    monkeypatch.setattr(clearances, "ARM", 1.00001 * clearances.ARM)
    assert len(failed(clearances.shaft_lines(model))) == 4


class TestFourBarWithPlay:
    @pytest.mark.slow
    def test_preload(self, monkeypatch):
        """One that is tilted by a little more fails."""
        model = discretise(clearances.flexible_four_bar())
        for case, number in (("tilt_z", 0), ("tilt_z", 1), ("tilt_z", 3), ("all", 3), ("axial", 2), ("tilt_x", 2)):
            assert_all_pass(clearances.four_bar_lines(model, case, number), 5)
        monkeypatch.setitem(clearances.MISALIGNMENTS, "tilt_z", {"D.delta_z": 1.00001 * clearances.TILT})
        assert len(failed(clearances.four_bar_lines(model, "tilt_z", 1))) == 5

    @pytest.mark.slow
    def test_cut_at_the_bush(self):
        model = discretise(clearances.flexible_four_bar(cut=True))
        assert_all_pass(clearances.four_bar_lines(model, "all", 3), 5)


@pytest.mark.slow
def test_single_impacts(monkeypatch):
    """A pin that is heavier by a thousandth fails."""
    restored, damped = impacts.run_impact(restitution=0.9), impacts.run_impact(damping=impacts.DAMPING)
    assert int(restored.status) == int(damped.status) == 0
    assert_all_pass(impacts.restitution_lines(restored), 7)
    assert_all_pass(impacts.damping_lines(damped), 3)
    assert float(damped.checks.energy_balance_error) < 1e-8
    monkeypatch.setattr(impacts, "MASS", 1.001 * impacts.MASS)
    for lines in (impacts.restitution_lines(restored), impacts.damping_lines(damped)):
        assert failed(lines) == ["rebound speed"]


@pytest.mark.parametrize(
    "case", [impacts.FAST, pytest.param(impacts.SLOW, marks=pytest.mark.slow)], ids=lambda case: case.name
)
def test_first_impacts_of_a_slider_crank_with_play(case):
    run = impacts.run_slider_crank(case)
    assert int(run.status) == 0
    assert_all_pass(impacts.slider_crank_lines(case, run), 11)
    later = eqx.tree_at(lambda one: one.times, run, run.times + 1.5 * case.allowed[0])
    assert len(failed(impacts.slider_crank_lines(case, later))) == 5


def test_contacts_between_saved_times():
    going_on = impacts.impacts_of(np.arange(6.0), np.array([-1.0, 3.0, -1.0, -1.0, 1.0, 2.0]))
    assert going_on == [(0.25, 1.75, slice(1, 2)), (3.5, 5.0, slice(4, 6))]


@pytest.mark.slow
def test_bennett_linkage():
    assert_all_pass(computed(bennett_loop.validate), 4)


@pytest.mark.slow
def test_published_linkages(monkeypatch):
    """All but the planar engine."""
    fourbars = {name: published_linkages.MODELICA[name] for name in ("Fourbar1", "Fourbar2")}
    monkeypatch.setattr(published_linkages, "MODELICA", fourbars)
    assert_all_pass(computed(published_linkages.validate), 16)


@pytest.mark.long
@pytest.mark.slow
def test_andrews_squeezer():
    """The table is met but for accelerations and forces that are not those of its angles and rates."""
    lines = computed(andrews_squeezer.validate)
    missed = [line for line in lines if line.verdict != PASS]
    assert len(lines) == 27 + 13 and all(line.verdict == NOT_MET for line in missed)
    assert {line.group for line in missed} == {"Andrews' squeezer"}
    assert not {"angle", "rate"} & {line.name.split()[0] for line in missed}
    off = {line.name.split()[0]: abs(line.difference) / line.allowed for line in missed}
    assert set(off) == {"acceleration", "force"} and max(off.values()) < 20.0


@pytest.mark.slow
def test_joint_tables(monkeypatch):
    """Tables are met but that of a universal joint which loses energy; Lagrange's equations are met there."""
    names = ("prismatic 2", "cylindrical 3", "universal 3", "spring 2")
    monkeypatch.setattr(joint_tables, "CASES", {name: joint_tables.CASES[name] for name in names})
    lines = computed(joint_tables.validate)
    table = [line for line in lines if line.group == "Adams, universal joint"]
    assert len(table) == 4 and all(line.verdict == NOT_MET for line in table)
    assert_all_pass([line for line in lines if line not in table], 13)
    monkeypatch.undo()
    kept = [joint_tables.energy_loss(name) for name in ("revolute 2", "spherical 2")]
    assert np.abs(kept).max() < 1e-5 and joint_tables.energy_loss("universal 3") < -4e-4


@pytest.mark.slow
def test_force_tables(monkeypatch):
    """Two bodies on springs by one program, and an actuator on an oblique guide.

    The motion whose table of rates is missed is that of Newton's equations; a spring softer by a thousandth fails."""
    run = force_tables.released("function 3")
    assert float(run.checks.energy_balance_error) < 1e-6
    assert_all_pass(force_tables.released_lines("function 3", run), 3)
    other = force_tables.released("function 4")
    missed = [line for line in force_tables.released_lines("function 4", other) if line.verdict != PASS]
    assert [(line.name.split()[2], line.verdict) for line in missed] == [("rate", NOT_MET)]
    assert_all_pass(force_tables.solved_lines("function 4", other), 2)
    assert_all_pass(force_tables.moved_lines("actuator 2", force_tables.moved("actuator 2")), 4)
    third = force_tables.SPRUNG["function 3"]
    softer = (0.999 * third.numbers[0], *third.numbers[1:])
    monkeypatch.setitem(force_tables.SPRUNG, "function 3", dataclasses.replace(third, numbers=softer))
    assert len(failed(force_tables.released_lines("function 3", force_tables.released("function 3")))) == 3
