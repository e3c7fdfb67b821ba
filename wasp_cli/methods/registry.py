"""The assistants by name. To add one, write a class and its configuration, and add one entry here
or an entry point. No key covers this module.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from wasp_cli.config import Config
from wasp_cli.errors import WaspError, did_you_mean
from wasp_cli.own import misspelt
from wasp_cli.registry import Registry, import_here, load_target, remedy, require_spelling


@dataclass(frozen=True)
class Signal:
    """What a method decides by: the numbers that its records hold as `signal`."""

    name: str = "signal"  # short name, a symbol or a word
    meaning: str = "the method's own decision value"
    """What a value is, with its unit, as it ends a sentence: `costly decisions expected of the
    command`.
    """
    limit: str = ""
    """What a value must exceed for an intervention: the name of a threshold of the rows (`tau_c`,
    `tau_r`, `tau_q`), or of a field of the configuration whose value is a number. Empty where there
    is no such limit.
    """


@dataclass(frozen=True)
class Knob:
    """The one number that decides how often a method acts, and the values of it that the stage
    `operating` tries.
    """

    symbol: str  # its name in tables: `ratio`, `tau_r, times`
    turns: Literal["setting", "threshold", "margin", "correction"]
    """What a value of it is:

    - `setting`: the value of the field `name` of the configuration,
    - `threshold`: a multiple of the calibrated threshold `name`,
    - `margin`: the threshold `name`, as a multiple of the calibrated `margin_p95`,
    - `correction`: a multiple of every correction.
    """
    name: str  # of the field or of the threshold; empty for `correction`
    values: tuple[float, ...]
    written: tuple[str, ...] = ()
    """Fields of the configuration that set the same by hand. Where a spec writes one of them, the
    method keeps what is written, and nothing is tried.
    """

    def __post_init__(self) -> None:
        """Raise a ValueError where there is no value, or one twice."""
        if not self.values or len(set(self.values)) < len(self.values):
            raise ValueError(f"the knob '{self.symbol}' needs values, and each of them once")


@dataclass(frozen=True)
class MethodInfo:
    """What is known of an assistant without importing torch."""

    name: str  # in specs
    title: str  # in tables
    target: str  # import string of what makes the `Assistant` from its configuration and `Parts`
    config: str  # import string of its config model
    # stage kinds whose artifacts it reads, besides `world_model` and `policies`
    needs: tuple[str, ...] = ()
    needs_with: tuple[tuple[str, str, str], ...] = ()
    """Further stage kinds that it reads only under a setting: (field of its configuration, value,
    stage kind).
    """
    # whether its thresholds come from held-out episodes of the unimpaired expert (stage
    # `calibration`)
    calibrated: bool = False
    # false for a reference row: it runs the unimpaired operator, once for all variants
    impaired: bool = True
    intervenes: bool = True
    """False where there are no interventions: the operator's command is always executed, or nobody
    is at the controls.
    """
    attended: bool = True
    """False where nobody is at the controls: no command is read, so that the distance to it means
    nothing, and tables leave it out.
    """
    variants: Mapping[str, str] = field(default_factory=lambda: {"full": "full"})
    """Ablations, each with its title in tables: values of the field `variant` of the
    configuration. `full` is the whole method.
    """
    # a method: the claims of a paper are judged a second time with this one in its place
    instead_of: str = ""
    # variants whose thresholds have another unit, so that each is calibrated by itself
    own_thresholds: tuple[str, ...] = ()
    # how it decides, in a sentence or two; `wasp explain`, the schema and the report print it
    rule: str = ""
    signal: Signal = Signal()  # what it decides by, where its records hold a signal
    # how often it acts; None: it has one setting, which helps or does not
    knob: Knob | None = None

    def needs_of(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the stage kinds that it reads under a configuration (resolved, as JSON values)."""
        kinds = list(self.needs)
        for setting, value, kind in self.needs_with:
            if config.get(setting) == value:
                kinds.append(kind)
        return tuple(kinds)

    def config_model(self) -> type[Config]:
        """Import and return the model of its configuration.

        Raises:
            WaspError: it cannot be imported, or is no `Config`.
        """
        model = load_target(self.config, f"the configuration of the method '{self.name}'")
        if not (isinstance(model, type) and issubclass(model, Config)):
            raise WaspError(
                f"'{self.config}' of the method '{self.name}' is no configuration",
                "derive it from wasp_cli.config.Config",
            )
        return model


class OwnMethod(MethodInfo):
    """An assistant of your own, `module:Class`, without a package: a class in a file of the folder
    where `wasp` runs.

    It has no settings: its constants stand in the file, whose source is in the key. The class may
    have an attribute `needs`, a tuple of stage kinds.
    """

    @classmethod
    def named(cls, name: str) -> OwnMethod:
        """Describe it without importing it."""
        module, _, title = name.partition(":")
        return cls(
            name,
            f"{title} ({module})",
            name,
            "wasp_cli.config:Config",
            rule=f"{title} is a class of the module {module}.",
        )

    def needs_of(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the stage kinds of the class's `needs`; none where the class is not imported."""
        # A spec that is to run has imported the class. Reports of somebody else's results import
        # nothing.
        module, _, name = self.target.partition(":")
        assistant = getattr(sys.modules.get(module), name, None)
        return tuple(getattr(assistant, "needs", ()))

    def load(self) -> Any:
        """Import and return the class.

        Raises:
            WaspError: the module has no such class, or the class lacks a method of an assistant.
        """
        module, _, name = self.target.partition(":")
        imported = import_here(module)
        assistant = getattr(imported, name, None)
        if assistant is None:
            classes = [key for key, value in vars(imported).items() if isinstance(value, type)]
            hint = did_you_mean(name, classes, f"write a class {name} in it")
            raise WaspError(
                f"the assistant '{self.name}' is not in {imported}",
                remedy(module, hint.replace(" '", f" '{module}:")),
            )
        missing = [
            method
            for method in ("reset", "decide")
            if not callable(getattr(assistant, method, None))
        ]
        if missing:
            raise WaspError(
                f"the assistant '{self.name}' has no {' and no '.join(missing)}",
                "wasp_cli.methods.base.Assistant says what an assistant has",
            )
        return assistant


class MethodRegistry(Registry[MethodInfo]):
    """The registered methods. A class of your own resolves too, but is not listed."""

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or (isinstance(name, str) and is_own(name))

    def __getitem__(self, name: str) -> MethodInfo:
        require_spelling("method", name)
        if is_own(name):
            return OwnMethod.named(name)
        return super().__getitem__(name)

    def load(self, name: str) -> Any:
        """Import and return what makes the assistant of that name."""
        info = self[name]
        if isinstance(info, OwnMethod):
            return info.load()
        return super().load(name)


_OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_own(name: str) -> bool:
    """Tell whether a name has the form of a class of your own: `module:Class`."""
    return _OWN.fullmatch(name) is not None and misspelt(name) is None


_VOTE = Signal(
    "vote",
    "on a scale from -1 (no member of the ensemble prefers the copilot's action by more "
    "than τ_Q) to 1 (all do)",
    "vote",
)
_TIMES_MARGIN = Knob("tau_Q, times", "margin", "tau_q", (0.0, 0.5, 1.0, 2.0, 4.0), ("quantile",))
_TIMES_COST = Knob(
    "tau_c, times", "threshold", "tau_c", (0.25, 0.5, 1.0, 2.0, 4.0), ("tau_c", "quantile")
)
_TIMES_GAMMA = Knob(
    "gamma, times", "threshold", "gamma", (0.25, 0.5, 0.75, 0.9, 1.0), ("gamma", "quantile")
)
_TIMES_GAIN = (0.0, 0.25, 0.5, 1.0, 2.0)  # of tau_r
_ABLATIONS: Mapping[str, str] = {
    "full": "full",
    "safety-only": "safety gate only",
    "task-only": "task gate only",
    "no-case2": "no Case II recovery",
    "no-rollout": "no rollouts (H = 1)",
}
"""Of Table 2."""

METHODS: Registry[MethodInfo] = MethodRegistry(
    "method",
    "wasp.methods",
    (
        MethodInfo(
            "human",
            "Human-only",
            "wasp_cli.methods.human:HumanOnly",
            "wasp_cli.methods.configs:HumanConfig",
            intervenes=False,
            rule="Human-only never intervenes: the command is executed as it is.",
        ),
        MethodInfo(
            "ida",
            "IDA",
            "wasp_cli.methods.ida:IDA",
            "wasp_cli.methods.configs:IDAConfig",
            ("ida_q",),
            needs_with=(("copilot", "diffusion", "denoiser"),),
            calibrated=True,
            rule="IDA replaces the command by its copilot's action (the expert's, unless the "
            "spec says otherwise) where an ensemble of Q functions votes for it.",
            signal=_VOTE,
            knob=_TIMES_MARGIN,
        ),
        MethodInfo(
            "diffusion",
            "Diffusion",
            "wasp_cli.methods.diffusion:Diffusion",
            "wasp_cli.methods.configs:DiffusionConfig",
            ("denoiser",),
            rule="Diffusion has no gate: every command is blurred with noise and denoised "
            "towards what an expert would do.",
            knob=Knob("ratio", "setting", "ratio", (0.1, 0.2, 0.4, 0.6, 0.8), ("ratio",)),
        ),
        MethodInfo(
            "saferl",
            "SafeRL-Res",
            "wasp_cli.methods.saferl:SafeRLRes",
            "wasp_cli.methods.configs:SafeRLConfig",
            ("residual",),
            rule="SafeRL-Res has no gate: a trained policy adds its correction to every command.",
            knob=Knob("correction, times", "correction", "", (0.25, 0.5, 0.75, 1.0, 1.5)),
        ),
        MethodInfo(
            "wasp",
            "WASP",
            "wasp_cli.methods.wasp.assistant:wasp",
            "wasp_cli.methods.configs:WASPConfig",
            ("critics",),
            needs_with=(("adversary", "lucid", "adversary"),),
            calibrated=True,
            variants=_ABLATIONS,
            own_thresholds=("no-rollout",),
            rule="WASP corrects the command if the command, followed by the expert, is "
            "predicted to cost more than τ_c, or else if a safe correction is predicted to gain "
            "more return than τ_r.",
            knob=Knob("tau_r, times", "threshold", "tau_r", _TIMES_GAIN, ("tau_r", "tau_r_share")),
        ),
        MethodInfo(
            "printed",
            "WASP (as printed)",
            "wasp_cli.methods.wasp.printed:printed",
            "wasp_cli.methods.configs:PrintedConfig",
            ("critics",),
            calibrated=True,
            variants=_ABLATIONS,
            instead_of="wasp",
            own_thresholds=("no-rollout",),
            rule="WASP as printed imagines the operator's own rule: it plans a residual where "
            "the imagined cost exceeds τ_c, or else where the best of random plans gains more "
            "return than τ_r.",
            knob=Knob(
                # not tau_c: an assistant should not buy return with what its safety gate lets pass
                "tau_r, times",
                "threshold",
                "tau_r",
                _TIMES_GAIN,
                ("tau_r", "tau_r_quantile"),
            ),
        ),
        MethodInfo(
            "ida-guarded",
            "IDA + safety gate",
            "wasp_cli.methods.guarded:GuardedIDA",
            "wasp_cli.methods.configs:GuardedIDAConfig",
            ("ida_q", "critics"),
            calibrated=True,
            rule="IDA decides about the task; if its action, followed by the expert, is "
            "predicted to cost more than τ_c, WASP's safety gate corrects it.",
            signal=_VOTE,
            knob=_TIMES_MARGIN,
        ),
        MethodInfo(
            "ida-least",
            "IDA, least correction",
            "wasp_cli.methods.least:LeastIDA",
            "wasp_cli.methods.configs:IDAConfig",
            ("ida_q",),
            calibrated=True,
            rule="IDA, but of all actions with the force of its copilot's the one closest to "
            "the command is executed.",
            signal=_VOTE,
            knob=_TIMES_MARGIN,
        ),
        MethodInfo(
            "expert",
            "Expert",
            "wasp_cli.methods.human:HumanOnly",
            "wasp_cli.methods.configs:HumanConfig",
            impaired=False,
            intervenes=False,
            rule="The unimpaired operator without assistance: the command is executed as it is.",
        ),
        MethodInfo(
            "filter",
            "Safety filter",
            "wasp_cli.methods.filter:SafetyFilter",
            "wasp_cli.methods.configs:FilterConfig",
            ("critics",),
            calibrated=True,
            rule="The safety filter looks one imagined step ahead: where that step and V_c "
            "behind it cost more than τ_c, it makes the least correction towards the safest "
            "action that brings the cost below.",
            signal=Signal(
                "Q_c", "costly decisions to be expected of the command, discounted", "tau_c"
            ),
            knob=_TIMES_COST,
        ),
        MethodInfo(
            "mpmi",
            "MPMI",
            "wasp_cli.methods.mpmi:MPMI",
            "wasp_cli.methods.configs:MPMIConfig",
            calibrated=True,
            rule="MPMI imagines that inputs are held over the horizon: where the command costs "
            "more than τ_c, the nearest input that costs no more is executed, or the command if "
            "there is none.",
            signal=Signal(
                "G_c", "costly decisions to be expected of holding the command, discounted", "tau_c"
            ),
            knob=_TIMES_COST,
        ),
        MethodInfo(
            "planner",
            "Planner alone",
            "wasp_cli.methods.planner:Planner",
            "wasp_cli.methods.configs:PlannerConfig",
            ("critics",),
            impaired=False,
            intervenes=False,
            attended=False,
            rule="The planner alone is WASP's search with nobody at the controls: at every "
            "decision it executes the best plan of at most τ_c expected cost, where that gains "
            "τ_r over the expert's actions or these cost more than τ_c.",
            signal=Signal("G_c", "costly decisions to be expected of the plan, discounted"),
        ),
        MethodInfo(
            "reach",
            "Reachability filter",
            "wasp_cli.methods.reach:ReachabilityFilter",
            "wasp_cli.methods.configs:ReachConfig",
            ("reachability",),
            calibrated=True,
            rule="The reachability filter keeps the command where its learned safety value Q is "
            "at least γ times V, that of the safest action; else it executes the nearest "
            "action of which that holds, or else the safest.",
            signal=Signal(
                "γ V - Q",
                "how far the safety value of the command falls short of γ times the safest "
                "action's; above 0 it intervenes",
            ),
            knob=_TIMES_GAMMA,
        ),
        MethodInfo(
            "qcbf",
            "Q-CBF filter",
            "wasp_cli.methods.qcbf:QCBFFilter",
            "wasp_cli.methods.configs:QCBFConfig",
            ("fallback",),
            calibrated=True,
            rule="The Q-CBF filter keeps the command where its learned safety value Q is at least "
            "γ times V, that of a learned fallback policy; else it executes the nearest "
            "action of which that holds, or else the fallback's.",
            signal=Signal(
                "γ V - Q",
                "how far the safety value of the command falls short of γ times the fallback's; "
                "above 0 it intervenes",
            ),
            knob=_TIMES_GAMMA,
        ),
        MethodInfo(
            "csa",
            "CSA",
            "wasp_cli.methods.csa:CSA",
            "wasp_cli.methods.configs:CSAConfig",
            ("consistency",),
            rule="CSA has no gate: every command is treated as a noisy expert action and "
            "denoised in one step, without a draw.",
            knob=Knob("ratio", "setting", "ratio", (0.1, 0.2, 0.4, 0.55, 0.69), ("ratio",)),
        ),
    ),
)
