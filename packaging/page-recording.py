"""Screenshots of the demo's live page, from before the edge is killed until after it is back, as one animated WebP."""

import io
import queue
import subprocess
import sys
import threading
import time

from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

PICTURE_PERIOD_S = 0.3
BEFORE_S = 4.0
AFTER_S = 8.0
WINDOW_PX = (1180, 900)


def started_demo(programs, directory):
    """Runs the street; returns the process and a queue of the lines that it prints."""
    command = [f"{programs}/ecod-lab", "demo", "--scene", "street", "--seconds", "24", "--output", directory]
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    lines = queue.Queue()
    threading.Thread(target=lambda: [lines.put(line) for line in demo.stdout], daemon=True).start()
    return demo, lines


def line_with(lines, text):
    """Waits for a printed line that has `text` in it."""
    while text not in (line := lines.get(timeout=60)):
        pass
    return line


def chromium():
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars"):
        options.add_argument(argument)
    options.add_argument("--window-size={},{}".format(*WINDOW_PX))
    return webdriver.Chrome(options=options, service=Service("/usr/bin/chromedriver"))


def pictures(browser, lines):
    """Screenshots with their times; ends some seconds after the edge was killed."""
    shots, killed_at = [], None
    while killed_at is None or time.monotonic() < killed_at + AFTER_S:
        began = time.monotonic()
        shots.append((began, browser.get_screenshot_as_png()))
        while not lines.empty():
            if "the edge is killed" in lines.get():
                killed_at = time.monotonic()
        time.sleep(max(0.0, began + PICTURE_PERIOD_S - time.monotonic()))
    return [(at, Image.open(io.BytesIO(png)).convert("RGB")) for at, png in shots if at > killed_at - BEFORE_S]


def main(programs, directory, out):
    demo, lines = started_demo(programs, directory)
    try:
        url = line_with(lines, "watch it at").split()[-1]
        line_with(lines, " reports")
        browser = chromium()
        try:
            browser.get(url)
            shots = pictures(browser, lines)
        finally:
            browser.quit()
    finally:
        demo.terminate()
        demo.wait()
    times = [at for at, _ in shots]
    durations = [round(1000 * (later - at)) for at, later in zip(times, times[1:])] + [1500]
    images = [image for _, image in shots]
    images[0].save(out, save_all=True, append_images=images[1:], duration=durations, loop=0, quality=60, method=4)
    print(f"{len(images)} pictures in {out}")


if __name__ == "__main__":
    main(*sys.argv[1:])
