"""Takes the pictures of `wasp view` for the docs, with the real pages in a real Chromium: `python docs/pictures/viewing.py`.

It needs Chromium on the path, the extra `web` and the packages for tests, and reads a copy of the published results; a minute.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
EPISODE = "/cell/goal1 s1 wasp noisy=0.45/episode/0"


def main() -> None:
    """Take the table of cells, a decision of an episode, and the same in a narrow dark window."""
    from tests.drive.browser import chromium
    from wasp_cli.view import site_of
    from wasp_cli.view.server import ViewServer

    with tempfile.TemporaryDirectory() as folder, chromium(Path(folder) / "chromium") as browser:
        os.chdir(folder)
        results = Path("published")
        shutil.copytree(ROOT / "results" / "published" / "store", results / "store")
        server = ViewServer(site_of(results))
        server.start()
        tab = browser.tab()
        tab.size(1280, 560)
        tab.open(server.opening("/cells?task=goal1&method=WASP"))
        tab.until("[...document.querySelectorAll('#cells tbody tr')].every(row => row.cells[6].textContent)")
        picture(tab, "cells")
        tab.open(server.opening(EPISODE))
        stops = tab.value("JSON.parse(document.querySelector('section.episode').dataset.stops)")
        step = stops[min(2, len(stops) - 1)]
        for name, width, height, dark in (("step", 1280, 1000, False), ("narrow", 500, 1000, True)):
            tab.size(width, height, dark=dark)
            tab.open(server.opening(f"{EPISODE}?step={step}"))
            tab.until(f"document.querySelector('.step').dataset.shown === '{step}'")
            tab.until("document.querySelector('.told').textContent === '' && document.querySelector('.screen img').naturalWidth > 0", 120)
            picture(tab, name)
        tab.close()
        server.stop()


def picture(tab, name: str) -> None:
    """Take `viewing_NAME.png`, with few colours."""
    path = Path(__file__).with_name(f"viewing_{name}.png")
    tab.picture(path)
    with Image.open(path) as image:
        image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
