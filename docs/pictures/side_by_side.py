"""Draws README's film, the same episode alone and with WASP: `python
docs/pictures/side_by_side.py`. It reads the published cells.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
TASK, CELL, REPEAT = "goal1", "goal1 s315 {} laggy=0.7", 4
SIZE, EVERY, HEAD = 300, 2, 44


def main() -> None:
    """Draw both episodes, each with what it returned and cost so far, and write them beside
    each other.
    """
    import wasp_cli
    from wasp_cli.video.film import film

    results, font = wasp_cli.results(ROOT / "results" / "published"), ImageFont.load_default(15)
    halves = []
    for method, title in (("human", "operator alone"), ("wasp", "with WASP")):
        cell = results.cell(CELL.format(method))
        steps = cell.steps(0).to_pydict()
        a, a_h = (np.array(steps[name], np.float32) for name in ("a", "a_h"))
        world = cell.episodes().to_pydict()["episode_seed"][0]
        reward, cost = np.cumsum([0.0, *steps["reward"]]), np.cumsum([0, *steps["cost_env"]])
        half = []
        for moment in film(
            TASK, REPEAT, world, a, a_h, np.array(steps["reward"], np.float32), EVERY, SIZE
        ):
            frame = Image.new("RGB", (SIZE, SIZE + HEAD), "white")
            frame.paste(Image.fromarray(moment.frame), (0, HEAD))
            draw = ImageDraw.Draw(frame)
            draw.text((8, 3), title, "black", font)
            draw.text(
                (8, 22),
                f"return {reward[moment.decision]:.1f}   cost {cost[moment.decision]}",
                "black",
                font,
            )
            half.append(np.asarray(frame))
        halves.append(half)
    frames = [Image.fromarray(np.concatenate(pair, 1)) for pair in zip(*halves, strict=True)]
    out = ROOT / "docs" / "pictures" / "side_by_side.webp"
    frames[0].save(
        out,
        save_all=True,
        append_images=frames[1:],
        duration=1000 * EVERY * REPEAT // 50,
        loop=0,
        quality=40,
        method=4,
    )
    print(out, f"{out.stat().st_size / 1e6:.2f} MB", len(frames), "frames")


if __name__ == "__main__":
    main()
