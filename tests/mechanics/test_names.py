"""Names of links, joints, forces, sections and materials are no part of programs: mechanisms that differ in names alone
are the same to them, whatever the order of the names is."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Joint,
    JointFriction,
    JointSpring,
    Mechanism,
    Metric,
    MomentRamp,
    PointForce,
    Problem,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    design,
    discretise,
    kinetostatic_turn,
    natural_frequencies,
    simulate,
)
from rfem_jax.compilation import keeping
from rfem_jax.compilation.naming import Names, names_in
from rfem_jax.compilation.program import Program
from rfem_jax.tolerancing.problems.sample_values import evaluate_lanes, local_mesh
from tests.mechanics.test_designs_of_everything import chain_of_everything, loop_of_everything
from tests.mechanisms import chain_with_balls, compliant_chain, four_bar, link, loop_with_point_forces, two_loop_six_bar

ALL = (
    four_bar, two_loop_six_bar, compliant_chain, chain_with_balls, loop_with_point_forces, loop_of_everything,
    chain_of_everything,
)  # fmt: skip


def with_other_names(mechanism, other):
    """The mechanism whose things are called `other(name)`."""

    def named(thing, *fields):
        old = {field: getattr(thing, field) for field in fields if getattr(thing, field, None) is not None}
        new = {k: tuple(map(moving, x)) if isinstance(x, tuple) else moving(x) for k, x in old.items()}
        return dataclasses.replace(thing, **new)

    def moving(name):
        return name if name == "base" else other(name)

    def shared(one):
        parts = {part: named(getattr(one, part), "name") for part in ("section", "material") if getattr(one, part)}
        return dataclasses.replace(one, **parts)

    driven = mechanism.driven_joint
    motions = () if driven is None else (driven,) if isinstance(driven, str) else driven
    found = [".".join([other(motion.split(".")[0]), *motion.split(".")[1:]]) for motion in motions]
    return dataclasses.replace(
        mechanism,
        links=[shared(named(one, "name")) for one in mechanism.links],
        joints=[named(one, "name", "parent", "child") for one in mechanism.joints],
        forces=[named(one, "name", "joint", "link", "links") for one in mechanism.forces],
        driven_joint=found or None,
    )


def backwards(name):
    """Another name, which sorts the other way round."""
    return "".join(chr(ord("0") + ord("z") - ord(c)) if c.isalnum() and c.islower() else c for c in name)[::-1] + "q"


def structure(tree):
    return jax.tree.structure(tree)


@pytest.mark.parametrize("made", ALL, ids=lambda made: made.__name__)
def test_models_of_other_names_are_the_same_without_them(made):
    described = made()
    other = with_other_names(described, lambda name: f"{'zyx'[hash_of(name) % 3]}{name[::-1]}q")
    models = [discretise(one) for one in (described, other)]
    assert structure(models[0]) != structure(models[1])
    named: Any = [names_in((model,)) for model in models]
    nameless = [names.renamed(model) for names, model in zip(named, models, strict=True)]
    if not any(callable(getattr(force, "function", None)) for force in described.forces):
        assert structure(nameless[0]) == structure(nameless[1])
    for names, model, without in zip(named, models, nameless, strict=True):
        bare = dataclasses.replace(model, source=None)
        assert structure(names.back.renamed(dataclasses.replace(without, source=None))) == structure(bare)
        assert not [text for text in model.topology.joints if text in str(without.topology.joints)]


def hash_of(name):
    return sum(map(ord, name))


def test_a_name_like_another_word_stays():
    joints = [Joint("drive", "base", "arm"), Joint("B", "arm", "force")]
    model = discretise(Mechanism([link("arm", 0.3), link("force", 0.2)], joints, driven_joint="drive"))
    assert names_in((model,)) is None and names_in((discretise(four_bar()), 1)) is not None


@pytest.fixture
def traced(monkeypatch):
    """Programs that are made by themselves, as for a user who keeps none."""
    monkeypatch.setattr(keeping, "_choice", keeping._Choice(None))
    monkeypatch.setattr(keeping, "statistics", keeping.Statistics())
    return keeping.statistics


def pendulum(one, other, upper, lower, spring, rub, load):
    """A double pendulum with forces."""
    links = [link(upper, 0.3), link(lower, 0.2)]
    joints = [Joint(one, "base", upper, angle=0.2), Joint(other, upper, lower, angle=0.4)]
    forces = [
        JointSpring(spring, other, stiffness=3.0, damping=0.01),
        JointFriction(rub, one, constant=0.1, sliding_rate=1.0),
        PointForce(load, lower, 0.1, (1.0, 2.0, 3.0)),
    ]
    return discretise(Mechanism(links, joints, driven_joint=one, forces=forces))


NAMES = ("A", "B", "upper", "lower", "spring", "rub", "load"), ("z", "y", "link-2", "link-1", "c", "b", "a")
METHOD = RungeKutta4(step=1e-3)


def results(names):
    """Of the main programs, by the names in the order of `pendulum`; with keys in their places."""
    one, other, upper, lower, *_ = names
    model = pendulum(*names)
    errors = assembly_errors(model, {f"{other}.d_x": 1e-3})
    drive = MomentRamp(one, 0.5, 2e-3)
    wanted = design(model, {f"{lower}.length": 0.21})
    run = simulate(Simulation(model, drive=drive, duration=3e-3, method=METHOD), errors, record=f"{upper}.sections")
    assert [*run.loads] == sorted([one, other]) and [*run.motion.ends] == sorted([upper, lower])
    assert [*run.recorded] == [f"{upper}.sections"] and [*run.friction_losses] == [names[5]]
    designed = simulate(Simulation(model, drive=drive, duration=3e-3, method=METHOD, design=wanted), errors)
    rest = assemble(model, errors)
    turn = kinetostatic_turn(model, errors, np.array([0.1, 0.2]))
    modes = natural_frequencies(model, errors, count=1)
    problem = Problem(
        Simulation(model, drive=drive, duration=3e-3, method=METHOD),
        [f"{other}.rms_force", f"{one}.peak_moment", "end_energy"],
    )
    values, status = problem({f"{other}.d_x": jnp.asarray(1e-3), f"{lower}.length": jnp.asarray(1e-3)})
    assert [*values] == sorted([f"{other}.rms_force", f"{one}.peak_moment", "end_energy"]) and int(status) == 0
    rows = evaluate_lanes(problem, (f"{other}.d_x",), {}, jnp.asarray([[1e-3], [2e-3]]), local_mesh())
    return [
        run.loads[one].force, run.loads[other].moment, run.motion.ends[lower], run.forces[names[6]].force,
        run.friction_losses[names[5]], designed.loads[other].force, rest.preload[other].force,
        turn.loads[one].force, modes.frequency, values[f"{other}.rms_force"], values[f"{one}.peak_moment"], rows[0],
    ]  # fmt: skip


@pytest.mark.long
def test_programs_of_other_names_are_traced_once(traced):
    first = results(NAMES[0])
    count = traced.traced
    assert count > 0
    second = results(NAMES[1])
    assert traced.traced == count
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


def test_functions_of_the_user_read_runs_by_their_names(traced):
    def found(names):
        metric = Metric("own", "N", function=lambda run: jnp.max(run.loads[names[1]].force))
        return Problem(
            Simulation(pendulum(*names), drive=MomentRamp(names[0], 0.5, 2e-3), duration=3e-3, method=METHOD), metric
        )({})[0]["own"]

    assert float(found(NAMES[0])) == pytest.approx(float(found(NAMES[1])), rel=1e-12)


def test_mistakes_within_a_program_are_told_by_the_names(traced):
    @functools.partial(Program, nameless=True)
    def refuse(model):
        raise InputError(f"Argument `joint` must be another one than `{model.topology.joints[0]}`.")

    with pytest.raises(InputError, match="than `A`"):
        refuse(pendulum(*NAMES[0]))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("A", "#1"), ("A.radial", "#1.radial"), ("A.child.d_y", "#1.child.d_y"), ("link@0.5.deflection", None),
        ("bar@0.5.deflection", "#2@0.5.deflection"), ("link.bar.length", "link.#2.length"), ("drive.moment", None),
        ("drive.A.moment", "drive.#1.moment"), ("drive.A.T_y.moment", "drive.#1.T_y.moment"), ("gravity.x", None),
        ("radial.A", None), ("end_energy", None), ("Aa", None), ("section.bar.height", "section.#2.height"),
    ],
)  # fmt: skip
def test_texts_that_begin_with_a_name(text, found):
    names = Names({"A": "#1", "bar": "#2"})
    assert names.of(text) == (found or text) and names.back.of(names.of(text)) == text
