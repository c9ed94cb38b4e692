"""The kinds of tasks that a study may declare, in words: the one list that everything else follows.

Place in the pipeline: beside all packages, and imports none of them, so that `rfem-jax --help` does not wait for JAX.
The reader of study files takes the tables from here (`description`), the command line its subcommands, and `check` its
overview (`report`).

A kind has two classes: what is asked (a subclass of `Task`, whose fields are the keys of the table), and how it is
computed and shown (a subclass of `TaskReport`). Those of the kinds below are known to the catalogues of
`description.tasks` and `report.tasks`; a kind from outside the package brings its own (`register_task`).
"""

from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class TaskKind:
    """A kind of task, from the table of a study file to the files with its results.

    Args:
        name: of the table [name] in a study file, and of the files written; letters, digits and "_".
        asks: the class of what is asked, or "module:Class", which is imported when it is needed; None: a kind of the
            package's own.
        reports: the class that computes and shows it, or "module:Class"; None: as above.
        purpose: what it finds out, for `--help`.
        results: what it writes, for `--help`.
        title: its name in words; None makes them of `name`.
        command: the subcommand that does it alone; None makes it of `name`, with "-" for "_".
        many_processes: True if several processes can share its work (the command then has options for them).
        kept: what an interrupted run leaves for the same command to continue with; "" for nothing.
        tables: names without ending of the CSV files that it writes besides NAME.csv; no case may have them.
        data: True if it reads a file with measurements, the key `data` of its table, which the command may name.
    """

    name: str
    asks: type | str | None
    reports: type | str | None
    purpose: str
    results: str
    title: str | None = None
    command: str | None = None
    many_processes: bool = False
    kept: str = ""
    tables: tuple[str, ...] = ()
    data: bool = False

    def __post_init__(self):
        if not self.name.isidentifier() or not self.name.isascii():
            raise ValueError(
                f'Argument `name` of a kind of task must consist of letters, digits and "_", but was {self.name!r}; '
                "it names a table of study files."
            )
        words = self.name.replace("_", " ")
        object.__setattr__(self, "title", self.title or words[:1].upper() + words[1:])
        object.__setattr__(self, "command", self.command or self.name.replace("_", "-"))

    def asked_class(self) -> Any:
        """The class of what is asked, of a kind from outside the package."""
        return _imported(self.asks)

    def report_class(self) -> Any:
        """The class that computes and shows it, of a kind from outside the package."""
        return _imported(self.reports)


# Names that study files and the command line use for something else.
RESERVED_TABLES = (
    "title",
    "note",
    "mechanism",
    "drive",
    "drives",
    "design",
    "simulation",
    "statics",
    "cases",
    "tolerances",
)
# CSV files, without their ending, of the subcommands that are no tasks.
OTHER_TABLES = ("statics", "statics_sections", "turn", "modes", "cycle", "comparison", "comparison_tasks", "validation")
# Subcommands that are no tasks, in the order of `--help`: each is a file of `rfem_jax.report.commands` of that name.
COMMANDS = (
    "init",
    "run",
    "statics",
    "modes",
    "turn",
    "cycle",
    "check",
    "compare",
    "keys",
    "parameters",
    "report",
    "import",
    "export",
    "validate",
)

# Their classes are those of the two catalogues.
_own = partial(TaskKind, asks=None, reports=None)
_OF_THE_PACKAGE = (
    _own(
        "sensitivity",
        purpose="derivatives of joint loads with respect to assembly errors",
        results="ranked tables, principal directions, heat map, tornado chart",
    ),
    _own(
        "monte_carlo",
        title="Monte Carlo",
        purpose="scatter, quantiles and yield over the tolerances; continues an interrupted run",
        results="statistics, all samples, histograms, scatter matrix; chunks of samples in DIR/monte_carlo",
        many_processes=True,
        kept="finished chunks of a Monte Carlo study",
    ),
    _own(
        "worst_case",
        purpose="largest loads anywhere within the tolerances",
        results="the worst errors, all corners, the quadratic model's prediction",
    ),
    _own(
        "allocation",
        command="allocate",
        purpose="the cheapest tolerances that keep limits on loads",
        results="tolerances before and after, verified margins, cost against limits",
        tables=("allocation_front",),
    ),
    _own(
        "sweep",
        purpose="metrics over ranges of errors and dimensions, the surface through them; continues an interrupted run",
        results="all points, the response surface with its error, responses, contours; chunks of points in DIR/sweep",
        many_processes=True,
        kept="finished chunks of a sweep",
    ),
    _own(
        "reliability",
        purpose="probabilities that limits are broken, however small (FORM, importance sampling, subset simulation)",
        results="probabilities with intervals, the most probable failures, what errors contribute to them",
    ),
    _own(
        "optimise",
        purpose="the best dimensions and tolerances that keep limits",
        results="dimensions and tolerances before and after, verified margins, Pareto front",
        kept="evaluations of an optimisation",
        tables=("optimise_limits", "optimise_front"),
    ),
    _own(
        "identification",
        command="identify",
        purpose="the errors of a machine from what was measured of it, and what measurements can tell",
        results="errors with intervals, how well signals are fitted, simulated curves, the best correction",
        kept="evaluations of an identification",
        tables=("identification_curves", "identification_correction", "identification_machines"),
        data=True,
    ),
)  # fmt: skip
_kinds = {one.name: one for one in _OF_THE_PACKAGE}


def task_kinds() -> dict[str, TaskKind]:
    """{name: kind} of all kinds that are known, in the order in which a study's tasks are done."""
    return dict(_kinds)


def names_of_tables() -> tuple[str, ...]:
    """Names without ending of the CSV files in a folder of results that are no case's."""
    return (*OTHER_TABLES, *(name for kind in _kinds.values() for name in (kind.name, *kind.tables)))


def register_task(kind: TaskKind) -> TaskKind:
    """Make a kind of task known: study files may then have its table, and `rfem-jax` has its subcommand.

    Returns: the kind.
    Raises: ValueError if its name or its command is in use, or a class is missing.
    """
    for name in ("asks", "reports"):
        if getattr(kind, name) is None:
            raise ValueError(f"Argument `{name}` of a kind of task must be a class, but is None; give one.")
    if kind.name in (*_kinds, *RESERVED_TABLES):
        raise ValueError(
            f"Argument `name` of a kind of task must be a new one, but `{kind.name}` is in use; choose another."
        )
    commands = [one.command for one in _kinds.values()]
    if kind.command in (*commands, *COMMANDS):
        raise ValueError(
            f"Argument `command` of a kind of task must be a new one, but `{kind.command}` is in use; choose another."
        )
    _kinds[kind.name] = kind
    return kind


def _imported(named: type | str | None) -> Any:
    if not isinstance(named, str):
        return named
    module, _, name = named.partition(":")
    return getattr(import_module(module), name)
