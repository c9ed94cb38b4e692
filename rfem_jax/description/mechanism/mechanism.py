"""Mechanism: links joined by joints to a tree that starts at the base, closed by cut joints.

Place in the pipeline: the whole of what is built, without errors and drive; `mechanics` discretises
it. Everything is checked at construction.

Symbols: gravity [m/s^2] in the global frame, whose X-Z plane is the plane of the nominal motion, or its X-Y plane.
Source: docs/theory/1_discretisation.md, docs/theory/2_frames_and_errors.md.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from rfem_jax.description.basics.errors import (
    Checks,
    ChecksItself,
    InputError,
    Problems,
    require_choice,
    require_entries,
    require_instance,
    subject,
    suggestion,
)
from rfem_jax.description.basics.joint_kinds import KINDS, joint_errors, why_no_error
from rfem_jax.description.basics.notebook_tables import mechanism_html
from rfem_jax.description.basics.numbers import NumberTree, is_known, number_vector
from rfem_jax.description.basics.units import positive_quantity
from rfem_jax.description.drives.driven_motions import plain_motion
from rfem_jax.description.mechanism.bases import Base
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.forces import Force, JointForce, JointFriction
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.point_forces import PointLoad
from rfem_jax.description.mechanism.points import NamedPoint, Point, named_points, read_points
from rfem_jax.description.tolerances.error_catalogue import BOWS, LINK_ERRORS, NO_BOW, error_unit

Part = TypeVar("Part", Link, Joint, Force)

ELEMENTS = ("linear", "geometrically_exact")
REACTIONS = PLANAR, MINIMUM_NORM, REFUSE = "planar", "minimum_norm", "refuse"
STARTS = AS_GIVEN, EQUILIBRIUM = "as_given", "equilibrium"
PLANES = {"xz": (0.0, 0.0, -9.81), "xy": (0.0, -9.81, 0.0)}  # and gravity that points down in them
_OF_PLANE: Any = None
_ROUNDING = 1e-12  # a position at the end of a link may exceed its length by rounding


@dataclass(frozen=True)
class Mechanism(NumberTree, ChecksItself):
    """Links and joints, checked to form a tree with cut joints.

    Args:
        links: Link objects, at least one.
        joints: Joint objects; each link is the child of exactly one that is not cut.
        gravity: (x, y, z) [m/s^2] in the global frame; None: 9.81 m/s^2 downwards in the plane.
        redundant_reactions: what to do where joint loads are not unique (rigid loops with parallel
            axes): "minimum_norm" for those loads whose sum of squares over all joints is least; "planar" for the same
            where loads in the plane of planar loops are unique, so that only those across it are chosen so, while
            others are refused; "refuse" for none.
        driven_joint: the joint of the tree that a drive acts on and that assembly holds at its start; with several
            free motions "joint.motion", as "C.T_y"; a list of these for several drives, those of prescribed
            motions first; None = none (a study sets it from its drives).
        elements: spring-damping elements: "linear" (small deflections relative to the link frame),
            or "geometrically_exact" (of any size).
        start: how simulations start whose `start` says nothing else: "as_given", with the freedoms that no drive holds
            at the start values of the joints while flexible links settle, then released, at the joints' initial
            rates; or "equilibrium", in the static equilibrium of these freedoms, at rest (a study sets it from its
            own `start`).
        forces: objects of forces in joints (such as JointSpring), between points of links (PointSpring), at them
            (PointForce) and along links (DistributedForce), and of couplings of two joint coordinates (Coupling).
        reaction_length: length [m], > 0, over which moments count beside forces in the sum of squares of
            "minimum_norm"; None: that of the longest link.
        points: Point objects, whose paths runs follow, and names of joints, as "B", and of ends of links, as
            "coupler.end", for the paths of their centres and of these ends.
        shaking_point: (x, y, z) [m] in global axes, about which the moment on the base is taken; given, studies report
            what shakes the base; None: the origin of the base.
        base: a Base, whose places move apart with its temperature; None: they stay.
        plane: in which mechanisms are planar unless joints have other orientations: "xz", x to the right and z up,
            where hinges turn about y, from z to x, or "xy" with y up, as in a textbook's figure, where hinges turn
            about z, from x to y: there both frames of every joint, and the sections of links, are turned by a quarter
            about x (theory (2.22)), so that y of a joint's frame is z of its link.
    Raises:
        InputError: names clash or are unknown, a link is not connected, a loop is not cut, a
            joint lies off a flexible link, or a force does not fit its joint or its links.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    gravity: tuple[float, float, float] = _OF_PLANE
    redundant_reactions: str = PLANAR
    driven_joint: str | tuple[str, ...] | None = None
    elements: str = "linear"
    forces: tuple[Force, ...] = ()
    start: str = AS_GIVEN
    reaction_length: float | None = None
    points: tuple[Point, ...] = ()
    shaking_point: tuple[float, float, float] | None = None
    base: Base | None = None
    plane: str = "xz"

    def _repr_html_(self) -> str:
        return mechanism_html(self)

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("links", _unique, Link, "links")
        checks.convert("joints", _unique, Joint, "joints")
        checks.convert("plane", require_choice, tuple(PLANES), "plane")
        if self.gravity is None:
            object.__setattr__(self, "gravity", PLANES.get(str(self.plane), PLANES["xz"]))
        checks.convert("gravity", number_vector, "acceleration", "gravity")
        checks.convert("redundant_reactions", require_choice, REACTIONS, "redundant_reactions")
        if self.reaction_length is not None:
            checks.convert("reaction_length", positive_quantity, "length", "reaction_length")
            checks.relation(("redundant_reactions", "reaction_length"), self._check_reaction_length)
        checks.convert("elements", require_choice, ELEMENTS, "elements")
        checks.convert("start", require_choice, STARTS, "start")
        checks.convert("forces", _unique, Force, "forces")
        checks.convert("points", read_points)
        if self.shaking_point is not None:
            checks.convert("shaking_point", number_vector, "length", "shaking_point")
        if self.base is not None:
            write = 'write for example Base("12e-6 1/K", temperature="20 K").'
            checks.convert("base", require_instance, "base", Base, write)
        checks.relation(("links", "joints"), self._check_structure)
        checks.relation(("links", "joints", "forces"), self._resolve_forces)
        checks.relation(("links", "joints", "forces", "points"), self._check_points)
        checks.relation(("joints", "start"), self._check_rates)

    def _check_reaction_length(self) -> None:
        if self.redundant_reactions != MINIMUM_NORM:
            raise InputError(
                'Argument `reaction_length` must be left out unless redundant_reactions is "minimum_norm", to whose '
                "norm it belongs; set that, or leave it out."
            )

    def _check_structure(self) -> None:
        if not self.links:
            raise InputError("Argument `links` must hold at least one link, but is empty; add one.")
        problems = Problems()
        with problems.noted():
            self._check_references()
            self._check_tree()
        for joint in self.joints:
            self._check_positions(joint, problems)
        with problems.noted():
            self._check_driven_joint()
        problems.refuse()

    def _check_points(self) -> None:
        links, known, problems = {link.name: link for link in self.links}, self.named_points, Problems()
        forces = dict.fromkeys((force.name for force in self.forces), "force")
        others = dict.fromkeys(links, "link") | forces
        owners = dict.fromkeys(links, "link") | {joint.name: "joint" for joint in self.joints} | forces
        found: list[Point] = []
        for one in self.points:
            one = one.name if isinstance(one, NamedPoint) else one  # joints and links may have been replaced since
            with problems.noted():
                if isinstance(one, str) and one not in known:
                    raise InputError(
                        "Argument `points` must name joints and ends of links, but the mechanism has no such "
                        f"`{one}`; {suggestion(one, known)}"
                    )
                point = known[one] if isinstance(one, str) else one
                named = isinstance(point, NamedPoint)
                other = (others if named else owners).get(point.name)
                if other:
                    raise InputError(
                        f"Argument `points` must have names of their own, but there is a {other} "
                        f"`{point.name}`, too, and `{point.name}.x` could be of either; rename the "
                        f"{other if named else 'point'}."
                    )
                point.require_links(links)
                found.append(point)
        problems.refuse()
        object.__setattr__(self, "points", tuple(found))

    def _check_rates(self) -> None:
        rated = [joint.name for joint in self.joints if any(rate is not None for rate in joint.start_rates)]
        if rated and self.start == EQUILIBRIUM:
            raise InputError(
                f'Argument `start` must be "as_given" where joints have initial rates, but was "{EQUILIBRIUM}", which '
                f"is at rest, and joint `{rated[0]}` has a rate; leave out `start`, or the rates."
            )

    def link(self, name: str) -> Link:
        """Return the link `name`; raises InputError with the nearest name if there is none."""
        return _find(self.links, name, "link")

    def force(self, name: str) -> Force:
        """Return the force `name`; raises InputError with the nearest name if there is none."""
        return _find(self.forces, name, "force")

    def joint(self, name: str) -> Joint:
        """Return the joint `name`; raises InputError with the nearest name if there is none."""
        return _find(self.joints, name, "joint")

    @property
    def named_points(self) -> dict[str, NamedPoint]:
        """The points that have names already, by these: centres of joints, as "B", and ends of links, as
        "coupler.end"."""
        return named_points(self.links, self.joints)

    def following(self, names: Iterable[str]) -> "Mechanism":
        """This mechanism with the points among `names` that have names already, whose paths runs then follow."""
        known, own = self.named_points, {point.name for point in self.points}
        added = [known[name] for name in dict.fromkeys(names) if name in known and name not in own]
        return replace(self, points=(*self.points, *added)) if added else self

    @property
    def joint_forces(self) -> tuple[JointForce, ...]:
        """The forces along free motions of joints."""
        return tuple(force for force in self.forces if isinstance(force, JointForce))

    @property
    def point_forces(self) -> tuple[PointLoad, ...]:
        """The forces at points of links, between them and along links."""
        return tuple(force for force in self.forces if isinstance(force, PointLoad))

    @property
    def couplings(self) -> tuple[Coupling, ...]:
        """The couplings between joint coordinates."""
        return tuple(force for force in self.forces if isinstance(force, Coupling))

    @property
    def norm_length(self) -> float | None:
        """Length [m] over which moments count in the norm of redundant reactions; None where it is not asked for."""
        if self.redundant_reactions != MINIMUM_NORM:
            return None
        return max(link.length for link in self.links) if self.reaction_length is None else self.reaction_length

    @property
    def tree_joints(self) -> tuple[Joint, ...]:
        """The joints that are not cut, one per link, by depth in the tree, else in the order of links."""
        joints, ordered, level = self._parent_joints(), [], {"base"}
        while level:
            joined = [joints[link.name] for link in self.links if joints[link.name].parent in level]
            ordered += joined
            level = {joint.child for joint in joined}
        return tuple(ordered)

    @property
    def cut_joints(self) -> tuple[Joint, ...]:
        """The joints that close loops, in the order given."""
        return tuple(joint for joint in self.joints if joint.cut)

    @property
    def error_names(self) -> tuple[str, ...]:
        """All names of errors of this mechanism: those of the joints, then those of the links."""
        joints = (f"{joint.name}.{error}" for joint in self.joints for error in joint_errors(KINDS[joint.kind]))
        links = (f"{link.name}.{error}" for link in self.links for error in _link_errors(link))
        return (*joints, *links)

    def error_unit(self, name: str) -> str:
        """Return "rad" or "m"; raises InputError if this mechanism has no error `name`."""
        self.require_error(name)
        return error_unit(name)

    def require_error(self, name: str, where: str = "name") -> None:
        """Raise InputError with the nearest name unless `name` is one of `error_names`."""
        if name not in self.error_names:
            raise InputError(
                f"{subject(where)} must be an error of this mechanism, but it has no error `{name}`; "
                f"{self.about_missing(name) or suggestion(name, self.error_names)}"
            )

    def about_missing(self, name: str) -> str:
        """Why there is no error `name`, and what to do, where its joint exists but is of a kind that has none."""
        joint, _, error = str(name).partition(".")
        if error in (*BOWS, "straightness") and any(link.name == joint for link in self.links):
            return NO_BOW
        kinds = {one.name: one.kind for one in self.joints}
        return why_no_error(kinds[joint], error) if joint in kinds else ""

    def _parent_joints(self) -> dict[str, Joint]:
        return {joint.child: joint for joint in self.joints if not joint.cut}

    def _check_references(self) -> None:
        names = [link.name for link in self.links]
        unknown: dict[str, list[tuple[str, str]]] = {}
        for joint in self.joints:
            for side, known in (("parent", ["base", *names]), ("child", names)):
                if getattr(joint, side) not in known:
                    unknown.setdefault(getattr(joint, side), []).append((side, joint.name))
        problems = []
        for name, sides in unknown.items():
            known = names if sides[0][0] == "child" else ["base", *names]
            also = "".join(f", and `{side}` of `{joint}`," for side, joint in sides[1:])
            problems.append(
                f"Argument `{sides[0][0]}` of joint `{sides[0][1]}`{also} must be "
                f"{'the base or ' if sides[0][0] == 'parent' else ''}a link of the mechanism, but "
                f"there is no link `{name}`; {suggestion(name, known)}"
            )
        if problems:
            raise InputError(*problems)

    def _check_tree(self) -> None:
        """Each link is the child of exactly one joint of the tree, which begins at the base."""
        parents: dict[str, Joint] = {}
        problems = Problems()
        for joint in (joint for joint in self.joints if not joint.cut):
            other = parents.setdefault(joint.child, joint)
            if other is not joint:
                problems.found.append(
                    f"Argument `joints` must reach link `{joint.child}` by one path only, but the "
                    f"joints `{other.name}` and `{joint.name}` both have it as their child: a "
                    "closed loop; declare one joint of the loop cut = true."
                )
        problems.refuse()
        for link in self.links:
            if link.name not in parents:
                with problems.noted():
                    self._refuse_unconnected(link)
        problems.refuse()
        for link in self.links:
            _check_reaches_base(link.name, parents)

    def _refuse_unconnected(self, link: Link) -> None:
        touching = [joint for joint in self.joints if link.name in (joint.parent, joint.child)]
        cut = [joint.name for joint in touching if joint.cut and joint.child == link.name]
        if cut:
            fix = f"it is the child of the cut joint `{cut[0]}` only; leave that joint uncut"
        elif touching:
            fix = f"it is only the parent of joint `{touching[0].name}`; join it to its own parent"
        else:
            fix = f'add a joint with child = "{link.name}"'
        raise InputError(
            "Argument `joints` must connect every link to the base, but link "
            f"`{link.name}` is not the child of any joint of the tree; {fix}."
        )

    @property
    def driven_motions(self) -> tuple[tuple[str, str], ...]:
        """(joint, motion), as ("C", "T_y"), of all free motions that drives act on, in the order of `driven_joint`."""
        return tuple(self._driven_motion(name) for name in self._driven_names())

    def _driven_names(self) -> tuple[str, ...]:
        driven = self.driven_joint
        return () if driven is None else (driven,) if isinstance(driven, str) else driven

    def _driven_motion(self, name: str) -> tuple[str, str]:
        joint, _, motion = name.partition(".")
        driven = self.joint(joint)
        if driven.cut:
            raise InputError(
                "Argument `driven_joint` must be a joint of the tree, but "
                f"`{joint}` is cut; cut another joint of the loop."
            )
        motions = KINDS[driven.kind].motions
        if not motion and len(motions) > 1:
            listed = " or ".join(f'"{joint}.{motion}"' for motion in motions if "_" in motion)
            raise InputError(
                f"Argument `driven_joint` must say which motion of joint `{joint}` is meant, because it is "
                f'{driven.kind}, but was "{name}"; write {listed}.'
            )
        return joint, plain_motion(motion or None, driven.kind, joint, f"the drive on `{joint}`")

    def _check_driven_joint(self) -> None:
        if isinstance(self.driven_joint, list):
            object.__setattr__(self, "driven_joint", tuple(self.driven_joint))
        names = self._driven_names()
        if not isinstance(names, tuple) or any(not isinstance(name, str) for name in names):
            raise InputError(
                f"Argument `driven_joint` must be a name or a list of names, but was {self.driven_joint!r}; write for "
                'example ["A", "C.T_y"].'
            )
        found = [self._driven_motion(name) for name in names]
        for joint, motion in found:
            if found.count((joint, motion)) > 1:
                raise InputError(
                    f"Argument `driven_joint` must have each motion once, but has {motion} of joint `{joint}` twice; "
                    "leave one out."
                )

    def _resolve_forces(self) -> None:
        """Each force knows its joint's motions, or is at points that there are."""
        found, problems = [], Problems()
        links = {link.name: link for link in self.links}
        for force in self.forces:
            with problems.noted():
                if isinstance(force, PointLoad):
                    force.require_points(links)
                if isinstance(force, Coupling):
                    for joint in force.joints:
                        self._require_tree_joint(joint, f"`joints` of coupling `{force.name}`")
                    found.append(force.resolved(*map(self.joint, force.joints)))
                    continue
                if not isinstance(force, JointForce):
                    found.append(force)
                    continue
                if isinstance(force, JointFriction) and force.joint in [joint.name for joint in self.cut_joints]:
                    found.append(force.resolved(self.joint(force.joint)))
                    continue
                self._require_tree_joint(force.joint, f"`joint` of force `{force.name}`")
                found.append(force.resolved(self.joint(force.joint)))
        problems.refuse()
        object.__setattr__(self, "forces", tuple(found))

    def _require_tree_joint(self, name: str, where: str) -> None:
        tree = [joint.name for joint in self.joints if not joint.cut]
        if name not in tree:
            cut = name in [joint.name for joint in self.joints]
            reason = "is cut" if cut else "is not a joint"
            fix = "cut another joint of the loop." if cut else suggestion(name, tree)
            raise InputError(f"Argument {where} must be a joint of the tree, but `{name}` {reason}; {fix}")

    def _check_positions(self, joint: Joint, problems: Problems) -> None:
        """Note what lies off its flexible link; links that there are not are told elsewhere."""
        flexible = {link.name: link for link in self.links if link.flexible and not link.reduced}
        for name, field in ((joint.parent, "position"), (joint.child, "child_position")):
            link, position = flexible.get(name), getattr(joint, field)
            if link is None or position is None or not is_known(position[0], link.length):
                continue
            first = link.length / (2 * (link.elements - 1))
            if not 0.0 <= position[0] <= link.length * (1.0 + _ROUNDING):
                problems.found.append(
                    f"Argument `{field}` of joint `{joint.name}` must lie on the flexible link "
                    f"`{link.name}` (x from 0 to {link.length} m), but has x = {position[0]} m; "
                    "move it, or make the link rigid."
                )
            elif field == "child_position" and not joint.cut and position[0] > first * (1.0 + _ROUNDING):
                problems.found.append(
                    f"Argument `child_position` of joint `{joint.name}` must lie on the first rigid "
                    f"finite element of the flexible link `{link.name}` (x up to {first:.6g} m), but "
                    f"has x = {position[0]} m; let the link start at the joint, or make "
                    "the joint the cut one of its loop."
                )


def _unique(entries: Any, kind: type[Part], where: str) -> tuple[Part, ...]:
    name = kind.__name__
    entries = require_entries(entries, where, kind, f"{name} objects", f"write [{name}(...), ...].")
    twice = [name for name, count in Counter(entry.name for entry in entries).items() if count > 1]
    if twice:
        raise InputError(
            *(f"Argument `{where}` must have unique names, but `{name}` occurs twice; rename one." for name in twice)
        )
    return tuple(entries)


def _find(entries: Sequence[Part], name: str, kind: str) -> Part:
    for entry in entries:
        if entry.name == name:
            return entry
    raise InputError(
        f"Argument `name` must be a {kind} of the mechanism, but it has no {kind} `{name}`; "
        f"{suggestion(name, [entry.name for entry in entries])}"
    )


def _check_reaches_base(name: str, parents: dict[str, Joint]) -> None:
    seen = [name]
    while name != "base":
        name = parents[name].parent
        if name in seen:
            loop = " -> ".join((*seen[seen.index(name) :], name))
            raise InputError(
                f"Argument `joints` must connect every link to the base, but the links {loop} "
                "form a closed loop of their own; declare one joint of the loop cut = true and "
                "join one of its links to the base."
            )
        seen.append(name)


def _link_errors(link: Link) -> tuple[str, ...]:
    """Names of the errors of a link: one with an axis or a reduced body has no twist, which would be about x, and bows
    are of links with errors of form."""
    own = tuple(error for error in LINK_ERRORS if not link.course or error != "twist")
    return (*own, *(BOWS if link.form_errors else ()))
