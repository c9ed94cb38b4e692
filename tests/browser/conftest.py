"""The page in a real browser: Chromium of the system, without a window, driven by Selenium.

    apt-get install chromium chromium-driver && python -m pip install -e ".[test,browser]"
    python -m pytest -n0 tests/browser

Nothing is downloaded. Without a browser the tests are skipped, and say why; with RFEM_JAX_REQUIRE_BROWSER=1, as in CI,
they fail instead. `python -m pytest` without this folder's name leaves them out.
"""

import json
import os
import shutil
import time

import pytest

from rfem_jax import load_study
from rfem_jax.report.page.document import write_folder
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.catalogue import report_on
from tests.report import closed_form
from tests.report.conftest import STUDY, synthetic_run
from tests.report.page_folder import write_results
from tests.report.test_tasks import TASKS

GLOBAL_VIEWS = """
[sweep]
metrics = ["D.mean_square_moment", "A.mean_square_force"]
bounds = { "D.delta_x" = ["-0.25 deg", "0.25 deg"], "D.delta_z" = ["-0.25 deg", "0.25 deg"] }
levels = 3
at = { "D.d_y" = "0.1 mm" }
[reliability]
limits = { "D.mean_square_moment" = 14.0 }
n = 500
starts = 4
"""

INSTALL = 'apt-get install chromium chromium-driver, and python -m pip install -e ".[test,browser]"'
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--window-size=1400,1000")


def pytest_collection_modifyitems(items):
    for item in items:
        if "tests/browser" in item.path.as_posix():
            item.add_marker("browser")


def missing() -> str:
    """What is missing for a browser, or ""."""
    found = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    try:
        import selenium  # noqa: F401
    except ImportError:
        found.append("Selenium")
    return ", ".join(found)


@pytest.fixture(scope="session")
def chromium():
    """A browser; its windows are of the tests."""
    if found := missing():
        message = f"no {found}: {INSTALL}"
        if os.environ.get("RFEM_JAX_REQUIRE_BROWSER") == "1":
            pytest.fail(message)
        pytest.skip(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for option in OPTIONS:
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    yield browser
    browser.quit()


class Page:
    """A page that is open, and what tests ask of it."""

    def __init__(self, browser, path):
        self.browser = browser
        browser.get_log("browser")
        browser.get(path.as_uri())
        self.wait("return document.documentElement.dataset.ready === 'yes'")

    def run(self, script, *arguments):
        return self.browser.execute_script(script, *arguments)

    def wait(self, script, *arguments, seconds=10.0):
        """Wait until a script returns something true, and return that."""
        end = time.monotonic() + seconds
        while not (found := self.run(script, *arguments)):
            assert time.monotonic() < end, f"never true: {script}"
            time.sleep(0.03)
        return found

    def find(self, selector):
        return self.browser.find_element("css selector", selector)

    def all(self, selector):
        return self.browser.find_elements("css selector", selector)

    def text(self, selector):
        return self.run("return document.querySelector(arguments[0]).textContent", selector)

    def click(self, selector):
        element = self.find(selector)
        self.run("arguments[0].scrollIntoView({block: 'center'})", element)
        element.click()
        self.let_draw()

    def tab(self, title):
        next(tab for tab in self.all("[role=tab]") if tab.text == title).click()
        self.let_draw()

    def let_draw(self):
        """Let the browser draw: a canvas that appears or changes its size is drawn at the end of a frame.

        A script may run before that, and would see pixels which nobody sees; the second frame begins after it.
        """
        script = "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()))"
        self.browser.execute_async_script(script)

    def slide(self, selector, value):
        """Move a slider as a hand does, to a value."""
        self._set(selector, value, "input")

    def choose(self, selector, value):
        self._set(selector, value, "change")

    def _set(self, selector, value, event):
        script = "const [s, value, name] = arguments; const e = document.querySelector(s); e.value = value;"
        self.run(script + "e.dispatchEvent(new Event(name))", selector, value, event)

    def picture(self, selector="#mechanism"):
        """The pixels of a canvas as text."""
        return self.run("return document.querySelector(arguments[0]).toDataURL()", selector)

    def drag(self, selector, start, end):
        """Drag from one place to another, in shares of the element's width and height."""
        from selenium.webdriver.common.action_chains import ActionChains

        element = self.find(selector)
        self.run("arguments[0].scrollIntoView({block: 'center'})", element)
        width, height = element.size["width"], element.size["height"]

        def at(place):
            return round((place[0] - 0.5) * width), round((place[1] - 0.5) * height)

        chain = (
            ActionChains(self.browser, duration=30).move_to_element_with_offset(element, *at(start)).click_and_hold()
        )
        chain.move_to_element_with_offset(element, *at(end)).release().perform()
        self.let_draw()

    def complaints(self):
        """What the console says, but of what other tests have asked for."""
        return [entry["message"] for entry in self.browser.get_log("browser")]


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "study.toml"
    path.write_text(STUDY + TASKS + GLOBAL_VIEWS, encoding="utf-8")
    return load_study(path)


@pytest.fixture(scope="session")
def folder(study, tmp_path_factory):
    """Results of a study with all kinds of tasks, by closed forms."""
    runs = {"P1": synthetic_run(0.0), "P2": synthetic_run(2.0), "P3": synthetic_run(1.0)}
    folder = write_results(tmp_path_factory.mktemp("results"), study, runs)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_problem, "build_problem", closed_form.build_problem)
        for name in study.tasks.declared:
            report = report_on(study, name)
            report.write(folder, report.run(folder))
    write_folder(folder)
    return folder


@pytest.fixture(scope="session")
def results(folder):
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


@pytest.fixture
def page(chromium, folder):
    return Page(chromium, folder / "report.html")


@pytest.fixture
def open_page(chromium):
    """A function that opens another page."""
    return lambda path: Page(chromium, path)
