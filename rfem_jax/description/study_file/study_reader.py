"""From the tables of a study file to the objects of this package: mechanism, drive, method.

Place in the pipeline: called by `study.load_study`; each function takes one table of the TOML.
The keys are the names of the arguments of Material, Link, ...; "shape" chooses the class of a section, "kind" that of a
drive. Joints, springs and forces are read by `force_reader`.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rfem_jax.description.basics.errors import ABSENT, InputError, Problems, located, require_choice, require_name
from rfem_jax.description.basics.tables import (
    build,
    build_of_kind,
    checked_table,
    keys_of,
    keys_of_all,
    read_list,
    read_table,
    require_table,
)
from rfem_jax.description.basics.units import positive_quantity
from rfem_jax.description.bodies.body_files import load_body, read_matrices
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
from rfem_jax.description.mechanism.axes import AxisPoint
from rfem_jax.description.mechanism.bases import Base
from rfem_jax.description.mechanism.cambers import CamberPoint
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.links import Link, PointMass
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.mechanism import STARTS, Mechanism
from rfem_jax.description.mechanism.points import Point
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.sections import (
    AngleSection,
    ChannelSection,
    Circle,
    CompositeSection,
    GivenSection,
    HollowRectangle,
    ISection,
    PolygonSection,
    Rectangle,
    Section,
    TeeSection,
    Tube,
)
from rfem_jax.description.mechanism.stations import Station
from rfem_jax.description.methods import Method, named_method, setting_names
from rfem_jax.description.study_file.force_reader import read_force, read_joint, read_spring
from rfem_jax.description.tolerances.error_catalogue import BOWS

SHAPES = {
    "rectangle": Rectangle,
    "circle": Circle,
    "tube": Tube,
    "hollow_rectangle": HollowRectangle,
    "i_section": ISection,
    "channel": ChannelSection,
    "angle": AngleSection,
    "tee": TeeSection,
    "given": GivenSection,
    "composite": CompositeSection,
    "polygon": PolygonSection,
}
DRIVES = {
    "moment_ramp": MomentRamp,
    "moment_table": MomentTable,
    "force_ramp": ForceRamp,
    "force_table": ForceTable,
    "prescribed_rate": PrescribedRate,
    "prescribed_spin_up": PrescribedSpinUp,
    "prescribed_table": PrescribedTable,
    "prescribed_speed": PrescribedSpeed,
    "prescribed_run_up": PrescribedRunUp,
    "prescribed_displacements": PrescribedDisplacements,
}
_MECHANISM_OPTIONS = ("gravity", "redundant_reactions", "reaction_length", "elements", "shaking_point", "plane")
_MECHANISM_TABLES = ("materials", "sections", "springs", "forces", "couplings", "points", "base")
MECHANISM_KEYS = (("links", "joints"), (*_MECHANISM_TABLES, *_MECHANISM_OPTIONS))
BODY_FILE_KEYS = (("file",), ("damping", "units", "grids"))
SIMULATION_KEYS = (("duration",), ("method", "save_every", "start"))  # and the settings of the method


def read_mechanism(table: object, folder: Path = Path()) -> Mechanism:
    """Return the Mechanism of the table [mechanism]; `folder`: of the files that it names."""
    place = "[mechanism]"
    problems = Problems()
    content = checked_table(table, place, *MECHANISM_KEYS, problems)
    materials = _read_named(content.get("materials", {}), "mechanism.materials", _read_material, problems)
    sections = _read_named(content.get("sections", {}), "mechanism.sections", _read_section, problems)

    def all_of(key: str, read: Callable[..., Any], *known: Any) -> Any:
        return problems.attempt(read_list, content.get(key, []), f"[[mechanism.{key}]]", read, *known)

    parts = {key: content[key] for key in _MECHANISM_OPTIONS if key in content}
    parts["links"] = all_of("links", _read_link, materials, sections, folder)
    joints, springs, forces = all_of("joints", read_joint), all_of("springs", read_spring), all_of("forces", read_force)
    parts["points"] = problems.attempt(_read_points, content.get("points", []))
    couplings = all_of("couplings", partial(read_table, Coupling))
    if "base" in content:
        parts["base"] = problems.attempt(read_table, Base, content["base"], "[mechanism.base]")
    parts["joints"] = joints if joints is ABSENT else [joint for joint, _ in joints]
    parts["forces"] = ABSENT
    if ABSENT not in (joints, springs, forces, couplings):
        parts["forces"] = [*(one for _, some in joints for one in some), *springs, *forces, *couplings]
    return build(Mechanism, parts, place, problems)


def with_form_errors(content: dict[str, Any]) -> Any:
    """The table [mechanism] of a study, in which the links have errors of form that are named anywhere else."""
    mechanism, named = content.get("mechanism"), set[str]()

    def look_at(part: Any) -> None:
        if isinstance(part, dict):
            for key, value in part.items():
                look_at(key)
                look_at(value)
        elif isinstance(part, list):
            for one in part:
                look_at(one)
        elif isinstance(part, str) and part.endswith((*(f".{name}" for name in BOWS), ".straightness")):
            named.add(part.rpartition(".")[0])

    look_at({key: one for key, one in content.items() if key != "mechanism"})
    if not named or not isinstance(mechanism, dict) or not isinstance(mechanism.get("links"), list):
        return mechanism

    def asked(link: Any) -> Any:
        formed = isinstance(link, dict) and link.get("name") in named and not link.keys() & {"axis", "body"}
        return {"form_errors": True} | link if formed else link

    return mechanism | {"links": [asked(link) for link in mechanism["links"]]}


def _read_points(entries: Any) -> list[Point | str]:
    """Points of tables, and names of those that have names already."""
    names = [one for one in entries if isinstance(one, str)] if isinstance(entries, list) else []
    tables = [one for one in entries if not isinstance(one, str)] if names else entries
    return [*read_list(tables, "[[mechanism.points]]", partial(read_table, Point)), *names]


def read_drive(table: object, place: str = "[drive]") -> AnyDrive:
    """Return the drive of the table [drive], or of one of [[drives]]."""
    problems = Problems()
    known = ("joint", "motion", *keys_of_all(DRIVES.values(), omit=("joint", "motion")))
    content = checked_table(table, place, ("kind",), known, problems)
    return build_of_kind(content, "kind", DRIVES, drive_keys, place, problems)


def drive_keys(kind: str) -> tuple[list[str], list[str]]:
    """The required and the optional keys of [drive] of a kind."""
    required, optional = keys_of(DRIVES[kind], omit=("joint",))
    return ["joint", "kind", *required], optional


def read_drives(entries: object) -> tuple[AnyDrive, ...]:
    """Return the drives of the tables [[drives]]."""
    return tuple(read_list(entries, "[[drives]]", read_drive))


def read_simulation(table: object) -> tuple[Any, Method, Any, Any]:
    """Return (duration, Method, save_every or None, start or None) of the table [simulation]."""
    place = "[simulation]"
    problems = Problems()
    required, optional = SIMULATION_KEYS
    content = checked_table(table, place, required, (*optional, *setting_names()), problems)
    settings = {key: content[key] for key in setting_names() if key in content}
    name = content.get("method", "rk4" if "step" in content else "auto")
    method = ABSENT
    if name is not ABSENT:
        with problems.noted(), located(place):
            method = named_method(name, **settings)
    for key in ("duration", "save_every"):
        if key in content and content[key] is not ABSENT:
            with problems.noted():
                positive_quantity(content[key], "time", key)
    if content.get("start", ABSENT) is not ABSENT:
        with problems.noted(), located(place):
            require_choice(content["start"], STARTS, "start")
    problems.refuse()
    return content["duration"], method, content.get("save_every"), content.get("start")


def _read_named(tables: object, header: str, read: Callable[[str, object, str], Any], problems: Problems) -> Any:
    """Read tables [header.NAME] by read(name, table, place).

    Returns: ABSENT in place of those with a mistake, which is noted, and where there may be others than those found.
    """
    checked = problems.attempt(require_table, tables, f"[{header}]")
    if checked is ABSENT:
        return ABSENT
    return {name: problems.attempt(read, name, table, f"[{header}.{name}]") for name, table in checked.items()}


def _named_part(name: object, known: Any, key: str, place: str) -> Any:
    """What `_read_named` has found under a name."""
    if known is ABSENT:
        raise InputError()  # told elsewhere
    if not known:
        raise InputError(
            f"{place}: Argument `{key}` must name a table [mechanism.{key}s.NAME], but there is "
            f"none; add [mechanism.{key}s.{name}]."
        )
    with located(place):
        return known[require_choice(name, tuple(known), key)]


def _read_material(name: str, table: object, place: str) -> Material:
    return read_table(Material, table, place, name=name)


def _read_section(name: str, table: object, place: str) -> Section:
    problems = Problems()
    with problems.noted(), located(place):
        require_name(name, "`name` of a section")
    content = checked_table(table, place, ("shape",), keys_of_all(SHAPES.values(), omit=("name",)), problems)
    return build_of_kind(content, "shape", SHAPES, section_keys, place, problems, name=name)


def section_keys(shape: str) -> tuple[list[str], list[str]]:
    """The required and the optional keys of [mechanism.sections.NAME] of a shape."""
    required, optional = keys_of(SHAPES[shape], omit=("name",))
    return ["shape", *required], optional


def _read_link(table: object, place: str, materials: Any, sections: Any, folder: Path = Path()) -> Link:
    problems = Problems()
    required, optional = keys_of(Link)
    if not (isinstance(table, dict) and ("axis" in table or _is_reduced(table.get("body")))):
        required, optional = [*required, "length"], [key for key in optional if key != "length"]
    settings = checked_table(table, place, required, optional, problems)
    for key, known in (("section", sections), ("material", materials)):
        if settings.get(key, ABSENT) is not ABSENT:
            settings[key] = problems.attempt(_named_part, settings[key], known, key, place)
    if settings.get("rigid") is True and settings.get("rfes", 1) != 1:
        problems.found.append(
            f"{place}: Argument `rfes` must be left out where rigid = true, but was "
            f"{settings['rfes']!r}; remove one of the two."
        )
        settings["rfes"] = ABSENT
    if "point_masses" in settings:
        header, read = f"{place} point_masses", partial(read_table, PointMass)
        settings["point_masses"] = problems.attempt(read_list, settings["point_masses"], header, read)
    if "stations" in settings:
        header, read = f"{place} stations", partial(_read_station, sections=sections)
        settings["stations"] = problems.attempt(read_list, settings["stations"], header, read)
    for key, kind in (("axis", AxisPoint), ("camber", CamberPoint)):
        if key in settings:
            settings[key] = problems.attempt(read_list, settings[key], f"{place} {key}", partial(read_table, kind))
    if "body" in settings:
        settings["body"] = problems.attempt(_read_body, settings["body"], f"{place} body", folder)
    return build(Link, settings, place, problems)


def _is_reduced(table: Any) -> bool:
    return isinstance(table, dict) and bool(table.keys() & {"file", "stiffness", "interfaces"})


def _read_body(table: object, place: str, folder: Path) -> RigidBody | ReducedBody:
    """A rigid body, or a reduced one of a file or of two, whose names are relative to a folder."""
    if not isinstance(table, dict) or not _is_reduced(table):
        return read_table(RigidBody, table, place)
    problems, of_one = Problems(), "file" in table
    whole = f"{place} of {'a file' if of_one else 'two files'}"
    settings = checked_table(table, whole, *(BODY_FILE_KEYS if of_one else keys_of(read_matrices)), problems)
    with problems.noted(), located(place):
        for key in ("file", "grids") if of_one else ("mass", "stiffness"):
            if settings.get(key, ABSENT) is not ABSENT:
                settings[key] = folder / _file_name(settings[key], key)
    if ABSENT in settings.values():
        problems.failed = True
    problems.refuse()
    with located(place):
        return load_body(settings.pop("file"), **settings) if of_one else read_matrices(**settings)


def _file_name(name: object, key: str) -> str:
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f'Argument `{key}` of a reduced body must be a path, but was {name!r}; write "rocker.npz".')
    return name


def _read_station(table: object, place: str, sections: Any) -> Station:
    problems = Problems()
    settings = checked_table(table, place, *keys_of(Station), problems)
    for key in ("section", "after"):
        if settings.get(key, ABSENT) is not ABSENT:
            settings[key] = problems.attempt(_named_part, settings[key], sections, "section", place)
    return build(Station, settings, place, problems)
