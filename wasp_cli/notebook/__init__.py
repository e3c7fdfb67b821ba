"""Results and trained parts in one line, for notebooks and scripts: what `wasp_cli.results` and `wasp_cli.load_world_model` return."""
