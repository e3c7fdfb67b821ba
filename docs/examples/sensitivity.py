"""How much do the results of WASP depend on what the paper leaves open? Print the tables of REPRODUCTION.md, from the published rows.

python docs/examples/sensitivity.py
python docs/examples/sensitivity.py ROWS RESULTS...     first write the rows: of WASP's evaluations in these folders, by what they change
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.spec.presets import preset_values
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import EPISODES_FILE

ROWS = Path(__file__).parents[2] / "results" / "published" / "sensitivity.parquet"
DEFAULT = "as published"
SETTINGS = {
    "tau_c": "τ_c", "alpha": "α", "gate_rollouts": "M", "candidates": "N", "horizon": "H", "residual_steps": "L",
    "operator_model": "operator model", "tau_r_floor": "least τ_r", "bootstrap_reward": "V_r", "variant": "variant",
}  # fmt: skip
"""Fields of the section `wasp` in the order of the tables, with the paper's symbols. N_e and N_f follow N."""
SWEPT, OPERATORS, CAUSES = {"race1": "Race1", "goal1": "Goal1"}, ("laggy", "noisy"), "formula1"
ABLATED = ("no-rollout", "task-only")
"""Those of Table 2's variants that were computed for more than one training."""
MODERATE = {"noisy": 0.45, "laggy": 0.7, "limited-skill": 0.25, "reaction-time": 0.24}
COLUMNS = ("task", "seed", "variant", "episode", "episode_seed", "success", "return", "cost", "int_rate", "mag")
MEASURES = {"return": 2, "cost": 1, "int_rate": 2}
"""With the digits that are shown."""


def setting_of(config: Mapping[str, Any]) -> str | None:
    """Name what differs from the preset `cpu`; None where it is something else than one of SETTINGS."""
    default = WASPConfig.model_validate(preset_values("cpu")["wasp"]).model_dump(mode="json")
    others = {name for name, value in config.items() if default.get(name) != value} - {"elites", "feasible"}
    if not others:
        return DEFAULT
    name = others.pop()
    return None if others or name not in SETTINGS else f"{SETTINGS[name]} = {config[name]}"


def gather(target: Path, folders: Sequence[Path]) -> None:
    """Write the rows of the sweeps and of what was tried on FormulaOne1, beside the default on the same worlds."""
    found: dict[tuple[str, int, str, str], pa.Table] = {}
    for folder in folders:
        layout = Layout(folder.absolute())
        for key in sorted(stored_keys(layout, "evaluate")):
            manifest = read_manifest(layout, "evaluate", key)
            axes, task, seed = manifest["axes"], manifest["task"], manifest["seed"]
            moderate = axes["method"] == "wasp" and MODERATE.get(axes["variant"]) == axes["value"]
            swept = task in SWEPT and seed == 1 and axes["variant"] in OPERATORS
            if not moderate or not (swept or task == CAUSES):
                continue
            setting = setting_of(axes["method_config"])
            ablated = axes["method_config"]["variant"] not in ("full", *(() if swept else ABLATED))
            if setting is not None and not ablated:
                rows = pq.read_table(layout.artifact("evaluate", key) / EPISODES_FILE, columns=list(COLUMNS))
                found[task, seed, setting, axes["variant"]] = rows.append_column("setting", pa.array([setting] * len(rows)))
    changed = {(task, seed, operator) for task, seed, setting, operator in found if setting != DEFAULT}
    kept = [rows for (task, seed, _, operator), rows in sorted(found.items()) if (task, seed, operator) in changed]
    table = pa.concat_tables([rows.replace_schema_metadata(None) for rows in kept]).rename_columns({"variant": "operator"})
    pq.write_table(table, target, compression="zstd")


def compared(rows: pa.Table, task: str, seed: int, setting: str) -> dict[str, tuple[float, float, float]]:
    """Return by measure the mean over operators, its difference to the default on the same episodes, and the standard error of that."""
    here = rows.filter((pc.field("task") == task) & (pc.field("seed") == seed))
    pairs: dict[tuple[str, int], dict[str, Mapping[str, Any]]] = {}
    for row in here.to_pylist():
        pairs.setdefault((row["operator"], row["episode"]), {})[row["setting"]] = row
    found = {}
    for measure in MEASURES:
        apart: dict[str, list[float]] = {}
        values: dict[str, list[float]] = {}
        for (operator, _), pair in pairs.items():
            if setting in pair and DEFAULT in pair:
                values.setdefault(operator, []).append(pair[setting][measure])
                apart.setdefault(operator, []).append(pair[setting][measure] - pair[DEFAULT][measure])
        error = np.sqrt(sum(np.var(each, ddof=1) / len(each) for each in apart.values())) / len(apart)
        mean, difference = (float(np.mean([np.mean(each) for each in by.values()])) for by in (values, apart))
        found[measure] = mean, difference, float(error)
    return found


def cells(rows: pa.Table, task: str, seed: int, setting: str) -> Iterator[str]:
    """Write the measures of a setting; in brackets the difference to the default with its standard error."""
    for measure, (mean, apart, error) in compared(rows, task, seed, setting).items():
        digits = MEASURES[measure]
        yield f"{mean:.{digits}f}" + ("" if setting == DEFAULT else f" ({apart:+.{digits}f} ± {error:.{digits}f})")


def settings(rows: pa.Table, task: str, seed: int) -> list[str]:
    """List the settings that were tried, in order, the default first."""
    order = list(SETTINGS.values())
    names = set(rows.filter((pc.field("task") == task) & (pc.field("seed") == seed))["setting"].to_pylist()) - {DEFAULT}

    def place(text: str) -> tuple[int, float, str]:
        name, value = text.split(" = ")
        return order.index(name), float(value) if value[0].isdigit() else 0.0, value

    return [DEFAULT, *sorted(names, key=place)]


def sweeps(rows: pa.Table) -> str:
    """Write the table of the sweeps."""
    heading = [f"{title}: {name}" for title in SWEPT.values() for name in ("return", "cost", "Int.")]
    lines = ["| Setting | " + " | ".join(heading) + " |", "| --- |" + " ---: |" * len(heading)]
    for setting in [each for each in settings(rows, "race1", 1) if each in settings(rows, "goal1", 1)]:
        lines.append(f"| {setting} | " + " | ".join(text for task in SWEPT for text in cells(rows, task, 1, setting)) + " |")
    return "\n".join(lines)


def causes(rows: pa.Table) -> str:
    """Write the table of what was tried on FormulaOne1."""
    lines = ["| Training | Operators | Setting | Return | Cost | Int. |", "| ---: | --- | --- | ---: | ---: | ---: |"]
    for seed in sorted(set(rows.filter(pc.field("task") == CAUSES)["seed"].to_pylist())):
        for setting in settings(rows, CAUSES, seed)[1:]:
            tried = rows.filter((pc.field("task") == CAUSES) & (pc.field("seed") == seed) & (pc.field("setting") == setting))
            operators = [each for each in MODERATE if each in set(tried["operator"].to_pylist())]
            parts = {"all four": rows} if len(operators) == len(MODERATE) else {
                each: rows.filter(pc.field("operator") == each) for each in operators
            }  # fmt: skip
            for who, part in parts.items():
                lines.append(f"| {seed} | {who} | {setting} | " + " | ".join(cells(part, CAUSES, seed, setting)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    source = ROWS
    if len(sys.argv) > 2:
        source = Path(sys.argv[1])
        gather(source, [Path(each) for each in sys.argv[2:]])
    published = pq.read_table(source)
    print(sweeps(published), causes(published), sep="\n\n")
