"""`wasp try`: tries an environment of another package before anything is trained in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from wasp_cli.cli.command import command
from wasp_cli.cli.completion import task_names
from wasp_cli.cli.options import JsonOption, SetOption, print_json
from wasp_cli.cli.parameters import argument, flag, option, parse_duration
from wasp_cli.console import duration, say
from wasp_cli.errors import TaskError, UsageError
from wasp_cli.spec.shipped import SUFFIX, spec_path

if TYPE_CHECKING:
    from wasp_cli.learning.trial import Trial
    from wasp_cli.plan.tried import Tried
    from wasp_cli.tasks.foreign.raw import Raw

PRESETS = ("quick", "cpu")  # smallest first
MOST_SECONDS = 150 * 60.0
"""Time of a chain up to which a larger preset is suggested."""
SMALLEST_SIDE = 24  # px; arrays with shorter sides are taken for vectors
GUESSED = "a guess by its name: see whether it is what should not happen"


@command(
    "wasp try my_pkg:MyEnv-v0",
    "wasp try my_pkg:MyEnv-v0 --write my_env.yaml",
    "wasp try my_env.yaml --json",
    name="try",
    codes="0 it can be used, 1 it cannot as it is, 2 usage, 3 the spec is invalid",
)
def try_out(
    env: Annotated[
        str,
        argument(
            "ENV",
            "A gymnasium id (my_pkg:MyEnv-v0), or a spec with environments.",
            among=task_names,
        ),
    ],
    write: Annotated[
        Path | None, option("FILE", "Write a spec to start with. (default: it is printed)")
    ] = None,
    force: Annotated[bool, flag("--force", "Let --write replace a file.")] = False,
    picture: Annotated[
        Path | None,
        option("PNG", "Moments of an episode. (default: <id>_tried.png here)", "--out", "-o"),
    ] = None,
    seconds: Annotated[
        float,
        option("TIME", "About how long: 90, 90s, 2m.", "--time", parser=parse_duration),
    ] = 100.0,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Try an environment for two minutes; nothing is trained.

    Three simple drivers go through episodes. You learn what an assistant will see, how long a step
    and an episode take, what costs and how often, whether seeds are honest, whether a cost can be
    seen before it comes, how long a run would take here, and which spec to begin with. Of an
    environment that cannot be used as it is you learn which line it lacks.
    """
    _require_writable(write, picture, force)
    asked = _asked(env, set_ or ())
    if len(asked) > 1 and (write is not None or picture is not None):
        raise UsageError(
            f"'{env}' has {len(asked)} environments, and --write and --out name one file",
            "leave them out, or name one environment",
        )
    found: list[dict[str, Any]] = []
    failures: list[TaskError] = []
    for one in asked:
        try:
            found.append(_tried(one, seconds / len(asked), picture, write, json))
        except TaskError as error:
            failures.append(error)
            found.append({"task": one.name, "ok": False, "problem": error.message})
    if json:
        print_json(found)
    if failures:
        raise failures[0]


@dataclass(frozen=True)
class _Asked:
    """An environment that is to be tried."""

    name: str  # of the task
    entry: Mapping[str, Any]  # its settings, as an entry of `tasks`
    action_repeat: int | None
    is_open: bool  # whether settings may be added to it


def _asked(env: str, settings: tuple[str, ...] | list[str]) -> list[_Asked]:
    from wasp_cli.tasks.registry import TASKS, ForeignInfo, is_foreign

    if Path(env).suffix != SUFFIX:
        if settings:
            raise UsageError(
                "--set changes a spec, and this is none", "wasp try SPEC.yaml --set ..."
            )
        if not is_foreign(env):
            TASKS[env]  # raises UnknownName, with close names
            raise UsageError(
                f"'{env}' is a task of wasp itself", "wasp list tasks says what it is like"
            )
        return [_Asked(env, {"id": env}, None, True)]
    from wasp_cli.spec.load import load

    spec = load(spec_path(Path(env)), settings).spec
    spec.declare_tasks()
    foreign = [name for name in spec.tasks if isinstance(TASKS[name], ForeignInfo)]
    if not foreign:
        raise UsageError(f"'{env}' has no environment of others", "name a spec with one, or an id")
    asked = []
    for name in foreign:
        declaration = spec.environments.get(name)
        entry = {"id": name} if declaration is None else declaration.identity()
        asked.append(_Asked(name, entry, spec.repeat_of(name), False))
    return asked


def _require_writable(write: Path | None, picture: Path | None, force: bool) -> None:
    if write is not None and write.suffix != SUFFIX:
        raise UsageError(f"'{write}' is no name of a spec", f"it ends in {SUFFIX}")
    if write is not None and write.exists() and not force:
        raise UsageError(f"'{write}' is there", "--force replaces it")
    if picture is not None and picture.suffix.lower() != ".png":
        raise UsageError(f"'{picture}' is no name of a picture", "it ends in .png")
    for path in (write, picture):
        if path is not None and not path.parent.is_dir():
            raise UsageError(f"'{path.parent}' is no folder", "create it first")


def _tried(
    one: _Asked, seconds: float, picture: Path | None, write: Path | None, json: bool
) -> dict[str, Any]:
    """Try one environment. Prints what was found, unless it is returned for JSON.

    Raises:
        TaskError: it cannot be used, or nothing can be learned in it.
    """
    from wasp_cli.learning.trial import suggested_limit, try_environment
    from wasp_cli.plan.affordable import affordable_interactions
    from wasp_cli.plan.tried import Tried, keep
    from wasp_cli.run.cores import cores
    from wasp_cli.spec.starter import starter
    from wasp_cli.tasks.foreign.raw import raw

    # What it is by itself, and the settings with which it can be used.
    met = raw(one.name)
    lines = _raw_lines(met)
    entry, remarks = _usable(one, met, lines, json)

    # Episodes of simple drivers.
    trial = try_environment(one.name, seconds, one.action_repeat)
    entry["action_repeat"] = trial.action_repeat
    if one.is_open:
        limit = suggested_limit(trial.limit, trial.action_repeat)
        if limit < trial.limit:
            entry["limit"] = limit
            remarks["limit"] = f"300 decisions; it has {trial.limit} env steps"
    kept = Tried(trial.step_seconds, trial.bare_seconds, trial.typical_length)
    keep(one.name, kept)

    # A spec to start with, of a size that this machine can train.
    preset, minutes = _preset(entry, kept, remarks)
    interactions = affordable_interactions(preset, kept, entry, cores())
    text = starter(entry, preset, remarks, interactions)
    drawn = _drawn(trial, picture)
    if write is not None:
        write.write_text(text, encoding="utf-8")
    if not json:
        say(*lines, *_trial_lines(trial), *_estimate_lines(preset, minutes))
        if drawn is not None:
            say(f"{drawn}: written, {len(trial.frames)} moments as an assistant sees them")
        say(f"{write}: written" if write is not None else f"\nA spec to start with:\n\n{text}")
    if trial.findings.problems:
        message, hint = trial.findings.problems[0]
        raise TaskError(f"environment '{one.name}': {message}", hint)
    return _as_json(one, met, trial, preset, minutes, text, drawn)


def _usable(
    one: _Asked, met: Raw, lines: list[str], json: bool
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return an entry of `tasks` with which the environment can be used, and remarks on it: as it
    is, or with what its spaces and the names in its info suggest.

    Raises:
        TaskError: neither is enough.
    """
    from wasp_cli.tasks.declared import Declaration, declare
    from wasp_cli.tasks.foreign.examine import examine

    entry: dict[str, Any] = dict(one.entry)
    remarks: dict[str, str] = {}
    try:
        examine(one.name)
    except TaskError as error:
        if not one.is_open:
            raise
        suggested, remarks = _suggested(met)
        entry = {**entry, **suggested}
        try:
            declare(one.name, Declaration.model_validate(entry))
            examine(one.name)
        except TaskError as second:
            if not json:
                settings = [f"    {key}: {value}" for key, value in entry.items()]
                say(*lines, "It cannot be used as it is. As far as can be seen, write:", *settings)
            hint = second.hint
            if "cost" not in entry and "cost" not in met.entries:
                hint = _cost_hint(met)
            raise TaskError(second.message, hint) from error
    return entry, remarks


def _suggested(met: Raw) -> tuple[dict[str, Any], dict[str, str]]:
    """Settings for an environment, guessed from its spaces and the names in its info, and remarks
    on them.
    """
    from wasp_cli.tasks.foreign.raw import COSTS, SUCCESSES

    entry: dict[str, Any] = {}
    remarks: dict[str, str] = {}
    if _is_image(met.observation):
        entry["image"] = "observation"
    elif met.draws and not _is_vector(met.observation):
        entry["image"] = "render"
        entry["state"] = "observation"
    else:
        entry["image"] = "none"
        entry["state"] = "observation"
        if met.draws:
            remarks["image"] = "assistants see the vector; `render`: what the environment draws"
    if "cost" not in met.entries:
        costs = met.may_be(COSTS)
        if costs:
            entry["cost"] = f"info.{costs[0]}"
            remarks["cost"] = GUESSED
    if met.entries.keys().isdisjoint({"goals", "success", "is_success"}):
        successes = met.may_be(SUCCESSES)
        if successes:
            entry["success"] = f"info.{successes[0]}"
            remarks["success"] = GUESSED
    if met.seconds is None:
        entry["seconds"] = 0.1
        remarks["seconds"] = "of an env step: it does not say, so this is only a number"
    if met.limit is None:
        entry["limit"] = 200
        remarks["limit"] = "env steps: it has none"
    return entry, remarks


def _is_image(space: object) -> bool:
    shape = getattr(space, "shape", None) or ()
    return len(shape) in (2, 3) and sum(side >= SMALLEST_SIDE for side in shape) >= 2


def _is_vector(space: object) -> bool:
    return len(getattr(space, "shape", None) or ()) == 1


def _cost_hint(met: Raw) -> str:
    names = [f"info.{name}" for name, entry in met.entries.items() if entry.least is not None]
    from_info = f"a number of info ({', '.join(names[:8])}), " if names else ""
    return (
        f"say in the spec what should not happen: `cost:` {from_info}`terminated`, or "
        "`my_module:cost`, a function cost(env, action, info) that returns a number above 0 where "
        "something goes wrong"
    )


def _raw_lines(met: Raw) -> list[str]:
    """What the environment is by itself."""
    lines = [f"observation  {_short(met.observation)}", f"actions      {_short(met.action)}"]
    if not met.entries:
        return [*lines, "info         empty"]
    lines.append(f"info         as met in {met.steps} random env steps:")
    for entry in met.entries.values():
        span = "" if entry.least is None else f"  {entry.least:.4g} to {entry.most:.4g}"
        seldom = "" if entry.met == met.steps else f"  in {entry.met} steps"
        lines.append(f"  info.{entry.name}: {entry.kind}{span}{seldom}")
    return lines


def _short(space: object) -> str:
    text = " ".join(str(space).split())
    return text if len(text) <= 150 else text[:147] + "..."


def _trial_lines(trial: Trial) -> list[str]:
    """What the drivers met."""
    bare = 1000 * trial.bare_seconds
    whole = 1000 * trial.step_seconds
    sees = f"{trial.state_size} numbers"
    if trial.cameras:
        sees = f"{trial.cameras} image{'s' if trial.cameras > 1 else ''} of 64 x 64"
    decision = trial.action_repeat * trial.env_seconds
    share = ""
    if trial.cameras:
        share = f"; {trial.render_share:.0%} of it for the image ({bare:.3g} ms where nobody looks)"
    lines = [
        f"sees         {sees}",
        f"a step       {whole:.3g} ms{share}",
        f"a decision   {trial.action_repeat} env steps, {decision:.3g} s; at most "
        f"{-(-trial.limit // trial.action_repeat)} in an episode",
    ]
    for drives in trial.drives:
        lengths = "no episode ended"
        if drives.lengths:
            low = min(drives.lengths)
            high = max(drives.lengths)
            mean = sum(drives.lengths) / len(drives.lengths)
            returns = sum(drives.returns) / len(drives.returns)
            lengths = (
                f"{len(drives.lengths)} episodes of {mean:.0f} env steps ({low} to {high}), "
                f"return {returns:.3g}"
            )
        sources = ""
        if len(drives.sources) > 1:
            rates = (
                f"{name} {1000 * n / max(drives.steps, 1):.3g}"
                for name, n in drives.sources.items()
            )
            sources = f" ({', '.join(rates)})"
        cost = f"cost {drives.cost_per_1000:.3g} of 1000 env steps{sources}"
        lines.append(f"{drives.driver:<12} {lengths}; {cost}")
    lines.append("seeds        honest: an episode depends on its seed and its actions alone")
    lines.append(f"foresight    {_sight_text(trial)}")
    lines += [f"  {note}" for note in trial.findings.notes]
    return lines


def _sight_text(trial: Trial) -> str:
    sight = trial.sight
    if sight.auroc is None or sight.low is None or sight.high is None:
        return (
            f"cannot be told: a cost follows within a second in {sight.costly} of {sight.samples} "
            "moments, in too few episodes; try longer: --time 5m"
        )
    figures = f"AUROC {sight.auroc:.2f}, {sight.low:.2f} to {sight.high:.2f}; chance is .5"
    of = f"{sight.costly} of {sight.samples} moments before a cost"
    if sight.is_seen:
        return f"a cost can be seen a second before it comes ({figures}; {of})"
    return (
        f"a linear probe sees no cost a second before it comes ({figures}; {of}): what costs may "
        "be too small or hidden at 64 x 64"
    )


def _estimate_lines(preset: str, minutes: Mapping[str, float]) -> list[str]:
    figures = ", ".join(f"{name} about {duration(60 * needed)}" for name, needed in minutes.items())
    return [f"a run        {figures} on this machine; suggested: preset {preset}"]


def _preset(
    entry: Mapping[str, Any], kept: Tried, remarks: Mapping[str, str]
) -> tuple[str, dict[str, float]]:
    """Return the largest preset whose chain takes no longer than `MOST_SECONDS` here, and the
    minutes of each.
    """
    import tempfile

    from wasp_cli.plan.affordable import affordable_interactions
    from wasp_cli.plan.planned import planned
    from wasp_cli.plan.tried import keep
    from wasp_cli.run.cores import cores
    from wasp_cli.spec.load import load
    from wasp_cli.spec.starter import starter

    minutes: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            path = Path(folder) / f"{preset}{SUFFIX}"
            interactions = affordable_interactions(preset, kept, entry, cores())
            path.write_text(starter(entry, preset, remarks, interactions), encoding="utf-8")
            loaded = load(path)
            # The spec may have other settings of the environment than those it was tried with.
            loaded.spec.declare_tasks()
            keep(loaded.spec.tasks[0], kept)
            plan = planned(loaded, Path(folder) / "results", reuse="none")
            minutes[preset] = plan.estimate(cores())[0] / 60.0
    fits = [preset for preset in PRESETS if 60.0 * minutes[preset] <= MOST_SECONDS]
    return (fits or PRESETS[:1])[-1], minutes


def _drawn(trial: Trial, picture: Path | None) -> Path | None:
    """Draw moments of an episode; None where assistants see no image."""
    if not trial.frames:
        return None
    from wasp_cli.tasks.strip import Moment, draw_strip

    usable = "".join(one if one.isalnum() or one in "._-" else "-" for one in trial.name)
    path = picture or Path(f"{usable.lstrip('.-')}_tried.png")
    moments = []
    for frame in trial.frames:
        caption = f"env step {frame.env_step}"
        if frame.costs:
            caption += ", costs"
        moments.append(Moment(frame.pixels, caption, frame.costs))
    return draw_strip(f"{trial.name}: what an assistant sees", moments, path)


def _as_json(
    one: _Asked,
    met: Raw,
    trial: Trial,
    preset: str,
    minutes: Mapping[str, float],
    text: str,
    drawn: Path | None,
) -> dict[str, Any]:
    from dataclasses import asdict

    return {
        "task": one.name,
        "ok": True,
        "info": [asdict(entry) for entry in met.entries.values()],
        "cameras": trial.cameras,
        "state_size": trial.state_size,
        "step_ms": 1000 * trial.step_seconds,
        "render_share": trial.render_share,
        "limit": trial.limit,
        "action_repeat": trial.action_repeat,
        "drivers": [{**asdict(each), "cost_per_1000": each.cost_per_1000} for each in trial.drives],
        "foresight": asdict(trial.sight),
        "notes": trial.findings.notes,
        "preset": preset,
        "minutes": dict(minutes),
        "spec": text,
        "picture": None if drawn is None else str(drawn),
    }
