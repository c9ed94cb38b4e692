"""Tolerances of a study as they stand on a drawing: characteristics with their symbols, zones, values, datums, as CSV.

Place in the pipeline: [tolerances] of a study, or the answer of `allocate` or `optimise` -> **drawing_table**.

An error of one component within an interval is a zone between two planes, as wide as the interval; a tilt t [rad] is
one of 100 mm t over a restricted length of 100 mm. Zones of the study are those of the drawing. Lengths of links and
dimensions have deviations from their sizes, a radial clearance twice its own on the diameter. A direction is
parallel, perpendicular or askew to its datum as the nominal mechanism has it. A bow is a half-wave, which just lies
between planes as far apart as its amplitude. Runout and other forms are no errors of the model, and in no row.

Symbols: ISO 1101:2017, table 4; sizes: ISO 14405-1.
"""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.parameters.parameters import parameters_of
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tolerances.error_catalogue import BOWS, JOINT_ERRORS, LINK_ERRORS, as_specified
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances
from rfem_jax.description.tolerances.zones import STRAIGHTNESS, SpecifiedZone, is_zone
from rfem_jax.exchange.rigid_frames import rotation_from

SYMBOLS = {
    "position": "\u2316", "coaxiality": "\u25ce", "parallelism": "\u2225", "perpendicularity": "\u27c2",
    "angularity": "\u2220", "straightness": "\u23e4", "size": "\u00b1",
}  # fmt: skip
DIAMETER = "\u2300"
OVER = 100.0  # mm, the restricted length of directions
_DIGITS = 4
_ALONG = 1e-6  # sine or cosine of an angle below which directions are parallel or perpendicular
COLUMNS = (
    "name", "part", "feature", "characteristic", "symbol", "zone", "value", "lower", "upper", "unit", "over_length_mm",
    "datum", "indication", "distribution",
)  # fmt: skip


@dataclass(frozen=True)
class _Asked:
    """An error within an interval (low, high) [SI], and how it is distributed."""

    name: str
    low: float
    high: float
    distribution: str
    code: str = ""

    @property
    def width(self) -> float:
        return self.high - self.low


def drawing_text(study: Study, found: dict[str, float] | None = None) -> tuple[str, tuple[str, ...]]:
    """The table, and names of tolerances that no drawing has (masses, stiffnesses).

    **Arguments:** `found`: {error: half-width [rad, m], zone: diameter [m]} of an answer, in the place of those of the
    study; others of the study stay.

    **Raises:** `InputError` for a study without tolerances.
    """
    specified, sizes = study.tasks.tolerances, dict(found or {})
    asked = [] if specified is None else [_replaced(one, sizes) for one in _asked(specified)]
    own = () if specified is None else specified.zones
    zones = {one.name: one for one in own}
    zones |= {one.name: one for task in study.tasks.asked.values() for one in getattr(task, "zones", ())}
    asked += [
        _Asked(name, -size, size, "") for name, size in sizes.items()
        if not is_zone(name) and name not in {one.name for one in asked}
    ]  # fmt: skip
    shown = [zone for zone in zones.values() if zone.name in sizes or zone in own]
    if not asked and not shown:
        raise InputError(
            "A table for drawings must have tolerances, but the study has none; add [tolerances], or give the "
            "answer of `rfem-jax allocate` by --answer."
        )
    table = _Table(study.mechanism)
    rows = [table.of_zone(zone, sizes.get(zone.name, zone.diameter)) for zone in shown]
    rows += [table.of_error(one) for one in asked]
    left = tuple(f"{row['name']}, which no drawing shows" for row in rows if not row.get("symbol"))
    file = io.StringIO()
    file.write("\ufeff")  # spreadsheets take a file without this mark for one in the code page of the system
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([row.get(name, "") for name in COLUMNS] for row in rows)
    return file.getvalue(), left


def _asked(specified: SpecifiedTolerances) -> Iterator[_Asked]:
    for one in specified.independent:
        words = one.distribution.replace("_", " ")
        if one.deviations is not None:
            words += f", {one.deviations:g} sigma"
        yield _Asked(one.error, *one.interval, words, one.iso or "")
    for group in specified.correlated:
        for name, width in group.half_widths.items():
            others = ", ".join(other for other in group.half_widths if other != name)
            yield _Asked(name, -width, width, f"normal, {group.deviations:g} sigma, correlated with {others}")


def _replaced(one: _Asked, sizes: dict[str, float]) -> _Asked:
    if one.name not in sizes:
        return one
    middle, half = 0.5 * (one.low + one.high), sizes[one.name]
    return _Asked(one.name, middle - half, middle + half, one.distribution)


@dataclass(frozen=True)
class _Table:
    """Rows by the names of errors and zones of a mechanism."""

    mechanism: Mechanism

    def of_zone(self, zone: SpecifiedZone, diameter: float) -> dict[str, str]:
        owner, value = zone.name.rpartition(".")[0], _mm(diameter)
        if zone.characteristic == STRAIGHTNESS:
            return {
                "name": zone.name, "distribution": "uniform in the zone",
                **_straightness(owner, "cylinder", value, f"{DIAMETER}{value}"),
            }  # fmt: skip
        _, part, _, datum, _ = self._feature(owner)
        shape = "S" if zone.zone == "sphere" else ""
        over = f"{1e3 * zone.length:g}" if zone.length is not None else ""
        feature = f"centre of {owner}" if zone.zone == "sphere" else f"axis of {owner}"
        fit = f" ({zone.fit})" if zone.fit else ""
        return {
            "name": zone.name, "part": part, "feature": feature, "characteristic": zone.characteristic,
            "symbol": SYMBOLS[zone.characteristic], "zone": "sphere" if shape else "cylinder", "value": value,
            "unit": "mm", "over_length_mm": over, "datum": datum,
            "indication": f"{SYMBOLS[zone.characteristic]} {shape}{DIAMETER}{value} | {datum}{fit}",
            "distribution": "uniform in the zone",
        }  # fmt: skip

    def of_error(self, one: _Asked) -> dict[str, str]:
        owner, _, component = one.name.rpartition(".")
        links = {link.name for link in self.mechanism.links}
        joints = {joint.name for joint in self.mechanism.joints}
        row = {"name": one.name, "distribution": one.distribution}
        if owner in links and component in LINK_ERRORS:
            if component == "twist":
                return row | self._tilt(one, owner, f"far end of {owner}", "near end", "parallelism")
            return row | _size(one, owner, "length from end to end")
        if owner in links and component in BOWS:
            value = _mm(max(abs(one.low), abs(one.high)))
            return row | _straightness(owner, f"between planes across {component[-1]} of {owner}", value, value)
        if owner.partition(".")[0] in joints and component in {name.rpartition(".")[2] for name in JOINT_ERRORS}:
            return row | self._of_joint(one, owner, component)
        return row | self._of_parameter(one)

    def _of_joint(self, one: _Asked, owner: str, component: str) -> dict[str, str]:
        joint, part, axes, datum, datum_axis = self._feature(owner)
        letter = component[-1]
        if component.startswith("pin_tilt"):
            return self._tilt(one, part, f"pin of {owner}, about {letter}", datum, "parallelism")
        direction = axes["xyz".index(letter)]
        if component.startswith("delta"):
            along = KINDS[joint.kind].axis
            own = None if along is None or "xyz"[along] == letter else axes[along]
            return self._tilt(one, part, f"axis of {owner}, about {letter}", datum, _relation(own, datum_axis))
        value = _mm(one.width)
        planes = f"between planes across {letter} of {owner} ({_vector(direction)} in {part})"
        return {
            "part": part, "feature": f"centre of {owner}", "characteristic": "position", "symbol": SYMBOLS["position"],
            "zone": planes, "value": value, "lower": _mm(one.low), "upper": _mm(one.high), "unit": "mm", "datum": datum,
            "indication": f"{SYMBOLS['position']} {value} | {datum}",
        }  # fmt: skip

    def _tilt(self, one: _Asked, part: str, feature: str, datum: str, characteristic: str) -> dict[str, str]:
        value, (low, high) = _mm(one.width * 1e-3 * OVER), (np.degrees(end) for end in (one.low, one.high))
        return {
            "part": part, "feature": feature, "characteristic": characteristic, "symbol": SYMBOLS[characteristic],
            "zone": f"between planes ({low:.4g} to {high:.4g} deg)", "value": value, "unit": "mm",
            "over_length_mm": f"{OVER:g}", "datum": datum,
            "indication": f"{SYMBOLS[characteristic]} {value}/{OVER:g} | {datum}",
        }  # fmt: skip

    def _of_parameter(self, one: _Asked) -> dict[str, str]:
        owner, _, component = one.name.partition(".")
        parameters = parameters_of(self.mechanism)
        if owner == "drive" and one.name not in parameters:
            return self._unshown(one, deviation_unit(self.mechanism, one.name))
        parameter = parameters.find(one.name, "[tolerances]")
        if component.endswith("clearance.radial"):
            twice = _Asked(one.name, 2.0 * one.low, 2.0 * one.high, "", one.code)
            return _size(twice, owner, "diameter of the hole less that of the pin")
        if parameter.dimension == "length":
            return _size(one, owner, component)
        return self._unshown(one, parameter.unit)

    def _unshown(self, one: _Asked, unit: str) -> dict[str, str]:
        """A row without a symbol; `unit`: SI unit of the number."""
        owner, _, component = one.name.partition(".")
        unit, factor = as_specified(unit)
        ends = (f"{factor * end:.{_DIGITS}g}" for end in (one.low, one.high))
        return {"part": owner, "feature": component, "unit": unit, **dict(zip(("lower", "upper"), ends, strict=True))}

    def _feature(self, owner: str) -> tuple[Joint, str, Float[np.ndarray, "3 3"], str, np.ndarray | None]:
        """Of a seat or a bore: the joint; the part; its axes in that, rows; the datum, and the direction of this."""
        name, _, side = owner.partition(".")
        joint = self.mechanism.joint(name)
        part = joint.child if side == "child" else joint.parent
        angles = joint.child_orientation if side == "child" else joint.orientation
        axes = rotation_from(np.array(angles, dtype=float)).T
        if part == "base":
            return joint, part, axes, "frame of base", np.eye(3)[1]
        other = next(
            (one for one in self.mechanism.joints if one.child == part and not one.cut and one is not joint), None
        ) or next((one for one in self.mechanism.joints if part in (one.parent, one.child) and one is not joint), None)
        if other is None:
            return joint, part, axes, f"frame of {part}", np.eye(3)[1]
        turned = other.child_orientation if other.child == part else other.orientation
        along = KINDS[other.kind].axis
        direction = None if along is None else rotation_from(np.array(turned, dtype=float))[:, along]
        return joint, part, axes, f"{'centre' if along is None else 'axis'} of {other.name} in {part}", direction


def _relation(axis: np.ndarray | None, datum: np.ndarray | None) -> str:
    """The characteristic of a direction by its nominal angle to the datum's."""
    if axis is None or datum is None:
        return "angularity"
    if np.linalg.norm(np.cross(axis, datum)) < _ALONG:
        return "parallelism"
    return "perpendicularity" if abs(axis @ datum) < _ALONG else "angularity"


def _straightness(link: str, zone: str, value: str, size: str) -> dict[str, str]:
    """Straightness of the axis of a link, which needs no datum; `size`: as it stands in the frame."""
    symbol = SYMBOLS[STRAIGHTNESS]
    return {
        "part": link, "feature": f"axis of {link}", "characteristic": STRAIGHTNESS, "symbol": symbol, "zone": zone,
        "value": value, "unit": "mm", "indication": f"{symbol} {size}",
    }  # fmt: skip


def _size(one: _Asked, part: str, feature: str) -> dict[str, str]:
    low, high = _mm(one.low), _mm(one.high)
    even = abs(one.low + one.high) <= 1e-9 * one.width
    value = _mm(0.5 * one.width) if even else ""
    words = f"{SYMBOLS['size']}{value}" if even else f"{_signed(high)} / {_signed(low)}"
    return {
        "part": part, "feature": feature, "characteristic": "size", "symbol": SYMBOLS["size"], "value": value,
        "lower": low, "upper": high, "unit": "mm", "indication": one.code or words,
    }  # fmt: skip


def _mm(metres: float) -> str:
    """A length in mm with as many digits as a drawing has."""
    return f"{1e3 * metres:.{_DIGITS}g}"


def _signed(text: str) -> str:
    return text if text.startswith("-") or float(text) == 0.0 else f"+{text}"


def _vector(direction: np.ndarray) -> str:
    return " ".join(f"{0.0 + round(float(x), 4):g}" for x in direction)
