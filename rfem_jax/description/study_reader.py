"""From the tables of a study file to the objects of this room: mechanism, drive, method.

Place in the pipeline: called by `study.load_study`; each function takes one table of the TOML.
The keys are the names of the arguments of Material, Link, Joint, ...; "shape" chooses the class of
a section, "kind" that of a drive.
"""

from dataclasses import fields

from rfem_jax.description.drives import (
    MomentRamp,
    MomentTable,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
)
from rfem_jax.description.errors import InputError, located, require_choice, require_name
from rfem_jax.description.joints import Joint
from rfem_jax.description.links import Link, PointMass
from rfem_jax.description.materials import Material
from rfem_jax.description.mechanism import Mechanism
from rfem_jax.description.methods import Method
from rfem_jax.description.sections import Circle, GivenSection, Rectangle, Tube
from rfem_jax.description.tables import checked_list, checked_table, keys_of, named_place

SHAPES = {"rectangle": Rectangle, "circle": Circle, "tube": Tube, "given": GivenSection}
DRIVES = {
    "moment_ramp": (MomentRamp, ("moment", "rise_time"), ()),
    "moment_table": (MomentTable, ("times", "moments"), ()),
    "prescribed_rate": (PrescribedRate, ("rate",), ("rise_time",)),
    "prescribed_spin_up": (PrescribedSpinUp, ("rate", "rise_time"), ()),
    "prescribed_table": (PrescribedTable, ("times", "angles"), ()),
}
_MECHANISM_OPTIONS = ("gravity", "redundant_reactions", "elements")
_METHOD_KEYS = (
    "step", "rtol", "atol", "stabilisation", "accuracy", "spectral_radius", "corrections",
    "tolerance",
)  # fmt: skip


def read_mechanism(table) -> Mechanism:
    """Return the Mechanism of the table [mechanism]."""
    place = "[mechanism]"
    optional = ("materials", "sections", *_MECHANISM_OPTIONS)
    table = checked_table(table, place, ("links", "joints"), optional)
    materials = _read_named(table.get("materials", {}), "mechanism.materials", _read_material)
    sections = _read_named(table.get("sections", {}), "mechanism.sections", _read_section)
    links = _read_list(table["links"], "[[mechanism.links]]", _read_link, materials, sections)
    joints = _read_list(table["joints"], "[[mechanism.joints]]", _read_joint)
    options = {key: table[key] for key in _MECHANISM_OPTIONS if key in table}
    with located(place):
        return Mechanism(links=links, joints=joints, **options)


def read_drive(table):
    """Return the drive of the table [drive]."""
    place = "[drive]"
    keys = {key for _, required, optional in DRIVES.values() for key in (*required, *optional)}
    checked_table(table, place, ("kind",), ("joint", *sorted(keys)))
    kind = _choice(table["kind"], DRIVES, "kind", place)
    build, required, optional = DRIVES[kind]
    required = ("joint", "kind", *required)
    table = checked_table(table, f'{place} of kind "{kind}"', required, optional)
    with located(place):
        return build(**{key: value for key, value in table.items() if key != "kind"})


def read_simulation(table) -> tuple[object, Method, object]:
    """Return (duration, Method, save_every or None) of the table [simulation]."""
    place = "[simulation]"
    optional = ("method", "save_every", *_METHOD_KEYS)
    table = checked_table(table, place, ("duration",), optional)
    settings = {key: table[key] for key in _METHOD_KEYS if key in table}
    with located(place):
        method = Method(table.get("method", "rk4" if "step" in table else "auto"), **settings)
    return table["duration"], method, table.get("save_every")


def _choice(value, known, key: str, place: str) -> str:
    if not known:
        raise InputError(
            f"{place}: Argument `{key}` must name a table [mechanism.{key}s.NAME], but there is "
            f"none; add [mechanism.{key}s.{value}]."
        )
    with located(place):
        return require_choice(value, tuple(known), key)


def _read_named(tables, header: str, read) -> dict:
    """Read tables [header.NAME] by read(name, table, place)."""
    checked_table(tables, f"[{header}]", optional=tables if isinstance(tables, dict) else ())
    return {name: read(name, table, f"[{header}.{name}]") for name, table in tables.items()}


def _read_list(entries, header: str, read, *known) -> list:
    """Read tables [[header]] by read(table, place, *known)."""
    return [
        read(entry, named_place(header, entry, number), *known)
        for number, entry in enumerate(checked_list(entries, header), start=1)
    ]


def _read_material(name, table, place: str) -> Material:
    table = checked_table(table, place, *keys_of(Material, omit=("name",)))
    with located(place):
        return Material(name=name, **table)


def _read_section(name, table, place: str):
    keys = {field.name for kind in SHAPES.values() for field in fields(kind)}
    checked_table(table, place, ("shape",), sorted(keys))
    shape = _choice(table["shape"], SHAPES, "shape", place)
    required, optional = keys_of(SHAPES[shape])
    checked_table(table, f'{place} of shape "{shape}"', ("shape", *required), optional)
    with located(place):
        require_name(name, "`name` of a section")
        return SHAPES[shape](**{key: value for key, value in table.items() if key != "shape"})


def _read_link(table, place: str, materials, sections) -> Link:
    settings = dict(checked_table(table, place, *keys_of(Link)))
    settings["section"] = sections[_choice(settings["section"], sections, "section", place)]
    if "material" in settings:
        settings["material"] = materials[_choice(settings["material"], materials, "material", place)]
    if settings.get("rigid") is True and settings.get("rfes", 1) != 1:
        raise InputError(
            f"{place}: Argument `rfes` must be left out where rigid = true, but was "
            f"{settings['rfes']!r}; remove one of the two."
        )
    masses = _read_list(settings.get("point_masses", []), f"{place} point_masses", _read_point_mass)
    with located(place):
        return Link(**{**settings, "point_masses": masses})


def _read_point_mass(table, place: str) -> PointMass:
    table = checked_table(table, place, *keys_of(PointMass))
    with located(place):
        return PointMass(**table)


def _read_joint(table, place: str) -> Joint:
    table = checked_table(table, place, *keys_of(Joint))
    with located(place):
        return Joint(**table)
