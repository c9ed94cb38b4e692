"""All keys of a study file, as its reader knows them: the reference that `rfem-jax keys` prints.

Place in the pipeline: study_reader, tasks -> **key_reference** -> `rfem_jax.report.contents.keys_text`. A table's keys
are the arguments of a class, and what they mean is said in that class's docstring; what differs in a file is said here.
"""

import inspect
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, get_args

from rfem_jax.description.basics.tables import keys_of
from rfem_jax.description.bodies.body_files import load_body, read_matrices
from rfem_jax.description.mechanism.axes import AxisPoint
from rfem_jax.description.mechanism.bases import Base
from rfem_jax.description.mechanism.bearings import Bearing
from rfem_jax.description.mechanism.cambers import CamberPoint
from rfem_jax.description.mechanism.clearance import Clearance
from rfem_jax.description.mechanism.compliance import Compliance, TablesByDirection
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import Link, PointMass
from rfem_jax.description.mechanism.materials import Material
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.points import Point
from rfem_jax.description.mechanism.rigid_bodies import RigidBody
from rfem_jax.description.mechanism.stations import Station
from rfem_jax.description.methods import METHOD_CLASSES, settings_of
from rfem_jax.description.study_file.force_reader import (
    FORCES,
    IN_JOINTS,
    JOINT_KEYS,
    OF_ITS_JOINT,
    SPRINGS,
    force_keys,
    spring_place,
)
from rfem_jax.description.study_file.statics import Statics
from rfem_jax.description.study_file.study import CASE_KEYS, STUDY_KEYS, Case, Study
from rfem_jax.description.study_file.study_reader import (
    BODY_FILE_KEYS,
    DRIVES,
    MECHANISM_KEYS,
    SHAPES,
    SIMULATION_KEYS,
    drive_keys,
    section_keys,
)
from rfem_jax.description.tasks.catalogue import asked_classes
from rfem_jax.description.tolerances.tolerances import CorrelatedTolerances, SpecifiedTolerance
from rfem_jax.description.tolerances.zones import SpecifiedZone
from rfem_jax.task_kinds import task_kinds

NEEDED = "needed"
_IN_A_FILE = {  # where a file has something else than the class
    "materials": "tables [mechanism.materials.NAME]",
    "sections": "tables [mechanism.sections.NAME]",
    "links": "tables [[mechanism.links]], at least one",
    "joints": "tables [[mechanism.joints]]; each link is the child of exactly one that is not cut",
    "springs": "tables [[mechanism.springs]], as well as those of [[mechanism.forces]]",
    "forces": "tables [[mechanism.forces]]",
    "couplings": "tables [[mechanism.couplings]] between coordinates of two joints",
    "points": "tables [[mechanism.points]], whose paths runs follow, or a list of names of joints and ends of links, "
    'as ["B", "coupler.end"]',
    "base": "the table [mechanism.base], of a base that grows with its temperature",
    "section": "name of a table [mechanism.sections.NAME] (a rigid link needs it for its mass, unless it has a body)",
    "material": 'name of a table [mechanism.materials.NAME]; none with a section of shape "given"',
    "body": "table in the place of section and material: {mass = ..., centre = ..., inertia = ...} of a rigid link, "
    "{file = ...} or {mass = ..., stiffness = ..., interfaces = ...} of reduced matrices",
    "stations": "list of tables, [{x = ..., section = ..., after = ...}, ...]",
    "axis": "list of tables, [{to = ..., through = ...}, ...], through which a link leads that is not straight",
    "camber": "list of tables, [{x = ..., y = ..., z = ...}, ...], where the axis of a straight link was found",
    "form_errors": "whether a straight link has errors of form, bow and even twist; set where a study names a bow",
    "point_masses": "list of tables, [{mass = ..., position = ...}, ...]",
    "compliance": "table { radial = ..., axial = ..., ... }; none: rigid",
    "clearance": "table { radial = ..., length = ..., stiffness = ..., ... } in the place of compliance; none: no play",
    "bearing": "table { dynamic_capacity = ..., static_capacity = ..., ... }; none: unknown",
    "stiffness": "table by direction, in the place of compliance: { radial = ..., axial = ..., tilt = ... }",
    "damping": "table by direction, beside stiffness",
    "spring": "table { stiffness = ..., ... } of a free motion, or a list of them; the spring is named JOINT_spring",
    "friction": "table { constant = ..., ... } of a free motion, or a list of them; it is named JOINT_friction",
    "cases": "tables [[cases]]; none means one case without errors",
    "mechanism": "the table [mechanism]",
    "simulation": "the table [simulation]; may be left out where there is [statics]",
    "statics": "the table [statics]; none means that the tasks are of simulations",
    "hold": 'joint or list of joints that are held besides those of drives and of `positions`, as "A" or "C.T_y"',
    "positions": "the table [statics.positions]: JOINT = position, or a list of positions",
    "drive": "the table [drive]; none means no drive",
    "drives": "tables [[drives]] beside [drive] or in its place, for several drives at once",
    "tolerances": "the table [tolerances]",
    "bounds": "the table [allocation.bounds]: ERROR = [smallest, largest half-width]",
    "cost": "the table [allocation.cost]: its keys for all errors, ERROR = { ... } for one",
}


@dataclass(frozen=True)
class Key:
    """A key of a table: its name; what stands where it is left out (NEEDED: it must be there); what it means; type of
    its values, "" where it may have several."""

    name: str
    default: str
    meaning: str
    type: str = ""


@dataclass(frozen=True)
class KeyTable:
    """A table of a study file: its header, and its keys."""

    header: str
    keys: tuple[Key, ...]


def key_tables() -> list[KeyTable]:
    """All tables that a study file may have, tasks from outside the package included."""
    required, optional = STUDY_KEYS
    own = {name: f"the table [{name}]" for name in task_kinds()}
    top = _table("top level", Study, required, (*optional, *task_kinds()), {**_IN_A_FILE, **own})
    tables = [top, _table("[mechanism]", Mechanism, *MECHANISM_KEYS, _IN_A_FILE)]
    tables.append(_table("[mechanism.materials.NAME]", Material, *keys_of(Material, omit=("name",))))
    for shape, kind in SHAPES.items():
        header, own = f'[mechanism.sections.NAME] of shape "{shape}"', {"shape": f'"{shape}"'}
        tables.append(_table(header, kind, *section_keys(shape), own))
    for header, kind in (
        ("[[mechanism.links]]", Link),
        ("point_masses of [[mechanism.links]]", PointMass),
        ("axis of [[mechanism.links]]", AxisPoint),
        ("camber of [[mechanism.links]]", CamberPoint),
        ("body of [[mechanism.links]]", RigidBody),
    ):
        tables.append(_table(header, kind, *keys_of(kind), _IN_A_FILE))
    header, own = (
        "body of [[mechanism.links]], of",
        {"file": f"path, from the folder of the study: {argument_meanings(load_body)['path']}"},
    )
    tables.append(_table(f"{header} a file", load_body, *BODY_FILE_KEYS, own))
    tables.append(_table(f"{header} two files", read_matrices, *keys_of(read_matrices)))
    named: dict[str, str] = dict.fromkeys(("section", "after"), "name of a table [mechanism.sections.NAME]")
    tables.append(_table("stations of [[mechanism.links]]", Station, *keys_of(Station), named))
    tables += [*_joint_tables(), *_force_tables()]
    tables.append(_table("[[mechanism.couplings]]", Coupling, *keys_of(Coupling)))
    tables.append(_table("[[mechanism.points]]", Point, *keys_of(Point)))
    tables.append(_table("[mechanism.base]", Base, *keys_of(Base)))
    for name, kind in DRIVES.items():
        header, own = f'[drive] or [[drives]] of kind "{name}"', {"kind": f'"{name}"'}
        tables.append(_table(header, kind, *drive_keys(name), own))
    tables += _simulation_tables()
    tables.append(_table("[statics]", Statics, *keys_of(Statics), _IN_A_FILE))
    tables.append(_table("[[cases]]", Case, *CASE_KEYS))
    tolerance = _table("[tolerances] ERROR", SpecifiedTolerance, *keys_of(SpecifiedTolerance, omit=("error",)))
    either = Key("ERROR = ...", "-", "a half-width alone, or a table { ... } of the keys below")
    tables.append(KeyTable(tolerance.header, (either, *tolerance.keys)))
    zone = _table("[tolerances] JOINT.position", SpecifiedZone, *keys_of(SpecifiedZone, omit=("name",)))
    either = Key(
        "JOINT.position = ...",
        "-",
        "or coaxiality, parallelism, perpendicularity, LINK.straightness: a diameter, or a table",
    )
    tables.append(KeyTable(zone.header, (either, *zone.keys)))
    tables.append(_table("[[tolerances.correlated]]", CorrelatedTolerances, *keys_of(CorrelatedTolerances)))
    for name, kind in asked_classes().items():
        for header, described, required, optional in kind.tables(f"[{name}]"):
            tables.append(_table(header, described, required, optional))
    return tables


def argument_meanings(kind: Callable[..., Any]) -> dict[str, str]:
    """{argument: what it means} from the section "Args:" of the docstring of a class or a function."""
    _, _, section = (inspect.getdoc(kind) or "").partition("Args:\n")
    meanings: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        indent = len(line) - len(line.lstrip())
        if indent == 0:
            break
        if indent == 4:
            first, _, text = line.strip().partition(": ")
            names = first.split(", ")
            meanings |= dict.fromkeys(names, text)
        else:
            meanings |= {name: f"{meanings[name]} {line.strip()}" for name in names}
    return meanings


def _joint_tables() -> list[KeyTable]:
    """Joints, and the tables that may stand in them."""
    required, optional = keys_of(Joint)
    tables = [_table("[[mechanism.joints]]", Joint, required, (*optional, *JOINT_KEYS), _IN_A_FILE)]
    tables.append(_table("compliance of [[mechanism.joints]]", Compliance, *keys_of(Compliance), _IN_A_FILE))
    tables.append(_table("bearing of [[mechanism.joints]]", Bearing, *keys_of(Bearing), _IN_A_FILE))
    tables.append(
        _table("clearance of [[mechanism.joints]]", Clearance, *keys_of(Clearance), argument_meanings(Clearance))
    )
    meanings = argument_meanings(Compliance)
    for key, ending in (("stiffness", ""), ("damping", "_damping")):
        own = {one: meanings[name + ending] for one, name in TablesByDirection.keys().items()}
        tables.append(_table(f"{key} of [[mechanism.joints]]", TablesByDirection, (), [*own], own))
    for key, kind in IN_JOINTS.items():
        required, optional = keys_of(kind, omit=OF_ITS_JOINT)
        several = {"motion": f"{argument_meanings(kind)['motion']} Needed in a list of several."}
        tables.append(_table(f"{key} of [[mechanism.joints]]", kind, required, optional, several))
    return tables


def _force_tables() -> list[KeyTable]:
    """Springs and forces of all kinds."""
    tables = []
    for name in SPRINGS:
        tables.append(_table(f"[[mechanism.springs]] {spring_place(name)}", FORCES[name], *keys_of(FORCES[name])))
    for name, kind in FORCES.items():
        required, optional = force_keys(name)
        left_out = "" if "kind" in required else ", which may be left out"
        own = {"kind": f'"{name}"{left_out}', "frame": "another name of `axes`"}
        tables.append(_table(f'[[mechanism.forces]] of kind "{name}"', kind, required, optional, own))
    return tables


def _simulation_tables() -> list[KeyTable]:
    """What all simulations have, and the settings of each class of methods."""
    method = 'name of the method; left out: "rk4" if there is a step, else "auto"'
    tables = [_table("[simulation]", Study, *SIMULATION_KEYS, {"method": method})]
    for kind in dict.fromkeys(METHOD_CLASSES.values()):
        names = ", ".join(f'"{name}"' for name in kind.names)
        settings = [one.name for one in settings_of(kind)]
        tables.append(_table(f"[simulation], settings of the method {names}", kind, (), settings))
    return tables


def _table(
    header: str,
    kind: Callable[..., Any],
    required: Collection[str],
    optional: Collection[str],
    own: Mapping[str, str] | None = None,
) -> KeyTable:
    meanings = {"cost": _IN_A_FILE["cost"], **argument_meanings(kind), **(own or {})}
    defaults = dict.fromkeys(required, NEEDED) | {name: _default(kind, name) for name in optional}
    keys = (Key(name, text, _in_a_file(meanings.get(name, "")), _type(kind, name)) for name, text in defaults.items())
    return KeyTable(header, tuple(keys))


def _type(kind: Callable[..., Any], name: str) -> str:
    """Type of an argument of a class, in the words of JSON Schema; "number" for what may have a unit; "" for what
    may be of several types, is given in another form, or is a list or a table."""
    parameter = inspect.signature(kind).parameters.get(name)
    if parameter is None:
        return ""
    union = isinstance(parameter.annotation, UnionType)
    found = {
        one for one in (get_args(parameter.annotation) if union else [parameter.annotation]) if one is not NoneType
    }
    names = {float: "number", int: "integer", bool: "boolean", str: "string"}
    return names.get(found.pop(), "") if len(found) == 1 else ""


def _in_a_file(meaning: str) -> str:
    """In the words of TOML, which has no None."""
    for python, toml in (("None", "left out"), ("True", "true"), ("False", "false")):
        meaning = re.sub(rf"\b{python}\b", toml, meaning)
    return meaning


def _default(kind: Callable[..., Any], name: str) -> str:
    """The default of an argument of a class, written as in a study file."""
    factories = (
        {one.name: one.default_factory for one in fields(kind)} if isinstance(kind, type) and is_dataclass(kind) else {}
    )
    factory = factories.get(name, MISSING)
    if factory is not MISSING:
        return _written(factory())
    parameter = inspect.signature(kind).parameters.get(name)
    return "-" if parameter is None or parameter.default is parameter.empty else _written(parameter.default)


def _written(value: Any) -> str:
    """A default as it would stand in a study file; "-" for nothing."""
    if value is None or value is MISSING or value == () or value == {} or value == "":
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_written(one) for one in value)}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_written(one)}' for key, one in value.items())} }}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
