"""Twelve mechanisms that mix kinds of joints, forces, friction, compliance, sections and drives: derivatives by errors,
parameters and numbers of drives, forward = reverse = differences, at zero and at random errors.

A directional derivative stands for all numbers: directions are weighed so that numbers of little effect count, too.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Circle,
    Compliance,
    ForceRamp,
    ForceTable,
    GeneralisedAlpha,
    GivenSection,
    Joint,
    JointForceFunction,
    JointForceTable,
    JointFriction,
    JointSpring,
    Link,
    Material,
    Mechanism,
    Method,
    MomentFunction,
    MomentRamp,
    MomentTable,
    PointForce,
    PointMass,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    PointSpringTable,
    PrescribedRate,
    PrescribedSpeed,
    PrescribedSpinUp,
    Rectangle,
    RigidBody,
    RungeKutta4,
    Simulation,
    Tube,
    design,
    deviations,
    discretise,
    parameters,
    simulate,
)
from rfem_jax.description.tolerances.error_catalogue import error_dimension
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.simulation.system.driving import drive_numbers
from tests.evaluation import evaluated
from tests.mechanisms import (
    BUSHING,
    STEEL,
    chain_with_balls,
    chain_with_drives,
    four_bar,
    loop_cut_by,
    loop_with_a_ball,
)

pytestmark = pytest.mark.slow

BRASS = Material("brass", youngs_modulus=1e11, density=8400.0, shear_modulus=3.7e10, damping=2e-5)
BAR, TUBE, ROD = Rectangle(0.01, 0.012, name="bar"), Tube(0.016, 0.002, name="tube"), Circle(0.011, name="rod")
THICK = Tube(0.02, 0.004, shear_factor=1.9, name="thick")
GIVEN = GivenSection(2e7, 7e6, 6e6, 150.0, 180.0, 120.0, 0.7, 1.4e-5, 8e-6, 6e-6, 1e-5, name="given")
TENSOR = [[3e-4, 5e-5, -2e-5], [5e-5, 4e-4, 8e-5], [-2e-5, 8e-5, 5e-4]]
TABLE = {"positions": [0.0, 0.01, 0.2], "forces": [0.0, 300.0, 8000.0]}  # of a resultant
IMPLICIT = GeneralisedAlpha(step=1e-3, corrections=9, tolerance=1e-14)
FINE = GeneralisedAlpha(step=2.5e-4, corrections=9, tolerance=1e-14)  # energies balance within 1 %
EXPLICIT = RungeKutta4(step=1e-3)
STEP = 0.01  # of differences, in directions
SIZES = {"angle": 4e-3, "length": 3e-4}
GEOMETRY = ("length", "position", "orientation", "centre", "points", "angle", "displacement", "start")


class Mixed(NamedTuple):
    """A mechanism under drives, and the method: a few steps; released: at rest from its start, as nothing holds it."""

    mechanism: Mechanism
    drive: Any
    method: Method = IMPLICIT
    elements: str = "linear"
    steps: int = 8
    released: bool = False


def with_sections(mechanism: Mechanism, *sections: Any, **more: Any) -> Mechanism:
    """Other sections for its links, in turn; links of bodies stay."""
    links = [
        link
        if link.section is None
        else dataclasses.replace(
            link, section=section, material=None if section is GIVEN else BRASS if section is THICK else STEEL
        )
        for link, section in zip(mechanism.links, sections, strict=True)
    ]
    return dataclasses.replace(mechanism, links=links, **more)


def law(position, rate):
    return 0.4 - 2.0 * position**3 - 0.03 * rate * position


def tubes_in_bushings() -> Mixed:
    joints = [dataclasses.replace(one, compliance=BUSHING if one.cut else None) for one in four_bar().joints]
    forces = [JointSpring("return", "D", stiffness=3.0, damping=0.1, rest=-1.0, preload=0.2)]
    return Mixed(
        with_sections(four_bar(2), BAR, TUBE, THICK, joints=joints, forces=forces), MomentRamp("A", 1.5, 0.012)
    )


def slider_crank(cut: str, forces: Sequence[Any] = (), section: Any = ROD) -> Mechanism:
    """A crank, a rod and a slide, cut at the wrist or at the guide."""
    angle = np.arcsin(0.05 / 0.2)
    links = [
        Link("crank", 0.05, BAR, STEEL, rigid=True),
        Link("rod", 0.2, section, None if section is GIVEN else STEEL, rfes=3),
        Link("slide", 0.04, BAR, STEEL, rigid=True, point_masses=[PointMass(0.4, 0.02, (1e-4, 1e-4, 1e-4))]),
    ]
    at = 0.2 * np.cos(angle)
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2),
        Joint("B", "crank", "rod", angle=np.pi / 2 + angle),
    ]
    if cut == "wrist":
        joints += [
            Joint("G", "base", "slide", kind="prismatic", displacement=at),
            Joint("W", "rod", "slide", cut=True, child_position=(0.0, 0.0, 0.0)),
        ]
    else:
        joints += [
            Joint("W", "rod", "slide", angle=-angle),
            Joint("G", "base", "slide", kind="prismatic", cut=True, child_position=(0.0, 0.0, 0.0)),
        ]
    return Mechanism(links, joints, driven_joint="A", forces=forces)


def gas_over_a_stroke() -> Mixed:
    forces = [JointForceTable("gas", "G", [0.0, 0.15, 0.3], [-100.0, -40.0, -5.0])]
    return Mixed(slider_crank("wrist", forces), PrescribedRate("A", 20.0, rise_time=5e-3))


def guide_that_rubs() -> Mixed:
    forces = [
        JointFriction("guide", "G", coefficient=0.1, length=0.03, constant=0.2, viscous=0.3, sliding_rate=0.2,
                      law="brown_mcphee", static_coefficient=0.12, static_constant=0.3, load_scale=5.0),
        JointFriction("pin", "A", coefficient=0.1, radius=0.01, sliding_rate=5.0, viscous=1e-3, load_scale=5.0),
    ]  # fmt: skip
    return Mixed(slider_crank("guide", forces, GIVEN), PrescribedSpinUp("A", 20.0, 0.015))


def pins_that_rub() -> Mixed:
    forces = [
        JointFriction("pin", "C", coefficient=0.2, radius=0.01, length=0.02, sliding_rate=0.5, load_scale=5.0),
        JointFriction("foot", "D", constant=0.02, viscous=0.01, sliding_rate=0.5),
        JointForceFunction("law", "D", law),
    ]
    return Mixed(
        with_sections(four_bar(2), TUBE, ROD, BAR, forces=forces),
        MomentTable("A", [0.0, 0.004, 0.02], [0.0, 1.0, 2.0]),
    )


def forces_at_points() -> Mixed:
    def over_time(t, phase):
        return jnp.stack([20.0 * t, 0.0 * t, 1.0 + phase.astype(jnp.float64)])

    forces = [
        PointSpring("across", ["crank", "rocker"], [(0.05, 0.01, 0.02), (0.2, 0.0, 0.01)], 800.0, 30.0, 0.1, 5.0),
        PointSpringTable("rubber", ["base", "rocker"], [(0.1, 0.1, 0.5), 0.1], [0.0, 0.2, 2.0], [0.0, 1.0, 60.0]),
        PointSpringFunction("law", ["base", "coupler"], [(0.1, 0.1, 0.5), 0.1], lambda x, v: 30.0 * x**2 + 0.1 * v),
        PointForce("follower", "rocker", 0.3, (3.0, -2.0, 3.0), axes="link"),
        PointForce(
            "jump", "crank", (0.1, 0.0, 0.02), [(3, 2, 3), (0, 0, 1), (1, 1, 1), (0, 2, 0)], times=[0, 4e-3, 4e-3, 0.02]
        ),
        PointMoment("twist", "coupler", 0.1, over_time, breakpoints=[4e-3]),
        PointMoment("turn", "coupler", 0.2, (0.1, 0.2, 0.3), axes="link"),
    ]
    return Mixed(with_sections(four_bar(2), BAR, TUBE, ROD, forces=forces), MomentRamp("A", 1.5, 0.012))


def exact_arm() -> Mixed:
    links = [
        Link("upper", 0.3, ROD, STEEL, rfes=3, point_masses=[PointMass(0.2, (0.3, 0.0, 0.01), (1e-5, 1e-5, 1e-5))]),
        Link("lower", 0.2, body=RigidBody(0.3, (0.04, 0.01, -0.02), TENSOR, (0.0, 0.2, 0.1))),
    ]
    joints = [
        Joint("A", "base", "upper", orientation=(0.2, 0.0, 0.3), angle=0.5),
        Joint("U", "upper", "lower", kind="universal", start=(0.3, -0.5), compliance=Compliance(tilt=30.0)),
    ]
    forces = [JointSpring("limb", "U", stiffness=1.5, damping=0.01, motion="R_z")]
    mechanism = Mechanism(links, joints, driven_joint="A", forces=forces)
    return Mixed(mechanism, MomentFunction("A", lambda t, phase: 2.0 * jnp.sin(200.0 * t)), FINE,
                 "geometrically_exact")  # fmt: skip


def rigid_chain_of_kinds() -> Mixed:
    """By the explicit method: a fixed, planar, cylindrical and prismatic joint behind a hinge."""
    links = [
        Link("a", 0.1, BAR, STEEL, rigid=True),
        Link("b", 0.2, TUBE, STEEL, rigid=True),
        Link("c", 0.15, ROD, STEEL, rigid=True, point_masses=[PointMass(0.1, (0.06, 0.01, -0.02), (1e-5, 2e-5, 2e-5))]),
        Link("d", 0.12, body=RigidBody(0.3, (0.04, 0.01, -0.02), (3e-4, 4e-4, 5e-4), (0.1, 0.2, -0.3))),
        Link("e", 0.12, THICK, BRASS, rigid=True),
    ]
    joints = [
        Joint("A", "base", "a", orientation=(0.2, 0.0, 0.3), angle=0.4),
        Joint("P", "a", "b", kind="prismatic", orientation=(0.3, -0.2, 0.1), displacement=0.05),
        Joint("C", "b", "c", kind="cylindrical", position=(0.12, 0.01, 0.0), angle=0.6, displacement=-0.03),
        Joint("L", "c", "d", kind="planar", child_orientation=(0.1, 0.2, -0.3), start=(0.02, -0.04, 0.7)),
        Joint("F", "d", "e", kind="fixed", orientation=(0.5, 0.1, 0.2)),
    ]
    forces = [
        JointSpring("slide", "P", stiffness=300.0, damping=4.0, rest=0.03),
        JointForceTable("gas", "P", [-1.0, 1.0], [3.0, -8.0]),
        JointFriction("rub", "C", motion="T_y", constant=0.2, viscous=0.3, sliding_rate=0.1),
        JointForceFunction("along", "C", law, motion="R_y"),
        JointSpring("planar", "L", stiffness=40.0, preload=-2.0, motion="T_x"),
    ]
    mechanism = Mechanism(links, joints, driven_joint="A", forces=forces)
    return Mixed(mechanism, MomentRamp("A", 1.5, 0.012), EXPLICIT, released=True)


def balls_and_a_free_link() -> Mixed:
    sections = TUBE, ROD, BAR, THICK
    plain = chain_with_balls()
    rigid = dataclasses.replace(plain, links=[dataclasses.replace(one, rigid=True) for one in plain.links])
    return Mixed(with_sections(rigid, *sections), MomentRamp("A", 0.5, 0.012), EXPLICIT, released=True)


def ball_and_universal() -> Mixed:
    return Mixed(with_sections(loop_with_a_ball(), BAR, TUBE, ROD), PrescribedRate("A", 10.0, rise_time=5e-3))


def several_drives() -> Mixed:
    drives = [
        PrescribedSpeed("P", 0.3, rise_time=5e-3), MomentRamp("U", 0.3, 0.012, motion="R_z"),
        MomentRamp("U", 0.2, 0.012, motion="R_y"), ForceRamp("C", 2.0, 0.012, motion="T_y"),
        ForceTable("L", [0.0, 0.03], [1.0, 2.0], motion="T_z"), MomentRamp("L", 0.1, 0.012, motion="R_y"),
    ]  # fmt: skip
    return Mixed(with_sections(chain_with_drives(), BAR, TUBE, ROD, THICK), drives)


def structure_cut_by(kind: str, compliance: Compliance | None, section: Any) -> Mixed:
    loop = loop_cut_by(kind)
    joints = [dataclasses.replace(one, compliance=compliance if one.cut else None) for one in loop.joints]
    forces = [PointForce("load", "left", 0.2, [(0, 0, 0), (3.0, 2.0, -5.0)], times=[0.0, 0.03])]
    return Mixed(with_sections(loop, section, TUBE, joints=joints, forces=forces), None)


def cut_by_a_plane() -> Mixed:
    return structure_cut_by("planar", Compliance(axial=2e4, axial_damping=5.0), ROD)


def cut_by_a_weld() -> Mixed:
    return structure_cut_by("fixed", Compliance(T_y=2e4, T_y_damping=5.0), GIVEN)


def cut_by_a_cylinder() -> Mixed:
    return structure_cut_by("cylindrical", Compliance(radial=TABLE, radial_damping=5.0), THICK)


MIXED: tuple[Callable[[], Mixed], ...] = (
    tubes_in_bushings, gas_over_a_stroke, guide_that_rubs, pins_that_rub, forces_at_points, exact_arm,
    rigid_chain_of_kinds, balls_and_a_free_link, ball_and_universal, several_drives, cut_by_a_plane, cut_by_a_weld,
    cut_by_a_cylinder,
)  # fmt: skip


def drive_numbers_of(mixed: Mixed, model: Any) -> dict[str, float]:
    """Numbers of the drives that designs may set."""
    return {name: float(value) for name, value in drive_numbers(model, mixed.drive, None).items()}


# Each compiles for minutes, all directions and both modes; these two are among the long tests of every session of CI.
LONG = (gas_over_a_stroke, several_drives)


@pytest.mark.parametrize(
    "made",
    [pytest.param(made, marks=pytest.mark.long if made in LONG else pytest.mark.exhaustive) for made in MIXED],
    ids=lambda made: made.__name__,
)
def test_forward_reverse_and_differences_agree(made):
    mixed = made()
    model = discretise(mixed.mechanism, elements=mixed.elements)
    of_drives = drive_numbers_of(mixed, model)
    # Zeros may not become negative where they are inertias, dampings or stiffnesses; geometry deviates as errors do.
    known = {name: one.value for name, one in parameters(model).items() if one.value != 0.0}
    geometric = [name for name in known if any(word in name.split(".") for word in GEOMETRY)]
    error_names = [name for name in model.topology.error_names if name not in known]
    names = [*error_names, *known, *of_drives]
    nominal = np.array([0.0] * len(error_names) + [0.0 if n in geometric else known[n] for n in known]
                       + [*of_drives.values()])  # fmt: skip
    sizes = [SIZES[error_dimension(name)] for name in error_names]
    sizes += [3e-4 if name in geometric else 1e-2 * abs(value) for name, value in known.items()]
    sizes = np.array(sizes + [1e-2 * abs(value) for value in of_drives.values()])
    method, duration = mixed.method, mixed.steps * mixed.method.step

    at_rest = static_state(model.topology, model.start_coordinates()) if mixed.released else None

    def metrics(numbers):
        given = dict(zip(names, numbers, strict=True))
        deviating = {name: given[name] for name in (*error_names, *geometric)}
        wanted = {name: x for name, x in given.items() if name not in deviating}
        run = simulate(
            Simulation(
                model,
                drive=mixed.drive,
                duration=duration,
                method=method,
                save_every=duration,
                start=at_rest,
                design=design(model, wanted) if wanted else None,
            ),
            deviations(model, deviating),
        )
        squares = [*run.metrics.mean_square_force.values(), *run.metrics.mean_square_moment.values()]
        ends = [x[-1] for x in (*run.motion.angles.values(), *run.motion.displacements.values())]
        found = jnp.concatenate([jnp.stack([*squares, run.energy.total[-1]]), *map(jnp.ravel, ends)])
        return found, run.status

    scatter = np.random.default_rng(3).uniform(-0.5, 0.5, len(names)) * sizes
    of_errors = np.array([name in error_names for name in names])
    states = np.stack([nominal, nominal + np.where(of_errors, scatter, 0.0)])
    sampled = evaluated(jax.vmap(metrics))
    values, status = sampled(states)
    assert not status.any()
    weights = np.random.default_rng(4).uniform(0.5, 1.0, values.shape[1])
    weights = weights / np.maximum(abs(values).max(axis=0), 1e-6 * abs(values).max())

    def weighed(numbers):
        return jnp.asarray(weights) @ metrics(numbers)[0]

    gradients = evaluated(jax.vmap(jax.grad(weighed)))(states) * sizes
    assert np.isfinite(gradients).all()
    along, usual = (np.stack(part) for part in zip(*(directions(one, of_errors) for one in gradients), strict=True))
    repeated = np.repeat(states, 2, axis=0)
    pushed = evaluated(jax.vmap(lambda at, along: jax.jvp(weighed, (at,), (along,))[1]))
    forward = pushed(repeated, (along * sizes).reshape(repeated.shape)).reshape(2, 2)
    reverse = np.einsum("sn,sdn->sd", gradients, along)
    scale = np.maximum(np.einsum("sn,sdn->sd", abs(gradients), abs(along)), usual[:, None])
    assert (abs(forward - reverse) / scale).max() < 1e-8
    points = np.concatenate([states[:, None] + STEP * k * along * sizes for k in (-2, -1, 1, 2)], axis=1)
    found, status = sampled(points.reshape(-1, len(names)))
    assert not status.any()
    ends = (found @ weights).reshape(2, 4, 2)
    difference = (ends[:, 0] - 8.0 * ends[:, 1] + 8.0 * ends[:, 2] - ends[:, 3]) / (12.0 * STEP)
    # What vanishes by symmetry is compared relative to the second derivative along the direction.
    second = abs(ends[:, 2] - 2.0 * (values @ weights)[:, None] + ends[:, 1]) / STEP**2
    gap = abs(difference - forward) / np.maximum(scale, second)
    assert gap.max() < 1e-6, gap


def directions(gradient, of_errors):
    """Two directions, in the sizes of the numbers: of all that have an effect, those of much effect changing less, and
    of errors that have none, as those out of the plane of a perfect mechanism (of all, if there are no such)."""
    effect = abs(gradient)
    acts = effect > 1e-9 * effect.max()
    usual = np.quantile(effect[acts], 0.3)
    signs = np.random.default_rng(5).choice([-1.0, 1.0], (2, len(gradient)))
    along = signs * np.minimum(1.0, usual / np.maximum(effect, 1e-300))
    return np.where([acts, idle if (idle := ~acts & of_errors).any() else acts], along, 0.0), usual
