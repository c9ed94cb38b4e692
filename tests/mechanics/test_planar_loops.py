"""Planar loops of rigid links without `redundant_reactions`: what is unique, what is zero, what stays refused.

Loads in the plane of such loops are compared with closed forms in `tests/theory/test_rigid_four_bar.py`, whose models
ask for the least norm; here it is shown that the same model is made where nothing is asked for.
"""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    DistributedForce,
    InputError,
    Joint,
    JointFriction,
    Mechanism,
    PointForce,
    PointMoment,
    Problem,
    RungeKutta4,
    Simulation,
    StaticProblem,
    Tolerances,
    Uniform,
    assemble,
    assembly_errors,
    design,
    deviations,
    discretise,
    monte_carlo,
    parameters,
    sensitivity,
    simulate,
    sweep,
)
from rfem_jax.mechanics import describe
from rfem_jax.mechanics.model.planar_loops import opening
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.simulation.outcome.remarks import remarks_on
from tests.mechanics.test_redundant_reactions import door, loop, plain, slider_crank, toggle
from tests.mechanisms import four_bar, link, twisted_spatial_loop, two_loop_six_bar

UNASKED = {"redundant_reactions": "planar"}
ZERO, LEAST = "those across it are zero", "are the least: force^2 + (moment / {} m)^2"


def unloaded(**more):
    return replace(loop(), **{"forces": (), **UNASKED, **more})


def rod_and_slide():
    return replace(slider_crank(), **UNASKED)


def rigid_links(mechanism):
    return replace(mechanism, links=[replace(one, rfes=1, rigid=True) for one in mechanism.links], **UNASKED)


def sentence(mechanism):
    return describe(discretise(mechanism)).reactions


@pytest.mark.parametrize("make", [loop, slider_crank, partial(slider_crank, gravity=(0.5, 3.0, -9.0))])
def test_the_model_is_that_of_least_norm(make):
    asked = make()
    one, other = discretise(asked), discretise(replace(asked, **UNASKED))
    assert other.topology._replace(across="") == one.topology and one.topology.minimum_norm
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(left, right)
    assert describe(one).reactions == "" and "in the plane of the rigid loops are unique" in describe(other).reactions


def test_nothing_changes_where_loads_are_unique():
    model = discretise(four_bar(3))
    assert not model.topology.minimum_norm and describe(model).reactions == ""


@pytest.mark.long
@pytest.mark.parametrize(
    "mechanism",
    [
        unloaded(),
        rod_and_slide(),
        replace(toggle(1.0), **UNASKED),
        unloaded(forces=[PointForce("push", "coupler", (0.1, 0.0, 0.02), force=(3.0, 0.0, -5.0))]),
        unloaded(forces=[PointMoment("turn", "coupler", (0.1, 0.0, 0.02), moment=(0.0, 2.0, 0.0))]),
        unloaded(forces=[DistributedForce("wind", "coupler", load=(3.0, 0.0, 0.0), end_load=(0.0, 0.0, 40.0))]),
        # The whole mechanism stands beside the origin, and its plane is turned.
        unloaded(joints=[replace(one, position=(x, 0.2, 0.0)) if one.parent == "base" else one
                         for one, x in zip(loop().joints, (0.0, 0.0, 0.0, 0.3), strict=True)]),
    ],
)  # fmt: skip
def test_what_is_symmetric_to_its_plane_loads_nothing_across_it(mechanism):
    model = discretise(mechanism)
    assert ZERO in describe(model).reactions
    found = assemble(model)
    assert STATUS[int(found.status)].name == "ok"
    largest = max(float(np.abs(load.force).max()) for load in found.preload.values())
    for load in found.preload.values():  # in the frames of hinges, whose y axis is the normal
        np.testing.assert_allclose(load.force[1], 0.0, atol=1e-12 * largest)
        np.testing.assert_allclose(np.asarray(load.moment)[[0, 2]], 0.0, atol=1e-12 * largest)


@pytest.mark.long
@pytest.mark.parametrize(
    "mechanism",
    [
        replace(loop(), **UNASKED),  # a force across the plane
        unloaded(gravity=(0.0, 1.0, -9.0)),
        unloaded(forces=[PointForce("push", "coupler", (0.1, 0.05, 0.02), force=(3.0, 0.0, -5.0))]),
        unloaded(forces=[PointMoment("turn", "coupler", (0.1, 0.0, 0.02), moment=(1.0, 2.0, 0.0))]),
        unloaded(forces=[DistributedForce("wind", "coupler", load=(3.0, 0.0, 0.0), end_load=(0.0, 2.0, 40.0))]),
        unloaded(forces=[PointForce("push", "coupler", 0.1, force=[(0, 0, 1), (0, 0, 2)], times=[0.0, 1.0])]),
        # Joints of the coupler beside those of the base, each loop closed by the same distance.
        unloaded(joints=[
            replace(one, **({"position": (0.12, 0.02, 0.0)} if one.name == "B" else {}),
                    **({"position": (0.3, -0.02, 0.0)} if one.name == "C" else {}))
            for one in loop().joints]),
    ],
)  # fmt: skip
def test_what_is_not_symmetric_has_the_least_loads_across_it(mechanism):
    model = discretise(mechanism)
    assert LEAST.format("0.3") in describe(model).reactions
    found = assemble(model)
    assert STATUS[int(found.status)].name == "ok"


def test_a_mass_beside_the_plane_is_told():
    one, other, shoe = rod_and_slide().links
    for centre, inertia in (((0.11, 0.01, 0.0), other.body.inertia),
                            ((0.11, 0.0, 0.0), ((1e-3, 1e-4, 0.0), (1e-4, 4e-2, 0.0), (0.0, 0.0, 4e-2)))):  # fmt: skip
        beside = replace(other, body=replace(other.body, centre=centre, inertia=inertia))
        assert LEAST.format("0.33") in sentence(replace(rod_and_slide(), links=[one, beside, shoe]))


def parallelogram_of_three():
    """Three cranks carry one bar: loads in the plane are not unique."""
    links = [plain(name, 0.1) for name in ("one", "two", "three")] + [plain("bar", 0.4)]
    joints = [Joint(letter, "base", name, position=(x, 0, 0), angle=1.0)
              for letter, name, x in (("A", "one", 0.0), ("B", "two", 0.2), ("C", "three", 0.4))]  # fmt: skip
    joints += [Joint("P", "one", "bar", angle=-1.0), Joint("Q", "two", "bar", child_position=(0.2, 0, 0), cut=True),
               Joint("R", "three", "bar", child_position=(0.4, 0, 0), cut=True)]  # fmt: skip
    return Mechanism(links, joints, driven_joint="A")


def sarrus():
    """Two planar chains in planes across each other hold a plate up: its loads are those of a spatial mechanism."""
    links = [plain(name, 0.1) for name in ("low", "high", "left", "right")]
    quarter = (0.0, 0.0, np.pi / 2)
    joints = [
        Joint("A", "base", "low", angle=-0.5),
        Joint("B", "low", "high", angle=1.0),
        Joint("E", "base", "left", orientation=quarter, angle=-0.5),
        Joint("F", "left", "right", angle=1.0),
        Joint("G", "right", "plate", angle=-0.5),
        Joint("C", "high", "plate", child_orientation=(0.0, 0.0, -np.pi / 2), child_position=(0, 0, 0), cut=True),
    ]
    return Mechanism([*links, plain("plate", 0.1)], joints)


@pytest.mark.parametrize(
    "mechanism",
    [
        replace(door(), **UNASKED),  # hinges in line press each other within the plane, too
        rigid_links(twisted_spatial_loop()),
        parallelogram_of_three(),
        sarrus(),
        unloaded(redundant_reactions="refuse"),
    ],
)
def test_what_stays_refused(mechanism):
    with pytest.raises(InputError, match='must have unique joint reactions.*redundant_reactions = "minimum_norm"'):
        discretise(mechanism)


def test_the_length_belongs_to_the_norm_that_is_asked_for():
    with pytest.raises(InputError, match="`reaction_length` must be left out"):
        unloaded(reaction_length=0.1)


def test_friction_needs_unique_loads_as_before():
    friction = partial(JointFriction, "at_B", "B", coefficient=0.1, radius=0.01, sliding_rate=0.01)
    discretise(unloaded(forces=[friction()]))
    with pytest.raises(InputError, match="`coefficient` of force `at_B` .* redundant"):
        discretise(unloaded(forces=[friction(length=0.02)]))


def test_errors_across_the_plane_cannot_be_put_together():
    model = discretise(unloaded())
    assert STATUS[int(assemble(model, {"D.d_y": 1e-4}).status)].name == "cannot_close"
    assert STATUS[int(assemble(model, {"D.d_x": 1e-4, "coupler.length": 1e-4}).status)].name == "ok"


IN_PLANE = {"d_x", "d_z", "length"}


def is_taken(make, name):
    try:
        jax.eval_shape(lambda x: make({name: x}), 0.0)
    except InputError as problem:
        assert f"but `{name}` opens a loop of rigid links across its plane" in str(problem)
        return False
    return True


def test_no_derivatives_by_errors_across_the_plane():
    """The solution of least norm would give finite ones, and they would be wrong."""
    model = discretise(unloaded())
    for name in model.topology.error_names:
        assert is_taken(partial(assembly_errors, model), name) == (name.rpartition(".")[2] in IN_PLANE), name
    numbers = {"C.position.y": False, "C.position.z": True, "D.orientation.x": False, "D.orientation.y": True,
               "coupler.length": True, "bar.width": True, "gravity.y": True, "A.angle": True}  # fmt: skip
    for name in numbers.keys() & set(parameters(model)):
        for make in (partial(deviations, model), partial(design, model)):
            assert is_taken(make, name) == numbers[name], name
    asked = discretise(unloaded(redundant_reactions="minimum_norm"))  # who asks for the least norm gets it
    assert is_taken(partial(assembly_errors, asked), "D.d_y")


@pytest.mark.long
def test_forms_of_rigid_links_open_their_loops_where_joints_are():
    """Both ends of a bowed link stay where they are; a joint between them moves across the plane."""
    mechanism = rigid_links(two_loop_six_bar())
    formed = [replace(one, form_errors=one.name in ("coupler", "rocker")) for one in mechanism.links]
    model = discretise(replace(mechanism, links=formed))
    names = [f"{link}.{error}" for link in ("coupler", "rocker") for error in ("bow_y", "bow_z", "twist")]
    assert [*opening(model, names)] == ["coupler.twist", "rocker.bow_y", "rocker.twist"]
    assert STATUS[int(assemble(model, {"coupler.bow_y": 1e-4, "rocker.bow_z": 1e-4}).status)].name == "ok"
    assert STATUS[int(assemble(model, {"rocker.bow_y": 1e-4}).status)].name == "cannot_close"


def test_joints_that_give_take_them_up():
    joints = [replace(one, compliance=Compliance(T_y=1e6)) if one.name == "D" else one for one in loop().joints]
    model = discretise(unloaded(joints=joints))
    assert is_taken(partial(assembly_errors, model), "D.d_y") and is_taken(partial(assembly_errors, model), "B.d_y")
    assert not is_taken(partial(assembly_errors, model), "D.delta_x")


@pytest.mark.long
def test_a_run_says_which():
    model = discretise(unloaded())
    run = simulate(Simulation(model, drive=None, duration=2e-4, method=RungeKutta4(step=1e-4)))
    assert STATUS[int(run.status)].name == "ok"
    assert [one for one in remarks_on(run) if ZERO in one] and ZERO in run.summary()


@pytest.mark.long
def test_a_planar_frame_of_rigid_links_has_its_loads():
    """A triangle that stands on a hinge and a slide: a structure that statics alone determines in its plane."""
    links = [link("left", 0.5), link("right", 0.5), plain("shoe", 0.1)]
    joints = [
        Joint("A", "base", "left", angle=-0.6),
        Joint("B", "left", "right", angle=1.2),
        Joint("G", "base", "shoe", position=(2 * 0.5 * np.cos(0.6), 0, 0), kind="fixed"),
        Joint("C", "shoe", "right", position=(0, 0, 0), cut=True),
    ]
    load = [PointForce("load", "left", (0.5, 0.0, 0.0), force=(0.0, 0.0, -10.0))]
    model = discretise(Mechanism(links, joints, forces=load, gravity=(0.0, 0.0, 0.0)))
    found = assemble(model)
    assert STATUS[int(found.status)].name == "ok" and describe(model).rigid_mobility == 0
    np.testing.assert_allclose(np.linalg.norm(found.preload["A"].force), 5.0 / np.sin(0.6), rtol=1e-9)


def test_tolerance_studies_refuse_what_the_loops_cannot_take_up():
    problem = Problem(Simulation(discretise(unloaded()), drive=None, duration=2e-4, method=RungeKutta4(step=1e-4)),
                      ["D.peak_force"])  # fmt: skip
    tolerances = Tolerances({"D.d_x": Uniform(1e-4), "D.d_y": Uniform(1e-4)})
    for study in (partial(sensitivity, problem, scale=tolerances), partial(monte_carlo, problem, tolerances, 8, 0)):
        with pytest.raises(InputError, match="`D.d_y` opens a loop of rigid links across its plane"):
            study()
    with pytest.raises(InputError, match="`bounds` must be of what the loops can take up, but `C.position.y`"):
        sweep(problem, {"C.position.y": (-1e-4, 1e-4)})


def test_all_errors_of_a_sensitivity_are_those_that_close():
    """Asked for all, a study is of the errors in the plane, and of the parameters."""
    model = discretise(replace(loop(), **UNASKED))
    problem = StaticProblem(model, ("A.max_force",))
    known = problem.variable_names
    assert {"D.d_x", "coupler.length", "D.d_z"} <= set(known) and not {"D.d_y", "D.delta_x"} & set(known)
    assert set(known) < set(problem.error_names)
