"""The picture of a band of paths: the path of a point with its deviations enlarged, and these over time.

Place in the pipeline: `tolerancing.sampling.path_band` -> **path_figure** -> monte_carlo.
"""

import math

import numpy as np

from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Axes, Figure
from rfem_jax.report.drawings.style import BAR_COLOURS, CASE_COLOURS, add_titles, new_figure
from rfem_jax.tolerancing.sampling.path_band import PathBand

MILLI = 1e3
SHARE = 0.12  # of the extent of the path: how large deviations are drawn
IN_PLANE = {"xz": (0, 2), "xy": (0, 1)}
WORDS = ("along", "across", "out of the plane")


def band_figure(study: Study, band: PathBand) -> Figure:
    """Paths of the samples about that of the perfect mechanism, and the band of their deviations over time [mm]."""
    figure = new_figure(9.6, 5.6)
    whole = figure.add_gridspec(4, 2, width_ratios=[1.25, 1.0], height_ratios=[1.0, 1.0, 1.0, 0.12])
    scale = _draw_paths(figure.add_subplot(whole[:, 0]), band)
    below = None
    for part, words in enumerate(WORDS):
        axes = figure.add_subplot(whole[part, 1], sharex=below)
        below = axes if below is None else below
        _draw_part(axes, band, part)
        axes.set_title(f"{words} [mm]", loc="left")
        axes.tick_params(labelbottom=part == 2)
        if part == 2:
            axes.set_xlabel("time [s]")
    assert below is not None
    legend = figure.add_subplot(whole[3, 1])
    legend.set_axis_off()
    legend.legend(*below.get_legend_handles_labels(), loc="center", ncols=2, frameon=False)
    heading = f"Paths of {band.point} of {len(band.deviations)} samples"
    add_titles(figure, f"{heading}; deviations drawn {scale:g} times", study)
    return figure


def _draw_paths(axes: Axes, band: PathBand) -> float:
    """All paths in the plane, their deviations enlarged by the number that is returned."""
    largest = band.distances.max()
    scale = _round_down(SHARE * np.ptp(band.perfect, axis=0).max() / largest) if largest > 0.0 else 1.0
    for deviation in band.deviations:
        x, z = (MILLI * (band.perfect + scale * deviation)[:, i] for i in IN_PLANE[band.plane])
        axes.plot(x, z, color=CASE_COLOURS[2], linewidth=0.4, alpha=max(0.1, 8.0 / len(band.deviations)))
    x, z = (MILLI * band.perfect[:, i] for i in IN_PLANE[band.plane])
    axes.plot(x, z, color=CASE_COLOURS[0], linewidth=1.6, label="perfect mechanism")
    axes.plot(x[:1], z[:1], "o", color=CASE_COLOURS[0], markersize=4.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [mm]")
    axes.set_ylabel(f"{band.plane[1]} [mm]")
    axes.set_title("path, and start of the perfect one", loc="left")
    return scale


def _draw_part(axes: Axes, band: PathBand, part: int) -> None:
    envelope = MILLI * band.smallest[:, part], MILLI * band.largest[:, part]
    ends = MILLI * band.low[:, part], MILLI * band.high[:, part]
    axes.fill_between(band.times, *ends, color=BAR_COLOURS[2], label=f"{100 * band.level:g} % of the samples")
    for end, label in zip(envelope, ("envelope", None), strict=True):
        axes.plot(band.times, end, color=CASE_COLOURS[1], linewidth=1.0, linestyle="--", label=label)
    axes.axhline(0.0, color=CASE_COLOURS[0], linewidth=0.6)


def _round_down(number: float) -> float:
    """The next number below of 1, 2, 5, 10, ..., at least 1."""
    if number <= 1.0 or not math.isfinite(number):
        return 1.0
    ten = 10.0 ** math.floor(math.log10(number))
    return max(factor * ten for factor in (1.0, 2.0, 5.0) if factor * ten <= number)
