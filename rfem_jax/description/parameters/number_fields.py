"""Which fields of the objects of a description are numbers, their dimensions and the signs that they must have.

Place in the pipeline: joint_kinds, the objects -> **number_fields** -> parameters.
"""

from collections.abc import Callable, Mapping

from rfem_jax.description.basics.joint_kinds import Freedom
from rfem_jax.description.mechanism.clearance import Clearance, stiffness_dimension
from rfem_jax.description.mechanism.forces import JointFriction, JointSpring
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import PointMass
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.point_forces import (
    PointForce,
    PointMoment,
    PointSpring,
)
from rfem_jax.description.mechanism.points import Point
from rfem_jax.description.mechanism.sections import Circle, GivenSection, Rectangle, Tube

POSITIVE, NOT_NEGATIVE, ANY = "positive", "not_negative", "any"
SIGN_WORDS = {POSITIVE: "greater than 0", NOT_NEGATIVE: "at least 0"}
COMPONENTS = "xyz"

Fields = Mapping[str, tuple[str, str]]

FIELDS: dict[type, Fields] = {
    Rectangle: {
        "width": ("length", POSITIVE),
        "height": ("length", POSITIVE),
        "shear_factor": ("none", POSITIVE),
    },
    Circle: {"diameter": ("length", POSITIVE), "shear_factor": ("none", POSITIVE)},
    Tube: {
        "outer_diameter": ("length", POSITIVE),
        "wall": ("length", POSITIVE),
        "shear_factor": ("none", POSITIVE),
    },
    GivenSection: {
        **dict.fromkeys(("axial_stiffness", "shear_stiffness_y", "shear_stiffness_z"), ("axial_stiffness", POSITIVE)),
        **dict.fromkeys(
            ("torsion_stiffness", "bending_stiffness_y", "bending_stiffness_z"), ("bending_stiffness", POSITIVE)
        ),
        "line_density": ("line_density", POSITIVE),
        **dict.fromkeys([f"rotary_inertia_{axis}" for axis in COMPONENTS], ("rotary_inertia", POSITIVE)),
        "damping": ("time", NOT_NEGATIVE),
    },
    Material: {
        "youngs_modulus": ("pressure", POSITIVE),
        "density": ("density", POSITIVE),
        "poisson_ratio": ("none", ANY),
        "shear_modulus": ("pressure", POSITIVE),
        "damping": ("time", NOT_NEGATIVE),
    },
    PointMass: {
        "mass": ("mass", POSITIVE),
        "position": ("length", ANY),
        "inertia": ("moment_of_inertia", NOT_NEGATIVE),
    },
    Point: {"position": ("length", ANY)},
    Joint: {
        "position": ("length", ANY),
        "orientation": ("angle", ANY),
        "child_position": ("length", ANY),
        "child_orientation": ("angle", ANY),
        "rate": ("rate", ANY),
        "speed": ("speed", ANY),
    },
}
BODY: Fields = {"mass": ("mass", POSITIVE), "centre": ("length", ANY), "orientation": ("angle", ANY)}
POINT_FORCES: dict[type, Fields] = {
    PointSpring: {
        "stiffness": ("stiffness", NOT_NEGATIVE),
        "damping": ("damping", NOT_NEGATIVE),
        "free_length": ("length", NOT_NEGATIVE),
        "preload": ("force", ANY),
    },
    PointForce: {"position": ("length", ANY)},
    PointMoment: {"position": ("length", ANY)},
}


def joint_spring_fields(freedom: Freedom) -> Fields:
    """Of a spring along a coordinate of a joint."""
    turns = "rotational_" if freedom.rotation else ""
    return {
        "stiffness": (f"{turns}stiffness", NOT_NEGATIVE),
        "damping": (f"{turns}damping", NOT_NEGATIVE),
        "rest": (freedom.dimension, ANY),
        "preload": ("moment" if freedom.rotation else "force", ANY),
    }


def clearance_fields(clearance: Clearance) -> Fields:
    """Of a clearance; the dimensions of stiffnesses follow from its exponents."""
    return {
        "radial": ("length", NOT_NEGATIVE),
        "axial": ("length", NOT_NEGATIVE),
        "length": ("length", POSITIVE),
        "diameter": ("length", POSITIVE),
        **{name: (stiffness_dimension(clearance, name), POSITIVE) for name in ("stiffness", "axial_stiffness")},
        "damping": ("contact_damping", NOT_NEGATIVE),
        "restitution": ("none", NOT_NEGATIVE),
        "slowest_approach": ("speed", POSITIVE),
        "friction": ("none", NOT_NEGATIVE),
        "sliding_speed": ("speed", POSITIVE),
        "centring": ("stiffness", POSITIVE),
    }


def friction_fields(freedom: Freedom) -> Fields:
    """Of friction along a coordinate of a joint."""
    force = "moment" if freedom.rotation else "force"
    return {
        "coefficient": ("none", NOT_NEGATIVE),
        "radius": ("length", POSITIVE),
        "length": ("length", POSITIVE),
        "constant": (force, NOT_NEGATIVE),
        "viscous": ("rotational_damping" if freedom.rotation else "damping", NOT_NEGATIVE),
        "sliding_rate": ("rate" if freedom.rotation else "speed", POSITIVE),
        "static_coefficient": ("none", NOT_NEGATIVE),
        "static_constant": (force, NOT_NEGATIVE),
        "load_scale": ("force", POSITIVE),
    }


JOINT_FORCES: dict[type, Callable[[Freedom], Fields]] = {
    JointSpring: joint_spring_fields,
    JointFriction: friction_fields,
}
