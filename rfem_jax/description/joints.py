"""Joints: hinges about the local y axis between a parent (a link or the base) and a child link.

Place in the pipeline: joints connect the links of a mechanism; cut joints close its loops.

Frames: `position` and `orientation` place the joint's nominal frame F in the parent's frame (the
global frame for the base; the link frame, x along the beam, for a link); `child_position` and
`child_orientation` place the hinge in the child's link frame. R = R_z R_y R_x.
Source: theory (2.3) to (2.6).
"""

from dataclasses import dataclass
from typing import Any

from rfem_jax.description.errors import Checks, ChecksItself, InputError, require_flag, require_name
from rfem_jax.description.units import quantity, vector


@dataclass(frozen=True)
class Joint(ChecksItself):
    """A hinge about the y axis of its frame.

    Args:
        name: a word.
        parent: "base" or the name of a link.
        child: the name of a link other than the parent.
        position: (x, y, z) [m] in the parent's frame; None = the base's origin, or the link's end.
        orientation: angles (about x, y, z) [rad] in the parent's frame, R = R_z R_y R_x.
        child_position: (x, y, z) [m] in the child's frame; None = the child's origin for a joint of
            the tree, its far end for a cut joint.
        child_orientation: angles (about x, y, z) [rad] in the child's frame.
        angle: approximate start value [rad] of the joint coordinate; None = 0. Not of a cut joint,
            whose angle follows from closing the loop.
        cut: True if the joint closes a loop and is expressed by constraint equations.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    parent: str
    child: str
    position: tuple[float, float, float] | None = None
    orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    child_position: tuple[float, float, float] | None = None
    child_orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float | None = None
    cut: bool = False

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a joint")
        of = f"of joint `{self.name}`"
        checks.convert("parent", require_name, f"`parent` {of}")
        checks.convert("child", _child, of)
        checks.relation(("parent", "child"), self._check_child, of)
        checks.convert("cut", require_flag, f"`cut` {of}")
        for field, dimension in _VECTORS.items():
            checks.convert(field, _vector, dimension, f"`{field}` {of}")
        if self.angle is not None:
            checks.convert("angle", quantity, "angle", f"`angle` {of}")
        checks.relation(("cut",), self._check_angle, of)
        if self.angle is None and self.cut is False:
            object.__setattr__(self, "angle", 0.0)

    def _check_child(self, of: str) -> None:
        if self.parent == self.child:
            raise InputError(
                f"Argument `child` {of} must differ from its parent, but both are "
                f"`{self.child}`; name the two links that it joins."
            )

    def _check_angle(self, of: str) -> None:
        if self.cut and self.angle is not None:
            raise InputError(
                f"Argument `angle` {of} must be left out because the joint is cut, but was "
                f"{self.angle!r}; a cut joint's angle follows from closing the loop."
            )


def _child(child: object, of: str) -> str:
    if child == "base":
        raise InputError(
            f"Argument `child` {of} must be a link, but was the base; make the base the parent and the link the child."
        )
    return require_name(child, f"`child` {of}")


def _vector(value: Any, dimension: str, where: str) -> tuple[float, float, float] | None:
    if value is None:
        return (0.0, 0.0, 0.0) if dimension == "angle" else None
    return vector(value, dimension, where)


_VECTORS = {
    "position": "length",
    "orientation": "angle",
    "child_position": "length",
    "child_orientation": "angle",
}
