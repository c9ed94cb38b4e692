"""A JSON Schema of study files, made of the reference of their keys: editors complete and check a file by it.

Place in the pipeline: key_reference -> **schema** -> `rfem-jax keys --schema`, `rfem-jax init`.

It knows the tables, their keys, which of them are needed, what they mean and, roughly, their types.  What depends on
more than one key is left to the reader of studies, which says it in a sentence.  Draft 7, which editors of TOML know
(https://json-schema.org/draft-07; the line `#:schema FILE` is that of Taplo and Even Better TOML).
"""

import json
from collections.abc import Iterable, Mapping
from typing import Any

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.methods import METHOD_CLASSES
from rfem_jax.description.study_file.key_reference import NEEDED, Key, KeyTable, key_tables
from rfem_jax.task_kinds import task_kinds

FILE = "rfem_jax.schema.json"  # its name beside a study
LINE = f"#:schema ./{FILE}"  # at the beginning of a study
Schema = dict[str, Any]

NUMBER: Schema = {"type": ["number", "string"]}  # a string has a unit
# Lists and tables are left out: in place of many of them a single value may stand.
TYPES: dict[str, Schema] = {
    "number": NUMBER,
    "integer": {"type": "integer"},
    "boolean": {"type": "boolean"},
    "string": {"type": "string"},
}
JOINTS, LINKS = "[[mechanism.joints]]", "[[mechanism.links]]"


def study_schema() -> Schema:
    """The schema, as a tree of plain data."""
    tables = key_tables()
    by_header = {table.header: table for table in tables}

    def those(beginning: str) -> list[Schema]:
        return [_table(table) for table in tables if table.header.startswith(beginning)]

    def one(header: str, own: Mapping[str, Schema] | None = None) -> Schema:
        return _table(by_header[header], own)

    within_joints = {key: one(f"{key} of {JOINTS}") for key in
                     ("compliance", "bearing", "clearance", "stiffness", "damping")}  # fmt: skip
    within_joints |= {key: _either(one(f"{key} of {JOINTS}")) for key in ("spring", "friction")}
    links = {"body": {"anyOf": those(f"body of {LINKS}")}, "point_masses": _list_of([one(f"point_masses of {LINKS}")])}
    links |= {key: _list_of([one(f"{key} of {LINKS}")]) for key in ("stations", "axis", "camber")}
    mechanism = {
        "materials": _named([one("[mechanism.materials.NAME]")]),
        "sections": _named(those("[mechanism.sections.NAME]")),
        "links": _list_of([one(LINKS, links)]),
        "joints": _list_of([one(JOINTS, {"kind": _word(KINDS), **within_joints})]),
        "springs": _list_of(those("[[mechanism.springs]]")),
        "forces": _list_of(those("[[mechanism.forces]]")),
        "couplings": _list_of([one("[[mechanism.couplings]]")]),
        "points": _list_of([{"type": "string"}, one("[[mechanism.points]]")]),
        "base": one("[mechanism.base]"),
    }
    drives = those("[drive]")
    methods = {"method": _word(name for kind in METHOD_CLASSES.values() for name in kind.names)}
    settings = {key: value for table in those("[simulation], ") for key, value in table["properties"].items()}
    tolerances = [NUMBER, one("[tolerances] ERROR"), one("[tolerances] JOINT.position")]
    correlated = _list_of([one("[[tolerances.correlated]]")])
    own = {
        "mechanism": one("[mechanism]", mechanism),
        "drive": {"anyOf": drives},
        "drives": _list_of(drives),
        "simulation": one("[simulation]", settings | methods),
        "statics": one("[statics]"),
        "cases": _list_of([one("[[cases]]")]),
        "tolerances": _named(tolerances, correlated=correlated),
    }
    for name in task_kinds():
        within = {}
        if f"[{name}.cost]" in by_header:
            cost = one(f"[{name}.cost]")
            within["cost"] = _named([cost], **cost["properties"])
        for key in ("signals.COLUMN", "candidates.COLUMN", "measured.NAME"):
            if f"[{name}.{key}]" in by_header:
                within[key.partition(".")[0]] = _named([one(f"[{name}.{key}]")])
        if f"[{name}.correction]" in by_header:
            within["correction"] = one(f"[{name}.correction]")
        own[name] = one(f"[{name}]", within)
    schema = one("top level", own)
    schema["required"] = [name for name in schema["required"] if name != "simulation"]
    schema |= {"if": {"not": {"required": ["statics"]}}, "then": {"required": ["simulation"]}}
    return {"$schema": "http://json-schema.org/draft-07/schema#", "title": "A study of rfem_jax", **schema}


def schema_text() -> str:
    """The schema as JSON."""
    return json.dumps(study_schema(), indent=1) + "\n"


def _table(table: KeyTable, own: Mapping[str, Schema] | None = None) -> Schema:
    """A table of the reference; `own`: schemas of keys that say more than the type."""
    keys = [key for key in table.keys if " = " not in key.name]
    properties = {key.name: {**_value(key), "description": key.meaning} for key in keys}
    for name, schema in (own or {}).items():
        properties[name] = {**schema, "description": properties.get(name, {}).get("description", "")}
    needed = [key.name for key in keys if key.default == NEEDED]
    return {"type": "object", "properties": properties, "required": needed, "additionalProperties": False}


def _value(key: Key) -> Schema:
    """What a value may be: the word that a kind is chosen by, or one of a type."""
    if key.name in ("kind", "shape") and key.meaning.startswith('"'):
        return {"const": key.meaning.split('"')[1]}
    return TYPES.get(key.type, {})


def _word(known: Iterable[str]) -> Schema:
    """A word of which these are known; there may be others, which a user has registered."""
    return {"anyOf": [{"enum": list(dict.fromkeys(known))}, {"type": "string"}]}


def _named(kinds: list[Schema], **others: Schema) -> Schema:
    """Tables by names of the user, beside keys of its own."""
    return {"type": "object", "properties": others, "additionalProperties": {"anyOf": kinds}}


def _list_of(kinds: list[Schema]) -> Schema:
    return {"type": "array", "items": {"anyOf": kinds}}


def _either(table: Schema) -> Schema:
    """A table, or a list of such."""
    return {"anyOf": [table, {"type": "array", "items": table}]}
