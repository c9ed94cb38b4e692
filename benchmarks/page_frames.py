"""How long the script of a page report.html works for one frame of its animation.

    python benchmarks/page_frames.py DIR [--seconds 4] [--width 1400] [--height 1000]

Opens DIR/report.html in Chromium without a window (of the system, driven by Selenium: see tests/browser/conftest.py),
with two cases side by side and two curves as at first, and with all cases over each other, and plays. Prints frames a
second, and by the browser's own counters the time of script and of all tasks for a frame, in ms.
"""

import argparse
import shutil
import sys
import time
from pathlib import Path

SETUPS = {
    "as opened": "",
    "all cases, joint frames": (
        "document.querySelectorAll('button.case[aria-pressed=false]').forEach((one) => one.click());"
        "document.querySelector('[data-value=over]').click(); document.getElementById('show-frames').click();"
    ),
}
COUNT = "window.frames_seen = 0; (function next() { window.frames_seen += 1; requestAnimationFrame(next); })();"


def open_browser(width: int, height: int):
    """Chromium without a window."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for one in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", f"--window-size={width},{height}"):
        options.add_argument(one)
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))


def counters(browser) -> dict[str, float]:
    """Times of the page since it was opened [s]."""
    found = browser.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
    return {one["name"]: one["value"] for one in found}


def measure(browser, path: Path, setup: str, seconds: float) -> tuple[float, float, float]:
    """Frames a second, script and all tasks for a frame [ms]."""
    browser.get(path.resolve().as_uri())
    browser.execute_cdp_cmd("Performance.enable", {})
    browser.execute_script(f"{setup} {COUNT} document.getElementById('play').click();")
    time.sleep(0.5)
    before, frames = counters(browser), browser.execute_script("return window.frames_seen")
    started = time.perf_counter()
    time.sleep(seconds)
    after, last = counters(browser), browser.execute_script("return window.frames_seen")
    count = max(last - frames, 1)
    spent = [1e3 * (after[name] - before[name]) / count for name in ("ScriptDuration", "TaskDuration")]
    return count / (time.perf_counter() - started), spent[0], spent[1]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", metavar="DIR", type=Path)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--width", type=int, default=1400)
    parser.add_argument("--height", type=int, default=1000)
    arguments = parser.parse_args()
    path = arguments.folder / "report.html"
    if not path.exists():
        print(f"{path} is missing; write it with `rfem-jax report {arguments.folder}`.")
        return 2
    browser = open_browser(arguments.width, arguments.height)
    try:
        print("| page | frames a second | script, ms a frame | all tasks, ms a frame |\n|---|---|---|---|")
        for name, setup in SETUPS.items():
            rate, script, tasks = measure(browser, path, setup, arguments.seconds)
            print(f"| {name} | {rate:.1f} | {script:.2f} | {tasks:.2f} |")
    finally:
        browser.quit()
    return 0


if __name__ == "__main__":
    sys.exit(main())
