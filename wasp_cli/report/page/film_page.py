"""A page for each task: its films with a common slider, and under each the timeline of its gates."""

from __future__ import annotations

import math

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.page.films import MethodFilm, TaskFilms
from wasp_cli.report.page.markup import Markup, data_uri, element, joined
from wasp_cli.report.page.timeline import timeline
from wasp_cli.report.tables.titles import operator_title

KEY = (("safety", "safety gate"), ("task", "task gate"), ("method", "the method's own rule"), ("cost", "cost"))


def film_page(films: TaskFilms) -> Markup:
    """The content of a task's page."""
    operator = operator_title(films.operator) + ("" if films.value is None else f" {films.value:g}")
    how = "the one whose cost is the median under Human-only" if films.chosen_by_cost else "the one of median cost"
    told = (
        f"Episode {films.number} of seed {films.seed} under the operator {operator}: {how}. Every method meets the same world and the same "
        "mistakes; the Expert is the unimpaired operator."
    )
    slider = element(
        "input", type="range", min=0, max=films.decisions, step=films.films[0].every, value=films.decisions, aria_label="decision"
    )
    controls = element("div", element("button", "Play", type="button"), slider, element("output", ""), class_="player")
    key = joined(element("span", element("i", style=f"background:var(--{kind})"), name) for kind, name in KEY)
    legend = "On the map: the path so far, the operator's command and the executed action as arrows, dots where it cost."
    seconds = films.decision_seconds
    return element(
        "div",
        element("p", told),
        element("p", legend, " Below it: Ḡᶜ and ΔG are what the safety and the task gate look at, dashed their thresholds.", class_="soft"),
        element("p", key, class_="key soft"),
        controls,
        element("div", *(_film(film) for film in films.films), class_="films"),
        data_player=True,
        data_seconds="" if seconds is None or not math.isfinite(seconds) else f"{seconds:g}",
        id=f"films-{films.task}",
    )


def _film(film: MethodFilm) -> Markup:
    row, sprite = film.episode.row, film.sprite
    title = METHODS[film.method].title
    numbers = f"return {row['return']:.1f}, cost {row['cost']:g}, Int. {row['int_rate']:.2f}"
    caption = element("figcaption", element("strong", title), element("br"), numbers)
    if sprite is None:
        frame, data = element("p", f"No film: {film.problem}", class_="soft"), {}
    else:
        rows = math.ceil(len(sprite.decisions) / sprite.columns)
        style = f"background-image:url({data_uri(sprite.data, sprite.mime)});background-size:{100 * sprite.columns}% {100 * rows}%"
        frame = element("div", class_="frame", style=style, role="img", aria_label=f"The episode under {title}, from above")
        data = {"data_count": len(sprite.decisions), "data_columns": sprite.columns, "data_rows": rows}
    return element(
        "figure",
        caption,
        frame,
        timeline(film.episode),
        class_="film",
        data_every=film.every,
        data_decisions=film.episode.decisions,
        **data,
    )
