"""Takes the pictures of `wasp drive` for the docs, with the real page in a real Chromium: `python
docs/pictures/driving.py`.

It needs Chromium on the path, the extra `drive`, and the published models; a few minutes.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))


def main() -> None:
    """Drive a practice episode and one condition of the study, and a free drive with everything
    shown.
    """
    from tests.drive.browser import chromium

    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results"
        with chromium(Path(folder)) as browser:
            for take in (drive, study):
                take(browser, results)
    for path in Path(__file__).parent.glob("driving_*.png"):
        with Image.open(path) as image:
            # Thin lines keep their colours: few pixels have them, so that the most frequent colours
            # would leave them out.
            image.convert("RGB").quantize(
                256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
            ).save(path, optimize=True)


def served(
    what: str, results: Path, participant: int, method: str | None, episodes: int, speed: float
):
    """Prepare a session and serve it; returns server and clock."""
    from wasp_cli.drive.command import Wanted
    from wasp_cli.drive.desk import Desk
    from wasp_cli.drive.server import Server

    session = Wanted(
        what, method, participant, episodes, None, speed, (), None, (), results, 1
    ).prepared()
    desk = Desk()
    server = Server(desk)
    server.start()
    clock = threading.Thread(target=session.run, args=(desk,), daemon=True)
    clock.start()
    return server, clock


def picture(tab, name: str) -> None:
    """Take `driving_NAME.png`."""
    tab.picture(Path(__file__).with_name(f"driving_{name}.png"))


def drive(browser, results: Path) -> None:
    """Both views with everything shown, each alone, and the replay."""
    server, clock = served("goal1", results, 0, "wasp", 1, 1.0)
    tab = browser.tab()
    tab.size(1280, 640)
    tab.open(server.address)
    tab.until("phase === 'ready'")
    tab.click("Go")
    tab.until("phase === 'driving' && frame")
    tab.key(True, "ArrowUp")
    tab.until("frame.header.corrected && lines && lines.corrected && frame.header.t > 20", 60)
    picture(tab, "wide")
    tab.key(True, "ArrowLeft")
    tab.size(500, 760)
    time.sleep(0.5)
    picture(tab, "narrow")
    tab.size(1280, 640)
    tab.value("document.querySelector('#toggles input[data-name=map]').click()")
    tab.until("frame.header.t > 60")
    picture(tab, "cameras")
    tab.value("document.querySelector('#toggles input[data-name=map]').click()")
    tab.until("phase === 'over'", 60)
    tab.size(1280, 900)
    tab.click("Watch it again")
    tab.value("player.begun = null; byId('scrub').value = 240")
    tab.until("player.at === 240")
    picture(tab, "replay")
    tab.close()
    clock.join(30)
    server.stop()


def study(browser, results: Path) -> None:
    """The questionnaire."""
    server, _ = served("specs/study.yaml", results, 1, None, 1, 4.0)
    tab = browser.tab()
    tab.size(1280, 900)
    tab.open(server.address)
    tab.until("phase === 'form'")
    tab.click("I agree")
    for _ in range(2):
        tab.until("phase === 'ready'", 60)
        tab.click("Go")
        tab.until("phase === 'driving'")
        tab.until("phase !== 'driving'", 90)
    tab.until("phase === 'form'", 60)
    tab.value(
        "document.querySelectorAll('.scale input').forEach((each, i) => { each.value = 20 "
        "+ 9 * i; each.oninput(); })"
    )
    picture(tab, "questions")
    tab.close()
    server.stop()


if __name__ == "__main__":
    main()
