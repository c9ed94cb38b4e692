"""Tapered and stepped links: integrals over parts of them, and their sections at any place.

Place in the pipeline: description.stations -> **profiles** -> building, with_errors, section_loads.

The formulas of the sections are evaluated at points of Gauss in every span between two stations, so that the program
does not grow with the number of rfes, and masses are exact for sizes that change linearly. Source: theory (1.17) to
(1.19).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.description.basics.numbers import traced
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.section_bases import SectionProperties
from rfem_jax.description.mechanism.sections import CoupledSection, Section, coupled_edges, plane_edges, plane_names
from rfem_jax.description.mechanism.stations import Span, section_between

NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)


class Pieces(NamedTuple):
    """Integrals over n pieces of a link: mass [kg]; centre [m], along the link; spread [kg m^2], of the mass times the
    squared distance from the centre along the link; rotary [kg m^2], of the sections' own inertias; compliance, of one
    over each of the six stiffnesses, as a sde has them."""

    mass: Float[Array, " n"]
    centre: Float[Array, " n"]
    spread: Float[Array, " n"]
    rotary: Float[Array, "3 n"]
    compliance: Float[Array, "6 n"]


class Taper(eqx.Module):
    """Rfes and sdes of all links of a model with stations: mass [kg] of the nodes; centre [m], from the node's
    reference point along the link; spread and rotary [kg m^2], as of `Pieces`; stiffness of the sdes."""

    mass: Float[Array, " nodes"]
    centre: Float[Array, " nodes"]
    spread: Float[Array, " nodes"]
    rotary: Float[Array, "3 nodes"]
    stiffness: Float[Array, "6 rfes"]


class Profile(eqx.Module):
    """The sections along one link: spans between its stations, the material, and the plane of the description."""

    spans: tuple[Span, ...]
    material: Material | None
    plane: str = eqx.field(static=True)

    def pieces(self, start: Any, stop: Any) -> Pieces:
        """Integrals over the pieces from `start` to `stop` (n,) [m]; the opposite where `stop` is smaller."""
        xp: Any = jnp if traced(jax.tree.leaves((self.spans, self.material, start, stop))) else np
        n = len(NODES)
        total: Any = 0.0
        for begin, end, first, last in self.spans:
            low, high = (xp.minimum(xp.maximum(x, begin), end) for x in (start, stop))
            x = (0.5 * (low + high)[None] + 0.5 * (high - low)[None] * NODES[:, None]).reshape(-1)
            weight = (0.5 * (high - low)[None] * WEIGHTS[:, None]).reshape(-1)
            found = self.at(Span(begin, end, first, last), x)
            density = xp.broadcast_to(found.line_density, x.shape)
            y, z = plane_names(self.plane)
            rotary = [getattr(found, f"rotary_{axis}") for axis in ("x", y, z)]
            names = "axial", f"shear_{y}", f"shear_{z}", "torsion", f"bending_{y}", f"bending_{z}"
            rows = [density, density * x, density * x**2, *rotary, *(1.0 / getattr(found, name) for name in names)]
            rows = xp.stack([xp.broadcast_to(row, x.shape) for row in rows])
            total = total + (rows * weight[None]).reshape(len(rows), n, -1).sum(axis=1)
        there = total[0] != 0.0
        mass = xp.where(there, total[0], 1.0)
        centre = xp.where(there, total[1] / mass, 0.0)
        return Pieces(total[0], centre, total[2] - total[0] * centre**2, total[3:6], total[6:])

    def edges(self, x: Float[Array, " sections"]) -> Float[Array, "loads points sections"] | None:
        """Stresses at the edge of the sections at places [m], as `Sections.edges`; None where an edge is not known."""
        found: Any = None
        coupled = any(isinstance(span.first, CoupledSection) for span in self.spans)
        for begin, end, first, last in self.spans:
            section = section_between(first, last, jnp.clip((x - begin) / (end - begin), 0.0, 1.0))
            points = plane_edges(section.edge_stresses(), self.plane)
            points = coupled_edges(points) if coupled else points
            if not points:
                return None
            here = jnp.stack(
                [jnp.stack([jnp.broadcast_to(part, x.shape) for part in point]) for point in points], axis=1
            )
            found = here if found is None else _chosen(x >= begin, here, found)
        return found

    def at(self, span: Span, x: Any) -> SectionProperties:
        """Properties of the sections of one span at places [m]."""
        share = (x - span.begin) / (span.end - span.begin)
        return section_between(span.first, span.last, share).properties(self.material)


def _chosen(where: Array, new: Array, old: Array) -> Array:
    """The new columns where a condition holds; sections of different kinds have their points repeated."""
    points = max(new.shape[1], old.shape[1])
    new, old = (one[:, np.arange(points) % one.shape[1]] for one in (new, old))
    return jnp.where(where[None, None], new, old)


def profile_of(link: Link, plane: str, shaped: bool = False) -> Profile | None:
    """The profile of a link with stations, or with a section where links have forms, whose numbers may be traced; None
    of others."""
    if link.section is None or not (link.stations or shaped):
        return None
    spans = (span._replace(first=_nameless(span.first), last=_nameless(span.last)) for span in link.spans)
    material = None if link.material is None else link.material.with_fields(name="")
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), Profile(tuple(spans), material, plane))


def _nameless(section: Section) -> Section:
    return section.with_fields(name=None)


def taper_of(links: Sequence[Link], edges: Sequence[Float[np.ndarray, " _"]], plane: str) -> Taper | None:
    """The rfes and sdes of links, whose rfes have their ends at shares `edges` of the lengths; None without
    stations."""
    if not any(link.stations for link in links):
        return None
    roots, others, sdes = [], [], []
    for link, shares in zip(links, edges, strict=True):
        m = max(len(shares) - 2, 1)
        if link.section is None:
            nothing: Any = [np.zeros((*rows, 1)) for rows in ((), (), (), (3,), (6,))]
            roots.append(Pieces(*nothing))
            continue
        profile = Profile(link.spans, link.material, plane)
        ends, faces = shares * link.length, np.arange(m + 1) / m * link.length
        bodies = profile.pieces(ends[:-1], ends[1:])
        middle = 0.5 * (ends[1:] + ends[:-1])
        roots.append(_of(bodies, slice(1), 0.0))
        others.append(_of(bodies, slice(1, None), middle[1:]))
        if m + 2 == len(shares):
            sdes.append(1.0 / profile.pieces(faces[:-1], faces[1:]).compliance)
    mass, centre, spread, rotary, _ = (_joined(part) for part in zip(*roots, *others, strict=True))
    return Taper(mass, centre, spread, rotary, _joined(sdes) if sdes else jnp.zeros((6, 0)))


def _of(pieces: Pieces, chosen: slice, about: Any) -> Pieces:
    """Some of the pieces, with their centres from other places."""
    some = Pieces(*(part[..., chosen] for part in pieces))
    return some._replace(centre=some.centre - about)


def _joined(parts: Sequence[Any]) -> Array:
    xp: Any = jnp if traced(parts) else np
    return jnp.asarray(xp.concatenate(parts, axis=-1), jnp.float64)
