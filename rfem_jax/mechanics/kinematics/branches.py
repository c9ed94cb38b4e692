"""On which side the loops close: their assembly modes, or branches.

Place in the pipeline: kinematics, cut_joints -> **branches** -> observation.

A loop passes from one side to the other where its closure, as equations for two of its coordinates, is singular; the
others are given, by drives or by loops that close before it (theory (5.13)).
"""

from functools import lru_cache

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import cross, dot
from rfem_jax.mechanics.kinematics.cut_joints import Closure
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


def assembly_modes(actual: ModelWithErrors, motion: Motion, cuts: Closure) -> Float[Array, " cuts"]:
    """On which side every cut joint closes its loop: +1, -1, or 0 at the change point itself (theory (5.13)).

    The sign of y_L . (one arm x other arm) of the two joints that close the loop; an arm reaches from a hinge to the
    cut joint, or across the slide of a prismatic joint. A planar four-bar has two assembly modes for one crank angle;
    at a change point, where the arms are parallel, it may pass from one to the other. It is 0 where a joint of the loop
    has several coordinates, and for other cut joints than revolute ones.
    """
    modes = []
    for i, links in enumerate(closing_joints(actual.topology)):
        if links is None:
            modes.append(jnp.zeros(()))
            continue
        one, other = (_arm(actual.topology, motion, cuts, i, link) for link in links)
        modes.append(jnp.sign(dot(cuts.rotation[:, 1, i], cross(one, other))))
    return jnp.stack(modes)


def _arm(topology: Topology, motion: Motion, cuts: Closure, cut: int, link: int) -> Float[Array, "3"]:
    """Arm of the joint of a link to a cut joint."""
    if topology.kind(link).nominal.freedoms[0].rotation:
        return cuts.centre[:, cut] - motion.hinges.point[:, link]
    # A slide moves as about a hinge far away across it.
    return cross(motion.axis[3:, topology.own_coordinates[link][0]], cuts.rotation[:, 1, cut])


@lru_cache(maxsize=256)
def closing_joints(topology: Topology) -> tuple[tuple[int, int] | None, ...]:
    """By cut joint the links whose tree joints close its loop, two that are not driven; None where no side is told.

    Of several loops that share joints the one with the fewest takes its own first. Where more than two are left, the
    others are taken as given: the nearest on both sides of the cut joint close it, or the two nearest on one side.
    """
    sides = [_sides(topology, i) for i in range(topology.n_cuts)]
    found: dict[int, tuple[int, int] | None] = {i: None for i, one in enumerate(sides) if one is None}
    taken: set[int] = set()
    while len(found) < len(sides):
        left_over = {
            i: [[link for link in side if link not in taken] for side in one]
            for i, one in enumerate(sides)
            if one is not None and i not in found
        }
        cut = min(left_over, key=lambda i: sum(map(len, left_over[i])))
        left, right = left_over[cut]
        nearest = [*left[:1], *right[:1]] if left and right else [*left[:2], *right[:2]]
        taken.update(nearest)
        told = len(nearest) == 2 and topology.kind(topology.cuts[cut]).nominal.motions == ("R_y",)
        found[cut] = (nearest[0], nearest[1]) if told else None
    return tuple(found[i] for i in range(len(sides)))


def _sides(topology: Topology, cut: int) -> tuple[list[int], list[int]] | None:
    """Links on both sides of a cut joint, from there on, whose joints move the loop and are not driven; None where a
    joint of the loop has several coordinates."""
    joint = topology.n_links + cut
    left, right = (
        [link for _, link in topology.to_base(side[joint])] for side in (topology.parents, topology.children)
    )
    sides = [link for link in left if link not in right], [link for link in right if link not in left]
    count = {link: len(topology.kind(link).nominal.freedoms) for side in sides for link in side}
    if any(number > 1 for number in count.values()):
        return None

    def free(link: int) -> bool:
        return count[link] == 1 and topology.own_coordinates[link][0] not in topology.drives

    return [link for link in sides[0] if free(link)], [link for link in sides[1] if free(link)]
