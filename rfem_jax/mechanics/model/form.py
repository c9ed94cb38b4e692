"""Links that are not straight: rfes and sdes along curves in space, and errors of form.

Place in the pipeline: description.curves, profiles -> **form** -> building, with_errors, section_loads.

All rfes keep axes parallel to those of their link at rest: their places, their bodies, the sdes' lever arms and the
sdes' stiffness, a full matrix in link axes, have the whole form. A curve is run through by its arc length s, the share
s / L of it has what depends on errors: the length's scale, the bow and the twist. Integrals are sums over points of
Gauss between all places where a curve or its sections change, so that the program does not grow with the number of
rfes. Source: theory (1.20) to (1.27), (1.32), (1.33).
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.numbers import array_of, is_known, larger, smaller, traced
from rfem_jax.description.mechanism.curves import Camber, Curve, Values
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.section_bases import CoupledProperties, SectionProperties, inverse_of, stacked
from rfem_jax.description.mechanism.sections import plane_names
from rfem_jax.description.mechanism.stations import Span
from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, cross, cross_matrix, dot, product, scaled
from rfem_jax.mechanics.model.profiles import Profile

NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)  # for an arc of 270 degrees to rounding
LEAST_ACROSS = 0.01  # 1 - of a tangent's part along the hinges, below which nothing says how sections are turned
LOOKED_AT = 200  # places of a curve
ALONG_HINGES = 1e-12  # square of the part of a tangent across the hinges, where it leads along these
# About x: y of a joint, or of a section, is z of its link in the plane xy.
QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
DRAWN = 4  # points of a link to each of its sdes


class Places(eqx.Module):
    """Places along links: position [m], unit tangent, roll [rad] of the section, and share of the link's length;
    camber: measured offsets [m] along y and z and their rates by the place along the link, None where no link has
    any."""

    position: Float[Values, "*q 3 n"]
    tangent: Float[Values, "*q 3 n"]
    roll: Float[Values, "*q n"]
    share: Float[Values, "*q n"]
    camber: Float[Values, "*q 4 n"] | None = None


class Segments(eqx.Module):
    """Points of Gauss of n parts of links: places; weight [m]; compliance per length, in the section's axes; density
    [kg/m], offset [m], of the mass centre in the section's axes, and rotary [kg m], the inertia per length about axes
    through that."""

    places: Places
    weight: Float[Values, "q n"]
    compliance: Float[Values, "q 6 6 n"]
    density: Float[Values, "q n"]
    offset: Float[Values, "q 3 n"]
    rotary: Float[Values, "q 3 3 n"]


class Held(NamedTuple):
    """What is fixed to links: shares of their lengths there, and measured offsets [m] as in `Places`."""

    share: Float[Values, " n"]
    camber: Float[Values, "4 n"] | None = None


class Lines(NamedTuple):
    """The axes of all links, and their measured offsets from these, None where no link has any."""

    curves: tuple[Curve, ...]
    cambers: tuple[Camber, ...] | None

    def of(self, link: int) -> tuple[Curve, Camber | None]:
        """Of one link."""
        return self.curves[link], None if self.cambers is None else self.cambers[link]


class Form(eqx.Module):
    """The forms of all links of a model.

    lines: their axes; middles: reference points of the nodes, of rfe 0 the start of its link; sdes; begins, ends: of
    the sdes' segments; segments: of the sdes; bodies: of the nodes; seats, bores, masses, elements: where joints, point
    masses and both ends of force elements are, by their names.
    """

    lines: Lines
    middles: Places
    sdes: Places
    begins: Places
    ends: Places
    segments: Segments
    bodies: Segments
    seats: Held
    bores: Held
    masses: Held
    elements: dict[str, Held]

    @property
    def curves(self) -> tuple[Curve, ...]:
        """The axes of all links."""
        return self.lines.curves


class Shaped(NamedTuple):
    """Places with the errors of form: position [m], tangent, as long as the curve is stretched, and section axes."""

    position: Float[Array, "3 n"]
    tangent: Float[Array, "3 n"]
    axes: Float[Array, "3 3 n"]


class FormErrors(NamedTuple):
    """Errors of n links, or of the links of n places: scale, lengths over nominal ones; bow [m], along y and z of the
    links; twist [rad], by which the end is turned, zero of links without errors of form; length [m], nominal."""

    scale: Float[Array, " n"]
    bow: Float[Array, "2 n"]
    twist: Float[Array, " n"]
    length: Float[Array, " n"]


class ActualForm(eqx.Module):
    """The forms of all links with their errors.

    errors: of all links; axes: of the sections at the sdes; lines: as of `Form`; hinge: axis of the links that lies
    along the hinges, 1 or 2.
    """

    lines: Lines
    errors: FormErrors
    axes: Float[Array, "3 3 rfes"]
    hinge: int = eqx.field(static=True)

    def at(self, link: int, s: Float[Values, " n"]) -> Shaped:
        """Places at lengths s [m] along a link that is as long as it is, undeformed, in its frame."""
        curve, camber = self.lines.of(link)
        places = _places(curve, camber, s / (self.errors.scale[link] * self.errors.length[link]))
        return shaped(places, self.of_link(link, s.shape[0]), self.hinge)

    def of_link(self, link: int, n: int) -> FormErrors:
        """The errors of one link n times, as `shaped` takes them."""
        return jax.tree.map(lambda one: jnp.broadcast_to(one[..., link, None], (*one.shape[:-1], n)), self.errors)

    def whole(self, link: int) -> Float[Array, ""]:
        """Length [m] of a link along its axis, with its error."""
        return self.errors.scale[link] * self.errors.length[link]


def shaped(places: Places, errors: FormErrors, hinge: int) -> Shaped:
    """Places with the errors of their links (theory (1.26), (1.32), (1.33))."""
    across = jnp.concatenate([jnp.zeros((1, *errors.scale.shape)), errors.bow])
    angle = np.pi * places.share
    position = scaled(errors.scale, places.position) + scaled(jnp.sin(angle), across)
    tangent = scaled(errors.scale, places.tangent) + scaled(np.pi / errors.length * jnp.cos(angle), across)
    if places.camber is not None:
        position, tangent = (
            jnp.concatenate([one[:1], one[1:] + more])
            for one, more in ((position, places.camber[:2]), (tangent, places.camber[2:]))
        )
    return Shaped(
        position, tangent, section_axes(tangent, jnp.asarray(places.roll) + errors.twist * places.share, hinge)
    )


def wave(share: Float[Array, " n"]) -> Float[Array, " n"]:
    """The half-wave of a bow at shares of a link's length."""
    return jnp.sin(np.pi * share)


def section_axes(tangent: Float[Array, "3 n"], roll: Float[Array, " n"], hinge: int) -> Float[Array, "3 3 n"]:
    """Axes of sections, of which the one along the hinges is as near to these as it can be across the curve, before it
    is turned by the roll (theory (1.21))."""
    along = scaled(1.0 / jnp.sqrt(dot(tangent, tangent)), tangent)
    unit = jnp.asarray(vectors.IDENTITY[hinge][:, None])
    across = unit - scaled(along[hinge], along)
    square = dot(across, across)
    # Interfaces of a reduced body may follow each other along the hinges: it has no sections, and any axis does.
    turned = square > ALONG_HINGES
    across = jnp.where(turned, across, jnp.asarray(vectors.IDENTITY[(hinge + 1) % 3][:, None]))
    across = scaled(1.0 / jnp.sqrt(jnp.where(turned, square, 1.0)), across)
    y, z = (across, cross(along, across)) if hinge == 1 else (cross(across, along), across)
    cosine, sine = jnp.cos(roll), jnp.sin(roll)
    return jnp.stack([along, scaled(cosine, y) + scaled(sine, z), scaled(cosine, z) - scaled(sine, y)], axis=1)


def sde_stiffness(
    segments: Segments,
    errors: FormErrors,
    points: tuple[Array, Array, Array],
    hinge: int,
    none: Bool[np.ndarray, " rfes"],
) -> Float[Array, "6 6 rfes"]:
    """Stiffness of sdes in link axes, with the errors of their links, of points [m] of the sdes and of the begins and
    ends of their segments (theory (1.22) to (1.24)); zero of the rfes that have `none`."""
    sde, begin, end = points
    chord = end - begin
    chord = scaled(1.0 / jnp.sqrt(dot(chord, chord)), chord)

    def add(total, segment):
        place = shaped(segment.places, errors, hinge)
        apart = sde - place.position
        lever = cross_matrix(apart - scaled(dot(chord, apart), chord))
        to_force = vectors.transpose(place.axes)
        to_moment = product(to_force, lever)
        loads = jnp.concatenate([
            jnp.concatenate([to_force, jnp.zeros_like(to_force)], axis=1),
            jnp.concatenate([to_moment, to_force], axis=1),
        ])  # fmt: skip
        weight = segment.weight * jnp.sqrt(dot(place.tangent, place.tangent))
        compliance = product(vectors.transposed_product(loads, segment.compliance), loads)
        return total + weight[None, None] * compliance, None

    compliance, _ = jax.lax.scan(add, jnp.zeros((6, 6, sde.shape[1])), segments)
    if not none.any():
        return vectors.invert_positive(compliance)
    there = none[None, None]
    compliance = jnp.where(there, np.eye(6)[:, :, None], compliance)
    return jnp.where(there, 0.0, vectors.invert_positive(compliance))


def bodies_of(
    bodies: Segments, errors: FormErrors, about: Float[Array, "3 nodes"], hinge: int
) -> tuple[Float[Array, " nodes"], Float[Array, "3 nodes"], Float[Array, "3 3 nodes"]]:
    """Mass, first moment about the reference points `about` and inertia about these of parts of links, with the errors
    of these (theory (1.25))."""

    def add(total, part):
        place = shaped(part.places, errors, hinge)
        apart = place.position + apply(place.axes, part.offset) - about
        stretch = jnp.sqrt(dot(place.tangent, place.tangent))
        mass = part.weight * part.density * stretch
        own = vectors.product_transposed(product(place.axes, part.rotary), place.axes)
        inertia = point_inertia(mass, apart) + (part.weight * stretch)[None, None] * own
        return (total[0] + mass, total[1] + scaled(mass, apart), total[2] + inertia), None

    n = about.shape[1]
    return jax.lax.scan(add, (jnp.zeros(n), jnp.zeros((3, n)), jnp.zeros((3, 3, n))), bodies)[0]


def point_inertia(mass: Float[Array, " n"], place: Float[Array, "3 n"]) -> Float[Array, "3 3 n"]:
    """Inertia of point masses about the origin."""
    identity = jnp.asarray(vectors.IDENTITY)[:, :, None]
    return mass[None, None] * (dot(place, place)[None, None] * identity - place[:, None] * place[None])


class Attached(NamedTuple):
    """What is fixed to links: (index of its link, or -1 for the base; place in the link's frame) of seats, bores, point
    masses, and of the two ends of force elements, by their names."""

    seats: Sequence[tuple[int, Any]]
    bores: Sequence[tuple[int, Any]]
    masses: Sequence[tuple[int, Any]]
    elements: dict[str, Sequence[tuple[int, Any]]]


def form_of(
    links: Sequence[Link], plane: str, fractions: Sequence[tuple[np.ndarray, np.ndarray]], attached: Attached
) -> Form:
    """The forms of links, whose rfes have these lengths and middles as fractions of the links' lengths."""
    cambered = any(link.camber for link in links)
    lines = Lines(tuple(link.curve for link in links), tuple(link.offsets for link in links) if cambered else None)
    parts: list[list[Any]] = [[] for _ in range(8)]
    for n_link, (link, (shares, centres)) in enumerate(zip(links, fractions, strict=True)):
        line = lines.of(n_link)
        n, edges = len(shares), np.concatenate([[0.0], np.cumsum(shares)])
        faces = np.arange(n) / max(n - 1, 1)
        profile = None if link.section is None else Profile(link.spans, link.material, plane)
        bodies = _between(profile, line, edges)
        found = (
            _places(*line, np.zeros(1)), _places(*line, centres[1:]),
            _places(*line, centres[1:] if link.reduced and n > 1 else edges[1:-1]),
            _places(*line, faces[:-1]), _places(*line, faces[1:]), _between(profile, line, faces),
            jax.tree.map(lambda x: x[..., :1], bodies), jax.tree.map(lambda x: x[..., 1:], bodies),
        )  # fmt: skip
        for part, one in zip(parts, found, strict=True):
            part.append(one)
    origins, middles, sdes, begins, ends, segments, roots, others = parts
    form = Form(
        lines=lines,
        middles=_joined([*origins, *middles]),
        sdes=_joined(sdes),
        begins=_joined(begins),
        ends=_joined(ends),
        segments=_joined(_padded(segments)),
        bodies=_joined(_padded([*roots, *others])),
        seats=_held(lines, links, attached.seats),
        bores=_held(lines, links, attached.bores),
        masses=_held(lines, links, attached.masses),
        elements={name: _held(lines, links, some) for name, some in attached.elements.items()},
    )
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), form)


def require_turned(links: Sequence[Link], plane: str) -> None:
    """Raise InputError for links that lead along the hinges, where nothing says how their sections are turned."""
    hinge = hinge_of(plane)
    for link in links:
        if not link.axis or not is_known([[one.to, one.through or (), one.radius or 0.0] for one in link.axis]):
            continue
        s = np.linspace(0.0, float(link.curve.length), LOOKED_AT)
        along = np.asarray(link.curve.at(s).tangent)[hinge]
        if (np.abs(along) > 1.0 - LEAST_ACROSS).any():
            at = s[np.abs(along).argmax()]
            raise InputError(
                f"Argument `axis` of link `{link.name}` must not lead along {'xyz'[hinge]}, the direction of the "
                f"hinges, but does at {at:.3g} m along it, where nothing says how its section is turned; turn the "
                "frame of the link by `child_orientation` of its joint, so that its axis leads across."
            )


def hinge_of(plane: str) -> int:
    """The axis of links that lies along the hinges of a plane, 1 or 2."""
    return 1 if plane == "xz" else 2


def _places(curve: Curve, camber: Camber | None, shares: Any) -> Places:
    s = shares * curve.length
    found = curve.at(s)
    return Places(found.position, found.tangent, found.roll, shares, None if camber is None else camber.at(s))


def _held(lines: Lines, links: Sequence[Link], attached: Sequence[tuple[int, Any]]) -> Held:
    """Where places are along the links: of straight links by x, else by the nearest place on the axis."""
    shares: list[Any] = []
    offsets: list[Any] = []
    for index, place in attached:
        if index < 0:
            shares.append(0.0)
            offsets.append(np.zeros(4))
            continue
        curve, camber = lines.of(index)
        at = place[0] if not links[index].course else curve.nearest(array_of(list(place))[:, None])[0]
        shares.append(smaller(larger(at / curve.length, 0.0), 1.0))
        offsets.append(None if camber is None else camber.at(array_of([shares[-1] * curve.length]))[:, 0])
    if lines.cambers is None:
        return Held(array_of(shares))
    return Held(array_of(shares), array_of([list(one) for one in offsets]).reshape(-1, 4).T)


def _between(profile: Profile | None, line: tuple[Curve, Camber | None], edges: Float[np.ndarray, " n"]) -> Segments:
    """Points of Gauss between edges, shares of a link's length."""
    length = line[0].length
    return segments_of(profile, line, edges[:-1] * length, edges[1:] * length)


def segments_of(profile: Profile | None, line: tuple[Curve, Camber | None], start: Any, stop: Any) -> Segments:
    """Points of Gauss of the parts of a link from `start` to `stop` (n,) [m], in every part of its curve and its
    sections, with negative weights where `stop` is smaller; without a profile without mass."""
    curve, camber = line
    xp: Any = jnp if traced(jax.tree.leaves((line, profile, start, stop))) else np
    parts, n = [], len(NODES)
    if profile is not None:
        for s, weight, span in _pieces(xp, profile, curve, start, stop):
            found = profile.at(span, s.reshape(-1))
            parts.append((s, weight, _per_length(xp, found, profile.plane, s.shape)))
    else:
        nothing = np.zeros((n, start.shape[0]))
        parts = [(nothing, nothing, (np.zeros((n, 6, 6, nothing.shape[1])), nothing, np.zeros((n, 3, nothing.shape[1])),
                                     np.zeros((n, 3, 3, nothing.shape[1]))))]  # fmt: skip
    s, weight = (xp.concatenate([part[i] for part in parts]) for i in (0, 1))
    of_section = (xp.concatenate([part[2][i] for part in parts]) for i in range(4))
    at = curve.at(s.reshape(-1))
    position, tangent = (xp.moveaxis(one.reshape((3, *s.shape)), 0, 1) for one in (at.position, at.tangent))
    offsets = None if camber is None else xp.moveaxis(camber.at(s.reshape(-1)).reshape((4, *s.shape)), 0, 1)
    places = Places(position, tangent, at.roll.reshape(s.shape), s / curve.length, offsets)
    return Segments(places, weight, *of_section)


def _pieces(xp: Any, profile: Profile, curve: Curve, start: Any, stop: Any) -> Iterator[tuple[Any, Any, Span]]:
    """Places (q, n) [m] and weights [m] of Gauss's points of all parts of a link, and the spans that these are in."""
    for span in profile.spans:
        for k in range(curve.angles.shape[0]):
            first = xp.maximum(span.begin, curve.edges[k])
            last = xp.maximum(first, xp.minimum(span.end, curve.edges[k + 1]))
            low, high = (xp.minimum(xp.maximum(x, first), last) for x in (start, stop))
            s = 0.5 * (low + high)[None] + 0.5 * (high - low)[None] * NODES[:, None]
            yield s, 0.5 * (high - low)[None] * WEIGHTS[:, None], span


def _per_length(xp: Any, found: SectionProperties, plane: str, shape: tuple[int, ...]) -> tuple[Any, Any, Any, Any]:
    """Compliance (q, 6, 6, n), density (q, n), offset (q, 3, n) and rotary (q, 3, 3, n) of sections, in their axes
    along a link's."""
    y, z = plane_names(plane)
    names = "axial", f"shear_{y}", f"shear_{z}", "torsion", f"bending_{y}", f"bending_{z}"
    density = xp.broadcast_to(found.line_density, shape[0] * shape[1]).reshape(shape)
    if isinstance(found, CoupledProperties):
        compliance, offset, rotary = (_everywhere(xp, one, shape) for one in _of_coupled(found, plane))
        return compliance, density, offset[:, :, 0], rotary
    compliance = [1.0 / xp.broadcast_to(getattr(found, name), shape[0] * shape[1]).reshape(shape) for name in names]
    rotary = [
        xp.broadcast_to(getattr(found, f"rotary_{axis}"), shape[0] * shape[1]).reshape(shape) for axis in ("x", y, z)
    ]
    return _diagonal(xp, compliance), density, np.zeros((shape[0], 3, shape[1])), _diagonal(xp, rotary)


def _of_coupled(found: CoupledProperties, plane: str) -> tuple[Any, Any, Any]:
    """Compliance (6, 6), offset (3, 1) and rotary (3, 3), or for each of several places, in axes along a link's."""
    turn = QUARTER if plane == "xy" else np.eye(3)
    both = np.kron(np.eye(2), turn)
    offset = stacked([[0.0], [found.offset_y], [found.offset_z]])
    y, z, yz = found.rotary_y, found.rotary_z, found.product
    rotary = stacked([[found.rotary_x, 0.0, 0.0], [0.0, y, yz], [0.0, yz, z]])
    return both @ inverse_of(found.matrix)[0] @ both.T, turn @ offset, turn @ rotary @ turn.T


def _everywhere(xp: Any, matrix: Any, shape: tuple[int, ...]) -> Any:
    """Matrices (q, r, c, n) of one (r, c), or of one for each of q n places."""
    rows = matrix.shape[-2:]
    return xp.moveaxis(xp.broadcast_to(matrix, (shape[0] * shape[1], *rows)).reshape((*shape, *rows)), 1, -1)


def _diagonal(xp: Any, entries: list[Any]) -> Any:
    """Diagonal matrices (q, k, k, n) of k entries (q, n)."""
    return xp.stack(entries, axis=1)[:, :, None] * np.eye(len(entries))[None, :, :, None]


def _padded(parts: list[Segments]) -> list[Segments]:
    """With as many points each, those that are added without weight."""
    most = max(part.weight.shape[0] for part in parts)
    filled = []
    for part in parts:
        xp: Any = jnp if traced(jax.tree.leaves(part)) else np
        more = np.arange(most) % part.weight.shape[0]
        weight = xp.where(np.arange(most)[:, None] < part.weight.shape[0], part.weight[more], 0.0)
        filled.append(eqx.tree_at(lambda one: one.weight, jax.tree.map(lambda x, more=more: x[more], part), weight))
    return filled


def _joined(parts: Sequence[Any]) -> Any:
    """Parts of all links beside each other."""
    xp: Any = jnp if traced([leaf for part in parts for leaf in jax.tree.leaves(part)]) else np
    return jax.tree.map(lambda *some: xp.concatenate(some, axis=-1), *parts)


def drawn(elements: int) -> tuple[Float[np.ndarray, " points"], Int[np.ndarray, " points"]]:
    """Shares of its length at which a link with a form is drawn, and the numbers of the rfes that hold these."""
    shares = np.linspace(0.0, 1.0, DRAWN * max(elements - 1, 2) + 1)
    if elements == 1:
        return shares, np.zeros(len(shares), dtype=int)
    return shares, np.clip((shares * (elements - 1) + 0.5).astype(int), 0, elements - 1)
