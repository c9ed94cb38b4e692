"""Inertia, weight and loads along the link of pieces of beam between two places on rfes.

Place in the pipeline: link_bodies, form, profiles, line_loads -> **link_pieces** -> section_loads.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, cross
from rfem_jax.mechanics.dynamics.link_bodies import LinkBodies, inertial_wrench, length_of, middles_of, rests_of
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.shaped_lines import shaped_line
from rfem_jax.mechanics.model.form import bodies_of, point_inertia, segments_of
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


def piece_loads(
    model: Model,
    actual: ModelWithErrors,
    link: int,
    bodies: LinkBodies,
    rfes: Sequence[int],
    piece: tuple[Array, Array],
) -> Array:
    """Rate of momentum minus weight of the pieces of beam between two places [m] on rfes, as wrenches (6, n) at the
    global origin; negative where the second place is smaller."""
    start, stop = piece
    if actual.form is not None:
        return _shaped_piece_loads(model, actual, link, bodies, rfes, piece)
    extent = stop - start
    mass = model.section.line_density[link] * extent
    middle, zero = 0.5 * (start + stop), jnp.zeros_like(start)
    profile = None if model.profiles is None else model.profiles[link]
    if profile is not None:
        longer, about = length_of(actual, link) / model.length[link], middles_of(actual, link, rfes)
        pieces = profile.pieces((start + about) / longer, (stop + about) / longer)
        spread = pieces.spread * longer**3
        inertia = pieces.rotary * longer + jnp.asarray(np.array([0.0, 1.0, 1.0]))[:, None] * spread[None]
        inertia = jnp.asarray(vectors.IDENTITY)[:, :, None] * inertia[:, None]
        middle = pieces.centre * longer - about
        return inertial_wrench(actual, bodies, pieces.mass * longer, jnp.stack([middle, zero, zero]), inertia)
    principal = [model.section.rotary[i, link] * extent for i in range(3)]
    slender = mass * extent**2 / 12.0
    principal = jnp.stack([principal[0], principal[1] + slender, principal[2] + slender])
    inertia = jnp.asarray(vectors.IDENTITY)[:, :, None] * principal[:, None]
    return inertial_wrench(actual, bodies, mass, jnp.stack([middle, zero, zero]), inertia)


def _shaped_piece_loads(
    model: Model,
    actual: ModelWithErrors,
    link: int,
    bodies: LinkBodies,
    rfes: Sequence[int],
    piece: tuple[Array, Array],
) -> Array:
    """As `piece_loads`, of a link with a form."""
    form, profile = actual.form, None if model.profiles is None else model.profiles[link]
    assert form is not None
    scale, about = form.errors.scale[link], middles_of(actual, link, rfes)
    parts = segments_of(profile, form.lines.of(link), *((x + about) / scale for x in piece))
    mass, moment, inertia = bodies_of(parts, form.of_link(link, len(rfes)), rests_of(actual, link, rfes), form.hinge)
    there = mass != 0.0
    centre = jnp.where(there[None], moment / jnp.where(there, mass, 1.0)[None], 0.0)
    return inertial_wrench(actual, bodies, mass, centre, inertia - point_inertia(mass, centre))


def loads_along(
    actual: ModelWithErrors,
    at_nodes: FrameLoads,
    link: int,
    bodies: LinkBodies,
    rfes: Sequence[int],
    piece: tuple[Array, Array],
) -> Array:
    """Loads along the link on pieces of its rfes between two places [m] on these, as wrenches (6, sections) at the
    global origin."""
    assert actual.frame_forces is not None
    middle, total = middles_of(actual, link, rfes), jnp.zeros((6, len(rfes)))
    start, stop = (x + middle for x in piece)
    for name, line in (actual.frame_forces.lines or {}).items():
        if line.link != link:
            continue
        assert at_nodes.lines is not None
        if actual.form is not None:
            rests = rests_of(actual, link, rfes)
            force, moment, _ = shaped_line(
                actual.form, line, at_nodes.lines[name], (start, stop), rests, bodies.rotation
            )
            total = total + vectors.wrench_at_origin(moment, force, bodies.point)
            continue
        pieces = line.over(at_nodes.lines[name], start, stop, middle)
        force, lever = pieces.force, pieces.lever
        if line.turning:
            force, lever = apply(bodies.rotation, force), apply(bodies.rotation, lever)
        total = total + vectors.wrench_at_origin(cross(bodies.rotation[:, 0], lever), force, bodies.point)
    return total
