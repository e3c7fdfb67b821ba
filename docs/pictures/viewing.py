"""Takes the pictures of `wasp view` for the docs, with the real pages in a real Chromium: `python
docs/pictures/viewing.py`.

It needs Chromium on the path, the extra `web` and the packages for tests, and reads published
results; a minute.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
METHODS = "[human, ida, ida-guarded, diffusion, csa, saferl, wasp, expert]"
SPEC = f"extends: table1\nname: goal1\ntasks: [goal1]\nseeds: [1]\nmethods: {METHODS}\n"
EPISODE = "/cell/goal1 s1 wasp noisy=0.45/episode/0"


def main() -> None:
    """Take the first page and a decision of an episode, of published cells."""
    from tests.commands import run_here
    from tests.drive.browser import chromium
    from wasp_cli.view.server import ViewServer
    from wasp_cli.view.site import site_of

    with tempfile.TemporaryDirectory() as folder, chromium(Path(folder) / "chromium") as browser:
        os.chdir(folder)
        Path("goal1.yaml").write_text(SPEC, encoding="utf-8")
        results = Path("results")
        assert run_here("run", "goal1.yaml", "--results", results, columns=120).exit_code == 0
        server = ViewServer(site_of(results))
        server.start()
        tab = browser.tab()
        tab.size(1280, 640)
        tab.open(server.opening())
        picture(tab, "home")
        tab.open(server.opening(EPISODE))
        stops = tab.value("JSON.parse(document.querySelector('section.episode').dataset.stops)")
        step = stops[min(2, len(stops) - 1)]
        tab.size(1280, 1000)
        tab.open(server.opening(f"{EPISODE}?step={step}"))
        tab.until(f"document.querySelector('.step').dataset.shown === '{step}'")
        tab.until(
            "document.querySelector('.told').textContent === '' && "
            "document.querySelector('.screen img').naturalWidth > 0",
            120,
        )
        picture(tab, "step")
        tab.close()
        server.stop()


def picture(tab, name: str) -> None:
    """Take `viewing_NAME.png`, with few colours."""
    path = Path(__file__).with_name(f"viewing_{name}.png")
    tab.picture(path)
    with Image.open(path) as image:
        image.convert("RGB").quantize(
            256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        ).save(path, optimize=True)


if __name__ == "__main__":
    main()
