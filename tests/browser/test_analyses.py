"""Pages of analyses and of optimisation: charts have the numbers of the files, controls do what they say."""

import json
import math
import shutil

import numpy as np
import pytest

from rfem_jax.report.page.document import write_folder

ANGLES = [0.0, 0.5, 1.0, 1.5]
TURN = {
    "title": "Turn", "units": {"max_force_at": "rad", "holding": "N m"},
    "cases": {
        name: {
            "status": "ok",
            "joints": {
                joint: {"max_force": 10.0 * size, "max_force_at": 1.0, "max_moment": size * k, "max_moment_at": 0.5}
                for k, joint in enumerate("AD", 1)
            },
            "curves": {
                "position": ANGLES, "holding": [size, None, size, size],
                "force": {joint: [10.0 * size] * 4 for joint in "AD"},
                "moment": {joint: [size * k * math.sin(angle) for angle in ANGLES] for k, joint in enumerate("AD", 1)},
                "stress": {"crank": [1e6 * size] * 4},
                "place": {
                    "P": {"x": [0.01 * size * k for k in range(4)], "y": [0.0] * 4, "z": [0.02, None, 0.02, 0.02]},
                },
                "angles": {"P": {axis: [0.1 * size, None, 0.3, 0.4] for axis in "xyz"}},
                "shaking_force": {axis: [size, 2.0, 3.0, 4.0] for axis in "xyz"},
            },
            "shaking": {"max_force": 20.0, "max_force_at": 1.0, "max_moment": 0.0, "max_moment_at": 0.5},
        }
        for name, size in (("perfect", 1.0), ("tilted", 3.0))
    },
}  # fmt: skip
LINE = [[0.1 * i, 0.0, 0.05 * i] for i in range(5)]
MODES = {
    "title": "Modes", "units": {"frequency": "Hz"},
    "cases": {
        "perfect": {
            "status": "ok",
            "modes": [
                {"frequency": 12.5, "damping_ratio": 0.01, "repeated": False, "stable": True,
                 "derivatives": {"D.delta_x": 18.0, "bar.length": -40.0}},
                {"frequency": 80.25, "damping_ratio": 0.02, "repeated": False, "stable": True,
                 "derivatives": {"D.delta_x": None, "bar.length": 1.0}},
            ],
        },
        "tilted": {
            "status": "no_modes",
            "modes": [{"frequency": None, "damping_ratio": None, "repeated": False, "stable": None}] * 2,
        },
    },
    "shapes": {
        "case": "perfect",
        "links": {
            "bar": {
                "points": LINE,
                "moves": [[[0.0, 0.0, i / 4] for i in range(5)], [[0.0, (i / 4) ** 2, 0.0] for i in range(5)]],
            }
        },
    },
}  # fmt: skip
CYCLE = {"title": "Cycle", "cases": {"P1": {"converged": True, "revolutions": 7, "residual": 3e-7}}}
LIMIT = {
    "metric": "D.mean_square_moment", "unit": "(N m)^2", "side": "upper", "limit": 20.0, "nominal": 3.0,
    "predicted": 19.5, "verified": 19.75, "margin": 0.25, "shadow_price": -0.125,
}  # fmt: skip
STATICS = {
    "title": "Clamp", "analysis": "statics", "held": {"A": "rad"},
    "cases": {
        name: {
            "status": "ok", "statuses": ["ok", "ok"], "position": {"A": [0.0, 0.5]},
            "holding": {"A": [factor, 2.0 * factor]},
            "joints": {"A": {"force": [[3.0, 0.0, 4.0], [6.0, 0.0, 8.0]],
                             "moment": [[0.0, 1.0, 0.0], [0.0, 2.0, 0.0]]}},
            "stress": {"lever": [1e6, 2e6]}, "metrics": {"A.max_force": 10.0},
        }
        for name, factor in (("perfect", 1.0), ("short", 1.1))
    },
    "units": {"A": "N m", "A.max_force": "N"},
}  # fmt: skip
OPTIMISE = {
    "title": "Optimum", "criterion": "worst_case", "status": "ok", "message": "found, and a fresh run agrees",
    "objective": 1.25, "terms": {"mass": 0.75, "cost": 5.0}, "initial": {"bar.height": 0.01},
    "designs": {"bar.height": 0.008}, "bounds": {"bar.height": [0.006, 0.014]},
    "tolerances": {"D.delta_x": math.radians(0.2)}, "tolerances_before": {"D.delta_x": math.radians(0.5)},
    "tolerance_bounds": {"D.delta_x": [math.radians(0.05), math.radians(1.0)]}, "at_bounds": {},
    "units": {"bar.height": "m", "D.delta_x": "rad"}, "limits": [LIMIT],
    "history": [[2.0, 0.5], [1.5, 0.1], [1.25, -0.001]],
    "front": [
        {"weight": weight, "status": "ok", "terms": {"mass": 0.5 + weight, "cost": 6.0 - weight},
         "designs": {"bar.height": 0.008}}
        for weight in (0.0, 0.5, 1.0)
    ],
}  # fmt: skip


@pytest.fixture
def page(open_page, tmp_path):
    for name, content in (("turn", TURN), ("modes", MODES), ("optimise", OPTIMISE)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content), encoding="utf-8")
    return open_page(write_folder(tmp_path))


def titles(page, selector):
    script = "return [...document.querySelectorAll(arguments[0] + ' title')].map((one) => one.textContent)"
    return page.run(script, selector)


def ends(page, selector):
    """First and last place of every curve."""
    script = "return [...document.querySelectorAll(arguments[0])].map((one) => one.getAttribute('points').split(' '))"
    return [(one[0], one[-1]) for one in page.run(script, selector)]


def cells(page, selector):
    script = (
        "return [...document.querySelectorAll(arguments[0] + ' tbody tr')]"
        ".map((row) => [...row.cells].map((cell) => cell.textContent))"
    )
    return page.run(script, selector)


def test_loads_at_rest_have_tables_and_a_curve(open_page, tmp_path):
    (tmp_path / "statics.json").write_text(json.dumps(STATICS), encoding="utf-8")
    page = open_page(write_folder(tmp_path))
    page.tab("Statics")
    rows = cells(page, "#static-loads")
    assert len(rows) == 4 and rows[1][:4] == ["perfect", "A", f"A {math.degrees(0.5):.5g} deg", "10"]
    assert [row[3] for row in cells(page, "#static-holding")] == ["1", "2", "1.1", "2.2"]
    assert len(ends(page, "#static-curve polyline")) == 2
    assert cells(page, "#static-metrics")[0] == ["perfect", "A.max_force", "10", "N"]
    assert cells(page, "#static-stresses")[3] == ["short", "lever", f"A {math.degrees(0.5):.5g} deg", "2"]


def test_the_turn_opens_with_the_joint_whose_moment_is_largest(page):
    page.tab("Turn")
    assert page.run("return document.querySelector('#turn-quantity').value") == "moment D"
    assert len(ends(page, "#turn-curves polyline")) == 2
    assert "perfect" in page.text("#turn-curves .legend") and "tilted" in page.text("#turn-curves .legend")
    rows = cells(page, "#turn-loads")
    assert [row[1] for row in rows] == 2 * ["A", "D", "on the base"]
    assert rows[4][:3] == ["tilted", "D", "30"] and float(rows[4][5]) == pytest.approx(math.degrees(0.5), rel=1e-4)
    # Positions that are not assembled leave a gap.
    page.choose("#turn-quantity", "holding")
    assert len(ends(page, "#turn-curves polyline")) == 4
    assert "N m" in page.text("#turn-curves svg")
    page.choose("#turn-quantity", "stress crank")
    assert len(ends(page, "#turn-curves polyline")) == 2 and page.complaints() == []


def test_the_turn_shows_where_points_go_and_what_the_base_feels(page):
    page.tab("Turn")
    for quantity, unit, lines in (("shaking_force x", "N", 2), ("place P z", "mm", 4), ("angles P y", "deg", 4)):
        page.choose("#turn-quantity", quantity)
        assert unit in page.text("#turn-curves svg") and len(ends(page, "#turn-curves polyline")) == lines
    # A path with a gap where a position was not assembled, seen along the axis along which it stays.
    assert len(ends(page, "#turn-path polyline")) == 4 and page.complaints() == []
    assert "x of P, mm" in page.text("#turn-path svg") and "z of P, mm" in page.text("#turn-path svg")


def test_modes_swing_and_are_seen_from_where_they_move(page):
    page.tab("Modes")
    assert cells(page, "#frequencies")[1][:4] == ["2", "80.25", "n/a", "0.02"]
    assert "tilted*" in page.text("#frequencies") and page.text("#page-task-1 .failed") == "* tilted: no_modes."
    pressed = "return document.querySelector('#mode-view button[aria-pressed=true]').dataset.value"
    assert page.run(pressed) == "2"
    first = ends(page, "#mode-shape .curve")
    still = ends(page, "#mode-shape .still")
    assert first[0][0] == still[0][0] and first[0][1] != still[0][1]
    page.choose("#mode", "1")
    assert page.run(pressed) == "1"
    held = ends(page, "#mode-shape .curve")
    page.click("#mode-play")
    assert page.text("#mode-play") == "Pause"
    page.wait(
        "return document.querySelector('#mode-shape .curve').getAttribute('points').split(' ').pop() !== arguments[0]",
        held[0][1],
    )
    page.click("#mode-play")
    assert page.text("#mode-play") == "Play"
    page.click("#mode-view button[data-value='2']")
    assert ends(page, "#mode-shape .curve") == ends(page, "#mode-shape .still")  # it moves along y alone
    # A derivative of 18 Hz/rad is pi/10 Hz/deg.
    slopes = cells(page, "#page-task-1 .card:last-child .tabled:last-child")
    assert float(slopes[0][1]) == pytest.approx(math.pi / 10, rel=1e-4) and slopes[1][1] == "n/a"
    assert page.complaints() == []


def test_an_optimum_before_and_after_between_its_bounds(page):
    page.tab("Optimise")
    assert "Objective 1.25 (mass 0.75, cost 5), worst case, status ok." in page.text("#page-task-2")
    assert "bar.height, before: 10 mm" in titles(page, "#bounds")
    assert "bar.height, after: 8 mm" in titles(page, "#bounds") and "D.delta_x, after: 0.2 deg" in titles(
        page, "#bounds"
    )
    rows = {row[0]: row for row in cells(page, "#designs")}
    assert rows["bar.height"][1:4] == ["dimension", "10 mm", "8 mm"]
    assert rows["D.delta_x"][1:4] == ["tolerance", "0.5 deg", "0.2 deg"]
    assert cells(page, "#design-limits")[0] == [
        "D.mean_square_moment", "(N m)^2", "upper", "20", "3", "19.5", "19.75", "0.25", "-0.125",
    ]  # fmt: skip
    found = titles(page, "#search")
    assert "objective: 2 at 1" in found and "largest constraint, normalised: -0.001 at 3" in found
    assert [row[:3] for row in cells(page, "#front")] == [["0", "0.5", "6"], ["0.5", "1", "5.5"], ["1", "1.5", "5"]]
    assert page.complaints() == []


def test_the_cycle_shows_where_the_bearings_are_pressed(open_page, folder, tmp_path):
    out = shutil.copytree(folder, tmp_path / "out")
    (out / "cycle.json").write_text(json.dumps(CYCLE), encoding="utf-8")
    page = open_page(write_folder(out))
    page.tab("Cycle")
    assert cells(page, "#cycles") == [["P1", "yes", "7", "3e-7"]]
    loads = {(row[0], row[1]): float(row[2]) for row in cells(page, "#cycle-loads")}
    assert loads["P2", "C"] == pytest.approx(8.0)
    assert len(ends(page, "#orbit polyline")) == 3
    before = ends(page, "#orbit polyline")
    page.choose("#orbit-joint", "C")
    assert ends(page, "#orbit polyline") != before and page.complaints() == []


def test_bands_of_paths(open_page, folder, tmp_path):
    """The widest part is shown at first; ends of the band and of the envelope are those of the file, in mm."""
    out = shutil.copytree(folder, tmp_path / "out")
    content = json.loads((out / "monte_carlo.json").read_text(encoding="utf-8"))
    band = {"samples": 32, "level": 0.95, "time": [0.0, 0.1, 0.2, 0.3]}
    for part, size in (("along", 1e-4), ("across", 3e-4)):
        rising = [size * (1.0 + 0.5 * i) for i in range(4)]
        band[part] = {
            "low": [-one for one in rising], "high": rising,
            "smallest": [-1.5 * one for one in rising], "largest": [1.5 * one for one in rising[:3]] + [None],
        }  # fmt: skip
    content["path_bands"] = {"P": band}
    (out / "monte_carlo.json").write_text(json.dumps(content), encoding="utf-8")
    page = open_page(write_folder(out))
    page.tab("Monte Carlo")
    assert page.run("return document.querySelector('#band-of').value") == "P across"
    assert "between the edges of the band are 95 % of them" in page.text("#bands")
    across = ends(page, "#bands polyline")
    assert len(across) == 3 and len(ends(page, "#bands polygon.band")) == 1
    page.choose("#band-of", "P along")
    # All numbers are a third, and so is the axis: curves stay, its numbers change.
    assert ends(page, "#bands polyline") == across and "0.2" in page.text("#bands svg")
    assert page.complaints() == []


def test_loads_in_a_given_motion_say_so(open_page, tmp_path):
    """The page of loads at rest has other words where the mechanism moves."""
    load = {"force": [[3.0, 0.0, 4.0]], "moment": [[0.0, 1.0, 0.0]]}
    case = {
        "status": "ok", "statuses": ["ok"], "position": {"A": [0.5]}, "holding": {"A": [2.5]}, "joints": {"A": load},
        "stress": {}, "metrics": {}, "energy": {},
    }  # fmt: skip
    content = {"title": "Loads", "held": {"A": "rad"}, "units": {"A": "N m"}, "cases": {"perfect": case}}
    words = {}
    for name, motion in (("rest", {}), ("moving", {"rate": {"A": [6.0]}, "acceleration": {"A": [0.0]}})):
        out = tmp_path / name
        out.mkdir()
        shown = {**content, "cases": {"perfect": {**case, **motion}}}
        (out / "statics.json").write_text(json.dumps(shown), encoding="utf-8")
        page = open_page(write_folder(out))
        words[name] = page.text("body")
        assert page.complaints() == []
    assert "What holds the mechanism" in words["rest"] and "Loads of the joints at rest" in words["rest"]
    assert (
        "What drives the mechanism" in words["moving"] and "Loads of the joints in the given motion" in words["moving"]
    )


def test_a_mechanism_in_x_and_y_is_seen_from_the_front_of_its_plane(open_page, folder, tmp_path):
    """Nearly as from above, with y upwards; others obliquely, as before."""
    pictures = {}
    for plane in ("xz", "xy"):
        out = shutil.copytree(folder, tmp_path / plane)
        with np.load(out / "animation.npz") as file:
            arrays = dict(file)
        description = json.loads(str(arrays["description"]))
        arrays["description"] = json.dumps(description | {"plane": plane})
        np.savez(out / "animation.npz", **arrays)
        page = open_page(write_folder(out))
        pictures[plane] = page.picture()
        page.click("[data-view=top]")
        assert page.picture() != pictures[plane]
        page.click("[data-view=oblique]")
        assert page.picture() == pictures[plane] and page.complaints() == []
    assert pictures["xy"] != pictures["xz"]
