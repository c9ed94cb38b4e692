"""The ways in which the loops of a mechanism close at its start, and which of them is meant.

Place in the pipeline: nominal_geometry -> **assembly_modes** -> discretisation.

Start values that a description leaves out are zero, and closing the loops begins there. Where that fails or goes far
from values that are given, or where the cut joint of a loop says its mode, loops are closed from many starts. Of the
ways that are found the mode decides, then the values that are given; if neither does, the user must.

A loop of four joints has two ways to close at one position of the driven one: with hinges alone they are mirrored at
the diagonal of its two neighbours, and with a slide at the line across it. It is "open" if the driven joint and the
opposite one lie on opposite sides of the diagonal, or with the larger displacement of the slide, and "crossed"
otherwise (theory (5.21)).
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    Placed,
    closure_jacobian,
    geometry_of,
    joint_units,
    moved,
    null_space,
    place,
)
from rfem_jax.mechanics.model.topology import BASE, Topology

STARTS = 24  # from which loops are closed with given values as they are, and as many with these changed, too
SAME = 1e-4  # distance of joints in two ways to close that are one, of the longest link
FAR = 0.5  # rad, or longest links
MOST = 8  # ways of which one can be meant; more, where a freedom is left
OPEN, CROSSED = "open", "crossed"


class Closed(NamedTuple):
    """One way to close: position of the tree joints, residual, alignment and angles of the cut joints, as of
    `discretisation.close_at`."""

    joints: Float[np.ndarray, " numbers"]
    residual: Float[np.ndarray, " constraints"]
    alignment: Float[np.ndarray, " cuts"]
    angles: Float[np.ndarray, " cuts"]


def chosen_closure(
    model: Model, close: Callable[[np.ndarray], Closed], good: Callable[[Closed], bool], modes: Mapping[str, str]
) -> Closed | None:
    """The way to close that is meant; None where none is found.

    **Arguments:** `close`: closes the loops from a start; `good`: whether they are closed then, with all axes alike;
    `modes`: "open" or "crossed" by the names of cut joints.

    **Raises:** `InputError` where several ways are left, and for a mode of a loop that has none.
    """
    start = np.asarray(model.start_joints)
    loops = {name: four_joint_loop(model.topology, name) for name in modes}
    for name, loop in loops.items():
        if loop is None:
            raise InputError(
                f"Argument `mode` of joint `{name}` must be left out unless its loop has four joints, hinges, or three "
                "of them and a slide that no drive moves; give a rough start value of one of its joints instead."
            )
    hinges = [(loop, modes[name]) for name, loop in loops.items() if loop is not None and loop.slide is None]
    # One way has all these modes.
    alone = len(hinges) == model.topology.n_cuts

    def meant(closed: Closed) -> bool:
        return alone and all(modes_of(model, loop, [closed])[0][0] == mode for loop, mode in hinges)

    found = closures(model, close, good, meant, start)
    if len(found) > MOST:
        raise InputError(
            "Argument `mechanism` must say how its loops close at the start, but they do in many ways: a freedom is "
            "left that no drive holds; give start values of the joints, about right."
        )
    for name, loop in loops.items():
        assert loop is not None, "refused before"
        named = [mode for mode, _ in modes_of(model, loop, found)]
        found = [one for one, mode in zip(found, named, strict=True) if mode == modes[name]]
    if len(found) < 2:
        return found[0] if found else None
    given = given_coordinates(model.topology, start)
    if not given:
        raise InputError(_undecided(model, found))
    return min(found, key=lambda one: _distance(model, one.joints, start, given))


def closures(
    model: Model,
    close: Callable[[np.ndarray], Closed],
    good: Callable[[Closed], bool],
    enough: Callable[[Closed], bool],
    start: np.ndarray,
) -> list[Closed]:
    """Different ways to close the loops, from many starts, until one is `enough`."""
    topology, geometry = model.topology, geometry_of(model)
    fixed = {*topology.held, *topology.sprung_coordinates}
    free = [k for k in range(topology.n_freedoms) if k not in fixed]
    left = [k for k in free if k not in given_coordinates(topology, start)]
    generator, units = np.random.default_rng(0), joint_units(geometry)
    found: list[Closed] = []
    for changed in (left, free) if left else (free,):
        for n in range(STARTS):
            change = np.zeros(topology.n_freedoms)
            # The first start is the one of the description.
            change[changed] = units[changed] * generator.uniform(-np.pi, np.pi, len(changed)) * (n > 0)
            closed = close(moved(topology, start, change))
            if good(closed):
                alone = [k for k in free if k not in topology.coupled]  # another turn would be another mesh
                closed = closed._replace(joints=_wrapped(topology, closed.joints, alone))
                if all(_apart(geometry, closed, one) for one in found):
                    found.append(closed)
                    if enough(closed):
                        return found
            if len(found) > MOST:
                return found
    return found


def given_coordinates(topology: Topology, start: np.ndarray) -> list[int]:
    """Coordinates that are not held and of which the description gives a start, which is not zero."""
    plain = [k for l in range(topology.n_links) for k in topology.coordinates[l][: topology.plain(l)]]
    return [k for k in plain if k not in topology.held and start[topology.place_of(k)] != 0.0]


def is_far(model: Model, closed: Closed) -> bool:
    """Whether closing has moved a given start value far away, although the ways to close are isolated."""
    topology, geometry = model.topology, geometry_of(model)
    start = np.asarray(model.start_joints)
    far = [k for k in given_coordinates(topology, start) if _distance(model, closed.joints, start, [k]) > FAR**2]
    if not far:
        return False
    fixed = {*topology.held, *topology.sprung_coordinates}
    free = [k for k in range(topology.n_freedoms) if k not in fixed]
    return null_space(closure_jacobian(geometry, place(geometry, closed.joints))[:, free]).shape[1] == 0


def _wrapped(topology: Topology, joints: np.ndarray, free: Sequence[int]) -> np.ndarray:
    """The same position, free angles between -180 deg and 180 deg."""
    found = np.array(joints)
    for l in range(topology.n_links):
        for k in topology.coordinates[l][: topology.plain(l)]:
            if k in free and not topology.slides[k]:
                at = topology.place_of(k)
                found[at] = np.arctan2(np.sin(found[at]), np.cos(found[at]))
    return found


def _apart(geometry: NominalGeometry, one: Closed, other: Closed) -> bool:
    """Whether any joint is elsewhere; links that can turn alone between two joints do not count."""
    centres = [place(geometry, closed.joints).child_centre for closed in (one, other)]
    return float(np.abs(centres[0] - centres[1]).max()) > SAME * geometry.scale


def _distance(model: Model, joints: np.ndarray, start: np.ndarray, given: Sequence[int]) -> float:
    """Sum of the squares by which given coordinates differ from their start, angles over a radian, lengths over the
    longest link."""
    topology, scale = model.topology, geometry_of(model).scale
    total = 0.0
    for k in given:
        change = joints[topology.place_of(k)] - start[topology.place_of(k)]
        total += (change / scale) ** 2 if topology.slides[k] else 2.0 - 2.0 * np.cos(change)
    return float(total)


class FourJoints(NamedTuple):
    """A loop of four joints in their order: the driven one first, and the two beside it second and last; slide: the
    coordinate of its slide, None for hinges alone."""

    ring: tuple[int, int, int, int]
    slide: int | None


def four_joint_loop(topology: Topology, cut: str) -> FourJoints | None:
    """The loop that a cut joint closes, if it has modes."""
    joint = topology.joints.index(cut)
    ends = topology.parents[joint], topology.children[joint]
    paths = [[link for _, link in topology.to_base(node)] for node in ends]
    while paths[0] and paths[1] and paths[0][-1] == paths[1][-1]:
        paths = [path[:-1] for path in paths]
    ring = [joint, *paths[1], *reversed(paths[0])]
    kinds = [topology.kinds[j] for j in ring]
    slides = [j for j, kind in zip(ring, kinds, strict=True) if kind == "prismatic"]
    if len(ring) != 4 or len(slides) > 1 or any(j >= topology.n_links for j in slides):
        return None
    if any(kind not in ("revolute", "prismatic", "spherical", "cylindrical", "universal") for kind in kinds):
        return None
    held = [topology.link_of_freedom[k] for k in topology.held]
    first = next((j for j in ring if j in held), next((j for j in ring if topology.parents[j] == BASE), ring[0]))
    if first in slides or kinds[ring.index(first)] != "revolute":
        return None
    n = ring.index(first)
    turned = (*ring[n:], *ring[:n])
    return FourJoints(
        (turned[0], turned[1], turned[2], turned[3]), topology.coordinates[slides[0]][0] if slides else None
    )


def modes_of(model: Model, loop: FourJoints, found: Sequence[Closed]) -> list[tuple[str, Placed]]:
    """The mode of a loop in each of several ways to close, "" where it is neither, and where the mechanism stands."""
    topology, geometry, modes = model.topology, geometry_of(model), []
    places = [place(geometry, one.joints) for one in found]
    if loop.slide is not None:
        way = [float(one.joints[topology.place_of(loop.slide)]) for one in found]
        middle = 0.5 * (max(way) + min(way)) if way else 0.0
        names = [OPEN if one > middle else CROSSED for one in way]
        return list(zip(names if len(found) > 1 else [OPEN] * len(found), places, strict=True))
    for placed in places:
        driven, one, opposite, other = (placed.centre[j] for j in loop.ring)
        normal = placed.joint_rotation[loop.ring[0]][:, 1]
        sides = [float(normal @ np.cross(other - one, point - one)) for point in (driven, opposite)]
        modes.append("" if sides[0] * sides[1] == 0.0 else OPEN if sides[0] * sides[1] < 0.0 else CROSSED)
    return list(zip(modes, places, strict=True))


def loop_modes(model: Model) -> dict[str, str]:
    """{cut joint: mode at the start} of the loops of four hinges with parallel axes."""
    topology, found = model.topology, {}
    start = Closed(np.asarray(model.start_joints), np.zeros(0), np.zeros(0), np.zeros(0))
    for name in (topology.joints[j] for j in topology.cuts):
        loop = four_joint_loop(topology, name)
        if loop is None or any(topology.kinds[j] != "revolute" for j in loop.ring):
            continue
        mode, placed = modes_of(model, loop, [start])[0]
        axes = [placed.joint_rotation[j][:, 1] for j in loop.ring]
        if mode and all(np.linalg.norm(np.cross(axes[0], axis)) < SAME for axis in axes):
            found[name] = mode
    return found


def _undecided(model: Model, found: Sequence[Closed]) -> str:
    """That several ways to close are possible, and how one is chosen."""
    topology = model.topology
    cuts = [topology.joints[j] for j in topology.cuts]
    loops = {name: loop for name in cuts if (loop := four_joint_loop(topology, name)) is not None}
    ways = []
    for n, one in enumerate(found):
        words = [f"{name} {mode}" for name, loop in loops.items() if (mode := modes_of(model, loop, found)[n][0])]
        ways.append(f"{start_values_text(topology, one.joints)}" + (f" ({', '.join(words)})" if words else ""))
    fix = f', or mode = "{OPEN}" or "{CROSSED}" of joint `{next(iter(loops))}`' if loops else ""
    return (
        f"Argument `mechanism` must say how its loops close at the start, but they do in {len(found)} ways: "
        f"{'; or '.join(ways)}. Give a rough start value of one of these joints{fix}."
    )


def start_values_text(topology: Topology, joints: Float[np.ndarray, " numbers"]) -> str:
    """Start values of the joints of the tree that move about or along one axis, "A = 30 deg, B = 0.2 m"."""
    names = [topology.joints.index(name) for name in topology.joint_order]
    tree = [l for l in names if l < topology.n_links]
    parts = []
    for k in itertools.chain.from_iterable(topology.own_coordinates[l] for l in tree):
        l = topology.link_of_freedom[k]
        if k - topology.coordinates[l][0] < topology.plain(l):
            value = float(joints[topology.place_of(k)])
            shown = f"{value:.5g} m" if topology.slides[k] else f"{np.degrees(value):.5g} deg"
            parts.append(f"{topology.label_of(k)} = {shown}")
    return ", ".join(parts)
