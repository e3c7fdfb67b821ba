"""The spec of `wasp ablate`: another spec, narrowed to a method and one of its variants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wasp_cli.errors import UnknownName
from wasp_cli.methods.registry import METHODS
from wasp_cli.spec.load import Loaded, load
from wasp_cli.spec.model import preset_names
from wasp_cli.spec.names import assistant_variants
from wasp_cli.tasks.registry import TASKS

WHOLE = "full"


def ablation(path: Path, variant: str, task: str | None = None, preset: str | None = None, settings: Sequence[str] = ()) -> Loaded:
    """The spec at `path` with the method that has `variant`, run whole and as that variant.

    Raises:
        UnknownName: no such variant, task or preset.
        InvalidSpec: the spec at `path` is not valid.
    """
    if variant not in assistant_variants():
        raise UnknownName("assistant variant", variant, assistant_variants())
    # The whole method is in every ablation; for `full` itself, it is the method that can be ablated.
    method = next(info.name for info in METHODS.values() if variant in info.variants and len(info.variants) > 1)
    narrowed = [f"name=ablate-{variant}", f"methods=[{method}]", f"variants=[{', '.join(dict.fromkeys((WHOLE, variant)))}]"]
    if task is not None:
        narrowed.append(f"tasks=[{TASKS[task].name}]")
    if preset is not None:
        if preset not in preset_names():
            raise UnknownName("preset", preset, preset_names())
        narrowed.append(f"preset={preset}")
    return load(path, [*narrowed, *settings])
