"""What is every part of a training worth? Print the table of docs/learning.md from what is
published.

python docs/examples/trained.py        the parts of specs/field.yaml
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[2]
TASKS = {"race1": "Race1", "formula1": "FormulaOne1", "goal1": "Goal1"}
STEPS = (1, 5, 10, 15)
Parts = Mapping[str, Mapping[str, Any]]
"""Of one task: what the manifest of each part says in short, by stage; `acceptance`: what the
expert reached on fresh layouts.
"""


def part(number: float | None) -> str:
    """Write a share as docs do: without its zero."""
    return (
        "-"
        if number is None
        else f"{number:.2f}".replace("0.", ".", 1)
        if 0 <= number < 1
        else f"{number:.2f}"
    )


def steps(parts: Parts, name: str) -> str:
    """Write a number of the diagnostics at every imagined step."""
    return " ".join(part(parts["diagnostics"][f"{name}@{k}"]) for k in STEPS)


def reached(numbers: Mapping[str, Any]) -> str:
    """Write return / cost."""
    return f"{numbers['return']:.1f} / {numbers['cost']:.1f}"


ROWS: Mapping[str, Callable[[Parts], str]] = {
    "expert on 256 fresh layouts: return / cost, success": lambda p: (
        f"{reached(p['acceptance'])}, {100 * p['acceptance']['success']:.0f} %"
    ),
    "latent expert: return / cost": lambda p: reached(p["policies"]),
    "privileged expert, same 48 episodes": lambda p: (
        f"{p['policies']['privileged_return']:.1f} / {p['policies']['privileged_cost']:.1f}"
    ),
    "cost AUPRC at step 1, 5, 10, 15": lambda p: steps(p, "auprc"),
    "persistence": lambda p: steps(p, "persistence"),
    "base rate": lambda p: steps(p, "base"),
    "predicted / base": lambda p: steps(p, "predicted_over_base"),
    "recall at 10 % false alarms": lambda p: steps(p, "recall"),
    "operators not in the dataset: AUPRC": lambda p: steps(p, "unseen_auprc"),
    "reward R2": lambda p: steps(p, "reward_r2"),
    "image error at step 15 / that of a copy": lambda p: part(
        p["diagnostics"]["image_over_copy@15"]
    ),
    "readout of the latent, R2: all, goal, things": lambda p: " ".join(
        part(p["diagnostics"].get(f"readout_{group}")) for group in ("all", "goal", "things")
    ),
    "V_r: predicted / real, rank correlation": lambda p: (
        f"{part(p['critics']['predicted_over_real_r'])}, {part(p['critics']['rank_r'])}"
    ),
    "V_c": lambda p: (
        f"{part(p['critics']['predicted_over_real_c'])}, {part(p['critics']['rank_c'])}"
    ),
    "Q of IDA": lambda p: f"{part(p['ida_q']['predicted_over_real'])}, {part(p['ida_q']['rank'])}",
    "Q of reachability: AUC on the expert's decisions": lambda p: part(
        p["reachability"]["auc_expert"]
    ),
    "Diffusion at ratio .4: commands' distance to the expert's, before and after": lambda p: (
        f"{part(p['denoiser']['off_expert'])}, {part(p['denoiser']['off_expert_denoised'])}"
    ),
    "CSA: the same": lambda p: (
        f"{part(p['consistency']['off_expert'])}, {part(p['consistency']['off_expert_assisted'])}"
    ),
    "SafeRL-Res: cost per 1000 env steps at the end of its training": lambda p: (
        f"{p['residual']['cost_per_1000']:.0f}"
    ),
    "minutes on busy cores: expert, world model, policies, the assistants": lambda p: ", ".join(
        f"{sum(p[name]['seconds'] for name in names if name in p) / 60:.0f}"
        for names in (
            ("expert",),
            ("world_model",),
            ("policies",),
            ("critics", "ida_q", "denoiser", "consistency", "reachability", "residual"),
        )
    ),
}


def trained(spec: str = "field") -> dict[str, Parts]:
    """Return what is published of a spec's training, by task."""
    loaded = load(ROOT / "specs" / f"{spec}.yaml")
    grid = lay_out_over(loaded.spec, Layout(Path("nowhere")), str(ROOT / "results" / "published"))
    tasks: dict[str, dict[str, dict[str, Any]]] = {task: {} for task in TASKS}
    for node in grid.nodes:
        folder = ROOT / "results" / "published" / "store" / node.kind / node.key
        if node.kind in ("evaluate", "calibration") or not (folder / "_manifest.json").is_file():
            continue
        manifest = json.loads((folder / "_manifest.json").read_text(encoding="utf-8"))
        parts = tasks[manifest["task"]]
        parts[node.kind] = {**manifest["summary"], "seconds": manifest["provenance"]["seconds"]}
        if node.kind == "expert":
            parts["acceptance"] = json.loads(
                (folder / "acceptance.json").read_text(encoding="utf-8")
            )[-1]
    return {task: parts for task, parts in tasks.items() if "residual" in parts}


def table(tasks: Mapping[str, Parts]) -> str:
    """Write what every part is worth."""
    lines = [
        f"| | {' | '.join(TASKS[task] for task in tasks)} |",
        "| --- |" + " ---: |" * len(tasks),
    ]
    lines += [
        f"| {title} | {' | '.join(row(parts) for parts in tasks.values())} |"
        for title, row in ROWS.items()
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(trained()))
