"""The result of an estimate of production: the distribution of errors, of the machines in its light, as [tolerances].

Place in the pipeline: production -> **production_result** -> terminal, files, page, notebooks.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.labelled_data import Arrays, Labelled, LabelledResult, Parts, Table, named_dimension
from rfem_jax.tolerancing.layout import show_error, show_number

MOST_TOLD = 12  # machines in a text
# What a status means, the worst first.
STATUSES = {
    "failed": "too few machines were identified",
    "undetermined": "the machines do not bound the scatter of an error: measure what tells of it, or more machines",
    "unlike": "a machine is unlike the others, so that errors are not normal: look at it, and leave it out if it is no "
    "sample of production",
    "selected": "many machines were left out, and the others may be a selection: see why these were not identified",
    "ok": "the machines are a sample of one normal distribution",
}


@dataclass(frozen=True, eq=False)
class Production(LabelledResult):
    """The distribution of errors that production has.

    names, error_units (k); mean, deviation (k,) [rad, m] with intervals mean_low ... deviation_high of `confidence`,
    infinite where nothing bounds it; shrinkage (k,): how much of a machine's errors comes from the others, between 0,
    where its own data tell all, and 1; machines (n): names; errors, errors_deviation (n, k) [rad, m] of each in the
    light of all; chances (n,): probability of a machine that is as far from the mean; unlike: machines too far from it;
    left_out {machine: status of its identification}; tolerances (k, 2), NaN without; status: see `message`.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    mean: Float[np.ndarray, " k"]
    mean_low: Float[np.ndarray, " k"]
    mean_high: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    deviation_low: Float[np.ndarray, " k"]
    deviation_high: Float[np.ndarray, " k"]
    shrinkage: Float[np.ndarray, " k"]
    machines: tuple[str, ...]
    errors: Float[np.ndarray, "n k"]
    errors_deviation: Float[np.ndarray, "n k"]
    chances: Float[np.ndarray, " n"]
    unlike: tuple[str, ...]
    left_out: dict[str, str]
    tolerances: Float[np.ndarray, "k 2"]
    confidence: float
    status: str

    index = ("error",)

    @property
    def message(self) -> str:
        """The status in a sentence."""
        return STATUSES[self.status]

    def lines(self) -> str:
        """The table [tolerances] of a study file: normal errors, whose interval holds three standard deviations on
        each side; a comment for an error whose scatter is not seen, or not bounded."""
        found = ["[tolerances]"]
        for i, (name, unit) in enumerate(zip(self.names, self.error_units, strict=True)):
            word, factor = as_specified(unit)
            mean, deviation = factor * self.mean[i], factor * self.deviation[i]
            low, high = factor * self.deviation_low[i], factor * self.deviation_high[i]
            words = f"{len(self.machines)} machines: mean {mean:.4g}, deviation {deviation:.4g} {word}"
            words += f" ({low:.3g} to {high:.3g})"
            ends = [f'"{mean + side * deviation:.6g} {word}"' for side in (-3.0, 3.0)]
            line = f'"{name}" = {{ interval = [{", ".join(ends)}], distribution = "normal" }}  # {words}'
            sure = deviation > 0.0 and np.isfinite(high) and ends[0] != ends[1]
            found.append(line if sure else f"# {name}: {words}, too little is known")
        return "\n".join(found) + "\n"

    def rows(self) -> list[dict[str, Any]]:
        """A row per error; `unit` is that of all numbers but `shrinkage`."""
        keys = ("mean", "mean_low", "mean_high", "deviation", "deviation_low", "deviation_high", "shrinkage")
        return [
            {
                "error": name, "unit": self.error_units[i], **{key: float(getattr(self, key)[i]) for key in keys},
                "tolerance_low": float(self.tolerances[i, 0]), "tolerance_high": float(self.tolerances[i, 1]),
            }
            for i, name in enumerate(self.names)
        ]  # fmt: skip

    def machine_rows(self) -> list[dict[str, Any]]:
        """A row per machine: its errors in the light of all, with deviations [rad, m], or why it was left out."""
        rows = []
        for i, machine in enumerate(self.machines):
            row: dict[str, Any] = {"machine": machine, "status": "unlike" if machine in self.unlike else "ok"}
            for j, name in enumerate(self.names):
                row |= {name: float(self.errors[i, j]), f"{name}_deviation": float(self.errors_deviation[i, j])}
            rows.append(row | {"chance": float(self.chances[i])})
        empty = dict.fromkeys(["chance", *(key for one in self.names for key in (one, f"{one}_deviation"))], np.nan)
        return rows + [{"machine": one, "status": status, **empty} for one, status in self.left_out.items()]

    def arrays(self) -> Arrays:
        """Errors over `error`, machines over `machine`."""
        error, unit = ("error",), "in error_unit"
        variables = {
            key: Labelled(error, getattr(self, key), "", unit)
            for key in ("mean", "mean_low", "mean_high", "deviation", "deviation_low", "deviation_high")
        }
        variables |= {
            "shrinkage": Labelled(error, self.shrinkage, "1", "part of a machine's errors that comes from the others"),
            "machine_error": Labelled(("machine", "error"), self.errors, "", unit),
            "machine_deviation": Labelled(("machine", "error"), self.errors_deviation, "", unit),
            "chance": Labelled(("machine",), self.chances, "1", "of a machine as far from the mean"),
        }
        coordinates = named_dimension("error", self.names, self.error_units) | {"machine": list(self.machines)}
        return variables, coordinates, {"title": "Production", "status": self.status, "confidence": self.confidence}

    def parts(self) -> Parts:
        """The distribution, machines that are unlike or were left out, the lines of a study file."""
        interval = f"{100.0 * self.confidence:g} % interval"
        rows = [
            [
                row["error"], show_error(row["mean"], row["unit"], 4),
                _range(row["mean_low"], row["mean_high"], row["unit"]), show_error(row["deviation"], row["unit"], 3),
                _range(row["deviation_low"], row["deviation_high"], row["unit"]),
                show_error(0.5 * (row["tolerance_high"] - row["tolerance_low"]), row["unit"], 4),
                show_number(100.0 * row["shrinkage"], 3),
            ]
            for row in self.rows()
        ]  # fmt: skip
        header = ["error", "mean", interval, "deviation", interval, "tolerance +-", "from others %"]
        head = f"Production, from {len(self.machines)} machines: status {self.status}: {self.message}"
        parts: list[str | Table] = [head, Table(header, rows)]
        if self.unlike:
            parts.append(f"Unlike the others: {_some(self.unlike)}.")
        if self.left_out:
            counts = ", ".join(f"{count} {status}" for status, count in Counter(self.left_out.values()).items())
            parts.append(f"Left out ({counts}): {_some(tuple(self.left_out))}.")
        return parts if self.status == "failed" else [*parts, "", *self.lines().splitlines()]


def _range(low: float, high: float, unit: str) -> str:
    word, factor = as_specified(unit)
    return f"{show_number(factor * low, 3)} to {show_number(factor * high, 3)} {word}"


def _some(names: tuple[str, ...]) -> str:
    more = len(names) - MOST_TOLD
    return ", ".join(names[:MOST_TOLD]) + (f" and {more} more" if more > 0 else "")
