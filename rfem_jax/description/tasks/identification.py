"""What is asked of an identification: unknowns, what was measured and how well; the table [identification].

Place in the pipeline: task -> **identification** -> `rfem_jax.report.tasks.identification`. The tables
[identification.signals] and [identification.candidates] are by the names of columns that a run writes.

Symbols: bounds and `at` in m and rad, or strings with a unit; noise and offsets in the unit of their column.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

from rfem_jax.description.basics.errors import (
    Checks,
    ChecksItself,
    InputError,
    Problems,
    located,
    require_choice,
    require_entries,
    require_flag,
    subject,
)
from rfem_jax.description.basics.tables import keys_of, read_table
from rfem_jax.description.basics.units import DIMENSIONS, Quantity, quantity
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.parameters.deviations import require_deviation
from rfem_jax.description.tasks.correction import AskedCorrection
from rfem_jax.description.tasks.settings import MOST_SAMPLES, convert_all, fraction, set_fields, whole_number
from rfem_jax.description.tasks.sweep import bounds_of
from rfem_jax.description.tasks.task import Task
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances, error_quantities
from rfem_jax.labelled_data import column_name

TIME = "time_s"
STRAIN = "m/m"  # the unit of strains, by which their columns are known
LOSSES = ("gaussian", "huber", "cauchy")
PRIORS = ("tolerances", "flat")
FILTERS = ("", "low_pass", "butterworth", "high_pass", "average")
SENSOR_TABLES = ("signals", "candidates")  # by the names of columns
MEASURED = "measured"  # by the names of experiments
_MEASURED = ("acceleration", "angle", "rate", "speed", "moment", "force", "length", "pressure")
_UNITS = {column_name("", DIMENSIONS[name][1]): (name, DIMENSIONS[name][1]) for name in _MEASURED}
_UNITS[column_name("", STRAIN)] = ("none", STRAIN)


@dataclass(frozen=True)
class Sensor(ChecksItself):
    """How well a signal is measured.

    Args:
        noise: standard deviation of every sample, in the unit of the column or as a string with a unit; None: to be
            estimated from what the model leaves over.
        offset: standard deviation of an unknown constant that the sensor adds, likewise; 0 without one, inf for one of
            which nothing is known.
        gain: standard deviation of the sensor's unknown relative error of scale; 0 without one.
        filter: "low_pass" of first order, "butterworth", a low pass of second order, "high_pass" of first order, as of
            an accelerometer that is coupled by a capacitor, or "average" over the last interval; "" without one.
        filter_time: time constant T [s], or a string with a unit; the cut-off frequency is 1/(2 pi T). Of "average" the
            interval.
    Raises: InputError for negative numbers, and a filter without a time.
    """

    noise: float | None = None
    offset: float = 0.0
    gain: float = 0.0
    filter: str = ""
    filter_time: float = 0.0

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("gain", _deviation, "gain", "none")
        checks.convert("filter", require_choice, FILTERS, "filter")
        checks.convert("filter_time", _deviation, "filter_time", "time")
        checks.relation(("filter", "filter_time"), self._require_time)
        for name in ("noise", "offset"):
            if getattr(self, name) is not None and not isinstance(getattr(self, name), str):  # of its column's unit
                checks.convert(name, _deviation, name, "none")

    def _require_time(self) -> None:
        if bool(self.filter) != (0.0 < self.filter_time < inf):
            raise InputError(
                "Argument `filter_time` must be a positive time of a sensor with a `filter`, and of no other, but was "
                f"{self.filter_time:g} s with the filter {self.filter!r}; give both, or none."
            )

    def of_column(self, column: str) -> "Sensor":
        """The same with numbers in the unit of its column. Raises InputError for strings in another unit."""
        dimension = _dimension(column)[0]
        noise = None if self.noise is None else _deviation(self.noise, f"`noise` of `{column}`", dimension)
        if noise == 0.0:
            raise InputError(
                f"Argument `noise` of `{column}` must be positive, but was 0; give the standard deviation of a "
                "sample, or leave it out, so that it is estimated."
            )
        return replace(self, noise=noise, offset=_deviation(self.offset, f"`offset` of `{column}`", dimension))


Sensors = Mapping[str, Sensor]


@dataclass(frozen=True)
class MeasuredExperiment(ChecksItself):
    """A further experiment with the same machine, and what was measured in it.

    Args:
        data: path of its CSV file, in a study file relative to it, with the columns of the signals.
        study: path of a study file of the same mechanism, likewise, whose drive, forces, duration and saved times are
            those of the experiment; "": those of the study itself.
        changes: {parameter, number of a drive, or error: deviation from its value} in this experiment.
    Raises: InputError for other values.
    """

    data: str
    study: str = ""
    changes: dict[str, float] = field(default_factory=dict)

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("data", _path)
        checks.convert("study", _path, "study", "study", "other.toml")
        checks.convert("changes", error_quantities, "changes")


@dataclass(frozen=True)
class IdentificationTask(Task):
    """The errors of a machine that was measured, and what can be known of them.

    Args:
        signals: {column of a run's CSV file: Sensor}, what was measured.
        candidates: {column: Sensor with its noise}, further signals whose worth is computed.
        data: path of the CSV file with the measurements, in a study file relative to it: `time_s` and the columns of
            the signals; an empty cell is a signal that was not sampled then. "": nothing is measured yet.
        unknowns: names of errors and parameters; none: all that have tolerances.
        prior: "tolerances", normal with the tolerances' means, deviations and correlations, or "flat" between bounds.
        bounds: {error: (low, high)} in rad and m, which estimates do not leave.
        at: {error: value} in rad and m of errors that are known; others are 0.
        experiments: {name: {parameter, number of a drive, or error: deviation from its value}} of other experiments
            with the same machine, which are compared where nothing is measured yet.
        measured: {name: MeasuredExperiment}, further experiments that were measured, as at another speed.
        time_shift: standard deviation [s] of the unknown delay of the measurements' clock; 0 without one.
        loss: "gaussian", or for data with outliers "huber" or "cauchy".
        confidence: of the intervals, between 0 and 1.
        starts: searches, from the mean of the prior and from points all over it.
        iterations: the most steps of each search.
        samples: simulations of the importance sampling that checks the intervals.
        check_model: whether it is checked that the model is fine enough for the data: on links of twice as many
            spring-damping elements, and with half the step.
        seed: of starts and samples.
        correction: which adjustment of the machine is looked for, if any.
    Raises: InputError for settings that are out of range or do not fit each other.
    """

    needs_tolerances = False

    signals: dict[str, Sensor]
    candidates: dict[str, Sensor] = field(default_factory=dict)
    data: str = ""
    unknowns: tuple[str, ...] = ()
    prior: str = "tolerances"
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    at: dict[str, float] = field(default_factory=dict)
    experiments: dict[str, dict[str, float]] = field(default_factory=dict)
    measured: dict[str, MeasuredExperiment] = field(default_factory=dict)
    time_shift: float = 0.0
    loss: str = "gaussian"
    confidence: float = 0.95
    starts: int = 8
    iterations: int = 60
    samples: int = 256
    check_model: bool = True
    seed: int = 0
    correction: AskedCorrection | None = None

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("signals", sensors_of, "signals")
        checks.convert("candidates", sensors_of, "candidates")
        checks.convert("data", _path)
        checks.convert("unknowns", _names)
        checks.convert("prior", require_choice, PRIORS, "prior")
        checks.convert("loss", require_choice, LOSSES, "loss")
        checks.convert("bounds", bounds_of)
        checks.convert("at", error_quantities, "at")
        checks.convert("experiments", _experiments)
        checks.convert(MEASURED, _measured)
        checks.convert("time_shift", _deviation, "time_shift", "time")
        convert_all(checks, ("starts", "iterations"), whole_number, 1, MOST_SAMPLES)
        convert_all(checks, ("samples",), whole_number, 16, MOST_SAMPLES)
        convert_all(checks, ("seed",), whole_number, 0)
        convert_all(checks, ("confidence",), fraction)
        convert_all(checks, ("check_model",), require_flag)
        checks.relation(("signals",), self._require_signals)
        checks.relation(("candidates",), self._require_noise)
        checks.relation(("data", "measured"), self._require_data)
        checks.relation(("time_shift",), self._require_finite)

    def _require_signals(self) -> None:
        if not self.signals:
            raise InputError(
                "Argument `signals` must name at least one column that is measured, but names none; write for "
                'example { "rate_rad_s" = { noise = 0.01 } }.'
            )

    def _require_noise(self) -> None:
        for column, sensor in self.candidates.items():
            require_noise(column, sensor, "candidates")

    def _require_data(self) -> None:
        if self.measured and not self.data:
            raise InputError(
                "Argument `measured` must be of further experiments, beside what was measured of the study itself, but "
                "there is no `data`; name the file of the first experiment there."
            )

    def _require_finite(self) -> None:
        if self.time_shift == inf:
            raise InputError("Argument `time_shift` must be a finite time, but was inf; estimate how large it may be.")

    @classmethod
    def tables(cls, header: str) -> list[tuple[str, type, Collection[str], Collection[str]]]:
        inner = [f"{header[:-1]}.{name}.COLUMN]" for name in SENSOR_TABLES]
        correction = f"{header[:-1]}.correction]", AskedCorrection, *keys_of(AskedCorrection)
        measured = f"{header[:-1]}.{MEASURED}.NAME]", MeasuredExperiment, *keys_of(MeasuredExperiment)
        return [*super().tables(header), *((one, Sensor, *keys_of(Sensor)) for one in inner), measured, correction]

    @classmethod
    def read(cls, table: object, place: str, tolerances: SpecifiedTolerances | None) -> "IdentificationTask":
        """As `Task.read`; the unknowns are all that have tolerances unless they are named."""
        read, problems = table, Problems()
        if isinstance(table, dict):
            read = dict(table)
            for name in (*SENSOR_TABLES, MEASURED):
                if isinstance(table.get(name), dict):
                    kind: Any = MeasuredExperiment if name == MEASURED else Sensor
                    with problems.noted():
                        read[name] = {
                            inner: read_table(kind, one, f"{place[:-1]}.{name}.{inner}]")
                            for inner, one in table[name].items()
                        }
            if "correction" in table:
                with problems.noted():
                    read["correction"] = read_table(AskedCorrection, table["correction"], f"{place[:-1]}.correction]")
        problems.refuse()
        task: Any = super().read(read, place, tolerances)
        with located(place):
            return task.with_unknowns(tolerances)

    def resolved(self, mechanism: Mechanism, name: str) -> "IdentificationTask":
        """As `Task.resolved`; what experiments change and a correction adjusts and reduces must be there, too."""
        problems = Problems()
        for title, values in (*self.experiments.items(), *((name, one.changes) for name, one in self.measured.items())):
            for error in values:
                with problems.noted():
                    require_deviation(mechanism, error, f"`{name}`, experiment `{title}`")
        if self.correction is not None:
            with problems.noted():
                self.correction.require_known(mechanism, name)
        problems.refuse()
        resolved: Any = super().resolved(mechanism, name)
        return resolved

    def with_unknowns(self, tolerances: SpecifiedTolerances | None) -> "IdentificationTask":
        """The same task with its unknowns named. Raises InputError where they have neither tolerances nor bounds."""
        known = {} if tolerances is None else tolerances.half_widths()
        names = self.unknowns or tuple(name for name in dict.fromkeys((*known, *self.bounds)) if name not in self.at)
        for name in names or ("",):
            if name not in known and (name not in self.bounds or self.prior == "tolerances"):
                raise InputError(
                    f'Argument `unknowns` must have tolerances, or bounds and the prior "flat", but '
                    f"{f'`{name}` has none' if name else 'there are none'}; add a table [tolerances]."
                )
        made = replace(self)
        set_fields(made, unknowns=names)
        return made


def sensors_of(sensors: Any, what: str) -> dict[str, Sensor]:
    """{column: Sensor} with numbers in the columns' units, of a mapping to sensors, or of names, whose noise is to be
    estimated. Raises InputError."""
    if isinstance(sensors, str) or not isinstance(sensors, (Mapping, list, tuple)):
        raise InputError(
            f"Argument `{what}` must be a table of columns and sensors, but was {sensors!r}; write for example "
            '{ "rate_rad_s" = { noise = 0.01 } }.'
        )
    found, problems = {}, Problems()
    for column in sensors:
        with problems.noted():
            sensor = sensors[column] if isinstance(sensors, Mapping) else Sensor()
            if not isinstance(sensor, Sensor):
                raise InputError(
                    f"Argument `{what}` must map columns to sensors, but `{column}` has {sensor!r}; write "
                    "Sensor(noise=...), in a study file { noise = ... }."
                )
            found[column] = sensor.of_column(column)
    problems.refuse()
    return found


def require_noise(column: str, sensor: Sensor, what: str) -> None:
    """Raise InputError for a signal whose worth cannot be told, because its noise is not known."""
    if sensor.noise is None:
        raise InputError(
            f"Argument `{what}` must say how noisy signals are, from which follows what they tell, but `{column}` "
            "has no `noise`; add it."
        )


def unit_of_column(column: str) -> str:
    """SI unit of a column, by the end of its name. Raises InputError for a name without one."""
    return _dimension(column)[1]


def _dimension(column: object) -> tuple[str, str]:
    for suffix, found in sorted(_UNITS.items(), key=lambda one: -len(one[0])):
        if isinstance(column, str) and column.endswith(suffix) and column != TIME:
            return found
    ends = ", ".join(f"`{suffix}`" for suffix in _UNITS)
    raise InputError(
        f"Argument `signals` must name columns of measured quantities in SI units, whose names end in {ends}, but "
        f"`{column}` does not; convert its numbers, and name it as `rfem-jax run` names it in the CSV files of cases."
    )


def _deviation(value: Quantity, where: str, dimension: str) -> float:
    """A standard deviation: not negative, and inf is allowed."""
    if value == inf:
        return inf
    number = quantity(value, dimension, where)
    if number < 0.0:
        raise InputError(f"{subject(where)} must not be negative, but was {value!r}; give a standard deviation.")
    return number


def _experiments(experiments: object) -> dict[str, dict[str, float]]:
    if not isinstance(experiments, dict):
        raise InputError(
            f"Argument `experiments` must be a table of experiments, but was {experiments!r}; write for example "
            '{ slower = { "drive.moment" = "-1 N m" } }.'
        )
    return {str(name): error_quantities(values, f"experiments.{name}") for name, values in experiments.items()}


def _measured(measured: object) -> dict[str, MeasuredExperiment]:
    if not isinstance(measured, Mapping) or not all(isinstance(one, MeasuredExperiment) for one in measured.values()):
        raise InputError(
            f"Argument `{MEASURED}` must be a table of experiments, but was {measured!r}; write for example "
            '{ fast = { data = "fast.csv", study = "fast.toml" } }.'
        )
    return dict(measured)


def _path(path: object, what: str = "data", kind: str = "CSV", example: str = "measured.csv") -> str:
    if not isinstance(path, str):
        raise InputError(f'Argument `{what}` must be the path of a {kind} file, but was {path!r}; write "{example}".')
    return path


def _names(names: object) -> tuple[str, ...]:
    return tuple(dict.fromkeys(require_entries(names, "unknowns", str, "names", 'write ["D.delta_x"].')))
