"""Study: a mechanism, its drive, how it is simulated, and the cases of assembly errors to compare.

Place in the pipeline: what `load_study` makes of a study file (TOML) or a user makes in Python;
`report` runs it.

Symbols: duration, save_every [s]; errors of a case in m and rad (`error_catalogue`).
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rfem_jax.description.basics.errors import (
    ABSENT,
    Checks,
    ChecksItself,
    InputError,
    Problems,
    WrongSetting,
    condensed,
    located,
    require_choice,
    require_entries,
    suggestion,
)
from rfem_jax.description.basics.notebook_tables import study_html
from rfem_jax.description.basics.tables import checked_table, read_list, read_table, read_toml
from rfem_jax.description.basics.units import positive_quantity, quantity
from rfem_jax.description.drives.driven_motions import (
    AnyDrive,
    all_breakpoints,
    driven_motion,
    each_drive,
    motion_label,
)
from rfem_jax.description.drives.numbers_by_name import drives_with
from rfem_jax.description.drives.rotations import PrescribedDrive, PrescribedTable
from rfem_jax.description.drives.translations import PrescribedDisplacements
from rfem_jax.description.mechanism.mechanism import STARTS, Mechanism
from rfem_jax.description.methods import Automatic, Method
from rfem_jax.description.metrics.catalogue import require_at_rest
from rfem_jax.description.metrics.path_metrics import REPORTED
from rfem_jax.description.metrics.shaking_metrics import with_shaking
from rfem_jax.description.metrics.subjects import points_of, require_metric, subjects_of
from rfem_jax.description.parameters.design_table import read_design
from rfem_jax.description.parameters.deviations import known_while_reading, require_signs, require_sizes
from rfem_jax.description.study_file.statics import Statics, require_no_drive
from rfem_jax.description.study_file.study_reader import (
    read_drive,
    read_drives,
    read_mechanism,
    read_simulation,
    with_form_errors,
)
from rfem_jax.description.tasks.settings import metric_names
from rfem_jax.description.tasks.study_tasks import Tasks, read_tasks
from rfem_jax.description.tolerances.error_catalogue import error_dimension
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances
from rfem_jax.task_kinds import names_of_tables, task_kinds

MOST_STEPS, MOST_SAVED = 1e9, 1e6
LONGEST_NAME = 100
# No file of Windows can have these names, whatever its ending.
DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
# And those of tasks.
STUDY_KEYS = (
    ("mechanism", "simulation"),  # which may be left out where there is [statics]
    ("title", "note", "drive", "drives", "design", "cases", "tolerances", "metrics", "statics"),
)
CASE_KEYS = (("name",), ("errors",))
_ROUNDING = 1.0 + 1e-9  # 0.5 / 1e-3 and the like must not fail by rounding


@dataclass(frozen=True)
class Case(ChecksItself):
    """One set of assembly errors.

    Args:
        name: letters, digits, "_", "-" and "." (it becomes a file's name).
        errors: {name: value}, values in m or rad, or strings with a unit; errors not named are 0.
    Raises:
        InputError: the name makes no file name, or an error's name or value is wrong.
    """

    name: str
    errors: dict[str, float] = field(default_factory=dict)

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", _file_name)
        checks.convert("errors", _errors, self.name)


@dataclass(frozen=True)
class Study(ChecksItself):
    """A complete study, checked as a whole.

    Args:
        title: one line.
        mechanism: a Mechanism.
        drive: a given or prescribed drive on a joint of the tree, a list of them, or None.
        duration: [s], > 0; None of a study of a mechanism at rest, which nothing simulates.
        method: a Method.
        save_every: interval [s] between saved times, or None for the simulation's default.
        cases: Case objects with unique names; none means one case "nominal" without errors.
        path: the file it was read from.
        note: what a reader of the results must know; shown with every table and picture.
        tasks: tolerances of the errors and the tolerance studies to do.
        asked_method: the Method that was asked for, where `method` was chosen for it; None = `method`.
        design: {parameter: value, or (lowest, highest)}, in SI units or strings with a unit: values replace those of
            the mechanism and its drives, pairs are bounds for `optimise`.
        metrics: names of metrics that every case is reported with besides its joint loads, as "coupler.peak_stress"
            or "*.peak_stress" for all links that have it.
        start: "as_given": freedoms that no drive holds start at the start values of the joints, at their initial rates,
            once flexible links have settled; "equilibrium": they start in static equilibrium, at rest. None = as the
            mechanism says ("as_given").
        statics: what is held, and where, as `Statics`: the metrics of all tasks are then those of the mechanism at
            rest. None: they are those of simulations.
    Raises:
        InputError: parts do not fit each other.
    """

    title: str
    mechanism: Mechanism
    drive: AnyDrive | tuple[AnyDrive, ...] | None = None
    duration: float | None = None
    method: Method = field(default_factory=Automatic)
    save_every: float | None = None
    cases: tuple[Case, ...] = ()
    path: Path | None = None
    note: str = ""
    tasks: Tasks = field(default_factory=Tasks)
    asked_method: Method | None = None
    design: dict[str, Any] = field(default_factory=dict)
    metrics: tuple[str, ...] = ()
    start: str | None = None
    statics: Statics | None = None

    def _repr_html_(self) -> str:
        return study_html(self)

    def _check_fields(self, checks: Checks) -> None:
        kinds = {"title": str, "note": str, "mechanism": Mechanism}
        kinds |= {"method": Method, "tasks": Tasks}
        for name, kind in kinds.items():
            checks.convert(name, _of_kind, name, kind)
        checks.convert("drive", _drives)
        checks.convert("cases", _cases)
        if self.duration is not None:
            checks.convert("duration", positive_quantity, "time", "duration")
        if self.save_every is not None:
            checks.convert("save_every", positive_quantity, "time", "save_every")
        checks.relation(("duration", "method", "save_every"), self._check_times)
        checks.relation(("mechanism", "drive"), self._check_driven_joints)
        if self.start is not None:
            checks.convert("start", require_choice, STARTS, "start")
            checks.relation(("mechanism", "start"), self._set_start)
        if self.statics is not None:
            checks.convert("statics", _of_kind, "statics", Statics)
            checks.relation(("mechanism", "drive", "statics"), self._resolve_statics)
        checks.relation(("mechanism", "drive", "design"), self._check_design)
        checks.relation(("drive", "duration"), self._check_drive_end)
        checks.relation(("mechanism", "cases"), self._check_cases)
        checks.relation(("mechanism", "drive", "tasks", "statics"), self._check_tasks)
        if self.metrics:
            checks.convert("metrics", metric_names)
        checks.relation(("mechanism", "drive", "duration", "metrics", "statics"), self._resolve_metrics)

    @property
    def tolerances(self) -> SpecifiedTolerances | None:
        """The tolerances that the study specifies; `rfem_jax.Tolerances.of(study)` makes distributions of them."""
        return self.tasks.tolerances

    def case(self, name: str) -> Case:
        """Return the case `name`; raises InputError with the nearest name if there is none."""
        for case in self.cases:
            if case.name == name:
                return case
        known = [case.name for case in self.cases]
        raise InputError(
            f"Argument `name` must be a case of the study, but `{name}` is none; {suggestion(name, known)}"
        )

    def require_duration(self) -> float:
        """The duration [s]. Raises InputError for a study that has none."""
        if self.duration is None:
            raise InputError(
                "Argument `duration` of a study must be given for a simulation, but is missing; add a table "
                "[simulation] with it, or compute loads at rest: `rfem-jax statics`, and the tasks with a table "
                "[statics]."
            )
        return self.duration

    @property
    def mechanism_at_rest(self) -> Mechanism:
        """The mechanism with all that is held when it is at rest."""
        return self.mechanism if self.statics is None else self.statics.held(self.mechanism)

    def _check_times(self) -> None:
        if self.duration is None:
            return
        step, saving, problems = self.method.step, self.save_every, []
        if step is not None and step > self.duration * _ROUNDING:
            problems.append(
                f"Argument `step` must not exceed the duration ({self.duration} s), but was {step} s; reduce it."
            )
        if saving is not None and saving > self.duration * _ROUNDING:
            problems.append(
                f"Argument `save_every` must not exceed the duration ({self.duration} s), but was "
                f"{saving} s; reduce it."
            )
        if saving is not None and step is not None and saving < step / _ROUNDING and not problems:
            problems.append(
                f"Argument `save_every` must not be less than the step ({step} s), but was "
                f"{saving} s; saved times are ends of steps: increase it or reduce the step."
            )
        if step is not None and self.duration / step > MOST_STEPS:
            problems.append(
                f"Argument `duration` must be at most {MOST_STEPS:g} steps, but {self.duration:g} s are "
                f"{self.duration / step:.3g} steps of {step:g} s, which would take days; check both numbers."
            )
        elif saving is not None and self.duration / saving > MOST_SAVED and not problems:
            problems.append(
                f"Argument `save_every` must leave at most {MOST_SAVED:g} saved times, but {self.duration:g} s have "
                f"{self.duration / saving:.3g} intervals of {saving:g} s; increase it."
            )
        if problems:
            raise InputError(*problems)

    @property
    def drives(self) -> tuple[AnyDrive, ...]:
        """All drives, in their order."""
        return each_drive(self.drive)

    @property
    def drive_labels(self) -> tuple[str, ...]:
        """Names of the free motions that the drives act on, "A" or "C.T_y", in the order of the drives."""
        named = zip(self.drives, self.drive_motions, strict=True)
        return tuple(motion_label(one.joint, self.mechanism.joint(one.joint).kind, motion) for one, motion in named)

    @property
    def drive_motions(self) -> tuple[str, ...]:
        """Names of the free motions that the drives act on, as "R_y", in the order of the drives."""
        return tuple(driven_motion(one, self.mechanism.joint(one.joint).kind) for one in self.drives)

    @property
    def drive_jumps(self) -> tuple[float, ...]:
        """Times [s] at which any drive jumps."""
        return all_breakpoints(self.drive)

    def _check_driven_joints(self) -> None:
        if not self.drives:
            return
        tree, problems = [joint.name for joint in self.mechanism.tree_joints], Problems()
        for one in self.drives:
            with problems.noted():
                if one.joint not in tree:
                    cut = one.joint in [joint.name for joint in self.mechanism.cut_joints]
                    reason = "is a cut joint" if cut else "is none"
                    fix = "cut another joint of the loop." if cut else suggestion(one.joint, tree)
                    raise InputError(
                        f"Argument `joint` of the drive must be a joint of the tree, but `{one.joint}` {reason}; {fix}"
                    )
                motion = driven_motion(one, self.mechanism.joint(one.joint).kind)
                if isinstance(one, PrescribedDrive):
                    self.mechanism.joint(one.joint).require_no_rate(motion)
        problems.refuse()
        # The model holds the driven joints at assembly, those of prescribed motions first.
        order = sorted(range(len(self.drives)), key=lambda i: not isinstance(self.drives[i], PrescribedDrive))
        labels = tuple(self.drive_labels[i] for i in order)
        driven = replace(self.mechanism, driven_joint=labels[0] if len(labels) == 1 else labels)
        object.__setattr__(self, "mechanism", driven)

    def _set_start(self) -> None:
        object.__setattr__(self, "mechanism", replace(self.mechanism, start=self.start))

    def _check_design(self) -> None:
        if self.design == {}:
            return
        found = read_design(self.design, self.mechanism, self.drives, self.drive_labels)
        object.__setattr__(self, "design", found)

    @property
    def design_values(self) -> dict[str, float]:
        """Values [SI units] that the design sets; what could not be read is none."""
        design = self.design if isinstance(self.design, dict) else {}
        return {name: value for name, value in design.items() if isinstance(value, float)}

    @property
    def designed_drive(self) -> AnyDrive | tuple[AnyDrive, ...] | None:
        """The drive, with the numbers that the design sets."""
        numbers = {name: value for name, value in self.design_values.items() if name.startswith("drive.")}
        if not numbers:
            return self.drive
        return _drives(drives_with(self.drives, self.drive_labels, numbers))

    @property
    def design_bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds [SI units] of the numbers that an optimisation may change."""
        return {name: value for name, value in self.design.items() if isinstance(value, tuple)}

    def _check_drive_end(self) -> None:
        if self.duration is None:
            return
        for one in self.drives:
            end = one.times[-1] if isinstance(one, (PrescribedTable, PrescribedDisplacements)) else self.duration
            if end * _ROUNDING < self.duration:
                raise InputError(
                    f"Argument `times` of the drive must reach the duration ({self.duration} s), but "
                    f"ends at {end} s; add later times or reduce the duration."
                )

    def _check_cases(self) -> None:
        seen: set[str] = set()
        problems = Problems()
        for case in self.cases:
            with problems.noted():
                # Names of files: "p1" and "P1" are one file on some machines.
                if case.name.lower() in seen:
                    raise InputError(
                        "Argument `cases` must have unique names (upper and lower case count as "
                        f"equal), but `{case.name}` occurs twice; rename one."
                    )
                seen.add(case.name.lower())
                sizes = {name: abs(value) for name, value in case.errors.items()}
                require_sizes(self.mechanism, sizes, f"`errors` of case `{case.name}`")
                require_signs(self.mechanism, case.errors, self.design_values, f"`errors` of case `{case.name}`")
        problems.refuse()

    def _check_tasks(self) -> None:
        with known_while_reading(self.mechanism, self.drives):
            object.__setattr__(self, "tasks", self.tasks.resolved(self.mechanism_at_rest))
        if self.statics is None:
            return
        problems = Problems()
        for name in self.tasks.declared:
            with problems.noted():
                metrics = getattr(self.tasks.asked[name], "metrics", ())
                require_at_rest(metrics, f" of the task `{name}`, whose study has [statics],")
            with problems.noted():
                require_no_drive(
                    self.mechanism, getattr(self.tasks.asked[name], "bounds", None) or (), f"`bounds` of [{name}]"
                )
        with problems.noted():
            tolerances = self.tasks.tolerances
            require_no_drive(self.mechanism, () if tolerances is None else tolerances.names, "`[tolerances]`")
        problems.refuse()

    def _resolve_statics(self) -> None:
        assert self.statics is not None, "there is such a table"
        object.__setattr__(self, "statics", self.statics.resolved(self.mechanism))
        self.mechanism_at_rest  # noqa: B018  # raises where its parts do not fit

    def _resolve_metrics(self) -> None:
        subjects = subjects_of(self.mechanism_at_rest if self.duration is None else self.mechanism)
        found = [one for name in self.metrics for one in require_metric(name, subjects, "mechanism")]
        owners = points_of(found)
        object.__setattr__(self, "mechanism", self.mechanism.following(owners))
        silent = [point.name for point in self.mechanism.points if point.name not in owners]
        found += [f"{point}.{kind}" for point in silent for kind in REPORTED]
        found = with_shaking(found, self.mechanism)
        object.__setattr__(self, "metrics", tuple(dict.fromkeys(found)))


def load_study(path: str | Path) -> Study:
    """Read a study file.

    Args:
        path: of a TOML file.
    Raises:
        InputError: the file cannot be read or anything in it is wrong: for each mistake that can be
            found, a line that says where it is and how to correct it.
    """
    path = Path(path)
    content = read_toml(path)
    try:
        with located(f"Study file `{path}`"):
            return _read_study(content, path)
    except WrongSetting:
        raise
    except InputError as error:
        raise InputError(*condensed(error.problems)) from None


def _read_study(content: dict[str, Any], path: Path) -> Study:
    """The study of the tables of a file; what is wrong in one table does not hide what is wrong in others."""
    problems = Problems()
    required, optional = STUDY_KEYS
    if "statics" in content:
        required, optional = required[:1], (*required[1:], *optional)
    content = checked_table(content, "The top level", required, (*optional, *task_kinds()), problems)
    if "mechanism" in content:
        content["mechanism"] = with_form_errors(content)
    parts: dict[str, Any] = {"title": path.stem, "drive": None, "path": path}
    parts |= {name: content[name] for name in ("title", "note", "metrics") if name in content}
    readers: dict[str, Callable[[Any], Any]] = {
        "mechanism": lambda table: read_mechanism(table, path.parent), "drive": read_drive, "drives": read_drives,
        "simulation": read_simulation, "cases": _read_cases,
        "statics": lambda table: read_table(Statics, table, "[statics]"),
    }  # fmt: skip
    for name, read in readers.items():
        if name in content:
            with known_while_reading(parts.get("mechanism")):
                parts[name] = problems.attempt(read, content[name])
    if "design" in content:
        parts["design"] = content["design"]
    if "drives" in parts:
        drive, drives = parts["drive"], parts.pop("drives")
        parts["drive"] = ABSENT if ABSENT in (drive, drives) else (*each_drive(drive), *drives)
    drives = None if parts["drive"] is ABSENT else each_drive(parts["drive"])
    with known_while_reading(parts["mechanism"], drives):
        parts["tasks"] = problems.attempt(read_tasks, {key: one for key, one in content.items() if one is not ABSENT})
    if content.get("tolerances") is ABSENT:
        parts["tasks"] = ABSENT
    times = ("duration", "method", "save_every", "start")
    simulation = parts.pop("simulation", {})
    if simulation is ABSENT:
        parts |= dict.fromkeys(times, ABSENT)
    elif simulation:
        parts |= dict(zip(times, simulation, strict=True))
    study = problems.attempt(lambda: Study(**parts))
    problems.refuse()
    return study


def _read_cases(entries: object) -> tuple[Case, ...]:
    return tuple(read_list(entries, "[[cases]]", _read_case))


def _read_case(entry: object, place: str) -> Case:
    problems, case = Problems(), None
    settings = checked_table(entry, place, *CASE_KEYS, problems)
    with problems.noted(), located(place) if settings["name"] is ABSENT else nullcontext():
        case = Case(**settings)
    problems.refuse()
    assert case is not None, "what is missing has been noted"
    return case


def _errors(errors: object, case: object) -> dict[str, float]:
    if not isinstance(errors, dict):
        raise InputError(
            f"Argument `errors` of case `{case}` must be a table of names and values, but "
            f'was {errors!r}; write for example {{ "D.delta_x" = "0.5 deg" }}.'
        )
    values, problems = {}, Problems()
    for name, value in errors.items():
        with problems.noted():
            with located(f"Case `{case}`"):
                dimension = error_dimension(name)
            values[name] = quantity(value, dimension, f"`{name}` of case `{case}`")
    problems.refuse()
    return values


def _of_kind(value: Any, name: str, kind: type | tuple[type, ...]) -> Any:
    if not isinstance(value, kind):
        wanted = {"title": "string"}.get(name, name.title())
        raise InputError(f"Argument `{name}` of a study must be a {wanted}, but was {value!r}; pass one.")
    return value


def _drives(drive: Any) -> Any:
    """A drive, several as a tuple, or None; a list of one is this one."""
    found = each_drive(drive)
    return None if not found else found[0] if len(found) == 1 else found


def _cases(cases: Any) -> tuple[Case, ...]:
    return require_entries(cases, "cases", Case, "Case objects", 'write [Case("P1"), ...].') or (Case("nominal"),)


def _file_name(name: Any) -> str:
    text = name if isinstance(name, str) else ""
    allowed = all(letter.isascii() and (letter.isalnum() or letter in "_-.") for letter in text)
    if not allowed or not text or not text[0].isalnum() or text[-1] == ".":
        raise InputError(
            'Argument `name` of a case must consist of letters, digits, "_", "-" and "." and '
            f"start with a letter or a digit, but was {name!r}; it is used as a file name."
        )
    if len(text) > LONGEST_NAME:
        raise InputError(
            f"Argument `name` of a case must have at most {LONGEST_NAME} characters, but has {len(text)}; it is used "
            "as a file name."
        )
    if text.lower() in names_of_tables():
        raise InputError(
            f"Argument `name` of a case must not be that of a file with other results, but was `{name}`; write for "
            f"example `{name}_case`."
        )
    if text.lower().partition(".")[0] in DEVICES:
        raise InputError(
            f"Argument `name` of a case must not be that of a device of Windows, but was `{name}`; write for example "
            f"`case_{name}`: it is used as a file name."
        )
    return name
