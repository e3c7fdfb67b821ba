"""Pictures and pages of trained parts, a folder for each: what a dataset holds, what a world
model sees and imagines.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.cells.table import Floats
from wasp_cli.report.canvas import save
from wasp_cli.report.render import markdown
from wasp_cli.report.summary import Value
from wasp_cli.report.tables import Column, Row, Table
from wasp_cli.report.trained.artifacts import PIXELS, UNREADABLE, Trained, read_json, read_table
from wasp_cli.report.trained.datasets import ALL, Document, dataset_warnings
from wasp_cli.report.trained.figures import (
    draw_horizon,
    draw_learning,
    draw_reliability,
    draw_value_reliability,
)
from wasp_cli.report.trained.vectors import VectorWindow, draw_decoded, draw_imagined
from wasp_cli.store.layout import Layout, slug
from wasp_cli.store.records import replace_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# red is what cost, blue what was predicted to
INK = (20, 20, 20)
PAPER = (255, 255, 255)
RED = (214, 39, 40)
BLUE = (31, 119, 180)
GAP = 6  # between frames, in px
TEXT = 18  # height of a line of text
SIDE = 96  # of a frame of a world model
LABEL = 92  # width of the names of its rows
BAR = 26  # height of the bars of costs
PITCH = SIDE + GAP
COLUMNS = (
    "window",
    "step",
    "behaviour",
    "episode",
    "decision",
    "cost",
    "predicted",
    "true",
    "model",
)
VECTORS_FILE = "vectors.parquet"  # the samples of a model of vectors
WINDOWS = 16  # imagined windows that are drawn at most

Images = NDArray[np.uint8]


class Window(NamedTuple):
    """K steps of an episode as they were seen, beside what a model of images decoded or
    imagined.
    """

    title: str
    true: Images  # [K, 6, 64, 64]
    model: Images  # [K, 6, 64, 64] decoded or imagined
    cost: Floats  # [K] real cost
    predicted: Floats  # [K] probability of a cost


class _Samples(NamedTuple):
    """What diagnostics sampled, a row for each frame."""

    window: NDArray[np.int64]  # -1: decoded, then the imagined ones by number
    rows: dict[str, list[Any]]  # other columns by name
    cost: Floats
    predicted: Floats

    def windows(self) -> list[int]:
        """Return the numbers of the imagined windows that are drawn."""
        return sorted(set(self.window[self.window >= 0].tolist()))[:WINDOWS]

    def places(self, number: int) -> list[int]:
        """Return the rows of a window, in order."""
        places: list[int] = np.flatnonzero(self.window == number).tolist()
        return places

    def title(self, number: int) -> str:
        """Return whose window it is."""
        first = self.places(number)[0]
        behaviour = self.rows["behaviour"][first]
        episode = self.rows["episode"][first]
        return f"{behaviour}, episode {episode}, step {self.rows['decision'][first]}"


def _samples(layout: Layout, artifact: Trained, file: str) -> _Samples:
    table = read_table(layout, artifact, file, COLUMNS)
    rows: dict[str, list[Any]] = {
        name: table[name].to_pylist()
        for name in ("behaviour", "episode", "decision", "true", "model")
    }
    cost = np.nan_to_num(np.asarray(table["cost"], np.float64))
    predicted = np.nan_to_num(np.asarray(table["predicted"], np.float64))
    window = np.asarray(table["window"], np.int64)
    return _Samples(window, rows, cost, np.clip(predicted, 0.0, 1.0))


def read_windows(layout: Layout, artifact: Trained) -> tuple[Window | None, list[Window]]:
    """Read what a model of images decoded (None if nothing was sampled), and the windows that it
    imagined. Raises one of UNREADABLE.
    """
    samples = _samples(layout, artifact, "images.parquet")

    def window(number: int) -> Window:
        places = samples.places(number)
        true = _images(samples.rows["true"], places)
        model = _images(samples.rows["model"], places)
        cost = samples.cost[places]
        predicted = samples.predicted[places]
        return Window(samples.title(number), true, model, cost, predicted)

    decoded = window(-1) if samples.places(-1) else None
    return decoded, [window(number) for number in samples.windows()]


def _images(rows: Sequence[bytes], places: Sequence[int]) -> Images:
    """The images [K, 6, 64, 64] of some rows."""
    return np.stack([np.frombuffer(rows[i], np.uint8).reshape(PIXELS) for i in places])


def read_vectors(layout: Layout, artifact: Trained) -> tuple[VectorWindow, list[VectorWindow]]:
    """Read what a model of vectors decoded, and the windows that it imagined. Raises one of
    UNREADABLE.
    """
    samples = _samples(layout, artifact, VECTORS_FILE)

    def window(number: int) -> VectorWindow:
        places = samples.places(number)
        true = np.array([samples.rows["true"][i] for i in places], np.float64)
        model = np.array([samples.rows["model"][i] for i in places], np.float64)
        cost = samples.cost[places]
        predicted = samples.predicted[places]
        return VectorWindow(samples.title(number), true, model, cost, predicted)

    return window(-1), [window(number) for number in samples.windows()]


def _sees_vectors(layout: Layout, artifact: Trained) -> bool:
    return (layout.artifact(artifact.kind, artifact.key) / VECTORS_FILE).is_file()


def _strip(window: Window, word: str) -> Image.Image:
    strip = Image.new("RGB", (LABEL + len(window.cost) * PITCH + GAP, GAP + 4 * PITCH), PAPER)
    draw = ImageDraw.Draw(strip)
    font = ImageFont.load_default(11)
    rows = [
        (f"{name} {camera}", images, channel)
        for camera, channel in (("front", 0), ("rear", 3))
        for name, images in (("true", window.true), (word, window.model))
    ]
    for row, (name, images, channel) in enumerate(rows):
        y = GAP + row * PITCH
        draw.text((GAP, y + SIDE // 2 - 6), name, INK, font)
        for column, image in enumerate(images):
            x = LABEL + column * PITCH
            shown = Image.fromarray(
                np.ascontiguousarray(image[channel : channel + 3].transpose(1, 2, 0))
            )
            strip.paste(shown.resize((SIDE, SIDE), Image.Resampling.NEAREST), (x, y))
            if window.cost[column] > 0:
                draw.rectangle((x - 2, y - 2, x + SIDE + 1, y + SIDE + 1), outline=RED, width=2)
    return strip


def draw_reconstructions(layout: Layout, artifact: Trained, path: Path) -> None:
    """Write what a world model decodes of held-out observations, beside these, as PNG. Raises one
    of UNREADABLE; writes nothing if nothing was sampled.
    """
    if _sees_vectors(layout, artifact):
        draw_decoded(read_vectors(layout, artifact)[0], path)
        return
    decoded, _ = read_windows(layout, artifact)
    if decoded is not None:
        _strip(decoded, "decoded").save(path, format="PNG")


def draw_open_loop(layout: Layout, artifact: Trained, path: Path) -> None:
    """Write the windows that a world model imagined under the true actions, beside what was seen
    and with costs, as PNG. Raises one of UNREADABLE; writes nothing if nothing was sampled.
    """
    if _sees_vectors(layout, artifact):
        _, imagined = read_vectors(layout, artifact)
        if imagined:
            draw_imagined(imagined, path)
        return
    _, windows = read_windows(layout, artifact)
    if not windows:
        return
    strips = [_strip(window, "imagined") for window in windows]
    block = TEXT + strips[0].height + BAR + TEXT + GAP
    sheet = Image.new("RGB", (max(strip.width for strip in strips), len(windows) * block), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(11)
    bold = ImageFont.load_default(13)
    for number, (window, strip) in enumerate(zip(windows, strips, strict=True)):
        top = number * block
        title = (
            f"{window.title}: seen at 0, then {len(window.cost) - 1} steps imagined under the "
            "true actions"
        )
        draw.text((GAP, top), title, INK, bold)
        sheet.paste(strip, (0, top + TEXT))
        base = top + TEXT + strip.height + BAR
        draw.text((GAP, base - BAR), "predicted cost", BLUE, font)
        draw.text((GAP, base - BAR // 2), "real cost", RED, font)
        for column, (cost, predicted) in enumerate(zip(window.cost, window.predicted, strict=True)):
            x = LABEL + column * PITCH
            draw.line((x, base, x + SIDE, base), INK)
            draw.rectangle(
                (x + 4, base - round((BAR - 2) * float(predicted)), x + SIDE // 2 - 4, base), BLUE
            )
            if cost > 0:
                draw.rectangle((x + SIDE // 2 + 4, base - BAR + 2, x + SIDE - 4, base), RED)
            draw.text((x + 4, base + 1), f"{column}:  {predicted:.2f}", BLUE, font)
    sheet.save(path, format="PNG")


SETS = {
    "held_out": "Held-out episodes of the dataset",
    "unseen": "Fresh episodes under operators that are not in the dataset",
}


def _percent(key: str, title: str, digits: int = 0) -> Column:
    return Column(key, f"{title} (%)", digits=digits, scale=100.0)


CONTENTS = (
    Column("episodes", "Episodes", digits=0),
    _percent("share", "Share"),
    Column("steps", "Steps", digits=0),
    Column("return_per_episode", "Return"),
    Column("goals_per_episode", "Goals"),
    _percent("with_goal", "With a goal"),
    _percent("terminal", "Ended by rule"),
    Column("cost_per_episode", "Cost", digits=1),
    _percent("costly_share", "Costly steps", 2),
)
FORESEEN = tuple(
    Column(key, title, digits=digits)
    for key, title, digits in (
        ("base", "Base rate", 3),
        ("auprc", "AUPRC", 3),
        ("auprc_low", "from", 3),
        ("auprc_high", "to", 3),
        ("persistence", "Persistence", 3),
        ("recall", "Recall", 3),
        ("predicted_over_base", "Predicted / base", 2),
        ("calibration_error", "ECE", 3),
        ("onset_base", "Onset base", 3),
        ("onset_auprc", "Onset AUPRC", 3),
        ("foreseen", "Foreseen", 3),
        ("onset_foreseen", "Onset foreseen", 3),
        ("reward_r2", "Reward R2", 2),
    )
)
OBSERVED = {
    kind: (
        Column(f"{kind}_error", f"{kind.capitalize()} error", digits=4),
        Column("copy_error", "Copy error", digits=4),
        Column(f"{kind}_over_copy", f"{kind.capitalize()} / copy", digits=2),
    )
    for kind in ("image", "vector")
}
"""Columns of how well a world model imagines what it sees: images or vectors."""
UNITS = {
    "image": "Image errors are squared, per pixel, for values in [0, 1].",
    "vector": "Vector errors are squared, per component, in units of the dataset's variance.",
}
WINDOW = tuple(
    Column(key, title, digits=3)
    for key, title in (
        ("base", "Base rate"),
        ("auprc", "AUPRC"),
        ("recall", "Recall"),
        ("foreseen", "Foreseen"),
        ("false_alarms", "False alarms"),
        ("persistence", "Persistence, AUPRC"),
        ("cost_correlation", "Summed cost, correlation with the real sum"),
    )
)


def contents_markdown(contents: Document) -> str:
    """Return the contents of a dataset (`contents.json`) by behaviour, as Markdown."""
    sources = [_percent(kind, kind, 2) for kind in contents[ALL]["sources"]]
    rows = [((name,), {**row, **row["sources"]}) for name, row in contents.items()]
    notes = [
        "Return, goals and cost (env steps that cost) are means per episode; costly steps "
        "and the cost sources are shares of the decision "
        "steps, and one step may cost by several sources.",
        *(f"Warning: {text}." for text in dataset_warnings(contents)),
    ]
    return _table("What the dataset holds", ("Behaviour",), (*CONTENTS, *sources), rows, notes)


def open_loop_markdown(sets: Document) -> str:
    """Return how well a world model foresees costs, rewards and observations (`diagnostics.json`),
    as Markdown: by imagined step, within the window, and read out of latents.
    """
    parts = ["# What the world model foresees\n"]
    for name, table in sets.items():
        named = ", ".join(f"{behaviour} {count}" for behaviour, count in table["episodes"].items())
        total = sum(table["episodes"].values())
        moments = f"imagined {len(table['steps'])} steps ahead from {table['starts']} moments"
        parts += [
            f"# {SETS.get(name, name)}\n",
            f"{total} episodes ({named}), {moments}.\n",
            *_foreseen(table),
        ]
    window = next(iter(sets.values()))["window"]
    kind = _observed(next(iter(sets.values())))
    parts.append(
        "From and to are a 95 % interval of the AUPRC over resampled episodes. Persistence "
        "says that the cost stays what it is now, copy "
        f"that the {kind} does. Recall is at 10 % false alarms. Onset counts only starts "
        "that do not cost themselves. Foreseen is the share "
        "of the real costs before which the safety gate would have fired: the expected "
        "costly steps of the window, discounted by "
        f"{window['gamma']:g} a step, were above {window['threshold']:g}; false alarms is "
        "the share of windows without a cost in which "
        "they were too. ECE is the mean distance of predicted and seen over ten bins. "
        f"{UNITS[kind]}\n"
    )
    return "\n".join(parts)


def _observed(table: Document) -> str:
    """Return what the model sees: `image` or `vector`."""
    return "vector" if any("vector_error" in row for row in table["steps"]) else "image"


def _foreseen(table: Document) -> Iterator[str]:
    """The tables of one set of episodes."""
    # By imagined step, and within the whole window.
    steps = table["steps"]
    window = table["window"]
    kind = _observed(table)
    columns = (*FORESEEN, *OBSERVED[kind])
    yield _table("Step by step", ("k",), columns, [((str(row["k"]),), row) for row in steps])
    starts = [
        ((title,), {column.key: window.get(f"{prefix}{column.key}") for column in WINDOW})
        for title, prefix in (("all", ""), ("onset", "onset_"))
    ]
    yield _table(f"Any cost within {len(steps)} steps", ("Starts",), WINDOW, starts)

    # How much of the privileged vector can be read out of latents.
    readout = table.get("readout")
    if readout:
        places = (
            ("filtered latent", "filtered"),
            (f"embedding of the {kind}", "embedding"),
            (f"imagined, step {readout['step']}", "imagined"),
        )
        note = (
            "What a ridge regression tells of the privileged vector, as R2, fitted on the "
            "episodes that were learned from."
        )
        groups = [Column(group, group) for group in readout["filtered"]]
        yield _table(
            "What is read from the latent",
            ("read from",),
            groups,
            [((title,), readout[key]) for title, key in places],
            [note],
        )
    sources = list(steps[0]["foreseen_by_source"]) if steps else []
    if len(sources) > 1:
        rows = [((str(row["k"]),), row["foreseen_by_source"]) for row in steps]
        shown = [Column(kind, kind, digits=3) for kind in sources]
        yield _table("Share of the costs of each source that were foreseen", ("k",), shown, rows)


def quality_markdown(quality: Document) -> str:
    """Return what denoising does to commands (`quality.json`), as Markdown."""
    columns = (
        Column("conformity", "to the expert's action", digits=3),
        Column("fidelity", "to the command", digits=3),
    )
    rows = [
        ((kind, ratio), row)
        for kind, by_ratio in quality.items()
        for ratio, row in by_ratio.items()
    ]
    return _table("What denoising does to commands", ("Command", "Ratio"), columns, rows)


def _table(
    title: str,
    labels: tuple[str, ...],
    columns: Sequence[Column],
    rows: Iterable[tuple[tuple[str, ...], Document]],
    notes: Sequence[str] = (),
) -> str:
    filled = tuple(
        Row(names, tuple(Value(numbers[column.key]) for column in columns))
        for names, numbers in rows
    )
    return markdown(
        Table("part", title, labels, tuple(columns), filled, tuple(notes), grouping=0, ranked=False)
    )


FOLDER = "trained"  # below the folder of a report
# writes a file from an artifact, or nothing if there is nothing to show
Draw = Callable[[Layout, Trained, Path], None]


def _figure(draw: Callable[[Layout, Sequence[Trained]], Figure | None]) -> Draw:
    def write(layout: Layout, artifact: Trained, path: Path) -> None:
        figure = draw(layout, [artifact])
        if figure is not None:
            save(figure, path)

    return write


def _page(render: Callable[[Any], str], source: str) -> Draw:
    def write(layout: Layout, artifact: Trained, path: Path) -> None:
        replace_file(path, render(read_json(layout, artifact, source)))

    return write


# by the kind of the artifact: the files and what writes each
EVIDENCE: dict[str, tuple[tuple[str, Draw], ...]] = {
    "expert": (("curve.png", _figure(draw_learning)),),
    "dataset": (("contents.md", _page(contents_markdown, "contents.json")),),
    "diagnostics": (
        ("open_loop.md", _page(open_loop_markdown, "diagnostics.json")),
        ("horizon.png", _figure(draw_horizon)),
        ("reliability.png", _figure(draw_reliability)),
        ("reconstruction.png", draw_reconstructions),
        ("open_loop.png", draw_open_loop),
    ),
    "critics": (("critics.png", _figure(draw_value_reliability)),),
    "ida_q": (("q.png", _figure(draw_value_reliability)),),
    "denoiser": (("quality.md", _page(quality_markdown, "quality.json")),),
    "consistency": (("quality.md", _page(quality_markdown, "quality.json")),),
    "residual": (("curve.png", _figure(draw_learning)),),
}


def write_evidence(
    layout: Layout,
    trained: Sequence[Trained],
    report: Path,
    tell: Callable[[str], None] = lambda text: None,
    *,
    anew: bool = True,
) -> list[Path]:
    """Write pictures and pages of trained parts, a folder for each. A file is left out if the
    artifact is damaged.

    Args:
        trained: the parts.
        report: folder of the report, below which FOLDER is written.
        tell: gets the name of each part.
        anew: whether what was there before is removed first.

    Returns:
        The files.
    """
    root = report / FOLDER
    if anew and root.is_dir() and not root.is_symlink():
        shutil.rmtree(root)
    elif anew or root.is_symlink():  # a link would lead elsewhere
        root.unlink(missing_ok=True)
    written: list[Path] = []
    for part in trained:
        if part.kind in EVIDENCE:
            folder = root / slug(f"{part.task} s{part.seed} {part.kind} {part.key[:8]}")
            folder.mkdir(parents=True)
            tell(folder.name)
            for file, draw in EVIDENCE[part.kind]:
                with suppress(*UNREADABLE):
                    draw(layout, part, folder / file)
            written += sorted(folder.iterdir())
            if not any(folder.iterdir()):
                folder.rmdir()
    return written
