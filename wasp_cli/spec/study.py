"""A study with people: its settings, its questionnaires, and the order of its conditions."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import (
    Field,
)

from wasp_cli.config import Config
from wasp_cli.spec.names import NO_REPEATS

Shown = Literal["cameras", "map", "cost", "goals", "gate", "imagined"]
Questionnaire = Literal["tlx", "assistance"]

QUESTIONS: dict[str, tuple[tuple[str, str, str, str], ...]] = {
    "tlx": (
        ("mental", "How mentally demanding was the task?", "very low", "very high"),
        ("physical", "How physically demanding was the task?", "very low", "very high"),
        ("temporal", "How hurried or rushed was the pace of the task?", "very low", "very high"),
        (
            "performance",
            "How successful were you in accomplishing what you were asked to do?",
            "perfect",
            "failure",
        ),
        (
            "effort",
            "How hard did you have to work to accomplish your level of performance?",
            "very low",
            "very high",
        ),
        (
            "frustration",
            "How insecure, discouraged, irritated, stressed and annoyed were you?",
            "very low",
            "very high",
        ),
    ),
    "assistance": (
        ("agency", "The vehicle did what I wanted it to do.", "not at all", "completely"),
        ("trust", "I could rely on what the vehicle did.", "not at all", "completely"),
        ("satisfaction", "I was satisfied with how driving went.", "not at all", "completely"),
    ),
}
"""By questionnaire: name, words and the two ends of every scale from 0 to 100. `tlx` is NASA's task
load index without weights (raw TLX; Hart 2006); the other is ours."""


class StudyConfig(Config):
    """A study: each participant drives every condition (a method, or one of its variants) once,
    in a balanced order.
    """

    title: str = Field(default="Driving study", max_length=200, description="heading of the page")
    consent: str = Field(
        default="",
        max_length=20_000,
        description="what participants are told and agree to; empty: no consent is asked",
    )
    consent_version: str = Field(
        default="1", max_length=40, description="recorded with the consent; change it with the text"
    )
    practice: int = Field(
        default=1,
        ge=0,
        le=100,
        description="episodes before the first block, without an assistant, that do not count",
    )
    questionnaires: Annotated[tuple[Questionnaire, ...], NO_REPEATS] = Field(
        default=("tlx", "assistance"),
        description="asked after every block: raw NASA-TLX; agency, trust and satisfaction",
    )
    shown: Annotated[tuple[Shown, ...], NO_REPEATS] = Field(
        default=("cameras", "map", "cost", "goals"),
        description="what participants see; gate and imagined would tell conditions apart",
    )
    speed: float = Field(default=1.0, gt=0.0, le=4.0, description="simulated seconds per second")


def balanced_order(conditions: int, participant: int) -> list[int]:
    """Return the order of conditions (0, 1, ...) of a participant: a row of a Williams square.

    Every condition stands in every place, and follows every other one, equally often over `n`
    participants with consecutive numbers, or over `2 n` where the number of conditions is odd
    (Williams 1949).
    """
    first = [(k + 1) // 2 if k % 2 else conditions - k // 2 for k in range(conditions)]
    rows = [[(start + shift) % conditions for start in first] for shift in range(conditions)]
    if conditions % 2:
        rows += [row[::-1] for row in rows]
    return rows[participant % len(rows)]
