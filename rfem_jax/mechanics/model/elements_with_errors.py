"""Spring-damping elements of links with errors: places, stiffness, damping and lever arms.

Place in the pipeline: masses_with_errors, form -> **elements_with_errors** -> with_errors.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Int

from rfem_jax.mechanics.model.form import ActualForm, FormErrors, hinge_of, sde_stiffness, shaped
from rfem_jax.mechanics.model.frames_with_errors import link_values
from rfem_jax.mechanics.model.masses_with_errors import errors_on_nodes, reference_points
from rfem_jax.mechanics.model.model import Model


def spring_damping_elements(model: Model, length: Array) -> dict[str, Any]:
    """Rest position of every free rfe; stiffness, damping and lever arms of the sde on its left (theory (1.7),
    (1.8))."""
    topology = model.topology
    link = topology.link_of_rfe.astype(int)
    count = np.array(topology.elements, dtype=float)[link] - 1.0
    index = np.concatenate([np.arange(n - 1) for n in topology.elements]).astype(int)
    middles = [topology.fractions(l)[1] for l in range(topology.n_links)]
    left = np.concatenate([x[:-1] for x in middles]) if middles else np.zeros(0)
    right = np.concatenate([x[1:] for x in middles]) if middles else np.zeros(0)
    place = (index + 0.5) / np.maximum(count, 1.0)
    extent = link_values(length, link)
    stiffness = link_values(model.section.stiffness, link) * (count / extent)[None]
    if model.taper is not None:  # theory (1.17)
        stiffness = model.taper.stiffness * link_values(model.length / length, link)[None]
    if topology.slender:  # the forces that keep their segments from stretching are no springs'
        stiffness = jnp.where((np.arange(6) < 3)[:, None] & topology.slender_rfes, 0.0, stiffness)
    return {
        "rest": jnp.asarray(right) * extent,
        "stiffness": stiffness,
        "damping": link_values(model.section.damping, link),
        "lever_left": jnp.asarray(place - left) * extent,
        "lever_right": jnp.asarray(place - right) * extent,
        **_bends(model, link, extent / np.maximum(count, 1.0)),
    }


def shaped_elements(model: Model, errors: FormErrors, length: Array) -> dict[str, Any]:
    """As `spring_damping_elements`, of links with forms; places and lever arms are vectors (theory (1.22) to
    (1.24))."""
    topology, form, hinge = model.topology, model.form, hinge_of(model.topology.plane)
    assert form is not None
    link = topology.link_of_rfe.astype(int)
    whole, middles = errors_on_nodes(errors, link), reference_points(model, errors).position
    rest, inner = middles[:, topology.n_links :], np.ones(topology.n_rfes, dtype=bool)
    inner[[a for a, b in topology.ranges if b > a]] = False
    before = jnp.where(inner[None], jnp.roll(rest, 1, axis=1), 0.0)
    sdes = shaped(form.sdes, whole, hinge)
    begin, end = (shaped(one, whole, hinge).position for one in (form.begins, form.ends))
    count = np.array(topology.elements, dtype=float)[link] - 1.0
    return {
        "rest": rest,
        "stiffness": sde_stiffness(form.segments, whole, (sdes.position, begin, end), hinge, topology.reduced_rfes),
        "damping": link_values(model.section.damping, link),
        "lever_left": sdes.position - before,
        "lever_right": sdes.position - rest,
        "form": ActualForm(form.lines, errors, sdes.axes, hinge),
        **_bends(model, link, link_values(length, link) / np.maximum(count, 1.0)),
    }


def _bends(model: Model, link: Int[np.ndarray, " rfes"], apart: Array) -> dict[str, Array]:
    """Rotations of sdes, which are as far `apart` [m], on links that are bent without load."""
    return {} if model.curvature is None else {"bent": link_values(model.curvature, link) * apart[None]}
