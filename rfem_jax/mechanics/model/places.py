"""Places on links: which rigid finite element holds a point, and where it is on that.

Place in the pipeline: description -> **places** -> acting_laws, building.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.numbers import Number, array_of
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.reduced_bodies import SAME_PLACE, ReducedBody
from rfem_jax.mechanics.model.superelements import rigid_part
from rfem_jax.mechanics.model.topology import BASE, Topology


class Mass(NamedTuple):
    """A point mass, or a body: mass [kg], its centre [m] in the link frame, principal moments and products of inertia
    (J_xy, J_xz, J_yz) [kg m^2]."""

    mass: Number
    position: Sequence[Number]
    inertia: Sequence[Number]
    products: Sequence[Number] = (0.0, 0.0, 0.0)
    of_body: bool = False


def masses_of(link: Link) -> list[Mass]:
    """The body of a link, if it has one, and its point masses."""
    masses = [Mass(point.mass, point.position, point.inertia) for point in link.point_masses]
    if link.body is None:
        return masses
    if isinstance(link.body, ReducedBody):
        mass, centre, tensor = rigid_part(link.body)
        centre = centre.tolist()
    else:
        mass, centre, tensor = link.body.mass, link.body.centre, link.body.tensor
    products = (tensor[0, 1], tensor[0, 2], tensor[1, 2])
    return [Mass(mass, centre, [tensor[i, i] for i in range(3)], products, True), *masses]


def all_masses(links: Sequence[Link]) -> list[Mass]:
    """Bodies and point masses of all links, in the order of these."""
    return [mass for link in links for mass in masses_of(link)]


class Attachment(NamedTuple):
    """One side of a joint: its node, and whether that is the far end of a link."""

    node: int
    at_end: bool


class DividedLinks(NamedTuple):
    """The links in the order of the model, and their numbers of rfes."""

    links: tuple[Link, ...]
    elements: tuple[int, ...]

    def node(self, index: int, place: Sequence[Any]) -> int:
        """Node that holds a point of a link."""
        link, n = self.links[index], self.elements[index]
        if isinstance(link.body, ReducedBody) and n > 1:
            i = _interface_at(link, link.body, place)
            return index if i == 0 else len(self.links) + sum(n - 1 for n in self.elements[:index]) + i - 1
        x = place[0] if not link.course or n == 1 else _along(link, place)
        edge = np.clip(x / link.length * (n - 1) + 0.5, 0, n - 1)
        i = 0 if n == 1 else int(min(edge, n - 1))
        if i == 0:
            return index
        return len(self.links) + sum(n - 1 for n in self.elements[:index]) + i - 1

    def holder(self, index: int, mass: Mass) -> int:
        """Node that holds a point mass; that of a body is the first one of its link."""
        return index if mass.of_body else self.node(index, [float(x) for x in mass.position])

    def attach(self, owner: str, position: Sequence[float] | None, at_end: bool) -> Attachment:
        """One side of a joint; without a position it is at the link's end (`at_end`) or its start."""
        if owner == "base":
            return Attachment(BASE, False)
        index = [link.name for link in self.links].index(owner)
        link = self.links[index]
        place = place_on(link, position, at_end)
        end = link.course[-1].to if link.course else (link.length,)
        far = max(abs(x - y) for x, y in zip(place, end)) > 1e-12 * link.length
        return Attachment(self.node(index, place), not far)


def node_place(
    topology: Topology, links: Sequence[Link], node: int, position: Sequence[Number] | None, at_end: bool
) -> list[Number]:
    """A place in the frame of the node that holds it [m]; None: the end of its link (`at_end`) or its start."""
    if node == BASE:
        return [0.0, 0.0, 0.0] if position is None else list(position)
    index = topology.link_of(node)
    x, y, z = place_on(links[index], position, at_end)
    if node < topology.n_links:
        return [x, y, z]
    first = topology.ranges[index][0]
    middle = float(topology.fractions(index)[1][node - topology.n_links - first + 1])
    if links[index].course:
        curve = links[index].curve
        about = curve.at(array_of([middle * curve.length])).position
        return [x - about[0, 0], y - about[1, 0], z - about[2, 0]]
    return [x - middle * links[index].length, y, z]


def place_on(link: Link, position: Sequence[Number] | None, at_end: bool) -> Sequence[Number]:
    """A place in a link's frame [m]; None: its end (`at_end`) or its start."""
    if position is not None:
        return position
    if at_end and link.course:
        return link.course[-1].to
    return (link.length if at_end else 0.0, 0.0, 0.0)


def _interface_at(link: Link, body: ReducedBody, place: Sequence[Any]) -> int:
    """The interface at a place of a link with a reduced body, on which alone anything can be fixed."""
    apart = np.linalg.norm(np.asarray(body.interfaces) - np.array(place, dtype=float), axis=1)
    if apart.min() > SAME_PLACE * float(link.length):
        shown = ", ".join(f"({x:.6g}, {y:.6g}, {z:.6g})" for x, y, z in np.asarray(body.interfaces))
        raise InputError(
            f"Argument `position` of what is fixed to link `{link.name}` must be an interface of its reduced body, but "
            f"is {tuple(map(float, place))} m; its interfaces are {shown}."
        )
    return int(apart.argmin())


def _along(link: Link, place: Sequence[Any]) -> float:
    """Length along the axis of a link [m] at the place on it that is nearest."""
    return float(link.curve.nearest(np.array(place, dtype=float)[:, None])[0])
