"""Derivatives by every number of a description through closure, static assembly and motion: forward = reverse =
differences, with errors present, of linear and geometrically exact elements.

Numbers that leave the mechanism planar are set by a design, whose loops close anew; the others deviate, as errors do.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GeneralisedAlpha,
    JointFriction,
    JointSpring,
    Mechanism,
    MomentRamp,
    PointMass,
    PointSpring,
    Rectangle,
    Simulation,
    design,
    deviations,
    discretise,
    parameters,
    simulate,
)
from tests.evaluation import evaluated
from tests.mechanisms import BUSHING, four_bar, link

pytestmark = pytest.mark.slow
OUT = ("position.y", "orientation.x", "orientation.z")
ERRORS = {"D.delta_x": 4e-3, "B.child.delta_z": -3e-3, "coupler.twist": 2e-3}
METHOD = GeneralisedAlpha(step=2e-3, corrections=9, tolerance=1e-14)
STEP = 2e-3  # of differences, in sizes of the numbers


def mechanism():
    """A four-bar with a bearing that gives way, springs, friction and a mass at a point; its bars are not square, where
    the torsion constant has no second derivative."""
    plain = four_bar(2)
    links = [link("crank", 0.12), link("coupler", 0.3, 2, point_masses=[PointMass(0.1, 0.14)]), link("rocker", 0.3)]
    links = [dataclasses.replace(one, section=Rectangle(0.01, 0.012)) for one in links]
    joints = [dataclasses.replace(one, compliance=BUSHING if one.cut else None) for one in plain.joints]
    forces = [
        JointSpring("return", "D", stiffness=3.0, damping=0.1, rest=-1.0, preload=0.2),
        PointSpring("across", ["crank", "rocker"], [(0.05, 0.01, 0.02), (0.2, 0.0, 0.01)], 800.0, 30.0, 0.1, 5.0),
        JointFriction("pin", "D", constant=0.02, viscous=0.01, sliding_rate=0.5),
    ]
    return Mechanism(links, joints, driven_joint="A", forces=forces)


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_every_number_of_a_description(elements):
    model = discretise(mechanism(), elements=elements)
    named = parameters(model)
    names = [*named, "drive.moment", *ERRORS]
    out = [name.endswith(OUT) for name in names]
    nominal = np.array([0.0 if away else named[name].value for name, away in zip(named, out, strict=False)])
    nominal = np.concatenate([nominal, [1.5], list(ERRORS.values())])
    small = np.array([1e-2 if name.endswith(OUT) or name in ERRORS else 0.0 for name in names])
    sizes = np.where(small > 0.0, small, np.where(nominal != 0.0, abs(nominal), 0.1))

    def loads(numbers):
        given = dict(zip(names, numbers, strict=True))
        # Inertias of a point and dampings that are zero may not become negative: they are steps from above zero.
        wanted = {name: given[name] for name, away in zip(names, out, strict=True) if not away and name not in ERRORS}
        deviating = {name: given[name] for name, away in zip(names, out, strict=True) if away or name in ERRORS}
        run = simulate(
            Simulation(
                model, drive=MomentRamp("A", 1.5, 3e-3), duration=6e-3, method=METHOD, design=design(model, wanted)
            ),
            deviations(model, deviating),
        )
        squares = [*run.metrics.mean_square_force.values(), *run.metrics.mean_square_moment.values()]
        return jnp.stack([*squares, run.motion.angle[-1], run.status.astype(float)])

    positive = np.array([".inertia." in name for name in names])
    point = nominal + np.where(positive, 1e-5, 0.0)
    sizes = np.where(positive, 1e-5, sizes)
    forward = evaluated(jax.jacfwd(loads))(jnp.asarray(point))[:-1] * sizes
    steps = STEP * np.concatenate([k * np.diag(sizes) for k in (-2, -1, 1, 2)])
    ends = evaluated(jax.vmap(loads))(jnp.asarray(point + steps)).reshape(4, len(names), -1)
    assert not ends[:, :, -1].any()
    differences = ((ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / (12.0 * STEP)).T[:-1]
    scale = np.maximum(abs(differences), 1e-3 * abs(differences).max(axis=1, keepdims=True))
    gap = abs(forward - differences) / scale
    row, column = np.unravel_index(gap.argmax(), gap.shape)
    assert gap.max() < 1e-6, f"{row} by {names[column]}"
    weights = 1.0 / abs(forward).max(axis=1)
    reverse = np.asarray(
        evaluated(jax.grad(lambda numbers: jnp.asarray(weights) @ loads(numbers)[:-1]))(jnp.asarray(point))
    )
    np.testing.assert_allclose(reverse * sizes, weights @ forward, rtol=1e-8, atol=1e-9)
