"""Deviations that cases, tolerances and tasks give numbers to: assembly errors, parameters of a mechanism, and numbers
of drives.

Place in the pipeline: mechanism, parameters, numbers_by_name -> **deviations** -> study, tasks, reports.

An error deviates from zero, a parameter from its value in the description or in a design. A name that both have, as
"coupler.length", is the error, which means the same. Numbers of drives deviate in tolerances and tasks, not in cases,
which share a drive.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress

from rfem_jax.description.basics.errors import ABSENT, InputError, Problems, subject, suggestion
from rfem_jax.description.basics.numbers import ANY, POSITIVE, SIGN_WORDS
from rfem_jax.description.basics.units import DIMENSIONS
from rfem_jax.description.drives.driven_motions import AnyDrive, driven_motion, motion_label
from rfem_jax.description.drives.numbers_by_name import NUMBER_DIMENSIONS, drive_number_dimension, each_drive_number
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.parameters.parameters import parameters_of
from rfem_jax.description.parameters.parts import parts_of
from rfem_jax.description.tolerances.error_catalogue import (
    NO_BOW,
    error_dimension,
    parameters_being_read,
    reading_parameters,
)
from rfem_jax.description.tolerances.zones import STRAIGHTNESS, SpecifiedZone, is_zone


def require_deviation(mechanism: Mechanism, name: str, where: str = "name") -> None:
    """Raise InputError with the nearest name unless `name` is an error or a parameter of the mechanism."""
    if name in mechanism.error_names or name in parameters_being_read():
        return
    known = parameters_of(mechanism)
    if name not in known:
        raise InputError(
            f"{subject(where)} must be an error or a parameter of this mechanism, but `{name}` is neither; "
            + (
                mechanism.about_missing(name)
                or known.about(name)
                or suggestion(name, (*mechanism.error_names, *known, *_of_drives()))
            )
        )


def require_zone(mechanism: Mechanism, zone: SpecifiedZone, where: str) -> None:
    """Raise InputError with the nearest name unless the mechanism has the errors of a zone."""
    missing = [error for error in zone.errors if error not in mechanism.error_names]
    if missing:
        owner, characteristic = zone.name.rpartition(".")[::2]
        if characteristic == STRAIGHTNESS:
            raise InputError(
                f"{subject(where)} must name zones of links that have their errors, but this mechanism has no "
                f"`{missing[0]}` for `{zone.name}`; {NO_BOW}"
            )
        seats = {error.rpartition(".")[0] for error in mechanism.error_names if error.rpartition(".")[2] == "d_x"}
        raise InputError(
            f"{subject(where)} must name zones of joints that have their errors, but this mechanism has no "
            f"`{missing[0]}` for `{zone.name}`; "
            + suggestion(zone.name, [f"{seat}.{characteristic}" for seat in sorted(seats - {owner})])
        )


def _of_drives() -> list[str]:
    """Names of the numbers of drives that are known while a study is read."""
    return [name for name in parameters_being_read() if name.startswith("drive.")]


def deviation_dimension(mechanism: Mechanism, name: str) -> str:
    """Dimension of a deviation, a key of `units.DIMENSIONS`; raises as `require_deviation`; parameters of
    drives are accepted."""
    known = parameters_of(mechanism)
    if name not in mechanism.error_names and name not in known:
        of_drive = drive_number_dimension(name)
        if of_drive is not None:
            return of_drive
    require_deviation(mechanism, name)
    return error_dimension(name) if name in mechanism.error_names else known[name].dimension


def deviation_unit(mechanism: Mechanism, name: str) -> str:
    """SI unit of a deviation, or of a zone's diameter; raises as `require_deviation`."""
    if is_zone(name):
        return "m"
    return DIMENSIONS[deviation_dimension(mechanism, name)][1]


def require_sizes(mechanism: Mechanism, sizes: Mapping[str, float], where: str) -> None:
    """Raise InputError unless `sizes` {deviation: magnitude [SI units]} are of this mechanism and no error turns
    anything by a right angle or shifts it by the length of the longest link."""
    longest = max(link.length for link in mechanism.links)
    problems = Problems()
    for name, size in sizes.items():
        with problems.noted():
            require_deviation(mechanism, name, where)
            if name not in mechanism.error_names:
                continue
            most, unit = (0.5 * math.pi, "rad") if error_dimension(name) == "angle" else (longest, "m")
            if not size <= most:
                raise InputError(
                    f"{subject(where)} must be less than {most:.4g} {unit} (a right angle, or the longest link), "
                    f"but `{name}` has {size:g} {unit}; check the number and its unit."
                )
    problems.refuse()


def require_signs(
    mechanism: Mechanism, deviations: Mapping[str, float], design: Mapping[str, float], where: str
) -> None:
    """Raise InputError where a deviation {name: number in SI units} from a description, or from its `design`, makes a
    number of it zero or negative that must not be; names are known."""
    # An error of a link's length has the name of its length; other errors deviate from zero.
    named = [name for name in deviations if name not in mechanism.error_names or name.endswith(".length")]
    if not named:
        return
    known, parts, problems = parameters_of(mechanism), parts_of(mechanism), Problems()
    for name in named:
        if name not in known or known[name].sign == ANY:
            continue
        one, deviation = known[name], deviations[name]
        nominal = design.get(one.full, design.get(one.name, one.value_in(parts)))
        total = nominal + deviation
        if total < 0.0 or (total == 0.0 and one.sign == POSITIVE):
            with problems.noted():
                raise InputError(
                    f"{subject(where)} must leave `{name}` {SIGN_WORDS[one.sign]}, but its value is {nominal:g} "
                    f"{one.unit} and the deviation {deviation:g} {one.unit}; give a smaller deviation."
                )
    problems.refuse()


@contextmanager
def known_while_reading(mechanism: object, drives: Sequence[AnyDrive] | None = ()) -> Iterator[None]:
    """Within the block names of the parameters of a mechanism and of the numbers of its drives have dimensions wherever
    names of errors do (`drives` None: they could not be read, and may have any number). Of a mechanism that could not
    be read (ABSENT) they are not known, and no name is refused; nothing happens for what is no mechanism."""
    if not isinstance(mechanism, Mechanism):
        with reading_parameters(None) if mechanism is ABSENT else nullcontext():
            yield
        return
    dimensions = _drive_dimensions(mechanism, drives)
    named = parameters_of(mechanism)
    dimensions |= {name: one.dimension for one in named.all for name in (one.short, one.full) if name is not None}
    with reading_parameters(dimensions):
        yield


def _drive_dimensions(mechanism: Mechanism, drives: Sequence[AnyDrive] | None) -> dict[str, str]:
    """{name: dimension} of the numbers of drives; none of drives that do not fit, which is refused elsewhere."""
    if drives is None:
        return {f"drive.{number}": dimension for number, dimension in NUMBER_DIMENSIONS.items()}
    with suppress(InputError):
        kinds = [mechanism.joint(one.joint).kind for one in drives]
        motions = [driven_motion(one, kind) for one, kind in zip(drives, kinds, strict=True)]
        labels = [motion_label(one.joint, *motion) for one, *motion in zip(drives, kinds, motions, strict=True)]
        return {name: str(drive_number_dimension(name)) for name in each_drive_number(drives, labels)}
    return {}
