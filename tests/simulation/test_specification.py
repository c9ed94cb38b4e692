"""What is simulated: `Simulation`, its refusals, and calls of the version before."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Automatic,
    GeneralisedAlpha,
    InputError,
    Mechanism,
    MomentRamp,
    PrescribedRate,
    Problem,
    Simulation,
    assemble,
    assembly_errors,
    choose_method,
    cycle_run,
    design,
    discretise,
    equations_of_motion,
    load_study,
    simulate,
    steady_cycle,
)
from tests.derivatives import check_derivatives
from tests.description.conftest import _refused as refused
from tests.mechanisms import four_bar, three_link_loop
from tests.programs.conftest import PENDULUM

METHOD = GeneralisedAlpha(step=1e-3)


@pytest.fixture(scope="module")
def model():
    return discretise(four_bar(2))


@pytest.fixture(scope="module")
def simulation(model):
    return Simulation(model, drive=MomentRamp("A", 1.5, 0.01), duration=0.01, method=METHOD, save_every=1e-3)


@pytest.mark.long
def test_the_method_is_chosen_where_none_is_given(model):
    drive = MomentRamp("A", 1.5, 0.01)
    automatic = Simulation(model, drive=drive, duration=0.05)
    assert automatic.method == Automatic()
    assert automatic.chosen == choose_method(model, Automatic(), drive, 0.05)
    assert automatic.chosen.step is not None
    assert "by generalised_alpha with steps of" in repr(automatic)
    given = dataclasses.replace(automatic, method=METHOD)
    assert given.method == given.chosen == METHOD


@pytest.mark.long
def test_the_method_is_chosen_anew_for_another_drive_or_design(model):
    """A step that was chosen for slow motion is too long for a fast one."""
    slow = Simulation(model, drive=MomentRamp("A", 1.5, 0.01), duration=0.02)
    fast = dataclasses.replace(slow, drive=MomentRamp("A", 150.0, 0.001))
    assert fast.chosen == Simulation(model, drive=fast.drive, duration=0.02).chosen != slow.chosen
    thin = design(model, {"coupler.section.height": 1e-3, "rocker.section.height": 1e-3})
    assert dataclasses.replace(slow, design=thin).chosen != slow.chosen
    with pytest.raises(InputError, match=r"method=simulation.chosen"):
        jax.jit(lambda height: dataclasses.replace(slow, design=design(model, {"coupler.section.height": height})))(
            1e-3
        )
    with pytest.raises(InputError, match=r"method=simulation.chosen"):
        jax.jit(lambda tilt: simulate(dataclasses.replace(slow, duration=0.01), {"D.delta_x": tilt}).status)(1e-3)


def test_trials_must_be_known_and_finite(model):
    settings = {"drive": MomentRamp("A", 1.5, 0.01), "duration": 0.01, "method": METHOD}
    for trials, pieces in (
        ({"D.deltax": np.ones(2)}, ("D.deltax", "D.delta_x")),
        ({"D.delta_x": np.array([np.nan, 0.0])}, ("`trials`", "finite")),
        ({"D.delta_x": 0.1}, ("`trials`", "finite")),
        ({"D.delta_x": np.array(["1 deg"])}, ("`trials`", "finite")),
        (8, ("`trials`", "int")),
    ):
        with refused(*pieces):
            Simulation(model, trials=trials, **settings)
    assert Simulation(model, trials={"D.delta_x": np.ones(2)}, **settings).chosen == METHOD


def test_a_start_in_words_belongs_to_the_model(model):
    settled = Simulation(model, drive=MomentRamp("A", 1.5, 0.01), duration=0.01, method=METHOD, start="equilibrium")
    assert settled.start is None and settled.model.topology.settles and not model.topology.settles


def test_the_simulation_of_a_study(tmp_path):
    (tmp_path / "study.toml").write_text(PENDULUM, encoding="utf-8")
    study = load_study(tmp_path / "study.toml")
    simulation = Simulation.of(study, method=METHOD, duration=0.02)
    assert simulation.drive == study.drive and simulation.save_every == study.save_every
    assert simulation.method == METHOD and simulation.duration == 0.02
    model = discretise(study.mechanism)
    assert Simulation.of(study, model=model, method=METHOD).model is model


@pytest.mark.long
def test_numbers_of_the_drive_and_of_the_design_are_traced(model, simulation):
    def force(numbers):
        height, peak = numbers
        changed = dataclasses.replace(
            simulation, drive=MomentRamp("A", peak, 0.01), design=design(model, {"coupler.section.height": height})
        )
        return simulate(changed).metrics.mean_square_force["A"]

    check_derivatives(force, [0.008, 1.5], [8e-6, 1.5e-3], reverse=1e-8, differences=1e-4)


def test_what_is_wrong_is_said(model, simulation):
    drive = MomentRamp("A", 1.5, 0.01)
    with refused("`model`", "Mechanism", "discretise"):
        Simulation(four_bar(2), drive=drive, duration=0.01)
    with refused("`method`", "RungeKutta4(step=1e-5)", "'rk4'"):
        Simulation(model, drive=drive, duration=0.01, method="rk4")
    with refused("`method`", "Explicit(diffrax.Dopri8()", "Dopri8"):
        Simulation(model, drive=drive, duration=0.01, method=diffrax.Dopri8())
    with refused("`duraton`", "did you mean `duration`?"):
        Simulation(model, drive=drive, duraton=0.01)
    with refused("`drive`", "missing"):
        Simulation(model, duration=0.01)
    with refused("by their names", "drive="):
        Simulation(model, drive, 0.01)
    with refused("`start`", "0"):
        Simulation(model, drive=drive, duration=0.01, method=METHOD, start=0)
    with refused("`design`", "dict"):
        Simulation(model, drive=drive, duration=0.01, method=METHOD, design={"coupler.section.height": 0.01})
    with refused("`error`", "did you mean `errors`?"):
        equations_of_motion(simulation, error={})
    with refused("`drive`", "driven joint"):
        Simulation(model, drive=MomentRamp("B", 1.5, 0.01), duration=0.01)
    with refused("`duration`", "missing"):
        simulate(Simulation(model, drive=drive, method=METHOD))
    for bad in (0.0, -1, np.nan, "10 mm"):
        with refused("duration"):
            Simulation(model, drive=drive, duration=bad)
    assert Simulation(model, drive=drive, duration="10 ms", method=METHOD).duration == 0.01
    with refused("D.delta_xx"):
        simulate(simulation, {"D.delta_xx": 1e-3})
    with refused("`simulation`", "`equations_of_motion`"):
        equations_of_motion(model)
    with refused("`start`", "as_given"):
        Simulation(model, drive=drive, duration=0.01, start="at rest")
    with refused("`duration`", "`simulate`", "`Simulation`"):
        simulate(simulation, duration=0.2)
    with refused("`recrod`", "`simulate`"):
        simulate(simulation, recrod="A.turning")
    with refused("`simulation`", "Mechanism"):
        simulate(four_bar(2))
    with refused("simulation and metrics"):
        Problem(simulation, "A.rms_force", method=METHOD)
    state = assemble(model, assembly_errors(model)).state
    with refused("`start`", "State"):
        Problem(dataclasses.replace(simulation, start=state), "A.rms_force")
    with pytest.raises(InputError, match="`method` of a simulation must have a step"):
        jax.jit(lambda model: simulate(Simulation(model, drive=drive, duration=0.01)).status)(model)


def test_errors_of_another_mechanism_are_refused(model, simulation):
    """Arrays of the same shape would be taken for the errors of other joints."""
    links = {"crank": "arm", "coupler": "rod", "rocker": "lever"}
    described = four_bar(2)
    others = Mechanism(
        [dataclasses.replace(link, name=links[link.name]) for link in described.links],
        [
            dataclasses.replace(joint, parent=links.get(joint.parent, joint.parent), child=links[joint.child])
            for joint in described.joints
        ],
        driven_joint="A",
    )
    of_others = assembly_errors(discretise(others), {"D.delta_x": 1e-3})
    of_three = assembly_errors(discretise(three_link_loop()), {"D.delta_x": 1e-3})
    for errors in (of_others, of_three):
        for call in (simulate, equations_of_motion):
            with refused("`errors`", "same model"):
                call(simulation, errors)
        for longer in (None, design(model, {"crank.length": 0.12})):
            with refused("`errors`", "coupler", "same model"):
                assemble(model, errors, design=longer)
    with refused("`errors`", "by their names"):
        assemble(model, 1e-3)
    # Those of a mechanism with other rfes are the same, since rfes have no errors.
    of_same_rfes = assembly_errors(discretise(four_bar(3)), {"D.delta_x": 1e-3})
    by_name = assemble(model, {"D.delta_x": 1e-3})
    assert int(by_name.status) == 0
    np.testing.assert_array_equal(by_name.preload["C"].moment, assemble(model, of_same_rfes).preload["C"].moment)


@pytest.mark.parametrize("value", [None, True, 1e-3 + 1j, [1e-3], np.array([1e-3, 2e-3])], ids=str)
def test_errors_are_real_numbers(model, value):
    for name in ("D.delta_x", "coupler.length", "steel.density"):
        with refused("`errors`", f"'{name}'", "jax.vmap"):
            assemble(model, {name: value})


def test_a_batch_of_errors_is_mapped_over(model, simulation):
    batch = jax.vmap(lambda tilt: assembly_errors(model, {"D.delta_x": tilt}))(jnp.array([0.0, 1e-3]))
    with refused("`errors`", "one assembly", "jax.vmap"):
        simulate(simulation, batch)


@pytest.mark.long
def test_calls_of_the_version_before_work_and_warn(model, simulation):
    settings = {"duration": 0.01, "method": METHOD, "save_every": 1e-3}
    drive, errors = simulation.drive, assembly_errors(model, {"D.delta_x": 1e-3})
    with pytest.warns(DeprecationWarning, match=r"simulate\(Simulation\(model, drive=..., duration=..."):
        former = simulate(model, errors, drive=drive, **settings)
    now = simulate(simulation, {"D.delta_x": 1e-3})
    np.testing.assert_array_equal(former.loads.force, now.loads.force)
    with pytest.warns(DeprecationWarning, match=r"simulate\(Simulation\("):
        by_names = simulate(model=model, errors=errors, drive=drive, **settings)
    np.testing.assert_array_equal(by_names.loads.force, now.loads.force)
    with refused("`simulation`", "missing"):
        simulate(errors=errors)
    with pytest.warns(DeprecationWarning, match=r"Problem\(Simulation\("):
        problem = Problem(model, drive, 0.01, "A.rms_force", METHOD, save_every=1e-3)
    with pytest.warns(DeprecationWarning, match=r"Problem\(Simulation\(") as caught:
        by_names = Problem(model, drive=drive, duration=0.01, metrics="A.rms_force", method=METHOD, save_every=1e-3)
    assert caught[0].filename == __file__ and by_names.metrics == problem.metrics
    with pytest.warns(DeprecationWarning, match=r"Problem\(Simulation\("):
        longer = dataclasses.replace(problem, design=design(model, {"crank.length": 0.121}))
    designed = Problem(dataclasses.replace(simulation, design=longer.design), "A.rms_force")
    assert longer({"D.delta_x": 1e-3})[0] == designed({"D.delta_x": 1e-3})[0]
    values, _ = problem({"D.delta_x": 1e-3})
    assert values == Problem(simulation, "A.rms_force")({"D.delta_x": 1e-3})[0]


@pytest.mark.long
def test_cycles_of_the_version_before_work_and_warn(model):
    drive = PrescribedRate("A", 60.0)
    cycling = Simulation(model, drive=drive, method=METHOD, save_every=0.01)
    now = steady_cycle(cycling, most=2)
    with pytest.warns(DeprecationWarning, match="steady_cycle"):
        former = steady_cycle(model, drive=drive, method=cycling.method, save_every=0.01, most=2)
    assert former.residual == now.residual and np.isfinite(now.residual)
    with refused("`start`", "cycle"):
        steady_cycle(dataclasses.replace(cycling, start=now.start))
    for wrong in ({"tolerance": -1.0}, {"most": 0}, {"most": 2.5}):
        with refused(f"`{next(iter(wrong))}`"):
            steady_cycle(cycling, **wrong)
    run = cycle_run(now, cycling)
    with pytest.warns(DeprecationWarning, match="cycle_run"):
        again = cycle_run(now, model, drive=drive, method=cycling.method, save_every=0.01)
    np.testing.assert_array_equal(jnp.asarray(run.motion.angle), again.motion.angle)
