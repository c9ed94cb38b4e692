"""From the tables of a study file to the objects of this package: mechanism, drive, method.

Place in the pipeline: called by `study.load_study`; each function takes one table of the TOML.
The keys are the names of the arguments of Material, Link, ...; "shape" chooses the class of a section, "kind" that of a
drive. Joints, springs and forces are read by `force_reader`.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

from rfem_jax.description.basics.errors import ABSENT, InputError, Problems, located, require_choice, require_name
from rfem_jax.description.basics.tables import (
    build,
    build_by_trial,
    checked_table,
    keys_of,
    keys_of_kind,
    kind_of,
    read_list,
)
from rfem_jax.description.basics.units import positive_quantity
from rfem_jax.description.drives.driven_motions import AnyDrive
from rfem_jax.description.drives.rotations import (
    MomentRamp,
    MomentTable,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
)
from rfem_jax.description.drives.translations import (
    ForceRamp,
    ForceTable,
    PrescribedDisplacements,
    PrescribedRunUp,
    PrescribedSpeed,
)
from rfem_jax.description.mechanism.links import Link, PointMass
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.mechanism import STARTS, Mechanism
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.sections import Circle, GivenSection, Rectangle, Section, Tube
from rfem_jax.description.methods import Method, named_method, setting_names
from rfem_jax.description.study_file.force_reader import read_force, read_joint, read_spring

Part = TypeVar("Part")

SHAPES = {"rectangle": Rectangle, "circle": Circle, "tube": Tube, "given": GivenSection}
DRIVES = {
    "moment_ramp": (MomentRamp, ("moment", "rise_time"), ()),
    "moment_table": (MomentTable, ("times", "moments"), ()),
    "force_ramp": (ForceRamp, ("force", "rise_time"), ()),
    "force_table": (ForceTable, ("times", "forces"), ()),
    "prescribed_rate": (PrescribedRate, ("rate",), ("rise_time",)),
    "prescribed_spin_up": (PrescribedSpinUp, ("rate", "rise_time"), ()),
    "prescribed_table": (PrescribedTable, ("times", "angles"), ()),
    "prescribed_speed": (PrescribedSpeed, ("speed",), ("rise_time",)),
    "prescribed_run_up": (PrescribedRunUp, ("speed", "rise_time"), ()),
    "prescribed_displacements": (PrescribedDisplacements, ("times", "displacements"), ()),
}
_MECHANISM_OPTIONS = ("gravity", "redundant_reactions", "reaction_length", "elements")
MECHANISM_KEYS = (("links", "joints"), ("materials", "sections", "springs", "forces", *_MECHANISM_OPTIONS))
SIMULATION_KEYS = (("duration",), ("method", "save_every", "start"))  # and the settings of the method


def read_mechanism(table: object) -> Mechanism:
    """Return the Mechanism of the table [mechanism]."""
    place = "[mechanism]"
    problems = Problems()
    content = problems.usable(lambda: checked_table(table, place, *MECHANISM_KEYS))
    materials = _read_named(content.get("materials", {}), "mechanism.materials", _read_material, problems)
    sections = _read_named(content.get("sections", {}), "mechanism.sections", _read_section, problems)
    parts = {key: content[key] for key in _MECHANISM_OPTIONS if key in content} | {"links": ABSENT, "joints": ABSENT}
    if content["links"] is not ABSENT:
        with problems.noted():
            parts["links"] = read_list(content["links"], "[[mechanism.links]]", _read_link, materials, sections)
    in_joints = ABSENT
    if content["joints"] is not ABSENT:
        with problems.noted():
            joints = read_list(content["joints"], "[[mechanism.joints]]", read_joint)
            parts["joints"] = [joint for joint, _ in joints]
            in_joints = [force for _, forces in joints for force in forces]
    given = [in_joints]
    for key, read in (("springs", read_spring), ("forces", read_force)):
        given.append(ABSENT)
        if content.get(key, []) is not ABSENT:
            with problems.noted():
                given[-1] = read_list(content.get(key, []), f"[[mechanism.{key}]]", read)
    parts["forces"] = ABSENT if ABSENT in given else [force for forces in given for force in forces]
    return build(Mechanism, parts, place, problems)


def read_drive(table: object, place: str = "[drive]") -> AnyDrive:
    """Return the drive of the table [drive], or of one of [[drives]]."""
    problems = Problems()
    keys = {key for _, required, optional in DRIVES.values() for key in (*required, *optional)}
    content = problems.usable(lambda: checked_table(table, place, ("kind",), ("joint", "motion", *sorted(keys))))
    kind = kind_of(content, DRIVES, "kind", place, problems)
    make, required, optional = DRIVES[kind]
    optional = (*optional, "motion")
    settings = keys_of_kind(content, f'{place} of kind "{kind}"', ("joint", "kind", *required), optional, problems)
    return build(make, {name: value for name, value in settings.items() if name != "kind"}, place, problems)


def read_drives(entries: object) -> tuple[AnyDrive, ...]:
    """Return the drives of the tables [[drives]]."""
    return tuple(read_list(entries, "[[drives]]", read_drive))


def read_simulation(table: object) -> tuple[Any, Method, Any, Any]:
    """Return (duration, Method, save_every or None, start or None) of the table [simulation]."""
    place = "[simulation]"
    problems = Problems()
    required, optional = SIMULATION_KEYS
    content = problems.usable(lambda: checked_table(table, place, required, (*optional, *setting_names())))
    settings = {key: content[key] for key in setting_names() if key in content}
    name = content.get("method", "rk4" if "step" in content else "auto")
    method = None if name is ABSENT else build_by_trial(partial(named_method, name), settings, place, problems)
    for key in ("duration", "save_every"):
        if key in content and content[key] is not ABSENT:
            with problems.noted():
                positive_quantity(content[key], "time", key)
    if content.get("start", ABSENT) is not ABSENT:
        with problems.noted(), located(place):
            require_choice(content["start"], STARTS, "start")
    problems.refuse()
    assert method is not None, "what is missing has been noted"
    return content["duration"], method, content.get("save_every"), content.get("start")


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
) -> dict[str, Part | None] | None:
    """Read tables [header.NAME] by read(name, table, place).

    Returns: None in place of those with a mistake, which is noted, and where there may be others than those found.
    """
    if tables is ABSENT:
        return None
    found: dict[str, Part | None] | None = None
    with problems.noted():
        checked = checked_table(tables, f"[{header}]", optional=_own_keys(tables))
        found = {}
        for name, table in checked.items():
            found[name] = None
            with problems.noted():
                found[name] = read(name, table, f"[{header}.{name}]")
    return found


def _own_keys(table: object) -> Collection[str]:
    return table if isinstance(table, dict) else ()


def _read_material(name: str, table: object, place: str) -> Material:
    problems = Problems()
    settings = problems.usable(lambda: checked_table(table, place, *keys_of(Material, omit=("name",))))
    return build(Material, {"name": name, **settings}, place, problems)


def _read_section(name: str, table: object, place: str) -> Section:
    problems = Problems()
    with problems.noted(), located(place):
        require_name(name, "`name` of a section")
    keys = {field.name for kind in SHAPES.values() for field in fields(kind)} - {"name"}
    content = problems.usable(lambda: checked_table(table, place, ("shape",), sorted(keys)))
    shape = kind_of(content, SHAPES, "shape", place, problems)
    required, optional = keys_of(SHAPES[shape], omit=("name",))
    settings = keys_of_kind(content, f'{place} of shape "{shape}"', ("shape", *required), optional, problems)
    settings = {key: value for key, value in settings.items() if key != "shape"}
    return build(SHAPES[shape], {**settings, "name": name}, place, problems)


def _read_link(
    table: object,
    place: str,
    materials: Mapping[str, Material | None] | None,
    sections: Mapping[str, Section | None] | None,
) -> Link:
    problems = Problems()
    settings = dict(problems.usable(lambda: checked_table(table, place, *keys_of(Link))))
    for key, known in (("section", sections), ("material", materials)):
        name = settings.get(key, ABSENT)
        if name is ABSENT:
            continue
        settings[key] = ABSENT
        if known is None:
            continue
        with problems.noted():
            part = known[_choice(name, known, key, place)]
            settings[key] = ABSENT if part is None else part  # the mistake in that table is noted
    if settings.get("rigid") is True and settings.get("rfes", 1) != 1:
        problems.found.append(
            f"{place}: Argument `rfes` must be left out where rigid = true, but was "
            f"{settings['rfes']!r}; remove one of the two."
        )
        settings["rfes"] = ABSENT
    masses = settings.get("point_masses", [])
    if masses is not ABSENT:
        settings["point_masses"] = ABSENT
        with problems.noted():
            settings["point_masses"] = tuple(read_list(masses, f"{place} point_masses", _read_point_mass))
    if "body" in settings and settings["body"] is not ABSENT:
        body, settings["body"] = settings["body"], ABSENT
        with problems.noted():
            settings["body"] = _read_body(body, f"{place} body")
    return build(Link, settings, place, problems)


def _read_body(table: object, place: str) -> RigidBody:
    problems = Problems()
    settings = problems.usable(lambda: checked_table(table, place, *keys_of(RigidBody)))
    return build(RigidBody, settings, place, problems)


def _read_point_mass(table: object, place: str) -> PointMass:
    problems = Problems()
    settings = problems.usable(lambda: checked_table(table, place, *keys_of(PointMass)))
    return build(PointMass, settings, place, problems)
