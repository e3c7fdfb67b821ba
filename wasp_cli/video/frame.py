"""The video of an episode, frame by frame.

On the left is the map. On the right is what the cameras saw, and what the world model decodes: from
the filtered latent, and from imagined latents under the uncorrected command (upper block) and under
the correction (lower block). Below is the course of the whole episode. A task without map and
cameras has the components of its vector over time in their place, and on the left the picture that
the environment draws of itself, if it does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.report.explain.episode import Episode
from wasp_cli.report.explain.layout import action
from wasp_cli.report.explain.timeline import BASE, LOOKS, STRIP, Lane, curves, spans, timeline
from wasp_cli.tasks.base import Floats, Pixels
from wasp_cli.video import trace
from wasp_cli.video.film import write
from wasp_cli.video.map import (
    COMMAND,
    COST,
    EXECUTED,
    MapPicture,
    MapView,
    cameras_of,
    draw_actions,
    font,
    poses_of,
    things_of,
)
from wasp_cli.video.picture import DRAWN, fitted, outline
from wasp_cli.video.trace import ImaginedTrajectories, PlayedDecision, Progress, Source
from wasp_cli.video.vectors import Curves, Scale, draw_course, draw_curves, mark_cost

WIDTH = 976
HEIGHT = 704
# In px.
GAP = 12  # between panels
HEADER = 34  # height of the first line
TITLE = 18  # height of a title
MAP = 436  # side of the map
SIDE = 98  # of a camera image
BETWEEN = 4  # images
TIMELINE = 178
# length of the arrow of a full action as a share of the map's half side: shorter than in a film, to
# leave room for futures
ARROW = 0.15
_RIGHT = GAP + MAP + 16
# Of the two blocks of images, below a line for what they imagine and a line for the columns.
_TOPS = (HEADER + 2 * TITLE, HEADER + 4 * TITLE + 2 * (SIDE + BETWEEN))
POOR = 0.5  # R2 below which a readout is called poor
SLOWER = 2.0  # how much slower than real time a video is, since a decision shows much
LAST_MS = 2000  # how long the last frame stays
ROWS_APART = 6  # in px: between the rows of the timeline
_SIDES = (88, 14)  # in px: left and right of it
_INK = (20, 20, 20)
_GREY = (105, 105, 105)
_PAPER = (255, 255, 255)
_NOTHING = (242, 242, 242)
_SEQUENCES = (COMMAND, EXECUTED)
MOVES = ("forward", "left", "turn")  # what a readout explains


class Correction(NamedTuple):
    """What the assistant did at each of T decisions, as residuals to imagine."""

    residuals: Sequence[NDArray[Any] | None]  # T times [L, A], or None where the command stood
    name: str  # what it is, for people
    hold: bool  # residuals are added to the present command, not to the imagined ones


class WrittenVideo(NamedTuple):
    """What was written: the number of frames, and how well imagined paths are read out of
    latents.
    """

    frames: int
    # of the readout that draws imagined paths (forward, left, turn); None where there is none
    r2: dict[str, float] | None


class Painter:
    """Draws the frames of an episode's video; see the module."""

    def __init__(
        self,
        source: Source,
        stored: Episode,
        correction: Correction,
        horizon: int,
        every: int,
        progress: Progress,
    ) -> None:
        """Play a cell again. There is a frame for every `every`-th decision of the stored episode,
        and for the last one.
        """
        shown = {*range(0, stored.decisions, every), stored.decisions - 1}
        row = int(stored.row["episode"]) - source.recorded.first
        self.played = trace.play_episode(
            source, row, correction.residuals, shown, horizon, progress
        )
        self._stored = stored
        self._horizon = horizon
        self._correction = correction
        self.shown = tuple(
            dict.fromkeys(max(1, round(horizon * share)) for share in (1 / 3, 2 / 3, 1.0))
        )
        self._scale = Scale.of(self.played.states) if len(self.played.states) else None
        # Curves are drawn through every imagined step.
        self._decoded = self.shown if self._scale is None else range(1, horizon + 1)
        self._timeline = Timeline(stored, WIDTH, TIMELINE)
        self._view: MapView | None = None
        self._next = len(shown)

    def film(self, out: Path, progress: Progress) -> WrittenVideo:
        """Write all frames as a video."""
        decisions = [decision.start.t for decision in self.played.decisions]
        times = [
            round(1000 * SLOWER * seconds_of(self._stored) * (after - t))
            for t, after in pairwise(decisions)
        ]
        count = len(decisions)
        with trace.threads_of_evaluations():
            write(
                out,
                count,
                self.frame,
                [*times, LAST_MS],
                lambda index: progress(index / count, f"frame {index + 1} of {count}"),
            )
        explained = dict(zip(MOVES, self.played.explained.tolist(), strict=True))
        return WrittenVideo(count, None if self.played.readout is None else explained)

    def frames(self) -> Iterator[Pixels]:
        """Draw all frames, uint8 [HEIGHT, WIDTH, 3] each."""
        for index in range(len(self.played.decisions)):
            with trace.threads_of_evaluations():
                frame = np.asarray(self.frame(index))
            yield frame

    def frame(self, index: int) -> Image.Image:
        """Draw one frame: RGB of WIDTH x HEIGHT px."""
        if index < self._next and self.played.appearance is not None:
            # A map that follows its robot depends on the frames before: after a jump back it starts
            # again.
            self._view = MapView(self.played.appearance, MAP)
        self._next = index + 1
        decision = self.played.decisions[index]
        imagined = trace.imagine(
            self.played.model,
            decision.start,
            self._horizon,
            self._decoded,
            hold=self._correction.hold,
        )

        # The first line, the map, the images, the numbers and the timeline with a line at now.
        image = Image.new("RGB", (WIDTH, HEIGHT), _PAPER)
        draw = ImageDraw.Draw(image)
        t = decision.start.t
        draw.text((GAP, 9), self._stored.title, _INK, font(15, True))
        time = f"decision {t} of {self._stored.decisions}    {t * seconds_of(self._stored):.2f} s"
        draw.text((WIDTH - GAP - font(15).getlength(time), 9), time, _INK, font(15))
        self._overview(image, draw, decision, imagined)
        self._images(image, draw, decision, imagined)
        below = _RIGHT, HEADER + 2 * TITLE + 2 * SIDE + BETWEEN + 22
        draw.multiline_text(below, "\n".join(numbers(self._stored, t)), _INK, font(12), spacing=5)
        top = HEIGHT - TIMELINE
        image.paste(self._timeline.image, (0, top))
        x = self._timeline.x(t + 0.5)
        draw.line((x, top + 4, x, HEIGHT - 34), _GREY, 2)
        return image

    def _overview(
        self,
        image: Image.Image,
        draw: ImageDraw.ImageDraw,
        decision: PlayedDecision,
        imagined: ImaginedTrajectories,
    ) -> None:
        """Draw the left half: the picture of the environment, else the map, else the vector, else
        the front camera.
        """
        where = (GAP, HEADER + TITLE)
        if decision.picture is not None:
            draw.text((GAP, HEADER), DRAWN, _GREY, font(12))
            square = fitted(decision.picture, MAP)
            if self._stored.costly[decision.start.t]:
                mark_cost(square, 4)
            image.paste(square, where)
            outline(image, where, MAP)
            return
        no_map = self._view is None or decision.scene is None or self.played.appearance is None
        if no_map and self._scale is not None:
            draw.text((GAP, HEADER), "what the assistant sees, by component", _GREY, font(12))
            so_far = self.played.states[: decision.start.t + 1]
            costly = np.flatnonzero(self._stored.costly[: decision.start.t + 1]).tolist()
            course = draw_course(self._scale, so_far, MAP, costly)
            if self._stored.costly[decision.start.t]:
                mark_cost(course, 4)
            image.paste(course, where)
            return
        if self._view is None or decision.scene is None or self.played.appearance is None:
            draw.text((GAP, HEADER), "front camera (this task has no map)", _GREY, font(12))
            image.paste(_camera(decision.seen, 0, MAP), where)
            return
        draw.text((GAP, HEADER), "from above", _GREY, font(12))
        x = GAP + font(12).getlength("from above") + 18
        for name, colour in things_of(self.played.appearance):
            x = _legend_entry(draw, x, HEADER - 1, name, colour, "dot")
        t = decision.start.t
        picture = self._view.picture(decision.scene)
        picture.trail(self.played.places[: t + 1], 1.2)
        picture.dots(self.played.places[: t + 1][self._stored.costly[: t + 1]], COST, 3.5)
        pose = poses_of(self.played.appearance, decision.scene)[0]
        draw_actions(
            picture, self.played.world, pose, self._stored.a_h[t], self._stored.a[t], 4, ARROW
        )
        self._futures(picture, pose, imagined)
        if self._stored.costly[t]:
            picture.edge(COST, 4)
        image.paste(picture.finished(), where)
        self._legend(draw)

    def _futures(self, picture: MapPicture, pose: Floats, imagined: ImaginedTrajectories) -> None:
        """Draw all rollouts as thin lines, and the decoded one thick with a dot at each decoded
        step.
        """
        if self.played.readout is None:
            return
        for sequence, colour in zip(imagined.features, _SEQUENCES, strict=False):
            dash = 0 if colour == EXECUTED else 1
            for number, places in reversed(
                list(enumerate(trace.integrated(pose, self.played.readout(sequence))))
            ):
                if number == 0:
                    picture.line(places, "#FFFFFFB0", 4.0)
                picture.line(places, colour, 2.2 if number == 0 else 0.8, dash)
                if number == 0:
                    picture.dots(places[list(self.shown)], colour, 3.2, "#FFFFFF")

    def _legend(self, draw: ImageDraw.ImageDraw) -> None:
        x = float(GAP)
        y = HEADER + TITLE + MAP + 5
        for text, colour, kind in (
            ("command", COMMAND, "arrow"),
            ("executed instead", EXECUTED, "arrow"),
            ("imagined: uncorrected", COMMAND, "dash"),
            ("corrected", EXECUTED, "line"),
            ("cost", COST, "dot"),
        ):
            x = _legend_entry(draw, x, y, text, colour, kind)
        note = "no imagined paths: the episode is too short to learn to read them out of latents"
        if self.played.readout is not None:
            r2 = ", ".join(
                f"{name} {share:.2f}"
                for name, share in zip(MOVES, self.played.explained, strict=True)
            )
            poor = " (poor: a hint only)" if np.nanmin(self.played.explained) < POOR else ""
            note = f"imagined paths are read out of latents by a linear fit, R² {r2}{poor}"
        draw.text((GAP, y + 17), note, _GREY, font(10))

    def _images(
        self,
        image: Image.Image,
        draw: ImageDraw.ImageDraw,
        decision: PlayedDecision,
        imagined: ImaginedTrajectories,
    ) -> None:
        if self._scale is not None:
            self._vectors(image, draw, decision, imagined, self._scale)
            return
        rows = range(getattr(self.played.world, "cameras", 2))
        columns = [_RIGHT + column * (SIDE + BETWEEN) for column in range(2 + len(self.shown))]
        for column, name, images in (
            (columns[0], "cameras", decision.seen),
            (columns[1], "decoded", _bytes(decision.decoded)),
        ):
            draw.text((column, HEADER + TITLE), name, _GREY, font(11))
            for row in rows:
                where = (column, _TOPS[0] + row * (SIDE + BETWEEN))
                image.paste(_camera(images, row, SIDE), where)
                self._edge(image, where)
        for block, (top, name, colour) in enumerate(
            zip(_TOPS, ("uncorrected", self._correction.name), _SEQUENCES, strict=True)
        ):
            there = block < len(imagined.features)
            what = f"imagined: {name}" if there else "no correction at this decision"
            draw.rectangle(
                (columns[2], top - 2 * TITLE + 4, columns[2] + 10, top - 2 * TITLE + 14),
                colour if there else _NOTHING,
            )
            draw.text(
                (columns[2] + 16, top - 2 * TITLE + 2), what, _INK if there else _GREY, font(12)
            )
            for column, step in zip(columns[2:], self.shown, strict=True):
                text = f"+{step}  ĉ {imagined.cost[block, step - 1]:.2f}" if there else ""
                draw.text((column, top - TITLE + 2), text, _GREY, font(11))
                for row in rows:
                    x = column
                    y = top + row * (SIDE + BETWEEN)
                    if there:
                        image.paste(
                            _camera(_bytes(imagined.images[step][block]), row, SIDE), (x, y)
                        )
                        self._edge(image, (x, y))
                    else:
                        draw.rectangle((x, y, x + SIDE - 1, y + SIDE - 1), _NOTHING)

    def _edge(self, image: Image.Image, where: tuple[int, int]) -> None:
        """Draw a line around an image of an environment of another package."""
        if self.played.appearance is None:
            outline(image, where, SIDE)

    def _vectors(
        self,
        image: Image.Image,
        draw: ImageDraw.ImageDraw,
        decision: PlayedDecision,
        imagined: ImaginedTrajectories,
        scale: Scale,
    ) -> None:
        """Draw for each block the vector before and after the decision, and as it was imagined."""
        t = decision.start.t
        horizon = self._horizon
        span = (max(0, t - horizon // 2), t + horizon)
        # As wide as the imagined images of other tasks, to the right of the numbers.
        left = _RIGHT + 2 * (SIDE + BETWEEN)
        size = (WIDTH - GAP - left, 2 * SIDE + BETWEEN)
        came = Curves(self.played.states, 0, "#a0a0a0")
        for block, (top, name, colour) in enumerate(
            zip(_TOPS, ("uncorrected", self._correction.name), _SEQUENCES, strict=True)
        ):
            there = block < len(imagined.features)
            what = f"imagined: {name}" if there else "no correction at this decision"
            mark = (left, top - 2 * TITLE + 4, left + 10, top - 2 * TITLE + 14)
            draw.rectangle(mark, colour if there else _NOTHING)
            place = (left + 16, top - 2 * TITLE + 2)
            draw.text(place, what, _INK if there else _GREY, font(12))
            if there:
                costs = [f"+{step}  ĉ {imagined.cost[block, step - 1]:.2f}" for step in self.shown]
                draw.text((left, top - TITLE + 2), "    ".join(costs), _GREY, font(11))
            curves = [came]
            if there:
                steps = [imagined.images[step][block] for step in range(1, horizon + 1)]
                ahead = np.array([decision.decoded, *steps], np.float64)
                curves.append(Curves(ahead, t, colour))
            image.paste(draw_curves(scale, curves, span, size, now=t), (left, top))
        notes = ["right: before and after this decision,", "grey: as it came"]
        draw.multiline_text((_RIGHT, HEADER + 2), "\n".join(notes), _GREY, font(11), spacing=4)


def _legend_entry(
    draw: ImageDraw.ImageDraw, x: float, y: float, text: str, colour: str, kind: str
) -> float:
    middle = y + 8
    if kind == "dot":
        draw.ellipse((x + 6, middle - 4, x + 14, middle + 4), colour)
    elif kind == "dash":
        draw.line((x, middle, x + 8, middle), colour, 3)
        draw.line((x + 13, middle, x + 20, middle), colour, 3)
    else:
        draw.line((x, middle, x + (14 if kind == "arrow" else 20), middle), colour, 3)
    if kind == "arrow":
        draw.polygon([(x + 20, middle), (x + 11, middle - 5), (x + 11, middle + 5)], colour)
    draw.text((x + 25, y + 1), text, _INK, font(11))
    return x + 25 + font(11).getlength(text) + 12


def _camera(images: NDArray[Any], camera: int, side: int) -> Image.Image:
    return Image.fromarray(cameras_of(images)[camera]).resize(
        (side, side), Image.Resampling.BICUBIC
    )


def _bytes(image: NDArray[Any]) -> NDArray[np.uint8]:
    return (image * 255).round().clip(0, 255).astype(np.uint8)


def seconds_of(stored: Episode) -> float:
    """Return the simulated seconds of a decision; 0.1 if they are not known."""
    return stored.constants.decision_seconds or 0.1


class Timeline:
    """The course of an episode as an image of `width` x `height` px: curves, gates and costs."""

    def __init__(self, episode: Episode, width: int, height: int) -> None:
        self._decisions = episode.decisions
        self._width = width
        looked_at = curves(episode)

        # The rows: curves, the gates in place of the acts, and costs.
        rows = [lane for lane in timeline(episode) if lane.name != "acts"]
        kinds = [LOOKS[gate].kind if gate in LOOKS else "" for gate in episode.gate.tolist()]
        rows.insert(-1, Lane("gate", STRIP, BASE, marks=spans(kinds)))
        colours = {look.kind: look.colour for look in LOOKS.values()} | {
            "cost": COST,
            "limit": EXECUTED,
            "base": "#d0d0d0",
        }
        scale = min((height - 44 - ROWS_APART * len(rows)) / sum(lane.height for lane in rows), 2.0)
        # drawn twice as large, which smooths its edges
        large = Image.new("RGB", (2 * width, 2 * height), _PAPER)
        draw = ImageDraw.Draw(large)
        top = 8.0
        for i, lane in enumerate(rows):
            below = top + scale * lane.height
            draw.text((2 * _SIDES[0] - 12, top + below), lane.name, _INK, font(22), anchor="rm")
            for kind, first, many in lane.marks:
                draw.rectangle(
                    (2 * self.x(first), 2 * top, 2 * self.x(first + many) - 2, 2 * below),
                    colours[kind],
                )
            for kind, level in lane.levels:
                y = 2 * (top + scale * float(level))
                draw.line((2 * self.x(0), y, 2 * self.x(self._decisions), y), colours[kind], 2)
            for points in lane.curves:
                places = [tuple(map(float, point.split(","))) for point in points.split()]
                draw.line([(2 * self.x(x), 2 * (top + scale * y)) for x, y in places], COMMAND, 2)
            for y in (
                2 * (top + scale * float(level)) for kind, level in lane.levels if kind == "limit"
            ):
                at = (2 * self.x(self._decisions) - 4, y - 2)
                label = f"{looked_at[i].limit_name} {looked_at[i].limit:.3g}"
                # readable on a curve too
                draw.text(
                    at, label, "#8f3f74", font(20), anchor="rb", stroke_width=5, stroke_fill=_PAPER
                )
            top = below + ROWS_APART

        # The first and the last decision, and the legend.
        last = self._decisions - 1
        for t, end, anchor in ((0, 0, "lt"), (last, last + (last > 0), "rt")):
            place = (2 * self.x(end), 2 * top - 4)
            draw.text(place, f"decision {t}", _GREY, font(20), anchor=anchor)
        self.image = large.reduce(2)
        x = float(_SIDES[0])
        small = ImageDraw.Draw(self.image)
        fired = [
            (look.words, look.colour)
            for gate, look in LOOKS.items()
            if (episode.gate == gate).any()
        ]
        for words, colour in [*fired, ("cost paid", COST)]:
            x = _legend_entry(small, x, height - 22, words, colour, "dot")

    def x(self, decisions: float) -> float:
        """Return where a number of decisions after the beginning lies, in px from the left."""
        return _SIDES[0] + decisions / self._decisions * (self._width - sum(_SIDES))


def numbers(episode: Episode, t: int) -> list[str]:
    """Return the numbers of decision t as lines: gate, command, action, what the gates compared,
    and the reward and cost so far.
    """
    gate = LOOKS.get(int(episode.gate[t]))
    limits = episode.thresholds
    deviation = float(episode.numbers["deviation"][t])
    alone = episode.at("alone_cost", t)
    lines = [
        f"gate: {gate.words}" if gate else "gate: none, the command stands",
        f"command   {action(episode.a_h[t].tolist())}",
        f"executed  {action(episode.a[t].tolist())}",
        f"‖a − aᴴ‖  {deviation:.2f}" if deviation > INTERVENED else "‖a − aᴴ‖  0",
    ]

    # What the method decided by.
    if episode.gated:
        lines += _against("Ḡᶜ", episode.at("g_cost", t), "τ_c", limits.tau_c)
        lines += _against("ΔG", episode.at("delta_g", t), "τ_r", limits.tau_r)
        planned = episode.at("plan_cost", t)
        if planned is not None:
            text = f"plan's cost {planned:.2f}"
            if alone is not None:
                text += f", without it {alone:.2f}"
            lines.append(text)
    else:
        lines += _against(
            episode.signal.name, episode.at("signal", t), "limit", episode.signal_limit
        )

    # What has happened so far.
    reward = episode.numbers["reward"][: t + 1]
    cost = int(episode.numbers["cost_env"][: t + 1].sum())
    goals = int(episode.numbers["goals"][: t + 1].sum())
    lines.append(f"reward {reward[-1]:+.3f}, so far {reward.sum():.2f}")
    lines.append(f"cost so far {cost}, goals {goals}")
    return lines


def _against(name: str, value: float | None, limit_name: str, limit: float | None) -> list[str]:
    """A value beside its limit, as one line; none if the value is undefined."""
    if value is None:
        return []
    text = f"{name} {value:.2f}"
    if limit is not None:
        sign = ">" if value > limit else "≤"
        text += f" {sign} {limit_name} {limit:.3g}"
    return [text]
