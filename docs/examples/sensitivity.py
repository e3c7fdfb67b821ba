"""How much do the results of WASP depend on what the paper leaves open? Print the table of REPRODUCTION.md.

python docs/examples/sensitivity.py                 from the published rows
python docs/examples/sensitivity.py RESULTS ROWS    first write the rows: of every evaluation of WASP in RESULTS that differs from the default
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.spec.presets import preset_values
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import EPISODES_FILE

ROWS = Path(__file__).parents[2] / "results" / "published" / "reports" / "sensitivity" / "episodes.parquet"
TASKS = {"race1": "Race1", "goal1": "Goal1"}
DEFAULT = "as published"
SETTINGS = {
    "tau_c": "τ_c", "alpha": "α", "gate_rollouts": "M", "candidates": "N", "horizon": "H", "residual_steps": "L",
    "operator_model": "operator model", "tau_r_floor": "least τ_r",
}  # fmt: skip
"""The fields of the section `wasp` in the order of the table, with the paper's symbols. N_e and N_f follow N."""
MEASURES = ("return", "cost", "int_rate")


def setting_of(config: Mapping[str, Any]) -> str | None:
    """Name what differs from the preset `cpu`; None where it is something else than one of SETTINGS."""
    default = WASPConfig.model_validate(preset_values("cpu")["wasp"]).model_dump(mode="json")
    others = {name for name, value in config.items() if default.get(name) != value} - {"elites", "feasible"}
    if not others:
        return DEFAULT
    name = others.pop()
    return None if others or name not in SETTINGS else f"{SETTINGS[name]} = {config[name]}"


def gather(results: Path, target: Path) -> None:
    """Write the rows of a results folder's evaluations: two operators, training seed 1."""
    layout, tables = Layout(results.absolute()), []
    for key in sorted(stored_keys(layout, "evaluate")):
        manifest = read_manifest(layout, "evaluate", key)
        axes = manifest["axes"]
        wanted = axes["method"] == "wasp" and axes["method_config"]["variant"] == "full" and axes["method_config"]["recipe"] == "own"
        if not wanted or manifest["seed"] != 1 or manifest["task"] not in TASKS or axes["variant"] not in ("laggy", "noisy"):
            continue
        setting = setting_of(axes["method_config"])
        if setting is not None:
            rows = pq.read_table(layout.artifact("evaluate", key) / EPISODES_FILE)
            kept = rows.select(["task", "variant", "value", "seed", "episode", "episode_seed", "success", *MEASURES, "mag"])
            tables.append(kept.append_column("setting", pa.array([setting] * len(kept))))
    target.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.concat_tables(tables).replace_schema_metadata(None), target)


def paired(rows: pa.Table, task: str, setting: str, measure: str) -> tuple[float, float, float]:
    """Return a mean over both operators, its difference to the default on the same episodes, and the standard error of that."""
    values: dict[tuple[str, int], dict[str, float]] = {}
    for row in rows.to_pylist():
        if row["task"] == task and row["setting"] in (setting, DEFAULT):
            values.setdefault((row["variant"], row["episode"]), {})[row["setting"]] = row[measure]
    both = {key: each for key, each in values.items() if setting in each and DEFAULT in each}
    variances, differences = [], []
    for operator in sorted({operator for operator, _ in both}):
        apart = np.array([each[setting] - each[DEFAULT] for (who, _), each in both.items() if who == operator])
        differences.append(apart.mean())
        variances.append(apart.var(ddof=1) / len(apart))
    mean = float(np.mean([each[setting] for each in both.values()]))
    return mean, float(np.mean(differences)), float(np.sqrt(np.sum(variances)) / len(variances))


def table(rows: pa.Table) -> str:
    """Write the Markdown table; in brackets the difference to the default with its standard error."""
    heading = [f"{title}: {name}" if name == "return" else name for title in TASKS.values() for name in ("return", "cost", "Int.")]
    lines = ["| Setting | " + " | ".join(heading) + " |", "| --- |" + " ---: |" * len(heading)]
    order = list(SETTINGS.values())
    found = sorted(set(rows["setting"].to_pylist()) - {DEFAULT}, key=lambda text: (order.index(text.split(" = ")[0]), _sorting(text)))
    for setting in [DEFAULT, *found]:
        cells = []
        for task in TASKS:
            for measure in MEASURES:
                mean, apart, error = paired(rows, task, setting, measure)
                digits = 1 if measure == "cost" else 2
                text = f"{mean:.{digits}f}"
                cells.append(text if setting == DEFAULT else f"{text} ({apart:+.{digits}f} ± {error:.{digits}f})")
        lines.append(f"| {setting} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _sorting(text: str) -> tuple[float, str]:
    value = text.split(" = ")[1]
    return (float(value), "") if value[0].isdigit() else (0.0, value)


if __name__ == "__main__":
    source = ROWS
    if len(sys.argv) == 3:
        source = Path(sys.argv[2])
        gather(Path(sys.argv[1]), source)
    print(table(pq.read_table(source)))
