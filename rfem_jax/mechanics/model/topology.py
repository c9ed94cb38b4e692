"""What does not change with the numbers of a mechanism: `Topology`, its links, joints and rigid finite elements.

Place in the pipeline: building makes it -> **topology** -> model, all of the mechanics.

A *node* is a rigid body: -1 is the base, 0 .. links-1 are the rfes 0 (one a link, whose frame is the
link frame {p,0}), and links + k is the free rfe k.  All free rfes of all links stand in one array
axis, link by link, so that one operation treats them together.

An *interface* of a link is a free rfe that carries a joint, or that a force element acts on.  Since springs, not
constraints, join the rfes of a flexible link, the rfes 0 and the interfaces form *islands*: trees of bodies joined by
hinges alone, whose root is an interface or a link that is joined to the base.

Symbols: n_links L, n_rfes N (free rfes), joints J = L tree joints (joint l carries link l), then C cut
joints; freedoms F: coordinates of the tree joints; constraints: closure equations of the cut joints.
"""

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from rfem_jax.compilation.naming import Names
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.joint_kinds import COMPONENTS, KINDS, Freedom, JointKind, compliant
from rfem_jax.description.drives.driven_motions import motion_label
from rfem_jax.description.tolerances.error_catalogue import BOWS
from rfem_jax.mechanics.model.form import DRAWN, drawn
from rfem_jax.mechanics.model.superelements import ReducedLink

BASE = -1


class Topology(NamedTuple):
    """How links and joints are connected: the static, hashable part of a model.

    links: names of the links, by their depth in the tree, else in the order of the description.
    joints: names of the joints, the tree joints in the order of their links, then the cut joints.
    joint_order: names of the joints in the order of the description.
    error_names: names of all assembly errors, such as "D.delta_x", "C.child.d_y" or "coupler.length".
    kinds: the kind of each joint, a name in `joint_kinds.KINDS`.
    parents, children: the node on each joint's parent and child side.
    parent_at_end, child_at_end: whether a joint sits at the far end of the link on that side, whose twist
        error then rotates it.
    elements: number of rfes of each link (1: rigid).
    drives: joint coordinates that drives act on, in the order of the description.
    masses: the node that holds each point mass.
    minimum_norm: whether redundant reactions are resolved by the solution of least norm.
    exact: whether the spring-damping elements are geometrically exact.
    idle: joint coordinates that stand for idle freedoms, which statics holds at their start.
    dependent: those of `drives` that follow from the ones before if all links are rigid, which statics holds only
        where their motion is prescribed; blocked: those that follow from them even so.
    holders: nodes of the free rfes that force elements act on.
    sprung: of each joint the motions that its kind holds and that are sprung; () if no joint is compliant.
    clearances: joints with a clearance, whose motions are all sprung: by contacts, which are force elements.
    undriven: joint coordinates that stand for the freedoms that no drive holds (theory (6.9)).
    settles: whether a simulation starts in the equilibrium of these freedoms, and does not hold them at first.
    rated: joint coordinates with initial rates, in the array `Model.start_rates`.
    redundant: number of the closure equations that say nothing new at the start.
    massless: links without mass, which can only be at rest.
    across: what the loads across the plane of planar rigid loops are where nothing else was asked for
        (`planar_loops.reactions_across`), "" for other mechanisms.
    plane: "xz" or "xy", in which the description has planar mechanisms.
    ideal: names of the ideal couplings, whose equations come after those of the cut joints; coupled: the joint
        coordinates of these.
    stations: of every link the rfes that hold its stations inside; () without any.
    shaped: whether links have forms (`form.Form`): their rfes are not on their x axes, or their sdes couple directions.
    curved: links with an axis of their own.
    slender: flexible links whose segments neither stretch nor shear (`slender_links`).
    reduced: links that are superelements (`superelements`).
    """

    links: tuple[str, ...]
    joints: tuple[str, ...]
    joint_order: tuple[str, ...]
    error_names: tuple[str, ...]
    kinds: tuple[str, ...]
    parents: tuple[int, ...]
    children: tuple[int, ...]
    parent_at_end: tuple[bool, ...]
    child_at_end: tuple[bool, ...]
    elements: tuple[int, ...]
    drives: tuple[int, ...]
    masses: tuple[int, ...]
    minimum_norm: bool
    exact: bool = False
    idle: tuple[int, ...] = ()
    dependent: tuple[int, ...] = ()
    blocked: tuple[int, ...] = ()
    holders: tuple[int, ...] = ()
    sprung: tuple[tuple[str, ...], ...] = ()
    clearances: tuple[int, ...] = ()
    undriven: tuple[int, ...] = ()
    settles: bool = False
    rated: tuple[int, ...] = ()
    redundant: int = 0
    massless: tuple[int, ...] = ()
    across: str = ""
    plane: str = "xz"
    ideal: tuple[str, ...] = ()
    coupled: tuple[int, ...] = ()
    stations: tuple[tuple[int, ...], ...] = ()
    shaped: bool = False
    curved: tuple[int, ...] = ()
    slender: tuple[int, ...] = ()
    reduced: tuple[ReducedLink, ...] = ()

    def renamed(self, names: Names) -> "Topology":
        """With other names."""
        texts = ("links", "joints", "joint_order", "error_names", "ideal")
        return self._replace(**{text: tuple(map(names.of, getattr(self, text))) for text in texts})

    @property
    def n_links(self) -> int:
        """Number of links L, and of tree joints."""
        return len(self.links)

    @property
    def n_cuts(self) -> int:
        """Number of cut joints C."""
        return len(self.joints) - len(self.links)

    @property
    def n_rfes(self) -> int:
        """Number of free rfes N."""
        return sum(n - 1 for n in self.elements)

    def kind(self, joint: int) -> JointKind:
        """The kind of a joint, by its index; of a compliant joint with its sprung directions as free motions."""
        kind = KINDS[self.kinds[joint]]
        return compliant(kind, self.sprung[joint]) if self.sprung else kind

    @property
    def own_coordinates(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the rates of every tree joint that are no springs, in the order of its nominal kind."""
        return tuple(tuple(at[n] for n in self.kind(l).own) for l, at in enumerate(self.coordinates))

    @property
    def own_positions(self) -> tuple[tuple[int, ...], ...]:
        """Indices in the position of the plain numbers of every tree joint that are no springs, likewise."""
        plain = (tuple(n for n in self.kind(l).own if n < self.plain(l)) for l in range(self.n_links))
        return tuple(tuple(at[n] for n in own) for own, at in zip(plain, self.positions))

    @property
    def sprung_coordinates(self) -> tuple[int, ...]:
        """Indices of the rates of the tree joints that are sprung directions of compliant joints."""
        own = {k for at in self.own_coordinates for k in at}
        return tuple(k for k in range(self.n_freedoms) if k not in own) if self.sprung else ()

    def tilted(self, coordinate: int) -> tuple[int, int] | None:
        """The place in the position of the first angle of a sprung tilt, and the rate of the second, for the angle of a
        tree joint that turns about one axis; None for other coordinates."""
        link = self.link_of_freedom[coordinate]
        kind = self.kind(link)
        if kind.ball or kind.nominal.angles != 1 or kind.angles != 3 or coordinate != self.coordinates[link].stop - 3:
            return None
        return self.positions[link].stop - 2, coordinate + 2

    @property
    def sprung_rows(self) -> tuple[bool, ...]:
        """For every closure equation of the cut joints whether it is the law of a spring; () for models without such
        springs."""
        rows = [self._sprung_rows(j) for j in self.cuts] if self.sprung else []
        if not any(any(joint) for joint in rows):
            return ()
        return (*(row for joint in rows for row in joint), *(False for _ in self.ideal))

    def _sprung_rows(self, cut: int) -> list[bool]:
        """For every closure equation of one cut joint whether it is the law of a spring."""
        kind = self.kind(cut)
        tilts = any(motion[0] == "R" for motion in self.sprung[cut])
        across = kind.nominal.across
        return [axis not in kind.across for axis in across] + [tilts] * len(kind.nominal.perpendicular)

    @property
    def freedoms(self) -> tuple[Freedom, ...]:
        """The coordinates of the tree joints."""
        return tuple(freedom for l in range(self.n_links) for freedom in self.kind(l).freedoms)

    @property
    def n_freedoms(self) -> int:
        """Number of coordinates of the tree joints, F."""
        return len(self.freedoms)

    @property
    def slides(self) -> tuple[bool, ...]:
        """For every coordinate of the tree joints whether it is a displacement."""
        return tuple(not freedom.rotation for freedom in self.freedoms)

    @property
    def link_of_freedom(self) -> tuple[int, ...]:
        """Link whose joint has each coordinate."""
        return tuple(l for l in range(self.n_links) for _ in self.kind(l).freedoms)

    @property
    def coordinates(self) -> tuple[range, ...]:
        """Indices of the rates of every tree joint, one a coordinate."""
        return _ranges([len(self.kind(l).freedoms) for l in range(self.n_links)])

    @property
    def balls(self) -> bool:
        """Whether any tree joint turns about any axis, and has a quaternion as its position."""
        return any(self.kind(l).ball for l in range(self.n_links))

    def plain(self, link: int) -> int:
        """Number of the coordinates of a tree joint that are plain numbers, first of its position."""
        kind = self.kind(link)
        return len(kind.freedoms) - 3 * kind.ball

    @property
    def positions(self) -> tuple[range, ...]:
        """Indices in the position of the numbers of every tree joint: its plain coordinates, then four of a
        quaternion if it turns about any axis."""
        return _ranges([len(self.kind(l).freedoms) + self.kind(l).ball for l in range(self.n_links)])

    def place_of(self, coordinate: int) -> int:
        """Index in the position of a coordinate that is a plain number."""
        link = self.link_of_freedom[coordinate]
        return self.positions[link][coordinate - self.coordinates[link][0]]

    def motion_of(self, coordinate: int) -> str:
        """Name of the free motion of a coordinate that is a plain number, such as "R_y"."""
        link = self.link_of_freedom[coordinate]
        return self.kind(link).motions[coordinate - self.coordinates[link][0]]

    def about_hinge(self, coordinate: int) -> bool:
        """Whether a coordinate is the angle of a revolute joint."""
        return self.kinds[self.link_of_freedom[coordinate]] == "revolute"

    @property
    def drive_labels(self) -> tuple[str, ...]:
        """Names of the free motions that drives act on: "A", or "C.T_y" where the joint has several."""
        joints = [self.link_of_freedom[k] for k in self.drives]
        named = zip(joints, self.drives, strict=True)
        return tuple(motion_label(self.joints[j], self.kinds[j], self.motion_of(k)) for j, k in named)

    @property
    def held(self) -> tuple[int, ...]:
        """Joint coordinates that assembly holds: those of drives, each as far as those before leave it free."""
        return tuple(k for k in self.drives if k not in self.dependent)

    @property
    def held_at_start(self) -> tuple[int, ...]:
        """Joint coordinates that the start of a simulation holds: those of drives and, unless it settles, of all
        further freedoms."""
        return self.held if self.settles else (*self.held, *self.undriven)

    def label_of(self, coordinate: int) -> str:
        """Name of a coordinate for people: "A"; "C.T_y" in a joint with several coordinates; "S.R_x" in a joint that
        turns about any axis."""
        joint = self.link_of_freedom[coordinate]
        freedom = self.freedoms[coordinate]
        motion = f"{'TR'[freedom.rotation]}_{'xyz'[freedom.axis]}"
        return (
            motion_label(self.joints[joint], self.kinds[joint], motion)
            if not freedom.any_axis
            else (f"{self.joints[joint]}.{motion}")
        )

    @property
    def driven(self) -> int | None:
        """Index of the tree joint of the first drive, or None."""
        return self.link_of_freedom[self.drives[0]] if self.drives else None

    @property
    def driven_position(self) -> int | None:
        """Index in the position of the coordinate of the first drive."""
        return self.place_of(self.drives[0]) if self.drives else None

    @property
    def driven_coordinate(self) -> int | None:
        """Index among the rates of the coordinate of the first drive."""
        return self.drives[0] if self.drives else None

    @property
    def constraints(self) -> tuple[range, ...]:
        """Indices of the closure equations of every cut joint, laws of springs among them."""
        return _ranges([self.kind(j).nominal.constraints for j in self.cuts])

    @property
    def n_constraints(self) -> int:
        """Number of closure equations, those of ideal couplings included."""
        return sum(len(rows) for rows in self.constraints) + len(self.ideal)

    @property
    def error_components(self) -> tuple[str, ...]:
        """Names of the errors of one side of a joint, of all that any joint of the model may have."""
        sides = [self.kind(j).errors(child) for j in range(len(self.joints)) for child in (False, True)]
        known = {name for side in sides for name in side} | {"delta_x", "delta_z", "d_x", "d_y", "d_z"}
        return tuple(name for name in (*COMPONENTS[:1], *COMPONENTS[2:], COMPONENTS[1]) if name in known)

    @property
    def cuts(self) -> range:
        """Indices of the cut joints."""
        return range(self.n_links, len(self.joints))

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]:
        """First and past-the-last free rfe of every link."""
        stops = np.cumsum([n - 1 for n in self.elements])
        return tuple((int(b) - n + 1, int(b)) for b, n in zip(stops, self.elements))

    @property
    def link_of_rfe(self) -> Int[np.ndarray, " rfes"]:
        """Link of every free rfe."""
        return np.repeat(np.arange(self.n_links), [n - 1 for n in self.elements])

    def fractions(self, link: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lengths and middles of a link's rfes as fractions of its length."""
        for one in self.reduced:
            if one.link == link:
                return np.eye(len(one.middles))[0], one.middles
        return rfe_fractions(self.elements[link])

    @property
    def reduced_rfes(self) -> Bool[np.ndarray, " rfes"]:
        """Whether every free rfe is of a superelement."""
        return np.isin(self.link_of_rfe, [one.link for one in self.reduced])

    @property
    def carriers(self) -> Bool[np.ndarray, " rfes"]:
        """Whether every free rfe carries amplitudes of modes."""
        last = [range(self.ranges[one.link][1] - one.carriers, self.ranges[one.link][1]) for one in self.reduced]
        return np.isin(np.arange(self.n_rfes), [k for some in last for k in some])

    @property
    def left_over(self) -> Bool[np.ndarray, "6 rfes"]:
        """Which coordinates of free rfes are left over by superelements."""
        found = np.zeros((6, self.n_rfes), dtype=bool)
        for one in self.reduced:
            found[6 - one.idle :, self.ranges[one.link][1] - 1] = True
        return found

    @property
    def slender_rfes(self) -> Bool[np.ndarray, " rfes"]:
        """Whether every free rfe is of a link whose segments neither stretch nor shear."""
        return np.isin(self.link_of_rfe, self.slender)

    @property
    def interfaces(self) -> tuple[int, ...]:
        """The free rfes that carry a joint or hold a force element (as rfes, not as nodes)."""
        nodes = self.parents + self.children[self.n_links :] + self.holders
        return tuple(sorted({node - self.n_links for node in nodes if node >= self.n_links}))

    @property
    def formed(self) -> tuple[int, ...]:
        """The links with errors of form."""
        return tuple(l for l, name in enumerate(self.links) if f"{name}.{BOWS[0]}" in self.error_names)

    def drawn(self, link: int) -> tuple[Float[np.ndarray, " points"], Int[np.ndarray, " points"]]:
        """Shares of its length at which a link is drawn, and the numbers of the rfes that hold these."""
        for one in self.reduced:
            if one.link == link:
                shares = np.linspace(0.0, 1.0, DRAWN * max(2 * len(one.shares), 3) + 1)
                return shares, np.searchsorted(one.shares, shares, side="right").clip(0, len(one.shares) - 1)
        return drawn(self.elements[link])

    def drawn_with(self, link: int) -> Float[np.ndarray, " points"] | None:
        """How much every drawn point of a superelement moves with the interface after that of `drawn`, so that the line
        between both is smooth; None of other links."""
        for one in self.reduced:
            if one.link == link:
                shares, before = self.drawn(link)
                places = np.array([0.0, *one.shares])
                part = (shares - places[before]) / (places[before + 1] - places[before])
                return part**2 * (3.0 - 2.0 * part)
        return None

    def end_of(self, link: int) -> int:
        """The node at the far end of a link: its last rfe, or the last interface of a superelement."""
        first, last = self.ranges[link]
        carriers = sum(one.carriers for one in self.reduced if one.link == link)
        return link if first == last else self.n_links + last - 1 - carriers

    def link_of(self, node: int) -> int:
        """Link that a node belongs to."""
        return node if node < self.n_links else int(self.link_of_rfe[node - self.n_links])

    def to_base(self, node: int) -> list[tuple[int, int]]:
        """The nodes from a node to the base, on the way of the tree, each with its link."""
        way = []
        while node != BASE:
            way.append((node, self.link_of(node)))
            node = self.parents[way[-1][1]]
        return way

    def island_of(self, node: int) -> int:
        """The root of a node's island: an interface of a link that is not slender, or the link joined to the base."""
        while (node < self.n_links and self.parents[node] != BASE) or self.is_slender(node):
            node = self.parents[node] if node < self.n_links else self.link_of(node)
        return node

    def is_slender(self, node: int) -> bool:
        """Whether a node is a free rfe of a slender link."""
        return node >= self.n_links and self.link_of(node) in self.slender

    def joint(self, name: str) -> int:
        """Index of a joint by its name."""
        if name not in self.joints:
            raise InputError(f"Argument `joint` must be one of {self.joints}, but is {name!r}.")
        return self.joints.index(name)


def _ranges(counts: Sequence[int]) -> tuple[range, ...]:
    """Consecutive ranges of given lengths."""
    return tuple(range(a, b) for a, b in pairwise(accumulate(counts, initial=0)))


def rfe_fractions(elements: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Lengths and middles of a link's rfes as fractions of its length (secondary division)."""
    if elements == 1:
        return np.ones(1), np.full(1, 0.5)
    m = elements - 1
    edges = np.concatenate([[0.0], (np.arange(m) + 0.5) / m, [1.0]])
    return np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
