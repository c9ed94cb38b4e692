"""Pictures of the pages of a `report.html`, for the documentation.

    python docs/take_pictures.py results/four_bar --pages overview turn modes --out docs/pictures

Writes report_PAGE.png for every page, as the browser shows it, each below 150 kB.  Needs Chromium, Selenium and Pillow:
`python -m pip install -e ".[plots,browser]"`; tests/browser says how to install the browser.
"""

import argparse
import io
import shutil
import sys
from pathlib import Path

from PIL import Image

LARGEST = 150_000  # bytes of a picture
WIDTH, MOST_HEIGHT = 1100, 1400  # pixels
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--hide-scrollbars")


def main() -> int:
    """Open the page, take a picture of every tab that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="with report.html")
    parser.add_argument("--pages", nargs="+", required=True, help="titles of pages, small, with _ for spaces")
    parser.add_argument("--time", type=float, default=0.12, help="of the animation, s")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    arguments = parser.parse_args()
    browser = open_browser()
    try:
        browser.get((arguments.folder / "report.html").resolve().as_uri())
        tabs = {tab.text.lower().replace(" ", "_"): tab for tab in browser.find_elements("css selector", "[role=tab]")}
        for name in arguments.pages:
            if name not in tabs:
                print(f"The report has no page `{name}`; it has {', '.join(tabs)}.", file=sys.stderr)
                return 2
            tabs[name].click()
            picture = picture_of(browser, arguments.time)
            path = arguments.out / f"report_{name}.png"
            path.write_bytes(picture)
            print(f"{path}: {len(picture) / 1000:.0f} kB")
    finally:
        browser.quit()
    return 0


def open_browser():
    """Chromium without a window, in light colours."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for option in (*OPTIONS, f"--window-size={WIDTH},{MOST_HEIGHT}"):
        options.add_argument(option)
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))


def picture_of(browser, time: float) -> bytes:
    """The page as it is, as a PNG of few colours."""
    move = (
        "const e = document.getElementById('time'); if (!e) return;"
        "e.value = arguments[0]; e.dispatchEvent(new Event('input'));"
    )
    browser.execute_script(move, time)
    browser.execute_script("return new Promise((done) => setTimeout(done, 300))")
    height = browser.execute_script("return document.documentElement.scrollHeight")
    browser.set_window_size(WIDTH, min(max(int(height), 400), MOST_HEIGHT))
    browser.execute_script("return new Promise((done) => setTimeout(done, 300))")
    image = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    for colours in (256, 128, 64, 32, 16):
        stream = io.BytesIO()
        image.quantize(colours, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
        if stream.tell() <= LARGEST:
            break
    return stream.getvalue()


if __name__ == "__main__":
    sys.exit(main())
