"""How a function becomes a command of `wasp`: its options, its help, and how an expected error ends
it.

And the options that commands share: single ones, groups of them, which a command takes as one
parameter, and what a shell offers. What is offered is imported when it is asked for: every command
loads this module. Names in registries need neither torch nor MuJoCo. A plugin that does not load
offers nothing, instead of a traceback.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from glob import escape, glob
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from wasp_cli.console import INTERRUPTED, end_in_order, report_error, silence
from wasp_cli.errors import UnknownName, UsageError, WaspError, refusal
from wasp_cli.registry import load_target
from wasp_cli.spec.shipped import shipped_names

if TYPE_CHECKING:
    from wasp_cli.run.session import RunOptions
    from wasp_cli.spec.load import Loaded


PIPE_CLOSED = 141
# all commands, as `wasp --help` lists them: each with the first sentence of its docstring
GROUPS = {
    "Start": ("run", "report", "view", "drive"),
    "Prepare": ("list", "draw", "try", "init", "check", "schema", "clone", "plan"),
    "Compare": ("sweep", "ablate", "compare"),
    "Follow": ("status", "logs"),
    "Look into": ("show", "explain", "replay", "note", "export"),
    "Maintain": ("publish", "verify", "gc", "doctor"),
}

Command = TypeVar("Command", bound=Callable[..., None])


class _Group(TyperGroup):
    """All commands, whose help fits on one screen; that of a command is Typer's."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args and not ctx.resilient_parsing:
            typer.echo(self.get_help(ctx))
            ctx.exit(2)
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from rich.console import Console
        from rich.table import Table

        table = Table.grid(padding=(0, 2, 0, 0))
        for style in ("dim", "bold cyan", ""):
            table.add_column(style=style, no_wrap=bool(style))
        for title, names in GROUPS.items():
            table.add_row()
            for name in names:
                table.add_row(
                    title if name == names[0] else "",
                    name,
                    self.commands[name].get_short_help_str(limit=1000),
                )
        options = ", ".join(name for parameter in self.get_params(ctx) for name in parameter.opts)
        console = Console(highlight=False)
        with console.capture() as shown:
            console.print(
                self.get_usage(ctx),
                f"\n{self.help}",
                table,
                f"\nOptions: {options}",
                sep="\n",
                markup=False,
            )
        formatter.write(shown.get())


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:
        params: list[Any] = super().get_params(ctx)
        for param in params:
            if getattr(param, "is_flag", False) and param.metavar is None:
                param.metavar = ""
        return params


HELP = """\
Run experiments in shared autonomy. A spec says which; results go to results/.
Start here: wasp run quickstart, then: wasp report results/
Drive: wasp drive race1. Check: wasp verify. Your own: docs/extending.md"""
app = typer.Typer(
    name="wasp", cls=_Group, help=HELP, rich_markup_mode="rich", pretty_exceptions_enable=False
)


def command(
    *examples: str, codes: str = "", name: str | None = None
) -> Callable[[Command], Command]:
    """Make a function a command: its docstring is the help, its parameters are the options.

    A parameter whose type is a dataclass stands for the fields of it, so that commands share
    options.
    """
    shown = "   ·   ".join(f"[bold]{example}[/]" for example in examples)
    epilog = f"{shown}\n\nExit codes: {codes}." if codes else shown

    def registered(function: Command) -> Command:
        app.command(name, cls=_Command, epilog=epilog)(_expecting_errors(_flat(function)))
        return function

    return registered


def _flat(function: Callable[..., None]) -> Callable[..., None]:
    """Take the fields of parameters that are dataclasses as parameters of their own."""
    hints = get_type_hints(function, include_extras=True)
    shared: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(function).parameters.values():
        group = shared.get(parameter.name)
        types = get_type_hints(group, include_extras=True) if group else hints
        for option in inspect.signature(group).parameters.values() if group else [parameter]:
            parameters.append(
                option.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=types[option.name])
            )

    @functools.wraps(function)
    def flat(**values: Any) -> None:
        for name, kind in shared.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        function(**values)

    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    # Help is the docstring, and its paragraphs are wrapped to the terminal, not to the source.
    flat.__doc__ = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(function.__doc__ or ""))
    return flat


def _expecting_errors(function: Callable[..., None]) -> Callable[..., None]:
    """Show an expected error as one message and end with its exit code; everything else is a bug
    and keeps its traceback.

    Expected are also the refusals of the system: a full disk, a folder without permission, a broken
    pipe.
    """

    @functools.wraps(function)
    def wrapped(**values: Any) -> None:
        try:
            end_in_order()
            function(**values)
            sys.stdout.flush()
        except (WaspError, OSError) as error:
            if isinstance(error, OSError):
                silence(sys.stdout)  # what it still holds would raise again at the end
            if os.environ.get("WASP_DEBUG"):
                raise
            if isinstance(error, BrokenPipeError):
                raise typer.Exit(PIPE_CLOSED) from None
            expected = error if isinstance(error, WaspError) else refusal(error)
            report_error(expected)
            raise typer.Exit(expected.exit_code) from None
        except (KeyboardInterrupt, typer.Abort):  # the latter where a question was asked
            if os.environ.get("WASP_DEBUG"):
                raise
            print("interrupted", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None

    return wrapped


def print_json(value: Any) -> None:
    json.dump(value, sys.stdout, indent=1)
    sys.stdout.write("\n")


RESULTS = Path("results")
LOCAL = "loky"  # the backend of this machine
SCHEDULER_VARIABLE = "WASP_SCHEDULER"
Completion = Callable[..., list[str]] | None


def spec_names(incomplete: str) -> list[str]:
    """List the YAML files of the typed folder, and without one also those of `specs/` and the
    names that come with the package.
    """
    typed = incomplete[: incomplete.rfind("/") + 1]
    folders = [typed] if typed else ["", "specs/"]
    files = [name for folder in folders for name in sorted(glob(f"{escape(folder)}*.yaml"))]
    return files if typed else [*files, *shipped_names()]


def _offered(target: str, ending: str = "") -> Callable[[], list[str]]:
    """What offers the names in something that is imported when it is asked; none where a plugin
    does not load.
    """

    def offered() -> list[str]:
        with suppress(WaspError):
            names = load_target(target)
            return [f"{name}{ending}" for name in (names() if callable(names) else names)]
        return []

    return offered


task_names = _offered("wasp_cli.tasks.registry:TASKS")
method_names = _offered("wasp_cli.methods.registry:METHODS")
variant_names = _offered("wasp_cli.spec.names:assistant_variants")
preset_names = _offered("wasp_cli.spec.presets:PRESETS")
setting_names = _offered("wasp_cli.spec.hints:settings", "=")  # the keys of `--set` and `--vary`


def require_extra(extra: str, *packages: str) -> None:
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise UsageError(
                f"this command needs packages that are not here: {error}",
                f"pip install 'wasp-cli[{extra}]'",
            ) from error


def parse_folder(value: str | Path) -> Path:
    """Return a folder as it was typed; refuse an empty name, and one that no report can hold."""
    # an unset variable of a script; Path("") would be the current folder
    if not str(value).strip():
        raise typer.BadParameter("the name of the folder is empty")
    try:
        place = os.path.abspath(value)
    except OSError as error:
        raise typer.BadParameter(
            "the current folder is not there any more; change to another one"
        ) from error
    if os.fsencode(place).decode(errors="replace") != place:
        raise typer.BadParameter(f"{place!r} has bytes that are not UTF-8; rename the folder")
    return Path(value)


LONGEST = 1e8  # seconds of a duration: three years, which every clock can add


def parse_duration(text: str | float) -> float:
    """Return the seconds of a duration as it is typed: `90`, `90s`, `30m`, `2h`."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([smh]?)\s*", str(text))
    seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
    if not 0 < seconds < LONGEST:
        raise typer.BadParameter(
            f"invalid duration '{text}'; write seconds (90), minutes (30m) or hours (2h)"
        )
    return seconds


def option(metavar: str, text: str, *names: str, among: Completion = None, **more: Any) -> Any:
    """Declare an option that takes a value. Without names it has that of its parameter; a
    default that the text explains is not shown.
    """
    return typer.Option(
        *names,
        metavar=metavar,
        help=text,
        show_default="(default: " not in text,
        autocompletion=among,
        **more,
    )


def argument(metavar: str, text: str, among: Completion = None, **more: Any) -> Any:
    return typer.Argument(
        metavar=metavar,
        help=text,
        show_default="(default: " not in text,
        autocompletion=among,
        **more,
    )


def flag(name: str, text: str, *names: str, **more: Any) -> Any:
    return typer.Option(name, *names, help=text, **more)


directory = functools.partial(option, "DIR", parser=parse_folder)

ResultsOption = Annotated[Path, directory("The results folder.", "--results")]
ResultsArgument = Annotated[
    Path | None,
    argument("[DIR]", "The results folder. (default: what --results says)", parser=parse_folder),
]
NodeArgument = Annotated[
    str, argument("NODE", "A label ('goal1 s1 world_model'), or the beginning of a key.")
]
StoredCellArgument = Annotated[
    str,
    argument(
        "CELL",
        "A label ('goal1 s1 wasp laggy=0.7'), the beginning of a key, or an episodes.parquet.",
    ),
]
EpisodeOption = Annotated[int, option("E", "The episode, counted from 0.", "--episode", "-e")]
MethodOption = Annotated[
    list[str] | None,
    option(
        "NAME", "Only this method of the spec (repeatable).", "--method", "-m", among=method_names
    ),
]
PresetOption = Annotated[
    str | None,
    option(
        "NAME",
        "Sizes and budgets, in place of the spec's own. (default: what the spec says)",
        "--preset",
        among=preset_names,
    ),
]
RunOption = Annotated[
    str | None,
    option(
        "ID",
        "A folder name in runs/, its end, or the name of a spec. (default: the newest)",
        "--run",
    ),
]
JobsOption = Annotated[
    int | None,
    option(
        "N",
        "At most N workers, which share N cores; 0: one, in this process. (default: all cores)",
        "--jobs",
        "-j",
        min=0,
    ),
]
SetOption = Annotated[
    list[str] | None,
    option("KEY=VALUE", "Override a value of the spec (repeatable).", "--set", among=setting_names),
]
SelectOption = Annotated[
    list[str] | None,
    option(
        "FIELD=VALUE,...",
        "Only these: 'task=race1,method=wasp|ida', 'stage=world_model' (repeatable).",
        "--select",
    ),
]
ReuseOption = Annotated[
    str | None,
    option(
        "none|published|DIR",
        "Use results of results/published, or of DIR. (default: what the spec says)",
        "--reuse",
    ),
]
JsonOption = Annotated[bool, flag("--json", "Print JSON.")]
PortOption = Annotated[int, option("N", "Port on 127.0.0.1; 0: any free one.", min=0, max=65535)]
BrowserOption = Annotated[
    bool, flag("--browser/--no-browser", "Open a browser, or only print the address.")
]


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A results folder, which a command takes as its argument or as `--results`."""

    folder: ResultsArgument = None
    results: ResultsOption = RESULTS

    @property
    def path(self) -> Path:
        if self.folder is not None and self.results not in (self.folder, RESULTS):
            raise UsageError(
                f"two results folders: '{self.folder}' and --results '{self.results}'",
                "name one of them",
            )
        return self.results if self.folder is None else self.folder


@dataclass(frozen=True, kw_only=True)
class Whereabouts:
    run: RunOption = None
    results: ResultsOption = RESULTS


@dataclass(frozen=True, kw_only=True)
class Sized:
    task: Annotated[
        list[str] | None,
        option(
            "TASK", "Only this task of the spec (repeatable).", "--task", "-t", among=task_names
        ),
    ] = None
    preset: PresetOption = None
    set_: SetOption = None
    results: ResultsOption = RESULTS

    @property
    def settings(self) -> list[str]:
        from wasp_cli.spec.load import sized

        return sized(self.preset, self.set_)


@dataclass(frozen=True, kw_only=True)
class SizedSpec(Sized):
    spec: Annotated[
        Path, argument("SPEC", "A YAML file, or a name such as quickstart.", among=spec_names)
    ]

    def load(self) -> Loaded:
        from wasp_cli.spec.load import load, restricted

        return restricted(load(self.spec, self.settings), self.task)


@dataclass(frozen=True, kw_only=True)
class SelectedSpec(SizedSpec):
    method: MethodOption = None
    select: SelectOption = None
    limit: Annotated[
        int | None,
        option("N", "Only the first N episodes of each cell: a look before the whole.", min=1),
    ] = None
    failed: Annotated[
        bool, flag("--failed", "Only nodes that failed before, and nodes that wait for them.")
    ] = False
    reuse: ReuseOption = None

    def load(self) -> Loaded:
        """Load the spec that is meant; `select` and `failed` say which of its cells."""
        from wasp_cli.spec.load import limited, load, restricted

        return limited(
            restricted(load(self.spec, self.settings), self.task, self.method), self.limit
        )


@dataclass(frozen=True, kw_only=True)
class Work:
    dry_run: Annotated[
        bool, flag("--dry-run", "Show the plan, as wasp plan does, and run nothing.")
    ] = False
    jobs: JobsOption = None
    timeout: Annotated[
        float | None,
        option(
            "TIME", "Time limit of each node: 90, 30m, 2h. (default: none)", parser=parse_duration
        ),
    ] = None
    retries: Annotated[
        int, option("N", "Retries of a node that fails for a reason which may pass.", min=0, max=9)
    ] = 0
    strict: Annotated[
        bool,
        flag("--strict", "Stop where a stage is not good enough for what builds on it."),
    ] = False
    backend: Annotated[
        str, option("NAME", "Workers: loky (local), dask or slurm.", envvar="WASP_BACKEND")
    ] = LOCAL
    scheduler: Annotated[
        str | None,
        option(
            "URL",
            "Address of dask; of slurm, options of sbatch.",
            envvar=SCHEDULER_VARIABLE,
        ),
    ] = None

    def options(self) -> RunOptions:
        from wasp_cli.run.cores import cores
        from wasp_cli.run.pools.choice import BACKENDS
        from wasp_cli.run.session import RunOptions

        if self.backend not in BACKENDS:  # also told where nothing is going to run
            raise UnknownName("backend", self.backend, BACKENDS)
        jobs = cores() if self.jobs is None else self.jobs
        scheduler = self.scheduler
        if self.backend == LOCAL and scheduler == os.environ.get(SCHEDULER_VARIABLE):
            scheduler = None  # the variable is for the backends that have one
        return RunOptions(
            jobs,
            self.timeout,
            self.retries,
            self.backend,
            scheduler,
            reports=True,
            strict=self.strict,
        )
