"""Mechanisms with couplings, which tests of elastic and of ideal ones share."""

import numpy as np

from rfem_jax import Coupling, Joint, JointSpring, Mechanism
from rfem_jax.validation.geared_mechanisms import APART, CRANK, ROD, TURN, rod_angles
from tests.mechanisms import body, link

ONE, TWO, RATIO = 0.02, 0.05, -0.5
NO_GRAVITY = (0.0, 0.0, 0.0)
LIFT, FOLLOWER, SPRING, PRELOAD, RATE = 8e-3, 0.4, 3e3, 60.0, 30.0


def rotor(name, inertia):
    return body(name, 1.0, inertia=(inertia, inertia, inertia))


def gear_pair(gravity=NO_GRAVITY, driven="A", rates=(None, None), forces=(), **mesh):
    """Two rotors, `ONE` and `TWO`, and a gear pair between them."""
    joints = [
        Joint("A", "base", "one", rate=rates[0]),
        Joint("B", "base", "two", position=(0.3, 0.0, 0.0), rate=rates[1]),
    ]
    mesh = Coupling("mesh", ("A", "B"), **({"ratio": RATIO} | mesh))
    links = [rotor("one", ONE), rotor("two", TWO)]
    return Mechanism(links, joints, gravity=gravity, driven_joint=driven, forces=[mesh, *forces])


def cam(**mesh):
    """A cam that turns evenly under a follower on a guide along z, with a spring; harmonic lift."""
    links = [rotor("cam", 1e-3), body("follower", FOLLOWER)]
    up = (0.0, -0.5 * np.pi, 0.0)
    joints = [Joint("A", "base", "cam"), Joint("G", "base", "follower", kind="prismatic", orientation=up)]
    turns = np.linspace(0.0, 2.0 * np.pi, 73)
    lift = Coupling(
        "lift", ("A", "G"), positions=list(turns), values=list(0.5 * LIFT * (1.0 - np.cos(turns))), periodic=True,
        offset=0.0, **mesh,
    )  # fmt: skip
    spring = JointSpring("return", "G", stiffness=SPRING, preload=-PRELOAD)
    return Mechanism(links, joints, gravity=NO_GRAVITY, driven_joint="A", forces=[lift, spring])


def geared_five_bar(rfes=None, reactions="minimum_norm", **mesh):
    """Cranks turn with equal angles from those at the start, 0 and `TURN`; rods meet in C, above."""
    links = [link("one", CRANK), link("left", ROD, rfes), link("right", ROD, rfes)]
    links.append(link("two", CRANK))
    angles, (one, two) = rod_angles(0.0, TURN), (0.0, TURN)
    joints = [
        Joint("A", "base", "one", angle=one),
        Joint("B", "one", "left", angle=angles[0] - one),
        Joint("E", "base", "two", position=(APART, 0.0, 0.0), angle=two),
        Joint("D", "two", "right", angle=angles[1] - two),
        Joint("C", "left", "right", child_position=(ROD, 0.0, 0.0), cut=True),
    ]
    mesh = Coupling("mesh", ("A", "E"), **({"ratio": 1.0} | mesh))
    rigid = {} if rfes else {"redundant_reactions": reactions}
    return Mechanism(links, joints, driven_joint="A", forces=[mesh], **rigid)
