"""The band of the paths of a point: where samples have it, about its path on the perfect mechanism.

Place in the pipeline: sampled_paths -> **path_band** -> Monte Carlo results, tables, files and pictures.

Parts of a deviation are those of theory (8.22): along the path of the perfect mechanism, across it within the plane,
and out of the plane.

Symbols: n samples, T times.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from rfem_jax.description.metrics.path_metrics import OUT_OF_PLANE
from rfem_jax.labelled_data import COMPONENTS, Arrays, Labelled, LabelledResult, Parts, Table
from rfem_jax.tolerancing.layout import show_number

PARTS = ("along", "across", "out_of_plane")


@dataclass(frozen=True, eq=False)
class PathBand(LabelledResult):
    """Where samples have a point, about its path on the perfect mechanism.

    point: its name; times (T,) [s]; perfect (T, 3) [m], velocity (T, 3) [m/s]: the path without errors;
    deviations (n, T, 3) [m]: of the good samples from it, in x, y and z; level: the fraction of samples between `low`
    and `high`, at each time by itself; plane: of the description, "xz" or "xy".
    """

    point: str
    times: Float[np.ndarray, " T"]
    perfect: Float[np.ndarray, "T 3"]
    velocity: Float[np.ndarray, "T 3"]
    deviations: Float[np.ndarray, "n T 3"]
    level: float
    plane: str = "xz"

    index: ClassVar[tuple[str, ...]] = ("time_s",)

    @property
    def axes(self) -> Float[np.ndarray, "T 3 3"]:
        """Unit vectors along the perfect path, across it within the plane, and out of the plane."""
        speed = np.linalg.norm(self.velocity, axis=1, keepdims=True)
        tangent = np.where(speed > 0.0, self.velocity, 0.0) / np.where(speed > 0.0, speed, 1.0)
        # Where the point rests it goes neither along nor across; x stands for along.
        tangent[~tangent.any(axis=1)] = (1.0, 0.0, 0.0)
        out = np.array(OUT_OF_PLANE[self.plane])
        normal = out - tangent * (tangent @ out)[:, None]
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        # Of a path that goes out of the plane x is across.
        normal = np.where(length > 1e-9, normal / np.where(length > 0.0, length, 1.0), np.cross(out, (1.0, 0.0, 0.0)))
        return np.stack([tangent, np.cross(normal, tangent), normal], axis=1)

    @property
    def parts_of_deviations(self) -> Float[np.ndarray, "n T 3"]:
        """Deviations [m] along, across and out of the plane."""
        return np.einsum("tpc,ntc->ntp", self.axes, self.deviations)

    @property
    def distances(self) -> Float[np.ndarray, "n T"]:
        """Sizes of the deviations [m]."""
        return np.linalg.norm(self.deviations, axis=2)

    @property
    def low(self) -> Float[np.ndarray, "T 3"]:
        """Lower end [m] of the band of `level`, by parts."""
        return np.quantile(self.parts_of_deviations, 0.5 * (1.0 - self.level), axis=0)

    @property
    def high(self) -> Float[np.ndarray, "T 3"]:
        """Its upper end [m]."""
        return np.quantile(self.parts_of_deviations, 0.5 * (1.0 + self.level), axis=0)

    @property
    def smallest(self) -> Float[np.ndarray, "T 3"]:
        """Lower end [m] of the envelope of all samples, by parts."""
        return self.parts_of_deviations.min(axis=0)

    @property
    def largest(self) -> Float[np.ndarray, "T 3"]:
        """Its upper end [m]."""
        return self.parts_of_deviations.max(axis=0)

    def arrays(self) -> Arrays:
        """Over `sample`, `time`, `component` (x, y, z) and `part` (along, across, out_of_plane)."""
        by_part, percent = ("time", "part"), f"{100 * self.level:g} %"
        variables = {
            "perfect": Labelled(("time", "component"), self.perfect, "m", "path of the perfect mechanism"),
            "deviation": Labelled(("sample", "time", "component"), self.deviations, "m", "from the perfect path"),
            "low": Labelled(by_part, self.low, "m", f"lower end of the band of {percent}"),
            "high": Labelled(by_part, self.high, "m", f"upper end of the band of {percent}"),
            "smallest": Labelled(by_part, self.smallest, "m", "lower end of the envelope"),
            "largest": Labelled(by_part, self.largest, "m", "upper end of the envelope"),
        }
        coordinates: dict[str, Any] = {"time": Labelled(("time",), self.times, "s", "time")}
        coordinates |= {"component": COMPONENTS, "part": PARTS}
        return variables, coordinates, {"title": f"Band of the paths of {self.point}", "level": self.level}

    def rows(self) -> list[dict[str, Any]]:
        """One row per time: the perfect path, and the ends of band and envelope by parts [m]."""
        ends = {"low": self.low, "high": self.high, "smallest": self.smallest, "largest": self.largest}
        rows = []
        for t, time in enumerate(self.times):
            row: dict[str, Any] = {"time_s": time}
            row |= {f"{self.point}_{axis}_m": self.perfect[t, i] for i, axis in enumerate(COMPONENTS)}
            for part, name in enumerate(PARTS):
                row |= {f"{name}_{end}_m": values[t, part] for end, values in ends.items()}
            rows.append(row)
        return rows

    def parts(self) -> Parts:
        """The widest places of the band."""
        percent = f"{100 * self.level:g} %"
        title = f"Paths of {self.point}: {len(self.deviations)} samples at {len(self.times)} times"
        rows = []
        for part, name in enumerate(PARTS):
            width = self.high[:, part] - self.low[:, part]
            t = int(np.argmax(width))
            ends = self.low[t, part], self.high[t, part], self.smallest[:, part].min(), self.largest[:, part].max()
            rows.append([name.replace("_", " "), show_number(self.times[t]), *map(show_number, ends)])
        header = ["deviation [m]", "widest at [s]", f"{percent} from", "to", "envelope from", "to"]
        return [title, Table(header, rows)]
