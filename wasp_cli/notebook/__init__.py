"""What `wasp_cli.results` and `wasp_cli.load_world_model` return."""
