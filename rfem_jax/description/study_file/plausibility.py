"""Numbers of a study that are allowed, but most likely lack their unit.

Place in the pipeline: `Study` -> **sentences**, which commands say before they compute.
"""

import math
from collections.abc import Iterator

from rfem_jax.description.mechanism.points import NamedPoint
from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.study_file.study import Study

LARGEST_TILT = math.radians(5.0)
LARGEST_SHIFT = 0.1  # of the longest link
FARTHEST_POINT = 20.0  # over the longest link
LARGEST_WARMTH = 500.0  # K
MOST_UNEQUAL = 100.0  # length of a link over that of the shortest


def doubtful_numbers(study: Study) -> list[str]:
    """A sentence for every link of a strange length, every point far from its link, and every error or tolerance that
    is no small deviation."""
    lengths = [link.length for link in study.mechanism.links if link.length > 0.0]
    shortest, longest = min(lengths, default=math.inf), max(lengths, default=math.inf)
    sentences = [
        f"Link `{link.name}` is {link.length:.6g} m long, {link.length / shortest:.3g} times the shortest link; a "
        f'number without a unit is in metres: write "{link.length:.6g} mm" if millimetres are meant.'
        for link in study.mechanism.links
        if link.length > MOST_UNEQUAL * shortest
    ]
    for point in study.mechanism.points:
        if isinstance(point, NamedPoint):
            continue
        distance = math.hypot(*point.place)
        if distance > FARTHEST_POINT * longest:
            sentences.append(
                f"Point `{point.name}` is {distance:.6g} m from the origin of its link, {distance / longest:.3g} times "
                f"the longest link; a number without a unit is in metres: write the unit if millimetres are meant."
            )
    for name, value, place in _errors(study):
        unit, size = deviation_unit(study.mechanism, name), abs(value)
        if unit == "rad" and size > LARGEST_TILT:
            sentences.append(
                f"`{name}` {place} is {math.degrees(size):.3g} deg, much for an error; a number without a unit is in "
                f'radians: write "{value:.6g} deg" if degrees are meant.'
            )
        if unit == "K" and size > LARGEST_WARMTH:
            sentences.append(
                f"`{name}` {place} is {size:.4g} K, much for steel or aluminium; it is the difference to the "
                "temperature of assembly, not that above absolute zero."
            )
        if unit == "m" and size > LARGEST_SHIFT * longest:
            sentences.append(
                f"`{name}` {place} is {size:.3g} m, much beside the longest link ({longest:.3g} m); a number without a "
                f'unit is in metres: write "{value:.6g} mm" if millimetres are meant.'
            )
    return sentences


def _errors(study: Study) -> Iterator[tuple[str, float, str]]:
    """Name, value [rad or m] and place of every error and every half-width of a tolerance."""
    known, tolerances = set(study.mechanism.error_names), study.tolerances
    places = {f"of case `{case.name}`": case.errors for case in study.cases}
    places["in `[tolerances]`"] = {} if tolerances is None else tolerances.half_widths()
    for place, values in places.items():
        for name in values:
            if name in known or name.endswith(".temperature"):
                yield name, float(values[name]), place
