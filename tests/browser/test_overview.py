"""The first page in a browser: it opens without a complaint, and every control does what it says."""

import pytest

from rfem_jax.report.page.histories import read_table


def test_it_opens_without_a_complaint_and_asks_for_nothing(page):
    assert [tab.text for tab in page.all("[role=tab]")] == [
        "Overview", "Tables", "Sensitivity", "Monte Carlo", "Worst case", "Allocation", "Sweep", "Reliability",
        "Checks",
    ]  # fmt: skip
    assert page.text("h1") == "Test four-bar"
    for tab in page.all("[role=tab]"):
        tab.click()
        assert page.run("return document.querySelectorAll('main > .page:not(.hidden)').length") == 1
    assert page.complaints() == []
    assert page.run("return performance.getEntriesByType('resource').length") == 0


def test_it_opens_where_loads_are_largest_with_the_case_that_errors_load_most(page):
    words = page.text(".headline")
    # RMS moments are 0.1 * (number of the joint) * size, forces ten times that; P2 has size 2.
    assert "RMS moment in joint C: 0 N m in P1, 0.8 N m in P2" in words
    assert "RMS force in joint C: 0 N in P1, 8 N in P2" in words
    pressed = [e.text for e in page.all("button.case[aria-pressed=true]")]
    assert pressed == ["P1", "P2"]


def test_play_and_pause(page):
    page.click("#play")
    assert page.text("#play") == "Pause"
    before = page.text("#time-text")
    page.wait("return document.getElementById('time-text').textContent !== arguments[0]", before)
    page.click("#play")
    stopped, picture = page.text("#time-text"), page.picture()
    page.run("return new Promise((done) => setTimeout(done, 120))")
    assert (page.text("#time-text"), page.picture(), page.text("#play")) == (stopped, picture, "Play")


def test_speed_is_that_of_the_list(page):
    """In a slower run less time passes while the clock of the wall goes on."""
    passed = {}
    for speed in ("0.2", "0.02"):
        page.choose("#speed", speed)
        page.slide("#time", 0.0)
        page.run("window.started = performance.now()")
        page.click("#play")
        page.run("return new Promise((done) => setTimeout(done, 400))")
        page.click("#play")
        time, wall = (
            float(page.text("#time-text").split()[0]),
            page.run("return (performance.now() - window.started) / 1000"),
        )
        assert 0.2 * wall < time / float(speed) < 1.05 * wall
        passed[speed] = time
    assert passed["0.2"] > 3.0 * passed["0.02"]


def test_a_drag_of_the_time_moves_mechanism_curves_and_numbers(page, folder):
    page.slide("#time", 0.0)
    start = page.picture()
    page.slide("#time", 0.3)
    assert page.text("#time-text") == "0.3000 s" and page.picture() != start
    table = read_table(folder / "P2.csv")
    size = sum(table[f"C_moment_{axis}_Nm"][6] ** 2 for axis in "xyz") ** 0.5
    entries = page.run("return [...document.querySelectorAll('.history')][0].querySelector('.legend').textContent")
    assert f"P2{size:.4g} N m" in entries
    cursor, width = page.run(
        "const e = document.querySelector('.time-cursor');"
        "return [new DOMMatrix(getComputedStyle(e).transform).e, e.parentElement.clientWidth]"
    )
    assert cursor == pytest.approx(0.6 * width, abs=1.5)


def test_a_drag_on_a_curve_moves_the_time_of_the_animation(page):
    before = page.picture()
    page.drag(".u-over", (0.2, 0.5), (0.8, 0.5))
    assert float(page.text("#time-text").split()[0]) == pytest.approx(0.4, abs=0.01)
    assert page.picture() != before
    assert page.run("return Number(document.getElementById('time').value)") == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize(
    "selector",
    ["#show-forces", "#show-moments", "#show-acting", "#show-errors", "#show-frames", "#show-perfect",
     "#perspective", "button.joint", "[data-case='2']", "[data-value=over]", "[data-view=front]", "[data-view=side]",
     "[data-view=top]"],
)  # fmt: skip
def test_switches_of_the_scene_change_it_and_change_it_back(page, selector):
    before = page.picture()
    page.click(selector)
    changed = page.picture()
    assert changed != before
    back = "[data-value=beside]" if "over" in selector else "#reset-view" if "view" in selector else selector
    page.click(back)
    assert page.picture() == before


def test_exaggeration(page):
    assert page.text("#exaggeration-text").endswith("times")
    before = page.picture()
    page.slide("#exaggeration", 0.0)
    assert page.text("#exaggeration-text") == "1 times"
    flat = page.picture()
    assert flat != before
    page.slide("#exaggeration", 2.302585093)
    assert page.text("#exaggeration-text") == "10 times" and page.picture() not in (flat, before)


def test_size_of_arrows(page):
    before = page.picture()
    page.slide("#arrow-size", 2.0)
    assert page.picture() != before


def test_view_turns_by_drag_and_keys_and_zooms_by_wheel(page):
    pictures = [page.picture()]
    page.drag("#mechanism", (0.4, 0.5), (0.6, 0.6))
    pictures.append(page.picture())
    page.run(
        "document.getElementById('mechanism').dispatchEvent(new WheelEvent('wheel', {deltaY: -300, cancelable: true}))"
    )
    pictures.append(page.picture())
    for key in ("ArrowLeft", "ArrowUp", "+", "-"):
        page.run(
            "const e = document.getElementById('mechanism'); e.focus();"
            "e.dispatchEvent(new KeyboardEvent('keydown', {key: arguments[0], bubbles: true}))",
            key,
        )
        pictures.append(page.picture())
    assert len(set(pictures[:-1])) == len(pictures) - 1
    page.click("#reset-view")
    assert page.picture() == pictures[0]


def press(page, key):
    page.run("document.body.dispatchEvent(new KeyboardEvent('keydown', {key: arguments[0], bubbles: true}))", key)


def test_keys_of_the_page(page):
    press(page, "Home")
    assert page.text("#time-text") == "0.0000 s"
    press(page, ".")
    assert page.text("#time-text") == "0.0500 s"  # one of ten intervals
    press(page, ".")
    press(page, ",")
    assert page.text("#time-text") == "0.0500 s"
    press(page, "End")
    assert page.text("#time-text") == "0.5000 s"
    press(page, " ")
    assert page.text("#play") == "Pause"
    press(page, " ")
    assert page.text("#play") == "Play"


def test_tabs_by_keys(page):
    page.run("document.getElementById('tab-overview').focus()")
    page.run("document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}))")
    assert page.run("return document.activeElement.id") == "tab-tables"
    assert page.find("#tab-tables").get_attribute("aria-selected") == "true"


def test_curves_of_any_quantity_and_component(page, folder):
    table = {case: read_table(folder / f"{case}.csv") for case in ("P1", "P2")}
    page.slide("#time", 0.25)
    script = "return [...document.querySelectorAll('.quantity')[0].options].map((one) => one.textContent)"
    offered = page.run(script)
    for label in ("Force in A", "Moment in D", "Angle", "Rate", "Kinetic energy", "Drive moment", "B angle"):
        assert label in offered
    page.choose(".quantity", str(offered.index("Force in D")))
    page.run("document.querySelector('.history [data-value=\"1\"]').click()")  # y
    legend = page.text(".history .legend")
    assert f"P1{table['P1']['D_force_y_N'][5]:.4g} N" in legend and f"P2{table['P2']['D_force_y_N'][5]:.4g} N" in legend
    page.run("document.querySelector('.difference').click()")
    difference = table["P2"]["D_force_y_N"][5] - table["P1"]["D_force_y_N"][5]
    assert f"P2{difference:.4g} N" in page.text(".history .legend")
    assert "P10 N" in page.text(".history .legend")


def test_curves_are_added_and_removed_and_follow_the_cases(page):
    assert len(page.all(".history")) == 2
    page.click("#add-curve")
    assert len(page.all(".history")) == 3
    page.click(".history:last-child .remove")
    assert len(page.all(".history")) == 2
    page.click("[data-case='2']")
    assert "P3" in page.text(".history .legend")
    page.click("[data-case='2']")
    assert "P3" not in page.text(".history .legend")


def test_light_and_dark(page):
    ground = "return getComputedStyle(document.documentElement).backgroundColor"
    page.click("#theme [data-value=light]")
    light, picture = page.run(ground), page.picture()
    page.click("#theme [data-value=dark]")
    assert page.run(ground) != light and page.picture() != picture
    page.click("#theme [data-value=light]")
    assert (page.run(ground), page.picture()) == (light, picture)


def test_charts_have_the_numbers_of_the_results(page, results):
    titles = page.run("return [...document.querySelectorAll('#page-overview svg title')].map((one) => one.textContent)")
    for case, found in results["cases"].items():
        for joint, row in found["joints"].items():
            for value, unit in ((row["rms_force"], "N"), (row["rms_moment"], "N m")):
                assert f"{case}, joint {joint}: {float(f'{value:.4g}'):g} {unit}" in titles


def test_print_has_all_pages_on_white(page):
    page.click("#theme [data-value=dark]")
    page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        shown = page.run(
            "return [...document.querySelectorAll('main > .page')].map((one) => getComputedStyle(one).display)"
        )
        assert set(shown) == {"block"} and len(shown) == 9
        assert page.run("return getComputedStyle(document.querySelector('.player')).display") == "none"
        page.run("window.dispatchEvent(new Event('beforeprint'))")
        assert page.run("return document.documentElement.dataset.theme") == "light"
        page.run("window.dispatchEvent(new Event('afterprint'))")
        assert page.run("return document.documentElement.dataset.theme") == "dark"
    finally:
        page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_a_phone_scrolls_in_one_direction(page):
    size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    page.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        for tab in page.all("[role=tab]"):
            page.run("arguments[0].click()", tab)
            wide = page.run("return document.documentElement.scrollWidth")
            assert wide <= 390, tab.text
    finally:
        page.browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_controls_have_names(page):
    script = """
    return [...document.querySelectorAll('button, input, select, canvas, svg[role]')].filter((one) =>
      !(one.textContent.trim() || one.getAttribute('aria-label') || one.closest('label, [role=img][aria-label]')))
      .map((one) => one.outerHTML)"""
    assert page.run(script) == []
    names = page.run("return [...document.querySelectorAll('[id]')].map((one) => one.id)")
    assert len(set(names)) == len(names)
