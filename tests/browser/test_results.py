"""Tables, tasks and checks in a browser: their numbers are those of the files."""

import csv
import json
import shutil

import numpy as np
import pytest

from rfem_jax.report.page.document import write_folder


def shown_number(value):
    """A number as the page writes it."""
    return f"{float(f'{value:.4g}'):g}"


def table(page, selector):
    """Head and rows of a table as texts."""
    rows = page.run(
        "return [...document.querySelectorAll(arguments[0] + ' tr')]"
        ".map((row) => [...row.cells].map((one) => one.textContent))",
        selector,
    )
    return rows[0], rows[1:]


def test_the_table_of_loads_is_that_of_the_results(page, results):
    head, rows = table(page, "#loads-table")
    assert head == [
        "case", "joint", "kind", "Preload force, N", "Preload moment, N m", "RMS resultant force, N",
        "RMS resultant moment, N m", "Maximum resultant force, N", "Maximum resultant moment, N m",
        "Maximum axial force, N", "Maximum normal force, N",
    ]  # fmt: skip
    assert len(rows) == 12
    for row in rows:
        found = results["cases"][row[0]]["joints"][row[1]]
        names = ("rms_force", "rms_moment", "max_force", "max_moment", "max_axial_force", "max_normal_force")
        wanted = [np.linalg.norm(found[key]) for key in ("preload_force", "preload_moment")]
        wanted += [found[key] for key in names]
        assert row[2] == found["kind"]
        np.testing.assert_allclose([float(cell) for cell in row[3:]], wanted, rtol=1e-4)


def test_tables_sort_up_and_down(page):
    page.tab("Tables")

    def column(at):
        return [row[at] for row in table(page, "#loads-table")[1]]

    page.run("document.querySelectorAll('#loads-table th button')[3].click()")
    down = [float(cell) for cell in column(3)]
    assert down == sorted(down, reverse=True) and down[0] > down[-1]
    page.run("document.querySelectorAll('#loads-table th button')[3].click()")
    assert [float(cell) for cell in column(3)] == down[::-1]
    page.run("document.querySelectorAll('#loads-table th button')[1].click()")
    assert column(1) == sorted(column(1))
    assert page.run("return document.querySelectorAll('#loads-table th[aria-sort=ascending]').length") == 1


def test_tables_are_copied_with_tabs_and_full_digits(page, results):
    page.tab("Tables")
    page.run("navigator.clipboard.writeText = (text) => { window.copied = text; return Promise.resolve(); }")
    page.click("#loads-table .copy")
    lines = [line.split("\t") for line in page.wait("return window.copied").split("\n")]
    assert lines[0][5] == "RMS resultant force, N" and len(lines) == 13
    for line in lines[1:]:
        assert float(line[5]) == results["cases"][line[0]]["joints"][line[1]]["rms_force"]


def test_checks(page, results):
    head, rows = table(page, "#balances")
    assert head[:4] == ["case", "status", "what it means", "Energy balance"]
    for row in rows:
        found = results["cases"][row[0]]
        assert row[1] == "ok" and row[2] == found["message"]
        assert float(row[3]) == pytest.approx(found["energy_balance_error"], rel=1e-2)
        assert float(row[6]) == pytest.approx(found["momentum_balance_error"], rel=1e-2)
    text = page.text("#page-checks")
    assert results["versions"]["jax"] in text and "rk4" in text


def test_numbers_of_a_case_that_failed_carry_a_mark(open_page, folder, tmp_path):
    out = tmp_path / "failed"
    shutil.copytree(folder, out)
    content = json.loads((out / "results.json").read_text(encoding="utf-8"))
    content["cases"]["P2"]["status"] = "diverged"
    (out / "results.json").write_text(json.dumps(content), encoding="utf-8")
    page = open_page(write_folder(out))
    assert not [
        text
        for text in page.run("return [...document.querySelectorAll('.finding')].map((e) => e.textContent)")
        if "P2" in text
    ]
    for selector in ("ul.cases strong", "button.case"):
        names = page.run("return [...document.querySelectorAll(arguments[0])].map((e) => e.textContent)", selector)
        assert "P2*" in names and "P2" not in names
    page.tab("Tables")
    _, rows = table(page, "#loads-table")
    assert {row[0] for row in rows} == {"P1", "P2*", "P3"}
    assert page.text("#page-tables .failed") == "* P2: diverged."


def task_tab(page, title):
    page.tab(title)
    return "main > .page:not(.hidden)"


def test_heat_map_and_tornado(page, folder):
    found = json.loads((folder / "sensitivity.json").read_text(encoding="utf-8"))
    shown = task_tab(page, "Sensitivity")
    one = found["metrics"]["D.mean_square_moment"]
    # People think in N m: the change of the root of a mean square that vanishes without errors.
    assert one["character"] == "kink"
    effects = {error: np.sqrt(effect) for error, effect in one["effects"].items()}
    head, rows = table(page, f"{shown} .heat:first-of-type")
    assert [cell.split()[0] for cell in head[1:]] == found["errors"] and "+-0.25 deg" in head[1]
    row = next(row for row in rows if row[0] == "D")
    np.testing.assert_allclose(
        [float(cell) for cell in row[1:]], [effects[e] for e in found["errors"]], rtol=5e-3, atol=1e-6
    )
    shares = page.run(
        "return [...document.querySelectorAll(arguments[0] + ' .heat td.number')]"
        ".map((one) => one.style.getPropertyValue('--share'))",
        shown,
    )
    assert "100%" in shares
    page.choose("#tornado-metric", "A.mean_square_force")
    bars = page.run("return [...document.querySelectorAll('#tornado rect title')].map((one) => one.textContent)")
    # 900 + 30 z0 + 5 z1^2, an RMS force of 30 N: changes of its square by +-30, and by 5 at both ends.
    for error, end, change in (("delta_x", "lower", -30.0), ("delta_x", "upper", 30.0), ("delta_z", "lower", 5.0)):
        assert f"D.{error}, {end} end of the tolerance: {shown_number(np.sqrt(900 + change) - 30)} N" in bars
    captions = page.run(
        "return [...document.querySelectorAll(arguments[0] + ' caption')].map((e) => e.textContent)", shown
    )
    assert captions[0] == "Change of rms moment, N m"


def samples(folder):
    with open(folder / "monte_carlo.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_samples_are_picked_in_the_scatter_plot_and_their_errors_listed(page, folder):
    rows = samples(folder)
    task_tab(page, "Monte Carlo")
    before = page.picture("#scatter"), page.picture("#histogram")
    page.drag("#scatter", (0.02, 0.02), (0.98, 0.95))
    head, picked = table(page, "#picked")
    assert len(picked) == len(rows) == 32
    assert head[:4] == ["sample", "D.delta_x, deg", "D.delta_z, deg", "D.d_y, mm"]
    for row in picked:
        sample = rows[int(row[0])]
        errors = [np.degrees(float(sample[f"D.delta_{axis}_rad"])) for axis in "xz"] + [1e3 * float(sample["D.d_y_m"])]
        np.testing.assert_allclose([float(cell) for cell in row[1:4]], errors, rtol=1e-4)
    assert page.picture("#scatter") != before[0] and page.picture("#histogram") != before[1]
    page.click("#let-go")
    assert (page.picture("#scatter"), page.picture("#histogram")) == before and not page.all("#picked table")


def test_a_part_of_the_scatter_plot_and_of_a_histogram(page, folder):
    rows = samples(folder)
    task_tab(page, "Monte Carlo")
    page.choose("#scatter-x", "0")
    page.drag("#scatter", (0.02, 0.02), (0.5, 0.95))
    picked = {int(row[0]) for row in table(page, "#picked")[1]}
    delta = np.array([float(row["D.delta_x_rad"]) for row in rows])
    assert 0 < len(picked) < 32
    assert delta[list(picked)].max() < delta[[i for i in range(32) if i not in picked]].min()
    page.run("document.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
    assert not page.all("#picked table")
    page.choose("#histogram-of", "2")
    page.drag("#histogram", (0.5, 0.3), (0.99, 0.5))
    picked = {int(row[0]) for row in table(page, "#picked")[1]}
    shift = np.array([float(row["D.d_y_m"]) for row in rows])
    assert 0 < len(picked) < 32
    assert shift[list(picked)].min() > shift[[i for i in range(32) if i not in picked]].max()


def test_statistics_and_yield_are_those_of_the_file(page, folder):
    found = json.loads((folder / "monte_carlo.json").read_text(encoding="utf-8"))
    task_tab(page, "Monte Carlo")
    rows = {row[0]: row for row in table(page, "#statistics")[1]}
    for name, one in found["metrics"].items():
        assert rows[name][2].startswith(f"{one['mean']['value']:.4g}")
    share = 100.0 * found["metrics"]["D.mean_square_moment"]["yield_of_all"]["value"]
    words = page.text("#yield").split("In the end ")[1].split()
    assert float(words[0]) == pytest.approx(share, rel=1e-3) and words[1:5] == ["%,", "by", "32", "samples;"]


def test_worst_cases(page, folder):
    found = json.loads((folder / "worst_case.json").read_text(encoding="utf-8"))["metrics"]
    shown = task_tab(page, "Worst case")
    rows = {row[0]: row for row in table(page, shown)[1]}
    assert set(rows) == set(found)
    for name, one in found.items():
        assert float(rows[name][3]) == pytest.approx(one["value"], rel=1e-4)
        assert f"{np.degrees(one['errors']['D.delta_x']):.4g} deg" in rows[name]
    points = page.run("return document.querySelectorAll(arguments[0] + ' .chart .case-2').length", shown)
    assert points == sum(len(one["corners"]["values"]) for one in found.values())


def test_allocation_and_cost_against_the_limit(page, folder):
    found = json.loads((folder / "allocation.json").read_text(encoding="utf-8"))
    shown = task_tab(page, "Allocation")
    assert f"Cost {found['cost']:.4g}" in page.text(shown)
    rows = {row[0]: row for row in table(page, "#tolerances")[1]}
    for name, value in found["tolerances"].items():
        unit, factor = ("mm", 1e3) if name.endswith("d_y") else ("deg", np.degrees(1.0))
        assert rows[name][2] == f"{shown_number(factor * value)} {unit}"
    titles = page.run(
        "return [...document.querySelectorAll(arguments[0] + ' .chart title')].map((one) => one.textContent)", shown
    )
    for one in found["front"]:
        assert f"cost: {shown_number(one['cost'])} at {shown_number(one['limits'][0]['limit'])}" in titles


def titles_in(page, selector):
    return page.run(
        "return [...document.querySelectorAll(arguments[0] + ' title')].map((one) => one.textContent)", selector
    )


def test_a_sweep_over_each_quantity_and_over_two(page, folder):
    with open(folder / "sweep.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    task_tab(page, "Sweep")
    page.choose("#sweep-metric", "1")
    force = np.array([float(row["A.mean_square_force_N2"]) for row in rows])
    tilts = np.degrees([[float(row[f"D.delta_{axis}_rad"]) for row in rows] for axis in "xz"])
    charts = [set(titles_in(page, f"#sweep-responses figure:nth-child({k})")) for k in (1, 2)]
    for chart, tilt, axis in zip(charts, tilts, "xz", strict=True):
        points = {
            f"A.mean_square_force: {shown_number(y)} at {shown_number(x)}" for x, y in zip(tilt, force, strict=True)
        }
        assert chart == points | {f"A.mean_square_force over D.delta_{axis}, deg"}
    cells = titles_in(page, "#sweep-map .cell")
    wanted = [
        f"{shown_number(z)} N^2 at {shown_number(x)}, {shown_number(y)}" for x, y, z in zip(*tilts, force, strict=True)
    ]
    assert sorted(cells) == sorted(wanted) and len(cells) == 9
    before = titles_in(page, "#sweep-map")
    page.choose("#sweep-x", "1")
    page.choose("#sweep-y", "0")
    assert titles_in(page, "#sweep-map") != before
    # The curve of the quadratic surface goes through the points, whose law is quadratic: 900 + 30 z0 + 5 z1^2.
    surface = {row[0]: row for row in table(page, "#surface")[1]}
    assert surface["A.mean_square_force"][1:4] == ["N^2", "900", "100"]


def test_probabilities_that_limits_are_broken(page, folder):
    found = json.loads((folder / "reliability.json").read_text(encoding="utf-8"))
    shown = task_tab(page, "Reliability")
    estimate = found["any_limit"]
    assert f"probability of {estimate['value']:.4g} (" in page.text(shown)
    head, rows = table(page, "#failures")
    (one,) = found["limits"]
    assert rows[0][:3] == ["D.mean_square_moment", "(N m)^2", "upper"]
    assert rows[0][head.index("broken with probability")].startswith(f"{one['probability']['value']:.4g} (")
    assert float(rows[0][head.index("reliability index")]) == pytest.approx(one["beta"], rel=1e-4)
    names = list(one["shares"])
    np.testing.assert_allclose(
        [float(cell) for cell in table(page, "#shares")[1][0][1:]], [100 * one["shares"][n] for n in names],
        rtol=6e-3, atol=0.05,  # shares are shown to a tenth of a per cent
    )  # fmt: skip
    errors = table(page, "#failing-errors")[1][0]
    assert errors[0] == "D.mean_square_moment \u2264 14 (N m)^2"
    assert f"{shown_number(np.degrees(one['errors']['D.delta_x']))} deg" in errors
