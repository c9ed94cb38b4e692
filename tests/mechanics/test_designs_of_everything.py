"""Designs of mechanisms that hold one of everything: every number, beside everything else, has the effect of a
description with this number, and no other; derivatives of the arrays against differences."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Base,
    Circle,
    Clearance,
    Compliance,
    DistributedForce,
    GivenSection,
    Joint,
    JointForceFunction,
    JointForceTable,
    JointFriction,
    JointSpring,
    Link,
    Material,
    Mechanism,
    PointForce,
    PointMass,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    PointSpringTable,
    Rectangle,
    RigidBody,
    Tube,
    design,
    designed,
    deviations,
    discretise,
    parameters,
)
from rfem_jax.description.parameters.parameters import parameters_of
from rfem_jax.description.parameters.parts import number_at, parts_of, scaled, with_numbers
from rfem_jax.mechanics.model.building import PartStructure, arrays_of
from rfem_jax.mechanics.statics.designs import _plan_of
from tests.mechanisms import STEEL, TABLE

BRASS = Material("brass", youngs_modulus=1e11, density=8400.0, shear_modulus=3.7e10, damping=2e-5,
                 thermal_expansion=19e-6)  # fmt: skip
GIVEN = GivenSection(
    2e7, 7e6, 6e6, 150.0, 180.0, 120.0, 0.7, 1.4e-5, 8e-6, 6e-6, 1e-5, edge_y=5e-3, edge_z=6e-3, edge_modulus=2e11,
    torsion_modulus=2e-7, name="given",
)  # fmt: skip
TENSOR = [[3e-4, 5e-5, -2e-5], [5e-5, 4e-4, 8e-5], [-2e-5, 8e-5, 5e-4]]
PIN = Clearance(
    5e-5, 0.02, 5e8, axial=1e-4, exponent=1.5, axial_stiffness=4e8, axial_exponent=1.0, restitution=0.8, friction=0.1,
    diameter=0.01, sliding_speed=1e-3,
)  # fmt: skip


class Tanh(eqx.Module):
    """A law that holds an array, and beside it what is none."""

    weight: jax.Array
    squash: Callable
    name: str = "tanh"

    def __call__(self, one, other):
        return self.squash(self.weight * one) + 0.0 * other


LAW = Tanh(jnp.asarray(2.0), jnp.tanh)


def law_of_time(t, phase):
    return jnp.stack([t, 2.0 * phase.astype(jnp.float64), 1.0 + t])


def chain_of_everything():
    """Every section, body, kind of a tree joint, compliance, clearance, friction and force; gravity along no axis."""
    links = [
        Link("a", 0.1, Rectangle(0.012, 0.01, name="bar"), STEEL, rigid=True),
        Link("b", 0.2, Tube(0.016, 0.001, name="tube"), STEEL, rfes=2),
        Link("c", 0.15, Circle(0.01), BRASS, rigid=True, temperature=200.0,
             point_masses=[PointMass(0.1, (0.06, 0.01, -0.02), (1e-5, 2e-5, 2.5e-5))]),
        Link("d", 0.25, GIVEN, rfes=3, temperature=80.0, thermal_expansion=2e-5,
             point_masses=[PointMass(0.2, (0.1, 0.0, 0.01), (1e-5, 1e-5, 1e-5))]),
        Link("e", 0.12, body=RigidBody(0.3, (0.04, 0.01, -0.02), (3e-4, 4e-4, 5e-4), (0.1, 0.2, -0.3))),
        Link("f", 0.12, body=RigidBody(0.3, (0.04, 0.01, -0.02), TENSOR, (0.0, 0.2, 0.1)),
             temperature=9.0, thermal_expansion=-1e-5),
        Link("g", 0.1, Tube(0.02, 0.003, shear_factor=1.9), BRASS, rfes=2, temperature=-50.0),
        Link("h", 0.1, Rectangle(0.008, 0.014), STEEL, rigid=True),
        Link("i", 0.1, Circle(0.01, name="rod"), STEEL, rfes=2),
        Link("j", 0.1, Rectangle(0.012, 0.01, name="bar"), STEEL, rigid=True),
    ]  # fmt: skip
    turn = {"positions": [-1.0, 0.0, 1.0], "forces": [-2.0, 0.0, 3.0]}  # another one in each sense
    bushing = Compliance(radial=300.0, axial=200.0, tilt=2.0, radial_damping=3.0, axial_damping=2.0, tilt_damping=0.3)
    guide = Compliance(normal=TABLE, R_x=turn, R_y=2.0, R_z=1.5, normal_damping=0.4, R_y_damping=0.1)
    joints = [
        Joint("A", "base", "a", orientation=(0.2, 0.0, 0.3), angle=0.4, compliance=bushing),
        Joint("P", "a", "b", kind="prismatic", orientation=(0.3, -0.2, 0.1), displacement=0.05, compliance=guide),
        Joint("U", "b", "c", kind="universal", child_position=(0.01, 0.0, 0.02), start=(0.3, -0.5)),
        Joint("C", "b", "d", kind="cylindrical", position=(0.12, 0.01, 0.0), angle=0.6, displacement=-0.03),
        Joint("L", "d", "e", kind="planar", child_orientation=(0.1, 0.2, -0.3), start=(0.02, -0.04, 0.7)),
        Joint("F", "e", "f", kind="fixed", orientation=(0.5, 0.1, 0.2)),
        Joint("R", "d", "g", position=(0.125, 0.0, 0.01), angle=-0.8, clearance=PIN),
        Joint("S", "f", "h", kind="spherical", start=(0.3, -0.6, 0.2)),
        Joint("O", "base", "i", kind="free", orientation=(0.2, 0.0, 0.3), start=(0.1, -0.2, 0.3, 2.0, 1.4, -0.5)),
        Joint("B", "i", "j", position=(0.09, 0.0, 0.0), angle=0.3),
    ]
    rows, moments = [(3, 2, 3), (0, 0, 1), (1, 1, 1)], [(0, 1, 0), (1, 0, 2)]
    forces = [
        JointSpring("hairspring", "A", stiffness=2.0, damping=0.1, rest=0.2, preload=0.3),
        JointSpring("slide", "P", stiffness=300.0, damping=4.0, rest=0.03),
        JointForceTable("gas", "P", [-1.0, 0.0, 0.1, 1.0], [3.0, -2.0, 5.0, 8.0]),
        JointForceFunction("law", "U", LAW, motion="R_y"),
        JointSpring("along", "C", stiffness=30.0, motion="T_y"),
        JointFriction("guide", "C", motion="T_y", coefficient=0.1, length=0.03, constant=0.2, viscous=0.3,
                      sliding_rate=0.01, law="brown_mcphee", static_coefficient=0.12, static_constant=0.3),
        JointFriction("pin", "B", coefficient=0.1, radius=0.01, length=0.02, constant=0.02, viscous=0.01,
                      sliding_rate=0.5),
        PointSpring("across", ["a", "h"], [(0.05, 0.01, 0.02), (0.08, 0.0, 0.01)], 800.0, 30.0, 0.1, 5.0),
        PointSpringTable("rubber", ["base", "b"], [(0.05, 0.01, 0.3), (0.18, 0.0, 0.01)], [0.0, 0.1, 0.5], [0, 1, 30]),
        PointSpringFunction("own", ["base", "g"], [(0.05, 0.01, 0.3), (0.08, 0.0, 0.01)], LAW),
        PointForce("follower", "b", (0.19, 0.0, 0.0), (30.0, -20.0, 30.0), axes="link"),
        PointForce("jump", "c", (0.1, 0.0, 0.02), rows, times=[0, 0.1, 0.2]),
        PointMoment("twist", "d", 0.1, law_of_time, breakpoints=[0.05], axes="link"),
        PointMoment("turn", "e", 0.1, (0.1, 0.2, 0.3)),
        PointMoment("swing", "i", (0.02, 0.0, 0.0), moments, times=[0, 0.2]),
        DistributedForce("wind", "d", (30.0, -20.0, 30.0), (5.0, 40.0, -9.0), begin=0.04, end=0.2, axes="link"),
        DistributedForce("rain", "h", rows, times=[0, 0.1, 0.2], begin=0.02),
    ]  # fmt: skip
    base, gravity = Base(12e-6, 40.0), (1.0, -2.0, -9.0)
    return Mechanism(links, joints, driven_joint=["A", "C.T_y"], forces=forces, gravity=gravity, base=base)


def loop_of_everything():
    """A planar four-bar of tubes and rods: friction and compliance at the cut joint, a pin with play in the tree."""
    links = [
        Link("crank", 0.12, Tube(0.016, 0.001, name="tube"), STEEL, rigid=True),
        Link("coupler", 0.3, Circle(0.01, name="rod"), STEEL, rfes=2),
        Link("rocker", 0.3, Tube(0.02, 0.003, shear_factor=1.9, name="thick"), BRASS, rfes=2, temperature=10.0,
             point_masses=[PointMass(0.2, (0.1, 0.0, 0.01), (1e-5, 1e-5, 1e-5))]),
    ]  # fmt: skip
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2),
        Joint("B", "crank", "coupler", angle=np.radians(54.4), clearance=PIN),
        Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=np.radians(-100.8)),
        Joint("C", "coupler", "rocker", cut=True, compliance=Compliance(radial=TABLE, axial=2e4, axial_damping=3.0)),
    ]
    forces = [
        JointFriction("pin", "C", coefficient=0.1, radius=0.01, sliding_rate=0.5),
        JointSpring("return", "D", stiffness=3.0, damping=0.1, rest=-1.0, preload=0.2),
        PointSpring("across", ["crank", "rocker"], [(0.05, 0.01, 0.02), (0.2, 0.0, 0.01)], 800.0, 30.0, 0.1, 5.0),
    ]
    return Mechanism(links, joints, driven_joint="A", forces=forces)


MECHANISMS = {"chain": chain_of_everything, "loop": loop_of_everything}
OUT = (("position", "y"), ("orientation", "xz"))
OUT_OF_PLANE = tuple(f"{part}.{axis}" for part, axes in OUT for axis in axes)  # loops do not close with them


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.exhaustive] if name == "chain" else []) for name in MECHANISMS],
)
def described(request):
    return MECHANISMS[request.param]()


@pytest.fixture(scope="module")
def model(described):
    return discretise(described)


def names_of(model):
    loop = model.topology.n_cuts > 0
    return [name for name in parameters(model) if not (loop and name.endswith(OUT_OF_PLANE))]


def changed(one):
    """Another value of a parameter, near its own."""
    if one.value != 0.0:
        return 1.001 * one.value
    return 1e-3 if one.unit in ("m", "rad") else 1e-6


def with_values(mechanism, values):
    """The mechanism described with other numbers."""
    names, whole = parameters_of(mechanism), mechanism
    for name, value in values.items():
        parameter = names[name]
        for path in parameter.paths:
            if path[0] == "springs":
                whole = _with_spring(whole, path, parameter, value)
                continue
            if path[0] in ("joints", "links") and number_at(whole, path[:3]) is None:
                origin = (0.0, 0.0, 0.0) if path[0] == "joints" else 0.0
                part = dataclasses.replace(number_at(whole, path[:2]), **{path[2]: origin})
                whole = with_numbers(whole, {path[:2]: part})
            factor = scaled(number_at(whole, path), value) if parameter.factor else value
            whole = with_numbers(whole, {path: factor})
    links = [_with_derived_factor(link, before) for link, before in zip(whole.links, mechanism.links, strict=True)]
    return dataclasses.replace(whole, links=links)


def _with_derived_factor(link, before):
    """A tube's shear factor follows from its diameters where it did before."""
    tube = before.section
    if not isinstance(tube, Tube) or tube.shear_factor != tube.derived_factor:
        return link
    return dataclasses.replace(link, section=dataclasses.replace(link.section, shear_factor=None))


def _with_spring(whole, path, parameter, value):
    joint = whole.joints[path[1]]
    field = parameter.full.split(".compliance.")[1].removesuffix(".factor")
    if parameter.factor:
        table = getattr(joint.compliance, field)
        value = {**table, "forces": [value * force for force in table["forces"]]}
    springs = dataclasses.replace(joint.compliance, **{field: value})
    return with_numbers(whole, {("joints", path[1]): dataclasses.replace(joint, compliance=springs)})


def leaves_of(model):
    """{path: array} of all arrays of a model."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(dataclasses.replace(model, source=None))
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


FRAMES_OF_OTHERS = tuple(f"{joint}.{end}" for joint in "PUCLFRSB" for end in ("position", "orientation", "child_"))


@pytest.mark.slow
def test_every_number_alone_changes_what_its_description_would(described, model):
    source = model.source
    structure = PartStructure(model.topology, source.blueprint.points, source.blueprint.products)
    nominal, named = leaves_of(arrays_of(parts_of(described), structure)), parameters(model)
    for name in names_of(model):
        if model.topology.n_cuts == 0 and name.startswith(FRAMES_OF_OTHERS):
            continue  # those of two joints are enough
        value, full = changed(named[name]), named[name].full
        wanted = leaves_of(arrays_of(parts_of(with_values(described, {name: value})), structure))
        differ = {path for path in nominal if (wanted[path] != nominal[path]).any()}
        plan = _plan_of(source.blueprint, model.topology, (full,))
        flags = [one for one in jax.tree.leaves(plan.changes) if not isinstance(one, str)]
        changes = dict(zip(nominal, flags, strict=True))
        assert differ and differ <= {path for path in nominal if changes[path]}, name


@pytest.fixture(scope="module")
def together(model):
    """Function of the values of all numbers -> (all leaves, status); their nominal values, others, and sizes."""
    known = parameters(model)
    named = {name: known[name] for name in names_of(model)}
    nominal = np.array([one.value for one in named.values()])
    other = np.array([changed(one) for one in named.values()])

    def leaves(values):
        made = designed(model, design(model, dict(zip(named, values, strict=True))))
        return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(made.model)]), made.status

    @jax.jit
    def both(values, along, cotangent):
        (found, status), change = jax.jvp(leaves, (values,), (along,))
        (pulled,) = jax.vjp(lambda x: leaves(x)[0], values)[1](cotangent)
        return found, status, change[0], pulled

    return both, nominal, other, list(named)


def flat(leaves):
    return np.concatenate([leaf.ravel() for leaf in leaves.values()])


@pytest.mark.exhaustive
def test_all_numbers_together_are_what_their_description_would_be(described, model, together):
    both, nominal, other, names = together
    cotangent = np.random.default_rng(6).uniform(-1.0, 1.0, flat(leaves_of(model)).size)
    along = np.random.default_rng(5).uniform(-1.0, 1.0, len(names)) * (other - nominal)
    wanted = flat(leaves_of(discretise(with_values(described, dict(zip(names, other.tolist(), strict=True))))))
    found, status, change, pulled = both(other, along, cotangent)
    assert int(status) == 0
    # Loops are closed by iterations; sines and products of matrices differ in the last bits.
    closes = model.topology.n_cuts > 0
    np.testing.assert_allclose(found, wanted, rtol=1e-11 if closes else 1e-14, atol=1e-13 if closes else 1e-15)
    # Forward mode is a difference of fourth order, reverse mode its transpose.
    step = 0.4
    ends = [both(other + k * step * along, along, cotangent)[0] for k in (-2, -1, 1, 2)]
    difference = (ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / (12.0 * step)
    scale = np.maximum(abs(np.asarray(change)), 1e-6 * np.maximum(abs(np.asarray(found)), 1e-6))
    np.testing.assert_array_less(abs(np.asarray(difference - change)) / scale, 1e-6)
    assert float(pulled @ along) == pytest.approx(float(cotangent @ change), rel=1e-9)


def test_designs_and_deviations_outside_of_a_program(described, model):
    """Programs know things by other names, in another order than here: each array is the one of its own thing."""
    named, blueprint = parameters(model), model.source.blueprint
    structure = PartStructure(model.topology, blueprint.points, blueprint.products)
    for owner in ("across", "follower", "return"):
        numbers = [name for name in named if name.startswith(f"{owner}.") and not name.endswith(OUT_OF_PLANE)]
        numbers = [name for name in numbers if "position" not in name and "orientation" not in name]
        values = {name: changed(named[name]) for name in numbers if ".start" not in name}
        if not values:
            continue  # it is of the other mechanism
        wanted = leaves_of(arrays_of(parts_of(with_values(described, values)), structure))
        more = {name: value - named[name].value for name, value in values.items()}
        for one in (designed(model, design(model, values)), designed(model, None, deviations(model, more))):
            found = leaves_of(one.model)
            for path in wanted:
                if not path.startswith((".start_joints", ".cut_angles")):
                    np.testing.assert_allclose(found[path], wanted[path], rtol=1e-9, atol=1e-12, err_msg=path)
