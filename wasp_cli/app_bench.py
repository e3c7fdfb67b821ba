"""The commands under `wasp bench`: what the planner costs, and what it reaches with a perfect model."""

from __future__ import annotations

import typer

bench_app = typer.Typer(no_args_is_help=True, help="Measure the planner: its speed, and its ceiling with a perfect model.")
