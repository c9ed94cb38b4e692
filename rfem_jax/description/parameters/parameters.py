"""The names of all numbers of a mechanism: what a design sets and a tolerance scatters.

Place in the pipeline: parts -> **parameters** -> study, and the mechanics' `design`.

A name is that of a thing and of its number, as "crank.length", "bar.height", "steel.youngs_modulus", "D.position.x",
"B.compliance.radial", "B.clearance.radial", "gravity.x". Each has a full name, too, which begins with the kind of the
thing, as "section.bar.height"; where things of several kinds have one name, only full names are known. What several
links share, a section or a material of one name, is one parameter. Tables are scaled by a `factor`.

Not among them are numbers that follow from others: start values of joints that drives do not hold, which closing the
loops or assembly finds, positions that are left out at the end of a link, and derived shear factors.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from rfem_jax.description.basics.errors import InputError, subject, suggestion
from rfem_jax.description.basics.joint_kinds import KINDS, Freedom
from rfem_jax.description.basics.numbers import ANY, NOT_NEGATIVE, POSITIVE, Fields, read_number
from rfem_jax.description.basics.units import DIMENSIONS
from rfem_jax.description.mechanism.composite_sections import CompositeSection, entry_field
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.forces import Force, JointForce, JointForceTable
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import GRADIENTS, Link
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.point_forces import BetweenPoints, LoadOnLink, PointSpringTable
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.sections import Tube
from rfem_jax.description.parameters.parts import Parts, Path, number_at, parts_of

COMPONENTS = "xyz"


@dataclass(frozen=True)
class Parameter:
    """A number of a mechanism: its full name, the shorter one (None where other things have the same), its dimension,
    the sign that it must have, and where it stands in the parts; `factor`: it scales tables that stand there."""

    full: str
    short: str | None
    dimension: str
    sign: str
    paths: tuple[Path, ...]
    factor: bool = False

    @property
    def name(self) -> str:
        """The shorter name, or else the full one."""
        return self.short or self.full

    @property
    def unit(self) -> str:
        """SI unit."""
        return DIMENSIONS[self.dimension][1]

    def value_in(self, parts: Parts) -> float:
        """Its number [unit]."""
        return 1.0 if self.factor else float(number_at(parts, self.paths[0]))

    def read(self, value: Any, where: str) -> float:
        """A value as a number [unit]; raises InputError for one of another dimension or sign."""
        return read_number(value, (self.dimension, self.sign), where)


@dataclass(frozen=True, eq=False)
class ParameterNames(Mapping[str, Parameter]):
    """Parameters by their short and full names; iterates over one name of each.

    all: the parameters; ambiguous: names of several things, and the kinds of these.
    """

    all: tuple[Parameter, ...]
    ambiguous: tuple[tuple[str, tuple[str, ...]], ...] = ()

    @cached_property
    def _known(self) -> dict[str, Parameter]:
        return {name: one for one in self.all for name in (one.full, one.short) if name is not None}

    def renamed(self, names: Any) -> "ParameterNames":
        """Of things with other names, `names.of(name)`."""
        found = (
            replace(one, full=names.of(one.full), short=None if one.short is None else names.of(one.short))
            for one in self.all
        )
        return ParameterNames(tuple(found), tuple((names.of(owner), kinds) for owner, kinds in self.ambiguous))

    def __iter__(self) -> Iterator[str]:
        return (one.name for one in self.all)

    def __len__(self) -> int:
        return len(self.all)

    def __contains__(self, name: object) -> bool:
        return name in self._known

    def __getitem__(self, name: str) -> Parameter:
        return self.find(name, "name")

    def find(self, name: str, where: str) -> Parameter:
        """The parameter of a name; raises InputError with the nearest one, or for a name of several things."""
        if name in self._known:
            return self._known[name]
        owner = str(name).partition(".")[0]
        kinds = dict(self.ambiguous).get(owner, ())
        full = [f"{kind}.{name}" for kind in kinds if f"{kind}.{name}" in self._known]
        if full:
            raise InputError(
                f"{subject(where)} must tell apart the things that are called `{owner}` ({' and '.join(kinds)}), but "
                f"has `{name}`; write `{'` or `'.join(full)}`."
            )
        if about := self.about(name):
            raise InputError(f"{subject(where)} must name numbers that are given, but {about}")
        raise InputError(
            f"{subject(where)} must name parameters, but `{name}` is not a parameter; {suggestion(name, self._known)}"
        )

    def about(self, name: str) -> str:
        """Why a number of a thing that there is has no name of its own, and what to do; "" where nothing is known."""
        owner, _, component = str(name).partition(".")
        component = component if component in _FOLLOWING else component.partition(".")[0]
        known = component in _FOLLOWING and any(one.startswith(f"{owner}.") for one in self._known)
        return f"`{name}` {_FOLLOWING[component]}." if known else ""


_AT_THE_END = "is left out and lies at the link's end; set the link's length, or give the position in the description"
_DOES_NOT_BEND = "is of a rigid link, or of one without `thermal_expansion`; make it flexible, or give it one"
_FOUND = "follows from closing the loops or from assembly; only what a drive holds is given"
_FOLLOWING = {
    "shear_factor": "is derived from the diameters; give it in the description",
    **dict.fromkeys(("shear_factor_y", "shear_factor_z"), "is derived from the sizes; give it in the description"),
    "points": "is a corner of a polygon, whose torsion constant and shear centre would not follow; change its `scale`",
    "temperature": "has no `thermal_expansion`; give it with the material, the link or the base",
    **dict.fromkeys(GRADIENTS, _DOES_NOT_BEND),
    "angle": _FOUND,
    "displacement": _FOUND,
    **{f"{place}.{axis}": _AT_THE_END for place in ("position", "child_position") for axis in COMPONENTS},
}


def parameters_of(mechanism: Mechanism) -> ParameterNames:
    """All parameters of a mechanism; of the same one, which does not change, they are listed once in a row."""
    last = _last.get("mechanism")
    if last is None or last[0] is not mechanism:
        last = _last["mechanism"] = mechanism, named_parameters(parts_of(mechanism), mechanism.driven_motions)
    return last[1]


_last: dict[str, tuple[Mechanism, ParameterNames]] = {}


def named_parameters(parts: Parts, held: Sequence[tuple[str, str]]) -> ParameterNames:
    """All parameters of parts; `held`: joints and motions whose start values drives hold."""
    found = [
        *_of_links(parts),
        *_of_joints(parts, held),
        *_of_forces(parts),
        *_of_points(parts),
        *_of_base(parts),
        *_of_gravity(),
    ]
    kinds: dict[str, list[str]] = {}
    for one in found:
        kind, owner, *_ = one.full.split(".")
        if kind not in kinds.setdefault(owner, []):
            kinds[owner].append(kind)
    ambiguous = {owner: tuple(several) for owner, several in kinds.items() if len(several) > 1}
    named = [replace(one, short=None) if one.full.split(".")[1] in ambiguous else one for one in found]
    return ParameterNames(tuple(named), tuple(ambiguous.items()))


def _parameter(
    owner: tuple[str, str], name: str, field: tuple[str, str], paths: Sequence[Path], factor: bool = False
) -> Parameter:
    (kind, thing), (dimension, sign) = owner, field
    short = f"{thing}.{name}"
    return Parameter(f"{kind}.{short}", short, dimension, sign, tuple(paths), factor)


def _fields(
    owner: tuple[str, str], thing: Any, fields: Fields, paths: Sequence[Path], before: str = ""
) -> Iterator[Parameter]:
    """Parameters of the fields of a thing that are given: numbers, or three components."""
    for name, field in fields.items():
        value, at = getattr(thing, name), [(*path, name) for path in paths]
        if value is None:
            continue
        if not isinstance(value, (tuple, list)):
            yield _parameter(owner, before + name, field, at)
            continue
        for i, axis in enumerate(COMPONENTS):
            yield _parameter(owner, f"{before}{name}.{axis}", field, [(*path, i) for path in at])


def _of_links(parts: Parts) -> Iterator[Parameter]:
    for i, link in enumerate(parts.links):
        owner, path = ("link", link.name), ("links", i)
        if not link.course:
            yield _parameter(owner, "length", ("length", POSITIVE), [(*path, "length")])
        yield from _fields(owner, link, link.numbers, [path])
        for n, point in enumerate(link.axis):
            yield from _fields(owner, point, point.numbers, [(*path, "axis", n)], f"axis.{n + 1}.")
        for n, point in enumerate(link.camber):
            yield from _fields(owner, point, point.numbers, [(*path, "camber", n)], f"camber.{n + 1}.")
        if link.body is not None:
            yield from _of_body(owner, link.body, (*path, "body"))
        for n, mass in enumerate(link.point_masses, start=1):
            at = (*path, "point_masses", n - 1)
            yield from _fields(owner, mass, mass.numbers, [at], f"point_masses.{n}.")
        for n, station in enumerate(link.stations):
            yield from _fields(owner, station, station.numbers, [(*path, "stations", n)], f"stations.{n + 1}.")
    for kind in ("section", "material"):
        yield from _shared(parts.links, kind)


def _of_kind(links: Sequence[Link], kind: str) -> Iterator[tuple[Path, Link, Any]]:
    """Sections or materials of links, with their places in the parts."""
    for i, link in enumerate(links):
        yield ("links", i, kind), link, getattr(link, kind)
        for n, station in enumerate(link.stations if kind == "section" else ()):
            for name in ("section", "after"):
                yield ("links", i, "stations", n, name), link, getattr(station, name)


def _shared(links: Sequence[Link], kind: str) -> Iterator[Parameter]:
    """Parameters of sections or materials, those of one name and content once."""
    own = [one for one in _of_kind(links, kind) if one[2] is not None]
    by_name: dict[str, list[Any]] = {}
    for _, _, thing in own:
        by_name.setdefault(thing.name, []).append(thing)
    done: set[str] = set()
    for path, link, thing in own:
        alike = thing.name is not None and all(other == thing for other in by_name[thing.name])
        if alike and thing.name in done:
            continue
        users = [at for at, _, other in own if other.name == thing.name] if alike else [path]
        within = [str(step + 1) if isinstance(step, int) else step for step in path[2:]]
        owner, before = ("link", link.name), f"{'.'.join(within)}."
        if alike:
            done.add(str(thing.name))
            owner, before = (kind, str(thing.name)), ""
        fields = dict(thing.numbers)
        if isinstance(thing, Tube) and thing.shear_factor == thing.derived_factor:
            del fields["shear_factor"]
        yield from _fields(owner, thing, fields, users, before)
        if isinstance(thing, CompositeSection):
            yield from _of_matrix(owner, users, before)


def _of_matrix(owner: tuple[str, str], users: Sequence[Path], before: str) -> Iterator[Parameter]:
    """The entries of a stiffness matrix, both of a pair as one."""
    for i in range(6):
        for j in range(i, 6):
            at = [(*path, "stiffness", *place) for path in users for place in dict.fromkeys(((i, j), (j, i)))]
            yield _parameter(owner, f"{before}stiffness.{i + 1}{j + 1}", entry_field(i, j), at)


def _of_body(owner: tuple[str, str], body: RigidBody | ReducedBody, path: Path) -> Iterator[Parameter]:
    yield from _fields(owner, body, body.numbers, [path])
    if isinstance(body, ReducedBody):
        return
    if not isinstance(body.inertia[0], tuple):
        yield from _fields(owner, body, {"inertia": ("moment_of_inertia", POSITIVE)}, [path])
        return
    for i, row in enumerate(COMPONENTS):
        for j, column in list(enumerate(COMPONENTS))[i:]:
            at = [(*path, "inertia", i, j)] + ([(*path, "inertia", j, i)] if i != j else [])
            sign = POSITIVE if i == j else ANY
            yield _parameter(owner, f"inertia.{row}{column}", ("moment_of_inertia", sign), at)


def _of_joints(parts: Parts, held: Sequence[tuple[str, str]]) -> Iterator[Parameter]:
    for j, (joint, springs) in enumerate(zip(parts.joints, parts.springs, strict=True)):
        owner, path = ("joint", joint.name), ("joints", j)
        yield from _fields(owner, joint, joint.numbers, [path])
        for motion in [motion for name, motion in held if name == joint.name]:
            yield _start_value(owner, joint, motion, path)
        for n, (rate, (motion, freedom)) in enumerate(zip(joint.rates or (), _numbered(joint), strict=False)):
            if rate == 0.0:  # it may follow from others
                continue
            dimension = "rate" if freedom.rotation else "speed"
            yield _parameter(owner, f"rates.{motion}", (dimension, ANY), [(*path, "rates", n)])
        if joint.clearance is not None:
            yield from _fields(owner, joint.clearance, joint.clearance.numbers, [(*path, "clearance")], "clearance.")
        for n, spring in enumerate(springs):
            at, turns = ("springs", j, n), "rotational_" if spring.rotation else ""
            name, table = f"compliance.{spring.name}", spring.positions is not None
            if table:
                yield _parameter(owner, f"{name}.factor", ("none", POSITIVE), [(*at, "forces")], factor=True)
            else:
                yield _parameter(owner, name, (f"{turns}stiffness", POSITIVE), [(*at, "stiffness")])
            yield _parameter(owner, f"{name}_damping", (f"{turns}damping", NOT_NEGATIVE), [(*at, "damping")])


def _numbered(joint: Joint) -> list[tuple[str, Freedom]]:
    """The coordinates of a joint with names: "T_x", "R_y"."""
    return [(f"{'TR'[one.rotation]}_{'xyz'[one.axis]}", one) for one in KINDS[joint.kind].freedoms]


def _start_value(owner: tuple[str, str], joint: Joint, motion: str, path: Path) -> Parameter:
    """The start value of a motion that a drive holds."""
    kind = KINDS[joint.kind]
    n = kind.motions.index(motion)
    freedom = kind.freedoms[n]
    if joint.start is not None:
        return _parameter(owner, f"start.{motion}", (freedom.dimension, ANY), [(*path, "start", n)])
    name = "angle" if freedom.rotation else "displacement"
    return _parameter(owner, name, (freedom.dimension, ANY), [(*path, name)])


def _of_forces(parts: Parts) -> Iterator[Parameter]:
    for i, force in enumerate(parts.forces):
        owner, path = ("force", force.name), ("forces", i)
        yield from _fields(owner, force, _force_fields(force, parts), [path])
        if isinstance(force, (JointForceTable, PointSpringTable)):
            yield _parameter(owner, "factor", ("none", ANY), [(*path, "forces")], factor=True)
        if isinstance(force, Coupling) and force.values is not None:
            yield _parameter(owner, "factor", ("none", ANY), [(*path, "values")], factor=True)
        if isinstance(force, LoadOnLink):
            yield from _of_load(owner, force, path)
        if isinstance(force, BetweenPoints):
            for n in range(2):
                for k, axis in enumerate(COMPONENTS):
                    at = [(*path, "points", n, k)]
                    yield _parameter(owner, f"points.{n + 1}.{axis}", ("length", ANY), at)


def _of_load(owner: tuple[str, str], force: LoadOnLink, path: Path) -> Iterator[Parameter]:
    """Of a force or moment on a link: its components, or the factor of its tables."""
    if callable(force.value):
        return
    if force.times is not None:
        tables = [(*path, name) for name in force.vectors if getattr(force, name) is not None]
        yield _parameter(owner, "factor", ("none", ANY), tables, factor=True)
        return
    yield from _fields(owner, force, {name: (dimension, ANY) for name, dimension in force.vectors.items()}, [path])


def _force_fields(force: Force, parts: Parts) -> Fields:
    """Fields of a force that are numbers."""
    if isinstance(force, Coupling):
        return force.numbers_between
    if not isinstance(force, JointForce):
        return force.numbers
    joint = parts.joint(force.joint)
    return force.numbers_along(KINDS[joint.kind].freedoms[force.coordinate(joint)])


def _of_points(parts: Parts) -> Iterator[Parameter]:
    for i, point in enumerate(parts.points):
        yield from _fields(("point", point.name), point, point.numbers, [("points", i)])


def _of_base(parts: Parts) -> Iterator[Parameter]:
    """Of a base that grows with its temperature."""
    for name, (dimension, sign) in {} if parts.base is None else parts.base.numbers.items():
        yield Parameter(f"mechanism.base.{name}", f"base.{name}", dimension, sign, (("base", name),))


def _of_gravity() -> Iterator[Parameter]:
    for i, axis in enumerate(COMPONENTS):
        full, short = f"mechanism.gravity.{axis}", f"gravity.{axis}"
        yield Parameter(full, short, "acceleration", ANY, (("gravity", i),))


def require_each_once(names: Sequence[Parameter], where: str) -> None:
    """Raise InputError if a parameter is named twice, by its two names."""
    twice = [one.full for one, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(
            f"{subject(where)} must name each parameter once, but names `{twice[0]}` twice; leave one out."
        )
