"""Of pictures that differ in their numbers alone the first is drawn."""

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from rfem_jax.report import pictures, style
from tests.drawn_first import drawn_first


def figure(label="a", lines=1):
    made = Figure(figsize=(2.0, 1.0))
    axes = made.subplots()
    axes.set_xlabel(label)
    for n in range(lines):
        axes.plot([0.0, n + 1.0])
    return made


def test_the_first_of_each_kind_is_drawn(monkeypatch):
    monkeypatch.setitem(style.SETTINGS, "savefig.dpi", 50)
    draw = drawn_first(pictures._drawn)
    with matplotlib.rc_context(style.SETTINGS):
        for kind in ({}, {"label": "b"}, {"lines": 2}):
            assert np.ptp(draw(figure(**kind))) > 0
            again = draw(figure(**kind))
            assert again.shape == (50, 100, 4) and again.dtype == np.uint8 and (again == 255).all()
