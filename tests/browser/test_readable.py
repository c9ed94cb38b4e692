"""What a reader must be able to read: whole names, wide tables, what acts on the mechanism, and what is missing."""

import json
import shutil

import numpy as np
import pytest

from rfem_jax.report.page.animation import FILE
from rfem_jax.report.page.document import write_folder

from .test_results import table, task_tab


@pytest.fixture
def changed(folder, tmp_path, open_page):
    """A function that opens the page of a copy of the folder, which another function has changed."""

    def opened(change):
        copy = shutil.copytree(folder, tmp_path / "copy")
        change(copy)
        write_folder(copy)
        return open_page(copy / "report.html")

    return opened


def change_json(path, change):
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")


NAMES = {"A": "WM", "B": "MW", "D": "Left_ball_joint_of_the_upper_wishbone", "C": "UB"}


def test_names_of_joints_are_whole_or_end_in_dots(changed):
    def rename(folder):
        def renamed(content):
            for case in content["cases"].values():
                case["joints"] = {NAMES[name]: row for name, row in case["joints"].items()}

        change_json(folder / "results.json", renamed)

    page = changed(rename)
    boxes = page.run(
        "return [...document.querySelectorAll('#load-charts svg')].map((svg) => [...svg.querySelectorAll('text.name')]"
        ".map((one) => [one.firstChild.textContent, one.getBBox().x, one.getBBox().x + one.getBBox().width]))"
    )
    for chart in boxes:
        assert [name for name, _, _ in chart][:2] == ["WM", "MW"]
        assert chart[2][0].startswith("Left_ball") and chart[2][0].endswith("\u2026")
        for _, left, right in chart:
            assert left >= 0.0 and right < 200.0
    titles = page.run("return [...document.querySelectorAll('#load-charts text.name title')].map((e) => e.textContent)")
    assert titles == [NAMES["D"]] * 2


def test_the_maxima_stand_beside_the_rms_loads(page, results):
    page.click("#load-kind [data-value=max]")
    titles = page.run("return [...document.querySelectorAll('#load-charts .chart g title, #load-charts .chart title')]"
                      ".map((one) => one.textContent)")  # fmt: skip
    assert page.text("#load-charts figcaption") == "Maximum resultant moment, N m"
    largest = results["cases"]["P2"]["joints"]["C"]["max_force"]
    assert f"P2, joint C: {largest:g} N" in titles
    page.click("#load-kind [data-value=rms]")
    assert page.text("#load-charts figcaption") == "RMS resultant moment, N m"


def pixels(page, colour, near=12):
    """How many pixels of the mechanism have a colour, nearly."""
    return page.run(
        "const [colour, near] = arguments; const canvas = document.getElementById('mechanism');"
        "const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height); let count = 0;"
        "for (let i = 0; i < data.length; i += 4)"
        "  if (colour.every((one, k) => Math.abs(data[i + k] - one) < near)) count += 1;"
        "return count",
        colour,
        near,
    )


ACTING, P2 = (0x7A, 0x4F, 0x00), (0xC2, 0x4E, 0x00)


def test_springs_and_outer_forces_are_drawn_and_can_be_switched_off(page):
    page.click("#theme [data-value=light]")
    page.slide("#time", 0.0)
    springs = pixels(page, ACTING)
    page.slide("#time", 0.5)  # the force is largest
    everything = pixels(page, ACTING)
    page.click("#show-acting")
    assert pixels(page, ACTING) == 0
    assert springs > 300 and everything > springs + 50


def test_a_joint_off_the_axis_of_its_links_has_arms(changed, page):
    def moved(folder):
        with np.load(folder / FILE) as file:
            arrays = {name: file[name] for name in file.files}
        joints = [one["name"] for one in json.loads(str(arrays["description"]))["joints"]]
        for i in range(3):
            for part in ("nominal_centre", "centre"):
                arrays[f"{i}_{part}"][:, joints.index("D"), 0] -= 0.1  # from the foot of an upright link inwards
        np.savez(folder / FILE, **arrays)

    def links(page):
        page.click("#theme [data-value=light]")
        page.click("[data-case='0']")
        for switch in ("errors", "perfect", "forces", "moments", "acting"):
            page.click(f"#show-{switch}")
        return pixels(page, P2, near=90)

    before = links(page)
    assert links(changed(moved)) > before + 60


def test_files_of_older_versions_are_drawn_without_forces(changed):
    def older(folder):
        with np.load(folder / FILE) as file:
            arrays = {name: file[name] for name in file.files if "force" not in name and "path" not in name}
        description = json.loads(str(arrays["description"]))
        arrays["description"] = np.array(json.dumps({k: description[k] for k in ("cases", "links", "joints")}))
        np.savez(folder / FILE, **arrays)

    page = changed(older)
    assert page.all("#mechanism") and not page.all("#show-acting") and page.complaints() == []


def test_wide_and_long_tables_scroll_in_their_frame_and_keep_their_heads(changed):
    def enlarge(folder):
        def more(content):
            for case in content["cases"].values():
                case["joints"] |= {f"{name}{i}": row for name, row in case["joints"].items() for i in range(30)}

        change_json(folder / "results.json", more)

    page = changed(enlarge)
    page.tab("Tables")
    page.browser.set_window_size(700, 800)
    try:
        assert page.run("return document.documentElement.scrollWidth <= window.innerWidth")
        inside, height, window = page.run(
            "const e = document.querySelector('#loads-table .table');"
            "e.scrollTop = 600; e.scrollLeft = 200; return [e.scrollWidth > e.clientWidth, e.clientHeight, innerHeight]"
        )
        assert inside and height < 0.8 * window
        head, cell, frame = page.run(
            "const box = (one) => document.querySelector(one).getBoundingClientRect();"
            "return [box('#loads-table thead th').top, box('#loads-table tbody td').left, "
            "[box('#loads-table .table').top, box('#loads-table .table').left]]"
        )
        assert head == pytest.approx(frame[0], abs=1.0) and cell == pytest.approx(frame[1], abs=1.0)
    finally:
        page.browser.set_window_size(1400, 1000)


def test_what_errors_and_zones_contribute(changed, folder):
    found = json.loads((folder / "sensitivity.json").read_text(encoding="utf-8"))["metrics"]

    def zone(folder):
        change_json(folder / "sensitivity.json", lambda content: content.update(zone_names={"D.d_y": "D.position"}))

    page = changed(zone)
    task_tab(page, "Sensitivity")
    head, rows = table(page, "#contributions")
    shares = {name: one["variance_total_percent"] for name, one in found.items()}
    assert [cell.split(",")[0] for cell in head[1:]] == list(shares)
    assert [row[0] for row in rows] == ["D.delta_x", "D.delta_z", "D.position"]
    for row, factor in zip(rows, ("D.delta_x", "D.delta_z", "D.d_y"), strict=True):
        np.testing.assert_allclose(
            [float(cell) for cell in row[1:]], [one[factor] for one in shares.values()], rtol=6e-3
        )


def test_histograms_that_are_missing_are_said(changed):
    page = changed(lambda folder: (folder / "monte_carlo.csv").unlink())
    task_tab(page, "Monte Carlo")
    assert "no histogram: this folder has no monte_carlo.csv" in page.text("#no-samples")


def test_norms_are_called_what_they_are(changed):
    def with_note(folder):
        def noted(content):
            content["metric_notes"] = {"peak_force": "smooth 16-norm, which is not `max_force`"}
            content["units"]["metrics"] = {"A.peak_force": "N"}
            for case in content["cases"].values():
                case["metrics"] = {"A.peak_force": 3.0}

        change_json(folder / "results.json", noted)

    page = changed(with_note)
    page.tab("Tables")
    assert table(page, "#metrics-table")[1] == [["A.peak_force", "N", "3", "3", "3"]]
    assert page.text("#page-tables .metric-note") == "peak_force: smooth 16-norm, which is not max_force."
