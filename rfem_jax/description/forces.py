"""Forces along the free motions of joints: springs with dampers, and laws of the joint's own position and rate.

Place in the pipeline: `Mechanism` holds them; the mechanics evaluates them inside compiled code.

A force acts on one free motion of a joint of the tree, which is about or along one axis: a moment [N m] about it or a
force [N] along it, of the parent on the child, positive as the joint's coordinate, and the opposite one on the parent.
A spring is part of its joint and of the joint's load; a law acts beside the joint, as a drive does, and is not.
Source: theory (3.14) to (3.17).
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from rfem_jax.description.driven_motions import plain_motion
from rfem_jax.description.errors import ChecksItself, InputError, require_name
from rfem_jax.description.joint_kinds import KINDS, Freedom
from rfem_jax.description.joints import Joint
from rfem_jax.description.units import Quantities, Quantity, non_negative_quantity, quantity, sequence

if TYPE_CHECKING:
    Law = Callable[[Any, Any], Any]
else:
    Law = Any  # what is no function is refused in a sentence


class Force(abc.ABC):
    """A force that a mechanism holds: along joints, or at points of links (`point_forces`)."""

    name: str


class JointForce(Force):
    """A force along one free motion of a joint of the tree."""

    joint: str
    motion: str | None

    @abc.abstractmethod
    def resolved(self, joint: Joint) -> "JointForce":
        """The force with numbers in SI units, and the name of its motion, on its joint; raises InputError if something
        does not fit the joint."""

    def coordinate(self, joint: Joint) -> int:
        """Index of the motion among the coordinates of its joint."""
        motions = KINDS[joint.kind].motions
        return motions.index(_motion_of(self, joint))


@dataclass(frozen=True)
class JointSpring(ChecksItself, JointForce):
    """A spring with a damper: preload - stiffness * (position - rest) - damping * rate.

    Args:
        name: a word.
        joint: name of a joint that is not cut.
        stiffness: [N m/rad] about an axis, [N/m] along one, >= 0.
        damping: [N m s/rad], [N s/m], >= 0.
        rest: position [rad, m] at which the spring exerts its preload.
        preload: moment [N m] or force [N] at the position `rest`.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    joint: str
    stiffness: Quantity = 0.0
    damping: Quantity = 0.0
    rest: Quantity = 0.0
    preload: Quantity = 0.0
    motion: str | None = None

    def __post_init__(self):
        _check_names(self)

    def resolved(self, joint: Joint) -> "JointSpring":
        freedom = _freedom_of(self, joint)
        of = f"of force `{self.name}`"
        return replace(
            self,
            stiffness=non_negative_quantity(self.stiffness, _dimension(freedom, "stiffness"), f"`stiffness` {of}"),
            damping=non_negative_quantity(self.damping, _dimension(freedom, "damping"), f"`damping` {of}"),
            rest=quantity(self.rest, freedom.dimension, f"`rest` {of}"),
            preload=quantity(self.preload, _dimension(freedom, "force"), f"`preload` {of}"),
            motion=_motion_of(self, joint),
        )


@dataclass(frozen=True)
class JointForceTable(ChecksItself, JointForce):
    """A force given at positions of its joint, linear in between and constant outside, as gas pressure over a stroke.

    Args:
        name: a word.
        joint: name of a joint that is not cut.
        positions: [rad] about an axis, [m] along one, increasing; at least two.
        forces: moments [N m] or forces [N], as many as positions.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    joint: str
    positions: Quantities
    forces: Quantities
    motion: str | None = None

    def __post_init__(self):
        _check_names(self)

    def resolved(self, joint: Joint) -> "JointForceTable":
        freedom = _freedom_of(self, joint)
        of = f"of force `{self.name}`"
        positions = sequence(self.positions, freedom.dimension, f"`positions` {of}")
        forces = sequence(self.forces, _dimension(freedom, "force"), f"`forces` {of}")
        if len(positions) < 2 or not all(np.diff(positions) > 0.0):
            raise InputError(
                f"Argument `positions` {of} must hold at least two positions, increasing, but was {list(positions)}; "
                "sort the table and give each position once."
            )
        if len(forces) != len(positions):
            raise InputError(
                f"Argument `forces` {of} must have as many entries as `positions` ({len(positions)}), but has "
                f"{len(forces)}; give one for each position."
            )
        return replace(self, positions=positions, forces=forces, motion=_motion_of(self, joint))


@dataclass(frozen=True)
class JointForceFunction(ChecksItself, JointForce):
    """A force given by a Python function written in JAX.

    Args:
        name: a word.
        joint: name of a joint that is not cut.
        function: (position [rad, m], rate [rad/s, m/s]) -> moment [N m] or force [N], a float64 scalar. An
            `equinox.Module` with `__call__` may hold parameters to differentiate.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is of the wrong kind.
    """

    name: str
    joint: str
    function: Law
    motion: str | None = None

    def __post_init__(self):
        _check_names(self)
        if not callable(self.function):
            raise InputError(
                f"Argument `function` of force `{self.name}` must be a function of position and rate, but was "
                f"{self.function!r}; pass for example lambda q, v: -3.0 * q**3."
            )
        if not isinstance(self.function, (eqx.Module, Partial)):
            object.__setattr__(self, "function", Partial(self.function))
        self._check_result()

    def _check_result(self) -> None:
        number = jax.ShapeDtypeStruct((), jnp.float64)
        try:
            result = eqx.filter_eval_shape(self.function, number, number)
        except Exception as error:
            raise InputError(
                f"Argument `function` of force `{self.name}` must be callable as function(position, rate) in JAX, but "
                f"raised {type(error).__name__}: {error}; use jax.numpy and these arguments."
            ) from error
        if getattr(result, "shape", None) != () or result.dtype != jnp.float64:
            raise InputError(
                f"Argument `function` of force `{self.name}` must return a float64 scalar, but returned {result}; "
                "return one jax.numpy value."
            )

    def resolved(self, joint: Joint) -> "JointForceFunction":
        _freedom_of(self, joint)
        return replace(self, motion=_motion_of(self, joint))


def _check_names(force: JointForce) -> None:
    require_name(force.name, "`name` of a force")
    require_name(force.joint, f"`joint` of force `{force.name}`")


def _motion_of(force: JointForce, joint: Joint) -> str:
    """Name of the motion that a force acts on."""
    return plain_motion(force.motion, joint.kind, joint.name, f"force `{force.name}`")


def _freedom_of(force: JointForce, joint: Joint) -> Freedom:
    """The coordinate that a force acts on."""
    motion = _motion_of(force, joint)
    kind = KINDS[joint.kind]
    # Motions about any axis come last, so that those before have one coordinate each.
    return kind.freedoms[kind.motions.index(motion)]


def _dimension(freedom: Freedom, of: str) -> str:
    """Dimension of a force, a stiffness or a damping along a coordinate."""
    along = {"force": "force", "stiffness": "stiffness", "damping": "damping"}
    about = {"force": "moment", "stiffness": "rotational_stiffness", "damping": "rotational_damping"}
    return (about if freedom.rotation else along)[of]
