"""From the tables of a study file to the objects of this package: mechanism, drive, method.

Place in the pipeline: called by `study.load_study`; each function takes one table of the TOML.
The keys are the names of the arguments of Material, Link, Joint, ...; "shape" chooses the class of
a section, "kind" that of a drive.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from rfem_jax.description.drives import (
    MomentDrive,
    MomentRamp,
    MomentTable,
    PrescribedDrive,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
)
from rfem_jax.description.errors import InputError, Problems, located, require_choice, require_name
from rfem_jax.description.forces import JointForce, JointForceTable, JointSpring
from rfem_jax.description.joints import Joint
from rfem_jax.description.links import Link, PointMass
from rfem_jax.description.materials import Material
from rfem_jax.description.mechanism import Mechanism
from rfem_jax.description.methods import Method
from rfem_jax.description.sections import Circle, GivenSection, Rectangle, Section, Tube
from rfem_jax.description.tables import checked_list, checked_table, keys_of, named_place

Part = TypeVar("Part")

SHAPES = {"rectangle": Rectangle, "circle": Circle, "tube": Tube, "given": GivenSection}
DRIVES = {
    "moment_ramp": (MomentRamp, ("moment", "rise_time"), ()),
    "moment_table": (MomentTable, ("times", "moments"), ()),
    "prescribed_rate": (PrescribedRate, ("rate",), ("rise_time",)),
    "prescribed_spin_up": (PrescribedSpinUp, ("rate", "rise_time"), ()),
    "prescribed_table": (PrescribedTable, ("times", "angles"), ()),
}
FORCES = {"joint_spring": JointSpring, "joint_table": JointForceTable}
_MECHANISM_OPTIONS = ("gravity", "redundant_reactions", "elements")
MECHANISM_KEYS = (("links", "joints"), ("materials", "sections", "forces", *_MECHANISM_OPTIONS))
_METHOD_KEYS = (
    "step", "rtol", "atol", "stabilisation", "accuracy", "spectral_radius", "corrections",
    "tolerance",
)  # fmt: skip
SIMULATION_KEYS = (("duration",), ("method", "save_every", *_METHOD_KEYS))


def read_mechanism(table: object) -> Mechanism:
    """Return the Mechanism of the table [mechanism]."""
    place = "[mechanism]"
    content = checked_table(table, place, *MECHANISM_KEYS)
    problems = Problems()
    materials = _read_named(content.get("materials", {}), "mechanism.materials", _read_material, problems)
    sections = _read_named(content.get("sections", {}), "mechanism.sections", _read_section, problems)
    links, joints, forces = [], [], []
    with problems.noted():
        links = _read_list(content["links"], "[[mechanism.links]]", _read_link, materials, sections)
    with problems.noted():
        joints = _read_list(content["joints"], "[[mechanism.joints]]", _read_joint)
    with problems.noted():
        forces = _read_list(content.get("forces", []), "[[mechanism.forces]]", _read_force)
    problems.refuse()
    options = {key: content[key] for key in _MECHANISM_OPTIONS if key in content}
    with located(place):
        return Mechanism(links=tuple(links), joints=tuple(joints), forces=tuple(forces), **options)


def read_drive(table: object) -> MomentDrive | PrescribedDrive:
    """Return the drive of the table [drive]."""
    place = "[drive]"
    keys = {key for _, required, optional in DRIVES.values() for key in (*required, *optional)}
    content = checked_table(table, place, ("kind",), ("joint", *sorted(keys)))
    kind = _choice(content["kind"], DRIVES, "kind", place)
    build, required, optional = DRIVES[kind]
    required = ("joint", "kind", *required)
    checked_table(content, f'{place} of kind "{kind}"', required, optional)
    with located(place):
        return build(**{key: value for key, value in content.items() if key != "kind"})


def read_simulation(table: object) -> tuple[Any, Method, Any]:
    """Return (duration, Method, save_every or None) of the table [simulation]."""
    place = "[simulation]"
    content = checked_table(table, place, *SIMULATION_KEYS)
    settings = {key: content[key] for key in _METHOD_KEYS if key in content}
    with located(place):
        method = Method(content.get("method", "rk4" if "step" in content else "auto"), **settings)
    return content["duration"], method, content.get("save_every")


def _choice(value: object, known: Mapping[str, object], key: str, place: str) -> str:
    if not known:
        raise InputError(
            f"{place}: Argument `{key}` must name a table [mechanism.{key}s.NAME], but there is "
            f"none; add [mechanism.{key}s.{value}]."
        )
    with located(place):
        return require_choice(value, tuple(known), key)


def _read_named(
    tables: object, header: str, read: Callable[[str, object, str], Part], problems: Problems
) -> dict[str, Part | None]:
    """Read tables [header.NAME] by read(name, table, place); None stands for those with a mistake, which is noted."""
    found: dict[str, Part | None] = {}
    with problems.noted():
        for name, table in checked_table(tables, f"[{header}]", optional=_own_keys(tables)).items():
            found[name] = None
            with problems.noted():
                found[name] = read(name, table, f"[{header}.{name}]")
    return found


def _own_keys(table: object) -> Collection[str]:
    return table if isinstance(table, dict) else ()


def _read_list(entries: object, header: str, read: Callable[..., Part], *known: Mapping[str, object]) -> list[Part]:
    """Read tables [[header]] by read(table, place, *known)."""
    found, problems = [], Problems()
    for number, entry in enumerate(checked_list(entries, header), start=1):
        with problems.noted():
            found.append(read(entry, named_place(header, entry, number), *known))
    problems.refuse()
    return found


def _read_material(name: str, table: object, place: str) -> Material:
    content = checked_table(table, place, *keys_of(Material, omit=("name",)))
    with located(place):
        return Material(name=name, **content)


def _read_section(name: str, table: object, place: str) -> Section:
    keys = {field.name for kind in SHAPES.values() for field in fields(kind)}
    content = checked_table(table, place, ("shape",), sorted(keys))
    shape = _choice(content["shape"], SHAPES, "shape", place)
    required, optional = keys_of(SHAPES[shape])
    checked_table(content, f'{place} of shape "{shape}"', ("shape", *required), optional)
    with located(place):
        require_name(name, "`name` of a section")
        return SHAPES[shape](**{key: value for key, value in content.items() if key != "shape"})


def _read_link(
    table: object, place: str, materials: Mapping[str, Material | None], sections: Mapping[str, Section | None]
) -> Link:
    settings = dict(checked_table(table, place, *keys_of(Link)))
    for key, known in (("section", sections), ("material", materials)):
        if key in settings:
            settings[key] = known[_choice(settings[key], known, key, place)]
            if settings[key] is None:
                raise InputError()  # nothing to add: the mistake in that table is noted
    if settings.get("rigid") is True and settings.get("rfes", 1) != 1:
        raise InputError(
            f"{place}: Argument `rfes` must be left out where rigid = true, but was "
            f"{settings['rfes']!r}; remove one of the two."
        )
    masses = _read_list(settings.get("point_masses", []), f"{place} point_masses", _read_point_mass)
    with located(place):
        return Link(**{**settings, "point_masses": tuple(masses)})


def _read_point_mass(table: object, place: str) -> PointMass:
    content = checked_table(table, place, *keys_of(PointMass))
    with located(place):
        return PointMass(**content)


def _read_joint(table: object, place: str) -> Joint:
    content = checked_table(table, place, *keys_of(Joint))
    with located(place):
        return Joint(**content)


def _read_force(table: object, place: str) -> JointForce:
    keys = {field.name for kind in FORCES.values() for field in fields(kind)}
    content = checked_table(table, place, ("kind",), sorted(keys))
    kind = _choice(content["kind"], FORCES, "kind", place)
    required, optional = keys_of(FORCES[kind])
    checked_table(content, f'{place} of kind "{kind}"', ("kind", *required), optional)
    with located(place):
        return FORCES[kind](**{key: value for key, value in content.items() if key != "kind"})
