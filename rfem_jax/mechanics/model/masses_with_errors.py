"""Masses, centres of mass and inertias of all nodes, of links with errors and their point masses.

Place in the pipeline: frames_with_errors, form -> **masses_with_errors** -> with_errors.

Theory (1.5), (1.18), and of links with forms (1.25).
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.model.form import FormErrors, Shaped, bodies_of, hinge_of, point_inertia, shaped
from rfem_jax.mechanics.model.frames_with_errors import displaced, link_values
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import Topology


def node_bodies(
    model: Model, form: FormErrors | None, length: Array, scale: Array
) -> tuple[Float[Array, " nodes"], Float[Array, "3 nodes"], Float[Array, "3 3 nodes"]]:
    """Mass, centre of mass and central inertia of all nodes, point masses included."""
    topology = model.topology
    n_links, nodes = topology.n_links, topology.n_links + topology.n_rfes
    link, share, middle = _node_fractions(topology)
    lengths = link_values(length, link)
    extent = share * lengths
    density, rotary = link_values(model.section.line_density, link), link_values(model.section.rotary, link)
    mass = density * extent
    slender = jnp.asarray(np.array([0.0, 1.0, 1.0]))[:, None] * (mass * extent**2 / 12.0)[None]
    principal = slender + rotary * extent[None]
    is_root = np.arange(nodes) < n_links
    axial = jnp.where(is_root, middle * lengths, 0.0)
    if model.taper is not None:  # theory (1.18), of the link as long as it is
        longer = link_values(scale, link)
        mass, axial = model.taper.mass * longer, model.taper.centre * longer
        slender = jnp.asarray(np.array([0.0, 1.0, 1.0]))[:, None] * (model.taper.spread * longer**3)[None]
        principal = slender + model.taper.rotary * longer[None]
    beam_centre, of_beam = _x_vectors(axial), None
    if form is not None:
        mass, beam_centre, of_beam = _shaped_bodies(model, form)

    holder = np.array(topology.masses, dtype=int)
    point = places_of_masses(model, form, scale)
    # Sums at the nodes that hold them, by products: additions at places would be scatters.
    onto = (holder[:, None] == np.arange(nodes)).astype(float)
    total = mass + model.point_mass @ onto
    moment = mass[None] * beam_centre
    moment = moment + (model.point_mass[None] * point) @ onto
    if topology.massless or topology.reduced:
        there = total > 0.0
        centre = jnp.where(there[None], moment / jnp.where(there, total, 1.0)[None], 0.0)
    else:
        centre = moment / total[None]

    def steiner(m, r):
        identity = jnp.asarray(vectors.IDENTITY)[:, :, None]
        return m[None, None] * (vectors.dot(r, r)[None, None] * identity - r[:, None] * r[None])

    def diagonal(entries):
        return jnp.asarray(vectors.IDENTITY)[:, :, None] * entries[:, None]

    inertia = (diagonal(principal) if of_beam is None else of_beam) + steiner(mass, beam_centre - centre)
    added = diagonal(model.point_inertia) + steiner(model.point_mass, point - centre[:, holder])
    if model.point_products is not None:
        added = added + off_diagonal(model.point_products)
    return total, centre, inertia + added @ onto


def _shaped_bodies(
    model: Model, form: FormErrors
) -> tuple[Float[Array, " nodes"], Float[Array, "3 nodes"], Float[Array, "3 3 nodes"]]:
    """Mass, centre from the reference point, and central inertia of the beams of all nodes."""
    assert model.form is not None
    whole = errors_on_nodes(form, _node_fractions(model.topology)[0])
    about = reference_points(model, form).position
    mass, moment, inertia = bodies_of(model.form.bodies, whole, about, hinge_of(model.topology.plane))
    there = mass > 0.0
    centre = jnp.where(there[None], moment / jnp.where(there, mass, 1.0)[None], 0.0)
    return mass, centre, inertia - point_inertia(mass, centre)


def places_of_masses(model: Model, form: FormErrors | None, scale: Array) -> Float[Array, "3 masses"]:
    held = None if model.form is None else model.form.masses
    point = displaced(model, form, model.point_position, model.topology.masses, held)
    link = np.array([model.topology.link_of(node) for node in model.topology.masses], dtype=int)
    return jnp.concatenate([point[:1] * link_values(scale, link)[None], point[1:]])


def reference_points(model: Model, form: FormErrors) -> Shaped:
    """The reference points of all nodes in the frames of their links."""
    assert model.form is not None
    whole = errors_on_nodes(form, _node_fractions(model.topology)[0])
    return shaped(model.form.middles, whole, hinge_of(model.topology.plane))


def errors_on_nodes(form: FormErrors, links: np.ndarray) -> FormErrors:
    """The errors of the links of nodes, as `form.shaped` takes them."""
    return FormErrors(*(link_values(one, links) for one in form))


def _node_fractions(topology: Topology) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Link, share of its length and middle of every node, in the order of the nodes."""
    fractions = [topology.fractions(l) for l in range(topology.n_links)]
    link = np.concatenate([np.arange(topology.n_links), topology.link_of_rfe])
    share, middle = (np.concatenate([[f[k][0] for f in fractions], *[f[k][1:] for f in fractions]]) for k in (0, 1))
    return link.astype(int), share, middle


def inverse_inertia(topology: Topology, inertia: Float[Array, "3 3 rfes"]) -> Float[Array, "3 3 rfes"]:
    """Inverse inertias; of the free rfes of superelements, which have none, of any."""
    if topology.reduced:
        inertia = inertia + np.asarray(vectors.IDENTITY)[:, :, None] * topology.reduced_rfes
    return vectors.invert_positive(inertia)


def off_diagonal(products: Float[Array, "3 ..."]) -> Float[Array, "3 3 ..."]:
    """Symmetric matrices of J_xy, J_xz, J_yz, with zeros on the diagonal."""
    xy, xz, yz = products
    zero = jnp.zeros_like(xy)
    rows = (zero, xy, xz), (xy, zero, yz), (xz, yz, zero)
    return jnp.stack([jnp.stack(row) for row in rows])


def _x_vectors(values: Array) -> Array:
    """Vectors (3, n) along x."""
    zero = jnp.zeros_like(values)
    return jnp.stack([values, zero, zero])
