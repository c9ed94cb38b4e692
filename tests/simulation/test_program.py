"""The compiled program: its size, what retraces it, and a failed run in a batch."""

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    Case,
    GeneralisedAlpha,
    InputError,
    MomentRamp,
    RungeKutta4,
    Simulation,
    Study,
    assemble,
    assembly_errors,
    discretise,
    natural_frequencies,
    run_cases,
    simulate,
)
from rfem_jax.mechanics.kinematics import motion as kinematics
from rfem_jax.mechanics.model.status import DIVERGED, NOT_ASSEMBLED
from rfem_jax.simulation import simulating
from rfem_jax.simulation.stages import integration
from tests.mechanisms import four_bar, link


def _holds_equations(x):
    """Whether a parameter is a jaxpr, in its closed form or not, or a kernel."""
    return any(hasattr(x, name) for name in ("eqns", "jaxpr", "program"))


def equations_in(jaxpr) -> int:
    """Number of equations of a jaxpr, inner ones included."""
    count = 0
    for equation in jaxpr.eqns:
        count += 1
        for value in jax.tree.leaves(equation.params, is_leaf=_holds_equations):
            inner = getattr(value, "program", value)
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                count += equations_in(inner)
    return count


def itself(function):
    return function


@pytest.mark.long
@pytest.mark.parametrize("counts", [(3, 9), (17, 65)], ids=["links in one piece", "links in segments"])
def test_program_does_not_grow_with_the_number_of_rfes(small, counts, monkeypatch):
    # Without its jit, which would return what another test has traced.
    monkeypatch.setattr(simulating, "simulated", simulating.simulated.function)
    sizes = []
    for rfes in counts:
        model = discretise(four_bar(), rfes=rfes)
        program = jax.make_jaxpr(lambda e, model=model: simulate(Simulation(model, **small.settings), e).metrics)(
            assembly_errors(model)
        )
        sizes.append(equations_in(program.jaxpr))
    assert len(set(sizes)) == 1
    assert sizes[0] > 1000


@pytest.mark.slow
@pytest.mark.parametrize("transformed", [itself, jax.jacfwd, jax.grad], ids=["value", "forward", "reverse"])
def test_kinematics_are_traced_once_for_all_their_places(transformed, monkeypatch):
    """They stand in static start, steps, matrix, loads and balances, and in the rules of their derivatives."""
    places, plain = [], kinematics.relative_motion
    monkeypatch.setattr(kinematics, "relative_motion", lambda *given: places.append(1) or plain(*given))
    model, method = discretise(four_bar(2)), GeneralisedAlpha(step=1e-3)

    def force(tilt):
        errors = assembly_errors(model, {"D.delta_x": tilt})
        run = simulate(
            Simulation(model, drive=MomentRamp("A", 1.0, 0.01), duration=4e-3, method=method, save_every=1e-3), errors
        )
        return run.metrics.mean_square_force["A"]

    jax.clear_caches()
    jax.make_jaxpr(transformed(force))(1e-3)
    # Before JAX 0.12 it traces a rule of a derivative in another context than the function.
    contexts = 1 if transformed is itself or jax.__version_info__ >= (0, 12) else 2
    assert 1 <= len(places) <= contexts


@pytest.mark.slow
def test_new_numbers_do_not_retrace(small):
    traced = eqx.debug.assert_max_traces(integration.prepare, max_traces=1)

    @eqx.filter_jit
    def start(model, errors, drive):
        return traced(model, errors, drive, None).preload.force

    heavier = discretise(
        replace(
            four_bar(3),
            links=tuple(
                link(old.name, old.length * (1.0 + 1e-3), 3 if old.flexible else None) for old in four_bar(3).links
            ),
        )
    )
    first = start(small.model, assembly_errors(small.model), small.drive)
    second = start(heavier, assembly_errors(heavier, {"D.d_y": 1e-3}), MomentRamp("A", 2.0, 0.01))
    assert not np.allclose(first, second)


@pytest.mark.long
def test_a_failed_sample_does_not_spoil_its_batch(small):
    model = small.model

    def one(tilt):
        return simulate(Simulation(model, **small.settings), assembly_errors(model, {"D.delta_x": tilt}))

    tilts = jnp.array([0.0, 5e-3, jnp.nan])
    runs = jax.jit(jax.vmap(one))(tilts)
    assert list(np.asarray(runs.status)) == [0, 0, NOT_ASSEMBLED]
    alone = small.run({"D.delta_x": jnp.asarray(5e-3)})
    np.testing.assert_allclose(runs.metrics.rms_moment["A"][1], alone.metrics.rms_moment["A"], rtol=1e-9)
    assert STATUS[NOT_ASSEMBLED].name == "not_assembled"


@pytest.mark.slow
def test_a_diverging_run_says_so(small):
    settings = {**small.settings, "method": RungeKutta4(step=2e-4)}
    run = simulate(Simulation(small.model, **settings), None)
    assert int(run.status) == DIVERGED
    assert "step is too large" in STATUS[DIVERGED].message


@pytest.mark.slow
def test_cases_in_pieces_equal_single_runs(small):
    study = Study(
        "small",
        four_bar(3),
        small.drive,
        0.02,
        small.settings["method"],
        1e-3,
        cases=(Case("none"), Case("tilted", {"D.delta_x": "0.3 deg"})),
    )
    seen = []
    _, runs = run_cases(study, progress=seen.append)
    assert seen[-1] == pytest.approx(1.0) and len(seen) > 5 and sorted(seen) == seen
    alone = small.run({"D.delta_x": jnp.radians(0.3)})
    assert runs["tilted"].times.shape == alone.times.shape
    for one, other in zip(jax.tree.leaves(runs["tilted"]), jax.tree.leaves(alone)):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)


def test_single_precision_is_refused():
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(InputError, match="jax_enable_x64"):
            discretise(four_bar())
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.wrong_types
def test_bad_arguments_are_refused(small):
    with pytest.raises(InputError, match="did you mean `D.delta_x`"):
        assembly_errors(small.model, {"D.delta_xx": 0.1})
    with pytest.raises(InputError, match="`hold` must name joints of the tree"):
        assemble(small.model, assembly_errors(small.model), hold={"C": 0.0})
    for value, said in (
        ("x", "`hold.A` must start with a number"),
        ("1 mm", "must be an angle"),
        (None, "`hold` must hold"),
    ):
        with pytest.raises(InputError, match=said):
            assemble(small.model, hold={"A": value})
    with pytest.raises(InputError, match="`hold` must be a table"):
        assemble(small.model, hold=0.5)
    with pytest.raises(InputError, match="`rfes` must be a whole number"):
        discretise(four_bar(), rfes=1)
    with pytest.raises(InputError, match="`duration` must be greater than 0"):
        simulate(Simulation(small.model, **{**small.settings, "duration": 0.0}), None)


def test_errors_are_where_their_names_say_traced_or_not(small):
    topology = small.model.topology
    names = topology.error_names
    numbers = jnp.arange(1.0, len(names) + 1)

    def errors(numbers):
        return assembly_errors(small.model, dict(zip(names[::-1], numbers[::-1])))

    known = errors(np.asarray(numbers))
    tilt = known.seat[topology.error_components.index("delta_x"), topology.joints.index("D")]
    assert tilt == numbers[names.index("D.delta_x")]
    for traced, untraced in zip(jax.tree.leaves(jax.jit(errors)(numbers)), jax.tree.leaves(known), strict=True):
        np.testing.assert_array_equal(traced, untraced)


def test_joints_are_held_at_values_with_a_unit(small):
    by_unit, by_number = (assemble(small.model, hold={"A": value}) for value in ("57 deg", math.radians(57.0)))
    assert by_unit.status == 0
    np.testing.assert_array_equal(by_unit.state.position.joints, by_number.state.position.joints)
    with pytest.raises(InputError, match="`hold.A` must start with a number"):
        natural_frequencies(small.model, hold={"A": "x"})


def test_what_cannot_close_is_refused():
    from rfem_jax import Joint, Mechanism

    links = [link("a", 0.1), link("b", 0.1, 3), link("c", 0.1, 3)]
    joints = [
        Joint("A", "base", "a", angle=-1.0),
        Joint("B", "a", "b", angle=0.5),
        Joint("D", "base", "c", position=(0.5, 0, 0), angle=-2.0),
        Joint("C", "b", "c", cut=True),
    ]
    with pytest.raises(InputError, match="joint 'C' stays open by"):
        discretise(Mechanism(links, joints, driven_joint="A"))


def test_rigid_loops_have_the_least_loads_unless_refused():
    rigid = [link("crank", 0.12), link("coupler", 0.3), link("rocker", 0.3)]
    with pytest.raises(InputError, match='redundant_reactions = "minimum_norm"'):
        discretise(replace(four_bar(3), links=tuple(rigid), redundant_reactions="refuse"))
    for choice in ({}, {"redundant_reactions": "minimum_norm"}):
        assert discretise(replace(four_bar(3), links=tuple(rigid), **choice)).topology.minimum_norm
